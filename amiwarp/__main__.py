"""``python -m amiwarp`` and the ``amiwarp`` command."""

from __future__ import annotations

from amiwarp.cli import INTERRUPTED, STOPPED, fail


def main() -> None:
    """Load the command line, which takes a moment, and run it; ends the process."""
    try:
        from amiwarp.cli import app

        app.main()
    except KeyboardInterrupt:  # while it is loaded, before a command began, or after it ended
        fail(INTERRUPTED, STOPPED)


if __name__ == "__main__":
    main()
