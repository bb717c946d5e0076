"""Commands ``reconstruct``, ``pixels`` and ``depth``; ``phase`` has a file of its own."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from amiwarp.choices import CONTRAST, DepthMethod, Fill, PictureMethod, Tone
from amiwarp.cli import common as cli
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import EventSource, Recording
from amiwarp.io import open_recording
from amiwarp.io.output_formats import check_ending
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.reconstruction.phase_command import run_phase as run_phase
from amiwarp.tasks import Progress

if TYPE_CHECKING:
    from amiwarp.imaging.windows import Windows
    from amiwarp.reconstruction.phase_window import PhaseReconstruction
    from amiwarp.reconstruction.picture import Picture
    from amiwarp.reconstruction.reconstruct import Reconstruction
    from amiwarp.results.calibration import Calibration

OWN_NETWORK = "quarter-turn"
"""Value of ``--network`` for amiwarp's own network."""
LEAST_KNOWN = 0.005
"""Share of a picture that events must determine for it to be written."""
EARLIER_WINDOWS = 24
"""Largest number of windows before a picture's from which a network has its states."""
MOST_NAMED = 20
"""Largest number of hot or dead pixels that are named in text; JSON names all."""

_in_window = partial(typer.Option, rich_help_panel="Window")
_in_picture = partial(typer.Option, rich_help_panel="Picture")
_in_network = partial(typer.Option, rich_help_panel="Network")


@dataclass(frozen=True)
class WindowOptions:
    """Options for the time window whose events are used."""

    start: Annotated[
        float | None,
        _in_window(
            help="Start of the window (s from the first event). Default: one turn, less in short recordings; 0 for a "
            "video."
        ),
    ] = None
    length: Annotated[float | None, _in_window(min=1e-6, help="Length of the window (s).")] = None
    turns: Annotated[
        float | None,
        _in_window(
            min=0.25, help="Length of the window (turns of the prism), at least 0.25. Default: 1."
        ),
    ] = None
    fps: Annotated[
        float | None,
        _in_window(min=0.01, max=100_000.0, help="Frames per second of a video. Default: 25."),
    ] = None
    omega: Annotated[
        str | None,
        _in_window(
            help="Angular velocity of the camera about its x, y and z axes (rad/s), such as 0,0.6,0. "
            "Default: from the calibration.",
            metavar="X,Y,Z",
        ),
    ] = None

    def span(self, recording: Recording, turn_us: float | None, *, video: bool) -> tuple[int, int]:
        """Return the start and the length of the time window [us]. A video begins with the recording.

        ``turn_us``: duration of a turn [us], None if nothing turns.
        """
        from amiwarp.reconstruction.windows import window_span

        after = 0.0 if self.start is None and video else self.start
        start = None
        if after is not None:
            start = recording.events.t_first + cli.microseconds(after, "s", "--start")
        length = None
        if self.length is not None:
            length = cli.microseconds(self.length, "s", "--length")
        return window_span(recording, turn_us, start, length, self.turns)

    def camera_rotation(self) -> CameraRotation | None:
        """Return the camera's rotation given by an option, or None."""
        if self.omega is None:
            return None
        x, y, z = cli.numbers(self.omega, 3, "--omega")
        return CameraRotation((x, y, z))


@dataclass(frozen=True)
class PictureOptions:
    """Options for the content and the format of the picture."""

    method: Annotated[
        PictureMethod,
        _in_picture(
            help="solver: least squares over pairs of events, for any window and a moving camera. phase: sums of each "
            "pixel's events in phase with the optic, faster; for whole turns of a still scene. auto: phase where "
            "optic, camera and window allow it, else the solver; says which."
        ),
    ] = PictureMethod.SOLVER
    fill: Annotated[
        Fill,
        _in_picture(
            help="Filling of pixels that no event determines. none: black; smooth: smooth surface; edge: flat areas "
            "with sharp edges."
        ),
    ] = Fill.SMOOTH
    tone: Annotated[
        Tone,
        _in_picture(
            help="Grey values. mapped: contrast stretched, gamma 2.2; linear: proportional to intensity. Of a network, "
            "mapped: contrast stretched; linear: its values from 0 to 1."
        ),
    ] = Tone.MAPPED
    bits: Annotated[int, _in_picture(help="Bits per pixel of a .png: 8 or 16. A .tif has 16.")] = 8
    contrast: Annotated[
        float,
        _in_picture(
            min=0.01,
            max=10.0,
            help="ON threshold of the sensor (log intensity), which scales the brightness.",
        ),
    ] = CONTRAST
    mask: Annotated[
        Path | None,
        _in_picture(
            help="Mask of the pixels that events determine, to write (.png).", metavar="<path>"
        ),
        cli.OUTPUT,
    ] = None


@dataclass(frozen=True)
class NetworkOptions:
    """Options for the reconstruction by a network."""

    network: Annotated[
        Path | None,
        _in_network(
            help="Network to use instead of the solver: 'quarter-turn' for amiwarp's own, which makes a picture of the "
            "compensated events of a quarter turn, or a TorchScript (.pt) or ONNX (.onnx) file of a network that takes "
            "normalised voxel grids, such as E2VID. Needs the extra torch or onnx.",
            metavar="quarter-turn|<path>",
        ),
    ] = None
    bins: Annotated[int, _in_network(min=1, help="Time bins of the network's voxel grids.")] = 5
    multiple: Annotated[
        int,
        _in_network(
            min=1, help="The network's height and width are multiples of this number (px)."
        ),
    ] = 8


def run_reconstruct(
    recording: Annotated[Path, typer.Argument(help="Recording in any supported format.")],
    out: Annotated[
        Path,
        typer.Argument(help="File to write: .png, .tif (16 bit), .npy (log intensity) or .mp4."),
        cli.OUTPUT,
    ],
    *,
    calibration: Annotated[
        Path | None,
        typer.Option(
            help="Calibration file from 'amiwarp calibrate' (.json). May be left out with --network: the network then "
            "takes the events as recorded."
        ),
    ] = None,
    window: WindowOptions,
    picture: PictureOptions,
    by: NetworkOptions,
    layout: cli.FileOptions,
    common: cli.Common,
) -> None:
    """Reconstruct a picture of the scene from the events of a window, or a video from a sliding window.

    A window needs at least a quarter turn of the prism. Intensity is relative, because events do not hold absolute
    brightness. With --network, the windows of a video follow one another by default, and up to 24 windows before
    the window of a picture give a recurrent network its states.
    """
    from amiwarp.reconstruction.film_files import VIDEO
    from amiwarp.reconstruction.phase_window import PhaseReconstruction
    from amiwarp.reconstruction.reconstruct import Reconstruction
    from amiwarp.results.calibration import Calibration

    _check_options(out, window, picture, by)
    video = out.suffix.lower() == VIDEO
    device = cli.choose_device(common.device)
    given = None if calibration is None else Calibration.load(calibration)
    began = time.perf_counter()
    if by.network is not None:
        opened = open_recording(recording, **layout.given())
        data = _by_network(opened, given, out, window, picture, by, device)
        data = {"file": str(out), **data, "seconds": time.perf_counter() - began, "device": device}
        cli.report(common, data, [_network_line(data)])
        return

    if given is None:
        raise AmiwarpError(
            f"{out}: --calibration is missing; give a calibration file, or a network by --network",
            ErrorCode.OPTIONS,
        )
    opened = open_recording(recording, **layout.given())
    why = ""
    work: Reconstruction | PhaseReconstruction | None = None
    if picture.method is PictureMethod.AUTO:
        work, why = _chosen(opened, given, window, picture, device, video=video)
        method = PictureMethod.SOLVER if work is None else PictureMethod.PHASE
        picture = replace(picture, method=method)
    elif picture.method is PictureMethod.PHASE:
        work = PhaseReconstruction(opened, given, device=device)
    if work is None:
        work = Reconstruction(
            opened,
            given,
            camera_rotation=window.camera_rotation(),
            fill=picture.fill,
            device=device,
        )
    start, length = window.span(work.recording, work.turn_us, video=video)
    began = time.perf_counter()
    with cli.progress("reconstructing") as advance:
        if video:
            data = _video(work, out, (start, length), window.fps or 25.0, picture, advance)
        else:
            data = _still(work.window(start, length), out, picture)
    seconds = time.perf_counter() - began
    data = {
        "file": str(out),
        "start_us": start,
        "length_us": length,
        "method": picture.method.value,
        **data,
        "seconds": seconds,
        "device": device,
    }
    lines = [_reconstructed_line(data)]
    if why:
        data["chosen"] = why
        lines.append(f"--method auto took {picture.method.value}: {why}")
    cli.report(common, data, lines)


def _chosen(
    opened: Recording,
    given: Calibration,
    window: WindowOptions,
    picture: PictureOptions,
    device: str,
    *,
    video: bool,
) -> tuple[PhaseReconstruction | None, str]:
    """Return the work by sums in phase, None if the solver must do it, and why."""
    from amiwarp.reconstruction.phase_window import PhaseReconstruction, whole_turns

    if window.omega is not None or picture.fill is not Fill.SMOOTH:
        return None, "--omega and --fill apply to it"
    try:
        work = PhaseReconstruction(opened, given, device=device)
        start, length = window.span(opened, work.turn_us, video=video)
        whole_turns(work.encoder, start, length)
    except AmiwarpError as error:
        return None, str(error)
    return work, "whole turns, a camera at rest; the scene must be still"


def _check_options(
    out: Path, window: WindowOptions, picture: PictureOptions, by: NetworkOptions
) -> None:
    """Raise :class:`AmiwarpError` for options that do not apply to what is written."""
    from amiwarp.reconstruction.film_files import VIDEO
    from amiwarp.reconstruction.picture_files import MASK_SUFFIXES, check_path

    check_path(out)
    if picture.mask is not None:
        check_path(picture.mask, MASK_SUFFIXES)
    ending = out.suffix.lower()
    video = ending == VIDEO
    if video and (picture.mask is not None or picture.bits != 8):
        raise AmiwarpError(
            "--mask and --bits apply to a single picture; leave them out for a video",
            ErrorCode.OPTIONS,
        )
    if ending == ".npy" and (picture.bits != 8 or picture.tone != Tone.MAPPED):
        raise AmiwarpError(
            f"{out}: --bits and --tone apply to .png, .tif and .mp4; leave them out for .npy",
            ErrorCode.OPTIONS,
        )
    in_a_file = by.network is not None and str(by.network) != OWN_NETWORK
    if not in_a_file and replace(by, network=None) != NetworkOptions():
        raise AmiwarpError(
            "--bins and --multiple apply to a network in a file; give it by --network",
            ErrorCode.OPTIONS,
        )
    method = picture.method
    if method is not PictureMethod.SOLVER and by.network is not None:
        raise AmiwarpError(
            f"--method {method.value} and --network are both given; give one of them",
            ErrorCode.OPTIONS,
        )
    of_solver = window.omega is not None or picture.fill is not Fill.SMOOTH
    if method is PictureMethod.PHASE and of_solver:
        raise AmiwarpError(
            "--omega and --fill apply to the solver; leave them out with --method phase",
            ErrorCode.OPTIONS,
        )
    if not video and window.fps is not None:
        raise AmiwarpError(
            f"{out}: --fps applies to a video; give a name that ends in {VIDEO}", ErrorCode.OPTIONS
        )


def _still(found: Picture, out: Path, options: PictureOptions) -> dict[str, Any]:
    from amiwarp.reconstruction.picture_files import save_mask, save_picture

    known = float(found.known.mean())
    if known < LEAST_KNOWN:
        raise AmiwarpError(
            f"{out}: the events determine {100.0 * known:.1f} % of the picture; calibrate this recording, if the "
            "calibration belongs to another one, or give a longer --length"
        )
    save_picture(found, out, tone=options.tone, bits=options.bits, contrast=options.contrast)
    if options.mask is not None:
        save_mask(found, options.mask)
    facts = {"frames": 1, "known": known, "off_excess": found.off_excess}
    if options.method is PictureMethod.PHASE:
        return facts
    return {
        **facts,
        "pairs": found.pairs,
        "residual": found.residual,
        "smoothness": found.smoothness,
        "hot_pixels": found.hot,
    }


def _video(
    work: Reconstruction | PhaseReconstruction,
    out: Path,
    span: tuple[int, int],
    fps: float,
    options: PictureOptions,
    advance: Progress,
) -> dict[str, Any]:
    from amiwarp.reconstruction.picture_files import save_video

    step = 1e6 / fps
    count = work.count(*span, step_us=step)
    pairs: list[int] = []

    def pictures() -> Iterator[Picture]:
        for found in work.windows(*span, step_us=step):
            yield found
            pairs.append(found.pairs)
            advance("reconstructing", len(pairs) / count)

    frames = save_video(pictures(), out, fps=fps, tone=options.tone, contrast=options.contrast)
    facts = {"frames": frames, "fps": fps}
    return facts if options.method is PictureMethod.PHASE else {**facts, "pairs": sum(pairs)}


def _reconstructed_line(data: dict[str, Any]) -> str:
    work = "sums in phase"
    if data["method"] == PictureMethod.SOLVER:
        work = f"{data['pairs'] / 1e6:.2f} million pairs of events"
    speed = f"{work} in {data['seconds']:.2f} s on {data['device']}"
    window = f"{data['length_us'] / 1e3:.1f} ms"
    if "fps" in data:
        return f"{data['file']}: {data['frames']} frames of {window} at {data['fps']:g}/s, {speed}"
    known = f"{100.0 * data['known']:.0f} % of the picture determined by events"
    return f"{data['file']}: {window}, {speed}; {known}"


def _by_network(
    recording: Recording,
    calibration: Calibration | None,
    out: Path,
    window: WindowOptions,
    picture: PictureOptions,
    by: NetworkOptions,
    device: str,
) -> dict[str, Any]:
    """Write a picture or a video that a network makes, and return the facts about it."""
    from amiwarp.compensation.recordings import check_size
    from amiwarp.events.encoder_speed import turn_between
    from amiwarp.reconstruction.film_files import VIDEO
    from amiwarp.reconstruction.picture_files import save_network_picture, save_network_video

    assert by.network is not None
    own = str(by.network) == OWN_NETWORK
    _check_solver_options(window, picture, own)
    events = recording.events
    if not len(events):
        raise AmiwarpError(
            f"{recording.name}: has no events; give a recording with events",
            ErrorCode.CONTENT_MISSING,
        )
    if own and calibration is None:
        raise AmiwarpError(
            f"{out}: --calibration is missing; amiwarp's own network takes compensated events",
            ErrorCode.OPTIONS,
        )
    network = _network(by.network, by, device)
    optic: dict[str, Any] = {}
    encoder = recording.encoder
    if calibration is not None:
        check_size(calibration, events.size, recording.name)
        encoder = calibration.encoder_for(encoder, events.t_first, events.t_last)
        optic = {"model": calibration.model, "encoder": encoder}
    turn_us = None if encoder is None else turn_between(encoder, events.t_first, events.t_last)

    video = out.suffix.lower() == VIDEO
    fps = window.fps or 25.0
    if window.length is None and window.turns is None:
        if own:
            window = replace(window, turns=0.25)
        elif video:
            window = replace(window, length=1.0 / fps)
    start, length = window.span(recording, turn_us, video=video)
    if video:
        count = max(1, math.floor((events.t_last + 1 - start - length) * fps / 1e6) + 1)
        starts = start + np.rint(np.arange(count) * (1e6 / fps)).astype(np.int64)
    else:
        earlier = 0 if own else min(EARLIER_WINDOWS, (start - events.t_first) // length)
        starts = start - length * np.arange(earlier, -1, -1, dtype=np.int64)
    cut = _windows(events, starts, length)

    with cli.progress("reconstructing") as advance:

        def images() -> Iterator[Any]:
            for k, image in enumerate(network.over(recording, cut, **optic)):
                if len(image) != 1:
                    raise AmiwarpError(
                        f"{by.network}: makes {len(image)} channels; give a network that makes pictures"
                    )
                yield _own_picture(image[0], out, picture) if own else image[0]
                advance("reconstructing", (k + 1) / len(cut))

        if video:
            save_network_video(images(), out, fps=fps, tone=picture.tone)
        else:
            *_, last = images()
            save_network_picture(last, out, tone=picture.tone, bits=picture.bits)
    facts = {"frames": len(cut), "fps": fps} if video else {"frames": 1}
    return {
        "start_us": start,
        "length_us": length,
        **facts,
        "network": str(by.network),
        "windows": len(cut),
        "events": int((cut.stop - cut.start).sum()),
    }


def _check_solver_options(window: WindowOptions, picture: PictureOptions, own: bool) -> None:
    """Raise :class:`AmiwarpError` for options that do not apply to a network. ``own``: whether it is amiwarp's own."""
    if picture.mask is not None or picture.fill is not Fill.SMOOTH or window.omega is not None:
        raise AmiwarpError(
            "--mask, --fill and --omega apply to the solver; leave them out with --network",
            ErrorCode.OPTIONS,
        )
    if picture.contrast != CONTRAST and not own:
        raise AmiwarpError(
            f"--contrast applies to the solver and to the network {OWN_NETWORK}; leave it out",
            ErrorCode.OPTIONS,
        )


def _network(path: Path, by: NetworkOptions, device: str) -> Any:
    """Return amiwarp's own network, or the one in a file."""
    from amiwarp.imaging.tensors import voxel_grid
    from amiwarp.imaging.to_tensor import ToTensor
    from amiwarp.learning.networks import Network

    if str(path) == OWN_NETWORK:
        return Network.quarter_turn(device)
    tensors = ToTensor(voxel_grid, bins=by.bins, normalize=True)
    return Network(path, tensors, multiple=by.multiple, device=device)


def _windows(events: EventSource, starts: NDArray[np.int64], length: int) -> Windows:
    """Return windows of a length [us] with the indices of their events."""
    from amiwarp.imaging.windows import Windows

    ends = starts + length
    first = np.array([events.find(int(t)) for t in starts])
    after = np.array([events.find(int(t)) for t in ends])
    return Windows(first, after, starts, ends)


def _own_picture(log: Any, out: Path, picture: PictureOptions) -> Any:
    """Return what a file shows of log intensity in thresholds: natural units, or a picture like a camera's."""
    from amiwarp.reconstruction.picture_files import BRIGHT, GAMMA

    log = picture.contrast * log
    if out.suffix.lower() == ".npy":
        return log
    if picture.tone is Tone.LINEAR:
        return np.exp(log - np.percentile(log, BRIGHT))
    return np.exp((log - np.median(log)) / GAMMA)


def _network_line(data: dict[str, Any]) -> str:
    work = f"{data['events'] / 1e6:.2f} million events in {data['seconds']:.2f} s"
    speed = f"{work} on {data['device']} by {data['network']}"
    window = f"{data['length_us'] / 1e3:.1f} ms"
    if "fps" in data:
        return f"{data['file']}: {data['frames']} frames of {window} at {data['fps']:g}/s, {speed}"
    earlier = f" after {data['windows'] - 1} earlier windows" if data["windows"] > 1 else ""
    return f"{data['file']}: {window}{earlier}, {speed}"


def run_pixels(
    recording: Annotated[Path, typer.Argument(help="Recording in any supported format.")],
    calibration: Annotated[
        Path, typer.Argument(help="Calibration file from 'amiwarp calibrate' (.json).")
    ],
    out: Annotated[Path, typer.Argument(help="Map of the pixels to write (.npz)."), cli.OUTPUT],
    *,
    start: Annotated[
        float | None,
        _in_window(
            min=0.0, help="Start of the used time (s from the first event). Default: one turn."
        ),
    ] = None,
    length: Annotated[
        float | None,
        _in_window(min=1e-6, help="Length of the used time (s). Default: until the end."),
    ] = None,
    refractory_us: Annotated[
        float | None,
        typer.Option(
            min=0.0, help="Refractory period of the sensor (us). Default: the calibration's."
        ),
    ] = None,
    layout: cli.FileOptions,
    common: cli.Common,
) -> None:
    """Measure the ON and OFF threshold of every pixel, and find hot and dead pixels, from a calibrated recording.

    Thresholds are relative to their median. Scene and camera must be still, or rotate as calibrated. A threshold needs
    20 pairs of events, so a longer recording reaches pixels that see less texture.
    """
    from amiwarp.brightness.sensor_timing import SensorTiming
    from amiwarp.reconstruction.pixels import pixel_thresholds
    from amiwarp.results.calibration import Calibration

    check_ending(out, "pixel maps are written", [".npz"])
    device = cli.choose_device(common.device)
    source = open_recording(recording, **layout.given())
    first = source.events.t_first if len(source.events) else 0
    began = time.perf_counter()
    with cli.progress("measuring the pixels") as advance:
        found = pixel_thresholds(
            source,
            Calibration.load(calibration),
            sensor=None if refractory_us is None else SensorTiming(refractory_us=refractory_us),
            start_us=None if start is None else first + cli.microseconds(start, "s", "--start"),
            length_us=None if length is None else cli.microseconds(length, "s", "--length"),
            device=device,
            progress=advance,
        )
    found.save(out)
    width, height = found.size
    data: dict[str, Any] = {
        "file": str(out),
        "width": width,
        "height": height,
        "on": _threshold_facts(found.on, found.on_std, found.on_pairs),
        "off": _threshold_facts(found.off, found.off_std, found.off_pairs),
    }
    for name in ("hot", "dead"):
        y, x = np.nonzero(getattr(found, name))
        data[name] = np.stack([x, y], axis=1).tolist()
    lines = _pixel_lines(data)
    seconds = time.perf_counter() - began
    cli.report(common, {**data, "seconds": seconds, "device": device}, lines)


def _threshold_facts(
    values: NDArray[Any], std: NDArray[Any], pairs: NDArray[Any]
) -> dict[str, Any]:
    """Return facts about the thresholds of one polarity; the mismatch is their spread beyond their errors."""
    known = np.isfinite(values)
    mismatch = None
    median_std = None
    if known.any():
        variance = float(np.var(values[known]) - np.mean(std[known] ** 2))
        mismatch = math.sqrt(max(0.0, variance))
        median_std = float(np.median(std[known]))
    return {
        "known": int(known.sum()),
        "mismatch": mismatch,
        "std": median_std,
        "pairs": int(pairs.sum()),
    }


def _pixel_lines(data: dict[str, Any]) -> list[str]:
    lines = [data["file"]]
    for name in ("on", "off"):
        one = data[name]
        if one["known"]:
            lines.append(
                f"{name.upper()} threshold of {one['known']:,} pixels, each ± {100 * one['std']:.1f} %; they differ by "
                f"{100 * one['mismatch']:.1f} %"
            )
    for name in ("hot", "dead"):
        pixels = data[name]
        words = [f"({x}, {y})" for x, y in pixels[:MOST_NAMED]]
        if len(pixels) > MOST_NAMED:
            words.append("...")
        kind = "pixel" if len(pixels) == 1 else "pixels"
        lines.append(f"{len(pixels)} {name} {kind} {' '.join(words)}".rstrip())
    return lines


def run_depth(
    recording: Annotated[Path, typer.Argument(help="Recording in any supported format.")],
    calibration: Annotated[
        Path, typer.Argument(help="Calibration file from 'amiwarp calibrate' (.json).")
    ],
    out: Annotated[Path, typer.Argument(help="Map of inverse depth to write (.npz)."), cli.OUTPUT],
    *,
    ply: Annotated[
        Path | None, typer.Option(help="Point cloud to write (.ply)."), cli.OUTPUT
    ] = None,
    figure: Annotated[
        Path | None,
        typer.Option(help="Figure of the depths and their deviations to write (.png)."),
        cli.OUTPUT,
    ] = None,
    method: Annotated[
        DepthMethod,
        typer.Option(
            help="photometric: a brightness map for each depth. phase: sums of each pixel's events in phase with the "
            "plate, in a fraction of the time, with one depth for tiles of 48 px."
        ),
    ] = DepthMethod.PHOTOMETRIC,
    nearest_m: Annotated[float, typer.Option(help="Smallest depth that is tried (m).")] = 0.25,
    layout: cli.FileOptions,
    common: cli.Common,
) -> None:
    """Find the depth of every edge from a camera at rest behind a rotating tilted plate, with its uncertainty.

    Scene and camera must be still. Depths are unknown where the events do not determine them to 10 %.
    """
    from amiwarp.reconstruction.depth_at_rest import depth
    from amiwarp.results.calibration import Calibration

    check_ending(out, "depth maps are written", [".npz"])
    if ply is not None:
        check_ending(ply, "points are written", [".ply"])
    if figure is not None:
        check_ending(figure, "figures are written", [".png"])
    device = cli.choose_device(common.device)
    began = time.perf_counter()
    with cli.progress("finding depths") as advance:
        found = depth(
            open_recording(recording, **layout.given()),
            Calibration.load(calibration),
            method=method,
            nearest_m=nearest_m,
            device=device,
            progress=advance,
        )
    found.save(out)
    if ply is not None:
        found.save_points(ply)
    if figure is not None:
        from amiwarp.plotting.world_figure import draw_depths

        draw_depths(figure, found)
    depths = 1.0 / found.inverse_depth[found.known]
    height, width = found.inverse_depth.shape
    data: dict[str, Any] = {
        "file": str(out),
        "width": width,
        "height": height,
        "method": method.value,
        "known": int(found.known.sum()),
        "depth_m": [float(x) for x in np.percentile(depths, [5, 50, 95])],
        "relative_std": float(np.median((found.std / found.inverse_depth)[found.known])),
        "ply": None if ply is None else str(ply),
        "figure": None if figure is None else str(figure),
        "seconds": time.perf_counter() - began,
        "device": device,
    }
    near, middle, far = data["depth_m"]
    line = (
        f"{out}: {data['known']:,} of {width * height:,} pixels with a known depth, "
        f"{near:.3g} to {far:.3g} m (median {middle:.3g} m), "
        f"to {100 * data['relative_std']:.2g} %, in {data['seconds']:.1f} s on {device}"
    )
    cli.report(common, data, [line])
