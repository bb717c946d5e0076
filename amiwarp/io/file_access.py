"""Reading and writing at a place of an open file, in any thread, and reserving its space on the disk."""

from __future__ import annotations

import errno
import os
import threading
from collections.abc import Sequence
from typing import Any


def allocate(handle: int, start: int, count: int) -> None:
    """Reserve disk space for a file.

    Raises OSError if the disk is full. Systems that cannot reserve space do nothing.
    """
    if hasattr(os, "posix_fallocate"):
        try:
            os.posix_fallocate(handle, start, count)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP):
                raise


# On systems without os.pread, a place is reached by moving the file's position
_seeking = threading.Lock()


def read_at(handle: int, buffer: Any, place: int) -> int:
    """Read bytes at a place of a file [bytes] into ``buffer``, and return their number. Any thread may call it."""
    if hasattr(os, "preadv"):
        return os.preadv(handle, [buffer], place)
    view = memoryview(buffer).cast("B")
    with _seeking:
        os.lseek(handle, place, os.SEEK_SET)
        data = os.read(handle, len(view))
    view[: len(data)] = data
    return len(data)


def write_at(handle: int, parts: Sequence[Any], place: int) -> int:
    """Write parts one after the other at a place of a file [bytes], and return how many bytes were written."""
    if hasattr(os, "pwritev"):
        return os.pwritev(handle, parts, place)
    with _seeking:
        os.lseek(handle, place, os.SEEK_SET)
        return os.write(handle, parts[0])
