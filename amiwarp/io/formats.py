"""Detection of the format of a recording from its content, and a function that opens recordings of all formats."""

from __future__ import annotations

import enum
import os
from collections.abc import Callable
from pathlib import Path

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Recording
from amiwarp.io.input_files import errors_name
from amiwarp.io.regular_file import check_regular
from amiwarp.validation import choice


class Format(enum.StrEnum):
    """File formats of recordings that amiwarp reads."""

    HDF5 = "hdf5"
    """HDF5 file: native recording of amiwarp, or event file of the DSEC data set."""
    EVT = "evt"
    """Prophesee RAW file with the encoding EVT 2.0 or EVT 3.0."""
    DAT = "dat"
    """Prophesee DAT file."""
    AEDAT4 = "aedat4"
    """iniVation AEDAT 4.0 file."""
    ES = "es"
    """Event Stream (.es) file."""
    TEXT = "text"
    """Text file in the format of the Event Camera Dataset: lines of ``t x y p``, with t in seconds."""
    NPZ = "npz"
    """NumPy archive with the arrays x, y, t and p."""


def detect_format(path: Path) -> Format:
    """Return the format of a file from the first bytes. Raises :class:`AmiwarpError` for an unknown format."""
    check_regular(path)
    with errors_name(path, lambda: "opening"), path.open("rb") as file:
        head = file.read(4096)
    if not head:
        raise AmiwarpError(f"{path}: is empty; give a recording")
    for magic, found in (
        (b"\x89HDF\r\n\x1a\n", Format.HDF5),
        (b"#!AER-DAT4", Format.AEDAT4),
        (b"Event Stream", Format.ES),
        (b"PK\x03\x04", Format.NPZ),
    ):
        if head.startswith(magic):
            return found
    if head.startswith(b"#!AER-DAT"):
        raise AmiwarpError(f"{path}: is AEDAT {head[9:12].decode('ascii', 'replace')}; only AEDAT 4 is read")
    if head.startswith(b"%"):
        return Format.EVT if _is_evt(head) else Format.DAT
    if _looks_like_text(head):
        return Format.TEXT
    known = ", ".join(member.value for member in Format)
    raise AmiwarpError(f"{path}: content is of no known format; expected one of {known}")


def _is_evt(head: bytes) -> bool:
    """Return whether the first bytes of a Prophesee file are the header of a RAW (EVT) file."""
    lines = head.split(b"\n")
    return any(line.startswith((b"% evt ", b"% format EVT")) for line in lines)


def _looks_like_text(head: bytes) -> bool:
    """Return whether the first line without a comment consists of two or four numbers."""
    line = next((line for line in head.split(b"\n") if line.strip() and not line.lstrip().startswith(b"#")), b"")
    try:
        return len([float(word) for word in line.split()]) in (2, 4)
    except ValueError:
        return False


def open_recording(path: str | os.PathLike[str], *, format: Format | str | None = None) -> Recording:
    """Open a recording of any supported format.

    Formats without an index are read once to count, check and repair their events. The recording's ``metadata`` lists
    the repairs.

    Parameters
    ----------
    path : str or path-like
        Recording to open.
    format : Format or str, optional
        Format of the file. By default, the format is detected from the content.

    Returns
    -------
    Recording
        The recording, whose events are read on demand.

    Raises
    ------
    AmiwarpError
        If the file cannot be read. The message names the file and the position in the file.

    Examples
    --------
    >>> import numpy as np
    >>> np.savez("short.npz", x=[1, 2], y=[0, 0], t=[0, 10], p=[1, 0], width=4, height=4)
    >>> recording = amiwarp.open_recording("short.npz")
    >>> len(recording.events), recording.metadata["format"]
    (2, 'npz')
    """
    path = Path(path)
    chosen = detect_format(path) if format is None else choice(Format, format, f"{path}: format")
    return _opener(chosen)(path)


def _opener(chosen: Format) -> Callable[[Path], Recording]:
    """Return the function that opens recordings of a format."""
    # Each reader is imported when it is needed, because the libraries of the readers take time to load.
    if chosen is Format.HDF5:
        from amiwarp.io.native_reader import open_native as opener
    elif chosen is Format.EVT:
        from amiwarp.io.prophesee import open_evt as opener
    elif chosen is Format.DAT:
        from amiwarp.io.prophesee import open_dat as opener
    elif chosen is Format.AEDAT4:
        from amiwarp.io.aedat import open_aedat4 as opener
    elif chosen is Format.ES:
        from amiwarp.io.event_stream import open_es as opener
    elif chosen is Format.TEXT:
        from amiwarp.io.text import open_text as opener
    else:
        from amiwarp.io.npz import open_npz as opener
    return opener
