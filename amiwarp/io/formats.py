"""Formats of recordings: those that are read and how they are detected, those that are written and what they hold.

A new format is a module with its functions, and its rows in the tables of this file.
"""

from __future__ import annotations

import importlib
import os
import re
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import Option
from amiwarp.errors import AmiwarpError, optional_module
from amiwarp.events.recording import EventSource, Recording
from amiwarp.io.column_options import GivenLayout
from amiwarp.io.file_scan import GivenSource, given_source
from amiwarp.io.files import check_regular, errors_name, name_kind, note_folders, open_input
from amiwarp.io.json_files import read_json
from amiwarp.io.ros_bags import MCAP, ROS1, SQLITE
from amiwarp.io.ros_packed import ZSTANDARD, packed_head
from amiwarp.io.text_rows import HEAD_BYTES, looks_like_text, why_no_rows
from amiwarp.io.text_size import read_size
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.validation import choice, guarded, instance, shown, whole

# Formats that are read.


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
    """NumPy archive: arrays x, y, t and p, those of N-ImageNet or EV-IMO, or of any layout."""
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
    Format.HDF5: "native_format:open_hdf5",
    Format.EVT: "prophesee:open_evt",
    Format.DAT: "dat:open_dat",
    Format.AEDAT4: "aedat4:open_aedat4",
    Format.AEDAT3: "aedat3:open_aedat3",
    Format.AEDAT2: "aedat2:open_aedat2",
    Format.ROSBAG: "ros:open_rosbag",
    Format.ES: "event_stream:open_es",
    Format.TEXT: "text_files:open_text",
    Format.NPZ: "column_files:open_npz",
    Format.NPY: "column_files:open_npy",
    Format.MAT: "served_columns:open_mat",
    Format.PARQUET: "served_columns:open_parquet",
    Format.EVIMO: "plain_files:open_evimo",
    Format.BIN: "plain_files:open_bin",
}
"""Function that opens each format, see :func:`io_function`."""

TRIGGERS = {
    Format.EVT: "prophesee:trigger_packets",
    Format.AEDAT4: "aedat4:aedat4_triggers",
    Format.AEDAT3: "aedat3:aedat3_triggers",
    Format.AEDAT2: "aedat2:aedat2_triggers",
    Format.ROSBAG: "ros:trigger_packets",
    Format.HDF5: "hdf5_files:trigger_packets",
}
"""Function that reads the edges of each format that holds triggers, see :func:`io_function`."""

TOPICS = (Format.HDF5, Format.ROSBAG)
"""Formats whose files may hold several streams of events."""

LAYOUTS = (Format.HDF5, Format.TEXT, Format.NPZ, Format.NPY, Format.MAT, Format.PARQUET)
"""Formats whose columns may have any layout. Their openers take a :class:`~amiwarp.io.column_options.GivenLayout`."""

CHIPS = (Format.AEDAT2,)
"""Formats whose openers take the name of the camera's chip, if it is given."""


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
    if path.is_dir() and any(each.name.endswith(BAG_ENDS) for each in path.iterdir()):
        raise AmiwarpError(
            f"{path}: is the folder of a ROS 2 bag without its metadata.yaml; "
            "run ros2 bag reindex, or give one of its files"
        )
    with errors_name(path, lambda: "opening"), open_input(path) as file:
        head = file.read(HEAD_BYTES)
        file_bytes = os.fstat(file.fileno()).st_size
    if not head and read_size(path) is not None:
        raise AmiwarpError(f"{path}: holds no events; give another recording")
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
    if head.startswith(b"%") and _is_evt(head):
        return Format.EVT
    if looks_like_text(head):
        return Format.TEXT
    if head.startswith(b"%") and not head.startswith(b"%PDF"):
        return Format.DAT
    if head.startswith(ZSTANDARD) and packed_head(path).startswith((ROS1, SQLITE, MCAP)):
        return Format.ROSBAG
    if kind := name_kind(head) or why_no_rows(head):
        raise AmiwarpError(f"{path}: {kind}")
    known = ", ".join(member.value for member in Format)
    raise AmiwarpError(f"{path}: content is of no known format; expected one of {known}")


BIN_EVENT_BYTES = 5
"""Size of an event in the ``.bin`` files of N-MNIST [bytes]."""
BIN_MARK_ROW = 240
"""Row of the marks in these files."""


def looks_like_bin(head: bytes, size: int) -> bool:
    """Return whether a file of ``size`` bytes that begins with ``head`` holds events of 5 bytes.

    Without a header, the content decides: whole events, rows of the cameras, and times that rise, except at marks.
    """
    if size % BIN_EVENT_BYTES or len(head) < 8 * BIN_EVENT_BYTES:
        return False
    _, y, t, _ = bin_columns(np.frombuffer(head, np.uint8, len(head) // BIN_EVENT_BYTES * BIN_EVENT_BYTES))
    mark = y == BIN_MARK_ROW
    step = np.diff(t[~mark])
    late, rising = np.count_nonzero(step < 0), np.count_nonzero(step > 0)
    return bool((y <= BIN_MARK_ROW).all() and late <= np.count_nonzero(mark) + t.size // 100 and 2 * rising > t.size)


def bin_columns(data: NDArray[np.uint8]) -> tuple[NDArray[np.int64], ...]:
    """Return x, y, time since the last mark [us] and polarity of events of 5 bytes."""
    rows = data.reshape(-1, BIN_EVENT_BYTES).astype(np.int64)
    return rows[:, 0], rows[:, 1], (rows[:, 2] & 0x7F) << 16 | rows[:, 3] << 8 | rows[:, 4], rows[:, 2] >> 7


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
    chosen = detect_format(path) if format is None else choice(Format, format, f"{path}: format")
    if format is not None and _folder_format(path) is not chosen:
        check_regular(path)
    check_topic(path, topic, chosen)
    layout = GivenLayout(columns, time_unit, polarity, scale_xy)
    layout.check()
    if layout != GivenLayout() and chosen not in LAYOUTS:
        raise AmiwarpError(
            f"{path}: is of the format {chosen.value}, whose layout is fixed; leave out {layout.options}"
        )
    if chip is not None:
        instance(chip, str, "chip")
        if chosen not in CHIPS:
            raise AmiwarpError(f"{path}: is of the format {chosen.value}, which needs no chip; leave out --chip")
    arguments: list[Any] = [topic] if chosen in TOPICS else []
    arguments += [layout] if chosen in LAYOUTS else []
    named = {} if chip is None else {"chip": chip}
    with given_source(GivenSource(None if size is None else _checked_size(size), sort)):
        recording: Recording = io_function(OPENERS[chosen])(path, *arguments, **named)
    return recording


def _checked_size(size: Any) -> tuple[int, int]:
    """Return a sensor size that the user gives [px]. Raises :class:`AmiwarpError` for any other value."""
    if not isinstance(size, tuple | list) or len(size) != 2:
        raise AmiwarpError(f"size is {shown(size)}; give the width and the height [px], such as (640, 480)")
    width, height = (whole(side, f"{name} of size", 1, LARGEST_SIZE) for name, side in zip(SIDES, size, strict=True))
    return width, height


SIDES = ("width", "height")
"""Names of the sides of a size, for messages."""


def check_topic(path: Path, topic: str | None, found: Format) -> None:
    """Raise :class:`AmiwarpError` if a topic is given for a file of a format without topics."""
    if topic is not None and found not in TOPICS:
        raise AmiwarpError(f"{path}: holds one stream of events, no topics; leave the topic out")


# Formats that are written.


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
COMPENSATED_HELP = (
    ".h5 (native), .npz, .txt or .csv with sub-pixels; with --round .raw (Prophesee EVT 3.0), .dat, .aedat4, .bag (ROS "
    "1 bag), .mcap or .db3 (ROS 2 bag)"
)
"""Extensions in the help of the commands, for any events and for compensated ones."""

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

LONGEST_EVT21_US, LONGEST_DAT_US = 2**34 - 1, 2**32 - 1
"""Longest recording that is written in EVT 2.1 and as DAT [us], 4.8 h and 71 min: their clocks of 34 and 32 bits do not
wrap, because not every reader notices that."""


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
    OutputFormat.TEXT: Limits("text", t_first=-(2**51), t_last=2**51, fractional=True, text_unit="s"),
    # Readers may take the microseconds as float64, too.
    OutputFormat.CSV: Limits("csv", t_first=-(2**53), t_last=2**53, fractional=True, text_unit="us"),
    # A time in ROS has 32 bits for the seconds: without a sign in ROS 1, with a sign in ROS 2.
    OutputFormat.ROS1: Limits("a ROS 1 bag", t_first=0, t_last=2**32 * 10**6 - 1),
    OutputFormat.ROS2: Limits("a ROS 2 bag", side=2048, t_first=0, t_last=2**31 * 10**6 - 1, span=LONGEST_US),
}
"""Limits of the formats other than the native one."""

WRITERS = {
    OutputFormat.DSEC: "native_format:write_dsec",
    OutputFormat.EVT3: "evt_writers:write_evt3",
    OutputFormat.EVT21: "evt_writers:write_evt21",
    OutputFormat.DAT: "dat:write_dat",
    OutputFormat.AEDAT4: "aedat4_writer:write_aedat4",
    OutputFormat.NPZ: "plain_files:write_npz",
    OutputFormat.TEXT: "plain_files:write_text",
    OutputFormat.CSV: "plain_files:write_csv",
    OutputFormat.ROS1: "ros_writer:write_ros1",
    OutputFormat.ROS2: "ros_writer:write_ros2",
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
    own = CHOSEN_BY_NAME.get(chosen, chosen)
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


def video_library(path: Path) -> Any:
    """Return PyAV, to read or write a video file. Raises :class:`AmiwarpError` where it is not installed."""
    return optional_module("av", "video", f"{path}: videos need PyAV")


def make_folder(path: Path) -> None:
    """Create a folder and its parents. Raises :class:`AmiwarpError` if that fails, or for the name of a file."""
    missing = [new for new in (path, *path.parents) if not os.path.lexists(new)]
    for new in missing:
        if new.suffix.lower() in FILE_ENDINGS:
            raise AmiwarpError(f"{new}: is for a folder, but ends in {new.suffix}; give the name of a folder")
    note_folders(missing)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise AmiwarpError(
            f"{path}: cannot be made a folder: {error.strerror or error}; choose another --out"
        ) from error


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


# Data sets of recordings in a folder with a manifest, as ``amiwarp dataset`` writes them.

FORMAT, VERSION = "amiwarp-dataset", 1
"""Values of the manifest's fields ``format`` and ``version``."""
MANIFEST = "manifest.json"
SPLIT_NAME = "[A-Za-z0-9_-]+"
"""Regular expression of the names of splits, which become names of folders and files."""
MOST_BYTES = 1 << 30
"""Largest manifest that is read [bytes]: about a million recordings."""


@dataclass(frozen=True, slots=True)
class ManifestItem:
    """Entry of one recording in the manifest."""

    entry: Mapping[str, Any]
    """All fields of the entry."""
    file: str
    split: str
    labels: Mapping[str, Any]
    events: int
    representation: str | None
    """Representation of the tensors that the file holds; None for a recording."""


@guarded
class RecordedDataset:
    """Recordings of a data set, or their tensors, with their labels, for PyTorch's ``DataLoader`` or any other loop.

    It has a length and an index, as the data sets of PyTorch, but does not need PyTorch. Only the manifest is held in
    memory, so that the processes of a ``DataLoader`` share the object however they are started.

    Parameters
    ----------
    folder : str or os.PathLike
        Folder of the data set, with ``manifest.json``.
    split : str, optional
        Name of the part to use, such as "train"; by default all parts.
    transform : callable, optional
        Called with the :class:`Recording` and the dict of its labels. Its return value is the item. Without it, an item
        is the tuple of all events and the labels. If the data set holds tensors instead of recordings, ``transform`` is
        called with a dict of arrays and the labels; without it, an item is the array ``tensor`` and the labels.
        Worker processes that are spawned need a function of a module.
    structured : bool, default False
        Whether items are as those of tonic's data sets: a structured array of the events with the fields x, y, t [us]
        and p (1 is ON, 0 is OFF), and a target, the dict of labels. ``transform`` is then called with the array alone.
    target_transform : callable, optional
        Called with the dict of labels of structured items. Its return value is the target.

    Raises
    ------
    AmiwarpError
        If the folder has no manifest, the manifest is damaged or of a newer version, no recording is in the split,
        ``target_transform`` is given without ``structured``, or ``structured`` for a data set of tensors.

    Examples
    --------
    >>> import json, pathlib
    >>> events = amiwarp.Events.from_arrays([1, 2], [0, 0], [0, 10], [1, 0])
    >>> recording = amiwarp.Recording(amiwarp.MemoryEvents(events, 4, 4))
    >>> amiwarp.save_recording("000000.h5", recording)
    >>> item = {"file": "000000.h5", "split": "train", "labels": {"shape": "disc"}, "events": 2}
    >>> manifest = {"format": "amiwarp-dataset", "version": 1, "items": [item]}
    >>> _ = pathlib.Path("manifest.json").write_text(json.dumps(manifest))
    >>> dataset = amiwarp.RecordedDataset(".", split="train")
    >>> events, labels = dataset[0]
    >>> len(dataset), len(events), labels
    (1, 2, {'shape': 'disc'})
    >>> tonic_like = amiwarp.RecordedDataset(".", structured=True, target_transform=lambda labels: labels["shape"])
    >>> tonic_like[0]
    (array([(1, 0,  0, 1), (2, 0, 10, 0)],
          dtype=[('x', '<i2'), ('y', '<i2'), ('t', '<i8'), ('p', 'i1')]), 'disc')
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        split: str | None = None,
        *,
        transform: Callable[..., Any] | None = None,
        structured: bool = False,
        target_transform: Callable[[dict[str, Any]], Any] | None = None,
    ) -> None:
        if target_transform is not None and not structured:
            raise AmiwarpError("target_transform applies to structured items; give structured = True, or leave it out")
        self.folder = Path(folder)
        _, items = read_manifest(self.folder / MANIFEST)
        self._items = [item for item in items if split is None or item.split == split]
        if not self._items:
            counts = ", ".join(f"{name} ({n})" for name, n in sorted(Counter(item.split for item in items).items()))
            raise AmiwarpError(
                f"{self.folder}: no recording is in the split {shown(split)}; it has {counts or 'no recordings'}"
            )
        tensors = [item for item in self._items if item.representation is not None]
        if structured and tensors:
            raise AmiwarpError(
                f"{self.folder}: holds tensors ({tensors[0].representation}), but structured items are events; leave "
                "out structured, or make the data set without [output]"
            )
        self.transform = transform
        self.structured = structured
        self.target_transform = target_transform

    @property
    def labels(self) -> list[dict[str, Any]]:
        """Labels of all items in order. The recordings are not opened for it."""
        return [dict(item.labels) for item in self._items]

    def __len__(self) -> int:
        return len(self._items)

    def __getitem__(self, index: int) -> Any:
        """Return an item: the value that ``transform`` returns, or its events or tensor, and its labels.

        Raises IndexError after the last item, and :class:`AmiwarpError` if the index is no whole number, or if the file
        is missing or is not the one that the manifest describes.
        """
        if not hasattr(index, "__index__"):
            raise AmiwarpError(f"the index of an item is {shown(index)}; give a whole number, one for each item")
        item = self._items[index]
        if item.representation is not None:
            arrays = io_function("plain_files:read_tensors")(self.folder / item.file)
            labels = dict(item.labels)
            return (arrays["tensor"], labels) if self.transform is None else self.transform(arrays, labels)
        recording = open_item(self.folder, item)
        if self.structured:
            found = recording.events.slice(0, item.events)
            side = "i2" if found.whole_pixels else "f4"
            # tonic's own polarities are bool, of which its ToVoxelGrid makes ON events only: bool has no -1
            events = found.to_structured([("x", side), ("y", side), ("t", "i8"), ("p", "i1")])
            target = dict(item.labels)
            return (
                events if self.transform is None else self.transform(events),
                target if self.target_transform is None else self.target_transform(target),
            )
        if self.transform is not None:
            return self.transform(recording, dict(item.labels))
        return recording.events.slice(0, item.events), dict(item.labels)


def open_item(folder: Path, item: ManifestItem) -> Recording:
    """Open a recording of a data set.

    Raises :class:`AmiwarpError` if the file is missing or is not the one that the manifest describes.
    """
    path = folder / item.file
    recording = open_recording(path)
    n = len(recording.events)
    if n != item.events:
        given = f"{path}: holds {n} events, the manifest says {item.events}"
        raise AmiwarpError(f"{given}; make this recording again, or correct the manifest")
    return recording


def read_manifest(path: Path) -> tuple[dict[str, Any], list[ManifestItem]]:
    """Return the fields of a manifest without its items, and the items."""
    if not path.is_file():
        raise AmiwarpError(f"{path.parent}: has no {MANIFEST}; give the folder that 'amiwarp dataset' wrote")
    data = read_json(path, "a manifest of a data set", most_bytes=MOST_BYTES)
    with errors_name(path, lambda: "reading the manifest"):
        if data.get("format") != FORMAT:
            raise AmiwarpError(f"field format is {shown(data.get('format'))}; expected {shown(FORMAT)}")
        version = whole(data.get("version"), "field version", 1, 1 << 30)
        if version > VERSION:
            raise AmiwarpError(f"field version is {version}, newer than {VERSION}; update amiwarp")
        items = instance(data.get("items"), list, "field items")
        head = {name: value for name, value in data.items() if name != "items"}
        found = [_item(entry, f"items[{k}]") for k, entry in enumerate(items)]
        first: dict[PurePosixPath, int] = {}
        for k, item in enumerate(found):
            if (other := first.setdefault(PurePosixPath(item.file), k)) != k:
                raise AmiwarpError(f"field items[{k}].file is {shown(item.file)}, as items[{other}].file; remove one")
        return head, found


def _item(entry: Any, where: str) -> ManifestItem:
    """Return one item of a manifest, checked."""
    fields = instance(entry, dict, f"field {where}")
    file = instance(fields.get("file"), str, f"field {where}.file")
    path = PurePosixPath(file)
    if path.is_absolute() or ".." in path.parts or "\\" in file or not path.parts:
        raise AmiwarpError(f"field {where}.file is {shown(file)}; expected a path below the folder of the manifest")
    split = instance(fields.get("split"), str, f"field {where}.split")
    if not re.fullmatch(SPLIT_NAME, split):
        raise AmiwarpError(f"field {where}.split is {shown(split)}; use letters, digits, '-' and '_'")
    made = fields.get("representation")
    return ManifestItem(
        fields,
        file,
        split,
        instance(fields.get("labels"), dict, f"field {where}.labels"),
        whole(fields.get("events"), f"field {where}.events", 0, 1 << 62),
        None if made is None else instance(made, str, f"field {where}.representation"),
    )
