"""What this package does behind the backs of libraries: each with its reason, and the release with which it can go.

Whoever raises the least version of a library in ``pyproject.toml`` looks here first.

| function | library | goes with the first release that |
|---|---|---|
| :func:`pointer_places` | NumPy (in none up to 2.4) | gives the addresses of many arrays at once |
| :func:`compiled_headers` | Warp (in none up to 1.19) | shares its precompiled header among threads |
| :func:`without_line` | Warp (in none up to 1.19) | keeps to ``log_level`` for what its native code prints |
| :func:`load_extensions_whole` | h5py, Cython (3.16 was not tried) | passes on a Ctrl-C during an import |
| :func:`first_page` | trame-client (in none up to 4.1) | takes title, viewport and socket of the page as options |
| :func:`untracked_shared_memory`, :func:`remove_shared_memory` | Python (3.11, 3.12) | has ``track=False``: 3.13 |
| :func:`trame_globals_restored`, :func:`remove_from_trame` | trame-server (in none up to 4.1) | has no globals |
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from functools import cache, wraps
from importlib.machinery import ExtensionFileLoader
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from amiwarp.tasks import interrupts_later

if TYPE_CHECKING:
    from multiprocessing.shared_memory import SharedMemory

    import numpy as np
    from numpy.typing import NDArray

HEAD = object.__basicsize__
"""Place of the pointer to the values in NumPy's array object (``PyArrayObject_fields`` in its C interface) [bytes]."""


_TRACKER_LOCK = threading.Lock()
"""Held while Python's tracker of resources is hidden from the module of shared memory."""


@cache
def layout_is_known() -> bool:
    """Return whether this NumPy keeps the pointer to an array's values at :data:`HEAD`."""
    import numpy as np

    probe = np.zeros(1)
    return bool(ctypes.c_uint64.from_address(id(probe) + HEAD).value == address(probe))


def address(array: NDArray[Any]) -> int:
    """Return the address of an array's first value."""
    return int(array.__array_interface__["data"][0])


def pointer_places(arrays: list[NDArray[Any]]) -> tuple[NDArray[np.uint64], object]:
    """Return the addresses at which the pointers to the arrays' values are stored, and what must live until the copy.

    A batch of 104 packets has 416 arrays. NumPy's public interface needs 1 to 1.5 us for each, where native code reads
    the pointer out of the array object in 0.04 us: without that, a GPU compensates a quarter fewer events per second.
    """
    import numpy as np

    arrays = [
        array if array.flags.c_contiguous else np.ascontiguousarray(array) for array in arrays
    ]
    if layout_is_known():
        objects = np.array(list(map(id, arrays)), np.uint64)
        return objects + np.uint64(HEAD), arrays
    # Else the pointers are stored in an array of our own, of 8 bytes each.
    pointers = np.array([address(array) for array in arrays], np.uint64)
    index = np.arange(len(arrays), dtype=np.uint64)
    places = np.uint64(address(pointers)) + np.uint64(8) * index
    return places, (pointers, arrays)


def compiled_headers() -> dict[int, Any]:
    """Return Warp's folders of its precompiled header for CPUs, by the identity of the thread.

    Warp makes one for each thread that compiles, which takes three seconds. If a later version keeps them elsewhere,
    the dictionary is empty, and each thread makes its own.
    """
    import warp as wp

    return getattr(wp._src.context.runtime, "_pch_dirs", {})  # type: ignore[attr-defined]  # private


@contextlib.contextmanager
def without_line(line: str) -> Iterator[None]:
    """Print what native code writes to stderr, except for one expected line, inside a ``with`` block.

    Warp's library prints that it has found no driver of a GPU, and asks none of Warp's settings first.
    """
    sys.stderr.flush()
    original = os.dup(2)
    with tempfile.TemporaryFile() as caught:
        os.dup2(caught.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(original, 2)
            os.close(original)
            caught.seek(0)
            for text in caught.read().decode(errors="replace").splitlines():
                if line not in text:
                    print(text, file=sys.stderr, flush=True)


def load_extensions_whole() -> None:
    """Postpone Ctrl-C while a compiled module is loaded, because some drop it: h5py, and more by Cython.

    For the command line only: it changes the loader of the whole process.
    """
    for method in ("create_module", "exec_module"):
        setattr(ExtensionFileLoader, method, _loaded_whole(getattr(ExtensionFileLoader, method)))


def _loaded_whole(load: Callable[..., Any]) -> Callable[..., Any]:
    """Return a method of the loader with Ctrl-C postponed."""

    @wraps(load)
    def whole(*arguments: Any) -> Any:
        with interrupts_later():
            return load(*arguments)

    return whole


def untracked_shared_memory(name: str, size: int | None = None) -> SharedMemory:
    """Open shared memory, or make it with a ``size`` [bytes], without Python's tracker of resources.

    The tracker removes at the end of a program what it only read, although another program still writes to it.
    """
    from multiprocessing import shared_memory

    options: dict[str, Any] = {} if size is None else {"create": True, "size": size}
    if sys.version_info >= (3, 13):
        return shared_memory.SharedMemory(name, track=False, **options)
    with _untracked(shared_memory):
        return shared_memory.SharedMemory(name, **options)


def remove_shared_memory(memory: SharedMemory) -> None:
    """Remove the name of shared memory that :func:`untracked_shared_memory` opened."""
    from multiprocessing import shared_memory

    with _untracked(shared_memory):
        memory.unlink()


@contextlib.contextmanager
def _untracked(module: Any) -> Iterator[None]:
    """Hide the tracker of resources from the module of shared memory."""
    if sys.version_info >= (3, 13):
        yield
        return
    with _TRACKER_LOCK:
        tracker = module.resource_tracker
        nothing = SimpleNamespace(register=lambda *_: None, unregister=lambda *_: None)
        module.resource_tracker = nothing
        try:
            yield
        finally:
            module.resource_tracker = tracker


def first_page(path: Path, route: str) -> str:
    """Return trame's first page with the inspector's own socket, from the folder ``route``. Its reader can enlarge it.

    It shows a plain text until the page is ready. trame has no option for these.
    """
    page = path.read_text(encoding="utf-8")
    page = re.sub(
        r'<meta\s+name="viewport"[^>]*>',
        '<meta name="viewport" content="width=device-width">',
        page,
    )
    head = f'<script src="{route}/socket.js"></script><title>amiwarp inspector</title>'
    page = re.sub(r"<title>.*?</title>", head, page)
    return re.sub(
        r'<div id="app"></div>\s*<script>.*?</script>',
        '<div id="app">opening the inspector …</div>',
        page,
        flags=re.DOTALL,
    )


@contextlib.contextmanager
def trame_globals_restored() -> Iterator[None]:
    """Hide the command line from trame, and restore the environment and trame's globals afterwards.

    trame keeps one server, its options and its socket for the whole process; each browser tab here has its own server.
    """
    from trame_server import protocol

    names = ("TRAME_ARGS", "WSLINK_HEART_BEAT", "WSLINK_MAX_MSG_SIZE", "WSLINK_READY_MSG")
    before = {name: os.environ[name] for name in names if name in os.environ}
    os.environ["TRAME_ARGS"] = ""
    try:
        yield
    finally:
        protocol.CoreServer.server = None
        protocol.server.ws_server = None
        for name in names:
            os.environ.pop(name, None)
        os.environ.update(before)


def remove_from_trame(server: Any) -> None:
    """Remove the server from trame's global variables, which would keep it alive."""
    from trame_client.widgets.core import HTML_CTX

    if HTML_CTX._server is server:
        HTML_CTX._server = None
