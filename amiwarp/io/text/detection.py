"""Whether a file is a table of text, and why it is none."""

from __future__ import annotations

import codecs
import re
from dataclasses import replace

from amiwarp.io.columns.names import names_roles
from amiwarp.io.text.encoding import BOM, as_utf8
from amiwarp.io.text.rows import TextRow, holds_values, is_number, wrong_word

HEAD_BYTES = 4096
"""Number of bytes from which a format is detected."""


def looks_like_text(head: bytes) -> bool:
    """Return whether a file begins with rows of at least three numbers, or a line of names or a size before them."""
    text = as_utf8(head, head)
    lines = list(filter(holds_values, text.removeprefix(BOM).splitlines()))[:3]
    if not lines:
        # It may be a comment that is longer than the head.
        is_comment = text.removeprefix(BOM).startswith(b"#") and b"\0" not in text
        return is_comment and len(head) >= HEAD_BYTES
    first = TextRow.of(lines[0])
    if first.is_row(lines[0]):
        return len(first.words(lines[0])) >= 2
    following = [line for line in lines[1:] if TextRow.of(line).is_row(line)]
    if not following or b"\0" in text:
        return False
    return all(len(TextRow.of(line).words(line)) >= 3 for line in following)


CONTROL = re.compile(rb"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")
"""Characters that are part of no text."""


def why_no_rows(head: bytes) -> str | None:
    """Return what keeps text from being a table of events; None if a file that begins with ``head`` is no text."""
    if head[1::2].count(0) * 3 > len(head) and not CONTROL.search(head[::2]):
        return "is text in UTF-16 without a mark at its beginning; save it in UTF-8"
    text = as_utf8(head, head)
    try:
        # The last character may be cut off
        codecs.getincrementaldecoder("utf-8")("strict").decode(text)
    except UnicodeDecodeError:
        return None
    if CONTROL.search(text):
        return None
    lines = [
        (number, line)
        for number, line in enumerate(text.removeprefix(BOM).splitlines(), 1)
        if holds_values(line)
    ][:3]
    if not lines:
        return None

    # The line to show: the first one of numbers and other words, or else the line with most numbers.
    counts = [_count_of_numbers(line) for _, line in lines]
    wrong_words = [wrong_word(TextRow.of(line).words(line)) for _, line in lines]
    example = counts.index(max(counts))
    for index, wrong in enumerate(wrong_words):
        if counts[index] and wrong is not None:
            example = index
            break
    number, line = lines[example]
    wrong = wrong_words[example]

    if len(lines) == 1 and names_roles(TextRow.of(line).names(line)):
        return f"holds no events, only names of columns in line {number}; give another recording"
    if not counts[example]:
        return (
            f"is text, but {_quoted(number, line)} holds no numbers; expected rows of t, x, y and p"
        )
    if wrong is None and example > 1:
        # Two lines of words are above it.
        return (
            f"is text, but {_quoted(*lines[1])} holds neither numbers nor only units; leave it out"
        )
    if wrong is None:
        return f"is text, but {_quoted(number, line)} is no row of t, x, y and p"
    return (
        f"is text, but {_quoted(number, line)} holds {wrong}; "
        "amiwarp reads numbers, polarities such as true and false, on and off, y and n, + and -, and times such as "
        "2024-05-01T12:00:00.000123; leave out other columns, or change them to numbers"
    )


def _count_of_numbers(line: bytes) -> int:
    """Return how many numbers are in a line, words for polarities not included."""
    row = replace(TextRow.of(line), has_words=False)
    return sum(map(is_number, row.words(line)))


def _quoted(number: int, line: bytes) -> str:
    """Return a line and its number, for messages."""
    return f"line {number} '{line[:80].decode('utf-8', 'replace').strip()}'"
