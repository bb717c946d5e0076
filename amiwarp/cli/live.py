"""``amiwarp live``: motion compensation of a live stream."""

from __future__ import annotations

import contextlib
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amiwarp.cli import say
from amiwarp.cli.console import choose_device, report
from amiwarp.cli.options import OUTPUT, Common
from amiwarp.cli.streams import SourceOptions, StatusLine, check_angles, check_whole, stopped_by_interrupt, summary
from amiwarp.errors import AmiwarpError
from amiwarp.io.live_writer import LiveWriter
from amiwarp.live.stream.adaptive import SpeedController, prism_orbit
from amiwarp.live.stream.camera_clock import clock_offset
from amiwarp.live.stream.queue_policy import Policy

if TYPE_CHECKING:
    from collections.abc import Callable

    from amiwarp.calib import Calibration
    from amiwarp.compensation.streams import Compensated
    from amiwarp.live.link.link import Link
    from amiwarp.live.stream.consumers import RawConsumer
    from amiwarp.live.stream.packets import Source
    from amiwarp.live.stream.session import Session
    from amiwarp.live.stream.socket_sinks import PipeSink, SocketSink
    from amiwarp.live.stream.speed_control import SpeedKeeper
    from amiwarp.live.stream.status import SessionStatus
    from amiwarp.optics.models import Model

EXAMPLE = "amiwarp live dv --port find --calibration calibration.json --out compensated.h5"

_ADAPTIVE, _OUTPUTS = "Adaptive speed", "Outputs"
START_RPM = 720.0
"""Speed at which adaptive control begins [turns/min], limited to the speeds that the options allow."""


@dataclass(frozen=True)
class AdaptiveOptions:
    """Options for setting the prism's speed from the stream."""

    adaptive: Annotated[
        bool,
        typer.Option(
            "--adaptive",
            help="Set the prism's speed automatically: just fast enough to see the edges.",
            rich_help_panel=_ADAPTIVE,
        ),
    ] = False
    least_rpm: Annotated[
        float, typer.Option(min=1.0, help="Lowest speed allowed (turns/min).", rich_help_panel=_ADAPTIVE)
    ] = 120.0
    limit_rpm: Annotated[
        float, typer.Option(min=1.0, help="Highest speed allowed (turns/min).", rich_help_panel=_ADAPTIVE)
    ] = 1440.0
    most_mev_s: Annotated[
        float | None,
        typer.Option(
            min=0.001, help="Highest event rate allowed (million events/s). Default: any.", rich_help_panel=_ADAPTIVE
        ),
    ] = None

    def build(self, model: Model, link: Link | None, say: Callable[[str], None]) -> SpeedKeeper | None:
        """Set the motor's first speed and return the speed control; None without ``--adaptive``."""
        from amiwarp.live.stream.speed_control import SpeedKeeper

        if not self.adaptive:
            return None
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

    out: Annotated[
        Path | None, typer.Option(help="Compensated recording to write (.h5).", rich_help_panel=_OUTPUTS), OUTPUT
    ] = None
    record: Annotated[
        Path | None,
        typer.Option(help="Recording of the uncompensated events to write (.h5).", rich_help_panel=_OUTPUTS),
        OUTPUT,
    ] = None
    to: Annotated[
        str | None,
        typer.Option(
            help="Address to serve compensated packets at: tcp:HOST:PORT, unix:PATH, or - for standard output.",
            metavar="ADDRESS",
            rich_help_panel=_OUTPUTS,
        ),
    ] = None
    raw_to: Annotated[
        str | None,
        typer.Option(
            help="Address to serve the uncompensated packets at, for example for 'amiwarp view --live'.",
            metavar="ADDRESS",
            rich_help_panel=_OUTPUTS,
        ),
    ] = None

    @property
    def files(self) -> list[str]:
        """Names of the recordings to write."""
        return [str(path) for path in (self.record, self.out) if path is not None]

    @property
    def use_stdout(self) -> bool:
        """Whether compensated packets go to standard output."""
        return "-" in (self.to, self.raw_to)


@dataclass(frozen=True)
class ProcessingOptions:
    """Options for the compensation of the stream."""

    wait_ms: Annotated[
        float,
        typer.Option(min=0.0, help="Longest wait for encoder samples (ms); after it the angle is extrapolated."),
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


def run(
    source: Annotated[
        str,
        typer.Argument(
            help="Source: dv, prophesee, tcp:HOST:PORT, unix:PATH, '-' for standard input, or a file to replay."
        ),
    ],
    *,
    calibration: Annotated[Path, typer.Option(help="Calibration file from 'amiwarp calibrate' (.json).")],
    outputs: OutputOptions,
    stream: SourceOptions,
    processing: ProcessingOptions,
    adaptive: AdaptiveOptions,
    common: Common,
) -> None:
    """Compensate the events of a live stream and show rate, latency, coverage and sharpness on one line.

    Ctrl-C ends the command. If the stream breaks off, it exits with code 1 and keeps the events received so far.

    Every event is written once, in order. Events outside the image and events with an extrapolated angle are marked.
    """
    from amiwarp.calib import Calibration
    from amiwarp.compensation.recordings import check_size

    device = choose_device(common.device)
    found = Calibration.load(calibration)
    with contextlib.ExitStack() as resources:
        stop = threading.Event()
        line = resources.enter_context(StatusLine(stop, stream.seconds))
        link = resources.enter_context(stream.link())
        opened = stream.open(source, line.say)
        check_angles(opened, link)
        check_size(found, opened.size, opened.name)
        resources.enter_context(stopped_by_interrupt(stop))  # before the files: Ctrl-C leaves none unfinished
        receivers = _Receivers(
            outputs, opened, found, offset_us=clock_offset(opened, link), resources=resources, stop=stop, say=line.say
        )
        keeper = adaptive.build(found.model, link, line.say)
        session = _session(opened, found, receivers, processing, link=link, keeper=keeper, device=device, say=line.say)
        status = _follow(session, stop, line, receivers)
    data: dict[str, Any] = {
        "files": outputs.files,
        **summary(status, opened),
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
        self, options: OutputOptions, source: Source, found: Calibration, *, offset_us: float,
        resources: contextlib.ExitStack, stop: threading.Event, say: Callable[[str], None],
    ) -> None:  # fmt: skip
        from amiwarp.live.stream.forwarding import Forward

        def sink(address: str | None) -> SocketSink | PipeSink | None:
            return None if address is None else _open_sink(address, found, resources, stop=stop, say=say)

        self.raw: list[RawConsumer] = []
        if options.record is not None:
            writer = _writer(options.record, source, found, compensated=False, offset_us=offset_us)
            self.raw.append(resources.enter_context(writer))
        self.raw_sink = sink(options.raw_to)
        if self.raw_sink is not None:
            self.raw.append(Forward(self.raw_sink))
        self.out = None
        if options.out is not None:
            self.out = resources.enter_context(_writer(options.out, source, found, compensated=True))
        self.sink = sink(options.to)

    @property
    def sinks(self) -> tuple[Callable[[Compensated], None], ...]:
        """Functions that take compensated packets and send them."""
        return () if self.sink is None else (_send_to(self.sink),)


def _session(
    source: Source, found: Calibration, receivers: _Receivers, options: ProcessingOptions, *, link: Link | None,
    keeper: SpeedKeeper | None, device: str, say: Callable[[str], None],
) -> Session:  # fmt: skip
    from amiwarp.live.stream.session import Session

    return Session(
        source, found, link=link, raw=receivers.raw, out=receivers.out, sinks=receivers.sinks,
        watch_s=options.watch_s or None, keeper=keeper, wait_us=round(1e3 * options.wait_ms), policy=options.policy,
        device=device, say=say,
    )  # fmt: skip


def _follow(session: Session, stop: threading.Event, line: StatusLine, receivers: _Receivers) -> SessionStatus:
    """Run the session to its end and show its status on ``line``."""

    def update(status: SessionStatus) -> None:
        line.update(status)
        if receivers.sink is not None:
            receivers.sink.tick()

    status = session.run(stop, update)
    line.report_lost_packets(receivers.sink, receivers.raw_sink)
    return status


def _print_result(data: dict[str, Any], common: Common, *, to_stderr: bool) -> None:
    """Print the result. If packets use standard output, print it as text on stderr."""
    if not to_stderr:
        report(common, data, _lines(data))
        return
    for text in _lines(data):
        say(text)


def _open_sink(
    address: str, found: Calibration, resources: contextlib.ExitStack, *, stop: threading.Event,
    say: Callable[[str], None],
) -> SocketSink | PipeSink:  # fmt: skip
    from amiwarp.live.stream.packets import encode_hello
    from amiwarp.live.stream.socket_sinks import open_sink

    hello = encode_hello(found.camera.width, found.camera.height, found.camera, found.prism)
    sink = open_sink(address, hello, stop=stop, say=say)
    resources.push(sink)
    return sink


def _send_to(sink: SocketSink | PipeSink) -> Callable[[Compensated], None]:
    from amiwarp.live.stream.packets import encode_compensated

    return lambda packet: sink.send(encode_compensated(packet.events, packet.flags))


def _writer(path: Path, source: Source, found: Calibration, *, compensated: bool, offset_us: float = 0.0) -> LiveWriter:
    width, height = source.size
    metadata: dict[str, Any] = {"recorded_from": source.name}
    if compensated:
        metadata["compensated_with"] = found.model_name
    return LiveWriter(path, width=width, height=height, camera=found.camera, prism=source.prism or found.prism,
                      metadata=metadata, compensated=compensated, clock_offset_us=offset_us)  # fmt: skip


def _lines(d: dict[str, Any]) -> list[str]:
    marked = [f"{d[key]:,} {what}" for key, what in (
        ("outside", "outside the image"), ("extrapolated", "with an extrapolated angle"),
        ("without_angle", "without an angle"), ("dropped", "dropped"), ("late", "late"),
    ) if d[key]]  # fmt: skip
    speed = f"{d['seconds']:.1f} s, {d['mev_per_s']:.3g} Mev/s by the {d['model']} model on {d['device']}"
    return [
        f"{d['compensated']:,} events ({', '.join(marked) or 'all inside the image with a measured angle'}), {speed}",
        *d["files"],
    ]
