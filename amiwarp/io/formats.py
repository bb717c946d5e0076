"""Detection of the format of a recording from its content, and a function that opens recordings of all formats."""

from __future__ import annotations

import enum
import importlib
import os
from collections.abc import Callable
from pathlib import Path

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Recording
from amiwarp.io.input_files import check_regular, errors_name, name_kind, open_input
from amiwarp.io.nmnist import looks_like_bin
from amiwarp.validation import choice, guarded


class Format(enum.StrEnum):
    """File formats of recordings that amiwarp reads."""

    HDF5 = "hdf5"
    """HDF5 file: native recording of amiwarp, or event file of DSEC, TUM-VIE, M3ED, MVSEC or Prophesee."""
    EVT = "evt"
    """Prophesee RAW file with the encoding EVT 2.0, 2.1 or 3.0."""
    DAT = "dat"
    """Prophesee DAT file."""
    AEDAT4 = "aedat4"
    """iniVation AEDAT 4.0 file."""
    AEDAT3 = "aedat3"
    """iniVation AEDAT 3.1 file."""
    AEDAT2 = "aedat2"
    """AEDAT 2.0 file, which jAER records with the DVS128 and the DAVIS cameras."""
    ROSBAG = "rosbag"
    """ROS 1 bag, or ROS 2 bag (SQLite or MCAP)."""
    ES = "es"
    """Event Stream (.es) file."""
    TEXT = "text"
    """Text file in the format of the Event Camera Dataset: lines of ``t x y p``, with t in seconds."""
    NPZ = "npz"
    """NumPy archive with the arrays x, y, t and p, or with those of N-ImageNet or EV-IMO."""
    EVIMO = "evimo"
    """Folder of NumPy files of the EV-IMO2 data set."""
    BIN = "bin"
    """Binary file of the N-MNIST and N-Caltech101 data sets, with 5 bytes per event."""


SIGNATURES = (
    (b"\x89HDF\r\n\x1a\n", Format.HDF5),
    (b"#!AER-DAT4", Format.AEDAT4),
    (b"#!AER-DAT3.1", Format.AEDAT3),
    (b"#!AER-DAT2.0", Format.AEDAT2),
    (b"#ROSBAG V2.0", Format.ROSBAG),
    (b"SQLite format 3\0", Format.ROSBAG),
    (b"\x89MCAP0\r\n", Format.ROSBAG),
    (b"Event Stream", Format.ES),
    (b"PK\x03\x04", Format.NPZ),
)
"""Pairs of a file's first bytes and the format that they identify."""

FOLDERS = (("metadata.yaml", Format.ROSBAG), ("dataset_events_t.npy", Format.EVIMO))
"""Pairs of the name of a file in a folder and the format that the file identifies."""


def _folder_format(path: Path) -> Format | None:
    """Return the format of a folder, or None if the path is a file or an unknown folder."""
    names = FOLDERS if path.is_dir() else ()
    return next((found for name, found in names if (path / name).is_file()), None)


def detect_format(path: Path) -> Format:
    """Return the format of a file from its first bytes. Raises :class:`AmiwarpError` for an unknown format."""
    folder = _folder_format(path)
    if folder is not None:
        return folder
    with errors_name(path, lambda: "opening"), open_input(path) as file:
        head = file.read(4096)
        file_bytes = os.fstat(file.fileno()).st_size
    if not head:
        raise AmiwarpError(f"{path}: is empty; give a recording")
    for magic, found in SIGNATURES:
        if head.startswith(magic):
            return found
    if head.startswith(b"#!AER-DAT"):
        raise AmiwarpError(f"{path}: is AEDAT {head[9:12].decode('ascii', 'replace')}; only 2.0, 3.1 and 4 are read")
    # Before the others: such files have no header, so any of them can begin like text or a picture.
    if looks_like_bin(head, file_bytes):
        return Format.BIN
    if head.startswith(b"%") and not head.startswith(b"%PDF"):
        return Format.EVT if _is_evt(head) else Format.DAT
    if _looks_like_text(head):
        return Format.TEXT
    if kind := name_kind(head):
        raise AmiwarpError(f"{path}: {kind}")
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


@guarded
def open_recording(
    path: str | os.PathLike[str], *, format: Format | str | None = None, topic: str | None = None
) -> Recording:
    """Open a recording of any supported format.

    Formats without an index are read once to count, check and repair their events. The recording's ``metadata`` lists
    the repairs.

    Parameters
    ----------
    path : str or path-like
        Recording to open.
    format : Format or str, optional
        Format of the file. By default, the format is detected from the content.
    topic : str, optional
        Topic of a ROS bag, or camera of an HDF5 file, if the file holds several: for example ``/dvs/events`` or
        ``davis/left``. The error for a missing topic lists all topics of the file.

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
    if format is not None and _folder_format(path) is not chosen:
        check_regular(path)
    if chosen in (Format.HDF5, Format.ROSBAG):
        return _opener(chosen)(path, topic)
    if topic is not None:
        raise AmiwarpError(f"{path}: holds one stream of events, no topics; leave the topic out")
    return _opener(chosen)(path)


OPENERS = {
    Format.HDF5: "native_reader:open_native",
    Format.EVT: "prophesee:open_evt",
    Format.DAT: "prophesee:open_dat",
    Format.AEDAT4: "aedat4:open_aedat4",
    Format.AEDAT3: "aedat3:open_aedat3",
    Format.AEDAT2: "aedat2:open_aedat2",
    Format.ROSBAG: "ros:open_rosbag",
    Format.ES: "event_stream:open_es",
    Format.TEXT: "text:open_text",
    Format.NPZ: "npz:open_npz",
    Format.EVIMO: "npz:open_evimo",
    Format.BIN: "nmnist:open_bin",
}
"""Function that opens each format, as ``module:function`` within :mod:`amiwarp.io`."""


def _opener(chosen: Format) -> Callable[..., Recording]:
    """Return the function that opens a format. Its module is imported on use, because some libraries load slowly."""
    module, _, name = OPENERS[chosen].partition(":")
    opener: Callable[..., Recording] = getattr(importlib.import_module(f"amiwarp.io.{module}"), name)
    return opener
