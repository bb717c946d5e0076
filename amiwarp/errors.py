"""Exception for bad input, whose message says what was given, what was expected and what to do."""

import importlib
import re
from typing import Any


class AmiwarpError(ValueError):
    """Error for bad input: a file, field or value that cannot be used. The message is one line.

    Examples
    --------
    >>> try:
    ...     amiwarp.Prism(apex=2.0)
    ... except amiwarp.AmiwarpError as error:
    ...     print(error)
    prism apex = 2.0 is not a finite number in 0 .. 0.523599 rad, 0 .. 30 deg; is it given in degrees?
    """

    def __init__(self, message: str) -> None:
        """Store the message in printable form and shortened, because it may quote a damaged or malicious file."""
        super().__init__(shortened(printable(message)))


LONGEST_WORD, WORD_HEAD, WORD_TAIL = 160, 100, 40
"""Longest word of a message, and the characters kept at the beginning and end of a longer one."""
LONGEST_MESSAGE, MESSAGE_HEAD, MESSAGE_TAIL = 800, 500, 250
"""The same of a whole message."""


def shortened(message: str) -> str:
    """Return a message without the middle of overlong words (paths, names in files), then of the whole."""
    words = re.sub(rf"\S{{{LONGEST_WORD + 1},}}", lambda found: _ends(found[0], WORD_HEAD, WORD_TAIL), message)
    return words if len(words) <= LONGEST_MESSAGE else _ends(words, MESSAGE_HEAD, MESSAGE_TAIL)


def _ends(text: str, head: int, tail: int) -> str:
    return f"{text[:head]}...{text[-tail:]}"


def printable(text: str) -> str:
    """Return text as one line without control characters.

    Names of files, cameras and streams, and text in files, may contain escape sequences of terminals, newlines, marks
    that reverse the direction of writing, or bytes that are not UTF-8. All of these are escaped, as in ``\\x1b``.
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def optional_module(name: str, extra: str, need: str) -> Any:
    """Import a module of an optional library. Raises :class:`AmiwarpError` if it is missing.

    ``extra``: the package's extra that installs it; ``need``: the message without the remedy.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise AmiwarpError(f"{need}; run: pip install 'amiwarp[{extra}]'") from error
