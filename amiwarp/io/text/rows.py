"""Lines of text files of events: separators, decimal commas, words for polarities, dates as times, and UTF-16.

:class:`TextRow` makes plain numbers between spaces of a line. :func:`looks_like_text` decides whether a file is a
table, and :func:`why_no_rows` says what keeps text from being one.
"""

from __future__ import annotations

import datetime
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache

from amiwarp.io.text.encoding import BOM


def holds_values(line: bytes) -> bool:
    """Return whether a line of a text file is neither empty, nor a comment, nor Excel's ``sep=,``."""
    begin = line.lstrip()
    if begin[:1] in (b"", b"#", b"%"):
        return False
    return not begin[:5].lstrip(b'"').lower().startswith(b"sep=")


ON_WORDS = (b"true", b"on", b"positive", b"pos", b"yes", b"y", b"t", b"p", b"+")


OFF_WORDS = (b"false", b"off", b"negative", b"neg", b"no", b"n", b"f", b"-")


WORDS = {**dict.fromkeys(ON_WORDS, b"1"), **dict.fromkeys(OFF_WORDS, b"0")}
"""Words for polarities in text, in lower case."""

WORD_PATTERN = re.compile(rb"(?<!\S)(?:" + b"|".join(map(re.escape, WORDS)) + rb")(?!\S)", re.I)
"""Pattern of these words between spaces."""

STAMP = re.compile(
    rb"(?<!\S)(\d{4}-\d\d-\d\d)[T ](\d\d):(\d\d):(\d\d)(?:\.(\d{1,9}))?(Z|[ ]?UTC|[+-]\d\d:?\d\d)?(?!\S)"
)
"""Pattern of a date and a time of day between spaces, as of ISO 8601."""

QUOTED = re.compile(rb"\"[^\"\n]*\"|'[^'\n]*'")
"""Pattern of a value in quotation marks."""

QUOTED_DECIMAL = re.compile(rb"([\"'][+-]?\d*),(\d+(?:[eE][+-]?\d+)?[\"'])")
"""Pattern of a number with one comma in quotation marks."""

DECIMAL = re.compile(rb"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")
"""Pattern of a number with one comma."""

THOUSANDS = re.compile(rb"[+-]?[1-9]\d{0,2}(?:,\d{3})+")
"""Pattern of a number whose commas may separate thousands."""


@dataclass(frozen=True, slots=True)
class TextRow:
    """Form of the lines of a text file."""

    separator: bytes
    """Character between two columns; a space stands for any number of spaces and tabs."""
    decimal_comma: bool = False
    """Whether numbers have commas instead of decimal points; between commas, only numbers in quotation marks."""
    has_words: bool = False
    """Whether the polarity is a word."""
    quoted: bool = False
    """Whether values are in quotation marks."""
    has_stamps: bool = False
    """Whether times are dates with times of day."""

    @classmethod
    def of(cls, line: bytes) -> TextRow:
        """Return the form of a line."""
        line = line.removeprefix(BOM)
        quoted = b'"' in line or b"'" in line
        outside = QUOTED.sub(b"0", line) if quoted else line
        if b";" in outside:
            # Commas can only be decimal ones, also if the first numbers have none.
            separator = b";"
            decimal_comma = True
        elif b"," in outside and not _decimals_between_spaces(outside):
            separator = b","
            decimal_comma = QUOTED_DECIMAL.search(line) is not None
        else:
            separator = b" "
            decimal_comma = b"," in line
        row = cls(separator, decimal_comma, quoted=quoted)
        plain = row.plain(line)
        return replace(
            row,
            has_words=WORD_PATTERN.search(plain) is not None,
            has_stamps=STAMP.search(plain) is not None,
        )

    def plain(self, text: bytes) -> bytes:
        """Return text with numbers between spaces, and ``nan`` for an empty value before others."""
        if self.quoted:
            if self.decimal_comma and self.separator == b",":
                text = QUOTED_DECIMAL.sub(rb"\1.\2", text)
            text = text.replace(b'"', b"").replace(b"'", b"")
        if self.separator != b" ":
            if self.has_gaps(text):
                text = _filled(text, self.separator)
            text = text.replace(self.separator, b" ")
        if self.decimal_comma and self.separator != b",":
            text = text.replace(b",", b".")
        if self.has_stamps:
            text = STAMP.sub(_microseconds_since_1970, text)
        if self.has_words:
            text = WORD_PATTERN.sub(lambda match: WORDS[match[0].lower()], text)
        return text

    def is_plain(self, text: bytes) -> bool:
        """Return whether lines of this form consist of decimal numbers between separators."""
        if self.has_words or self.has_stamps or self.quoted or self.has_gaps(text):
            return False
        return not (self.decimal_comma and b"," in text)

    def has_gaps(self, text: bytes) -> bool:
        """Return whether values may be empty in lines of this form."""
        mark = self.separator
        if mark == b" ":
            return False
        if text.startswith((mark, b" " + mark)):
            return True
        gaps = (mark + mark, mark + b" " + mark, b"\n" + mark, b"\n " + mark)
        if any(gap in text for gap in gaps):
            return True
        # Only values that are padded need the slower search.
        padded = b"  " in text or (b"\t" in text and mark != b"\t")
        return padded and re.search(_first_empty(mark), text) is not None

    def words(self, line: bytes) -> list[bytes]:
        """Return the values of a line without empty ones at its end."""
        return self.plain(line.removeprefix(BOM)).split()

    def stamped(self, line: bytes) -> tuple[int, ...]:
        """Return the indices of the columns of a line that are dates."""
        with_dates = replace(self, has_stamps=False, has_words=False)
        marked = STAMP.sub(b"date", with_dates.plain(line.removeprefix(BOM)))
        return tuple(position for position, word in enumerate(marked.split()) if word == b"date")

    def names(self, line: bytes) -> tuple[str, ...]:
        """Return the names of columns in a line; an empty one for a column without a name."""
        try:
            text = line.removeprefix(BOM).decode("utf-8").strip("\r\n")
        except UnicodeDecodeError:
            # It is for example the µ of a unit, as Windows writes it.
            text = line.decode("latin-1").strip("\r\n")
        if self.separator != b" ":
            names_of_columns = text.split(self.separator.decode())
        elif "\t" in text:
            names_of_columns = text.split("\t")
        else:
            # A unit in brackets belongs to the name before it.
            names_of_columns = re.sub(r"\s+(?=[\[({])", "", text).split()
        return tuple(name.strip().strip("\"'") for name in names_of_columns)

    def is_row(self, line: bytes) -> bool:
        """Return whether a line consists of numbers."""
        words = self.words(line)
        return bool(words) and all(map(is_number, words))


def doubtful_comma(lines: Iterable[bytes]) -> bytes | None:
    """Return a number of lines whose commas are decimal ones or separate thousands; None if that is clear.

    Between semicolons, commas are decimal ones. A number such as 0,001 has no thousands.
    """
    numbers: list[bytes] = []
    for line in lines:
        row = TextRow.of(line)
        if row.decimal_comma and row.separator != b";":
            values = QUOTED.findall(line) if row.separator == b"," else line.split()
            numbers += [value.strip(b"\"'") for value in values if b"," in value]
    return numbers[0] if numbers and all(map(THOUSANDS.fullmatch, numbers)) else None


def _decimals_between_spaces(line: bytes) -> bool:
    """Return whether the commas of a line are decimal ones in columns between spaces or tabs."""
    fields = line.split()
    return len(fields) >= 4 and all(
        b"," not in field or DECIMAL.fullmatch(field) for field in fields
    )


def number_of(word: bytes) -> float:
    """Return the number that a word is. Raises ValueError for others, such as 1_229, which only Python reads."""
    if b"_" in word:
        raise ValueError
    return float(word)


DATE = re.compile(rb"\d{4}-\d\d-\d\d")
"""Pattern of a date, as of ISO 8601."""


def wrong_word(words: Iterable[bytes]) -> str | None:
    """Return the first of the words that is no number, and what it is, for messages; None if all are numbers."""
    for word in words:
        if not is_number(word):
            what = "no number"
            if DATE.fullmatch(word):
                what = "a date without a time of day, such as T00:00:00"
            return f"'{word[:40].decode('utf-8', 'replace')}', which is {what}"
    return None


def is_number(word: bytes) -> bool:
    try:
        number_of(word)
    except ValueError:
        return False
    return True


def _first_empty(separator: bytes) -> bytes:
    """Return the pattern of an empty value that a separator follows."""
    mark = re.escape(separator)
    return rb"(?m)(?:^|(?<=" + mark + rb"))[ \t]*(?=" + mark + rb")"


def _filled(text: bytes, separator: bytes) -> bytes:
    """Return lines with ``nan`` for each empty value that others follow, and without the empty ones at their ends."""
    mark = re.escape(separator)
    text = re.sub(rb"(?m)(?:[ \t]*" + mark + rb")+[ \t]*(?=\r?$)", b"", text)
    return re.sub(_first_empty(separator), b"nan", text)


@cache
def _days_since_1970(date: bytes) -> int | None:
    """Return the days from 1970 to a date; None for a day that no month has."""
    try:
        day = datetime.date.fromisoformat(date.decode())
    except ValueError:
        return None
    return (day - datetime.date(1970, 1, 1)).days


def _microseconds_since_1970(match: re.Match[bytes]) -> bytes:
    """Return the time of a date as a number [us], or the date if it is none. Without a zone, it is in UTC."""
    date, hours, minutes, seconds, fraction, zone = match.groups()
    days = _days_since_1970(date)
    if days is None or int(hours) > 23 or int(minutes) > 59 or int(seconds) > 59:
        return match[0]
    total_s = ((days * 24 + int(hours)) * 60 + int(minutes)) * 60 + int(seconds)
    if zone is not None and zone[:1] in b"+-":
        ahead_s = int(zone[1:3]) * 3600 + int(zone[-2:]) * 60
        if zone[:1] == b"-":
            ahead_s = -ahead_s
        total_s -= ahead_s
    nanoseconds = int((fraction or b"0").ljust(9, b"0"))
    return b"%d" % (total_s * 1_000_000 + (nanoseconds + 500) // 1000)
