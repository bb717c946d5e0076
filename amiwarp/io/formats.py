"""Formats of recordings: those that are read and how they are detected, those that are written and what they hold.

A new format is a module with its functions, and its rows in the tables of this file.
"""

from __future__ import annotations

import enum
import importlib
import os
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Recording
from amiwarp.io.input_files import check_regular, errors_name, name_kind, open_input
from amiwarp.io.nmnist import looks_like_bin
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.validation import choice, guarded

# Formats that are read.


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


OPENERS = {
    Format.HDF5: "hdf5_reader:open_hdf5",
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
"""Function that opens each format, see :func:`io_function`."""

TRIGGERS = (Format.EVT, Format.AEDAT4, Format.AEDAT3, Format.AEDAT2, Format.ROSBAG, Format.HDF5)
"""Formats that hold triggers. Their modules have a function ``trigger_packets``, which reads the edges."""

TOPICS = (Format.HDF5, Format.ROSBAG)
"""Formats whose files may hold several streams of events."""


def io_function(place: str) -> Callable[..., Any]:
    """Return the function ``module:function`` of :mod:`amiwarp.io`.

    Its module is imported on use, because some libraries load slowly.
    """
    module, _, name = place.partition(":")
    function: Callable[..., Any] = getattr(importlib.import_module(f"amiwarp.io.{module}"), name)
    return function


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
    if topic is not None and chosen not in TOPICS:
        raise AmiwarpError(f"{path}: holds one stream of events, no topics; leave the topic out")
    recording: Recording = io_function(OPENERS[chosen])(path, *((topic,) if chosen in TOPICS else ()))
    return recording


# Formats that are written.


class OutputFormat(enum.StrEnum):
    """Formats of recordings that can be written.

    Examples
    --------
    >>> amiwarp.OutputFormat("dsec")
    <OutputFormat.DSEC: 'dsec'>
    """

    NATIVE = "native"
    """Native recording (.h5 or .hdf5), which holds everything."""
    DSEC = "dsec"
    """HDF5 with the layout of DSEC's event files (.h5)."""
    EVT3 = "evt3"
    """Prophesee RAW, EVT 3.0 (.raw)."""
    AEDAT4 = "aedat4"
    """iniVation AEDAT 4.0 (.aedat4)."""
    NPZ = "npz"
    """NumPy archive with the arrays x, y, t and p (.npz)."""
    TEXT = "text"
    """Text of the Event Camera Dataset: lines ``t x y p``, with t in seconds (.txt)."""
    ROS2 = "ros2"
    """ROS 2 bag of event_camera_msgs packets in EVT 3.0 (.mcap or .db3)."""


class Rounding(enum.StrEnum):
    """Ways to round the sub-pixel coordinates of compensated events, for formats that hold whole pixels.

    Examples
    --------
    >>> amiwarp.Rounding("dithered")
    <Rounding.DITHERED: 'dithered'>
    """

    NEAREST = "nearest"
    """To the nearest pixel."""
    DITHERED = "dithered"
    """Up or down at random: up with the fractional part as probability, so that the mean coordinate is unbiased."""


class Codec(enum.StrEnum):
    """Compression of native recordings.

    Examples
    --------
    >>> amiwarp.Codec("gzip")
    <Codec.GZIP: 'gzip'>
    """

    BLOSC = "blosc"
    """Blosc (LZ4, shuffle of bits; of bytes for times): fastest. Other programs need HDF5's Blosc filter to read it."""
    GZIP = "gzip"
    """Deflate with byte shuffle, which every HDF5 library reads."""


EXTENSIONS = {
    ".h5": OutputFormat.NATIVE,
    ".hdf5": OutputFormat.NATIVE,
    ".raw": OutputFormat.EVT3,
    ".aedat4": OutputFormat.AEDAT4,
    ".npz": OutputFormat.NPZ,
    ".txt": OutputFormat.TEXT,
    ".mcap": OutputFormat.ROS2,
    ".db3": OutputFormat.ROS2,
}
"""Format of each file extension. DSEC's files have the extension of native ones and are chosen by name."""

EXTENSION_HELP = ".h5 (native), .raw (Prophesee EVT 3.0), .aedat4, .npz, .txt, .mcap or .db3 (ROS 2 bag)"
COMPENSATED_HELP = (
    ".h5 (native), .npz or .txt with sub-pixels; with --round .raw (Prophesee EVT 3.0), .aedat4, .mcap or .db3 (ROS 2 "
    "bag)"
)
"""Extensions in the help of the commands, for any events and for compensated ones."""

POSE_ENDINGS = (".txt", ".tum")
"""File extensions of poses in the format of TUM."""

FILE_ENDINGS = {*EXTENSIONS, ".json", ".csv", ".png", ".svg", ".tif", ".tiff", ".npy", ".mp4", ".gif"}
"""File extensions that no folder for outputs may have."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What a format other than the native one can hold."""

    label: str
    """Name of the format in messages."""
    side: int = LARGEST_SIZE
    """Largest width and height [px]."""
    t_first: int = -(2**62)
    """Earliest time [us]."""
    t_last: int = 2**62
    """Latest time [us]."""
    span: int = 2**63
    """Longest time between the first and the last event [us]."""
    holds_size: bool = True
    """Whether it holds the sensor size."""
    fractional: bool = False
    """Whether it holds the sub-pixel coordinates of compensated events."""


@dataclass(frozen=True, slots=True)
class Bag:
    """Topic of events in a bag."""

    path: Path
    """The file, or the folder of a ROS 2 bag."""
    topic: str
    """Name of the topic."""


@dataclass(frozen=True, slots=True)
class Outline:
    """What is known of a recording before its events are read."""

    path: Path
    """Name of the finished file."""
    width: int
    """Sensor width [px]."""
    height: int
    """Sensor height [px]."""
    t_first: int
    """Time of the first event [us], or 0 without events."""
    t_last: int
    """Time of the last event [us], or 0 without events."""
    codec: Codec
    """Compression of HDF5."""
    bag: Bag | None = None
    """ROS 2 bag that the events come from, whose other topics are copied to a ROS 2 bag."""


MAX_MS = 100_000_000
"""Longest recording that can be written [ms], 28 h. In a longer one a timestamp must be damaged, and the millisecond
index would be huge."""

LONGEST_US = MAX_MS * 1000
"""Longest recording that is written in EVT 3.0 [us], 28 h. Each 17 s take three words, with and without events."""

LIMITS = {
    OutputFormat.DSEC: Limits("the DSEC layout", span=2**32 - 1),
    OutputFormat.EVT3: Limits("RAW EVT 3.0", side=2048, t_first=0, span=LONGEST_US),
    OutputFormat.AEDAT4: Limits("AEDAT 4", side=2**15, t_first=0),
    OutputFormat.NPZ: Limits("npz", fractional=True),
    # Readers take the seconds as float64, which is exact to the microsecond up to these times, 71 years.
    OutputFormat.TEXT: Limits("text", t_first=-(2**51), t_last=2**51, holds_size=False, fractional=True),
    # A time in ROS has 32 bits for the seconds.
    OutputFormat.ROS2: Limits("a ROS 2 bag", side=2048, t_first=0, t_last=2**31 * 10**6 - 1, span=LONGEST_US),
}
"""Limits of the formats other than the native one."""

WRITERS = {
    OutputFormat.DSEC: "native_writer:write_dsec",
    OutputFormat.EVT3: "prophesee:write_evt3",
    OutputFormat.AEDAT4: "aedat4:write_aedat4",
    OutputFormat.NPZ: "npz:write_npz",
    OutputFormat.TEXT: "text:write_text",
    OutputFormat.ROS2: "ros:write_ros2",
}
"""Function that writes all events in each format other than the native one, see :func:`io_function`."""


def output_format(path: Path, given: OutputFormat | str | None) -> OutputFormat:
    """Return the format to write: the given one, or else that of the extension.

    Raises :class:`AmiwarpError` for an unknown extension, and for one that files of the given format do not have.
    """
    found = EXTENSIONS.get(path.suffix.lower())
    if given is not None:
        chosen = choice(OutputFormat, given, f"{path}: format")
        check_ending(path, f"recordings in the format {chosen.value} are written", _endings(chosen))
        return chosen
    if found is None:
        known, names = ", ".join(EXTENSIONS), ", ".join(OutputFormat)
        raise AmiwarpError(
            f"{path}: the extension '{path.suffix}' is of no format that is written; "
            f"choose among {known}, which mean the formats {names}"
        )
    return found


def _endings(chosen: OutputFormat) -> list[str]:
    """Return the extensions of a format."""
    own = OutputFormat.NATIVE if chosen is OutputFormat.DSEC else chosen
    return [ending for ending, one in EXTENSIONS.items() if one is own]


def check_native(path: Path) -> None:
    """Raise :class:`AmiwarpError` if the name of a native recording ends in another extension."""
    remedy = None
    if EXTENSIONS.get(path.suffix.lower(), OutputFormat.NATIVE) is not OutputFormat.NATIVE:
        made = path.with_suffix(".h5")
        remedy = f"write {made.name}, then run: amiwarp convert {made.name} {path.name}"
    check_ending(path, "recordings are written here", _endings(OutputFormat.NATIVE), remedy)


def check_ending(path: Path, what: str, endings: Collection[str], remedy: str | None = None) -> str:
    """Return the extension of a file to write, in lower case. Raises :class:`AmiwarpError` for one not in ``endings``.

    ``what`` begins the message, such as "figures are written".
    """
    ending = path.suffix.lower()
    if ending not in endings:
        allowed = " or ".join(filter(None, (", ".join([*endings][:-1]), [*endings][-1])))
        raise AmiwarpError(
            f"{path}: {what} as {allowed}, not '{path.suffix}'; {remedy or f'give a name that ends in {allowed}'}"
        )
    return ending


def check_folder(path: Path) -> None:
    """Raise :class:`AmiwarpError` if the name of a folder for outputs ends in the extension of a file."""
    if path.suffix.lower() in FILE_ENDINGS:
        raise AmiwarpError(f"{path}: is for a folder, but ends in {path.suffix}; give the name of a folder")


def check_rounding(path: Path, given: Rounding | str | None, chosen: OutputFormat) -> Rounding | None:
    """Return the rounding. Raises :class:`AmiwarpError` for the native format, which needs none."""
    rounding = None if given is None else choice(Rounding, given, f"{path}: rounding")
    if rounding is not None and chosen is OutputFormat.NATIVE:
        raise AmiwarpError(
            f"{path}: rounding is {rounding.value}, but the native format holds sub-pixels; leave it out"
        )
    return rounding


def check_codec(path: Path, given: Codec | str, chosen: OutputFormat) -> Codec:
    """Return the codec. Raises :class:`AmiwarpError` if the format is not HDF5 and the codec is not the default."""
    codec = choice(Codec, given, f"{path}: codec")
    if codec is not Codec.BLOSC and chosen not in (OutputFormat.NATIVE, OutputFormat.DSEC):
        raise AmiwarpError(f"{path}: codec is {codec.value}, which is for HDF5 (.h5); leave it out for {chosen.value}")
    return codec
