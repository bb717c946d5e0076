"""Keep the site free of the network: formulas become MathML, and a page that loads anything remote fails the build."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError

REMOTE = re.compile(
    r"""<(?:script|img|iframe|source|video|audio|embed|object|input)\b[^>]*\b(?:src|srcset|data)\s*=\s*["']?(?:https?:)?//[^\s"'>]*"""
    r"""|<link\b(?![^>]*\brel=["'](?:canonical|license)["'])[^>]*\bhref\s*=\s*["']?(?:https?:)?//[^\s"'>]*"""
    r"""|@import\s+(?:url\()?["']?(?:https?:)?//[^\s"')]*"""
    r"""|url\(\s*["']?(?:https?:)?//[^\s"')]*""",
    re.I,
)
"""A resource of another host that a browser would load with the page. Links to follow are none."""


def remote_resources(folder: Path) -> list[str]:
    """Return the remote resources that the pages and style sheets in ``folder`` load, with the file of each."""
    out = []
    for path in sorted(folder.rglob("*")):
        if path.suffix in (".html", ".css"):
            found = REMOTE.findall(path.read_text(encoding="utf-8"))
            out += [f"{path.relative_to(folder)}: {one}" for one in found]
    return out


def check(app: Sphinx, exception: Exception | None) -> None:
    """Fail the build if a page loads anything from the network."""
    if exception is None and app.builder.format == "html":
        found = remote_resources(Path(app.outdir))
        if found:
            raise ExtensionError(
                "the pages load resources from the network: " + "; ".join(found[:10])
            )


def inline(self: Any, node: nodes.math) -> None:
    """Write a formula in a line."""
    self.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def block(self: Any, node: nodes.math_block) -> None:
    """Write a formula of its own line, which scrolls if it is too wide."""
    self.body.append(f'<div class="math-block">{tex2mathml(node.astext(), as_block=True)}</div>\n')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer and the check."""
    app.add_html_math_renderer("mathml", (inline, None), (block, None))
    app.connect("build-finished", check)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
