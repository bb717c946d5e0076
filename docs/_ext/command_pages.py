"""Write the pages of the command line reference from the commands themselves: one per command, and an index.

The pages are written before Sphinx reads its sources. Their folder ``reference/command-line`` is not under version
control.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import typer
from generated_files import escape, heading, write_pages
from rich.text import Text
from sphinx.application import Sphinx

from amiwarp.cli.app import app as application

INDEX = """
Angles are degrees on the command line. The exit code is 0 for done, 1 for bad input (one line on stderr says which)
or failed work, 2 for wrong usage and 130 after an interrupt. A study of which some parts failed exits with 0, and names
them. Every command has ``--help``.

"""


def plain(markup: str | None) -> str:
    """Return help text without the markup of Rich."""
    return Text.from_markup(markup or "").plain


def paragraphs(text: str) -> str:
    """Return the paragraphs of a help text, each on one line, as reStructuredText; options are set as code."""
    joined = "\n\n".join(escape(" ".join(part.split())) for part in text.split("\n\n"))
    return re.sub(r"(?<![\w-])(--[a-z][a-z-]*)", r"``\1``", joined)


def argument_name(one: Any) -> str:
    """Return the name of an argument in capitals."""
    return str(one.name).upper()


def parameter(one: Any, ctx: Any) -> str:
    """Return the description of an argument or an option: its name, its help, its default and its limits."""
    names, text = one.get_help_record(ctx)
    match = re.fullmatch(r"(.*?)\s*\[([^\[\]]*|\w+\[[^\]]*\])\]", text, re.S)
    notes = ""
    if match and re.search(r"default:|required|<|>", match[2]):
        text, notes = match[1], match[2]
    body = paragraphs(plain(text)) or " "
    extra = f"\n\n   *{escape(notes)}*" if notes else ""
    if one.param_type_name == "argument":
        return f"``{argument_name(one)}``\n   {body}{extra}\n\n"
    return f".. option:: {names.replace(' range>', '>')}\n\n   {body}{extra}\n\n"


def usage(command: Any, ctx: Any) -> str:
    """Return the line that shows how the command is called."""
    arguments = [one for one in command.params if one.param_type_name == "argument"]
    pieces = [
        argument_name(one) if one.required else f"[{argument_name(one)}]" for one in arguments
    ]
    return " ".join([ctx.command_path, *pieces, "[OPTIONS]"])


def command_page(name: str, command: Any, parent: Any) -> str:
    """Return the page of one command."""
    ctx = typer.Context(command, parent=parent, info_name=name)
    example = plain(command.epilog).removeprefix("Example:").strip()
    out = (
        heading(ctx.command_path)
        + f".. program:: {ctx.command_path}\n\n{paragraphs(plain(command.help))}\n\n"
    )
    out += f".. code-block:: sh\n   :caption: Example\n\n   {example}\n\n"
    out += f".. code-block:: text\n   :caption: Usage\n\n   {usage(command, ctx)}\n\n"
    panels: dict[str, list[Any]] = {}
    for one in command.params:
        if getattr(one, "hidden", False) or one.name == "help":
            continue
        default = "Arguments" if one.param_type_name == "argument" else "Options"
        panels.setdefault(one.rich_help_panel or default, []).append(one)
    for panel in sorted(
        panels, key=lambda p: {"Arguments": 0, "Options": 1, "Common": 3}.get(p, 2)
    ):
        out += heading(panel, "-") + "".join(parameter(one, ctx) for one in panels[panel])
    return out


def write(app: Sphinx, config: Any) -> None:
    """Write all pages."""
    group: Any = typer.main.get_command(application)
    parent = typer.Context(group, info_name="amiwarp")
    rows = "".join(
        f"   * - :doc:`amiwarp {name} <{name}>`\n     - {escape(plain(command.get_short_help_str(limit=200)))}\n"
        for name, command in group.commands.items()
    )
    table = f".. list-table::\n   :class: names\n   :widths: 30 70\n\n{rows}\n"
    toctree = ".. toctree::\n   :hidden:\n\n" + "".join(f"   {name}\n" for name in group.commands)
    pages = {
        "index.rst": heading("Command line")
        + f"{paragraphs(plain(group.help))}\n\n"
        + INDEX
        + table
        + toctree
    }
    for name, command in group.commands.items():
        pages[f"{name}.rst"] = command_page(name, command, parent)
    write_pages(Path(app.srcdir) / "reference" / "command-line", pages)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the generator."""
    app.connect("config-inited", write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
