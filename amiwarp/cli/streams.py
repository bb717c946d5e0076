"""Functions that ``record`` and ``live`` share: event source, link to the controller, status line, end of session."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.live import Live
from rich.text import Text

from amiwarp.cli import say
from amiwarp.errors import AmiwarpError, printable
from amiwarp.live.link.link import Link

if TYPE_CHECKING:
    from amiwarp.live.stream.packets import Source
    from amiwarp.live.stream.socket_sinks import PipeSink, SocketSink
    from amiwarp.live.stream.status import SessionStatus

_SOURCE = "Source"


@dataclass(frozen=True)
class SourceOptions:
    """Options for the source of events and of prism angles."""

    port: Annotated[
        str | None,
        typer.Option(
            help="Serial port of the prism's controller: name, USB id VID:PID, or 'find'. Default: none; the encoder "
            "samples of the source are used.",
            rich_help_panel=_SOURCE,
        ),
    ] = None
    counts_per_turn: Annotated[
        int | None,
        typer.Option(
            min=1, help="Encoder counts per turn, if the controller sends lines of text.", rich_help_panel=_SOURCE
        ),
    ] = None
    fast: Annotated[
        bool,
        typer.Option("--fast", help="Replay a file as fast as possible, not in real time.", rich_help_panel=_SOURCE),
    ] = False
    seconds: Annotated[
        float | None,
        typer.Option(min=0.001, help="Stop after this time (s). Default: at the end of the source or at Ctrl-C."),
    ] = None

    wait_for_source: Annotated[
        float,
        typer.Option(
            min=0.0,
            help="Longest wait for the sender to return after a socket's stream breaks off (s); 0: do not wait.",
            rich_help_panel=_SOURCE,
        ),
    ] = 0.0

    def open(self, spec: str, say: Callable[[str], None]) -> Source:
        """Open the source named ``spec``. ``say`` is called with its messages."""
        from amiwarp.live.stream.source_opening import open_source

        return open_source(spec, pace=None if self.fast else 1.0, wait_s=self.wait_for_source, say=say)

    @contextlib.contextmanager
    def link(self) -> Iterator[Link | None]:
        """Open the link to the controller while the ``with`` block runs; None if no port is given."""
        if self.port is None:
            yield None
            return
        with Link(None if self.port == "find" else self.port, counts_per_turn=self.counts_per_turn) as link:
            yield link


@contextlib.contextmanager
def stopped_by_interrupt(stop: threading.Event) -> Iterator[None]:
    """Let SIGINT (Ctrl-C) and SIGTERM set ``stop`` in a ``with`` block; a second signal raises KeyboardInterrupt."""

    def interrupted(number: int, frame: Any) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    before = {number: signal.signal(number, interrupted) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class StatusLine:
    """Status of a session on one line of stderr, below its messages. Without a terminal only messages are printed."""

    def __init__(self, stop: threading.Event, seconds: float | None) -> None:
        self._stop, self._seconds = stop, seconds
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
        """Show ``status``, and request the end of the session once ``seconds`` have passed."""
        if self._seconds is not None and status.seconds >= self._seconds:
            self._stop.set()
        if self._console.is_terminal:
            self._live.update(Text(describe(status, self._console.width), no_wrap=True, overflow="ellipsis"))

    def report_lost_packets(self, *sinks: SocketSink | PipeSink | None) -> None:
        """Print for each sink how many packets its receivers missed."""
        for sink in sinks:
            if sink is not None and sink.lost:
                self.say(f"{sink.lost:,} packets were not sent: a receiver is too slow")


def describe(s: SessionStatus, width: int = 80) -> str:
    """Return the text of the status line: the most important figures that fit into ``width`` characters."""
    lost = [f"{n:,} {what}" for n, what in ((s.dropped, "dropped"), (s.late, "late"), (s.waiting, "waiting")) if n]
    parts = [f"{s.seconds:.1f} s", f"{s.rate_mev_s:.2f} Mev/s", *lost[:2]]
    if s.done:
        parts += [f"latency {s.latency_ms[0]:.1f} ms", f"encoder {100.0 * s.covered:.1f} %"]
    parts += [] if s.rpm is None else [f"{s.rpm:.0f} rpm"]
    parts += [] if s.sharpness is None else [f"sharpness {s.sharpness:.2f}"]
    parts += [] if s.coverage is None else [f"edges {100.0 * s.coverage:.0f} %"]
    parts += [f"{s.events:,} events", *lost[2:]]
    parts += [] if s.clock is None else [f"clocks ±{s.clock.offset_std_us:.0f} µs"]
    while len(", ".join(parts)) > width:
        parts.pop()
    return ", ".join(parts)


def check_angles(source: Source, link: Link | None) -> None:
    """Raise :class:`AmiwarpError` if neither the source nor a controller provides prism angles."""
    if link is None and not source.has_encoder:
        raise AmiwarpError(f"{source.name}: contains no encoder samples; give the controller's --port")


def check_whole(source: Source, status: SessionStatus) -> None:
    """Raise :class:`AmiwarpError` if the stream broke off. Call this function after the files are complete."""
    problem = getattr(source, "problem", None)
    if problem is None:
        return
    socket = source.name.partition(":")[0].removesuffix("-listen") in ("tcp", "unix")
    hint = "; --wait-for-source S waits for the sender to return" if socket and not hasattr(source, "returns") else ""
    kept = f"the {status.events:,} events received until then are kept"
    raise AmiwarpError(f"{source.name}: the stream broke off: {problem}; {kept}{hint}")


def summary(s: SessionStatus, source: Source) -> dict[str, Any]:
    """Return the counts of a session for ``--json``."""
    return {
        "seconds": s.seconds, "events": s.events, "mev_per_s": s.events / max(s.seconds, 1e-9) / 1e6,
        "compensated": s.done, "outside": s.outside, "extrapolated": s.guessed, "without_angle": s.unknown,
        "dropped": s.dropped, "late": s.late, "returns": getattr(source, "returns", 0),
        "broke_off": getattr(source, "problem", None),
    }  # fmt: skip
