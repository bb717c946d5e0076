"""Exception for bad input, whose message says what was given, what was expected and what to do."""


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
        """Store the message in printable form, because it may quote a damaged or malicious file."""
        super().__init__(printable(message))


def printable(text: str) -> str:
    """Return text as one line without control characters.

    Names of files, cameras and streams, and text in files, may contain escape sequences of terminals, newlines, marks
    that reverse the direction of writing, or bytes that are not UTF-8. All of these are escaped, as in ``\\x1b``.
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)
