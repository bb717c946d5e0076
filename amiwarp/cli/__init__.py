"""The command line: subcommands, the choice of a device, everything that is printed.

Results go to stdout, progress and errors to stderr. Exit codes: 0 done, 1 bad input, 2 wrong usage, 130 interrupted.
"""

import sys
from typing import NoReturn

INTERRUPTED = 130
STOPPED = "interrupted; nothing was left half-written"


def fail(code: int, message: str) -> NoReturn:
    """One line, and the end of the process."""
    print(f"amiwarp: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(code)
