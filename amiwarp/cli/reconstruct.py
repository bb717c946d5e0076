"""``amiwarp reconstruct``: reconstruction of a picture or a video of the scene from events."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amiwarp.choices import CONTRAST, Fill, Tone
from amiwarp.cli.console import choose_device, progress, report
from amiwarp.cli.options import OUTPUT, Common, numbers
from amiwarp.errors import AmiwarpError
from amiwarp.io import open_recording
from amiwarp.optics.camera import CameraRotation
from amiwarp.progress import Progress

if TYPE_CHECKING:
    from amiwarp.reconstruction.picture import Picture, Reconstruction

EXAMPLE = "amiwarp reconstruct recording.h5 picture.png --calibration calibration.json --turns 1"

_in_window = partial(typer.Option, rich_help_panel="Window")
_in_picture = partial(typer.Option, rich_help_panel="Picture")


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
        float | None, _in_window(min=0.01, help="Length of the window (turns of the prism), at least 0.25. Default: 1.")
    ] = None
    fps: Annotated[
        float | None, _in_window(min=0.01, max=100_000.0, help="Frames per second of a video. Default: 25.")
    ] = None
    omega: Annotated[
        str | None,
        _in_window(
            help="Angular velocity of the camera about its x, y and z axes (rad/s), such as 0,0.6,0. "
            "Default: from the calibration.",
            metavar="X,Y,Z",
        ),
    ] = None

    def span(self, work: Reconstruction, *, video: bool) -> tuple[int, int]:
        """Return the start and the length of the time window [us]. A video begins with the recording."""
        after = 0.0 if self.start is None and video else self.start
        start = None if after is None else work.recording.events.t_first + round(after * 1e6)
        return work.span(start, None if self.length is None else max(1, round(self.length * 1e6)), self.turns)

    def camera_rotation(self) -> CameraRotation | None:
        """Return the camera's rotation given by an option, or None."""
        if self.omega is None:
            return None
        x, y, z = numbers(self.omega, 3, "--omega")
        return CameraRotation((x, y, z))


@dataclass(frozen=True)
class PictureOptions:
    """Options for the content and the format of the picture."""

    fill: Annotated[
        Fill,
        _in_picture(
            help="Filling of pixels that no event determines. none: black; smooth: smooth surface; edge: flat areas "
            "with sharp edges."
        ),
    ] = Fill.SMOOTH
    tone: Annotated[
        Tone, _in_picture(help="Grey values. mapped: contrast stretched, gamma 2.2; linear: proportional to intensity.")
    ] = Tone.MAPPED
    bits: Annotated[int, _in_picture(help="Bits per pixel of a .png: 8 or 16. A .tif has 16.")] = 8
    contrast: Annotated[
        float,
        _in_picture(
            min=0.01, max=10.0, help="ON threshold of the sensor (log intensity), which scales the brightness."
        ),
    ] = CONTRAST
    mask: Annotated[
        Path | None,
        _in_picture(help="Mask of the pixels that events determine, to write (.png).", metavar="<path>"),
        OUTPUT,
    ] = None


def run(
    recording: Annotated[Path, typer.Argument(help="Recording in any supported format.")],
    out: Annotated[
        Path, typer.Argument(help="File to write: .png, .tif (16 bit), .npy (log intensity) or .mp4."), OUTPUT
    ],
    *,
    calibration: Annotated[Path, typer.Option(help="Calibration file from 'amiwarp calibrate' (.json).")],
    window: WindowOptions,
    picture: PictureOptions,
    common: Common,
) -> None:
    """Reconstruct a picture of the scene from the events of a window, or a video from a sliding window.

    A window needs at least a quarter turn of the prism. Intensity is relative, because events do not hold absolute
    brightness.
    """
    from amiwarp.calib import Calibration
    from amiwarp.reconstruction.picture import MASK_SUFFIXES, VIDEO, Reconstruction, check_path

    check_path(out)
    if picture.mask is not None:
        check_path(picture.mask, MASK_SUFFIXES)
    video = out.suffix.lower() == VIDEO
    if video and (picture.mask is not None or picture.bits != 8):
        raise AmiwarpError("--mask and --bits apply to a single picture; leave them out for a video")
    if not video and window.fps is not None:
        raise AmiwarpError(f"{out}: --fps applies to a video; give a name that ends in {VIDEO}")
    device = choose_device(common.device)
    work = Reconstruction(
        open_recording(recording), Calibration.load(calibration), camera_rotation=window.camera_rotation(),
        fill=picture.fill, device=device,
    )  # fmt: skip
    start, length = window.span(work, video=video)
    began = time.perf_counter()
    with progress("reconstructing") as advance:
        if video:
            data = _video(work, out, (start, length), window.fps or 25.0, picture, advance)
        else:
            data = _still(work.window(start, length), out, picture)
    seconds = time.perf_counter() - began
    data = {"file": str(out), "start_us": start, "length_us": length, **data, "seconds": seconds, "device": device}
    report(common, data, [_line(data)])


def _still(found: Picture, out: Path, options: PictureOptions) -> dict[str, Any]:
    from amiwarp.reconstruction.picture import save_mask, save_picture

    save_picture(found, out, tone=options.tone, bits=options.bits, contrast=options.contrast)
    if options.mask is not None:
        save_mask(found, options.mask)
    return {
        "frames": 1,
        "pairs": found.pairs,
        "known": float(found.known.mean()),
        "residual": found.residual,
        "smoothness": found.smoothness,
        "off_excess": found.off_excess,
        "hot_pixels": found.hot,
    }


def _video(
    work: Reconstruction, out: Path, span: tuple[int, int], fps: float, options: PictureOptions, advance: Progress
) -> dict[str, Any]:
    from amiwarp.reconstruction.picture import save_video

    step = 1e6 / fps
    count = work.count(*span, step_us=step)
    pairs: list[int] = []

    def pictures() -> Iterator[Picture]:
        for found in work.windows(*span, step_us=step):
            yield found
            pairs.append(found.pairs)
            advance("reconstructing", len(pairs) / count)

    frames = save_video(pictures(), out, fps=fps, tone=options.tone, contrast=options.contrast)
    return {"frames": frames, "fps": fps, "pairs": sum(pairs)}


def _line(d: dict[str, Any]) -> str:
    speed = f"{d['pairs'] / 1e6:.2f} million pairs of events in {d['seconds']:.2f} s on {d['device']}"
    window = f"{d['length_us'] / 1e3:.1f} ms"
    if "fps" in d:
        return f"{d['file']}: {d['frames']} frames of {window} at {d['fps']:g}/s, {speed}"
    return f"{d['file']}: {window}, {speed}; {100.0 * d['known']:.0f} % of the picture determined by events"
