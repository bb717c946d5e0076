"""Report of the evaluations: a page of HTML in one file, JSON, tables and figures."""

from __future__ import annotations

import base64
import csv
import io
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from amiwarp.errors import AmiwarpError
from amiwarp.io.atomic_output import NewFile, make_folder, write_text
from amiwarp.studies.evaluate.conditions import Stream
from amiwarp.studies.evaluate.drawing import draw, save, to_svg
from amiwarp.studies.evaluate.registry import load, pictures
from amiwarp.studies.evaluate.results import CellResult, Chart, Claim, Picture, Settings, Table, Value, rows_of
from amiwarp.studies.machine_info import machine, versions

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PACKAGES = ("numpy", "scipy", "warp-lang", "scikit-image", "scikit-learn", "opencv-python-headless", "matplotlib")
"""Packages whose versions the report states."""
REPORT_FILES = ("report.html", "report.json")
"""Names of the report's main files."""
STD = "std"
"""Name of the column of the standard deviation, which is shown behind the value in the column before it."""


@dataclass(frozen=True)
class Section:
    """Section of the report: one evaluation."""

    name: str
    """Name of the evaluation."""
    title: str
    """Title."""
    protocol: str
    """What is computed."""
    differences: str
    """How that differs from the paper."""
    claims: list[Claim]
    """Claims of the paper with verdicts."""
    tables: list[Table]
    """Tables."""
    pictures: list[Picture]
    """Pictures and films."""
    cells: int
    """Number of cells."""
    errors: list[str]
    """Messages of cells that failed."""
    not_calibrated: dict[str, str]
    """Share of the recordings that the calibration refused, by scene and motion of the camera."""
    processor_s: float
    """Processor time of the measures [s]."""


def section(name: str, results: Sequence[CellResult]) -> Section:
    """Return the section of an evaluation from the results of its cells."""
    evaluation = load(name)
    good = [r for r in results if not r.error]
    errors = [f"{r.condition}: {r.error}" for r in results if r.error]
    shown = evaluation.tables(good) if good else []
    return Section(
        name, evaluation.TITLE, evaluation.PROTOCOL, evaluation.DIFFERENCES, evaluation.claims(good), shown,
        pictures(evaluation, good), len(results), errors, refused(good), sum(r.processor_s for r in results),
    )  # fmt: skip


def refused(results: Sequence[CellResult]) -> dict[str, str]:
    """Return the share of recordings without a calibrated stream, by scene and motion of the camera."""
    counts: dict[str, list[bool]] = {}
    for result in results:
        lists = (name for name, value in result.values.items() if isinstance(value, list) and value)
        tables = [name for name in lists if "stream" in result.values[name][0]]
        rows = rows_of([result], tables[0]) if tables else []
        streams = {row["stream"] for row in rows}
        if Stream.RAW in streams:
            counts.setdefault(f"{rows[0]['scene']}, {rows[0]['camera']}", []).append(Stream.CALIBRATED not in streams)
    return {case: f"{sum(missing)} of {len(missing)}" for case, missing in counts.items() if any(missing)}


def write(out: Path, sections: Sequence[Section], settings: Settings, processor_s: float) -> dict[str, Path]:
    """Write the report, its tables and its figures to a folder, and return the main files."""
    for folder in ("tables", "figures"):
        make_folder(out / folder)
    figures: dict[str, Figure] = {}
    for table in (t for s in sections for t in s.tables):
        _write_csv(out / "tables" / f"{table.name}.csv", table)
        if (figure := draw(table)) is not None:
            figures[table.name] = figure
            for kind in ("png", "pdf"):
                save(figure, out / "figures" / f"{table.name}.{kind}")
    films = {p.name: _encode(p) for s in sections for p in s.pictures}
    for picture in (p for s in sections for p in s.pictures):
        _write_bytes(out / "figures" / f"{picture.name}.{_kind(picture)}", films[picture.name])
    about = _about(settings, processor_s)
    files = dict(zip(("report", "data"), (out / name for name in REPORT_FILES), strict=True))
    write_text(files["report"], _page(sections, figures, films, about))
    data = {"about": about, "evaluations": [_json(s) for s in sections]}
    write_text(files["data"], json.dumps(data, indent=1, default=str) + "\n")
    return files


def _about(settings: Settings, processor_s: float) -> dict[str, Any]:
    return {
        "date": time.strftime("%Y-%m-%d"), "settings": asdict(settings), "machine": machine(settings.device),
        "versions": versions(PACKAGES), "processor_s": processor_s,
    }  # fmt: skip


def _json(one: Section) -> dict[str, Any]:
    """Return a section as JSON data, without its pictures."""
    data = {name: value for name, value in vars(one).items() if name not in ("pictures", "claims", "tables")}
    tables = [asdict(t) for t in one.tables if not t.long]
    return {**data, "claims": [asdict(c) for c in one.claims], "tables": tables}


def _write_csv(path: Path, table: Table) -> None:
    buffer = io.StringIO()
    rows = csv.writer(buffer, lineterminator="\n")
    rows.writerow(table.columns)
    rows.writerows(table.rows)
    write_text(path, buffer.getvalue())


def _write_bytes(path: Path, data: bytes) -> None:
    with NewFile(path) as new:
        new.part.write_bytes(data)


def _kind(picture: Picture) -> str:
    return "gif" if len(picture.frames) > 1 else "png"


def _encode(picture: Picture) -> bytes:
    """Return a picture as PNG, or a film as GIF."""
    from PIL import Image

    frames = [Image.fromarray(frame) for frame in picture.frames]
    buffer = io.BytesIO()
    if len(frames) == 1:
        frames[0].save(buffer, format="PNG", optimize=True)
    else:
        duration = round(1000 * picture.frame_s)
        frames[0].save(buffer, format="GIF", save_all=True, append_images=frames[1:], duration=duration, loop=0)
    return buffer.getvalue()


def _page(
    sections: Sequence[Section], figures: Mapping[str, Figure], films: Mapping[str, bytes], about: dict[str, Any]
) -> str:
    """Return the report as a page of HTML without references to other files."""
    try:
        import jinja2
    except ModuleNotFoundError as error:
        raise AmiwarpError("'amiwarp evaluate' needs Jinja2; run: pip install 'amiwarp[evaluate]'") from error
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    images = {name: _data("image/svg+xml", to_svg(figure)) for name, figure in figures.items()}
    kinds = {p.name: _kind(p) for s in sections for p in s.pictures}
    images |= {name: _data(f"image/{kinds[name]}", data) for name, data in films.items()}
    compact = {t.name: pivoted(t) for s in sections for t in s.tables if not t.long}
    template = environment.get_template("report.html.j2")
    return template.render(sections=sections, images=images, compact=compact, about=about)


def _data(kind: str, data: bytes) -> str:
    """Return data as an address that contains them."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def pivoted(table: Table) -> tuple[list[str], list[list[str]]]:
    """Return the headings and the cells of a table for reading.

    Standard deviations stand behind their values. The series of a chart become columns.
    """
    rows = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
    if table.chart is None:
        names = [c for c in table.columns if c != STD]
        return names, [[_cell(table, row, name) for name in names] for row in rows]
    chart = table.chart
    index = [c for c in dict.fromkeys((*chart.panels, chart.x)) if c in table.columns]
    return _pivot(table, chart, rows, index)


def _pivot(
    table: Table, chart: Chart, rows: list[dict[str, Value]], index: list[str]
) -> tuple[list[str], list[list[str]]]:
    """Return the table with one column for each series of its chart."""
    series = list(dict.fromkeys(row[chart.series] for row in rows))
    found: dict[tuple[Value, ...], dict[Value, str]] = {}
    for row in rows:
        found.setdefault(tuple(row[c] for c in index), {})[row[chart.series]] = _cell(table, row, chart.y)
    cells = [[*(shown(v) for v in key), *(values.get(s, "–") for s in series)] for key, values in found.items()]
    return [*index, *map(str, series)], cells


def _cell(table: Table, row: dict[str, Value], name: str) -> str:
    """Return a value as text, with its standard deviation if the next column has it."""
    after = table.columns.index(name) + 1
    has_std = after < len(table.columns) and table.columns[after] == STD
    text = shown(row[name])
    return f"{text} ± {shown(row[STD], 2)}" if has_std and row[name] is not None else text


def shown(value: Value, digits: int = 3) -> str:
    """Return a value as a person reads it: a number with a few digits, or a dash for none."""
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 10**digits else f"{value:.{digits}g}"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)
