"""``python -m amiwarp`` and the ``amiwarp`` command."""

from __future__ import annotations

from amiwarp.cli.app import main

if __name__ == "__main__":
    main()
