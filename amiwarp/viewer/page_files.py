"""Files of the inspector's page: its template, style and scripts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

FOLDER = Path(__file__).with_name("page")
"""Folder with the page's template, style and scripts."""
ROUTE = "__amiwarp"
"""Path below which the page finds these files."""


def use_page(server: Any, downloads: str) -> None:
    """Give a trame server the page's style and scripts, its template, and the folder ``downloads`` below its name."""
    template = (FOLDER / "page.html").read_text(encoding="utf-8")
    server.enable_module(
        {
            "serve": {ROUTE: str(FOLDER), server.name: downloads},
            "styles": [f"{ROUTE}/page.css"],
            "module_scripts": [f"{ROUTE}/page.js"],
            "vue_use": ["amiwarp_page"],
        }
    )
    # when the connection ends, trame shows the second template: the same page, which then says so
    server.state.update({f"trame__template_{name}": template for name in ("main", "error")})
