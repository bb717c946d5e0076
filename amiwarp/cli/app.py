"""Application of the command line: registration of the subcommands, and exit codes for failures."""

from __future__ import annotations

import _thread
import signal
import sys
import threading
from typing import Any

import typer
from typer.core import TyperGroup

from amiwarp.cli import (
    INTERRUPTED,
    STOPPED,
    calibrate,
    chart,
    compensate,
    convert,
    dataset,
    demo,
    design,
    emulate,
    evaluate,
    fail,
    info,
    live,
    motor,
    reconstruct,
    record,
    simulate,
    stability,
    translate,
    truth,
    view,
)
from amiwarp.cli.options import command
from amiwarp.errors import AmiwarpError

BAD_INPUT, USAGE = 1, 2

_UsageError: Any = typer.BadParameter.__base__
"""Class ``UsageError`` of click, taken from Typer, because newer versions of Typer contain their own copy of click."""


class _Group(TyperGroup):
    """Command group that reports every failure as one line on stderr and an exit code."""

    def main(self, *args: Any, **extra: Any) -> Any:
        extra["standalone_mode"] = False
        try:
            code = super().main(*args, **extra)
        except _UsageError as error:
            path = error.ctx.command_path if error.ctx else "amiwarp"
            fail(USAGE, f"{error.format_message().rstrip('.')}; see {path} --help")
        except (AmiwarpError, OSError) as error:
            fail(BAD_INPUT, str(error))
        except (KeyboardInterrupt, typer.Abort):
            code = INTERRUPTED
        if code == INTERRUPTED:
            fail(INTERRUPTED, STOPPED)
        sys.exit(code if isinstance(code, int) else 0)


app = typer.Typer(
    cls=_Group,
    name="amiwarp",
    help="Compensate the motion of a rotating wedge prism in the events of the camera behind it.",
    epilog="Start with: amiwarp demo",
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback(invoke_without_command=True)
def _version(
    ctx: typer.Context, version: bool = typer.Option(False, "--version", help="Print the version and exit.")
) -> None:
    if version:
        import amiwarp

        print(amiwarp.__version__)
    elif ctx.invoked_subcommand is None:
        print(ctx.get_help())


for module in (
    demo, info, view, convert, simulate, translate, dataset, calibrate, compensate, reconstruct, chart, design,
    stability, evaluate, truth, motor, record, live, emulate,
):  # fmt: skip
    command(app, module.run, name=module.__name__.rpartition(".")[2], example=module.EXAMPLE)


def main() -> None:
    """Run the command line and exit the process."""
    sys.unraisablehook = _repeat_dropped_interrupt
    app(prog_name="amiwarp")


def _repeat_dropped_interrupt(unraisable: Any) -> None:
    """Repeat a Ctrl-C that Python dropped because it arrived inside a finaliser."""
    if not issubclass(unraisable.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(unraisable)
        return
    timer = threading.Timer(0.05, _interrupt)
    timer.daemon = True
    timer.start()


def _interrupt() -> None:
    """Interrupt the main thread, even while it waits in a blocking call."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
    else:
        _thread.interrupt_main()
