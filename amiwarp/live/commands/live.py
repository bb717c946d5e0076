"""``amiwarp live``: motion compensation of a live stream."""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from amiwarp.cli import common as cli
from amiwarp.cli import say
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.native.live_writer import LiveWriter
from amiwarp.live.commands.controller import controller_lines, controller_summary
from amiwarp.live.commands.session import (
    SecondRatio,
    SourceArgument,
    SourceOptions,
    StatusLine,
    check_angles,
    check_model,
    check_whole,
    lost_lines,
    recorded_from,
    session_summary,
    stopped_by_interrupt,
)
from amiwarp.live.link.link import Link
from amiwarp.live.queues import Policy
from amiwarp.live.stream.adaptive import SpeedController, SpeedKeeper
from amiwarp.live.stream.coverage import prism_orbit

if TYPE_CHECKING:
    from amiwarp.compensation.streams import Compensated
    from amiwarp.live.stream.consumers import RawConsumer
    from amiwarp.live.stream.packets import Source
    from amiwarp.live.stream.picture_stream import PictureStream
    from amiwarp.live.stream.session import Session
    from amiwarp.live.stream.session_status import SessionStatus
    from amiwarp.live.stream.sinks import Sink
    from amiwarp.optics.models.base import Model
    from amiwarp.optics.prism import NominalPrism
    from amiwarp.plotting.live_viewers import LiveViewer
    from amiwarp.reconstruction.phase_camera import LivePicture
    from amiwarp.results.calibration import Calibration


_in_adaptive = partial(typer.Option, rich_help_panel="Adaptive speed")
_in_outputs = partial(typer.Option, rich_help_panel="Outputs")
_in_pictures = partial(typer.Option, rich_help_panel="Pictures of the scene")
LEAST_RPM = 120.0
MOST_RPM = 1440.0
"""Lowest and highest speed that adaptive control may set, by default [turns/min]."""
PICTURE_HZ = 15.0
"""Pictures of the scene per second of the stream, by default [Hz]."""
START_RPM = 720.0
"""Speed at which adaptive control begins [turns/min], limited to the speeds that the options allow."""


@dataclass(frozen=True)
class AdaptiveOptions:
    """Options for setting the prism's speed from the stream."""

    adaptive: Annotated[
        bool,
        _in_adaptive(
            "--adaptive",
            help="Set the prism's speed automatically: just fast enough to see the edges.",
        ),
    ] = False
    least_rpm: Annotated[float, _in_adaptive(min=1.0, help="Lowest speed allowed (turns/min).")] = (
        LEAST_RPM
    )
    limit_rpm: Annotated[
        float, _in_adaptive(min=1.0, help="Highest speed allowed (turns/min).")
    ] = MOST_RPM
    most_mev_s: Annotated[
        float | None,
        _in_adaptive(
            min=0.001, help="Highest event rate allowed (million events/s). Default: any."
        ),
    ] = None

    def __post_init__(self) -> None:
        limits = (self.least_rpm, self.limit_rpm, self.most_mev_s)
        if not self.adaptive and limits != (LEAST_RPM, MOST_RPM, None):
            raise AmiwarpError(
                "--least-rpm, --limit-rpm and --most-mev-s apply to --adaptive; add it, or remove them",
                ErrorCode.OPTIONS,
            )
        if not self.least_rpm <= self.limit_rpm < math.inf:
            raise AmiwarpError(
                f"--least-rpm {self.least_rpm:g} .. --limit-rpm {self.limit_rpm:g} is no range of speeds; give a "
                "lowest speed that is not above the highest one"
            )

    def build(
        self, model: Model, link: Link | None, say: Callable[[str], None]
    ) -> SpeedKeeper | None:
        """Set the motor's first speed and return the speed control; None without ``--adaptive``."""
        if not self.adaptive:
            return None
        if model.ANGLES > 1:
            raise AmiwarpError(
                f"--adaptive sets the speed of one prism, the calibration belongs to a {model.TEXT}; "
                "leave --adaptive out",
                ErrorCode.OPTIONS,
            )
        if link is None:
            raise AmiwarpError(
                "--adaptive sets the motor's speed; give the controller's --port", ErrorCode.OPTIONS
            )
        rpm = min(max(START_RPM, self.least_rpm), self.limit_rpm)
        controller = SpeedController(
            prism_orbit(model),
            rpm,
            least_rpm=self.least_rpm,
            most_rpm=self.limit_rpm,
            most_mev_s=math.inf if self.most_mev_s is None else self.most_mev_s,
        )
        link.set_speed(rpm, controller.ramp_rpm_s)
        return SpeedKeeper(model, controller, link.set_speed, say)


@dataclass(frozen=True)
class OutputOptions:
    """Options for the files and addresses that receive events."""

    out: Annotated[
        Path | None, _in_outputs(help="Compensated recording to write (.h5)."), cli.OUTPUT
    ] = None
    record: Annotated[
        Path | None,
        _in_outputs(help="Recording of the uncompensated events to write (.h5)."),
        cli.OUTPUT,
    ] = None
    to: Annotated[
        str | None,
        _in_outputs(
            help="Address to serve compensated packets at: tcp:HOST:PORT, unix:PATH, shm:NAME (shared memory), - for "
            "standard output; or udp:HOST:PORT of the program that receives them.",
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
            raise AmiwarpError(
                "--to - and --raw-to - would mix two streams; give one of them tcp: or unix:",
                ErrorCode.OPTIONS,
            )
        if self.use_stdout and json:
            given = "--to" if self.to == "-" else "--raw-to"
            raise AmiwarpError(
                f"--json and {given} - both write to standard output; remove --json, or give {given} "
                "tcp: or unix:",
                ErrorCode.OPTIONS,
            )


@dataclass(frozen=True)
class PictureOptions:
    """Options for pictures of the scene, made from sums in phase."""

    picture: Annotated[
        Path | None, _in_pictures(help="Film of the scene to write (.mp4, .gif)."), cli.OUTPUT
    ] = None
    picture_to: Annotated[
        str | None,
        _in_pictures(
            help="Address of a web page to serve that shows the scene; port 0: the system chooses one.",
            metavar="HOST:PORT",
        ),
    ] = None
    picture_hz: Annotated[
        float,
        _in_pictures(min=0.1, max=1000.0, help="Pictures per second of the stream (Hz)."),
    ] = PICTURE_HZ

    def __post_init__(self) -> None:
        if not self.wanted and self.picture_hz != PICTURE_HZ:
            raise AmiwarpError(
                "--picture-hz applies to --picture and --picture-to; add one of them, or remove it",
                ErrorCode.OPTIONS,
            )

    def check(self) -> None:
        """Raise :class:`AmiwarpError` for a film that cannot be written."""
        if self.picture is not None:
            from amiwarp.reconstruction.film_files import check_film

            check_film(self.picture)

    @property
    def wanted(self) -> bool:
        """Whether any pictures are made."""
        return self.picture is not None or self.picture_to is not None


@dataclass(frozen=True)
class ProcessingOptions:
    """Options for the compensation of the stream."""

    wait_ms: Annotated[
        float,
        typer.Option(
            min=0.0,
            help="Longest wait for encoder samples (ms); after it the angle is extrapolated.",
        ),
    ] = 10.0
    policy: Annotated[
        Policy,
        typer.Option(
            help="Treatment of events that arrive faster than they are processed. block: the source waits; "
            "drop-oldest: the oldest are dropped; thin: events are left out evenly."
        ),
    ] = Policy.BLOCK
    watch_s: Annotated[
        float,
        typer.Option(
            min=0.0, help="Interval between checks of the calibrated phase (s); 0: no checks."
        ),
    ] = 10.0


def run_live(
    source: SourceArgument,
    *,
    calibration: Annotated[
        Path, typer.Option(help="Calibration file from 'amiwarp calibrate' (.json).")
    ],
    outputs: OutputOptions,
    stream: SourceOptions,
    second_ratio: SecondRatio = None,
    pictures: PictureOptions,
    processing: ProcessingOptions,
    adaptive: AdaptiveOptions,
    common: cli.Common,
) -> None:
    """Compensate the events of a live stream and show rate, latency, coverage and sharpness on one line.

    Ctrl-C ends the command. If the stream breaks off, it exits with code 1 and keeps the events received so far.

    Every event is written once, in order. Events outside the image and events with an extrapolated angle are marked.
    """
    from amiwarp.compensation.recordings import check_size
    from amiwarp.live.stream.encoder_feed import clock_offset
    from amiwarp.results.calibration import Calibration

    outputs.check(json=common.json)
    pictures.check()
    device = cli.choose_device(common.device)
    calibrated = Calibration.load(calibration)
    with contextlib.ExitStack() as resources:
        stop = threading.Event()
        line = resources.enter_context(StatusLine())
        link = resources.enter_context(stream.link())
        opened = stream.open(source, line.say)
        angles = check_angles(opened, link, second_ratio)
        check_size(calibrated, opened.size, opened.name)
        check_model(opened, link, angles, calibrated)
        # Before the files: Ctrl-C leaves none unfinished
        resources.enter_context(stopped_by_interrupt(stop))
        receivers = _Receivers(
            outputs,
            opened,
            calibrated,
            encoders=angles,
            offset_us=clock_offset(opened, link),
            resources=resources,
            stop=stop,
            say=line.say,
        )
        picture_stream = _picture_stream(
            pictures,
            processing,
            opened,
            calibrated,
            link,
            resources,
            fast=stream.fast,
            device=device,
            say=line.say,
        )
        if picture_stream is not None:
            receivers.raw.append(picture_stream)
        keeper = adaptive.build(calibrated.model, link, line.say)
        session = _session(
            opened,
            calibrated,
            receivers,
            processing,
            link=link,
            second_ratio=second_ratio,
            keeper=keeper,
            device=device,
            say=line.say,
        )
        status = _follow(session, stop, stream.seconds, line, receivers)
        if picture_stream is not None:
            picture_stream.close()
    files = list(outputs.files)
    if pictures.picture is not None:
        files.append(str(pictures.picture))
    result: dict[str, Any] = {
        "files": files,
        **session_summary(status, opened),
        "controller": None if link is None else controller_summary(link),
        "latency_ms": status.latency_ms,
        "pictures": None if picture_stream is None else _picture_summary(picture_stream),
        "model": calibrated.model_name,
        "device": device,
        "messages": list(line.messages),
    }
    _print_result(result, common, to_stderr=outputs.use_stdout)
    check_whole(opened, status)


def _picture_stream(
    options: PictureOptions,
    processing: ProcessingOptions,
    source: Source,
    calibration: Calibration,
    link: Link | None,
    resources: contextlib.ExitStack,
    *,
    fast: bool,
    device: str,
    say: Callable[[str], None],
) -> PictureStream | None:
    """Return what makes the pictures that the options ask for, and open their outputs; None without any."""
    if not options.wanted:
        return None
    from amiwarp.live.stream.encoder_feed import event_encoder
    from amiwarp.live.stream.picture_film import PictureFilm
    from amiwarp.live.stream.picture_page import PicturePage
    from amiwarp.live.stream.picture_stream import PictureStream
    from amiwarp.reconstruction.phase_camera import PhaseCamera

    camera = PhaseCamera(
        calibration.model,
        event_encoder(source, calibration, link),
        rate_hz=options.picture_hz,
        wait_us=cli.microseconds(processing.wait_ms, "ms", "--wait-ms"),
        device=device,
    )
    outputs: list[Callable[[LivePicture], None]] = []
    if options.picture is not None:
        film = PictureFilm(options.picture, options.picture_hz)
        outputs.append(resources.enter_context(film))
    if options.picture_to is not None:
        page = PicturePage(options.picture_to)
        outputs.append(resources.enter_context(page))
        say(f"pictures are shown at {page.address}")

    def give(picture: LivePicture) -> None:
        for output in outputs:
            output(picture)

    picture_stream = PictureStream(camera, give, newest=not fast)
    return resources.enter_context(picture_stream)


def _picture_summary(pictures: PictureStream) -> dict[str, Any]:
    """Return the numbers of pictures and their latency for ``--json``."""
    latency_ms = None
    if pictures.latencies_us:
        median, slow = np.percentile(pictures.latencies_us, [50, 99]) * 1e-3
        latency_ms = float(median), float(slow)
    return {"made": pictures.made, "left_out": pictures.skipped, "latency_ms": latency_ms}


class _Receivers:
    """Writers and sinks that receive the events of a session. ``resources`` closes them at the end."""

    def __init__(
        self,
        options: OutputOptions,
        source: Source,
        calibration: Calibration,
        *,
        encoders: int,
        offset_us: float,
        resources: contextlib.ExitStack,
        stop: threading.Event,
        say: Callable[[str], None],
    ) -> None:
        from amiwarp.live.stream.forward import Forward

        def sink(what: str, address: str | None, encoders: int = 1) -> Sink | None:
            if address is None:
                return None
            opened = _open_sink(address, calibration, encoders, resources, stop=stop, say=say)
            if opened.address != address:  # for example, the system chose the port
                say(f"{what} packets are served at {opened.address}")
            return opened

        # First, because a recording that has begun is kept although a viewer's library is missing.
        self.viewers = [
            resources.enter_context(viewer) for viewer in _open_viewers(options, source)
        ]
        self.raw: list[RawConsumer] = []
        if options.record is not None:
            writer = _writer(
                options.record,
                source,
                calibration,
                compensated=False,
                encoders=encoders,
                offset_us=offset_us,
            )
            self.raw.append(resources.enter_context(writer))
        self.raw_sink = sink("uncompensated", options.raw_to, encoders)
        if self.raw_sink is not None:
            self.raw.append(Forward(self.raw_sink))
        self.out = None
        if options.out is not None:
            writer = _writer(options.out, source, calibration, compensated=True, encoders=encoders)
            self.out = resources.enter_context(writer)
        self.sink = sink("compensated", options.to)
        self.raw += self.viewers

    @property
    def sinks(self) -> tuple[Callable[[Compensated], None], ...]:
        """Functions that take compensated packets and send them."""
        if self.sink is None:
            return tuple(self.viewers)
        return (_send_to(self.sink), *self.viewers)


def _session(
    source: Source,
    calibration: Calibration,
    receivers: _Receivers,
    options: ProcessingOptions,
    *,
    link: Link | None,
    second_ratio: float | None,
    keeper: SpeedKeeper | None,
    device: str,
    say: Callable[[str], None],
) -> Session:
    """Return the session that compensates the source for the receivers."""
    from amiwarp.live.stream.session import Session

    return Session(
        source,
        calibration,
        link=link,
        second_ratio=second_ratio,
        raw=receivers.raw,
        out=receivers.out,
        sinks=receivers.sinks,
        watch_s=options.watch_s or None,
        keeper=keeper,
        wait_us=cli.microseconds(options.wait_ms, "ms", "--wait-ms"),
        policy=options.policy,
        device=device,
        say=say,
    )


def _follow(
    session: Session,
    stop: threading.Event,
    seconds: float | None,
    line: StatusLine,
    receivers: _Receivers,
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
            line.say(
                f"{viewer.lost:,} frames were not shown: the viewer, or this computer, is too slow"
            )
    return status


def _print_result(data: dict[str, Any], common: cli.Common, *, to_stderr: bool) -> None:
    """Print the result. If packets use standard output, print it as text on stderr."""
    if not to_stderr:
        cli.report(common, data, _live_lines(data))
        return
    for text in _live_lines(data):
        say(text)


def _open_sink(
    address: str,
    calibration: Calibration,
    encoders: int,
    resources: contextlib.ExitStack,
    *,
    stop: threading.Event,
    say: Callable[[str], None],
) -> Sink:
    """Open the sink at an address, which ``resources`` closes; its hello message describes the calibrated camera."""
    from amiwarp.live.stream.sinks import open_sink
    from amiwarp.live.stream.stream_format import encode_hello

    camera = calibration.model.camera
    hello = encode_hello(camera.width, camera.height, camera, _prism(calibration), encoders)
    sink = open_sink(address, hello, stop=stop, say=say)
    resources.push(sink)
    return sink


def _open_viewers(options: OutputOptions, source: Source) -> Iterator[LiveViewer]:
    """Yield the viewers to which the options send images."""
    if options.rerun is not None:
        from amiwarp.plotting.live_viewers import rerun_viewer

        yield rerun_viewer(options.rerun, source.size, source.name)
    if options.foxglove is not None:
        from amiwarp.plotting.live_viewers import foxglove_server

        yield foxglove_server(options.foxglove, source.size)


def _prism(calibration: Calibration) -> NominalPrism | None:
    """Return the nominal prism of a calibration; None if its optic has no prism, as a mirror."""
    return calibration.prism if calibration.model.PRISM else None


def _send_to(sink: Sink) -> Callable[[Compensated], None]:
    """Return a function that sends a compensated packet to a sink."""
    from amiwarp.live.stream.stream_format import encode_compensated

    return lambda packet: sink.send(encode_compensated(packet.events, packet.flags))


def _writer(
    path: Path,
    source: Source,
    calibration: Calibration,
    *,
    compensated: bool,
    encoders: int,
    offset_us: float = 0.0,
) -> LiveWriter:
    """Return the writer of a recording of the source, as it is or ``compensated``.

    ``encoders``: number of encoders whose samples it stores; ``offset_us``: their clock offset [us].
    """
    width, height = source.size
    metadata = recorded_from(source)
    if not calibration.model.PRISM:
        metadata["optic"] = calibration.model_name
    if compensated:
        metadata["compensated_with"] = calibration.model_name
    return LiveWriter(
        path,
        width=width,
        height=height,
        camera=calibration.model.camera,
        prism=source.prism or _prism(calibration),
        metadata=metadata,
        compensated=compensated,
        encoders=encoders,
        clock_offset_us=offset_us,
    )


def _live_lines(result: dict[str, Any]) -> list[str]:
    """Return the lines of the result: numbers of events and their marks, speed, clocks, controller, pictures, files."""
    marks = []
    for key, meaning in (
        ("outside", "outside the image"),
        ("extrapolated", "with an extrapolated angle"),
        ("without_angle", "without an angle"),
        ("dropped", "dropped"),
        ("late", "late"),
    ):
        if result[key]:
            marks.append(f"{result[key]:,} {meaning}")
    marked = ", ".join(marks) or "all inside the image with a measured angle"
    speed = f"{result['seconds']:.1f} s, {result['mev_per_s']:.3g} Mev/s"
    return [
        f"{result['compensated']:,} events ({marked}), {speed} by the {result['model']} model on {result['device']}",
        *lost_lines(result),
        *_clock_lines(result["clock"]),
        *controller_lines(result["controller"]),
        *_picture_lines(result["pictures"], result["seconds"]),
        *result["files"],
    ]


def _picture_lines(pictures: dict[str, Any] | None, seconds: float) -> list[str]:
    """Return the line of the result about pictures of the scene."""
    if pictures is None:
        return []
    text = f"{pictures['made']:,} pictures of the scene, {pictures['made'] / max(seconds, 1e-9):.1f} per second"
    if pictures["left_out"]:
        text += f", {pictures['left_out']:,} left out"
    if pictures["latency_ms"] is not None:
        median, slow = pictures["latency_ms"]
        text += f", {median:.0f} ms after the arrival of their last event (99 %: {slow:.0f} ms)"
    return [text]


def _clock_lines(clock: dict[str, Any] | None) -> list[str]:
    """Return the line of the result about the clocks of controller and camera."""
    if clock is None:
        return []
    if clock["uncertainty_us"] is None:
        return ["clocks of controller and camera: never related"]
    return [
        f"clocks of controller and camera: by {clock['from']}, ±{clock['uncertainty_us']:.1f} µs"
    ]
