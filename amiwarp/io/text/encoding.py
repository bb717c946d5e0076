"""Text of files in UTF-8, or in UTF-16, as Excel and PowerShell write it."""

import codecs
from collections.abc import Iterator
from pathlib import Path

from amiwarp.io.inputs import open_input

BOM = b"\xef\xbb\xbf"
"""Mark at the beginning of some files in UTF-8."""

UTF16 = {b"\xff\xfe": "utf-16-le", b"\xfe\xff": "utf-16-be"}
"""Encodings by their marks at the beginning of a file, as Excel and PowerShell write them."""


def as_utf8(data: bytes, mark: bytes) -> bytes:
    """Return bytes of a file that begins with ``mark`` as UTF-8. They begin at a character."""
    encoding = UTF16.get(mark[:2])
    if encoding is None:
        return data
    return data.decode(encoding, "replace").encode()


def text_head(path: Path, size: int) -> tuple[bytes, bool]:
    """Return the text in the first ``size`` bytes of a file, and whether the file goes on."""
    with open_input(path) as file:
        data = file.read(size)
        return as_utf8(data, data), bool(file.read(1))


def text_tail(path: Path, size: int) -> bytes:
    """Return the text in about the last ``size`` bytes of a file; it may begin within a line."""
    with open_input(path) as file:
        mark = file.read(2)
        start = max(path.stat().st_size - size, 0)
        # A character of UTF-16 has an even place
        file.seek(start // 2 * 2)
        return as_utf8(file.read(), mark)


def text_pieces(path: Path, start: int, size: int, notes: dict[str, int]) -> Iterator[bytes]:
    """Yield the text of a file in pieces, from the byte ``start`` of the text on, and note how much was read."""
    notes["total"] = path.stat().st_size
    with open_input(path) as file:
        encoding = UTF16.get(file.read(2))
        if encoding is None:
            file.seek(start)
            while data := file.read(size):
                notes["read"] = file.tell()
                yield data
            return

        # Decoded from the beginning, because a byte of the text may be anywhere in the file.
        file.seek(0)
        decoder = codecs.getincrementaldecoder(encoding)("replace")
        left_out = start
        while data := file.read(size):
            notes["read"] = file.tell()
            text = decoder.decode(data).encode()
            yield text[left_out:]
            left_out = max(left_out - len(text), 0)
