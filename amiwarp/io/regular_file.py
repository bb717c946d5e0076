"""Check that an input is a regular file. A pipe or a device could block its reader, or never end."""

from __future__ import annotations

import stat
from pathlib import Path

from amiwarp.errors import AmiwarpError

KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a named pipe (FIFO)",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a character device",
    stat.S_IFBLK: "a block device",
}
"""Names of the file types that are refused, used in messages."""


def check_regular(path: Path) -> None:
    """Check that ``path``, symbolic links followed, is a regular file, without opening it.

    Raises
    ------
    AmiwarpError
        If the file does not exist or cannot be reached, or is a folder, a named pipe, a socket or a device.
    """
    try:
        kind = stat.S_IFMT(path.stat().st_mode)
    except FileNotFoundError as error:
        raise AmiwarpError(f"{path}: no such file") from error
    except (OSError, ValueError) as error:
        what = getattr(error, "strerror", None) or error
        raise AmiwarpError(f"{path}: cannot be opened: {what}; give another file") from error
    if kind != stat.S_IFREG:
        raise AmiwarpError(f"{path}: is {KINDS.get(kind, 'not a regular file')}; give a regular file")
