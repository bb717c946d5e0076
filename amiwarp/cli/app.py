"""Application of the command line: registration of the subcommands, and exit codes for failures."""

import _thread
import importlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from typing import Any, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup

from amiwarp.cli import INTERRUPTED, STOPPED, fail
from amiwarp.errors import AmiwarpError
from amiwarp.workarounds import load_extensions_whole

BAD_INPUT = 1
"""Exit code for input that cannot be used."""
USAGE = 2
"""Exit code for a command line that is wrong."""
REPEAT_S = 0.05
"""Delay of a repeated interrupt [s], by when the finaliser that caught it has ended."""

_UsageError: Any = typer.BadParameter.__base__
"""Class ``UsageError`` of click, taken from Typer, because newer versions of Typer contain their own copy of click."""


class Command(NamedTuple):
    """Entry of the list of commands. Its texts are here so that ``amiwarp --help`` need not load the command."""

    package: str
    """Package whose module ``commands`` has the function ``run_NAME``, with ``_`` for a hyphen."""
    summary: str
    """First sentence of the help."""
    example: str
    """Example in the help."""


COMMANDS = {
    "demo": Command(
        "studies",
        "Simulate a recording, calibrate it without an initial guess, compensate it and reconstruct the picture.",
        "amiwarp demo --out amiwarp-demo",
    ),
    "warm-up": Command(
        "studies",
        "Compile the kernels of the ordinary commands in advance, for containers and continuous integration.",
        "amiwarp warm-up",
    ),
    "info": Command(
        "io",
        "Show a recording's format, events, encoder, camera, prism, IMU, frames, truth, repairs and assumptions.",
        "amiwarp info recording.h5",
    ),
    "view": Command(
        "viewer",
        "Show events in x, y and prism angle, recorded and compensated, and adjust the prism's parameters by hand.",
        "amiwarp view recording.h5 --calibration calibration.json",
    ),
    "render": Command(
        "plotting",
        "Write a film of a recording's events, with a prism or without, also in slow motion.",
        "amiwarp render events.raw slow.mp4 --speed 0.05 --window 1:1.5",
    ),
    "convert": Command(
        "io",
        "Convert a recording to amiwarp's HDF5 format, and add the encoder, camera and prism given by options.",
        "amiwarp convert events.raw recording.h5 --encoder encoder.csv --counts-per-turn 4096 --fov-deg 60",
    ),
    "filter": Command(
        "imaging",
        "Keep part of a recording: time, region, polarity; remove hot pixels, noise, and events beyond a rate.",
        "amiwarp filter events.raw calm.h5 --window 1:3 --background-ms 10 --hot-pixels",
    ),
    "simulate": Command(
        "simulation",
        "Simulate the recording of a picture or a world by an event camera behind the prism, with its ground truth.",
        "amiwarp simulate recording.h5 --picture photo.jpg --duration 0.5 --apex-deg 1 --rpm 720",
    ),
    "translate": Command(
        "simulation",
        "Simulate the recording of an event camera behind the prism from a video, pictures, or a plain event "
        "recording.",
        "amiwarp translate video.mp4 recording.h5 --apex-deg 1 --rpm 720",
    ),
    "dataset": Command(
        "learning",
        "Make thousands of simulated recordings from a specification, with labels, splits and a manifest.",
        "amiwarp dataset shapes.toml shapes --dry-run",
    ),
    "export": Command(
        "learning",
        "Export a data set to tar files for WebDataset, or to Parquet files for Hugging Face's datasets.",
        "amiwarp export shapes shapes-tars --to webdataset",
    ),
    "calibrate": Command(
        "calib",
        "Find the prism's parameters by contrast maximisation: those that make the image of warped events sharpest.",
        "amiwarp calibrate recording.h5 calibration.json --figure calibration.png",
    ),
    "lens": Command(
        "lens",
        "Calibrate the camera's lens, and the prism with it, from a printed board that stands still.",
        "amiwarp lens pose*.h5 camera.json --board 9x6 --square-mm 30 --calibration calibration.json",
    ),
    "board": Command(
        "lens",
        "Write a chessboard or ChArUco board in its true size, to print for a lens calibration.",
        "amiwarp board board.pdf --board 9x6 --square-mm 30",
    ),
    "compensate": Command(
        "compensation",
        "Compensate the prism's motion: move every event to its position without the prism.",
        "amiwarp compensate recording.h5 compensated.h5 --calibration calibration.json --iwe iwe.png",
    ),
    "reconstruct": Command(
        "reconstruction",
        "Reconstruct a picture of the scene from the events of a window, or a video from a sliding window.",
        "amiwarp reconstruct recording.h5 picture.png --calibration calibration.json --turns 1",
    ),
    "phase": Command(
        "reconstruction",
        "Write what whole turns tell of each pixel: the scene, its edges, its thresholds, and what moved.",
        "amiwarp phase recording.h5 calibration.json phase.npz --figure phase.png",
    ),
    "export-c": Command(
        "imaging",
        "Write the sums in phase as C for a microcontroller, with a test of its integers.",
        "amiwarp export-c phase-sums --size 32x32 --harmonics 5",
    ),
    "pixels": Command(
        "reconstruction",
        "Measure the ON and OFF threshold of every pixel, and find hot and dead pixels, from a calibrated recording.",
        "amiwarp pixels recording.h5 calibration.json pixels.npz",
    ),
    "depth": Command(
        "reconstruction",
        "Find the depth of every edge from a camera at rest behind a rotating tilted plate, with its uncertainty.",
        "amiwarp depth recording.h5 calibration.json depth.npz --ply points.ply --figure depth.png",
    ),
    "chart": Command(
        "studies.chart",
        "Measure speed and error of the settings on a recording with ground truth, and draw both Pareto fronts.",
        "amiwarp chart --out amiwarp-chart --budget-px 0.3",
    ),
    "design": Command(
        "studies",
        "Compare prisms and speeds for a camera, and recommend one with the reasons.",
        "amiwarp design --size 640x480 --fov-deg 60 --tolerance-px 0.5 --out amiwarp-design",
    ),
    "stability": Command(
        "studies.stability",
        "Calibrate simulated recordings under growing disturbances, and draw where calibration works and fails.",
        "amiwarp stability --quick --out amiwarp-atlas",
    ),
    "evaluate": Command(
        "studies.evaluate",
        "Check the AMI-EV paper's results: compare with a plain event camera on simulated worlds, and write a report.",
        "amiwarp evaluate --out evaluation --only texture",
    ),
    "bench": Command(
        "studies.bench",
        "Make the recordings of AMI-Bench, answer them by baselines, and score submissions.",
        "amiwarp bench --small",
    ),
    "truth": Command(
        "io",
        "Export the ground truth of a simulated world: optical flow in the DSEC or MVSEC format, poses as TUM files.",
        "amiwarp truth recording.h5 exported --flow dsec --poses tum",
    ),
    "motor": Command(
        "live",
        "Set the speed of the prism's motor, stop it, print the controller's status or settings, or check it.",
        "amiwarp motor set --port /dev/ttyACM0 --rpm 720",
    ),
    "record": Command(
        "live",
        "Record events and prism angles until the source ends, --seconds have passed, or Ctrl-C.",
        "amiwarp record dv recording.h5 --port find --seconds 10",
    ),
    "live": Command(
        "live",
        "Filter, compensate and undistort the events of a live stream, and show its figures on one line.",
        "amiwarp live dv --port find --calibration calibration.json --out compensated.h5",
    ),
    "emulate": Command(
        "live",
        "Emulate a prism controller with motor, encoder and index pulse, and inject faults on request.",
        "amiwarp emulate --link ./prism --rpm 720 --fault slip@5 --fault unplug@10+2",
    ),
}
"""Every command, in the order of the list of commands."""


def function_of(name: str) -> Callable[..., None]:
    """Load the module of a command and return the command's function."""
    module = importlib.import_module(f"amiwarp.{COMMANDS[name].package}.commands")
    function: Callable[..., None] = getattr(module, f"run_{name.replace('-', '_')}")
    return function


class _LoadedCommands(Mapping[str, Any]):
    """All commands by name. The module of a command is loaded when the command is taken from here."""

    def __getitem__(self, name: str) -> Any:
        if name not in COMMANDS:
            raise KeyError(name)
        return _loaded(name)

    def __iter__(self) -> Iterator[str]:
        return iter(COMMANDS)

    def __len__(self) -> int:
        return len(COMMANDS)


@cache
def _loaded(name: str) -> Any:
    """Load the module of a command and return the command."""
    from amiwarp.cli.common import command  # NumPy is loaded with it

    parent = typer.Typer(rich_markup_mode="rich", add_completion=False)
    command(parent, function_of(name), name=name, example=COMMANDS[name].example)
    return typer.main.get_command(parent)


class _Group(TyperGroup):
    """Command group that loads only the command that runs, and reports every failure as one line and an exit code."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.commands: Any = _LoadedCommands()

    def list_commands(self, ctx: Any) -> list[str]:
        return list(COMMANDS)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help with the summaries, without loading the commands."""
        # TyperGroup takes the help of each command from here.
        self.commands = {
            name: TyperCommand(name, help=command.summary) for name, command in COMMANDS.items()
        }
        try:
            super().format_help(ctx, formatter)
        finally:
            self.commands = _LoadedCommands()

    def main(self, *args: Any, **extra: Any) -> Any:
        extra["standalone_mode"] = False  # click would print errors and exit by itself
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
    ctx: typer.Context,
    version: bool = typer.Option(False, "--version", help="Print the version and exit."),
) -> None:
    if version:
        import amiwarp

        print(amiwarp.__version__)
    elif ctx.invoked_subcommand is None:
        print(ctx.get_help())


def main() -> None:
    """Run the command line and exit the process."""
    sys.unraisablehook = _repeat_dropped_interrupt
    load_extensions_whole()
    app(prog_name="amiwarp")


def _repeat_dropped_interrupt(unraisable: Any) -> None:
    """Repeat a Ctrl-C that Python dropped because it arrived inside a finaliser."""
    if not issubclass(unraisable.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(unraisable)
        return
    timer = threading.Timer(REPEAT_S, _interrupt)
    timer.daemon = True
    timer.start()


def _interrupt() -> None:
    """Interrupt the main thread, even while it waits in a blocking call."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
    else:
        _thread.interrupt_main()
