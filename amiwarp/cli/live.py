"""``amiwarp live``: compensates a stream as it comes."""

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
from amiwarp.live.stream.clocking import clock_offset
from amiwarp.live.stream.policy import Policy

if TYPE_CHECKING:
    from collections.abc import Callable

    from amiwarp.calib import Calibration
    from amiwarp.compensation.streams import Compensated
    from amiwarp.io.live_writer import LiveWriter
    from amiwarp.live.link.link import Link
    from amiwarp.live.stream.packets import Source
    from amiwarp.live.stream.session import Raw, Status
    from amiwarp.live.stream.sockets import PipeSink, SocketSink
    from amiwarp.live.stream.speed_control import SpeedKeeper
    from amiwarp.optics.models import Model

EXAMPLE = "amiwarp live dv --port find --calibration calibration.json --out compensated.h5"

_ADAPTIVE = "Adaptive speed"


@dataclass(frozen=True)
class AdaptiveOptions:
    """The prism's speed from the stream."""

    adaptive: Annotated[
        bool,
        typer.Option(
            "--adaptive",
            help="Set the prism's speed: as fast as the edges need, no faster.",
            rich_help_panel=_ADAPTIVE,
        ),
    ] = False
    least_rpm: Annotated[float, typer.Option(min=1.0, help="Not slower.", rich_help_panel=_ADAPTIVE)] = 120.0
    limit_rpm: Annotated[float, typer.Option(min=1.0, help="Not faster.", rich_help_panel=_ADAPTIVE)] = 1440.0
    most_mev_s: Annotated[
        float | None, typer.Option(min=0.001, help="Largest event rate (million a second).", rich_help_panel=_ADAPTIVE)
    ] = None

    def build(self, model: Model, link: Link | None, say: Callable[[str], None]) -> SpeedKeeper | None:
        from amiwarp.live.stream.speed_control import SpeedKeeper

        if not self.adaptive:
            return None
        if link is None:
            raise AmiwarpError("--adaptive sets the motor's speed; give the controller's --port")
        rpm = min(max(720.0, self.least_rpm), self.limit_rpm)
        most = float("inf") if self.most_mev_s is None else self.most_mev_s
        orbit = prism_orbit(model)
        limits = SpeedController(orbit, rpm, least_rpm=self.least_rpm, most_rpm=self.limit_rpm, most_mev_s=most)
        link.set_speed(rpm, limits.ramp_rpm_s)
        return SpeedKeeper(model, limits, link.set_speed, say)


def run(
    source: Annotated[str, typer.Argument(help="dv, prophesee, tcp:HOST:PORT, unix:PATH, - or a file to replay.")],
    *,
    calibration: Annotated[Path, typer.Option(help="What 'amiwarp calibrate' wrote.")],
    out: Annotated[Path | None, typer.Option(help="Compensated recording to write (.h5)."), OUTPUT] = None,
    record: Annotated[Path | None, typer.Option(help="Recording of what comes in to write (.h5)."), OUTPUT] = None,
    to: Annotated[
        str | None,
        typer.Option(
            help="Serve compensated packets at tcp:HOST:PORT or unix:PATH, or write them to -.", metavar="ADDRESS"
        ),
    ] = None,
    raw_to: Annotated[
        str | None,
        typer.Option(help="Serve what comes in there, for 'amiwarp view --live', say.", metavar="ADDRESS"),
    ] = None,
    stream: SourceOptions,
    wait_ms: Annotated[
        float, typer.Option(min=0.0, help="Longest wait for the encoder; then the angle is extrapolated (ms).")
    ] = 10.0,
    policy: Annotated[
        Policy, typer.Option(help="What happens to events that come faster than they can be worked through.")
    ] = Policy.BLOCK,
    watch_s: Annotated[
        float, typer.Option(min=0.0, help="Look for a change of the phase so often (s); 0: never.")
    ] = 10.0,
    adaptive: AdaptiveOptions,
    common: Common,
) -> None:
    """Compensate events as they come, with rate, latency, coverage and sharpness on one line; Ctrl-C ends it.

    A stream that breaks off ends it with exit code 1; what came is in the files.

    Every event comes out once, in order, marked where it left the image or its angle had to be extrapolated.
    """
    from amiwarp.calib import Calibration
    from amiwarp.compensation.recordings import check_size
    from amiwarp.live.stream.forward import Forward
    from amiwarp.live.stream.session import Session

    device = choose_device(common.device)
    found = Calibration.load(calibration)
    with contextlib.ExitStack() as held:
        stop = threading.Event()
        line = held.enter_context(StatusLine(stop, stream.seconds))
        link = held.enter_context(stream.link())
        opened = stream.open(source, line.say)
        check_angles(opened, link)
        check_size(found, opened.size, opened.name)
        raw: list[Raw] = []
        if record is not None:
            raw.append(
                held.enter_context(
                    _writer(record, opened, found, compensated=False, offset_us=clock_offset(opened, link))
                )
            )
        handed = None if raw_to is None else _sink(raw_to, found, held, stop, line.say)
        if handed is not None:
            raw.append(Forward(handed))
        written = None if out is None else held.enter_context(_writer(out, opened, found, compensated=True))
        served = None if to is None else _sink(to, found, held, stop, line.say)
        keeper = adaptive.build(found.model, link, line.say)
        held.enter_context(stopped_by_interrupt(stop))
        session = Session(
            opened, found, link=link, raw=raw, out=written,
            sinks=() if served is None else (_sent(served),), watch_s=watch_s or None, keeper=keeper,
            wait_us=round(1e3 * wait_ms), policy=policy, device=device, say=line.say,
        )  # fmt: skip

        def update(status: Status) -> None:
            line.update(status)
            if served is not None:
                served.tick()

        status = session.run(stop, update)
        line.end(served, handed)
    data: dict[str, Any] = {
        "files": [str(path) for path in (record, out) if path is not None],
        **summary(status, opened),
        "latency_ms": status.latency_ms,
        "model": found.model_name,
        "device": device,
        "messages": list(line.messages),
    }
    if "-" in (to, raw_to):  # standard output has packets
        for text in _lines(data):
            say(text)
    else:
        report(common, data, _lines(data))
    check_whole(opened, status)


def _sink(
    to: str, found: Calibration, held: contextlib.ExitStack, stop: threading.Event, say: Callable[[str], None]
) -> SocketSink | PipeSink:
    from amiwarp.live.stream.packets import encode_hello
    from amiwarp.live.stream.sockets import open_sink

    hello = encode_hello(found.camera.width, found.camera.height, found.camera, found.prism)
    sink = open_sink(to, hello, stop=stop, say=say)
    held.push(sink)
    return sink


def _sent(sink: SocketSink | PipeSink) -> Callable[[Compensated], None]:
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
        ("without_angle", "without any angle"), ("dropped", "dropped"), ("late", "late"),
    ) if d[key]]  # fmt: skip
    speed = f"{d['seconds']:.1f} s, {d['mev_per_s']:.3g} Mev/s by the {d['model']} model on {d['device']}"
    return [f"{d['compensated']:,} events ({', '.join(marked) or 'all with a place'}), {speed}", *d["files"]]
