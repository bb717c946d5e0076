"""Sums in phase as C for microcontrollers, with a test: events, and the integers that amiwarp sums from them."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp._version import __version__
from amiwarp.events.recording import Events
from amiwarp.imaging import phase, phase_tables
from amiwarp.imaging.uploaded_events import TURNS, upload_events
from amiwarp.io.output_formats import make_folder
from amiwarp.io.outputs import NewFile
from amiwarp.validation import real, whole

TEMPLATES = Path(__file__).with_name("c_templates")
NAMES = ("phase_sums.h", "phase_sums.c", "test_phase_sums.c", "README.md")
"""Files that are written, each from the template of its name."""
MOST_SIDE = 1024
"""Largest width and height of a region [px]: amiwarp sums the 2^20 pixels as one block."""
TEST_EVENTS = 512
TEST_PIXELS = 16
"""Number of events of the test, and largest number of pixels to which they belong."""
LINE = 116
"""Length of a line of numbers."""


@dataclass(frozen=True)
class CSums:
    """Settings of sums in phase on a microcontroller. Raises :class:`AmiwarpError` for numbers out of range."""

    width: int
    height: int
    """Size of the region [px]."""
    harmonics: int = phase.HARMONICS
    """Number of harmonics, less than half of ``bins``."""
    bins: int = phase.BINS
    """Number of bins of a turn."""
    off_ratio: float = 1.0
    """OFF threshold divided by the ON threshold."""

    def __post_init__(self) -> None:
        whole(self.width, "width", 1, MOST_SIDE, " px")
        whole(self.height, "height", 1, MOST_SIDE, " px")
        whole(self.bins, "bins", 3, phase.MOST_BINS)
        most_harmonics = min(phase.MOST_HARMONICS, (self.bins - 1) // 2)
        whole(self.harmonics, "harmonics", 1, most_harmonics)
        real(self.off_ratio, "off_ratio", phase_tables.LEAST_RATIO, 1.0 / phase_tables.LEAST_RATIO)

    @property
    def ram_bytes(self) -> int:
        """Size of the sums: for each pixel six numbers of 16 bits, and two of 32 bits for each harmonic."""
        return self.width * self.height * (12 + 8 * self.harmonics)

    @property
    def table(self) -> NDArray[np.int32]:
        """What events add to their pixels, and what they add beside extremes."""
        table = phase_tables.angle_table(self.bins, self.harmonics, self.off_ratio)
        return np.concatenate([table, phase_tables.extreme_table(table)])

    @property
    def rows(self) -> NDArray[np.signedinteger[Any]]:
        """The table without the counts, in the smallest type that holds it."""
        rows = self.table[:, 2:]
        if np.abs(rows).max() <= np.iinfo(np.int16).max:
            return rows.astype(np.int16)
        return rows


def write_c_sums(out: Path, settings: CSums, *, seed: int = 0) -> None:
    """Write the C, its test with random events, and what to know about them, to a folder.

    Raises :class:`AmiwarpError` if a file exists or cannot be written. Then none is written.
    """
    values = _values(settings, seed)
    make_folder(out)
    with contextlib.ExitStack() as files:
        for name in NAMES:
            new = files.enter_context(NewFile(out / name))
            template = Template((TEMPLATES / name).read_text(encoding="utf-8"))
            new.part.write_text(template.substitute(values), encoding="utf-8", newline="\n")


def _values(settings: CSums, seed: int) -> dict[str, object]:
    """Return what stands for each name in the templates."""
    events, turns = _test_events(settings, seed)
    integers = _integers(settings, events, turns)
    y, x = np.nonzero(integers[:, :, :2].any(axis=2))
    table, extremes = np.split(settings.rows, 2)
    return {
        "origin": f"Written by 'amiwarp export-c' of amiwarp {__version__}.",
        "width": settings.width,
        "height": settings.height,
        "harmonics": settings.harmonics,
        "bins": settings.bins,
        "off_ratio": settings.off_ratio,
        "columns": integers.shape[2],
        "most": phase.most_of_polarity(settings.off_ratio),
        "ram": f"{settings.ram_bytes:,}",
        "flash": f"{settings.rows.nbytes:,}",
        "entry": f"{settings.rows.dtype}_t",
        "table": _braced(table, 4),
        "extremes": _braced(extremes, 4),
        "extreme": phase_tables.EXTREME,
        "events_count": len(events),
        "events": _braced(np.column_stack([events.x, events.y, turns, events.p]), 4),
        "pixels_count": len(x),
        "pixels": _braced(np.column_stack([x, y]), 4),
        "expected": _braced(integers[y, x], 4),
    }


def _test_events(settings: CSums, seed: int) -> tuple[Events, NDArray[np.uint16]]:
    """Return random events of a few pixels, corners among them, and their angles [1/65536 turn]."""
    rng = np.random.default_rng(seed)
    pixels = settings.width * settings.height
    corners = [0, settings.width - 1, pixels - settings.width, pixels - 1]
    others = rng.integers(0, pixels, TEST_PIXELS - len(corners))
    of_event = np.resize([*corners, *others], TEST_EVENTS)
    y, x = np.divmod(of_event, settings.width)
    turns = rng.integers(0, TURNS, TEST_EVENTS)

    # Half of the events lie at borders of bins: at the first angle of a bin, or the last one before it.
    bins = np.arange(TEST_EVENTS // 4) % settings.bins
    starts = -(-bins * TURNS // settings.bins)  # rounded up
    turns[TEST_EVENTS // 4 : TEST_EVENTS // 2] = starts
    turns[TEST_EVENTS // 2 : 3 * TEST_EVENTS // 4] = (starts - 1) % TURNS
    polarities = rng.integers(0, 2, TEST_EVENTS)
    events = Events.from_arrays(x, y, np.arange(TEST_EVENTS), polarities)
    return events, turns.astype(np.uint16)


def _integers(settings: CSums, events: Events, turns: NDArray[np.uint16]) -> NDArray[np.int32]:
    """Return the integers of all pixels as amiwarp sums them, shape (height, width, 3 + 2 harmonics)."""
    angles = turns.astype(np.float64) * (math.tau / TURNS)
    arrays = upload_events(events, angles, "cpu").arrays
    width = settings.width
    return phase.integer_sums(arrays, len(events), width, settings.height, settings.table)


def _braced(rows: NDArray[np.integer[Any]], indent: int) -> str:
    """Return the rows of an array as rows of C, each in braces, in lines that are not too long."""
    return "".join(_row(row.tolist(), " " * indent) for row in rows)


def _row(values: Iterable[int], indent: str) -> str:
    """Return a row of numbers in braces."""
    lines = [indent + "{"]
    for value in values:
        if len(lines[-1]) + len(str(value)) > LINE:
            lines.append(indent + " ")
        lines[-1] += f"{value}, "
    return "\n".join(line.rstrip() for line in lines).rstrip(",") + "},\n"
