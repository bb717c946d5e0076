"""Bring the tables and plans of the page up to date: ``python -m rig.page``.

A table of the page that is made by code follows a line ``<!-- made: NAME -->``.
"""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from rig import bill, perfboard, wires

PAGE = Path(__file__).parent.parent / "docs" / "how-to" / "build-a-rig.md"
IMAGES = PAGE.parent.parent / "images"


def rows(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    return (
        "\n".join(f"| {' | '.join(line)} |" for line in (head, ["---"] * len(head), *lines)) + "\n"
    )


def tables() -> dict[str, str]:
    """Return all tables of the page that are made by code, by their names."""
    return {
        **bill.pages(),
        "pins": rows(
            ("net", "pin of the Pico", "pin of the Mega", "what", "on the board"),
            wires.controller_rows(),
        ),
        "connectors": rows(
            ("connector", "pin", "net", "goes to, belt", "goes to, hollow-shaft motor"),
            wires.connector_rows(),
        ),
        "wires": rows(
            ("wire", "net", "from", "hole", "to", "hole"), perfboard.wire_rows("rp2040", "belt")
        ),
        "left out": rows(
            ("left out", "when", "and these wires"), perfboard.left_out_rows("rp2040", "belt")
        ),
        "power": rows(("from", "to, belt", "to, hollow-shaft motor"), wires.POWER),
    }


def updated(page: str) -> str:
    """Return the text of a page with its tables made anew."""
    for name, table in tables().items():
        found = re.compile(rf"(<!-- made: {re.escape(name)} -->\n)(?:\|.*\n)*")
        page = found.sub(lambda match, table=table: match[1] + table, page)
    return page


if __name__ == "__main__":
    PAGE.write_text(updated(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    perfboard.write(IMAGES)
