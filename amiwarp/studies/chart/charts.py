"""Both charts from one recording: measured, drawn, written as figures, JSON and CSV, and asked for a budget."""

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
from amiwarp.io.output import check_output, make_folder, write_text
from amiwarp.progress import Progress, part, silent
from amiwarp.simulation.simulator import SensorModel
from amiwarp.studies.chart import calibration, compensation
from amiwarp.studies.chart.drawing import draw
from amiwarp.studies.chart.rows import Row, beaten_by, fastest_within, fronts, most_accurate_within
from amiwarp.studies.chart.truth import Known
from amiwarp.studies.demo import Demo, simulation
from amiwarp.studies.machine import machine, versions

if TYPE_CHECKING:
    from amiwarp.events.recording import Recording

PACKAGES = ("warp-lang", "numpy", "nlopt", "numba", "torch", "cupy-cuda12x", "cupy-cuda13x")
ABOUT = ("format", "version", "date", "machine", "device", "processor", "versions", "recording")
USUAL, QUICK = (640, 480, 2.0), (320, 240, 0.2)
"""Size and length [s] of the simulated recording."""
CONTRAST = 0.54
"""Threshold [log intensity] at which the map of the earth gives ten million events in those two seconds."""
REPEATS = {"compensation": 5, "calibration": 3}


@dataclass(frozen=True)
class Charts:
    """What was measured, and where it was written."""

    compensation: tuple[Row, ...]
    calibration: tuple[Row, ...]
    files: dict[str, Path]
    notes: tuple[str, ...]
    """On what is missing, and on settings that were refused."""
    about: dict[str, Any]
    """Machine, versions, date, recording."""

    @classmethod
    def load(cls, data: Path) -> Charts:
        """Reads ``chart.json``. Raises :class:`AmiwarpError` where it is none."""
        names = [f.name for f in fields(Row)]
        try:
            held = json.loads(data.read_text())
            rows = {k: tuple(Row(**{n: r[n] for n in names}) for r in held[k]["rows"]) for k in REPEATS}
            about = {name: held[name] for name in ABOUT}
        except (OSError, ValueError, TypeError, LookupError) as error:
            raise AmiwarpError(f"{data}: cannot be read as the data of charts ({error!r}); make it again") from error
        return cls(rows["compensation"], rows["calibration"], {"data": data}, tuple(held["notes"]), about)

    def draw(self, out: Path) -> Charts:
        """Both figures in the folder ``out``. Where Matplotlib or Pillow is missing, a note says so instead."""
        try:
            files = {name: path for chart in REPEATS for name, path in self._draw(chart, out).items()}
        except ModuleNotFoundError as missing:
            later = "python -m benchmarks.chart --from chart.json --out FOLDER"
            return replace(self, notes=(*self.notes, f"charts: not drawn, {missing}; where it is there: {later}"))
        return replace(self, files=self.files | files)

    def _draw(self, chart: str, out: Path) -> dict[str, Path]:
        rows: tuple[Row, ...] = getattr(self, chart)
        events = self.about["recording"]["events"] / 1e6
        title = f"{chart.capitalize()} on {self.about['machine']}: {events:.1f} M events"
        draw(out / chart, rows, title, _share_note(rows) if chart == "compensation" else _guess_note(rows))
        return _drawn(chart, out)

    def answer(
        self, folder: Path, *, budget_px: float | None = None, budget_ms: float | None = None
    ) -> dict[str, Row | None]:
        """For each command the best row within a budget, written to ``folder`` as a preset; None where there is none.

        ``budget_px``: the fastest of both; ``budget_ms``: the most accurate calibration.
        """
        out: dict[str, Row | None] = {}
        files = [r for r in self.compensation if r.job == compensation.FILE]
        if budget_px is not None:
            out["calibration"] = fastest_within(self.calibration, budget_px)
            # without files the images tell the models' order
            out["compensation"] = fastest_within(files or _as_files(self.compensation), budget_px)
        if budget_ms is not None:
            out["calibration"] = most_accurate_within(self.calibration, budget_ms * 1e-3)
        for kind, row in out.items():
            if row is not None:
                _preset(kind, row).save(folder / f"preset_{kind}.json")
        return out


def _as_files(rows: Sequence[Row]) -> list[Row]:
    whole = {"vote": "bilinear", "angles": TURNS, "share": 1.0}
    return [r for r in rows if "library" not in r.settings and all(r.settings[n] == v for n, v in whole.items())]


def _preset(kind: str, row: Row) -> Preset:
    settings = {n: v for n, v in row.settings.items() if n != "device"}
    if kind == "compensation":
        settings = {"model": settings["model"]}
    return Preset(kind, settings, {"label": row.label, "device": row.settings["device"], **_measured(row)})


def _measured(row: Row) -> dict[str, float]:
    speed = {"ms": row.seconds * 1e3} if row.chart == "calibration" else {"mev_per_s": row.mev_per_s}
    return {**speed, "error_px": row.error_px}


def simulated(
    picture: Path | None = None, *, seed: int = 0, device: str = "cpu", quick: bool = False,
    progress: Progress | None = None,
) -> Recording:  # fmt: skip
    """As that of ``amiwarp demo``, but 24 turns, in memory; ``picture`` None for the map of the earth."""
    width, height, seconds = QUICK if quick else USUAL
    made = simulation(Demo(Path(), picture, width, height, seconds, seed, device))
    if not quick:
        made = replace(made, sensor=SensorModel(contrast_on=CONTRAST, contrast_off=CONTRAST))
    return made.run(progress=progress)


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
    """Measure a recording with truth; write both charts and their data into the folder ``out``.

    ``quick`` measures a few settings, once each. ``libraries`` adds rows of other libraries. Raises
    :class:`AmiwarpError` for a recording without truth, a folder that cannot be made or holds these files, and an image
    that is wrong.
    """
    known = Known.of(recording)
    make_folder(out)
    files = {"data": out / "chart.json", "table": out / "chart.csv"}
    for path in (*files.values(), *(path for chart in REPEATS for path in _drawn(chart, out).values())):
        check_output(path)
    tell = progress or silent
    repeats = dict.fromkeys(REPEATS, 1) if quick else REPEATS
    compensated, notes = compensation.rows(
        known,
        device,
        repeats=repeats["compensation"],
        quick=quick,
        folder=out,
        tell=part(tell, 0.0, 0.3),
        libraries=libraries,
    )
    calibrated, more = calibration.rows(
        known, device, repeats=repeats["calibration"], quick=quick, seed=seed, tell=part(tell, 0.3, 0.97)
    )
    tell("drawing", 0.97)
    done = Charts(tuple(compensated), tuple(calibrated), files, (*notes, *more), _about(known, device))
    # the figures last: they need packages that a machine with a GPU may lack
    write_text(files["data"], json.dumps({**done.about, **_data(done)}, indent=1, allow_nan=False) + "\n")
    write_text(files["table"], _csv([*compensated, *calibrated]))
    return done.draw(out)


def _drawn(chart: str, out: Path) -> dict[str, Path]:
    return {chart: out / f"{chart}.png", f"{chart} (SVG)": out / f"{chart}.svg"}


def _share_note(rows: Sequence[Row]) -> str:
    errors = [f"{100 * r.image_error:.0f} % of its contrast for 1/{round(1 / r.settings['share'])}"
              for r in rows if not r.comparable and r.image_error is not None]  # fmt: skip
    small = "Small marks: fewer angles a turn. " if any(r.settings.get("angles", 0) < TURNS
                                                        for r in rows if "angles" in r.settings) else ""  # fmt: skip
    return f"{small}A share of the events leaves noise in the image: {', '.join(errors)}."


def _guess_note(rows: Sequence[Row]) -> str:
    text = "Model error: rms over image and turn, the constant lag removed."
    guess = round(math.degrees(calibration.GUESS))
    if any(not r.comparable for r in rows):
        text += f" With a guess: the phase known to {guess}°, so beside the front."
    return text


def _about(known: Known, device: str) -> dict[str, Any]:
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
    """Rows with their fronts, and what beats a default."""
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
    """One line a row; settings that a row has not are empty."""
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
