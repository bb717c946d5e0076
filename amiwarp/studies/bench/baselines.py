"""Baselines of AMI-Bench: methods of amiwarp, which answer the tasks from the public files alone."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.calibration import calibrate
from amiwarp.calib.camera_rates import estimate_rates
from amiwarp.calib.paper_method import calibrate_as_paper
from amiwarp.calib.settings import PHASE, STAGES, Settings
from amiwarp.choices import SearchCost
from amiwarp.compensation.in_memory import compensate_events
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events, Recording
from amiwarp.io.array_maps import save_map
from amiwarp.io.output_formats import make_folder
from amiwarp.io.outputs import write_text
from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.prism import Prism
from amiwarp.reconstruction.phase_window import PhaseReconstruction
from amiwarp.reconstruction.reconstruct import Reconstruction
from amiwarp.results.calibration import Calibration
from amiwarp.simulation.picture_light import DARK
from amiwarp.studies.bench.recordings import open_recordings
from amiwarp.studies.bench.scores import FLOW_TURNS, displacement_of
from amiwarp.studies.bench.specification import PLAIN, PRISM, VERSION, Entry
from amiwarp.studies.bench.submission import (
    ARRAYS,
    FILE,
    FORMAT,
    TASKS,
    UNITS,
    Submission,
    described,
)
from amiwarp.studies.evaluate.camera_motion import estimate_rotation
from amiwarp.studies.evaluate.event_images import pixel_index
from amiwarp.studies.evaluate.inertial import fitted_rate, mean_rates
from amiwarp.studies.evaluate.moving_bodies import (
    SegmentationSettings,
    moving_events,
    moving_pixels,
)
from amiwarp.studies.evaluate.optical_flow import flow_by_contrast, frames_flow
from amiwarp.studies.evaluate.overlaps import hull
from amiwarp.tasks import Progress, silent

GAMMA = 1.0 / 2.2
"""Exponent from the light of a frame to grey values, from which its flow is found."""
SENSOR_BITS = 65535.0
"""Largest value of a frame."""
NOT_REFUSALS = (ErrorCode.PACKAGE_MISSING, ErrorCode.DEVICE_MISSING, ErrorCode.FILE_MISSING)
"""Errors of the machine, which are no refusal of a recording."""

Calibrate = Callable[["View"], Calibration]
Answer = Callable[["View"], NDArray[Any]]
"""Function that answers a task about a recording."""


def _default(view: View) -> Calibration:
    """Return the default calibration; where it refuses, the sharpness stage alone, as its message advises."""
    try:
        return calibrate(view.prism, device=view.device)
    except AmiwarpError as error:
        if error.code is not ErrorCode.CALIBRATION_REFUSED:
            raise
    return calibrate(view.prism, Settings(stages=STAGES[:1]), device=view.device)


def _as_paper(view: View) -> Calibration:
    """Return the paper's calibration from the known start: nominal prism and mounted phase."""
    start = {"phase": view.entry.mounted_phase}
    return calibrate_as_paper(view.prism, start=start, device=view.device)


def _in_phase(view: View) -> Calibration:
    """Return a calibration whose global and local search have the cost of sums in phase alone."""
    settings = Settings(
        model="exact", cost=SearchCost.PHASE, global_algorithm=PHASE, stages=STAGES[:1]
    )
    return calibrate(view.prism, settings, device=view.device)


@dataclass(eq=False)
class View:
    """The public files of a recording, and the calibrations that several answers share."""

    entry: Entry
    """Its entry in the specification, of which only the public values are used."""
    prism: Recording
    """Recording of the event camera behind the prism."""
    plain: Recording
    """Recording of the plain event camera, with the frames of the standard camera."""
    device: str = "cpu"
    """Device that computes."""
    _found: dict[Calibrate, Calibration | AmiwarpError] = field(default_factory=dict)

    @classmethod
    def of(cls, folder: Path, entry: Entry, device: str) -> View:
        """Open the files of a recording."""
        opened = open_recordings(folder, entry)
        return cls(entry, opened[PRISM], opened[PLAIN], device)

    def calibration(self, method: Calibrate) -> Calibration:
        """Return the calibration by a method, which runs once. Raises :class:`AmiwarpError` if it refuses."""
        if method not in self._found:
            try:
                self._found[method] = method(self)
            except AmiwarpError as error:
                self._found[method] = error
        found = self._found[method]
        if isinstance(found, AmiwarpError):
            raise found
        return found

    def encoder(self, calibration: Calibration) -> Encoder:
        """Return the recording's encoder with the corrections of a calibration."""
        events = self.prism.events
        encoder = calibration.encoder_for(self.prism.encoder, events.t_first, events.t_last)
        assert encoder is not None  # the recording has one
        return encoder

    def around(self, turns: float) -> tuple[int, int]:
        """Return start and end of the time about the moment that takes some turns [us]."""
        half = round(0.5 * turns * self.entry.turn_us)
        return self.entry.moment_us - half, self.entry.moment_us + half

    def compensated(self, calibration: Calibration, start_us: int, end_us: int) -> Events:
        """Return the events of a time, compensated; without the ones that have no place."""
        events = self.prism.events.between(start_us, end_us)
        encoder = self.encoder(calibration)
        xy = compensate_events(events, calibration.model, encoder, device=self.device)
        kept = np.isfinite(xy).all(axis=1)
        return Events(xy[kept, 0], xy[kept, 1], events.t[kept], events.p[kept])


def default_calibration(view: View) -> Calibration:
    """Return the default calibration of a recording, which the baselines ``ours`` and ``network`` share."""
    return view.calibration(_default)


def _displacement(method: Calibrate) -> Answer:
    return lambda view: displacement_of(view.calibration(method).model)


def _events_of(method: Calibrate | None) -> Callable[[View, int, int], Events]:
    """Return the function that gives events as without the prism: compensated, or of the plain camera."""
    if method is None:
        return lambda view, start_us, end_us: view.plain.events.between(start_us, end_us)
    return lambda view, start_us, end_us: view.compensated(
        view.calibration(method), start_us, end_us
    )


def _flow(method: Calibrate | None) -> Answer:
    """Return the answer by contrast maximisation in a quarter turn."""
    events_of = _events_of(method)

    def answer(view: View) -> NDArray[Any]:
        events = events_of(view, *view.around(FLOW_TURNS))
        return flow_by_contrast(events, view.entry.camera)

    return answer


def _detection(method: Calibrate | None) -> Answer:
    """Return the answer by what stays blurred in a quarter turn: the convex hull of its largest cluster."""
    events_of = _events_of(method)

    def answer(view: View) -> NDArray[Any]:
        camera = view.entry.camera
        events = events_of(view, *view.around(FLOW_TURNS))
        (body,) = moving_events(events, camera, [SegmentationSettings()])
        mask = np.zeros((camera.height, camera.width), np.bool_)
        places = pixel_index(events[body == _largest(body)], (camera.width, camera.height))
        if body.any():
            mask.ravel()[places] = True
        return hull(mask)

    return answer


def _largest(number: NDArray[np.integer]) -> int:
    """Return the number of the largest body; 0, the background, is none."""
    counts = np.bincount(number.ravel(), minlength=2)
    counts[0] = 0
    return int(counts.argmax())


def _rotation(method: Calibrate | None) -> Answer:
    """Return the answer by contrast maximisation in each window."""
    events_of = _events_of(method)

    def answer(view: View) -> NDArray[Any]:
        ends = view.entry.rotation_ends_us.tolist()
        rates = []
        for start_us, end_us in pairwise(ends):
            found = estimate_rotation(events_of(view, start_us, end_us), view.entry.camera)
            rates.append(found.angular_velocity)
        return np.degrees(rates)

    return answer


def _turn_to_turn(view: View) -> NDArray[Any]:
    """Return the rotation from raw events at the same angles of successive turns, about the ends of each window."""
    calibration = default_calibration(view)
    encoder = view.encoder(calibration)
    half = view.entry.turn_us // 2
    ends = view.entry.rotation_ends_us.tolist()
    rates = []
    for start_us, end_us in pairwise(ends):
        events = view.prism.events.between(start_us - half, end_us + half)
        rates.append(estimate_rates(events, encoder, view.entry.camera))
    return np.degrees(rates)


def _solver_picture(view: View) -> NDArray[Any]:
    start_us, end_us = view.around(1.0)
    work = Reconstruction(view.prism, default_calibration(view), device=view.device)
    return np.asarray(work.window(start_us, end_us - start_us).log)


def _phase_picture(view: View) -> NDArray[Any]:
    start_us, end_us = view.around(1.0)
    calibration = view.calibration(_in_phase)
    work = PhaseReconstruction(view.prism, calibration, device=view.device)
    return np.asarray(work.window(start_us, end_us - start_us).log)


def _plain_picture(view: View) -> NDArray[Any]:
    """Return the solver's picture of plain events, which see what moves."""
    start_us, end_us = view.around(1.0)
    camera = view.entry.camera
    rotation = estimate_rotation(view.plain.events.between(start_us, end_us), camera)
    work = Reconstruction(
        view.plain,
        model=ExactModel(camera, Prism(0.0)),
        encoder=Encoder.constant_speed(0.0, -1_000_000, view.entry.duration_us + 1_000_000),
        camera_rotation=rotation,
        device=view.device,
    )
    return np.asarray(work.window(start_us, end_us - start_us).log)


def _frame_picture(view: View) -> NDArray[Any]:
    """Return the log light of the last frame that is complete at the moment."""
    frames = view.plain.frames
    assert frames is not None
    assert frames.exposure is not None
    last = int(np.count_nonzero(frames.exposure[:, 1] <= view.entry.moment_us)) - 1
    return np.log(np.asarray(frames[last]) / SENSOR_BITS + DARK)


def _frame_flows(view: View) -> tuple[NDArray[np.int64], list[NDArray[np.float32]]]:
    """Return the times of the frames [us], shape (n + 1,), and the flows between successive ones [px/s]."""
    frames = view.plain.frames
    assert frames is not None
    grey = []
    for place in range(len(frames)):
        light = (np.asarray(frames[place]) / SENSOR_BITS) ** GAMMA
        grey.append(np.rint(255.0 * light).astype(np.uint8))
    flows = []
    for place, seconds in enumerate(1e-6 * np.diff(frames.t)):
        flows.append(frames_flow(grey[place : place + 2], float(seconds)))
    return np.asarray(frames.t), flows


def _nearest_flow(view: View) -> NDArray[Any]:
    """Return the flow between the two frames whose middle is nearest to the moment."""
    times, flows = _frame_flows(view)
    middles = (times[1:] + times[:-1]) // 2
    return flows[int(np.abs(middles - view.entry.moment_us).argmin())]


def _frame_detection(view: View) -> NDArray[Any]:
    """Return the convex hull of the largest region whose flow is no rotation of the camera."""
    seconds = FLOW_TURNS * 1e-6 * view.entry.turn_us
    body = moving_pixels(_nearest_flow(view), view.entry.camera, seconds)
    return hull((body == _largest(body)) & (body > 0))


def _frame_rotation(view: View) -> NDArray[Any]:
    """Return the rotation that fits the flows of the frames, interpolated between their middles."""
    times, flows = _frame_flows(view)
    everywhere = np.ones(flows[0].shape[:2], np.bool_)
    rates = np.array([fitted_rate(view.entry.camera, flow, everywhere) for flow in flows])
    middles = (times[1:] + times[:-1]) // 2
    # The rates are known from the first middle to the last one; before and after, the nearest one holds.
    ends_us = view.entry.rotation_ends_us
    known = np.concatenate([[0], middles, [view.entry.duration_us]])
    held = np.concatenate([rates[:1], rates, rates[-1:]])
    return np.degrees(mean_rates(known, held, ends_us))


@dataclass(frozen=True)
class Baseline:
    """A method, and the tasks that it answers."""

    about: str
    """What it does."""
    answers: Mapping[str, Answer]
    """Function for each task."""


def _compensating(
    method: Calibrate, picture: Answer | None, rotation: Answer | None
) -> dict[str, Answer]:
    """Return the answers of a method that compensates events. Without ``picture`` it makes none."""
    answers = {
        "calibration": _displacement(method),
        "flow": _flow(method),
        "detection": _detection(method),
        "rotation": rotation or _rotation(method),
    }
    return answers if picture is None else {**answers, "picture": picture}


BASELINES = {
    "paper": Baseline(
        "Circle model, the cost J and a grid search, coarse to fine, from the nominal prism and the mounted phase, "
        "as He et al. (2024); contrast maximisation and clustering of compensated events.",
        _compensating(_as_paper, None, None),
    ),
    "ours": Baseline(
        "The default calibration of amiwarp, which chooses the model, or where it refuses its sharpness stage alone; "
        "pictures by least squares; flow and detection as "
        "the paper's; rotation from turn to turn.",
        _compensating(_default, _solver_picture, _turn_to_turn),
    ),
    "phase": Baseline(
        "Sums in phase: a search over them, and their picture. A camera that moves is refused.",
        {"calibration": _displacement(_in_phase), "picture": _phase_picture},
    ),
    "plain": Baseline(
        "The plain event camera in the same place, without the prism.",
        {
            "picture": _plain_picture,
            "flow": _flow(None),
            "detection": _detection(None),
            "rotation": _rotation(None),
        },
    ),
    "frames": Baseline(
        "The standard camera in the same place: its last frame, and the flow between frames by OpenCV's DIS.",
        {
            "picture": _frame_picture,
            "flow": _nearest_flow,
            "detection": _frame_detection,
            "rotation": _frame_rotation,
        },
    ),
}
"""Baselines by name. The command adds ``network``, whose room lies above this one."""


def run_baselines(
    chosen: Mapping[str, Baseline],
    recordings: Path,
    folders: Mapping[str, Path],
    entries: Sequence[Entry],
    device: str,
    progress: Progress = silent,
) -> None:
    """Answer the recordings by baselines, and write a submission of each to its folder.

    Raises :class:`AmiwarpError` if a file is missing, exists already, or cannot be written. A recording that a
    baseline refuses is stated in its submission.
    """
    for name, baseline in chosen.items():
        for task in ("", *baseline.answers):
            make_folder(folders[name] / task)
    refused: dict[str, dict[str, dict[str, str]]] = {name: {} for name in chosen}
    for place, entry in enumerate(entries):
        view = View.of(recordings, entry, device)
        for name, baseline in chosen.items():
            progress(f"{entry.name}: {name}", place / len(entries))
            for task, reason in _write_answers(view, baseline, folders[name]).items():
                refused[name].setdefault(task, {})[entry.name] = reason
    for name, baseline in chosen.items():
        units = {task: UNITS[task] for task in TASKS if task in baseline.answers}
        about = Submission(
            FORMAT, VERSION, entries[0].set_name, name, units, refused[name], baseline.about
        )
        text = json.dumps(described(about), indent=1)
        write_text(folders[name] / FILE, text + "\n")


def _write_answers(view: View, baseline: Baseline, folder: Path) -> dict[str, str]:
    """Write the answers about a recording. Return the reasons of refusals by task."""
    reasons = {}
    for task, answer in baseline.answers.items():
        if task not in view.entry.tasks:
            continue
        try:
            values = answer(view)
        except AmiwarpError as error:
            if error.code in NOT_REFUSALS:
                raise
            reasons[task] = str(error)
            continue
        kept = values if values.dtype == np.bool_ else values.astype(np.float32)
        path = folder / task / f"{view.entry.name}.npz"
        save_map(path, f"answer to {task}", {ARRAYS[task]: kept}, overwrite=False)
    return reasons
