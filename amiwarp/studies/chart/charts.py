"""Speed-error charts of compensation and calibration: measured on one recording, written as figures, JSON and CSV."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from amiwarp.calib.presets import Preset
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Recording
from amiwarp.imaging.uploaded_events import TURNS
from amiwarp.io.inputs import read_text
from amiwarp.io.output_formats import make_folder
from amiwarp.io.outputs import check_output, write_csv, write_text
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.studies.chart.calibration_rows import GUESS_ERROR_RAD, calibration_rows
from amiwarp.studies.chart.compensation_rows import FILE, Libraries, compensation_rows
from amiwarp.studies.chart.drawing import draw
from amiwarp.studies.chart.rows import Row, beaten_by, fastest_within, fronts, most_accurate_within
from amiwarp.studies.chart.truth import KnownRecording
from amiwarp.studies.demo import Demo, simulation
from amiwarp.studies.machine import machine, versions
from amiwarp.tasks import Progress, part, silent

PACKAGES = ("warp-lang", "numpy", "nlopt", "numba", "torch", "cupy-cuda12x", "cupy-cuda13x")
"""Packages whose versions are recorded with a chart."""
ABOUT = ("format", "version", "date", "machine", "device", "processor", "versions", "recording")
"""Keys of the description of machine and recording in ``chart.json``."""
USUAL = (640, 480, 2.0)
"""Width [px], height [px] and length [s] of the simulated recording."""
QUICK = (320, 240, 0.2)
"""The same for a quick run."""
CONTRAST = 0.54
"""Contrast threshold [log intensity] of the simulated sensor. With it the map of the earth gives ten million events in
two seconds."""
REPEATS = {"compensation": 5, "calibration": 45}
"""Number of repeated measurements of each setting, by chart. On the host of a GPU, the time of a calibration may vary
by half between repeats: the ratio of two medians of 45 is then accurate to 1 to 3 %."""


@dataclass(frozen=True)
class Charts:
    """Measured settings (rows) of both charts, and the written files."""

    compensation: tuple[Row, ...]
    """Measured settings of the compensation chart."""
    calibration: tuple[Row, ...]
    """Measured settings of the calibration chart."""
    files: dict[str, Path]
    """Paths of the written files, by name."""
    notes: tuple[str, ...]
    """Notes on settings that could not be measured or were refused."""
    about: dict[str, Any]
    """Description of the machine, the versions, the date and the recording."""
    failed: Mapping[str, str] = field(default_factory=dict)
    """Error of each setting that could not be measured because it failed, by its label."""

    @classmethod
    def load(cls, data: Path) -> Charts:
        """Read ``chart.json``. Raises :class:`AmiwarpError` if it is damaged or another file."""
        names = [field.name for field in fields(Row)]
        try:
            held = json.loads(read_text(data, noted=False))
            rows = {}
            for chart in REPEATS:
                stored = held[chart]["rows"]
                rows[chart] = tuple(Row(**{name: row[name] for name in names}) for row in stored)
            about = {name: held[name] for name in ABOUT}
            failed = {str(label): str(error) for label, error in held.get("failed", {}).items()}
        except (OSError, ValueError, TypeError, LookupError, AttributeError) as error:
            raise AmiwarpError(
                f"{data}: cannot be read as the data of charts ({error!r}); measure the charts again",
                ErrorCode.FORMAT_UNKNOWN,
            ) from error
        return cls(
            rows["compensation"],
            rows["calibration"],
            {"data": data},
            tuple(held["notes"]),
            about,
            failed,
        )

    def draw(self, out: Path) -> Charts:
        """Draw both figures into the folder ``out``; add a note if Matplotlib or Pillow is missing."""
        measured = []
        for chart in REPEATS:
            if any(chosen for _, chosen in fronts(self.rows(chart))):
                measured.append(chart)
        files = dict(self.files)
        try:
            for chart in measured:
                files |= self._draw(chart, out)
        except ModuleNotFoundError as missing:
            later = "python -m benchmarks.chart --from chart.json --out FOLDER"
            return replace(
                self,
                notes=(*self.notes, f"charts: not drawn, {missing}; install it and run: {later}"),
            )
        notes = [
            f"{chart}: not drawn, no setting was measured"
            for chart in REPEATS
            if chart not in measured
        ]
        return replace(self, files=files, notes=(*self.notes, *notes))

    def rows(self, chart: str) -> tuple[Row, ...]:
        """Return the measured settings of a chart."""
        measured: tuple[Row, ...] = getattr(self, chart)
        return measured

    def _draw(self, chart: str, out: Path) -> dict[str, Path]:
        """Draw one figure, and return the paths of its files."""
        rows = self.rows(chart)
        events = self.about["recording"]["events"] / 1e6
        title = f"{chart.capitalize()} on {self.about['machine']}: {events:.1f} M events"
        note = _share_note(rows) if chart == "compensation" else _guess_note(rows)
        if self.failed:
            note += f" {len(self.failed)} settings failed: see chart.json."
        draw(out / chart, rows, title, note)
        return _drawn(chart, out)

    def answer(
        self, folder: Path, *, budget_px: float | None = None, budget_ms: float | None = None
    ) -> dict[str, Row | None]:
        """Return for each command the best row within a budget (or None), and write it as a preset to ``folder``.

        ``budget_px`` selects the fastest rows of both commands; ``budget_ms`` the most accurate calibration.
        """
        best: dict[str, Row | None] = {}
        if budget_px is not None:
            best["calibration"] = fastest_within(self.calibration, budget_px)
            files = [row for row in self.compensation if row.job == FILE]
            # Without whole files, the images give the order of the models.
            best["compensation"] = fastest_within(files or _as_files(self.compensation), budget_px)
        if budget_ms is not None:
            best["calibration"] = most_accurate_within(self.calibration, budget_ms * 1e-3)
        for kind, row in best.items():
            if row is not None:
                _preset(kind, row).save(folder / f"preset_{kind}.json")
        return best


def _as_files(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of images of events that use all events, all angles and bilinear votes."""
    whole = {"vote": "bilinear", "angles": TURNS, "share": 1.0}
    of_files = []
    for row in rows:
        settings = row.settings
        if "library" not in settings and all(settings[name] == whole[name] for name in whole):
            of_files.append(row)
    return of_files


def _preset(kind: str, row: Row) -> Preset:
    """Return a measured setting as a preset of a command."""
    settings = dict(row.settings)
    device = settings.pop("device")
    if kind == "compensation":
        settings = {"model": settings["model"]}
    return Preset(kind, settings, {"label": row.label, "device": device, **_measured(row)})


def _measured(row: Row) -> dict[str, float]:
    """Return speed and error of a row by name, for its preset."""
    if row.chart == "calibration":
        return {"ms": row.seconds * 1e3, "error_px": row.error_px}
    return {"mev_per_s": row.mev_per_s, "error_px": row.error_px}


def simulated(
    picture: Path | None = None,
    *,
    seed: int = 0,
    device: str = "cpu",
    quick: bool = False,
    progress: Progress | None = None,
) -> Recording:
    """Simulate the recording of ``amiwarp demo`` in memory, with 24 turns.

    ``picture``: picture of the scene; None for the map of the earth.
    """
    width, height, seconds = QUICK if quick else USUAL
    described = simulation(Demo(Path(), picture, width, height, seconds, seed, device))
    if not quick:
        sensor = SensorModel(contrast_on=CONTRAST, contrast_off=CONTRAST)
        described = replace(described, sensor=sensor)
    recording = described.run(progress=progress)
    assert recording.truth is not None
    # The charts need no ground truth of single events, which is almost as large as the events.
    truth = replace(recording.truth, stored_points=None, stored_causes=None)
    return replace(recording, truth=truth)


def make(
    recording: Recording,
    out: Path,
    *,
    device: str = "cpu",
    seed: int = 0,
    quick: bool = False,
    libraries: Libraries | None = None,
    progress: Progress | None = None,
) -> Charts:
    """Measure a recording with ground truth; write both charts and their data into the folder ``out``.

    A setting that fails is named in the results, and does not stop the others. ``quick`` measures a few settings, once
    each. ``libraries`` adds rows of other libraries. Raises
    :class:`AmiwarpError` for a recording without ground truth, a folder that cannot be created or that holds these
    files, and a wrong image.
    """
    known = KnownRecording.of(recording)
    make_folder(out)
    files = {"data": out / "chart.json", "table": out / "chart.csv"}
    written = list(files.values())
    for chart in REPEATS:
        written += _drawn(chart, out).values()
    for path in written:
        check_output(path)

    report = progress or silent
    failed: dict[str, str] = {}
    repeats = dict.fromkeys(REPEATS, 1) if quick else REPEATS
    compensated, notes = compensation_rows(
        known,
        device,
        repeats=repeats["compensation"],
        quick=quick,
        folder=out,
        progress=part(report, 0.0, 0.3),
        failed=failed,
        libraries=libraries,
    )
    calibrated, more = calibration_rows(
        known,
        device,
        repeats=repeats["calibration"],
        quick=quick,
        seed=seed,
        progress=part(report, 0.3, 0.97),
        failed=failed,
    )

    report("drawing", 0.97)
    about = _about(known, device)
    charts = Charts(tuple(compensated), tuple(calibrated), files, (*notes, *more), about, failed)
    data = {**charts.about, **_data(charts)}
    write_text(files["data"], json.dumps(data, indent=1, allow_nan=False) + "\n")
    # Figures come last, because a GPU machine may lack their packages.
    _write_csv(files["table"], [*compensated, *calibrated])
    return charts.draw(out)


def _drawn(chart: str, out: Path) -> dict[str, Path]:
    """Return the paths of the figures of a chart."""
    return {chart: out / f"{chart}.png", f"{chart} (SVG)": out / f"{chart}.svg"}


def _share_note(rows: Sequence[Row]) -> str:
    """Return the note that is printed below the compensation chart."""
    errors = []
    for row in rows:
        if not row.comparable and row.image_error is not None:
            divisor = round(1 / row.settings["share"])
            errors.append(f"{100 * row.image_error:.0f} % of its contrast for 1/{divisor}")
    note = f"A share of the events adds noise to the image: {', '.join(errors)}."
    if any(row.settings.get("angles", TURNS) < TURNS for row in rows):
        note = f"Small markers: fewer angles per turn. {note}"
    return note


def _guess_note(rows: Sequence[Row]) -> str:
    """Return the note that is printed below the calibration chart."""
    text = "Model error: rms over image and turn, without the constant lag."
    guess = round(math.degrees(GUESS_ERROR_RAD))
    if any(not r.comparable for r in rows):
        text += f" With a guess: the phase is known to {guess}°, so these points are not part of the front."
    return text


def _about(known: KnownRecording, device: str) -> dict[str, Any]:
    """Return the description of the machine and the recording by name."""
    return {
        "format": "amiwarp-chart",
        "version": 1,
        "date": time.strftime("%Y-%m-%d"),
        "machine": machine(device),
        "device": device,
        "processor": machine("cpu"),
        "versions": versions(PACKAGES),
        "recording": {
            "name": known.recording.name,
            "events": len(known.events),
            "width": known.camera.width,
            "height": known.camera.height,
            "truth": known.recording.truth.parameters if known.recording.truth else {},
        },
    }


def _data(charts: Charts) -> dict[str, Any]:
    """Return as JSON data the rows, those on the Pareto fronts, and rows that are better than a default."""
    data: dict[str, Any] = {"notes": list(charts.notes), "failed": dict(charts.failed)}
    for name in REPEATS:
        rows = charts.rows(name)
        defaults = {}
        for row in rows:
            if row.default:
                better = beaten_by(row, rows)
                defaults[row.label] = {"beaten_by": [other.label for other in better]}
        data[name] = {
            "rows": [{**asdict(row), **_measured(row)} for row in rows],
            "fronts": {job: [row.label for row in chosen] for job, chosen in fronts(rows)},
            "defaults": defaults,
        }
    return data


def _write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write the rows as CSV, one line per measured setting. Settings that a row lacks are empty."""
    fixed = (
        "chart",
        "job",
        "label",
        "default",
        "on_front",
        "error_px",
        "mev_per_s",
        "ms",
        "spread",
        "repeats",
        "image_error",
    )
    on_front = set()
    for name in REPEATS:
        for _, chosen in fronts([row for row in rows if row.chart == name]):
            on_front |= {id(row) for row in chosen}

    lines = []
    for row in rows:
        line = {name: getattr(row, name, None) for name in fixed}
        line["on_front"] = id(row) in on_front
        line["ms"] = row.seconds * 1e3
        settings = dict(row.settings)
        photometric = settings.pop("photometric", {})
        settings |= {f"photometric_{name}": value for name, value in photometric.items()}
        if isinstance(settings.get("stages"), list):
            settings["stages"] = "+".join(settings["stages"])
        lines.append(line | settings)

    names = dict.fromkeys(fixed)
    for line in lines:
        names |= dict.fromkeys(line)
    write_csv(path, names, ([line.get(name, "") for name in names] for line in lines))
