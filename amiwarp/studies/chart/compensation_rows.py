"""Measurement of the compensation chart.

Three kinds of work are measured: images of events with every model, vote, number of angles and share of events; the
same images by other libraries; and the compensation of whole files.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.calib.presets import simplified
from amiwarp.choices import Vote
from amiwarp.compensation.recordings import compensate
from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events
from amiwarp.imaging.canvas import CanvasShape, Image
from amiwarp.imaging.uploaded_events import TURNS, UploadedEvents, upload_events
from amiwarp.imaging.votes import Votes
from amiwarp.io import open_recording, save_recording
from amiwarp.io.unfinished import scratch_folder
from amiwarp.optics.models.angles import wrap_angle
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.registry import rungs
from amiwarp.results.calibration import Calibration
from amiwarp.studies.chart.rows import Row
from amiwarp.studies.chart.timing import Task, Timed, measure, measured_row
from amiwarp.studies.chart.truth import KnownRecording, exact_image, exact_places, raw_places, rms
from amiwarp.studies.failures import noted
from amiwarp.tasks import Progress

IMAGE = "image of events"
"""Name of the job that makes an image. Rows of one job can be compared and share a Pareto front."""
FILE = "file to file"
"""Name of the job that compensates a file."""
ANGLES = (TURNS, 4096, 1024, 256)
"""Numbers of distinct prism angles per turn with which images are measured."""
SHARES = (4, 16)
"""Divisors n of the number of events: an image is measured with every n-th event."""
SAMPLE = 200_000
"""Largest number of events on which an error is measured; larger numbers are thinned evenly."""
MANY = 64_000_000
"""Number of events to which a recording is repeated on CUDA. With fewer events, launch times would dominate."""
REST_S = 0.02
"""Pause after a run of another library [s], whose threads stay busy for a while."""
WRONG = 0.02
"""Largest difference of the exact model's bilinear image from the float64 image, relative to the contrast; a larger one
is an error of the device."""


@dataclass(frozen=True, eq=False)
class ErrorSample:
    """Evenly thinned events of the recording with their exact compensated positions."""

    known: KnownRecording
    """Recording with ground truth from which the sample is taken."""
    step: int
    """Interval of the sampled events: every ``step``-th event of the recording."""
    xy: NDArray[np.float64]
    """Recorded positions of the sampled events [px], shape ``(n, 2)``."""
    theta: NDArray[np.float64]
    """Prism angles of the sampled events [rad], shape ``(n,)``."""
    exact: NDArray[np.float64]
    """Exact compensated positions [px], shape ``(n, 2)``."""

    @classmethod
    def of(cls, known: KnownRecording) -> ErrorSample:
        """Take a sample of the events of a recording."""
        step = math.ceil(len(known.events) / SAMPLE)
        some = known.events[::step]
        xy = raw_places(some)
        theta = known.encoder.angle_at(some.t)
        return cls(known, step, xy, theta, exact_places(known.model, xy, theta))

    def error(self, places: NDArray[np.floating[Any]], vote: Vote) -> float:
        """Return the rms distance [px] of positions ``(n, 2)`` from the exact positions.

        For a nearest vote, the error of its rounding to whole pixels is added.
        """
        voted = np.rint(places) if vote is Vote.NEAREST else places
        return rms(voted - self.exact)


def coarse(theta: NDArray[np.float64], angles: int) -> NDArray[np.float64]:
    """Round prism angles [rad] to ``angles`` steps per turn."""
    step = 2.0 * math.pi / angles
    rounded = theta / step
    np.rint(rounded, out=rounded)
    rounded *= step
    return rounded


class Uploads:
    """Events of the recording on the device, for each number of angles and each share.

    Each version is uploaded once. Versions of one share have the same pixels in memory, only other angles.
    """

    def __init__(self, known: KnownRecording, device: str) -> None:
        self.known = known
        self.device = device
        copies = 1 if wp.get_device(device).is_cpu else max(1, MANY // len(known.events))
        self.events = _repeated(known.events, copies)
        self.theta = _tiled(known.encoder.angle_at(known.events.t), copies)
        self.copies = copies
        self._made: dict[tuple[int, int], UploadedEvents] = {}

    def get(self, angles: int, share: int) -> UploadedEvents:
        """Return the uploaded events with ``angles`` distinct angles per turn, every ``share``-th event."""
        if (angles, share) not in self._made:
            # A share is taken before the events are repeated: of the repeated ones, it could contain all.
            count = len(self.known.events)
            theta = _tiled(coarse(self.theta[:count:share], angles), self.copies)
            alike = [made for (_, other), made in self._made.items() if other == share]
            uploaded = alike[0].at_angles(theta) if alike else self._upload(theta, share)
            self._made[angles, share] = uploaded
        return self._made[angles, share]

    def _upload(self, theta: NDArray[np.float64], share: int) -> UploadedEvents:
        """Upload every ``share``-th event with prism angles [rad]."""
        return upload_events(_repeated(self.known.events[::share], self.copies), theta, self.device)


def _repeated(events: Events, copies: int) -> Events:
    """Return the events repeated ``copies`` times."""
    columns = {name: _tiled(getattr(events, name), copies) for name in ("x", "y", "t", "p")}
    return replace(events, **columns)


def _tiled(values: NDArray[Any], copies: int) -> NDArray[Any]:
    """Return ``values`` repeated ``copies`` times; without a copy if that is once."""
    return values if copies == 1 else np.tile(values, copies)


@dataclass(frozen=True)
class ImageSetting:
    """Setting of an image of warped events that the chart measures."""

    model: str
    """Name of the optical model."""
    vote: Vote
    """How a vote is shared among pixels."""
    angles: int = TURNS
    """Number of distinct prism angles per turn."""
    share: int = 1
    """Interval of the used events: every ``share``-th event."""

    @property
    def label(self) -> str:
        """Name of the setting in the chart."""
        words = [self.model, self.vote.value]
        if self.angles != TURNS:
            words.append(f"{self.angles} angles")
        if self.share != 1:
            words.append(f"1/{self.share} of events")
        return ", ".join(words)

    def row_fields(self, device: str) -> dict[str, Any]:
        """Return the fields of the setting's row that do not depend on the measurement."""
        settings = {
            "model": self.model,
            "vote": self.vote.value,
            "angles": self.angles,
            "share": 1.0 / self.share,
            "device": device,
        }
        default = self == ImageSetting("exact", Vote.BILINEAR)
        return {
            "chart": "compensation",
            "job": IMAGE,
            "label": self.label,
            "family": self.model,
            "mark": self._mark,
            "settings": settings,
            "default": default,
            "comparable": self.share == 1,
        }

    @property
    def _mark(self) -> str:
        """Kind of the row, which determines its marker in the chart."""
        return self.vote.value if self.share == 1 else "share of events"


def compensation_settings(*, quick: bool) -> list[ImageSetting]:
    """Return the image settings that the chart measures."""
    models = ("circle", "exact") if quick else tuple(rungs())
    numbers_of_angles = ANGLES[::2] if quick else ANGLES
    settings = []
    for model in models:
        for vote in Vote:
            # A nearest vote hides the error of coarse angles.
            measured = numbers_of_angles if vote is Vote.BILINEAR else numbers_of_angles[:1]
            settings += [ImageSetting(model, vote, angles) for angles in measured]
    settings += [ImageSetting("exact", Vote.BILINEAR, TURNS, share) for share in SHARES]
    return settings


@dataclass(frozen=True, eq=False)
class LibraryTask:
    """Task of another library that makes the same image of events."""

    task: Task
    """Function to measure, with the fields of its row."""
    places: Callable[[slice], NDArray[np.float32]]
    """Function that returns the positions [px], shape ``(n, 2)``, to which the library moves the events of a slice."""


Libraries: TypeAlias = Callable[
    ["ErrorSample", "Uploads", str], tuple[list[LibraryTask], list[str]]
]
"""Function that returns tasks of other libraries for a sample, its uploads and a device, and notes on libraries that
are not installed."""


def compensation_rows(
    known: KnownRecording,
    device: str,
    *,
    repeats: int,
    quick: bool,
    progress: Progress,
    folder: Path,
    failed: dict[str, str],
    libraries: Libraries | None = None,
) -> tuple[list[Row], list[str]]:
    """Measure all settings and return their rows, with notes on settings that could not be measured.

    Settings that fail are noted in ``failed`` by their labels, with the error. Temporary files go to ``folder``. Raises
    :class:`AmiwarpError` if the exact model's image differs from the float64 image.
    """
    progress("measuring images of events: the truth", 0.0)
    sample = ErrorSample.of(known)
    images, notes = _image_rows(sample, device, repeats, quick, progress, failed, libraries)
    files = list[Row]()
    missing = list[str]()
    with noted(failed, FILE):
        files, missing = _file_rows(sample, device, repeats, quick, progress, failed, folder)
    return images + files, notes + missing


def _image_rows(
    sample: ErrorSample,
    device: str,
    repeats: int,
    quick: bool,
    progress: Progress,
    failed: dict[str, str],
    libraries: Libraries | None,
) -> tuple[list[Row], list[str]]:
    """Measure the images of events.

    The uploaded events are freed when this function returns, before files are measured.
    """
    known = sample.known
    truth = exact_image(known)
    models = {name: simplified(known.calibration(), name).model for name in rungs()}
    uploads = Uploads(known, device)
    all_settings = compensation_settings(quick=quick)
    library_tasks: list[LibraryTask] = []
    notes: list[str] = []
    if libraries is not None:
        library_tasks, notes = libraries(sample, uploads, device)
    tasks = [
        *_image_tasks(all_settings, models, uploads, device),
        *(library_task.task for library_task in library_tasks),
    ]
    timed = measure(tasks, repeats, progress, "measuring images of events", rest_s=REST_S)

    def error(timed_image: Timed, setting: ImageSetting) -> tuple[float, float]:
        places = _places(models[setting.model], sample, setting.angles, device)
        image_error = _image_error(timed_image.result, truth, uploads.copies / setting.share)
        return sample.error(places, setting.vote), image_error

    def error_of_other(timed_image: Timed, task: LibraryTask) -> tuple[float, float]:
        places = task.places(slice(0, len(known.events), sample.step)).astype(np.float64)
        image_error = _image_error(
            timed_image.result, truth, timed_image.task.events / len(known.events)
        )
        return sample.error(places, Vote.BILINEAR), image_error

    measured = []
    timed_settings = timed[: len(all_settings)]
    for result, setting in zip(timed_settings, all_settings, strict=True):
        measured.append(measured_row(result, failed, partial(error, result, setting)))
    of_libraries = timed[len(all_settings) :]
    for result, task in zip(of_libraries, library_tasks, strict=True):
        measured.append(measured_row(result, failed, partial(error_of_other, result, task)))
    rows = [row for row in measured if row is not None]
    _check(rows)
    return rows, notes


def _image_tasks(
    settings: list[ImageSetting], models: dict[str, Model], uploads: Uploads, device: str
) -> Iterator[Task]:
    """Yield the measurements of the images of events."""
    camera = uploads.known.camera
    buffers = {}
    for vote in Vote:
        canvas = CanvasShape(camera.width, camera.height, vote=vote)
        buffers[vote] = Votes(canvas, device), Image(canvas, 1, device)

    def run(setting: ImageSetting) -> Image:
        votes, image = buffers[setting.vote]
        votes.clear()
        votes.add_events(models[setting.model], uploads.get(setting.angles, setting.share))
        votes.read(image)
        wp.synchronize_device(device)
        return image

    for setting in settings:
        yield Task(
            partial(run, setting),
            len(uploads.theta),
            setting.row_fields(device),
            keep=lambda image: image.numpy()[0],
        )


def _places(model: Model, sample: ErrorSample, angles: int, device: str) -> NDArray[np.float64]:
    """Return compensated positions by the device functions that the votes call, at the rounded angles."""
    theta = wrap_angle(coarse(sample.theta, angles)).astype(np.float32)
    xy = wp.array(sample.xy.astype(np.float32), dtype=wp.vec2, device=device)
    angle = wp.array(theta, dtype=float, device=device)
    return model.compensate_points(xy, angle).numpy().astype(np.float64)


def _image_error(image: NDArray[Any], truth: NDArray[np.float64], times: float) -> float:
    """Return the rms difference of ``image`` / ``times`` from ``truth``, relative to the contrast of ``truth``."""
    difference = np.sqrt(np.mean((image / times - truth) ** 2))
    return float(difference / np.std(truth))


def _check(rows: list[Row]) -> None:
    """Raise :class:`AmiwarpError` if the image by the default setting is wrong, unless the setting failed."""
    default = next((row for row in rows if row.default), None)
    if default is None:
        return
    if default.image_error is None or not default.image_error < WRONG:
        raise AmiwarpError(
            f"the image by {default.label} differs from the float64 one by {default.image_error} of its contrast; "
            "this device gives wrong results; run the tests on it"
        )


def circle(sample: ErrorSample) -> tuple[float, float]:
    """Return radius [px] and phase [rad] of the circle that fits the exact displacements of the events best."""
    moved = (sample.xy - sample.exact) @ (1.0, 1.0j)
    best = complex(np.nanmean(moved * np.exp(-1j * sample.theta)))
    return abs(best), float(np.angle(best))


def _file_rows(
    sample: ErrorSample,
    device: str,
    repeats: int,
    quick: bool,
    progress: Progress,
    failed: dict[str, str],
    folder: Path,
) -> tuple[list[Row], list[str]]:
    """Measure the compensation of whole files with each model, reading and writing included.

    The error is measured on the events in the written file.
    """
    if missing := [name for name in ("h5py", "hdf5plugin") if find_spec(name) is None]:
        return [], [f"files: not measured, because {' and '.join(missing)} is not installed"]
    known = sample.known

    def error(path: Path) -> float:
        events = open_recording(path).events.slice(0, len(known.events))
        return sample.error(raw_places(events[:: sample.step]), Vote.BILINEAR)

    def run(calibration: Calibration) -> Path:
        compensate(source, calibration, place / "out.h5", device=device, overwrite=True)
        return place / "out.h5"

    with scratch_folder(folder) as place:
        save_recording(place / "in.h5", replace(known.recording, truth=None))
        source = open_recording(place / "in.h5")
        tasks = []
        for model in ("circle", "exact") if quick else rungs():
            calibration = simplified(known.calibration(), model)
            fields = {
                "chart": "compensation",
                "job": FILE,
                "label": f"{model}, file to file",
                "family": model,
                "mark": FILE,
                "settings": {"model": model, "device": device},
                "default": model == "exact",
            }
            tasks.append(Task(partial(run, calibration), len(known.events), fields, error))
        rows = []
        for timed in measure(tasks, repeats, progress, "measuring files"):
            row = measured_row(timed, failed, lambda timed=timed: (timed.result, None))  # type: ignore[misc]
            if row is not None:
                rows.append(row)
        return rows, []
