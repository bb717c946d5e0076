"""Groups of command line options as dataclasses: each group is defined once and used by any number of commands."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from amiwarp.io import atomic_output as output
from amiwarp.io.regular_file import check_regular

OUTPUT = "output"
"""Mark in ``Annotated`` of an option that names a file to write. Paths without a mark are files to read."""
OUTPUT_FOLDER = "output folder"
"""Mark in ``Annotated`` of an option that names a folder to write to. The command itself checks the files in it."""

NO_FILE = "no file"
"""Mark in ``Annotated`` of an option with a path that is neither read nor written as a file."""

_FORCE = Annotated[
    bool,
    typer.Option(
        "--force", help="Replace existing output files. Input files are never replaced.", rich_help_panel="Common"
    ),
]


@dataclass(frozen=True)
class Common:
    """Options that every command has."""

    json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object on stdout and nothing else.", rich_help_panel="Common")
    ] = False
    device: Annotated[
        str | None,
        typer.Option(
            help="Device that runs the kernels: cpu, cuda:0 ... Default: cuda:0 if present, otherwise cpu.",
            rich_help_panel="Common",
        ),
    ] = None
    seed: Annotated[
        int, typer.Option(min=0, max=2**31 - 1, help="Seed of the random number generators.", rich_help_panel="Common")
    ] = 0


def command(app: typer.Typer, function: Callable[..., None], *, name: str, example: str) -> None:
    """Register ``function`` as a subcommand. Each field of a dataclass parameter becomes an option."""
    hints = get_type_hints(function, include_extras=True)
    parameters: list[inspect.Parameter] = []
    groups: dict[str, tuple[type, list[str]]] = {}
    for parameter in inspect.signature(function).parameters.values():
        kind = hints[parameter.name]
        if is_dataclass(kind) and isinstance(kind, type):
            parameters += _option_parameters(kind)
            groups[parameter.name] = (kind, [f.name for f in fields(kind)])
        else:
            parameters.append(parameter.replace(annotation=kind, kind=inspect.Parameter.KEYWORD_ONLY))
    marks = {p.name: getattr(p.annotation, "__metadata__", ()) for p in parameters}
    writes = any(OUTPUT in mark or OUTPUT_FOLDER in mark for mark in marks.values())
    if writes:
        parameters.append(inspect.Parameter("force", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=_FORCE))

    @functools.wraps(function)
    def run(**values: Any) -> None:
        force = writes and values.pop("force")
        paths = list(_paths(values))
        inputs = [path for name, path in paths if not {OUTPUT, OUTPUT_FOLDER, NO_FILE} & set(marks[name])]
        for path in inputs:
            if path.exists() and not path.is_dir():  # the command itself reports missing files and folders
                check_regular(path)
        outputs = [path for name, path in paths if OUTPUT in marks[name]]
        for key, (kind, names) in groups.items():
            values[key] = kind(**{n: values.pop(n) for n in names})
        with output.run(inputs, outputs, overwrite=force):
            function(**values)

    del run.__wrapped__  # otherwise Typer would read the signature of ``function``
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in parameters}
    app.command(name, epilog=f"[bold]Example:[/bold] {example}", help=inspect.getdoc(function))(run)


def _paths(values: Mapping[str, Any]) -> Iterator[tuple[str, Path]]:
    """Yield every path among the values of the options, with the option's name."""
    for name, value in values.items():
        for one in value if isinstance(value, list | tuple) else [value]:
            if isinstance(one, Path):
                yield name, one


def _option_parameters(group: type) -> list[inspect.Parameter]:
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
