"""What the commands of live streams share: event source, link to the controller, status line, end of a session."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.live import Live
from rich.text import Text

from amiwarp.cli import say
from amiwarp.errors import AmiwarpError, ErrorCode, printable
from amiwarp.events.encoder_stream import LARGEST_RATIO
from amiwarp.live.link.link import Link
from amiwarp.validation import real

if TYPE_CHECKING:
    from amiwarp.live.stream.packets import Source
    from amiwarp.live.stream.session_status import SessionStatus
    from amiwarp.live.stream.sinks import Sink
    from amiwarp.results.calibration import Calibration


_in_source = partial(typer.Option, rich_help_panel="Source")
SourceArgument = Annotated[
    str,
    typer.Argument(
        help="Source: camera:, camera:SERIAL or camera:MODEL, dv, prophesee (each also with settings: "
        "camera:evk4,diff_on=20,region=LEFT:TOP:RIGHT:BOTTOM,masked=X:Y+X:Y,most_mev_s=N,trigger=on,settings=FILE), "
        "tcp:HOST:PORT, unix:PATH, shm:NAME (shared memory), udp:HOST:PORT, '-' (standard input), or a file to replay."
    ),
]
SecondRatio = Annotated[
    float | None,
    _in_source(
        "--second-ratio",
        help="Speed of the second prism of a Risley pair relative to the first, if both are geared and only the first "
        "has an encoder.",
    ),
]
"""Option ``--second-ratio``."""


@dataclass(frozen=True)
class SourceOptions:
    """Options for the source of events and of prism angles."""

    port: Annotated[
        str | None,
        _in_source(
            help="Serial port of the prism's controller: name, USB id VID:PID, or 'find'. Default: none; the encoder "
            "samples of the source are used."
        ),
    ] = None
    counts_per_turn: Annotated[
        int | None,
        _in_source(min=1, help="Encoder counts per turn, if the controller sends lines of text."),
    ] = None
    fast: Annotated[
        bool, _in_source("--fast", help="Replay a file as fast as possible, not in real time.")
    ] = False
    seconds: Annotated[
        float | None,
        typer.Option(
            min=0.001,
            help="Stop after this time (s). Default: at the end of the source or at Ctrl-C.",
        ),
    ] = None

    wait_for_source: Annotated[
        float,
        _in_source(
            min=0.0,
            help="Longest wait for the sender of a stream, or for a camera, to return after its stream breaks off "
            "(s); 0: do not wait.",
        ),
    ] = 0.0

    def __post_init__(self) -> None:
        if self.counts_per_turn is not None and self.port is None:
            raise AmiwarpError(
                "--counts-per-turn applies to a controller; give its --port, or remove the option",
                ErrorCode.OPTIONS,
            )

    def open(self, spec: str, say: Callable[[str], None]) -> Source:
        """Open the source named ``spec``. ``say`` is called with its messages."""
        from amiwarp.live.stream.sources import open_source

        return open_source(
            spec, pace=None if self.fast else 1.0, wait_s=self.wait_for_source, say=say
        )

    @contextlib.contextmanager
    def link(self) -> Iterator[Link | None]:
        """Open the link to the controller while the ``with`` block runs; None if no port is given."""
        if self.port is None:
            yield None
            return
        with Link(
            None if self.port == "find" else self.port, counts_per_turn=self.counts_per_turn
        ) as link:
            yield link


@contextlib.contextmanager
def stopped_by_interrupt(stop: threading.Event) -> Iterator[None]:
    """Let SIGINT (Ctrl-C) and SIGTERM set ``stop`` in a ``with`` block; a second signal raises KeyboardInterrupt."""

    def interrupted(number: int, frame: Any) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    before = {
        number: signal.signal(number, interrupted) for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class StatusLine:
    """Status of a session on one line of stderr, below its messages. Without a terminal only messages are printed."""

    def __init__(self) -> None:
        self._console = Console(stderr=True, highlight=False)
        self._live = Live(console=self._console, refresh_per_second=5, transient=True)
        self.messages: deque[str] = deque(maxlen=1000)
        """Most recent messages that were printed."""

    def __enter__(self) -> StatusLine:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._console.is_terminal:
            self._live.stop()

    def say(self, message: str) -> None:
        """Print a message above the status line and keep it in :attr:`messages`."""
        self.messages.append(message)
        if self._console.is_terminal:
            self._console.print(printable(message), markup=False)
        else:
            say(message)

    def update(self, status: SessionStatus) -> None:
        """Show ``status``."""
        if self._console.is_terminal:
            self._live.update(
                Text(describe(status, self._console.width), no_wrap=True, overflow="ellipsis")
            )

    def report_lost_packets(self, *sinks: Sink | None) -> None:
        """Print for each sink how many packets its receivers missed."""
        for sink in sinks:
            if sink is not None and sink.lost:
                self.say(
                    f"{sink.lost:,} packets were not sent: a receiver, or the network, is too slow"
                )


def describe(status: SessionStatus, width: int = 80) -> str:
    """Return the text of the status line: the most important figures that fit into ``width`` characters."""
    losses = []
    for count, what in (
        (status.dropped, "dropped"),
        (status.late, "late"),
        (status.waiting, "waiting"),
    ):
        if count:
            losses.append(f"{count:,} {what}")

    # The most important figures first: the last ones are left out on a narrow terminal.
    parts = [f"{status.seconds:.1f} s", f"{status.rate_mev_s:.2f} Mev/s", *losses[:2]]
    if status.done:
        parts.append(f"latency {status.latency_ms[0]:.1f} ms")
    names = [stage.name for stage in status.stages]
    if status.done and (not names or "compensate" in names):
        parts.append(f"encoder {100.0 * status.covered:.1f} %")
    for stage in status.stages:
        if stage.name == "filter" and stage.received:
            parts.append(f"filter keeps {100.0 * stage.passed / stage.received:.0f} %")
    if status.rpm is not None:
        parts.append(f"{status.rpm:.0f} rpm")
    if status.sharpness is not None:
        parts.append(f"sharpness {status.sharpness:.2f}")
    if status.coverage is not None:
        parts.append(f"edges {100.0 * status.coverage:.0f} %")
    parts += [f"{status.events:,} events", *losses[2:]]
    if status.clock is not None:
        parts.append(f"clocks ±{status.clock.offset_std_us:.0f} µs by {status.clock_source}")
    elif status.clock_source is not None:
        parts.append("clocks unknown")
    while len(", ".join(parts)) > width:
        parts.pop()
    return ", ".join(parts)


def check_angles(source: Source, link: Link | None, second_ratio: float | None = None) -> int:
    """Return the number of prism angles that the source, or the controller, and a ratio of speeds provide: 1 or 2.

    Raises :class:`AmiwarpError` if there is none, or if the ratio contradicts the source's second encoder.
    """
    from amiwarp.live.stream.encoder_feed import encoder_count

    count = encoder_count(source, link)
    if not count:
        raise AmiwarpError(
            f"{source.name}: contains no encoder samples; give the controller's --port",
            ErrorCode.CONTENT_MISSING,
        )
    if second_ratio is None:
        return count
    if count == 2:
        raise AmiwarpError(
            f"{source.name}: contains the samples of both encoders; leave --second-ratio out",
            ErrorCode.OPTIONS,
        )
    real(second_ratio, "--second-ratio", -LARGEST_RATIO, LARGEST_RATIO)
    return 2


def check_model(source: Source, link: Link | None, angles: int, calibration: Calibration) -> None:
    """Raise :class:`AmiwarpError` unless the number of angles that a session has is the calibrated model's."""
    model = calibration.model
    if angles == model.ANGLES:
        return
    if model.ANGLES == 1:
        raise AmiwarpError(
            f"{source.name}: there are two prism angles, but the calibrated model, {calibration.model_name}, has one; "
            "give a calibration of a pair of prisms or of a mirror, made from a recording with both encoders"
        )
    remedy = "give a source with the samples of both encoders ('encoders' in docs/reference/stream-format.md)"
    if source.encoders == 2:
        remedy = "leave --port out to take the samples of the source"
    name = source.name if link is None else link.name
    raise AmiwarpError(
        f"{name}: there are samples of one encoder, but the calibration belongs to a {model.TEXT}, which has two "
        f"angles; {remedy}, or --second-ratio if both are geared"
    )


def check_whole(source: Source, status: SessionStatus) -> None:
    """Raise :class:`AmiwarpError` if the stream broke off. Call this function after the files are complete."""
    from amiwarp.live.stream.returning_source import can_return

    problem = getattr(source, "problem", None)
    if problem is None:
        return
    waits = "; --wait-for-source S waits for it to return"
    hint = waits if can_return(source.name) and not hasattr(source, "returns") else ""
    kept = f"the {status.events:,} events received until then are kept"
    raise AmiwarpError(
        f"{source.name}: the stream broke off: {problem}; {kept}{hint}", ErrorCode.UNREACHABLE
    )


def session_summary(status: SessionStatus, source: Source) -> dict[str, Any]:
    """Return the counts of a session for ``--json``."""
    return {
        "seconds": status.seconds,
        "events": status.events,
        "mev_per_s": status.events / max(status.seconds, 1e-9) / 1e6,
        "compensated": status.done,
        "outside": status.outside,
        "extrapolated": status.guessed,
        "without_angle": status.unknown,
        "dropped": status.dropped,
        "late": status.late,
        "returns": getattr(source, "returns", 0),
        "lost_usb_packets": getattr(source, "lost", 0),
        "lost_packets": getattr(source, "lost_packets", 0),
        "broke_off": getattr(source, "problem", None),
        "clock": None if status.clock_source is None else _clock_summary(status),
    }


def lost_lines(result: dict[str, Any]) -> list[str]:
    """Return the line of the result about packets that were lost between the sender and this program."""
    lost = result["lost_packets"]
    if not lost:
        return []
    return [f"{lost:,} packets of the source were lost: this computer, or the network, is too slow"]


def _clock_summary(status: SessionStatus) -> dict[str, Any]:
    """Return how the clocks of controller and camera are related, and within what [us]."""
    source = str(status.clock_source)
    clock = status.clock
    if clock is None:
        return {"from": source, "uncertainty_us": None, "pulses": 0}
    return {"from": source, "uncertainty_us": clock.offset_std_us, "pulses": clock.pairs}


def recorded_from(source: Source) -> dict[str, Any]:
    """Return the metadata of a recording that name the source, its camera and its optic."""
    return {"recorded_from": source.name, **getattr(source, "metadata", {})}
