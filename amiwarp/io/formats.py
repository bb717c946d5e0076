"""Formats of recordings that are read, how they are detected, and how a recording is opened.

A new format is a module with its functions, and its rows in the tables of this file.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from amiwarp.errors import AmiwarpError, ErrorCode, Option
from amiwarp.events.recording import Recording
from amiwarp.io.bin_events import looks_like_bin
from amiwarp.io.columns.options import GivenLayout
from amiwarp.io.inputs import check_regular, errors_name, open_input
from amiwarp.io.mistaken_files import what_it_is
from amiwarp.io.opening import GivenSource, given_source
from amiwarp.io.ros.bags import MCAP, ROS1, SQLITE
from amiwarp.io.ros.packed import ZSTANDARD, packed_head
from amiwarp.io.text.detection import HEAD_BYTES, looks_like_text, why_no_rows
from amiwarp.io.text.size import read_size
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.schema.calls import guarded
from amiwarp.validation import choice, instance, shown, whole


class Format(Option):
    """File formats of recordings that amiwarp reads."""

    HDF5 = "hdf5"
    """HDF5 file: native recording of amiwarp; event file of DSEC, TUM-VIE, M3ED, MVSEC or Prophesee; or any layout of
    columns."""
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
    """ROS 1 bag, or ROS 2 bag (SQLite or MCAP), also compressed with Zstandard."""
    ES = "es"
    """Event Stream (.es) file."""
    TEXT = "text"
    """Text file: lines of ``t x y p`` with t in seconds, as in the Event Camera Dataset; or a table such as CSV."""
    NPZ = "npz"
    """NumPy archive: arrays x, y, t and p, arrays of N-ImageNet or EV-IMO, or of any layout."""
    NPY = "npy"
    """NumPy array: records with the fields x, y, t and p, or four columns."""
    MAT = "mat"
    """MATLAB file with the columns of events."""
    PARQUET = "parquet"
    """Parquet table of events."""
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
    (b"\x93NUMPY", Format.NPY),
    (b"MATLAB 5.0 MAT-file", Format.MAT),
    (b"MATLAB 7.3 MAT-file", Format.HDF5),
    (b"PAR1", Format.PARQUET),
)
"""Pairs of a file's first bytes and the format that they identify."""

FOLDERS = (("metadata.yaml", Format.ROSBAG), ("dataset_events_t.npy", Format.EVIMO))
"""Pairs of the name of a file in a folder and the format that the file identifies."""

BAG_ENDS = (".db3", ".mcap", ".db3.zstd", ".mcap.zstd")
"""Ends of the names of the files in the folder of a ROS 2 bag."""

OPENERS = {
    Format.HDF5: "native.reader:open_hdf5",
    Format.EVT: "prophesee.raw:open_evt",
    Format.DAT: "prophesee.dat:open_dat",
    Format.AEDAT4: "aedat.aedat4:open_aedat4",
    Format.AEDAT3: "aedat.aedat3:open_aedat3",
    Format.AEDAT2: "aedat.aedat2:open_aedat2",
    Format.ROSBAG: "ros.reader:open_rosbag",
    Format.ES: "event_stream:open_es",
    Format.TEXT: "text.reader:open_text",
    Format.NPZ: "columns.numpy_files:open_npz",
    Format.NPY: "columns.numpy_files:open_npy",
    Format.MAT: "columns.served:open_mat",
    Format.PARQUET: "columns.served:open_parquet",
    Format.EVIMO: "evimo:open_evimo",
    Format.BIN: "bin_files:open_bin",
}
"""Function that opens each format, see :func:`io_function`."""

TRIGGERS = {
    Format.EVT: "prophesee.raw:trigger_packets",
    Format.AEDAT4: "aedat.aedat4:aedat4_triggers",
    Format.AEDAT3: "aedat.aedat3:aedat3_triggers",
    Format.AEDAT2: "aedat.aedat2:aedat2_triggers",
    Format.ROSBAG: "ros.reader:trigger_packets",
    Format.HDF5: "hdf5.rows:trigger_packets",
}
"""Function that reads the edges of each format that holds triggers, see :func:`io_function`."""

TOPICS = (Format.HDF5, Format.ROSBAG)
"""Formats whose files may hold several streams of events."""

LAYOUTS = (Format.HDF5, Format.TEXT, Format.NPZ, Format.NPY, Format.MAT, Format.PARQUET)
"""Formats whose columns may have any layout. Their openers take a :class:`~amiwarp.io.columns.options.GivenLayout`."""

CHIPS = (Format.AEDAT2,)
"""Formats whose openers take the name of the camera's chip, if it is given."""


def io_function(place: str) -> Callable[..., Any]:
    """Return the function ``module:function`` of :mod:`amiwarp.io`.

    Its module is imported on use, because some libraries load slowly.
    """
    module, _, name = place.partition(":")
    function: Callable[..., Any] = getattr(importlib.import_module(f"amiwarp.io.{module}"), name)
    return function


RIG_FILE = "rig.json"
"""Name of the file that makes a folder of recordings a rig."""


def _folder_format(path: Path) -> Format | None:
    """Return the format of a folder, or None if the path is a file or an unknown folder."""
    if not path.is_dir():
        return None
    return next((format for name, format in FOLDERS if (path / name).is_file()), None)


def detect_format(path: Path) -> Format:
    """Return the format of a file from its first bytes. Raises :class:`AmiwarpError` for an unknown format."""
    folder = _folder_format(path)
    if folder is not None:
        return folder
    if path.is_dir() and any(inner.name.endswith(BAG_ENDS) for inner in path.iterdir()):
        raise AmiwarpError(
            f"{path}: is the folder of a ROS 2 bag without its metadata.yaml; "
            "run ros2 bag reindex, or give one of its files",
            ErrorCode.CONTENT_MISSING,
        )
    if path.name == RIG_FILE or (path / RIG_FILE).is_file():
        raise AmiwarpError(
            f"{path}: is a rig of several recordings; give one of them, or open the rig with amiwarp.open_rig",
            ErrorCode.AMBIGUOUS,
        )
    with errors_name(path, lambda: "opening"), open_input(path) as file:
        head = file.read(HEAD_BYTES)
        file_bytes = os.fstat(file.fileno()).st_size
    if not head:
        # Text without events is empty, but the size of the sensor is beside it.
        if read_size(path) is not None:
            raise AmiwarpError(
                f"{path}: holds no events; give another recording", ErrorCode.CONTENT_MISSING
            )
        raise AmiwarpError(f"{path}: is empty; give a recording", ErrorCode.CONTENT_MISSING)

    for magic, format in SIGNATURES:
        if head.startswith(magic):
            return format
    if head.startswith(b"#!AER-DAT"):
        raise AmiwarpError(
            f"{path}: is AEDAT {head[9:12].decode('ascii', 'replace')}; only 2.0, 3.1 and 4 are read",
            ErrorCode.FORMAT_UNKNOWN,
        )

    # .bin files come first: they have no header, so any of them can begin like text or a picture.
    if looks_like_bin(head, file_bytes):
        return Format.BIN
    if head.startswith(b"%") and _is_evt(head):
        return Format.EVT
    if looks_like_text(head):
        return Format.TEXT
    if head.startswith(b"%") and not head.startswith(b"%PDF"):
        return Format.DAT
    if head.startswith(ZSTANDARD) and packed_head(path).startswith((ROS1, SQLITE, MCAP)):
        return Format.ROSBAG

    why_not = what_it_is(head) or why_no_rows(head)
    if why_not:
        raise AmiwarpError(f"{path}: {why_not}", ErrorCode.FORMAT_UNKNOWN)
    known = ", ".join(member.value for member in Format)
    raise AmiwarpError(
        f"{path}: content is of no known format; expected one of {known}", ErrorCode.FORMAT_UNKNOWN
    )


def _is_evt(head: bytes) -> bool:
    """Return whether the first bytes of a Prophesee file are the header of a RAW (EVT) file."""
    lines = head.split(b"\n")
    return any(line.startswith((b"% evt ", b"% format EVT")) for line in lines)


@guarded
def open_recording(
    path: str | os.PathLike[str],
    *,
    format: Format | str | None = None,
    topic: str | None = None,
    columns: str | None = None,
    time_unit: str | None = None,
    polarity: str | None = None,
    scale_xy: int | None = None,
    size: tuple[int, int] | None = None,
    chip: str | None = None,
    sort: bool = False,
) -> Recording:
    """Open a recording of any supported format.

    Formats without an index are read once to count, check and repair their events. The recording's ``metadata`` lists
    the repairs, and what is assumed because the file does not state it, in entries whose names begin with ``assumed_``.

    Parameters
    ----------
    path : str or path-like
        Recording to open.
    format : Format or str, optional
        Format of the file. By default, the format is detected from the content.
    topic : str, optional
        Topic of a ROS bag, or camera of an HDF5 file, if the file holds several: for example ``/dvs/events`` or
        ``davis/left``. The error for a missing topic lists all topics of the file.
    columns : str, optional
        Columns of a text, NumPy, HDF5, MATLAB or Parquet file, by name or number: ``"t=ts,x=xs,y=ys,p=ps"``. For
        columns without names, their order: ``"x,y,p,t"``, with ``-`` for a column without use.
    time_unit : str, optional
        Unit of time in such a file: ``"s"``, ``"ms"``, ``"us"`` or ``"ns"``.
    polarity : str, optional
        Meaning of the values of the polarity in such a file: ``"1=on,2=off"``.
    scale_xy : int, optional
        Number by which x and y in such a file are divided, if they are multiples of a fraction of a pixel.
    size : tuple of int, optional
        Sensor size (width, height) [px]. It replaces the size in the file.
    chip : str, optional
        Camera of an AEDAT 2.0 file, for example ``dvs128`` or ``davis346``. By default, it is taken from the header; if
        it is not there, it is guessed from the largest address, and ``metadata["assumed_chip"]`` says so.
    sort : bool, default False
        Whether to sort the events by time, up to 33 million. They are then kept in memory.

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
    if format is None:
        chosen = detect_format(path)
    else:
        chosen = choice(Format, format, f"{path}: format")
        if _folder_format(path) is not chosen:
            check_regular(path)

    # Only some openers take a topic, a layout or a chip.
    arguments: list[Any] = []
    check_topic(path, topic, chosen)
    if chosen in TOPICS:
        arguments.append(topic)
    layout = GivenLayout(columns, time_unit, polarity, scale_xy)
    layout.check()
    if chosen in LAYOUTS:
        arguments.append(layout)
    elif layout != GivenLayout():
        raise AmiwarpError(
            f"{path}: is of the format {chosen.value}, whose layout is fixed; leave out {layout.options}",
            ErrorCode.OPTIONS,
        )
    named = {}
    if chip is not None:
        instance(chip, str, "chip")
        if chosen not in CHIPS:
            raise AmiwarpError(
                f"{path}: is of the format {chosen.value}, which needs no chip; leave out --chip",
                ErrorCode.OPTIONS,
            )
        named["chip"] = chip

    checked_size = None if size is None else _checked_size(size)
    with given_source(GivenSource(checked_size, sort)):
        recording: Recording = io_function(OPENERS[chosen])(path, *arguments, **named)
    return recording


def _checked_size(size: Any) -> tuple[int, int]:
    """Return a sensor size that the user gives [px]. Raises :class:`AmiwarpError` for any other value."""
    if not isinstance(size, tuple | list) or len(size) != 2:
        raise AmiwarpError(
            f"size is {shown(size)}; give the width and the height [px], such as (640, 480)"
        )
    width = whole(size[0], "width of size", 1, LARGEST_SIZE)
    height = whole(size[1], "height of size", 1, LARGEST_SIZE)
    return width, height


def check_topic(path: Path, topic: str | None, format: Format) -> None:
    """Raise :class:`AmiwarpError` if a topic is given for a file of a format without topics."""
    if topic is not None and format not in TOPICS:
        raise AmiwarpError(
            f"{path}: holds one stream of events, no topics; leave the topic out", ErrorCode.OPTIONS
        )
