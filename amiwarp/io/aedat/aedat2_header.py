"""Header of AEDAT 2.0 files: lines that begin with ``#``, which name the camera."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import DEFAULT_BLOCK
from amiwarp.io.assumptions import Assumption
from amiwarp.io.file_pieces import read_words
from amiwarp.io.inputs import open_input

AEDAT2_MAGIC = b"#!AER-DAT2.0"
"""First bytes of a file."""
HEADER_BYTES = 1 << 24
"""Longest header that is read [bytes]. It can hold all settings of the camera."""
HEADER_LAST = b"#end of ascii header"
"""Last line of the header, in lower case; older versions of jAER do not write it."""
LINE = re.compile(rb"(#[^\r\n]*)(\r\n|\n|\r)")
"""Line of the header, and its end."""
CONTROL = re.compile(rb"[\x00-\x08\x0b-\x1f]")
"""Characters that are part of no line of text."""
RECORD_LIKE = re.compile(rb"#.{0,5}|.*[\x7f-\xff].*", re.DOTALL)
"""Lines that can be the start of a record, whose address begins with ``#``."""
RECORD_BYTES = 8
"""Size of a record."""


@dataclass(frozen=True, slots=True)
class Chip:
    """Layout of a camera's addresses."""

    width: int
    height: int
    davis: bool
    """Whether the camera is a DAVIS, not a DVS128, whose addresses have another layout."""


CHIPS = {
    "dvs128": Chip(128, 128, False),
    "davis128": Chip(128, 128, True),
    "davis208": Chip(208, 192, True),
    "davis240": Chip(240, 180, True),
    "davis346": Chip(346, 260, True),
    "davis640": Chip(640, 480, True),
    "tmpdiff128": Chip(128, 128, False),
}
"""Layouts by the name of jAER's class in the header, in lower case and without a suffix."""


def read_aedat2_header(path: Path, given: str | None = None) -> tuple[Chip, int, Assumption | None]:
    """Return the camera, the position of the first record, and what was assumed about the camera, if anything."""
    with open_input(path) as file:
        head = file.read(HEADER_BYTES + 1)
    if not head.startswith(AEDAT2_MAGIC):
        raise AmiwarpError(
            "byte 0: is not the header of an AEDAT 2.0 file; give another file",
            ErrorCode.FORMAT_UNKNOWN,
        )
    lines, start = _header_lines(head, path.stat().st_size)
    if start > HEADER_BYTES:
        raise AmiwarpError(
            f"the header is longer than {HEADER_BYTES >> 20} MiB; the file is damaged",
            ErrorCode.FILE_DAMAGED,
        )
    name = ""
    for line in lines:
        match = re.match(rb"#\s*AEChip:\s*(\S+)", line)
        if match is not None:
            name = match[1].decode("ascii", "replace")
    if given is not None:
        if given.lower() not in CHIPS:
            raise AmiwarpError(f"chip is '{given[:60]}'; expected one of {', '.join(CHIPS)}")
        return CHIPS[given.lower()], start, None
    if not name:
        guessed = _guessed_chip(path, start)
        why = "the header names no camera, and this is the smallest that has the largest address"
        return CHIPS[guessed], start, Assumption("chip", guessed, why, "--chip")
    short = name.rpartition(".")[2].lower()
    chip = next((chip for key, chip in CHIPS.items() if short.startswith(key)), None)
    if chip is None:
        known = ", ".join(CHIPS)
        raise AmiwarpError(
            f"the header names camera '{name[:60]}'; expected one of {known}; choose one with --chip",
            ErrorCode.AMBIGUOUS,
        )
    return chip, start, None


def _header_lines(head: bytes, file_bytes: int) -> tuple[list[bytes], int]:
    """Return the lines of the header of a file of some size, and the position of the first record.

    Records can begin with ``#``, too. The header ends at a line that says so; without it, at what is no line of text.
    """
    lines: list[bytes] = []
    start = 0
    first_newline = b""
    newline = b""
    while match := LINE.match(head, start):
        line, newline = match.groups()
        if CONTROL.search(line):
            break
        first_newline = first_newline or newline
        if first_newline == b"\r":
            # A "\n" behind it is the beginning of the first record, and no part of a newline.
            newline = first_newline
        lines.append(line)
        start += len(line) + len(newline)
        if line.strip().lower() == HEADER_LAST:
            return lines, start
    is_doubtful = len(lines) > 1 and RECORD_LIKE.fullmatch(lines[-1]) is not None
    if is_doubtful and (file_bytes - start) % RECORD_BYTES:
        before = start - len(lines[-1]) - len(newline)
        # The last line is the start of a record if whole records follow without it.
        if (file_bytes - before) % RECORD_BYTES == 0:
            return lines[:-1], before
    return lines, start


def _guessed_chip(path: Path, offset: int) -> str:
    """Return the name of the smallest camera that has the largest address in a file without the camera's name."""
    largest = 0
    right = 0
    top = 0
    for records in read_words(path, offset, ">u4", DEFAULT_BLOCK, {}):
        words = records[:, 0].astype(np.int64)
        largest = max(largest, int(words.max(initial=0)))
        events = words[(words >> 31 == 0) & (words >> 10 & 1 == 0)]
        right = max(right, int((events >> 12 & 0x3FF).max(initial=0)))
        top = max(top, int((events >> 22 & 0x1FF).max(initial=0)))
    if largest < 1 << 16:
        return "dvs128"
    davis = {name: chip for name, chip in CHIPS.items() if chip.davis}
    for name, chip in davis.items():
        if right < chip.width and top < chip.height:
            return name
    return list(davis)[-1]
