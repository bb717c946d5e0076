"""Return of freed memory to the operating system."""

import ctypes
import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress


def release_memory() -> None:
    """Collect garbage, and return freed memory to the operating system.

    Objects that refer to each other in cycles are freed by the garbage collector only. glibc keeps freed memory in the
    arena of each thread until ``malloc_trim`` is called.
    """
    gc.collect()
    if sys.platform.startswith("linux"):
        with suppress(AttributeError):  # musl has no malloc_trim
            ctypes.CDLL(None).malloc_trim(0)


@contextmanager
def no_garbage_collection() -> Iterator[None]:
    """Stop the garbage collector in all threads, inside a ``with`` block. What is due then is collected at its end."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.collect(0)  # in this thread, or the next thread that allocates anything would do it
            gc.enable()


@contextmanager
def only_new_garbage() -> Iterator[None]:
    """Make the garbage collector ignore the objects that exist now, inside a ``with`` block.

    Modules create several 100,000 objects, and to visit them all may take as long as a calibration on a GPU.
    """
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
