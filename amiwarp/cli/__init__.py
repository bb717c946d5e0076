"""Command line: subcommands, choice of the device, and everything that is printed.

Results go to stdout; progress and errors go to stderr. Exit codes: 0 success, 1 bad input, 2 wrong usage,
130 interrupted.
"""

import sys
from typing import NoReturn

from amiwarp.errors import printable

INTERRUPTED = 130
STOPPED = "interrupted; nothing was left half-written"


def say(message: str) -> None:
    """Print a note or a warning on stderr as one line."""
    print(printable(message), file=sys.stderr, flush=True)


def fail(code: int, message: str) -> NoReturn:
    """Print one line on stderr and exit with the exit code ``code``."""
    # Typer puts each choice of an option on a line of its own.
    say(f"amiwarp: {message.strip().replace(chr(10) + chr(9), ' ')}")
    sys.exit(code)
