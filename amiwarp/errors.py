"""Exception for bad input, whose message says what was given, what was expected and what to do."""

import enum
import importlib
import re
from typing import Any, ClassVar, NoReturn


class Option(enum.StrEnum):
    """Base of options with a fixed set of values: a value that none of them has is answered with all of them."""

    @classmethod
    def _missing_(cls, value: object) -> NoReturn:
        raise AmiwarpError(f"{cls.__name__} is {value!r}; choose among {', '.join(cls)}")


class ErrorCode(Option):
    """Kind of an :class:`AmiwarpError`, for programs that act on it; the message is for people.

    Examples
    --------
    >>> amiwarp.ErrorCode("file-missing")
    <ErrorCode.FILE_MISSING: 'file-missing'>
    """

    INVALID = "invalid"
    """A value or a combination of values cannot be used. It is the code of all errors without one of their own."""
    FIELD = "field"
    """A field of a JSON, TOML or YAML file is missing, unknown or wrong."""
    OPTIONS = "options"
    """An option needs another one, or excludes it."""
    FILE_MISSING = "file-missing"
    """A file or folder does not exist."""
    FILE_UNREADABLE = "file-unreadable"
    """A file cannot be opened or read, is not a regular file, or changed meanwhile."""
    FILE_DAMAGED = "file-damaged"
    """A file contradicts its format, or ends too early."""
    FORMAT_UNKNOWN = "format-unknown"
    """A file is of another format, or of a variant or version that is not read."""
    CONTENT_MISSING = "content-missing"
    """A file or recording lacks what is needed: events, a camera, an encoder, ground truth."""
    AMBIGUOUS = "ambiguous"
    """A file can be read in several ways; the message names the option that chooses."""
    OUTPUT_EXISTS = "output-exists"
    """An output exists already and may not be replaced."""
    OUTPUT_FAILED = "output-failed"
    """An output cannot be written to its place."""
    DISK_FULL = "disk-full"
    """A disk has no space left for an output."""
    DEVICE_MISSING = "device-missing"
    """The device for the computation is not available."""
    PACKAGE_MISSING = "package-missing"
    """An optional package is not installed; the message has the command that installs it."""
    UNREACHABLE = "unreachable"
    """A camera, a port or a sender of events is not there now, or is in use."""
    CALIBRATION_REFUSED = "calibration-refused"
    """The events do not determine the calibration, or contradict what is given; the message has the cause."""


class AmiwarpError(ValueError):
    """Error for bad input: a file, field or value that cannot be used. The message is one line.

    Parameters
    ----------
    message : str
        What was given, what was expected and what to do.
    code : ErrorCode, optional
        Kind of the error; by default the kind of the error from which this one is raised, or ``ErrorCode.INVALID``.

    Examples
    --------
    >>> try:
    ...     amiwarp.Prism(apex=2.0)
    ... except amiwarp.AmiwarpError as error:
    ...     print(error)
    prism apex = 2.0 is not a finite number in 0 .. 0.523599 rad, 0 .. 30 deg; is it given in degrees?
    """

    _KIND: ClassVar[ErrorCode] = ErrorCode.INVALID
    """Code of an error to which none is given."""

    def __init__(self, message: str, code: ErrorCode | None = None) -> None:
        """Store the message in printable form and shortened, because it may quote a damaged or malicious file."""
        super().__init__(shortened(printable(message)))
        self._code = code

    def __reduce__(self) -> str | tuple[Any, ...]:
        # The error from which this one is raised does not travel to another process.
        self._code = self.code
        return super().__reduce__()

    @property
    def code(self) -> ErrorCode:
        """Kind of the error. An error that only adds a name to another one has the code of that one."""
        if self._code is not None:
            return self._code
        cause = self.__cause__
        return cause.code if isinstance(cause, AmiwarpError) else self._KIND


LONGEST_WORD = 160
WORD_HEAD = 100
WORD_TAIL = 40
"""Longest word of a message, and the characters kept at the beginning and end of a longer one."""
LONGEST_MESSAGE = 800
MESSAGE_HEAD = 500
MESSAGE_TAIL = 250
"""The same of a whole message."""


def shortened(message: str) -> str:
    """Return a message without the middle of overlong words (paths, names in files), then of the whole."""
    words = re.sub(
        rf"\S{{{LONGEST_WORD + 1},}}", lambda found: _ends(found[0], WORD_HEAD, WORD_TAIL), message
    )
    return words if len(words) <= LONGEST_MESSAGE else _ends(words, MESSAGE_HEAD, MESSAGE_TAIL)


def _ends(text: str, head: int, tail: int) -> str:
    return f"{text[:head]}...{text[-tail:]}"


def printable(text: str) -> str:
    """Return text as one line without control characters.

    Names of files, cameras and streams, and text in files, may contain escape sequences of terminals, newlines, marks
    that reverse the direction of writing, or bytes that are not UTF-8. All of these are escaped, as in ``\\x1b``.
    """
    if text.isprintable():
        return text
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text
    )


def optional_module(name: str, extra: str, need: str) -> Any:
    """Import a module of an optional library. Raises :class:`AmiwarpError` if it is missing.

    ``extra``: the package's extra that installs it; ``need``: the message without the remedy.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise AmiwarpError(
            f"{need}; run: pip install 'amiwarp[{extra}]'", ErrorCode.PACKAGE_MISSING
        ) from error
