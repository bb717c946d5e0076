"""Options as dataclasses: each group is written once, and a command takes as many groups as it needs."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields, is_dataclass
from typing import Annotated, Any, get_type_hints

import typer


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

    @functools.wraps(function)
    def run(**values: Any) -> None:
        for key, (kind, names) in groups.items():
            values[key] = kind(**{n: values.pop(n) for n in names})
        function(**values)

    del run.__wrapped__  # else the signature would be looked up there
    run.__signature__ = inspect.Signature(spread)  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in spread}
    app.command(name, epilog=f"[bold]Example:[/bold] {example}", help=inspect.getdoc(function))(run)


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
