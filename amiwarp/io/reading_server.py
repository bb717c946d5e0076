"""Server that runs in the process of :mod:`amiwarp.io.reading_process`: it reads requests and sends results."""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import struct
import sys
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError

PACKET = 1 << 17
"""Number of events that are joined to one packet before it is sent."""

PACKET_S = 2.0
"""Processor time after which packets are sent, however few they are [s]. A request has a limit of time."""

Reply = tuple[Any, list[NDArray[Any]]]
"""Reply to a request: a JSON value, and arrays of shape ``(n,)``."""

_state: dict[str, Any] = {}
"""Values that are kept between requests, by name."""


def serve() -> None:
    """Serve requests until the other process closes its pipe or ends."""
    requests = sys.stdin.buffer
    replies = os.fdopen(os.dup(1), "wb")
    # Text that a library prints must not mix with the replies.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    with contextlib.suppress(BrokenPipeError):
        while line := requests.readline():
            request = json.loads(line)
            _limit(request["cpu_s"], request["memory_bytes"])
            head, arrays = _answer(request)
            encoded = json.dumps(head).encode()
            replies.write(struct.pack("<I", len(encoded)) + encoded)
            for array in arrays:
                replies.write(array.data if array.size else b"")
            replies.flush()
    os._exit(0)


def _answer(request: dict[str, Any]) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    """Run the function of a request, and return its result or its error."""
    module, _, name = request["function"].partition(":")
    try:
        result, arrays = getattr(importlib.import_module(module), name)(*request["arguments"])
        arrays = [np.ascontiguousarray(array) for array in arrays]
        return {"result": result, "arrays": [(array.dtype.str, array.size) for array in arrays]}, arrays
    except AmiwarpError as error:
        return {"error": str(error)}, []
    except MemoryError:
        most = request["memory_bytes"] >> 20
        return {"error": f"needs over {most} MiB of memory at once; the file is damaged or too large"}, []
    except BaseException as error:  # panics of compiled decoders derive from BaseException
        return {"error": " ".join(str(error).split())[:300] or type(error).__name__}, []


def _limit(cpu_s: int, memory_bytes: int) -> None:
    """Limit processor time and memory of one request, if the system supports it."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        used = resource.getrusage(resource.RUSAGE_SELF)
        resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))
        hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
        soft = int(used.ru_utime + used.ru_stime) + 1 + cpu_s
        resource.setrlimit(resource.RLIMIT_CPU, (soft if hard < 0 else min(soft, hard), hard))
        with open("/proc/self/statm") as sizes:
            taken = int(sizes.read().split()[0]) * resource.getpagesize()
        hard = resource.getrlimit(resource.RLIMIT_AS)[1]
        soft = taken + memory_bytes
        resource.setrlimit(resource.RLIMIT_AS, (soft if hard < 0 else min(soft, hard), hard))


def prepare(module: str) -> Reply:
    """Import a module of which a function will be called. An error of the import is reported by that call."""
    with contextlib.suppress(Exception):
        importlib.import_module(module)
    return None, []


def keep(name: str, value: Any) -> None:
    """Keep a value between requests, until :func:`forget` is called."""
    _state[name] = value


def kept(name: str) -> Any:
    """Return a value that :func:`keep` stored."""
    return _state[name]


def forget() -> Reply:
    """Close and drop all values that were kept for a reader."""
    for value in _state.values():
        with contextlib.suppress(Exception):
            value.close()
    _state.clear()
    return None, []


def begin(function: str, *arguments: Any) -> Reply:
    """Start a generator of packets. Its first argument is a dictionary for counts."""
    module, _, name = function.partition(":")
    notes: dict[str, int] = {}
    keep("notes", notes)
    keep("packets", getattr(importlib.import_module(module), name)(notes, *arguments))
    return None, []


def advance() -> Reply:
    """Return the counts and the next packets of the started generator, joined; no arrays at the end."""
    found: list[tuple[NDArray[Any], ...]] = []
    for packet in _next_packets(kept("packets")):
        found.append(packet)
    return kept("notes"), [np.concatenate(parts) for parts in zip(*found, strict=True)]


def _next_packets(source: Iterator[tuple[NDArray[Any], ...]]) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield packets until they hold at least :data:`PACKET` events, or took :data:`PACKET_S`, if they hold few."""
    count, began = 0, time.process_time()
    for packet in source:
        count += len(packet[0])
        yield packet
        if count >= PACKET or time.process_time() - began > PACKET_S:
            return


def noting_progress(decoder: Iterator[Any], path: str, notes: dict[str, int]) -> Iterator[Any]:
    """Yield the packets of a compiled decoder, and note how much of its file it has read, on Linux."""
    number = _open_file(path)
    for packet in decoder:
        if number is not None:
            with contextlib.suppress(OSError, ValueError), open(f"/proc/self/fdinfo/{number}") as about:
                notes["read"] = int(about.readline().split()[1])
                notes["total"] = os.path.getsize(path)
        yield packet


def _open_file(path: str) -> str | None:
    """Return the number of the open file with this path, on Linux."""
    with contextlib.suppress(OSError):
        for number in os.listdir("/proc/self/fd"):
            with contextlib.suppress(OSError):
                if os.path.samefile(f"/proc/self/fd/{number}", path):
                    return number
    return None
