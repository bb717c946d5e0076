"""``python -m amiwarp`` and the ``amiwarp`` command."""

from __future__ import annotations

import sys

from amiwarp.cli import INTERRUPTED, STOPPED


def main() -> None:
    """The command line, which takes a moment to load: it may be interrupted then, too."""
    try:
        from amiwarp.cli import app
    except KeyboardInterrupt:
        print(f"amiwarp: {STOPPED}", file=sys.stderr)
        sys.exit(INTERRUPTED)
    app.main()


if __name__ == "__main__":
    main()
