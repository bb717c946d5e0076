"""``python -m amiwarp`` and the ``amiwarp`` command."""

from __future__ import annotations

import os
import signal
import sys

from amiwarp.cli import INTERRUPTED, STOPPED, fail

ENDING = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
"""Signals that end a command as Ctrl-C does."""


def main() -> None:
    """Run the command line and end the process.

    After an interrupt it ends without Python's own clearing up: a compiled library that was interrupted while it was
    loading may crash there. All that a command holds is given back before.
    """
    try:
        _main()
    except SystemExit as end:
        if end.code != INTERRUPTED:
            raise
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(INTERRUPTED)


def _main() -> None:
    """Load the command line, which takes a moment, and run it."""
    try:
        for number in ENDING:
            if signal.getsignal(number) is signal.SIG_DFL:  # nohup ignores the terminal's end, and so do we then
                signal.signal(number, signal.default_int_handler)
        from amiwarp.cli import app

        app.main()
    except KeyboardInterrupt:  # while it is loaded, before a command began, or after it ended
        fail(INTERRUPTED, STOPPED)


if __name__ == "__main__":
    main()
