"""Camera, motor and encoder: ``amiwarp live``, ``record``, ``motor`` and ``emulate``, the rig's emulator."""

from __future__ import annotations

import contextlib
import enum
import math
import re
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.live import Live
from rich.text import Text

from amiwarp.cli import common as cli
from amiwarp.cli import say
from amiwarp.errors import AmiwarpError, printable
from amiwarp.events.encoder import LARGEST_RATIO
from amiwarp.events.recording import Recording
from amiwarp.io import open_recording
from amiwarp.io.native_format import LiveWriter
from amiwarp.live.link.clocks import monotonic_us
from amiwarp.live.link.emulator import Controller, EmulatedFault, Motor, Played, PseudoTerminal, Rotor
from amiwarp.live.link.link import Link
from amiwarp.live.link.protocol import FAULTS, SETTINGS, STATES, STORED
from amiwarp.live.queues import Policy
from amiwarp.live.stream.adaptive import SpeedController, SpeedKeeper, prism_orbit
from amiwarp.validation import real

if TYPE_CHECKING:
    from amiwarp.calib.result import Calibration
    from amiwarp.compensation.streams import Compensated
    from amiwarp.live.stream.packets import Source
    from amiwarp.live.stream.session import RawConsumer, Session, SessionStatus
    from amiwarp.live.stream.sockets import PipeSink, SocketSink
    from amiwarp.live.stream.sources import EmulatedCamera
    from amiwarp.optics.models import Model
    from amiwarp.optics.prism import NominalPrism
    from amiwarp.plotting.viewers import LiveViewer

# Functions that ``record`` and ``live`` share: event source, link to the controller, status line, end of session.

_in_source = partial(typer.Option, rich_help_panel="Source")
SourceArgument = Annotated[
    str,
    typer.Argument(
        help="Source: camera:, camera:SERIAL or camera:MODEL, dv, prophesee (each also with settings: "
        "camera:evk4,diff_on=20,region=LEFT:TOP:RIGHT:BOTTOM,masked=X:Y+X:Y,most_mev_s=N,trigger=on,settings=FILE), "
        "tcp:HOST:PORT, unix:PATH, '-' for standard input, or a file to replay."
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
        int | None, _in_source(min=1, help="Encoder counts per turn, if the controller sends lines of text.")
    ] = None
    fast: Annotated[bool, _in_source("--fast", help="Replay a file as fast as possible, not in real time.")] = False
    seconds: Annotated[
        float | None,
        typer.Option(min=0.001, help="Stop after this time (s). Default: at the end of the source or at Ctrl-C."),
    ] = None

    wait_for_source: Annotated[
        float,
        _in_source(
            min=0.0,
            help="Longest wait for the sender of a socket, or for a camera, to return after its stream breaks off "
            "(s); 0: do not wait.",
        ),
    ] = 0.0

    def __post_init__(self) -> None:
        if self.counts_per_turn is not None and self.port is None:
            raise AmiwarpError("--counts-per-turn applies to a controller; give its --port, or remove the option")

    def open(self, spec: str, say: Callable[[str], None]) -> Source:
        """Open the source named ``spec``. ``say`` is called with its messages."""
        from amiwarp.live.stream.sources import open_source

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
    parts += [] if s.clock is None else [f"clocks ±{s.clock.offset_std_us:.0f} µs by {s.clock_source}"]
    parts += ["clocks unknown"] if s.clock is None and s.clock_source is not None else []
    while len(", ".join(parts)) > width:
        parts.pop()
    return ", ".join(parts)


def check_angles(source: Source, link: Link | None, second_ratio: float | None = None) -> int:
    """Return the number of prism angles that the source, or the controller, and a ratio of speeds provide: 1 or 2.

    Raises :class:`AmiwarpError` if there is none, or if the ratio contradicts the source's second encoder.
    """
    from amiwarp.live.stream.session import encoder_count

    count = encoder_count(source, link)
    if not count:
        raise AmiwarpError(f"{source.name}: contains no encoder samples; give the controller's --port")
    if second_ratio is None:
        return count
    if count == 2:
        raise AmiwarpError(f"{source.name}: contains the samples of both encoders; leave --second-ratio out")
    real(second_ratio, "--second-ratio", -LARGEST_RATIO, LARGEST_RATIO)
    return 2


def check_model(source: Source, link: Link | None, angles: int, found: Calibration) -> None:
    """Raise :class:`AmiwarpError` unless the number of angles that a session has is that of the calibrated model."""
    if angles == found.model.ANGLES:
        return
    if found.model.ANGLES == 1:
        raise AmiwarpError(
            f"{source.name}: there are two prism angles, but the calibrated model, {found.model_name}, has one; give a "
            "calibration of a pair of prisms or of a mirror, made from a recording with both encoders"
        )
    what = f"the calibration is that of a {found.model.TEXT}"
    other = (
        "leave --port out to take the samples of the source"
        if source.encoders == 2
        else ("give a source with the samples of both encoders ('encoders' in docs/reference/stream-format.md)")
    )
    name = source.name if link is None else link.name
    raise AmiwarpError(
        f"{name}: there are samples of one encoder, but {what}, which has two angles; {other}, or --second-ratio if "
        "both are geared"
    )


def check_whole(source: Source, status: SessionStatus) -> None:
    """Raise :class:`AmiwarpError` if the stream broke off. Call this function after the files are complete."""
    from amiwarp.live.stream.sources import can_return

    problem = getattr(source, "problem", None)
    if problem is None:
        return
    waits = "; --wait-for-source S waits for it to return"
    hint = waits if can_return(source.name) and not hasattr(source, "returns") else ""
    kept = f"the {status.events:,} events received until then are kept"
    raise AmiwarpError(f"{source.name}: the stream broke off: {problem}; {kept}{hint}")


def session_summary(s: SessionStatus, source: Source) -> dict[str, Any]:
    """Return the counts of a session for ``--json``."""
    return {
        "seconds": s.seconds, "events": s.events, "mev_per_s": s.events / max(s.seconds, 1e-9) / 1e6,
        "compensated": s.done, "outside": s.outside, "extrapolated": s.guessed, "without_angle": s.unknown,
        "dropped": s.dropped, "late": s.late, "returns": getattr(source, "returns", 0),
        "lost_usb_packets": getattr(source, "lost", 0), "broke_off": getattr(source, "problem", None),
        "clock": None if s.clock_source is None else _clock_summary(s),
    }  # fmt: skip


def _clock_summary(s: SessionStatus) -> dict[str, Any]:
    """Return how the clocks of controller and camera are related, and within what [us]."""
    source, clock = str(s.clock_source), s.clock
    if clock is None:
        return {"from": source, "uncertainty_us": None, "pulses": 0}
    return {"from": source, "uncertainty_us": clock.offset_std_us, "pulses": clock.pairs}


# ``amiwarp live``: motion compensation of a live stream.

_in_adaptive = partial(typer.Option, rich_help_panel="Adaptive speed")
_in_outputs = partial(typer.Option, rich_help_panel="Outputs")
LEAST_RPM, MOST_RPM = 120.0, 1440.0
"""Lowest and highest speed that adaptive control may set, by default [turns/min]."""
START_RPM = 720.0
"""Speed at which adaptive control begins [turns/min], limited to the speeds that the options allow."""


@dataclass(frozen=True)
class AdaptiveOptions:
    """Options for setting the prism's speed from the stream."""

    adaptive: Annotated[
        bool, _in_adaptive("--adaptive", help="Set the prism's speed automatically: just fast enough to see the edges.")
    ] = False
    least_rpm: Annotated[float, _in_adaptive(min=1.0, help="Lowest speed allowed (turns/min).")] = LEAST_RPM
    limit_rpm: Annotated[float, _in_adaptive(min=1.0, help="Highest speed allowed (turns/min).")] = MOST_RPM
    most_mev_s: Annotated[
        float | None, _in_adaptive(min=0.001, help="Highest event rate allowed (million events/s). Default: any.")
    ] = None

    def __post_init__(self) -> None:
        if not self.adaptive and (self.least_rpm, self.limit_rpm, self.most_mev_s) != (LEAST_RPM, MOST_RPM, None):
            raise AmiwarpError("--least-rpm, --limit-rpm and --most-mev-s apply to --adaptive; add it, or remove them")
        if not self.least_rpm <= self.limit_rpm < math.inf:
            raise AmiwarpError(
                f"--least-rpm {self.least_rpm:g} .. --limit-rpm {self.limit_rpm:g} is no range of speeds; give a "
                "lowest speed that is not above the highest one"
            )

    def build(self, model: Model, link: Link | None, say: Callable[[str], None]) -> SpeedKeeper | None:
        """Set the motor's first speed and return the speed control; None without ``--adaptive``."""
        if not self.adaptive:
            return None
        if model.ANGLES > 1:
            raise AmiwarpError(f"--adaptive sets the speed of one prism, the calibration is that of a {model.TEXT}")
        if link is None:
            raise AmiwarpError("--adaptive sets the motor's speed; give the controller's --port")
        rpm = min(max(START_RPM, self.least_rpm), self.limit_rpm)
        most = float("inf") if self.most_mev_s is None else self.most_mev_s
        orbit = prism_orbit(model)
        limits = SpeedController(orbit, rpm, least_rpm=self.least_rpm, most_rpm=self.limit_rpm, most_mev_s=most)
        link.set_speed(rpm, limits.ramp_rpm_s)
        return SpeedKeeper(model, limits, link.set_speed, say)


@dataclass(frozen=True)
class OutputOptions:
    """Options for the files and addresses that receive events."""

    out: Annotated[Path | None, _in_outputs(help="Compensated recording to write (.h5)."), cli.OUTPUT] = None
    record: Annotated[
        Path | None, _in_outputs(help="Recording of the uncompensated events to write (.h5)."), cli.OUTPUT
    ] = None
    to: Annotated[
        str | None,
        _in_outputs(
            help="Address to serve compensated packets at: tcp:HOST:PORT, unix:PATH, or - for standard output.",
            metavar="ADDRESS",
        ),
    ] = None
    raw_to: Annotated[
        str | None,
        _in_outputs(
            help="Address to serve the uncompensated packets at, for example for 'amiwarp view --live'.",
            metavar="ADDRESS",
        ),
    ] = None
    rerun: Annotated[
        str | None,
        _in_outputs(
            help="Show images of the events in the viewer Rerun: spawn starts it, HOST:PORT is one that runs.",
            metavar="ADDRESS",
        ),
    ] = None
    foxglove: Annotated[
        str | None,
        _in_outputs(
            help="Address to serve images of the events at for Foxglove, which connects to ws://HOST:PORT.",
            metavar="HOST:PORT",
        ),
    ] = None

    @property
    def files(self) -> list[str]:
        """Names of the recordings to write."""
        return [str(path) for path in (self.record, self.out) if path is not None]

    @property
    def use_stdout(self) -> bool:
        """Whether packets go to standard output."""
        return "-" in (self.to, self.raw_to)

    def check(self, *, json: bool) -> None:
        """Raise :class:`AmiwarpError` if packets and something else would go to standard output."""
        if self.to == self.raw_to == "-":
            raise AmiwarpError("--to - and --raw-to - would mix two streams; give one of them tcp: or unix:")
        if self.use_stdout and json:
            given = "--to" if self.to == "-" else "--raw-to"
            raise AmiwarpError(f"--json and {given} - both write to standard output; remove --json, or give {given} "
                               "tcp: or unix:")  # fmt: skip


@dataclass(frozen=True)
class ProcessingOptions:
    """Options for the compensation of the stream."""

    wait_ms: Annotated[
        float, typer.Option(min=0.0, help="Longest wait for encoder samples (ms); after it the angle is extrapolated.")
    ] = 10.0
    policy: Annotated[
        Policy,
        typer.Option(
            help="Treatment of events that arrive faster than they are processed. block: the source waits; "
            "drop-oldest: the oldest are dropped; thin: events are left out evenly."
        ),
    ] = Policy.BLOCK
    watch_s: Annotated[
        float, typer.Option(min=0.0, help="Interval between checks of the calibrated phase (s); 0: no checks.")
    ] = 10.0


def run_live(
    source: SourceArgument,
    *,
    calibration: Annotated[Path, typer.Option(help="Calibration file from 'amiwarp calibrate' (.json).")],
    outputs: OutputOptions,
    stream: SourceOptions,
    second_ratio: SecondRatio = None,
    processing: ProcessingOptions,
    adaptive: AdaptiveOptions,
    common: cli.Common,
) -> None:
    """Compensate the events of a live stream and show rate, latency, coverage and sharpness on one line.

    Ctrl-C ends the command. If the stream breaks off, it exits with code 1 and keeps the events received so far.

    Every event is written once, in order. Events outside the image and events with an extrapolated angle are marked.
    """
    from amiwarp.calib.result import Calibration
    from amiwarp.compensation.recordings import check_size
    from amiwarp.live.stream.session import clock_offset

    outputs.check(json=common.json)
    device = cli.choose_device(common.device)
    found = Calibration.load(calibration)
    with contextlib.ExitStack() as resources:
        stop = threading.Event()
        line = resources.enter_context(StatusLine())
        link = resources.enter_context(stream.link())
        opened = stream.open(source, line.say)
        angles = check_angles(opened, link, second_ratio)
        check_size(found, opened.size, opened.name)
        check_model(opened, link, angles, found)
        resources.enter_context(stopped_by_interrupt(stop))  # before the files: Ctrl-C leaves none unfinished
        receivers = _Receivers(
            outputs, opened, found, encoders=angles, offset_us=clock_offset(opened, link), resources=resources,
            stop=stop, say=line.say,
        )  # fmt: skip
        keeper = adaptive.build(found.model, link, line.say)
        session = _session(opened, found, receivers, processing, link=link, second_ratio=second_ratio, keeper=keeper,
                           device=device, say=line.say)  # fmt: skip
        status = _follow(session, stop, stream.seconds, line, receivers)
    data: dict[str, Any] = {
        "files": outputs.files,
        **session_summary(status, opened),
        "controller": None if link is None else controller_summary(link),
        "latency_ms": status.latency_ms,
        "model": found.model_name,
        "device": device,
        "messages": list(line.messages),
    }
    _print_result(data, common, to_stderr=outputs.use_stdout)
    check_whole(opened, status)


class _Receivers:
    """Writers and sinks that receive the events of a session. ``resources`` closes them at the end."""

    def __init__(
        self, options: OutputOptions, source: Source, found: Calibration, *, encoders: int, offset_us: float,
        resources: contextlib.ExitStack, stop: threading.Event, say: Callable[[str], None],
    ) -> None:  # fmt: skip
        from amiwarp.live.stream.sockets import Forward

        def sink(what: str, address: str | None, encoders: int = 1) -> SocketSink | PipeSink | None:
            if address is None:
                return None
            opened = _open_sink(address, found, encoders, resources, stop=stop, say=say)
            if opened.address != address:  # for example, the system chose the port
                say(f"{what} packets are served at {opened.address}")
            return opened

        # first, because a recording that has begun is kept although a viewer's library is missing
        self.viewers = [resources.enter_context(one) for one in _open_viewers(options, source)]
        self.raw: list[RawConsumer] = []
        if options.record is not None:
            writer = _writer(options.record, source, found, compensated=False, encoders=encoders, offset_us=offset_us)
            self.raw.append(resources.enter_context(writer))
        self.raw_sink = sink("uncompensated", options.raw_to, encoders)
        if self.raw_sink is not None:
            self.raw.append(Forward(self.raw_sink))
        self.out = None
        if options.out is not None:
            writer = _writer(options.out, source, found, compensated=True, encoders=encoders)
            self.out = resources.enter_context(writer)
        self.sink = sink("compensated", options.to)
        self.raw += self.viewers

    @property
    def sinks(self) -> tuple[Callable[[Compensated], None], ...]:
        """Functions that take compensated packets and send them."""
        return (*(() if self.sink is None else (_send_to(self.sink),)), *self.viewers)


def _session(
    source: Source, found: Calibration, receivers: _Receivers, options: ProcessingOptions, *, link: Link | None,
    second_ratio: float | None, keeper: SpeedKeeper | None, device: str, say: Callable[[str], None],
) -> Session:  # fmt: skip
    from amiwarp.live.stream.session import Session

    return Session(
        source, found, link=link, second_ratio=second_ratio, raw=receivers.raw, out=receivers.out,
        sinks=receivers.sinks, watch_s=options.watch_s or None, keeper=keeper,
        wait_us=cli.microseconds(options.wait_ms, "ms", "--wait-ms"), policy=options.policy, device=device, say=say,
    )  # fmt: skip


def _follow(
    session: Session, stop: threading.Event, seconds: float | None, line: StatusLine, receivers: _Receivers
) -> SessionStatus:
    """Run the session to its end, for at most ``seconds``, and show its status on ``line``."""

    def update(status: SessionStatus) -> None:
        line.update(status)
        if receivers.sink is not None:
            receivers.sink.tick()

    status = session.run(stop, update, seconds=seconds)
    line.report_lost_packets(receivers.sink, receivers.raw_sink)
    for viewer in receivers.viewers:
        viewer.close()
        if viewer.lost:
            line.say(f"{viewer.lost:,} frames were not shown: the viewer, or this computer, is too slow")
    return status


def _print_result(data: dict[str, Any], common: cli.Common, *, to_stderr: bool) -> None:
    """Print the result. If packets use standard output, print it as text on stderr."""
    if not to_stderr:
        cli.report(common, data, _live_lines(data))
        return
    for text in _live_lines(data):
        say(text)


def _open_sink(
    address: str, found: Calibration, encoders: int, resources: contextlib.ExitStack, *, stop: threading.Event,
    say: Callable[[str], None],
) -> SocketSink | PipeSink:  # fmt: skip
    from amiwarp.live.stream.packets import encode_hello
    from amiwarp.live.stream.sockets import open_sink

    camera = found.model.camera
    hello = encode_hello(camera.width, camera.height, camera, _prism(found), encoders)
    sink = open_sink(address, hello, stop=stop, say=say)
    resources.push(sink)
    return sink


def _open_viewers(options: OutputOptions, source: Source) -> Iterator[LiveViewer]:
    """Yield the viewers to which the options send images."""
    if options.rerun is not None:
        from amiwarp.plotting.viewers import rerun_viewer

        yield rerun_viewer(options.rerun, source.size, source.name)
    if options.foxglove is not None:
        from amiwarp.plotting.viewers import foxglove_server

        yield foxglove_server(options.foxglove, source.size)


def _prism(found: Calibration) -> NominalPrism | None:
    """Return the nominal prism of a calibration; None if its optic has no prism, as a mirror."""
    return found.prism if found.model.PRISM else None


def _send_to(sink: SocketSink | PipeSink) -> Callable[[Compensated], None]:
    from amiwarp.live.stream.packets import encode_compensated

    return lambda packet: sink.send(encode_compensated(packet.events, packet.flags))


def _writer(
    path: Path, source: Source, found: Calibration, *, compensated: bool, encoders: int, offset_us: float = 0.0
) -> LiveWriter:
    width, height = source.size
    metadata = _recorded_from(source)
    if not found.model.PRISM:
        metadata["optic"] = found.model_name
    if compensated:
        metadata["compensated_with"] = found.model_name
    return LiveWriter(
        path, width=width, height=height, camera=found.model.camera,
        prism=source.prism or _prism(found), metadata=metadata, compensated=compensated, encoders=encoders,
        clock_offset_us=offset_us,
    )  # fmt: skip


def _recorded_from(source: Source) -> dict[str, Any]:
    """Return the metadata of a recording that name the source, its camera and its optic."""
    return {"recorded_from": source.name, **getattr(source, "metadata", {})}


def _live_lines(d: dict[str, Any]) -> list[str]:
    marked = [f"{d[key]:,} {what}" for key, what in (
        ("outside", "outside the image"), ("extrapolated", "with an extrapolated angle"),
        ("without_angle", "without an angle"), ("dropped", "dropped"), ("late", "late"),
    ) if d[key]]  # fmt: skip
    speed = f"{d['seconds']:.1f} s, {d['mev_per_s']:.3g} Mev/s by the {d['model']} model on {d['device']}"
    return [
        f"{d['compensated']:,} events ({', '.join(marked) or 'all inside the image with a measured angle'}), {speed}",
        *_clock_lines(d["clock"]),
        *_controller_lines(d["controller"]),
        *d["files"],
    ]


def _clock_lines(clock: dict[str, Any] | None) -> list[str]:
    """Return the line of the result about the clocks of controller and camera."""
    if clock is None:
        return []
    if clock["uncertainty_us"] is None:
        return ["clocks of controller and camera: never related"]
    return [f"clocks of controller and camera: by {clock['from']}, ±{clock['uncertainty_us']:.1f} µs"]


def _controller_lines(controller: dict[str, Any] | None) -> list[str]:
    """Return the line of the result about the controller."""
    if controller is None:
        return []
    return [f"controller: firmware {_firmware_text(controller)}, supply {_supply_text(controller)}"]


# ``amiwarp record``: recording of a live camera and encoder to a file that survives crashes.


def run_record(
    source: SourceArgument,
    out: Annotated[Path, typer.Argument(help="Recording to write (.h5)."), cli.OUTPUT],
    *,
    stream: SourceOptions,
    second_ratio: SecondRatio = None,
    camera: cli.CameraOptions,
    prism: cli.NominalPrismOptions,
    common: cli.Common,
) -> None:
    """Record events and prism angles until the source ends, --seconds have passed, or Ctrl-C.

    If the stream breaks off, the command exits with code 1 and keeps the events received so far.

    During recording the file is called NAME.part.h5. It can be read at any time; after a crash it lacks at most the
    last second.
    """
    from amiwarp.live.stream.session import Session, clock_offset

    stop = threading.Event()
    with StatusLine() as line, stream.link() as link:
        opened = stream.open(source, line.say)
        encoders = check_angles(opened, link, second_ratio)
        width, height = opened.size
        writer = LiveWriter(
            out, width=width, height=height, camera=camera.build(width, height) or opened.camera,
            prism=prism.build(opened.prism), metadata=_recorded_from(opened), encoders=encoders,
            clock_offset_us=clock_offset(opened, link),
        )  # fmt: skip
        with stopped_by_interrupt(stop), writer:  # in this order, so that Ctrl-C leaves no unfinished file
            session = Session(opened, link=link, second_ratio=second_ratio, raw=[writer], say=line.say)
            status = session.run(stop, line.update, seconds=stream.seconds)
        controller = None if link is None else controller_summary(link)
    data = {
        "file": str(out),
        **session_summary(status, opened),
        "controller": controller,
        "messages": list(line.messages),
    }
    text = f"{out}: {status.events:,} events in {status.seconds:.1f} s, {data['mev_per_s']:.3g} Mev/s"
    cli.report(
        common,
        data,
        [
            text,
            *_controller_lines(controller),
            *([f"{status.late:,} events arrived too late to be sorted by time"] if status.late else []),
        ],
    )
    check_whole(opened, status)


# ``amiwarp motor``: status and speed of the prism's motor.

LIMIT_RPM = 3000.0
"""Default of ``--limit-rpm``, the largest accepted speed [turns/min]."""
RAMP_RPM_S = 500.0
"""Default of ``--ramp-rpm-s``, the largest change of the speed [turns/min/s]."""
WAIT_S = 2.5
"""Longest wait for the controller's status, which is sent once a second, and for its clock [s]."""
TELL_S = 1.0
"""Longest wait for what the controller says about itself [s]: firmware of amiwarp 0.1 does not answer the question."""
POLL_S = 0.02
"""Interval between two readings of the data that the controller has sent [s]."""


CHECK_RPM, LEAST_CHECK_RPM = 240.0, 60.0
"""Default and smallest speed of ``amiwarp motor check`` [turns/min]."""
_VERDICTS = {True: "passed", False: "FAILED", None: "skipped"}


class Action(enum.StrEnum):
    """Action of ``amiwarp motor``: print the status, set the speed, stop, show or change settings, or check."""

    STATUS = "status"
    SET = "set"
    STOP = "stop"
    SETTINGS = "settings"
    CHECK = "check"


def run_motor(
    action: Annotated[
        Action,
        typer.Argument(
            help="status: print the status; set: turn at --rpm; stop: stop the motor; settings: print the settings of "
            "the controller, or change them; check: test the controller against the serial protocol, with a turning "
            "motor."
        ),
    ],
    *,
    port: Annotated[
        str | None,
        typer.Option(
            help="Serial port of the controller: name, USB id VID:PID or URL (socket://host:port). "
            "Default: the port that sends encoder samples."
        ),
    ] = None,
    rpm: Annotated[
        float | None, typer.Option(help="Speed to set (turns/min); negative: backwards. For check: 240 by default.")
    ] = None,
    ramp_rpm_s: Annotated[
        float, typer.Option(min=0.001, help="For set: largest change of the speed (turns/min per second).")
    ] = RAMP_RPM_S,
    limit_rpm: Annotated[
        float,
        typer.Option(min=0.0, help="Largest accepted speed (turns/min): what prism, mount and bearing withstand."),
    ] = LIMIT_RPM,
    yes: Annotated[bool, typer.Option("--yes", help="For check: let the motor turn.")] = False,
    change: Annotated[
        list[str] | None,
        typer.Option(
            help="For settings: value to change, such as host-timeout=5. Can be repeated.", metavar="NAME=VALUE"
        ),
    ] = None,
    as_built: Annotated[
        bool, typer.Option("--as-built", help="For settings: go back to those of the firmware's build first.")
    ] = False,
    save: Annotated[
        bool, typer.Option("--save", help="For settings: keep them in the controller, also without power.")
    ] = False,
    common: cli.Common,
) -> None:
    """Set the speed of the prism's motor, stop it, print the controller's status or settings, or check it.

    The motor keeps its last commanded speed after this command exits, unless the setting host-timeout of the controller
    says otherwise. Settings change while the prism rests, and hold until the controller's next reset unless saved. A
    check takes about half a minute, ends with a stop, and fails (status 1) if the serial protocol is violated.
    """
    if action is Action.CHECK:
        rpm = CHECK_RPM if rpm is None else rpm
    elif (rpm is None) == (action is Action.SET):
        raise AmiwarpError("'amiwarp motor set' needs --rpm, the speed to set; status and stop do not accept it")
    if (change or as_built or save) and action is not Action.SETTINGS:
        raise AmiwarpError("--change, --as-built and --save apply to 'amiwarp motor settings'")
    changes = [_parsed_change(text) for text in change or ()]
    if ramp_rpm_s != RAMP_RPM_S and action is not Action.SET:
        raise AmiwarpError("--ramp-rpm-s applies to 'amiwarp motor set'; to stop slowly, set --rpm 0")
    if rpm is not None and not abs(rpm) <= limit_rpm:
        raise AmiwarpError(
            f"--rpm {rpm:g} is beyond the limit of {limit_rpm:g} rpm; raise --limit-rpm only if prism and mount "
            "withstand it"
        )
    if action is Action.CHECK:
        assert rpm is not None
        _check_motor(port, rpm, yes, common)
        return
    with Link(port) as link:
        messages: list[str] = []
        _wait(link, messages)
        if rpm is not None:
            link.set_speed(rpm, ramp_rpm_s)
            _wait(link, messages, rpm)
        elif action is Action.STOP:
            link.stop()
            _wait(link, messages, 0.0)
        data = _described(link, messages)
        if action is Action.SETTINGS:
            _change_settings(link, changes, as_built=as_built, save=save)
            _report_settings(link, common, saved=save)
            return
    cli.report(common, data, [cli.table(_motor_rows(data)), *data["messages"], *_hint(data)])


def _parsed_change(text: str) -> tuple[str, int]:
    """Return name and value of a setting given as ``NAME=VALUE``."""
    name, equals, value = text.partition("=")
    if not equals or re.fullmatch(r"-?\d{1,10}", value) is None:
        raise AmiwarpError(f"--change {text}: give NAME=VALUE with a whole number, such as host-timeout=5")
    return name, int(value)


def _change_settings(link: Link, changes: list[tuple[str, int]], *, as_built: bool, save: bool) -> None:
    """Change settings in the controller, and save them."""
    if as_built:
        link.restore_settings()
    for name, value in changes:
        link.set_setting(name, value)
    if save:
        link.save_settings()


def _report_settings(link: Link, common: cli.Common, *, saved: bool) -> None:
    """Print the controller's settings."""
    values = link.settings()
    rows = []
    for setting in SETTINGS:
        allowed = f"{setting.least:,} to {setting.most:,}" + (", or 0: off" if setting.off else "")
        rows.append((setting.name, f"{values[setting.name]:,}", setting.unit, allowed))
    data = {"port": link.name, "settings": values, "saved": saved}
    note = "saved in the controller" if saved else "changes hold until the controller's next reset; --save keeps them"
    cli.report(common, data, [cli.table(rows, "setting", "value", "unit", "range"), note])


def _check_motor(port: str | None, rpm: float, yes: bool, common: cli.Common) -> None:
    """Run the conformance suite and print its table; exit with status 1 if a check failed."""
    from amiwarp.live.link.conformance import Check, SerialWire, check_controller

    if abs(rpm) < LEAST_CHECK_RPM:
        raise AmiwarpError(f"--rpm {rpm:g} is too slow for a check; give {LEAST_CHECK_RPM:g} rpm or more")
    if not yes:
        raise AmiwarpError(
            f"the check turns the motor at {rpm:g} rpm; cover the prism, keep hands away, and add --yes to start it"
        )

    def tell(check: Check) -> None:
        say(f"{check.name}: {_VERDICTS[check.passed]}")

    wire = SerialWire(port)
    try:
        checks = check_controller(wire, rpm, tell)
    except OSError as error:
        raise AmiwarpError(f"{wire.name}: the port is gone, {error}; is the motor at rest?") from error
    finally:
        wire.close()
    failed = [check for check in checks if check.passed is False]
    rows = [(check.name, _VERDICTS[check.passed], check.measured) for check in checks]
    verdict = f"{len(failed)} of {len(checks)} checks failed" if failed else "the controller passes"
    remedies = [f"{check.name}: {check.remedy}" for check in failed]
    data = {"port": wire.name, "rpm": rpm, "passed": not failed, "checks": [asdict(check) for check in checks]}
    cli.report(common, data, [cli.table(rows, "check", "result", "measured"), "", *remedies, verdict])
    if failed:
        raise typer.Exit(1)


def _wait(link: Link, messages: list[str], target: float | None = None) -> None:
    """Wait until the status reports the target speed and the controller's clock is known, or :data:`WAIT_S` passed."""
    end = time.monotonic() + WAIT_S
    while time.monotonic() < end:
        messages += link.poll().messages
        status = link.status
        reported = status is not None and (target is None or math.isclose(status.target_rpm, target, rel_tol=1e-6))
        told = link.older or link.condition is not None or time.monotonic() > end - WAIT_S + TELL_S
        if reported and told and link.clock() is not None:
            return
        time.sleep(POLL_S)


def _described(link: Link, messages: list[str]) -> dict[str, Any]:
    status = link.status
    if status is None:
        details = "; ".join([*messages, "docs/reference/link-protocol.md describes the messages it must send"])
        raise AmiwarpError(f"{link.name}: no status in {WAIT_S:g} s; {details}")
    return {
        "port": link.name,
        "state": STATES[status.state] if status.state < len(STATES) else f"unknown ({status.state})",
        "rpm": status.rpm,
        "target_rpm": status.target_rpm,
        "counts_per_turn": status.counts_per_turn,
        "faults": [name for bit, name in enumerate(FAULTS) if status.faults >> bit & 1],
        "answers": link.clock() is not None,
        **controller_summary(link),
        "messages": messages,
    }


def controller_summary(link: Link) -> dict[str, Any]:
    """Return what the controller says about itself; None for all that is unknown."""
    who, condition = link.identity, link.condition
    told: dict[str, Any] = {
        "firmware": None if who is None else who.version,
        "board": None if who is None else who.board_name,
        "older_than_1_1": link.older,
        "supply_v": None,
        "host_timeout_s": None,
        "host_stops": None,
        "settings": None,
    }
    if condition is not None:
        told["supply_v"] = condition.supply_v
        told["host_timeout_s"], told["host_stops"] = condition.host_timeout_s, condition.host_stops
        known = condition.stored < len(STORED)
        told["settings"] = STORED[condition.stored] if known else f"unknown ({condition.stored})"
    return told


def _firmware_text(d: dict[str, Any]) -> str:
    if d["firmware"] is not None:
        return f"{d['firmware']} on {d['board'] or 'a board without a name'}"
    return "older than 1.1" if d["older_than_1_1"] else "unknown: it does not say"


def _supply_text(d: dict[str, Any]) -> str:
    if d["supply_v"] is not None:
        return f"{d['supply_v']:.1f} V"
    return "unknown" if d["firmware"] is None else "unknown: its pin is not connected"


def _without_host_text(d: dict[str, Any]) -> str:
    if d["host_timeout_s"] is None:
        return "the motor goes on" if d["older_than_1_1"] else "unknown"
    if not d["host_timeout_s"]:
        return "the motor goes on"
    stops = f"; stops since the controller's start: {d['host_stops']:,}" if d["host_stops"] else ""
    return f"the motor stops after {d['host_timeout_s']} s{stops}"


def _motor_rows(d: dict[str, Any]) -> list[tuple[str, str]]:
    return [
        ("port", d["port"] + ("" if d["answers"] else " (sends data, but does not answer commands)")),
        ("state", d["state"]),
        ("speed", f"{d['rpm']:.1f} rpm, set to {d['target_rpm']:g} rpm"),
        ("encoder", f"{d['counts_per_turn']:,} counts per turn"),
        ("faults", ", ".join(d["faults"]) or "none"),
        ("firmware", _firmware_text(d)),
        ("supply", _supply_text(d)),
        ("without a host", _without_host_text(d)),
        ("settings", d["settings"] or "unknown"),
    ]


def _hint(d: dict[str, Any]) -> list[str]:
    """Return a line about a motor that turns: how to stop it, or when it stops by itself."""
    if not d["target_rpm"]:
        return []
    if d["host_timeout_s"]:
        return [f"the motor stops {d['host_timeout_s']} s after this command ends, if no other host speaks to it"]
    return [f"the motor keeps turning; to stop it: amiwarp motor stop --port {d['port']}"]


# ``amiwarp emulate``: emulated prism controller behind a serial port that other programs can open.

STEP_S = 0.05
"""Interval between two checks whether the emulation shall end [s]."""
AFTER_S = 1.0
"""Time for which the controller continues after the camera's last event [s]."""
LATE_US = 100_000
"""Delay of the camera's events above which a message is printed [us]."""

_in_controller = partial(typer.Option, rich_help_panel="Controller")
_in_playback = partial(typer.Option, rich_help_panel="Playback")


@dataclass(frozen=True)
class ControllerOptions:
    """Options for the emulated controller."""

    counts_per_turn: Annotated[int, _in_controller(min=1, max=1 << 24, help="Encoder counts per turn.")] = 4096
    rpm: Annotated[
        float, _in_controller(min=-6000.0, max=6000.0, help="Speed at the start (turns/min); negative: backwards.")
    ] = 0.0
    drift_ppm: Annotated[
        float,
        _in_controller(min=-1e5, max=1e5, help="Frequency error of the controller's clock (ppm); positive: fast."),
    ] = 0.0
    fault: Annotated[
        list[str] | None,
        _in_controller(
            help="Fault with its start and duration (s): garbage, truncate, crc, drop (bytes), missed-index, stall, "
            "slip, reverse, reset, clock-jump or unplug. Can be repeated.",
            metavar="NAME@SECONDS[+DURATION]",
        ),
    ] = None

    supply_v: Annotated[
        float | None, _in_controller(min=0.0, max=60.0, help="Voltage of the motor's supply (V). Default: not sensed.")
    ] = None

    def build(self, rotor: Rotor, seed: int) -> Controller:
        """Return an emulated controller, with the options' settings, that drives ``rotor``."""
        return Controller(
            rotor,
            counts_per_turn=self.counts_per_turn,
            drift_ppm=self.drift_ppm,
            faults=[EmulatedFault.parse(text) for text in self.fault or ()],
            supply_mv=None if self.supply_v is None else round(1000.0 * self.supply_v),
            seed=seed,
        )


@dataclass(frozen=True)
class PlaybackOptions:
    """Options for playing a recording instead of emulating a motor."""

    recording: Annotated[
        Path | None,
        _in_playback(
            help="Recording to play: its prism rotation replaces the motor, its events are served at --camera."
        ),
    ] = None
    camera: Annotated[
        str | None,
        _in_playback(
            help="Address of an emulated camera that serves the recording's events: tcp:HOST:PORT or unix:PATH. "
            "Playing starts when the first client connects.",
            metavar="ADDRESS",
        ),
    ] = None

    def open(self) -> _Playback | None:
        """Open the recording. Return None if none is given."""
        if self.recording is None and self.camera is None:
            return None
        if self.recording is None or self.camera is None:
            raise AmiwarpError("--recording and --camera belong together; give both or neither")
        recording = open_recording(self.recording)
        if recording.encoder is None:
            raise AmiwarpError(f"{self.recording}: has no encoder samples; give a recording with an encoder")
        if recording.encoder.second is not None:
            raise AmiwarpError(
                f"{self.recording}: has two encoders, the emulated controller one; replay it with 'amiwarp live' or "
                "'amiwarp record', which take the file's own samples"
            )
        return _Playback(recording, Played(recording.encoder), self.camera)


@dataclass(frozen=True)
class _Playback:
    """Recording to play, its prism rotation, and the address that serves its events."""

    recording: Recording
    rotor: Played
    address: str

    def camera(self, controller: Controller, now_us: Callable[[], int]) -> EmulatedCamera:
        from amiwarp.live.stream.sources import EmulatedCamera

        return EmulatedCamera(self.recording, self.rotor, controller, self.address, now_us)


def run_emulate(
    *,
    link: Annotated[
        Path | None,
        typer.Option(help="Symbolic link to create for the port; valid again after a fault 'unplug'. Default: none."),
        cli.NO_FILE,
    ] = None,
    options: ControllerOptions,
    playback: PlaybackOptions,
    seconds: Annotated[
        float | None, typer.Option(min=0.0, help="Stop after this time (s). Default: at Ctrl-C.")
    ] = None,
    common: cli.Common,
) -> None:
    """Emulate a prism controller with motor, encoder and index pulse, and inject faults on request.

    Programs can be tried out against it without hardware.
    """
    played = playback.open()
    if played is not None and options.rpm:
        raise AmiwarpError("--rpm applies to the emulated motor, which --recording replaces; remove one of them")
    rotor = Motor(options.rpm, seed=common.seed) if played is None else played.rotor
    controller = options.build(rotor, common.seed)
    origin = monotonic_us()

    def now_us() -> int:
        return monotonic_us() - origin

    with contextlib.ExitStack() as resources:
        stop = threading.Event()
        resources.enter_context(stopped_by_interrupt(stop))
        terminal = resources.enter_context(PseudoTerminal(controller, link, now_us=now_us))
        camera = None if played is None else resources.enter_context(played.camera(controller, now_us))
        _print_names(terminal, camera, common)
        _wait_for_end(stop, seconds, camera)
        if camera is not None and camera.late_us > LATE_US:
            late = f"events were sent up to {camera.late_us * 1e-6:.1f} s late, none was lost"
            say(f"{late}: this machine or a receiver is slower than the recording")


def _print_names(terminal: PseudoTerminal, camera: EmulatedCamera | None, common: cli.Common) -> None:
    """Print the port, the camera's address and a command to try next."""
    if camera is None:
        hint = f"amiwarp motor status --port {terminal.name}"
        data, lines = {"port": terminal.name, "try": hint}, [terminal.name, f"try: {hint}", "stop with Ctrl-C"]
    else:
        hint = f"amiwarp live {camera.address} --port {terminal.name} --calibration CALIBRATION"
        data = {"port": terminal.name, "try": hint, "camera": camera.address}
        lines = [terminal.name, camera.address, f"try: {hint}"]
    cli.report(common, data, lines)


def _wait_for_end(stop: threading.Event, seconds: float | None, camera: EmulatedCamera | None) -> None:
    """Wait until ``stop`` is set, ``seconds`` have passed, or :data:`AFTER_S` after the camera's last event."""
    end = math.inf if seconds is None else time.monotonic() + seconds
    while not stop.wait(STEP_S) and time.monotonic() < end:
        if camera is not None and camera.done.is_set():
            stop.wait(AFTER_S)
            return
