"""The one exception that bad input raises: its text names what was given, what was expected and the remedy."""


class AmiwarpError(ValueError):
    """Bad input: a file, field or value that cannot be used. The message is one line for the user."""

    def __init__(self, message: str) -> None:
        """Keep the message, :func:`printable`: it may quote a damaged file, or a forged one."""
        super().__init__(printable(message))


def printable(text: str) -> str:
    """Return text as one line that a terminal shows and does not obey.

    Names of files, cameras and streams, and texts in files, may hold escape sequences, newlines, marks that turn the
    direction of writing round, or bytes that are no UTF-8. All of these come out escaped, as in ``\\x1b``.
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)
