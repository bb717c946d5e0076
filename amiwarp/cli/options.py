"""Options as dataclasses: each group is written once, and a command takes as many groups as it needs."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from amiwarp.io import output
from amiwarp.regular_file import check_regular

OUTPUT = "output"
"""Marks, in ``Annotated``, an option that names a file to write; every other path is read."""
OUTPUT_FOLDER = "output folder"
"""Marks an option that names a folder to write to; the command checks its files."""

NO_FILE = "no file"
"""Marks an option that names something that is neither read nor written as a file."""

_FORCE = Annotated[
    bool,
    typer.Option("--force", help="Replace outputs that exist; never a file that is read.", rich_help_panel="Common"),
]


@dataclass(frozen=True)
class Common:
    """What every command takes."""

    json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object on stdout and nothing else.", rich_help_panel="Common")
    ] = False
    device: Annotated[
        str | None,
        typer.Option(
            help="Where the kernels run: cpu, cuda:0 ... Default: cuda:0 where there is one, else cpu.",
            rich_help_panel="Common",
        ),
    ] = None
    seed: Annotated[
        int, typer.Option(min=0, max=2**31 - 1, help="Seed of whatever is drawn at random.", rich_help_panel="Common")
    ] = 0


def command(app: typer.Typer, function: Callable[..., None], *, name: str, example: str) -> None:
    """Register ``function`` as a subcommand; its parameters that are dataclasses are spread out into options."""
    hints = get_type_hints(function, include_extras=True)
    spread: list[inspect.Parameter] = []
    groups: dict[str, tuple[type, list[str]]] = {}
    for parameter in inspect.signature(function).parameters.values():
        kind = hints[parameter.name]
        if is_dataclass(kind) and isinstance(kind, type):
            spread += _parameters(kind)
            groups[parameter.name] = (kind, [f.name for f in fields(kind)])
        else:
            spread.append(parameter.replace(annotation=kind, kind=inspect.Parameter.KEYWORD_ONLY))
    marks = {p.name: getattr(p.annotation, "__metadata__", ()) for p in spread}
    writes = any(OUTPUT in mark or OUTPUT_FOLDER in mark for mark in marks.values())
    if writes:
        spread.append(inspect.Parameter("force", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=_FORCE))

    @functools.wraps(function)
    def run(**values: Any) -> None:
        force = writes and values.pop("force")
        paths = list(_paths(values))
        inputs = [path for name, path in paths if not {OUTPUT, OUTPUT_FOLDER, NO_FILE} & set(marks[name])]
        for path in inputs:
            if path.exists() and not path.is_dir():  # what is not there, and folders, the command explains better
                check_regular(path)
        outputs = [path for name, path in paths if OUTPUT in marks[name]]
        for key, (kind, names) in groups.items():
            values[key] = kind(**{n: values.pop(n) for n in names})
        with output.run(inputs, outputs, overwrite=force):
            function(**values)

    del run.__wrapped__  # else the signature would be looked up there
    run.__signature__ = inspect.Signature(spread)  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in spread}
    app.command(name, epilog=f"[bold]Example:[/bold] {example}", help=inspect.getdoc(function))(run)


def _paths(values: Mapping[str, Any]) -> Iterator[tuple[str, Path]]:
    """Give each path among the options with the option's name."""
    for name, value in values.items():
        for one in value if isinstance(value, list | tuple) else [value]:
            if isinstance(one, Path):
                yield name, one


def _parameters(group: type) -> list[inspect.Parameter]:
    hints = get_type_hints(group, include_extras=True)
    keyword = inspect.Parameter.KEYWORD_ONLY
    return [
        inspect.Parameter(
            f.name,
            keyword,
            default=inspect.Parameter.empty if f.default is MISSING else f.default,
            annotation=hints[f.name],
        )
        for f in fields(group)
    ]
