"""Speed-error charts of compensation and calibration: measured on one recording, written as figures, JSON and CSV."""

from __future__ import annotations

import csv
import io
import json
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from amiwarp.calib.presets import Preset
from amiwarp.errors import AmiwarpError
from amiwarp.imaging.device_events import TURNS
from amiwarp.io.atomic_output import check_output, make_folder, write_text
from amiwarp.io.input_files import read_text
from amiwarp.progress import Progress, part, silent
from amiwarp.simulation.sensor import SensorModel
from amiwarp.studies.chart import calibration, compensation
from amiwarp.studies.chart.drawing import draw
from amiwarp.studies.chart.rows import Row, beaten_by, fastest_within, fronts, most_accurate_within
from amiwarp.studies.chart.truth import KnownRecording
from amiwarp.studies.demo import Demo, simulation
from amiwarp.studies.machine_info import machine, versions

if TYPE_CHECKING:
    from amiwarp.events.recording import Recording

PACKAGES = ("warp-lang", "numpy", "nlopt", "numba", "torch", "cupy-cuda12x", "cupy-cuda13x")
"""Packages whose versions are recorded with a chart."""
ABOUT = ("format", "version", "date", "machine", "device", "processor", "versions", "recording")
"""Keys of the description of machine and recording in ``chart.json``."""
USUAL, QUICK = (640, 480, 2.0), (320, 240, 0.2)
"""Width [px], height [px] and length [s] of the simulated recording: usual size, and size for a quick run."""
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

    @classmethod
    def load(cls, data: Path) -> Charts:
        """Read ``chart.json``. Raises :class:`AmiwarpError` if it is damaged or another file."""
        names = [f.name for f in fields(Row)]
        try:
            held = json.loads(read_text(data, noted=False))
            rows = {k: tuple(Row(**{n: r[n] for n in names}) for r in held[k]["rows"]) for k in REPEATS}
            about = {name: held[name] for name in ABOUT}
        except (OSError, ValueError, TypeError, LookupError) as error:
            raise AmiwarpError(
                f"{data}: cannot be read as the data of charts ({error!r}); measure the charts again"
            ) from error
        return cls(rows["compensation"], rows["calibration"], {"data": data}, tuple(held["notes"]), about)

    def draw(self, out: Path) -> Charts:
        """Draw both figures into the folder ``out``; add a note if Matplotlib or Pillow is missing."""
        try:
            files = {name: path for chart in REPEATS for name, path in self._draw(chart, out).items()}
        except ModuleNotFoundError as missing:
            later = "python -m benchmarks.chart --from chart.json --out FOLDER"
            return replace(self, notes=(*self.notes, f"charts: not drawn, {missing}; install it and run: {later}"))
        return replace(self, files=self.files | files)

    def _draw(self, chart: str, out: Path) -> dict[str, Path]:
        """Draw one figure, and return the paths of its files."""
        rows: tuple[Row, ...] = getattr(self, chart)
        events = self.about["recording"]["events"] / 1e6
        title = f"{chart.capitalize()} on {self.about['machine']}: {events:.1f} M events"
        draw(out / chart, rows, title, _share_note(rows) if chart == "compensation" else _guess_note(rows))
        return _drawn(chart, out)

    def answer(
        self, folder: Path, *, budget_px: float | None = None, budget_ms: float | None = None
    ) -> dict[str, Row | None]:
        """Return for each command the best row within a budget (or None), and write it as a preset to ``folder``.

        ``budget_px`` selects the fastest rows of both commands; ``budget_ms`` the most accurate calibration.
        """
        out: dict[str, Row | None] = {}
        files = [r for r in self.compensation if r.job == compensation.FILE]
        if budget_px is not None:
            out["calibration"] = fastest_within(self.calibration, budget_px)
            # without whole files, the images give the order of the models
            out["compensation"] = fastest_within(files or _as_files(self.compensation), budget_px)
        if budget_ms is not None:
            out["calibration"] = most_accurate_within(self.calibration, budget_ms * 1e-3)
        for kind, row in out.items():
            if row is not None:
                _preset(kind, row).save(folder / f"preset_{kind}.json")
        return out


def _as_files(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of images of events that use all events, all angles and bilinear votes."""
    whole = {"vote": "bilinear", "angles": TURNS, "share": 1.0}
    return [r for r in rows if "library" not in r.settings and all(r.settings[n] == v for n, v in whole.items())]


def _preset(kind: str, row: Row) -> Preset:
    """Return a measured setting as a preset of a command."""
    settings = {n: v for n, v in row.settings.items() if n != "device"}
    if kind == "compensation":
        settings = {"model": settings["model"]}
    return Preset(kind, settings, {"label": row.label, "device": row.settings["device"], **_measured(row)})


def _measured(row: Row) -> dict[str, float]:
    """Return speed and error of a row by name, for its preset."""
    speed = {"ms": row.seconds * 1e3} if row.chart == "calibration" else {"mev_per_s": row.mev_per_s}
    return {**speed, "error_px": row.error_px}


def simulated(
    picture: Path | None = None, *, seed: int = 0, device: str = "cpu", quick: bool = False,
    progress: Progress | None = None,
) -> Recording:  # fmt: skip
    """Simulate the recording of ``amiwarp demo`` in memory, with 24 turns.

    ``picture``: picture of the scene; None for the map of the earth.
    """
    width, height, seconds = QUICK if quick else USUAL
    simulated_scene = simulation(Demo(Path(), picture, width, height, seconds, seed, device))
    if not quick:
        simulated_scene = replace(simulated_scene, sensor=SensorModel(contrast_on=CONTRAST, contrast_off=CONTRAST))
    recording = simulated_scene.run(progress=progress)
    assert recording.truth is not None
    # the charts need no ground truth of single events, which is almost as large as the events
    return replace(recording, truth=replace(recording.truth, stored_points=None, stored_causes=None))


def make(
    recording: Recording,
    out: Path,
    *,
    device: str = "cpu",
    seed: int = 0,
    quick: bool = False,
    libraries: compensation.Libraries | None = None,
    progress: Progress | None = None,
) -> Charts:
    """Measure a recording with ground truth; write both charts and their data into the folder ``out``.

    ``quick`` measures a few settings, once each. ``libraries`` adds rows of other libraries. Raises
    :class:`AmiwarpError` for a recording without ground truth, a folder that cannot be created or that holds these
    files, and a wrong image.
    """
    known = KnownRecording.of(recording)
    make_folder(out)
    files = {"data": out / "chart.json", "table": out / "chart.csv"}
    for path in (*files.values(), *(path for chart in REPEATS for path in _drawn(chart, out).values())):
        check_output(path)
    report = progress or silent
    repeats = dict.fromkeys(REPEATS, 1) if quick else REPEATS
    compensated, notes = compensation.rows(
        known,
        device,
        repeats=repeats["compensation"],
        quick=quick,
        folder=out,
        progress=part(report, 0.0, 0.3),
        libraries=libraries,
    )
    calibrated, more = calibration.rows(
        known, device, repeats=repeats["calibration"], quick=quick, seed=seed, progress=part(report, 0.3, 0.97)
    )
    report("drawing", 0.97)
    charts = Charts(tuple(compensated), tuple(calibrated), files, (*notes, *more), _about(known, device))
    # figures come last, because a GPU machine may lack their packages
    write_text(files["data"], json.dumps({**charts.about, **_data(charts)}, indent=1, allow_nan=False) + "\n")
    write_text(files["table"], _csv([*compensated, *calibrated]))
    return charts.draw(out)


def _drawn(chart: str, out: Path) -> dict[str, Path]:
    """Return the paths of the figures of a chart."""
    return {chart: out / f"{chart}.png", f"{chart} (SVG)": out / f"{chart}.svg"}


def _share_note(rows: Sequence[Row]) -> str:
    """Return the note that is printed below the compensation chart."""
    errors = [f"{100 * r.image_error:.0f} % of its contrast for 1/{round(1 / r.settings['share'])}"
              for r in rows if not r.comparable and r.image_error is not None]  # fmt: skip
    small = "Small markers: fewer angles per turn. " if any(r.settings.get("angles", 0) < TURNS
                                                        for r in rows if "angles" in r.settings) else ""  # fmt: skip
    return f"{small}A share of the events adds noise to the image: {', '.join(errors)}."


def _guess_note(rows: Sequence[Row]) -> str:
    """Return the note that is printed below the calibration chart."""
    text = "Model error: rms over image and turn, without the constant lag."
    guess = round(math.degrees(calibration.GUESS))
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
        "recording": {"name": known.recording.name, "events": len(known.events), "width": known.camera.width,
                      "height": known.camera.height, "truth": known.recording.truth.parameters
                      if known.recording.truth else {}},
    }  # fmt: skip


def _data(charts: Charts) -> dict[str, Any]:
    """Return as JSON data the rows, those on the Pareto fronts, and rows that are better than a default."""
    out: dict[str, Any] = {"notes": list(charts.notes)}
    for name in ("compensation", "calibration"):
        rows: tuple[Row, ...] = getattr(charts, name)
        out[name] = {
            "rows": [{**asdict(r), **_measured(r)} for r in rows],
            "fronts": {job: [r.label for r in chosen] for job, chosen in fronts(rows)},
            "defaults": {r.label: {"beaten_by": [b.label for b in beaten_by(r, rows)]} for r in rows if r.default},
        }
    return out


def _csv(rows: Sequence[Row]) -> str:
    """Return the rows as CSV, one line per measured setting. Settings that a row lacks are empty."""
    fixed = ("chart", "job", "label", "default", "on_front", "error_px", "mev_per_s", "ms", "spread",
             "repeats", "image_error")  # fmt: skip
    on = {id(r) for name in REPEATS for _, chosen in fronts([r for r in rows if r.chart == name]) for r in chosen}
    flat = []
    for r in rows:
        nested = r.settings.get("photometric", {})
        plain = {n: v for n, v in r.settings.items() if n != "photometric"}
        plain |= {f"photometric_{n}": v for n, v in nested.items()}
        if isinstance(plain.get("stages"), list):
            plain["stages"] = "+".join(plain["stages"])
        known = {n: getattr(r, n, None) for n in fixed} | {"on_front": id(r) in on, "ms": r.seconds * 1e3}
        flat.append(known | plain)
    names = list(dict.fromkeys([*fixed, *(n for line in flat for n in line)]))
    text = io.StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(flat)
    return text.getvalue()
