"""Write the pages of the Python reference: one per room of the package, one per public name.

The names come from ``amiwarp.PUBLIC_NAMES``. The imports of the front door tell in which room each one lives.
The pages are written before Sphinx reads its sources, to ``reference/api``, which is not under version control.
"""

from __future__ import annotations

import ast
import functools
import importlib
import inspect
import re
from pathlib import Path
from types import ModuleType
from typing import Any

from docutils import nodes
from generated_files import heading, write_pages
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.errors import ExtensionError
from sphinx.pycode import ModuleAnalyzer

import amiwarp

INDEX = """
The public names of ``import amiwarp``, by the part of the package that they belong to. Angles are in radians, times in
microseconds and places in pixels unless a name says otherwise.

"""


COMMON = "common"
COMMON_ABOUT = "What all parts of the package use."


@functools.cache
def homes() -> dict[str, str]:
    """Return the module that each public name is imported from, as the front door states it."""
    front = Path(amiwarp.__file__)
    stub = front.with_suffix(".pyi")
    found = {}
    for node in ast.walk(ast.parse((stub if stub.exists() else front).read_text())):
        if isinstance(node, ast.ImportFrom):
            module = f"amiwarp.{node.module}" if node.level else str(node.module)
            found.update({alias.asname or alias.name: module for alias in node.names})
    names = [name for name in amiwarp.PUBLIC_NAMES if not name.startswith("_")]
    missing = [name for name in names if name not in found]
    if missing:
        raise ExtensionError(f"no import in amiwarp's front door for {', '.join(missing)}")
    return {name: found[name] for name in names}


def room_of(module: str) -> str:
    """Return the room of a module, or :data:`COMMON` if it lies in none."""
    below = module.split(".")[1:2]
    package = below and importlib.import_module(f"amiwarp.{below[0]}")
    return below[0] if package and hasattr(package, "__path__") else COMMON


def rooms(order: list[str]) -> dict[str, list[str]]:
    """Return the public names by room; the rooms are in ``order``, then by name, those in no room last."""
    out: dict[str, list[str]] = {}
    for name, module in sorted(homes().items(), key=lambda item: item[0].lower()):
        out.setdefault(room_of(module), []).append(name)
    known = {room: i for i, room in enumerate(order)}
    return {
        room: out[room]
        for room in sorted(out, key=lambda r: (r == COMMON, known.get(r, len(order)), r))
    }


def alias(name: str) -> tuple[str, str]:
    """Return what a public name that is neither class nor function stands for, and its documentation."""
    module = importlib.import_module(homes()[name])
    analyzer = ModuleAnalyzer.for_module(module.__name__)
    analyzer.analyze()
    doc = " ".join(analyzer.attr_docs.get(("", name), [])).strip()
    for node in ast.parse(Path(str(module.__file__)).read_text()).body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if any(isinstance(target, ast.Name) and target.id == name for target in targets):
            return ast.unparse(node.value), doc  # type: ignore[attr-defined]
    return "", doc


def page_of(name: str) -> str:
    """Return the name of the page of a public name; no two differ in case only, as some file systems cannot."""
    twin = any(name != other and name.lower() == other.lower() for other in homes())
    return f"amiwarp.{name}" + ("-function" if twin and name.islower() else "")


def documented(thing: Any) -> bool:
    """Return whether ``thing`` carries a documentation of its own."""
    return inspect.isclass(thing) or inspect.isroutine(thing) or isinstance(thing, ModuleType)


def summary(name: str) -> str:
    """Return the first sentence of the documentation of a public name."""
    thing = getattr(amiwarp, name)
    return first_sentence((inspect.getdoc(thing) or "") if documented(thing) else alias(name)[1])


def first_sentence(text: str) -> str:
    """Return the first sentence of a docstring."""
    line = " ".join(text.split("\n\n")[0].split())
    return re.split(r"(?<=[.:]) (?=[A-Z])", line)[0].rstrip(":")


def directive(name: str) -> str:
    """Return the directive that documents a public name."""
    thing = getattr(amiwarp, name)
    if inspect.isclass(thing):
        return f".. {'autoexception' if issubclass(thing, BaseException) else 'autoclass'}:: {name}\n\n"
    if documented(thing):
        return f".. autofunction:: {name}\n\n"
    meaning, doc = alias(name)
    return f".. py:type:: {name}\n   :canonical: {meaning}\n\n   {doc}\n\n"


def name_page(name: str) -> str:
    """Return the page of one public name."""
    return (
        heading(name)
        + f".. currentmodule:: amiwarp\n\n{directive(name)}"
        + f".. minigallery:: amiwarp.{name}\n   :add-heading: Tutorials\n   :heading-level: -\n"
    )


def room_page(room: str, names: list[str]) -> str:
    """Return the page of one room: what it is for, and a table of its names."""
    about = (
        COMMON_ABOUT
        if room == COMMON
        else first_sentence(importlib.import_module(f"amiwarp.{room}").__doc__ or "")
    )
    rows = "".join(f"   * - :py:obj:`~amiwarp.{name}`\n     - {summary(name)}\n" for name in names)
    table = f".. list-table::\n   :class: names\n   :widths: 25 75\n\n{rows}\n"
    toctree = ".. toctree::\n   :hidden:\n\n" + "".join(f"   {page_of(name)}\n" for name in names)
    return heading(room) + f"{about}\n\n{table}{toctree}"


def index_page(found: dict[str, list[str]]) -> str:
    """Return the page that lists the rooms and their names."""
    rows = ""
    for room, names in found.items():
        links = ", ".join(f":py:obj:`~amiwarp.{name}`" for name in names)
        rows += f"   * - :doc:`{room}`\n     - {links}\n"
    table = f".. list-table::\n   :class: names\n   :widths: 20 80\n\n{rows}\n"
    toctree = ".. toctree::\n   :hidden:\n\n" + "".join(f"   {room}\n" for room in found)
    return heading("Python") + INDEX + table + toctree


def write(app: Sphinx, config: Any) -> None:
    """Write all pages."""
    found = rooms(config.api_rooms)
    pages = {"index.rst": index_page(found)}
    for room, names in found.items():
        pages[f"{room}.rst"] = room_page(room, names)
        pages.update({f"{page_of(name)}.rst": name_page(name) for name in names})
    write_pages(Path(app.srcdir) / "reference" / "api", pages)


def link_by_name(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, contnode: Any
) -> nodes.reference | None:
    """Link ``amiwarp.room.module.Name`` and ``Name`` to the public ``amiwarp.Name``, its members included."""
    if node.get("refdomain") != "py":
        return None
    parts = node["reftarget"].split(".")
    start = next((i for i, part in enumerate(parts) if part in homes()), None)
    if start is None or (start > 0 and parts[0] != "amiwarp"):
        return None
    target = ".".join(["amiwarp", *parts[start:]])
    if target == node["reftarget"]:
        return None
    domain = env.domains["py"]
    return domain.resolve_xref(env, node["refdoc"], app.builder, "obj", target, node, contnode)


class AttributeText:
    """Keep the text of attributes as it is written: Napoleon takes the words before a colon for a type."""

    def __init__(self) -> None:
        self.kept: dict[str, list[str]] = {}

    def keep(
        self, app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]
    ) -> None:
        """Store the text, before Napoleon."""
        if what in ("attribute", "data", "property"):
            self.kept[name] = list(lines)

    def restore(
        self, app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]
    ) -> None:
        """Put the text back, after Napoleon."""
        lines[:] = self.kept.pop(name, lines)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the generator."""
    app.add_config_value("api_rooms", [], "env")
    app.connect("config-inited", write)
    app.connect("missing-reference", link_by_name)
    text = AttributeText()
    app.connect("autodoc-process-docstring", text.keep, priority=400)
    app.connect("autodoc-process-docstring", text.restore, priority=600)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
