"""The command line: subcommands, the choice of a device, everything that is printed.

Results go to stdout, progress and errors to stderr. Exit codes: 0 done, 1 bad input, 2 wrong usage, 130 interrupted.
"""

import sys
from typing import NoReturn

INTERRUPTED = 130
STOPPED = "interrupted; nothing was left half-written"


def printable(text: str) -> str:
    """Return text as one line that a terminal shows and does not obey.

    Names of files, cameras and streams, and texts in files, may hold escape sequences, newlines, marks that turn the
    direction of writing round, or bytes that are no UTF-8. All of these come out escaped, as in ``\\x1b``.
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def say(message: str) -> None:
    """Print a note or a warning on stderr, as one line."""
    print(printable(message), file=sys.stderr, flush=True)


def fail(code: int, message: str) -> NoReturn:
    """Print one line on stderr and end the process."""
    # Typer lists the choices of an option a line each.
    say(f"amiwarp: {message.strip().replace(chr(10) + chr(9), ' ')}")
    sys.exit(code)
