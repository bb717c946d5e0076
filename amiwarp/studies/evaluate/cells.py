"""Cells of the study: one evaluation under one condition. Each is a file, so that a stopped run can be continued."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from amiwarp._version import __version__
from amiwarp.cpu_threads import cpu_threads, limited_cpu_threads
from amiwarp.errors import AmiwarpError
from amiwarp.io.json_files import fields_of, value_of
from amiwarp.io.sealed_json import CellStore
from amiwarp.kernels.launch import load_all, load_kernels
from amiwarp.studies.cpu_kernels import EXACT_KERNELS
from amiwarp.studies.evaluate.conditions import Condition, RecordedCondition, RecordedStreams, Streams
from amiwarp.studies.evaluate.measures.libraries import library
from amiwarp.studies.evaluate.registry import load
from amiwarp.studies.evaluate.results import CellResult, Settings
from amiwarp.validation import real

FORMAT = 4
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


@dataclass(frozen=True)
class JobResult:
    """Results of a job."""

    cells: list[CellResult]
    """Result of each evaluation."""
    processor_s: float
    """Processor time of the whole job [s]."""


def run_job(job: Job) -> JobResult:
    """Simulate the condition of a job once, or open its recording, and run its evaluations."""
    began = time.process_time()
    with limited_cpu_threads(job.threads), _limited_opencv(cpu_threads()):
        try:
            if isinstance(job.condition, Condition):
                streams: RecordedStreams = Streams(job.condition, job.settings.device)
            else:
                streams = RecordedStreams.of(job.condition, job.settings.device)
            cells = [_run(name, streams, job) for name in job.evaluations]
        except AmiwarpError as error:
            cells = [CellResult(name, job.condition, error=str(error)) for name in job.evaluations]
    return JobResult(cells, time.process_time() - began)


@contextlib.contextmanager
def _limited_opencv(threads: int) -> Iterator[None]:
    """Let OpenCV use a number of threads within the block; by default it uses all cores."""
    cv2 = library("cv2")
    before = cv2.getNumThreads()
    cv2.setNumThreads(threads)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def compile_kernels(names: Sequence[str], device: str) -> float:
    """Compile the kernels of evaluations, which else each worker would compile. Return the processor time [s]."""
    began = time.process_time()
    for name in names:
        load(name)
    load_all(device)
    if device == "cpu":
        load_kernels(EXACT_KERNELS, device)
    return time.process_time() - began


def _run(name: str, streams: RecordedStreams, job: Job) -> CellResult:
    """Run one evaluation. An error becomes part of the result, as a refused calibration does."""
    began = time.process_time()
    try:
        values, error = _as_stored(name, load(name).measure(streams, job.settings)), ""
    except AmiwarpError as refusal:
        values, error = {}, str(refusal)
    return CellResult(name, job.condition, values, error, time.process_time() - began)


def _as_stored(name: str, values: dict[str, Any]) -> dict[str, Any]:
    """Return the values of an evaluation as their cell will give them; numbers that are not finite become None."""
    plain = json.loads(json.dumps(values), parse_constant=lambda word: None)
    return value_of(load(name).Values, plain, f"values of {name}")


class Store(CellStore):
    """Folder of the cells of evaluations."""

    @staticmethod
    def _name(name: str, condition: Condition | RecordedCondition, settings: Settings) -> str:
        return f"{name}_{'quick' if settings.quick else 'full'}_{condition.key}.json"

    @staticmethod
    def _version(name: str, condition: Condition | RecordedCondition, settings: Settings) -> list[Any]:
        """Return all that a cell depends on: its condition, versions, settings and the kind of device.

        Seeds are left out, so that a run with more of them keeps its cells; the first one is shown in pictures.
        """
        size = asdict(settings) | {"device": settings.device.partition(":")[0]}
        del size["seeds"]
        return [FORMAT, __version__, load(name).VERSION, size, condition.key]

    def load(self, name: str, condition: Condition | RecordedCondition, settings: Settings) -> CellResult | None:
        """Return a stored cell; None if it is missing, damaged, or of another version, other settings or a device."""

        def make(data: dict[str, Any]) -> CellResult | None:
            fields_of(data, "", "version", "condition", "values", "error", "processor_s")
            if data["version"] != self._version(name, condition, settings):
                return None
            error, seconds = value_of(str, data["error"], "error"), real(data["processor_s"], "processor_s", 0.0, 1e9)
            values = {} if error else value_of(load(name).Values, data["values"], "values")
            return CellResult(name, condition, values, error, seconds)

        return self.read(self._name(name, condition, settings), make)

    def save(self, cell: CellResult, settings: Settings) -> None:
        """Write a cell."""
        condition = {name: str(v) if isinstance(v, Path) else v for name, v in asdict(cell.condition).items()}
        self.write(self._name(cell.evaluation, cell.condition, settings), {
            "version": self._version(cell.evaluation, cell.condition, settings),
            "condition": condition,
            "values": cell.values,
            "error": cell.error,
            "processor_s": cell.processor_s,
        })  # fmt: skip


def plan(names: Sequence[str], settings: Settings, recordings: Iterable[Path], *, worlds: bool = True) -> list[Job]:
    """Return one job for each condition and each recording, with all evaluations that need it.

    Without ``worlds`` there are only the recordings.
    """
    by: dict[Condition | RecordedCondition, list[str]] = {}
    for name in names:
        evaluation = load(name)
        for condition in evaluation.conditions(settings) if worlds else ():
            by.setdefault(condition, []).append(name)
        for path in () if evaluation.NEEDS_TRUTH else recordings:
            by.setdefault(RecordedCondition(path), []).append(name)
    return [Job(condition, tuple(evaluations), settings) for condition, evaluations in by.items()]
