"""Formats that are written: their names, their file extensions, and what those of recordings can hold."""

from __future__ import annotations

import enum
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from amiwarp.errors import AmiwarpError
from amiwarp.io.chunks import Codec
from amiwarp.io.native_layout import MAX_MS
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.validation import choice


class OutputFormat(enum.StrEnum):
    """Formats of recordings that can be written.

    Examples
    --------
    >>> amiwarp.OutputFormat("dsec")
    <OutputFormat.DSEC: 'dsec'>
    """

    NATIVE = "native"
    """Native recording (.h5), which holds everything."""
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
