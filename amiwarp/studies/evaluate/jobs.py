"""Jobs and their cells: what one process does, and the files in which finished cells are kept.

A cell is one evaluation under one condition. Each is a file, so that a stopped run can be continued.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from amiwarp._version import __version__
from amiwarp.io import open_recording
from amiwarp.io.finished_work import CellStore
from amiwarp.kernels.loading import load_all, load_kernels
from amiwarp.schema.records import fields_of, value_of
from amiwarp.simulation.translation.picture_flow import limited_opencv
from amiwarp.studies.demo_kernels import EXACT_KERNELS
from amiwarp.studies.evaluate.catalogue import UNCALIBRATED, load
from amiwarp.studies.evaluate.conditions import Condition, RecordedCondition, Settings
from amiwarp.studies.evaluate.libraries import library
from amiwarp.studies.evaluate.results import CellResult
from amiwarp.studies.evaluate.streams import RecordedStreams, Setup, Streams, known_setup
from amiwarp.studies.failures import failure_text
from amiwarp.tasks import cpu_threads, limited_cpu_threads, release_memory
from amiwarp.validation import real

FORMAT = 5
"""Version of the files of cells, and of the streams and measures that all evaluations share."""


@dataclass(frozen=True)
class Job:
    """Evaluations of one condition, which share its simulation."""

    condition: Condition | RecordedCondition
    """Condition."""
    evaluations: tuple[str, ...]
    """Names of the evaluations."""
    settings: Settings
    """Size of the run."""
    threads: int | None = None
    """Number of CPU threads; None for all."""
    setup: Setup | None = None
    """What is known of the prism from another recording; None if that is not needed."""

    @property
    def setup_condition(self) -> Condition | None:
        """Condition of the recording that the prism is calibrated from, if an evaluation needs that."""
        if not isinstance(self.condition, Condition):
            return None
        if set(self.evaluations) <= set(UNCALIBRATED):
            return None
        return self.condition.setup


@dataclass(frozen=True)
class JobResult:
    """Results of a job."""

    cells: list[CellResult]
    """Result of each evaluation."""
    processor_s: float
    """Processor time of the whole job [s]."""


def run_job(job: Job) -> JobResult:
    """Run the evaluations of a job, and release their memory, which a worker would otherwise keep for long."""
    began = time.process_time()
    cells = _run_cells(job)
    release_memory()
    return JobResult(cells, time.process_time() - began)


def failed(job: Job, message: str) -> list[CellResult]:
    """Return the results of a job's evaluations that failed for one reason."""
    return [CellResult(name, job.condition, error=message) for name in job.evaluations]


def _run_cells(job: Job) -> list[CellResult]:
    """Simulate the condition of a job once, or open its recording, and run its evaluations."""
    with limited_cpu_threads(job.threads), limited_opencv(library("cv2"), cpu_threads()):
        try:
            if isinstance(job.condition, Condition):
                streams: RecordedStreams = Streams(job.condition, job.settings.device, job.setup)
            else:
                streams = RecordedStreams(open_recording(job.condition.path), job.settings.device)
            return [_run_cell(name, streams, job) for name in job.evaluations]
        # Whatever one recording raises must not stop the others.
        except Exception as error:
            return failed(job, failure_text(error))


def run_setup(job: Job) -> tuple[Setup, float]:
    """Return what is known of the prism of a job from one recording of it, and the processor time [s]."""
    began = time.process_time()
    assert job.setup_condition is not None
    with limited_cpu_threads(job.threads):
        setup = known_setup(job.setup_condition, job.settings.device)
    release_memory()
    return setup, time.process_time() - began


def compile_kernels(names: Sequence[str], device: str) -> float:
    """Compile the kernels of evaluations, which else each worker would compile. Return the processor time [s]."""
    began = time.process_time()
    for name in names:
        load(name)
    load_all(device)
    if device == "cpu":
        load_kernels(EXACT_KERNELS, device)
    return time.process_time() - began


def _run_cell(name: str, streams: RecordedStreams, job: Job) -> CellResult:
    """Run one evaluation. An error of any kind, such as a refused calibration, becomes its result."""
    began = time.process_time()
    try:
        values = _as_stored(name, load(name).measure(streams, job.settings))
        error = ""
    except Exception as raised:
        values = {}
        error = failure_text(raised)
    return CellResult(name, job.condition, values, error, time.process_time() - began)


def _as_stored(name: str, values: dict[str, Any]) -> dict[str, Any]:
    """Return the values of an evaluation as their cell will give them; numbers that are not finite become None."""
    plain = json.loads(json.dumps(values), parse_constant=lambda word: None)
    return value_of(load(name).Values, plain, f"values of {name}")


class Store(CellStore):
    """Folder of the cells of evaluations."""

    @staticmethod
    def _name(name: str, condition: Condition | RecordedCondition, settings: Settings) -> str:
        size = "quick" if settings.quick else "full"
        return f"{name}_{size}_{condition.key}.json"

    @staticmethod
    def _version(
        name: str, condition: Condition | RecordedCondition, settings: Settings
    ) -> list[Any]:
        """Return all that a cell depends on: its condition, versions, settings and the kind of device.

        Seeds are left out, so that a run with more of them keeps its cells; the first one is shown in pictures.
        """
        size = asdict(settings) | {"device": settings.device.partition(":")[0]}
        del size["seeds"]
        return [FORMAT, __version__, load(name).VERSION, size, condition.key]

    def load(
        self, name: str, condition: Condition | RecordedCondition, settings: Settings
    ) -> CellResult | None:
        """Return a stored cell; None if it is missing, damaged, or of another version, other settings or a device."""

        def make(data: dict[str, Any]) -> CellResult | None:
            fields_of(data, "", "version", "condition", "values", "error", "processor_s")
            if data["version"] != self._version(name, condition, settings):
                return None
            error = value_of(str, data["error"], "error")
            seconds = real(data["processor_s"], "processor_s", 0.0, 1e9)
            values = {} if error else value_of(load(name).Values, data["values"], "values")
            return CellResult(name, condition, values, error, seconds)

        return self.read(self._name(name, condition, settings), make)

    def save(self, cell: CellResult, settings: Settings) -> None:
        """Write a cell."""
        condition = asdict(cell.condition)
        for name, value in condition.items():
            if isinstance(value, Path):
                condition[name] = str(value)
        data = {
            "version": self._version(cell.evaluation, cell.condition, settings),
            "condition": condition,
            "values": cell.values,
            "error": cell.error,
            "processor_s": cell.processor_s,
        }
        self.write(self._name(cell.evaluation, cell.condition, settings), data)


def plan(
    names: Sequence[str], settings: Settings, recordings: Iterable[Path], *, worlds: bool = True
) -> list[Job]:
    """Return one job for each condition and each recording, with all evaluations that need it.

    Without ``worlds`` there are only the recordings.
    """
    names_of: dict[Condition | RecordedCondition, list[str]] = {}
    for name in names:
        evaluation = load(name)
        if worlds:
            for condition in evaluation.conditions(settings):
                names_of.setdefault(condition, []).append(name)
        if not evaluation.NEEDS_TRUTH:
            for path in recordings:
                names_of.setdefault(RecordedCondition(path), []).append(name)
    return [
        Job(condition, tuple(names_of_condition), settings)
        for condition, names_of_condition in names_of.items()
    ]
