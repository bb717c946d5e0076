"""Files of the inspector's page: its template, and trame's first page with small changes."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).with_name("page")
"""Folder with the page's template, style and scripts."""
ROUTE = "__amiwarp"
"""Path below which the page finds these files."""


def first_page(path: Path) -> str:
    """Return trame's first page with the page's own socket. The reader can enlarge the page.

    It shows a plain text until the page is ready.
    """
    page = path.read_text(encoding="utf-8")
    page = re.sub(r'<meta\s+name="viewport"[^>]*>', '<meta name="viewport" content="width=device-width">', page)
    page = re.sub(r"<title>.*?</title>", "<title>amiwarp inspector</title>", page)
    page = page.replace("<title>", f'<script src="{ROUTE}/socket.js"></script><title>')
    return re.sub(r'<div id="app"></div>\s*<script>.*?</script>', '<div id="app">opening the inspector …</div>', page,
                  flags=re.DOTALL)  # fmt: skip


def read_template() -> str:
    """Return the page's template."""
    return (FOLDER / "page.html").read_text(encoding="utf-8")


def use_page(server: Any, template: str) -> None:
    """Give a trame server the page's style and scripts, and its template."""
    server.enable_module({
        "serve": {ROUTE: str(FOLDER)}, "styles": [f"{ROUTE}/page.css"], "module_scripts": [f"{ROUTE}/page.js"],
        "vue_use": ["amiwarp_page"],
    })  # fmt: skip
    # when the connection ends, trame shows the second template: the same page, which then says so
    server.state.update({f"trame__template_{name}": template for name in ("main", "error")})
