"""The part of the reading process that runs in it: it reads requests and sends results."""

import contextlib
import importlib
import json
import os
import signal
import struct
import sys
import time
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode

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
            head, arrays, cpu_s = _answer(request)
            encoded = json.dumps({**head, "keeps": bool(_state), "cpu_s": cpu_s}).encode()
            replies.write(struct.pack("<I", len(encoded)) + encoded)
            for array in arrays:
                replies.write(array.data if array.size else b"")
            replies.flush()
    os._exit(0)


def _answer(request: dict[str, Any]) -> tuple[dict[str, Any], list[NDArray[Any]], float]:
    """Run the function of a request. Return its result or its error, its arrays, and the processor time [s]."""
    module, _, name = request["function"].partition(":")
    try:
        function = getattr(importlib.import_module(module), name)
    except Exception as error:
        # The file is not to blame.
        return {"error": f"amiwarp cannot be loaded: {_said(error)}; install it again"}, [], 0.0
    began = time.process_time()
    _limit(request["cpu_s"], request["memory_bytes"])
    head, arrays = _outcome(function, request)
    _limit_cpu(0.0)
    return head, arrays, time.process_time() - began


def _outcome(
    function: Callable[..., Reply], request: dict[str, Any]
) -> tuple[dict[str, Any], list[NDArray[Any]]]:
    """Return the result of a function, or its error, and its arrays."""
    try:
        result, arrays = function(*request["arguments"])
        arrays = [np.ascontiguousarray(array) for array in arrays]
        kinds = [(array.dtype.str, array.size) for array in arrays]
        return {"result": result, "arrays": kinds}, arrays
    except AmiwarpError as error:
        return {"error": str(error), "code": error.code}, []
    except MemoryError:
        most = f"{request['memory_bytes'] >> 20} MiB of memory at once"
        return {
            "error": f"needs over {most}; the file is damaged or too large",
            "code": ErrorCode.FILE_DAMAGED,
        }, []
    except BaseException as error:
        # Panics of compiled decoders derive from BaseException.
        return {"error": _said(error), "code": ErrorCode.FILE_DAMAGED}, []


def _said(error: BaseException) -> str:
    """Return the message of an exception as one line, or the name of its type."""
    return " ".join(str(error).split())[:300] or type(error).__name__


def _limit(cpu_s: float, memory_bytes: int) -> None:
    """Limit processor time and memory of one request, if the system supports it."""
    _limit_cpu(cpu_s)
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        _set_limit(resource.RLIMIT_CORE, 0)
        taken = int(os.pread(_memory_sizes(), 64, 0).split()[0]) * resource.getpagesize()
        _set_limit(resource.RLIMIT_AS, taken + memory_bytes)


def _limit_cpu(cpu_s: float) -> None:
    """End this process after some processor time [s], if the system supports it; 0: never."""
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_PROF, cpu_s)


_limits: dict[int, tuple[int, int]] = {}
"""Limit and hard limit that were set last, by resource."""


def _set_limit(which: int, soft: int) -> None:
    """Set the limit of a resource, unless it is set already."""
    import resource

    before, hard = _limits.get(which) or resource.getrlimit(which)
    soft = soft if hard < 0 else min(soft, hard)
    if soft != before or which not in _limits:
        resource.setrlimit(which, (soft, hard))
        _limits[which] = soft, hard


@cache
def _memory_sizes() -> int:
    """Open the file in which Linux shows the memory that this process takes."""
    return os.open("/proc/self/statm", os.O_RDONLY)


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
    count = 0
    began = time.process_time()
    for packet in source:
        count += len(packet[0])
        yield packet
        if count >= PACKET or time.process_time() - began > PACKET_S:
            return
