"""``amiwarp live``: stages of a live stream, from the filter to motion compensation, and its outputs."""

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
    session_summary,
    stopped_by_interrupt,
)
from amiwarp.live.commands.stage_options import StageOptions, stage_lines, stage_summary
from amiwarp.live.commands.stream_description import StreamDescription
from amiwarp.live.commands.tensor_options import LiveTensors, TensorOptions, tensor_lines
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

            check_film(self.picture, fps=self.picture_hz)

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
        Path | None,
        typer.Option(
            help="Calibration file from 'amiwarp calibrate' (.json). Default: none; the events are not compensated."
        ),
    ] = None,
    stages: StageOptions,
    outputs: OutputOptions,
    stream: SourceOptions,
    second_ratio: SecondRatio = None,
    tensors: TensorOptions,
    pictures: PictureOptions,
    processing: ProcessingOptions,
    adaptive: AdaptiveOptions,
    common: cli.Common,
) -> None:
    """Filter, compensate and undistort the events of a live stream, and show its figures on one line.

    Without --calibration, the events of a plain camera pass all other stages, and nothing is compensated. --record and
    --raw-to get the events as they came, --out and --to those that passed the stages.

    Ctrl-C ends the command. If the stream breaks off, it exits with code 1 and keeps the events received so far.

    Every event is written once, in order. Events outside the image and events with an extrapolated angle are marked.
    """
    from amiwarp.live.stream.encoder_feed import clock_offset
    from amiwarp.results.calibration import Calibration

    outputs.check(json=common.json)
    pictures.check()
    calibrated = None
    if calibration is None:
        _check_plain(pictures, processing, adaptive, second_ratio)
    else:
        calibrated = Calibration.load(calibration)
    device = cli.choose_device(common.device)
    with contextlib.ExitStack() as resources:
        stop = threading.Event()
        line = resources.enter_context(StatusLine())
        link = resources.enter_context(stream.link())
        opened = stream.open(source, line.say)
        encoders = _encoders(opened, link, second_ratio, calibrated)
        chosen = stages.build_filter(opened.size)
        lens = stages.build_lens(opened.size, calibrated)
        # Before the files: Ctrl-C leaves none unfinished
        resources.enter_context(stopped_by_interrupt(stop))
        described = StreamDescription(opened, calibrated, chosen, lens, encoders)
        receivers = _Receivers(
            outputs,
            described,
            offset_us=clock_offset(opened, link),
            resources=resources,
            stop=stop,
            say=line.say,
        )
        live_tensors = tensors.build(
            opened.size, described.hello, resources, stop=stop, say=line.say
        )
        if live_tensors is not None:
            receivers.takers.append(live_tensors.output)
        picture_stream = None
        keeper = None
        if calibrated is not None:
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
            keeper = adaptive.build(calibrated.model, link, line.say)
        if picture_stream is not None:
            receivers.raw.append(picture_stream)
        session = _session(
            described,
            receivers,
            processing,
            link=link,
            second_ratio=second_ratio,
            keeper=keeper,
            device=device,
            say=line.say,
        )
        if calibrated is None:
            line.say("no calibration: events are not compensated; give one with --calibration")
        status = _follow(session, stop, stream.seconds, line, receivers, live_tensors)
        if picture_stream is not None:
            picture_stream.close()
        if live_tensors is not None:
            live_tensors.output.close(session.drain_left)
    files = list(outputs.files)
    if pictures.picture is not None:
        files.append(str(pictures.picture))
    if tensors.tensor_out is not None:
        files.append(str(tensors.tensor_out))
    result: dict[str, Any] = {
        "files": files,
        **session_summary(status, opened),
        "controller": None if link is None else controller_summary(link),
        "latency_ms": status.latency_ms,
        "pictures": None if picture_stream is None else _picture_summary(picture_stream),
        "stages": [stage_summary(stage) for stage in status.stages],
        "not_sent": receivers.not_sent,
        "tensors": None if live_tensors is None else live_tensors.summary(),
        "model": None if calibrated is None else calibrated.model_name,
        "device": device,
        "messages": list(line.messages),
    }
    if calibrated is None:
        result["compensated"] = 0
    lines = _live_lines(result, stage_lines(status.stages))
    _print_result(result, lines, common, to_stderr=outputs.use_stdout)
    check_whole(opened, status)


def _check_plain(
    pictures: PictureOptions,
    processing: ProcessingOptions,
    adaptive: AdaptiveOptions,
    second_ratio: float | None,
) -> None:
    """Raise :class:`AmiwarpError` for an option that needs a calibration."""
    default = ProcessingOptions()
    given = {
        "--picture": pictures.picture is not None,
        "--picture-to": pictures.picture_to is not None,
        "--adaptive": adaptive.adaptive,
        "--second-ratio": second_ratio is not None,
        "--wait-ms": processing.wait_ms != default.wait_ms,
        "--watch-s": processing.watch_s != default.watch_s,
    }
    for name, is_given in given.items():
        if is_given:
            raise AmiwarpError(
                f"{name} needs a calibration; give --calibration, or remove it", ErrorCode.OPTIONS
            )


def _encoders(
    source: Source, link: Link | None, second_ratio: float | None, calibration: Calibration | None
) -> int:
    """Return the number of prism angles of a session. A plain camera may have none."""
    from amiwarp.compensation.recordings import check_size
    from amiwarp.live.stream.encoder_feed import encoder_count

    if calibration is None:
        return encoder_count(source, link)
    angles = check_angles(source, link, second_ratio)
    check_size(calibration, source.size, source.name)
    check_model(source, link, angles, calibration)
    return angles


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
        stream: StreamDescription,
        *,
        offset_us: float,
        resources: contextlib.ExitStack,
        stop: threading.Event,
        say: Callable[[str], None],
    ) -> None:
        from amiwarp.live.stream.forward import Forward
        from amiwarp.live.stream.sinks import open_sink

        def sink(what: str, address: str | None, hello: bytes) -> Sink | None:
            if address is None:
                return None
            opened = open_sink(address, hello, stop=stop, say=say)
            resources.push(opened)
            if opened.address != address:  # for example, the system chose the port
                say(f"{what} packets are served at {opened.address}")
            return opened

        # First, because a recording that has begun is kept although a viewer's library is missing.
        self.viewers = [
            resources.enter_context(viewer) for viewer in _open_viewers(options, stream.source)
        ]
        self.raw: list[RawConsumer] = []
        if options.record is not None:
            writer = stream.raw_writer(options.record, offset_us)
            self.raw.append(resources.enter_context(writer))
        self.raw_sink = sink("uncompensated", options.raw_to, stream.raw_hello)
        if self.raw_sink is not None:
            self.raw.append(Forward(self.raw_sink))
        self.out = None
        if options.out is not None:
            self.out = resources.enter_context(stream.writer(options.out))
        self.sink = sink("plain" if stream.is_plain else "compensated", options.to, stream.hello)
        self.takers: list[Callable[[Compensated], None]] = []
        """Functions that take packets after the last stage."""
        if self.sink is not None:
            self.takers.append(_send_to(self.sink))
        if stream.is_plain:
            self.takers += [_show_plain(viewer) for viewer in self.viewers]
        else:
            self.takers += self.viewers
            self.raw += self.viewers

    @property
    def not_sent(self) -> dict[str, int]:
        """Number of packets that slow receivers lost, by the option that serves them."""
        served = {"to": self.sink, "raw_to": self.raw_sink}
        return {name: sink.lost for name, sink in served.items() if sink is not None}


def _session(
    stream: StreamDescription,
    receivers: _Receivers,
    options: ProcessingOptions,
    *,
    link: Link | None,
    second_ratio: float | None,
    keeper: SpeedKeeper | None,
    device: str,
    say: Callable[[str], None],
) -> Session:
    """Return the session that processes the source for the receivers."""
    from amiwarp.live.stream.session import Session

    return Session(
        stream.source,
        stream.calibration,
        link=link,
        second_ratio=second_ratio,
        chosen=stream.chosen,
        undistort=stream.lens,
        raw=receivers.raw,
        out=receivers.out,
        sinks=tuple(receivers.takers),
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
    tensors: LiveTensors | None,
) -> SessionStatus:
    """Run the session to its end, for at most ``seconds``, and show its status on ``line``."""

    def update(status: SessionStatus) -> None:
        line.update(status)
        if receivers.sink is not None:
            receivers.sink.tick()
        if tensors is not None:
            tensors.tick()

    status = session.run(stop, update, seconds=seconds)
    line.report_lost_packets(receivers.sink, receivers.raw_sink)
    for viewer in receivers.viewers:
        viewer.close()
        if viewer.lost:
            line.say(
                f"{viewer.lost:,} frames were not shown: the viewer, or this computer, is too slow"
            )
    return status


def _print_result(
    data: dict[str, Any], lines: list[str], common: cli.Common, *, to_stderr: bool
) -> None:
    """Print the result. If packets use standard output, print it as text on stderr."""
    if not to_stderr:
        cli.report(common, data, lines)
        return
    for text in lines:
        say(text)


def _open_viewers(options: OutputOptions, source: Source) -> Iterator[LiveViewer]:
    """Yield the viewers to which the options send images."""
    if options.rerun is not None:
        from amiwarp.plotting.live_viewers import rerun_viewer

        yield rerun_viewer(options.rerun, source.size, source.name)
    if options.foxglove is not None:
        from amiwarp.plotting.live_viewers import foxglove_server

        yield foxglove_server(options.foxglove, source.size)


def _send_to(sink: Sink) -> Callable[[Compensated], None]:
    """Return a function that sends packets to a sink: whole pixels as events of a sensor, others with their flags."""
    from amiwarp.live.stream.stream_format import encode_compensated, encode_events

    def send(packet: Compensated) -> None:
        if packet.events.whole_pixels:
            sink.send(encode_events(packet.events))
        else:
            sink.send(encode_compensated(packet.events, packet.flags))

    return send


def _show_plain(viewer: LiveViewer) -> Callable[[Compensated], None]:
    """Return a function that shows a packet that is not compensated."""
    return lambda packet: viewer.append(packet.events)


def _live_lines(result: dict[str, Any], stages: list[str]) -> list[str]:
    """Return the lines of the result: numbers of events and their marks, speed, clocks, controller, pictures, files."""
    speed = f"{result['seconds']:.1f} s, {result['mev_per_s']:.3g} Mev/s"
    if result["model"] is None:
        return [
            f"{result['events']:,} events, {speed}, not compensated",
            *lost_lines(result),
            *stages,
            *tensor_lines(result["tensors"]),
            *controller_lines(result["controller"]),
            *result["files"],
        ]
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
    return [
        f"{result['compensated']:,} events ({marked}), {speed} by the {result['model']} model on {result['device']}",
        *(stages if len(stages) > 2 else ()),
        *lost_lines(result),
        *_clock_lines(result["clock"]),
        *controller_lines(result["controller"]),
        *tensor_lines(result["tensors"]),
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
