"""What page and window do in threads: phase, calibration, live stream as a recording, and files."""

import asyncio
import contextlib
import itertools
import math
import re
import weakref
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.calibration import calibrate
from amiwarp.calib.result import Calibration
from amiwarp.calib.settings import AUTO, Settings
from amiwarp.choices import Axis, View
from amiwarp.compensation.recordings import BlockCompensator
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events, Recording
from amiwarp.imaging.regions import MOST_SEARCHED, busiest, inside
from amiwarp.io import RecordingWriter
from amiwarp.io.files import check_output
from amiwarp.io.formats import check_ending
from amiwarp.io.plain_files import save_map, save_rows
from amiwarp.io.spans import span_blocks
from amiwarp.optics.models import ExactModel, alternatives
from amiwarp.plotting.colours import Scale
from amiwarp.plotting.meshes import Box
from amiwarp.reconstruction.picture import save_film
from amiwarp.tasks import Progress, silent
from amiwarp.viewer.drawing import Look, Scene, axis_range, caption, picture_state, select_part, shown_lines
from amiwarp.viewer.filters import rate_text
from amiwarp.viewer.inspector import CURVE_HALF_WIDTH, Inspector, Knobs, Source, size_name
from amiwarp.viewer.layout import EXPORTS, SLIDERS, UNITS, orbit_text

# Progress of long work in threads.

PROGRESS_S = 0.1
"""Shortest interval between two progress messages of a job [s]. The page would draw each of eighty per second."""


class JobCancelled(Exception):
    """Raised to stop work whose result is no longer needed."""


class JobProgress:
    """Progress callback of a job in a thread. It stops the job once ``cancelled`` is set.

    It holds the page by a weak reference, because NLopt never releases its callbacks.
    """

    def __init__(self, show: Callable[[str, float], None]) -> None:
        """``show``: method of the page that shows the name of a step and the finished share, 0 to 1."""
        self.cancelled = False
        self.ended = False
        """Whether a film ends with the pictures made so far."""
        self._show, self._loop, self._last_s = weakref.WeakMethod(show), asyncio.get_running_loop(), -math.inf

    def __call__(self, what: str, share: float) -> None:
        if self.cancelled or self._show() is None:
            raise JobCancelled
        if (now := self._loop.time()) >= self._last_s + PROGRESS_S:
            self._last_s = now
            self._loop.call_soon_threadsafe(self._pass_on, what, share)

    def _pass_on(self, what: str, share: float) -> None:
        if (show := self._show()) is not None and not self.cancelled:
            show(what, share)


# Estimate of the prism's phase at first sight, so that the page opens with compensated events.

COARSE = 24
"""Number of phases of the first search, over one turn."""
FINER = (3.0, 12.0)
"""Divisors of the step of the first search, for the steps of the second and the third one."""
LEAST_GAIN = 1.3
"""Smallest ratio of the sharpness at the best phase to that at the median phase. It is 2 to 3 for scenes, and 1.1 for
random events."""


def estimate_phase(inspector: Inspector) -> bool:
    """Set an unknown phase to that with the highest sharpness of the time window; return whether there is one.

    A phase that is known, from a calibration or by hand, is kept. So is any phase if the prism does not rotate, or if
    no phase sharpens the image.
    """
    if inspector.sources["phase"] is not Source.ASSUMED or not math.isfinite(inspector.turn_us):
        return False
    searched, window, size = inspector, inspector.loaded, inspector.recording.events.size
    if math.prod(size) > MOST_SEARCHED:  # of a large sensor, the part with most events, so that the search stays short
        part, *times, _ = select_part(inspector, window, busiest(inspector.counts(window, None)))
        searched = Inspector(part, device=inspector.device)
        searched.set(inspector.knobs)
        searched.window = times[0], times[1]
    measure = searched.sharpness_meter()

    @cache
    def sharpness(phase: float) -> float:
        return measure(replace(inspector.knobs, phase=phase))

    step = math.tau / COARSE
    phases = (step * np.arange(COARSE) - math.pi).tolist()
    found, usual = max(phases, key=sharpness), float(np.median([*map(sharpness, phases)]))
    for share in FINER:
        found = max((found + k * step / share for k in range(-2, 3)), key=sharpness)
    if sharpness(found) < max(measure(None), LEAST_GAIN * usual):
        return False
    inspector.set(replace(inspector.knobs, phase=found))
    inspector.sources["phase"] = Source.ESTIMATED
    return True


# Calibration on what the inspector shows, and the sharpness over two parameters.

SHARPNESS_ONLY = ("sharpness",)
"""Stages of a calibration without the photometric one."""
SURFACE_POINTS = (21, 37)
"""Number of values of the first and the second parameter of a cost surface."""


def calibrated_events(inspector: Inspector, *, whole: bool = False) -> tuple[Recording, str]:
    """Return the events that :func:`find_calibration` uses, and a description of them for the page."""
    if whole:
        return inspector.recording, f"the whole recording, {len(inspector.recording.events):,} events"
    part, start_us, length_us, _ = select_part(inspector, inspector.loaded, inspector.loaded.region)
    s, start_s = inspector.selection, (start_us - inspector.recording.events.t_first) * 1e-6
    kind, end_s = "" if s.polarity is None else ("OFF ", "ON ")[s.polarity], start_s + length_us * 1e-6
    texts = [f"{len(part.events):,} {kind}events from {start_s:.3f} s to {end_s:.3f} s"]
    if s.region is not None:
        left, top, right, bottom = s.region
        texts.append(f"x {left} to {right}, y {top} to {bottom} px")
    texts += ["without hot pixels"] if s.hide_hot else []
    texts += [f"without background activity ({s.noise_us * 1e-3:g} ms)"] if s.noise_us is not None else []
    texts += [f"refractory period {s.refractory_us * 1e-3:g} ms"] if s.refractory_us else []
    texts += [f"at most {rate_text(s.most_per_s)}"] if s.most_per_s else []
    texts += [f"one of {s.every} events"] if s.every > 1 else []
    return part, ", ".join(texts)


def find_calibration(
    inspector: Inspector, settings: Settings | None = None, *, whole: bool = False, progress: Progress | None = None
) -> tuple[Calibration, str]:
    """Calibrate on the events of the window and the selection, or on the whole recording as ``amiwarp calibrate`` does.

    Returns the calibration of the whole camera, which nobody has accepted yet, and a description of it. Without an
    encoder, the search starts at the speed set on the page. Raises :class:`AmiwarpError` if these events cannot
    determine the parameters.
    """
    (recording, scope), rpm = calibrated_events(inspector, whole=whole), inspector.knobs.rpm
    wedge = ExactModel.NAME in alternatives(inspector.knobs.model)
    settings = settings or Settings(model=AUTO if wedge else inspector.knobs.model)
    if rpm and not inspector.has_encoder:
        settings = replace(settings, start={"rpm": rpm, **settings.start})
    try:
        found = calibrate(recording, settings, device=inspector.device, progress=progress)
    except AmiwarpError as error:
        if whole or settings.stages == SHARPNESS_ONLY:
            raise
        # Some thousand events of a small region can mislead the checks of the photometric stage.
        settings = replace(settings, stages=SHARPNESS_ONLY)
        found = calibrate(recording, settings, device=inspector.device, progress=progress)
        reason = str(error).partition(";")[0].removeprefix(f"{recording.name}: ").removeprefix("photometric stage: ")
        doubt = f"by sharpness alone, as the photometric stage refused so few events ({reason}); to be sure, calibrate "
        doubt += "on the whole recording"
        found = replace(found, warnings=(*found.warnings, doubt))
    if not whole:
        found = replace(found, camera=inspector.camera)
    sharpness = inspector.sharpness_meter()
    before, now, after = (sharpness(each) for each in (None, inspector.knobs, inspector.knobs_of(found)))
    exact, warnings = found.exact, "".join(f"; {text}" for text in found.warnings)
    orbit = orbit_text(exact.model_name, inspector.knobs_of(exact).value, found.parameters["phase"])
    return found, (
        f"found on {scope}: {found.model_name} model, {orbit}; sharpness of the region {before:.3g} as recorded, "
        f"{now:.3g} now, {after:.3g} with the result; {found.seconds:.1f} s{warnings}"
    )


def cost_surface(
    inspector: Inspector, found: Calibration | None = None, *, points: tuple[int, int] = SURFACE_POINTS,
    progress: Progress = silent,
) -> dict[str, Any]:  # fmt: skip
    """Return a map of the sharpness of the region over the two parameters that matter most, with all others fixed.

    These are the size, from 0 to twice its value, and phase, over one turn about its value. Without an encoder, they
    are speed and size; with a depth map, clock offset and phase. ``points``: numbers of their values. The map has marks
    of the current, the ``found`` and the true parameters. The call may run in a thread; ``progress`` may raise an error
    to stop it.
    """
    current, sharpness = inspector.knobs, inspector.sharpness_meter()
    size = size_name(current.model)
    sizes = np.linspace(0.0, 2.0 * (current.value(size) or inspector.nominal_apex or CURVE_HALF_WIDTH[size]), points[0])
    if inspector.depth is not None:  # there is no one size
        width, size = CURVE_HALF_WIDTH["clock_offset"], "clock_offset"
        sizes = current.clock_offset + np.linspace(-width, width, points[0])
    second, width = ("phase", math.pi) if inspector.has_encoder else ("rpm", CURVE_HALF_WIDTH["rpm"])
    names, scales = (size, second), (UNITS[size], UNITS[second])
    others = (current.value(second) or 0.0) + np.linspace(-width, width, points[1])
    out = np.empty(points[::-1])
    for row, other in enumerate(others.tolist()):
        progress(f"sharpness over {size} and {second}", row / len(out))
        out[row] = [sharpness(current.with_values({size: each, second: other})) for each in sizes.tolist()]
    x_title, y_title = (f"{SLIDERS[name][0]} ({SLIDERS[name][1]})" for name in names)
    marks = surface_marks(inspector, names, current, found)
    scale = Scale("sharpness", "1", float(out.min()), max(float(out.max()), float(out.min()) + 1e-9), "cividis")
    return {"x": (sizes / scales[0]).tolist(), "y": (others / scales[1]).tolist(), "marks": marks, "x_title": x_title,
            "y_title": y_title, "names": list(names),
            "picture": picture_state(out[::-1], scale)}  # fmt: skip


def surface_marks(
    inspector: Inspector, names: Sequence[str], about: Knobs, found: Calibration | None
) -> list[dict[str, Any]]:
    """Return the marks of the current, the true and the ``found`` parameters on a map over two parameters.

    ``names``: of these parameters; ``about``: those in the middle of the map, about which the phase has one turn.
    """
    marks = []
    known = (("○", "now", inspector.knobs), ("◇", "truth", inspector.truth),
             ("✕", "result", None if found is None else inspector.knobs_of(found)))  # fmt: skip
    scales = [UNITS[name] for name in names]
    for sign, title, knobs in known:
        if knobs is not None:
            x, y = ((knobs.value(name) or 0.0) / scale for name, scale in zip(names, scales, strict=True))
            if names[1] == "phase":
                y += 360.0 * round((about.phase / scales[1] - y) / 360.0)
            marks.append({"x": x, "y": y, "sign": sign, "title": title})
    return marks


# Files that the page offers as downloads: images, events and films.

COLUMNS = ("t", "x", "y", "p", "theta", "x_compensated", "y_compensated")
"""Columns of a table of events: time [us], pixel, polarity, prism angle [rad] and compensated place [px]."""


def write_events(inspector: Inspector, path: Path, *, compensated: bool) -> int:
    """Write all selected events of the window to a new native file, and return their number.

    Compensated events get sub-pixel coordinates, with the parameters set on the page. Camera, prism and encoder that
    the recording lacks are those set on the page. A window with more events than the page reads is written completely.
    Raises :class:`AmiwarpError` if the file exists.
    """
    recording, span, encoder = inspector.recording, inspector.loaded.span, inspector.encoder_of(inspector.knobs)
    width, height = recording.events.size
    first_us = max(span.start_us, encoder.coverage[0])
    last_us = min(span.start_us + span.length_us, encoder.coverage[1])
    metadata = {**recording.metadata, **({"compensated_with": inspector.knobs.model} if compensated else {})}
    with RecordingWriter(
        path, width=width, height=height, camera=inspector.camera, prism=inspector.nominal_prism, metadata=metadata,
        encoder=_cut(encoder, first_us, last_us) if inspector.has_encoder or inspector.knobs.rpm else None,
    ) as writer:  # fmt: skip
        compensator = BlockCompensator(inspector.model, encoder, first_us, last_us, inspector.device)
        for block in _selected_blocks(inspector):
            if compensated:
                moved, inside = compensator(block, all_cores=True)
                writer.append(moved, inside=inside)
            else:
                writer.append(block)
        return len(writer)


def write_table(inspector: Inspector, path: Path) -> None:
    """Write all selected events of the window, with :data:`COLUMNS`, to a new .csv or .npz file.

    Raises :class:`AmiwarpError` for another suffix, or if the file exists.
    """
    encoder, model = inspector.encoder_of(inspector.knobs), inspector.model

    def table(e: Events) -> tuple[NDArray[Any], ...]:
        theta = np.mod(encoder.angle_at(e.t), math.tau)
        xy = np.stack([e.x, e.y], axis=1).astype(np.float32)  # compensate_events refuses places between pixels
        moved = np.asarray(model.compensate_points(xy, encoder.angles_at(e.t).astype(np.float32)))
        return e.t, e.x, e.y, e.p, theta, moved[:, 0], moved[:, 1]

    tables = map(table, _selected_blocks(inspector))
    if check_ending(path, "tables are written", (".csv", ".npz")) == ".csv":
        save_rows(path, COLUMNS, tables, "%d,%d,%d,%d,%.6f,%.3f,%.3f")
        return
    columns = {name: np.concatenate(parts) for name, *parts in zip(COLUMNS, *tables, strict=True)}
    width, height = map(np.array, inspector.recording.events.size)
    save_map(path, "table", {**columns, "width": width, "height": height}, overwrite=False)


def write_cloud(inspector: Inspector, path: Path, axis: Axis, *, compensated: bool) -> None:
    """Write all selected events of the window as points to a new .vtp file, as :func:`amiwarp.event_clouds` does.

    Points lie at x [px], -y [px], and angle [deg] or time [ms] on the third axis, in the scale of the clouds. Events
    that the model cannot compensate are left out of compensated points. Raises :class:`AmiwarpError` if the file
    exists.
    """
    import pyvista

    shown, encoder, model = inspector.show(), inspector.encoder_of(inspector.knobs), inspector.model
    events = Events.concatenate(list(_selected_blocks(inspector)))
    xy = np.stack([events.x, events.y], axis=1).astype(np.float32)
    if compensated:
        xy = np.asarray(model.compensate_points(xy, encoder.angles_at(events.t).astype(np.float32)), np.float32)
    theta = np.mod(encoder.angle_at(events.t), math.tau)
    t_us = events.t - shown.span.first_us
    box = Box(*shown.region, *axis_range(shown, axis))
    along, unit = (np.degrees(theta), "theta [deg]") if axis is Axis.ANGLE else (t_us * 1e-3, "t [ms]")
    known = np.isfinite(xy).all(axis=1)
    cloud = pyvista.PolyData(box.positions(xy[known], along[known]))
    arrays: dict[str, NDArray[Any]] = {"t_us": t_us, "polarity": events.p}
    if math.isfinite(inspector.turn_us):
        arrays["theta_rad"] = theta
    for name, values in arrays.items():
        cloud.point_data[name] = values[known]
    cloud.field_data["axes"] = ["x [px]", "-y [px]", f"({unit} - z_start) * z_scale"]
    cloud.field_data["z_scale"], cloud.field_data["z_start"] = [box.stretch], [box.low]
    cloud.field_data["t_first_us"] = np.array([shown.span.first_us], np.int64)
    check_output(path)
    cloud.save(path)


def _selected_blocks(inspector: Inspector) -> Iterator[Events]:
    """Yield all selected events of the window, in blocks. The selection goes on from block to block."""
    running, region = inspector.selected_events(inspector.selection), inspector.loaded.region
    for block in filter(len, span_blocks(inspector.recording.events, inspector.loaded.span)):
        kept = running.keep(block) & inside(block, region)
        yield block if kept.all() else block[kept]


def _cut(encoder: Encoder, first_us: int, last_us: int) -> Encoder:
    """Return the samples of an encoder, and of its second one, that cover a time span, with one more on each side."""
    first = max(int(np.searchsorted(encoder.t, first_us + encoder.clock_offset_us)) - 2, 0)
    stop = int(np.searchsorted(encoder.t, last_us + encoder.clock_offset_us)) + 2
    t, pulses = encoder.t[first:stop], encoder.index_t
    if pulses is not None:
        pulses = pulses[(pulses >= t[0]) & (pulses <= t[-1])]
    second = None if encoder.second is None else _cut(encoder.second, first_us, last_us)
    return Encoder(t, encoder.angle[first:stop], encoder.clock_offset_us, pulses, second)


# Films of the clouds, and the downloads that a page offers. No file is written on the server.

FRAMES, FPS = 90, 25.0
"""Number of pictures of a turning film, and pictures per second."""
FILM_SIZE = (1280, 560)
"""Width and height of a film [px]."""


def file_stem(recording: str) -> str:
    """Return the name of a recording or of a stream, as file names may have it."""
    return re.sub(r"[^\w.+=@-]+", "_", recording)[:60].strip("._-~ ") or "recording"


def download_name(recording: str, what: str) -> str:
    """Return the file name of a download. ``recording``: name of the recording, which may be that of a stream."""
    name, suffix = file_stem(recording), EXPORTS[what][1]
    return f"{name}{suffix}" if suffix == f".{what}" else f"{name}.{what}{suffix}"


def unused_path(name: str) -> Path:
    """Return a path in the current folder with this name, or with a number after it, that no file has."""
    path = Path(name)
    names = (path.with_stem(f"{path.stem}-{k}") if k else path for k in itertools.count())
    return next(each for each in names if not (each.exists() or each.with_name(f"{each.stem}.part.h5").exists()))


def write_film(
    path: Path, inspector: Inspector, look: Look, view: View, progress: Progress, *, what: str,
    against: Knobs | None = None, with_orbit: bool = True, speed: float, ended: Callable[[], bool] = lambda: False,
) -> int:  # fmt: skip
    """Write a film of the clouds to a new file, picture by picture, and return their number.

    ``what``: "turntable" for a camera that moves once around the clouds of the inspector's window, or "film" for a time
    window that moves on from there with ``speed`` times real time, to the end of the recording or until ``ended``
    returns True. A time without events keeps the picture before it. ``against``: parameters of the left cloud; None for
    the recorded events. ``progress`` may raise an error to stop the film; no file is left then.
    """
    inspector, turns = inspector.copy(), what == "turntable"
    span, step_us = inspector.loaded.span, 1e6 / FPS * speed
    last_us = inspector.recording.events.t_last + 1 - span.length_us
    frames = FRAMES if turns else 1 + max(0, math.floor((last_us - span.start_us) / step_us))

    def draw(scene: Scene) -> None:
        shown = inspector.show(against=against)
        lines = shown_lines(inspector, shown, look.axis, against) if with_orbit else ()
        scene.show(shown, look, lines, caption(inspector, shown))

    def pictures() -> Iterator[NDArray[np.uint8]]:
        with contextlib.closing(Scene(FILM_SIZE)) as scene:
            draw(scene)
            scene.look_from(view, look)
            turning = scene.turntable(frames)
            for k in range(frames):
                if k and ended():
                    return
                progress(f"making the {EXPORTS[what][0]}, {k / FPS:.0f} of {frames / FPS:.0f} s", k / frames)
                if k and not turns:
                    with contextlib.suppress(AmiwarpError):  # there are no events at this time
                        inspector.open(span.start_us + round(k * step_us), span.length_us)
                        draw(scene)
                yield next(turning) if turns else scene.picture()

    return save_film(pictures(), path, fps=FPS)
