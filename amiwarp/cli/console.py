"""Functions that all commands use: choice of the device, progress bar, printed result."""

import contextlib
import json
import math
import sys
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import rich.progress
from rich.console import Console
from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from amiwarp.cli.options import Common
from amiwarp.errors import AmiwarpError, printable
from amiwarp.progress import Progress


def choose_device(name: str | None) -> str:
    """Initialise Warp and return the device to run on.

    Raises :class:`AmiwarpError` if the named device is not available.
    """
    from amiwarp.kernels.launch import start_quietly

    known = start_quietly()
    chosen = name or ("cuda:0" if "cuda:0" in known else "cpu")
    if chosen not in known:
        raise AmiwarpError(f"device {chosen!r} is not available; choose one of {', '.join(known)}")
    return chosen


@contextlib.contextmanager
def progress(what: str, *, average_s: float = 30.0) -> Iterator[Progress]:
    """Show a progress bar on stderr and remove it at the end. Print nothing if stderr is not a terminal.

    The remaining time follows from the mean speed of the last ``average_s`` [s].
    """
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with rich.progress.Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal, speed_estimate_period=average_s
    ) as bar:
        task = bar.add_task(printable(what), total=1.0)
        yield lambda what, share: bar.update(task, completed=share, description=printable(what))


def report(common: Common, data: dict[str, Any], lines: Iterable[str | Table]) -> None:
    """Print the result: ``data`` as one JSON object with ``--json``, otherwise ``lines`` as text.

    Each string in ``lines`` is printed as a single line, see :func:`printable`. In JSON, numbers that are not finite
    become null.
    """
    if common.json:
        print(json.dumps(plain(data), allow_nan=False), flush=True)
        return
    # Lines are not wrapped if stdout is a file or a pipe.
    console = Console(highlight=False, width=None if sys.stdout.isatty() else 1000)
    with console.capture() as text:
        for line in lines:
            console.print(printable(line) if isinstance(line, str) else line, markup=False)
    print("\n".join(row.rstrip() for row in text.get().splitlines()), flush=True)


def plain(value: Any) -> Any:
    """Convert ``value`` to types that JSON supports. Numbers that are not finite become None."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "item"):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, str | int | float | bool | None) else str(value)


def made_again(damaged: Sequence[str]) -> list[str]:
    """Return a line of text about damaged files of an earlier run that were made again; none without such files."""
    more = f", and {len(damaged) - 1:,} more" if len(damaged) > 1 else ""
    return [f"damaged, and made again: {damaged[0]}{more}"] if damaged else []


def table(rows: Iterable[tuple[str, ...]], *headings: str) -> Table:
    """Return a table without rules. Cells are shown without markup, see :func:`printable`."""
    from rich.text import Text

    grid = Table(box=None, show_header=bool(headings), pad_edge=False, header_style="bold")
    cells = [[Text(printable(cell)) for cell in row] for row in rows]
    for k in range(max((len(row) for row in cells), default=len(headings))):
        grid.add_column(headings[k] if headings else "", style="dim" if k == 0 and not headings else None)
    for row in cells:
        grid.add_row(*row)
    return grid
