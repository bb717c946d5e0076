"""Formats of recordings that are written, what they hold, and the checks of a name to write.

A new format is a module with its function, and its rows in the tables of this file.
"""

from __future__ import annotations

import os
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from amiwarp.errors import AmiwarpError, ErrorCode, Option, optional_module
from amiwarp.events.recording import EventSource
from amiwarp.io.inputs import note_folders
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.validation import choice


class OutputFormat(Option):
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
    EVT21 = "evt21"
    """Prophesee RAW, EVT 2.1 (.raw)."""
    DAT = "dat"
    """Prophesee DAT, version 2 (.dat)."""
    AEDAT4 = "aedat4"
    """iniVation AEDAT 4.0 (.aedat4)."""
    NPZ = "npz"
    """NumPy archive with the arrays x, y, t and p (.npz)."""
    TEXT = "text"
    """Text of the Event Camera Dataset: lines ``t x y p``, with t in seconds (.txt)."""
    CSV = "csv"
    """Table of t, x, y, p between commas below a line of names, with t in whole microseconds (.csv)."""
    ROS1 = "ros1"
    """ROS 1 bag of dvs_msgs arrays (.bag)."""
    ROS2 = "ros2"
    """ROS 2 bag of event_camera_msgs packets in EVT 3.0 (.mcap or .db3)."""


class Rounding(Option):
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


class Codec(Option):
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
    ".dat": OutputFormat.DAT,
    ".aedat4": OutputFormat.AEDAT4,
    ".npz": OutputFormat.NPZ,
    ".txt": OutputFormat.TEXT,
    ".csv": OutputFormat.CSV,
    ".bag": OutputFormat.ROS1,
    ".mcap": OutputFormat.ROS2,
    ".db3": OutputFormat.ROS2,
}
"""Format of each file extension. Formats of :data:`CHOSEN_BY_NAME` share one of these extensions."""

CHOSEN_BY_NAME = {OutputFormat.DSEC: OutputFormat.NATIVE, OutputFormat.EVT21: OutputFormat.EVT3}
"""Formats that no extension means, and the format whose extensions they have."""

EXTENSION_HELP = (
    ".h5 (native), .raw (Prophesee EVT 3.0), .dat, .aedat4, .npz, .txt, .csv, .bag (ROS 1 bag), .mcap or .db3 (ROS 2 "
    "bag)"
)
"""Extensions in the help of the commands."""

COMPENSATED_HELP = (
    ".h5 (native), .npz, .txt or .csv with sub-pixels; with --round .raw (Prophesee EVT 3.0), .dat, .aedat4, .bag (ROS "
    "1 bag), .mcap or .db3 (ROS 2 bag)"
)
"""Extensions in the help of the commands, for compensated events."""

POSE_ENDINGS = (".txt", ".tum")
"""File extensions of poses in the format of TUM."""

FILE_ENDINGS = {*EXTENSIONS, ".json", ".png", ".svg", ".tif", ".tiff", ".npy", ".mp4", ".gif"}
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
    fractional: bool = False
    """Whether it holds the sub-pixel coordinates of compensated events."""
    text_unit: str | None = None
    """Unit of time in text, which is written beside it with the sensor size."""


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
    """Bag that the events come from, whose other topics are copied to a bag of the same version of ROS."""


MAX_MS = 100_000_000
"""Longest recording that can be written [ms], 28 h. In a longer one a timestamp must be damaged, and the millisecond
index would be huge."""

LONGEST_US = MAX_MS * 1000
"""Longest recording that is written in EVT 3.0 [us], 28 h. Each 17 s take three words, with and without events."""

LONGEST_EVT21_US = 2**34 - 1
"""Longest recording that is written in EVT 2.1 [us], 4.8 h. Its clock of 34 bits does not wrap, because not every
reader notices that."""

LONGEST_DAT_US = 2**32 - 1
"""Longest recording that is written as DAT [us], 71 min. Its clock of 32 bits does not wrap either."""


def origin_of(about: Outline | EventSource, longest_us: int = LONGEST_US) -> int:
    """Return the time at which the clock of EVT words starts [us]: 0, or the first event if the last is very late."""
    return 0 if about.t_last <= longest_us else about.t_first


LIMITS = {
    OutputFormat.DSEC: Limits("the DSEC layout", span=2**32 - 1),
    OutputFormat.EVT3: Limits("RAW EVT 3.0", side=2048, t_first=0, span=LONGEST_US),
    OutputFormat.EVT21: Limits("RAW EVT 2.1", side=2048, t_first=0, span=LONGEST_EVT21_US),
    OutputFormat.DAT: Limits("DAT", side=2**14, t_first=0, span=LONGEST_DAT_US),
    OutputFormat.AEDAT4: Limits("AEDAT 4", side=2**15, t_first=0),
    OutputFormat.NPZ: Limits("npz", fractional=True),
    # Readers take the seconds as float64, which is exact to the microsecond up to these times, 71 years.
    OutputFormat.TEXT: Limits(
        "text", t_first=-(2**51), t_last=2**51, fractional=True, text_unit="s"
    ),
    # Readers may take the microseconds as float64, too.
    OutputFormat.CSV: Limits(
        "csv", t_first=-(2**53), t_last=2**53, fractional=True, text_unit="us"
    ),
    # A time in ROS has 32 bits for the seconds: without a sign in ROS 1, with a sign in ROS 2.
    OutputFormat.ROS1: Limits("a ROS 1 bag", t_first=0, t_last=2**32 * 10**6 - 1),
    OutputFormat.ROS2: Limits(
        "a ROS 2 bag", side=2048, t_first=0, t_last=2**31 * 10**6 - 1, span=LONGEST_US
    ),
}
"""Limits of the formats other than the native one."""

WRITERS = {
    OutputFormat.DSEC: "native.dsec:write_dsec",
    OutputFormat.EVT3: "prophesee.raw_writers:write_evt3",
    OutputFormat.EVT21: "prophesee.raw_writers:write_evt21",
    OutputFormat.DAT: "prophesee.dat_writer:write_dat",
    OutputFormat.AEDAT4: "aedat.aedat4_writer:write_aedat4",
    OutputFormat.NPZ: "npz_writer:write_npz",
    OutputFormat.TEXT: "text.writers:write_text",
    OutputFormat.CSV: "text.writers:write_csv",
    OutputFormat.ROS1: "ros.ros1_writer:write_ros1",
    OutputFormat.ROS2: "ros.ros2_writer:write_ros2",
}
"""Function that writes all events in each format other than the native one, see :func:`io_function`."""


def output_format(path: Path, given: OutputFormat | str | None) -> OutputFormat:
    """Return the format to write: the given one, or else the format of the extension.

    Raises :class:`AmiwarpError` for an unknown extension, and for one that files of the given format do not have.
    """
    of_extension = EXTENSIONS.get(path.suffix.lower())
    if given is not None:
        chosen = choice(OutputFormat, given, f"{path}: format")
        check_ending(path, f"recordings in the format {chosen.value} are written", _endings(chosen))
        return chosen
    if of_extension is None:
        known = ", ".join(EXTENSIONS)
        names = ", ".join(OutputFormat)
        raise AmiwarpError(
            f"{path}: the extension '{path.suffix}' is of no format that is written; "
            f"choose among {known}, which mean the formats {names}"
        )
    return of_extension


def _endings(chosen: OutputFormat) -> list[str]:
    """Return the extensions of a format."""
    format_name = CHOSEN_BY_NAME.get(chosen, chosen)
    return [ending for ending, one in EXTENSIONS.items() if one is format_name]


def check_native(path: Path) -> None:
    """Raise :class:`AmiwarpError` if the name of a native recording ends in another extension."""
    remedy = None
    if EXTENSIONS.get(path.suffix.lower(), OutputFormat.NATIVE) is not OutputFormat.NATIVE:
        native_path = path.with_suffix(".h5")
        remedy = (
            f"write {native_path.name}, then run: amiwarp convert {native_path.name} {path.name}"
        )
    check_ending(path, "recordings are written here", _endings(OutputFormat.NATIVE), remedy)


def check_ending(path: Path, what: str, endings: Collection[str], remedy: str | None = None) -> str:
    """Return the extension of a file to write, in lower case. Raises :class:`AmiwarpError` for one not in ``endings``.

    ``what`` begins the message, such as "figures are written".
    """
    ending = path.suffix.lower()
    if ending not in endings:
        *others, last = endings
        allowed = f"{', '.join(others)} or {last}" if others else last
        if remedy is None:
            remedy = f"give a name that ends in {allowed}"
        raise AmiwarpError(f"{path}: {what} as {allowed}, not '{path.suffix}'; {remedy}")
    return ending


def video_library(path: Path) -> Any:
    """Return PyAV, to read or write a video file. Raises :class:`AmiwarpError` where it is not installed."""
    return optional_module("av", "video", f"{path}: videos need PyAV")


def make_folder(path: Path) -> None:
    """Create a folder and its parents. Raises :class:`AmiwarpError` if that fails, or for the name of a file."""
    missing = [new for new in (path, *path.parents) if not os.path.lexists(new)]
    for new in missing:
        if new.suffix.lower() in FILE_ENDINGS:
            raise AmiwarpError(
                f"{new}: is for a folder, but ends in {new.suffix}; give the name of a folder"
            )
    note_folders(missing)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise AmiwarpError(
            f"{path}: cannot be made a folder: {error.strerror or error}; choose another --out",
            ErrorCode.OUTPUT_FAILED,
        ) from error


def check_rounding(
    path: Path, given: Rounding | str | None, chosen: OutputFormat
) -> Rounding | None:
    """Return the rounding. Raises :class:`AmiwarpError` for the native format, which needs none."""
    rounding = None if given is None else choice(Rounding, given, f"{path}: rounding")
    if rounding is not None and chosen is OutputFormat.NATIVE:
        raise AmiwarpError(
            f"{path}: rounding is {rounding.value}, but the native format holds sub-pixels; leave it out",
            ErrorCode.OPTIONS,
        )
    return rounding


def check_codec(path: Path, given: Codec | str, chosen: OutputFormat) -> Codec:
    """Return the codec. Raises :class:`AmiwarpError` if the format is not HDF5 and the codec is not the default."""
    codec = choice(Codec, given, f"{path}: codec")
    if codec is not Codec.BLOSC and chosen not in (OutputFormat.NATIVE, OutputFormat.DSEC):
        raise AmiwarpError(
            f"{path}: codec is {codec.value}, which is for HDF5 (.h5); leave it out for {chosen.value}",
            ErrorCode.OPTIONS,
        )
    return codec
