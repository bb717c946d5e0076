"""Report of the evaluations: a page in HTML, its data in JSON, tables, figures and pictures."""

from __future__ import annotations

import base64
import io
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from amiwarp.io.output_formats import make_folder
from amiwarp.io.outputs import NewFile, write_csv, write_text
from amiwarp.studies.evaluate.catalogue import load
from amiwarp.studies.evaluate.charts import draw, save, to_svg
from amiwarp.studies.evaluate.claims import PAPER, Claim
from amiwarp.studies.evaluate.conditions import Settings
from amiwarp.studies.evaluate.libraries import library
from amiwarp.studies.evaluate.results import CellResult, Table, Value
from amiwarp.studies.evaluate.stored_pictures import Picture
from amiwarp.studies.machine import machine, versions

if TYPE_CHECKING:
    from matplotlib.figure import Figure


PACKAGES = (
    "numpy",
    "scipy",
    "warp-lang",
    "scikit-image",
    "scikit-learn",
    "opencv-python-headless",
    "matplotlib",
)
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
    """Claims of the paper, and checks of their robustness, with verdicts."""
    tables: list[Table]
    """Tables."""
    pictures: list[Picture]
    """Pictures and films."""
    cells: int
    """Number of cells."""
    errors: list[str]
    """Messages of cells that failed."""
    processor_s: float
    """Processor time of the measures [s]."""


def section(name: str, results: Sequence[CellResult]) -> Section:
    """Return the section of an evaluation from the results of its cells."""
    evaluation = load(name)
    good = [result for result in results if not result.error]
    pictures: list[Picture] = []
    if hasattr(evaluation, "pictures"):
        pictures = evaluation.pictures(good)
    return Section(
        name,
        evaluation.TITLE,
        evaluation.PROTOCOL,
        evaluation.DIFFERENCES,
        claims=evaluation.claims(good),
        tables=evaluation.tables(good) if good else [],
        pictures=pictures,
        cells=len(results),
        errors=[f"{result.condition.text}: {result.error}" for result in results if result.error],
        processor_s=sum(result.processor_s for result in results),
    )


def write(
    out: Path, sections: Sequence[Section], settings: Settings, processor_s: float
) -> dict[str, Path]:
    """Write the report, its tables and its figures to a folder, and return the main files."""
    for folder in ("tables", "figures"):
        make_folder(out / folder)
    figures: dict[str, Figure] = {}
    for table in _tables(sections):
        write_csv(out / "tables" / f"{table.name}.csv", table.columns, table.rows)
        if (figure := draw(table)) is not None:
            figures[table.name] = figure
            for kind in ("png", "pdf"):
                save(figure, out / "figures" / f"{table.name}.{kind}")

    # Encoded once, for the files and for the page
    films = {picture.name: _encode(picture) for picture in _pictures(sections)}
    for picture in _pictures(sections):
        with NewFile(out / "figures" / f"{picture.name}.{_kind(picture)}") as new:
            new.part.write_bytes(films[picture.name])

    about = _about(sections, settings, processor_s)
    page_name, data_name = REPORT_FILES
    files = {"report": out / page_name, "data": out / data_name}
    write_text(files["report"], _page(sections, figures, films, about))
    data = {"about": about, "evaluations": [_json(section) for section in sections]}
    write_text(files["data"], json.dumps(data, indent=1, default=str) + "\n")
    return files


def _tables(sections: Sequence[Section]) -> list[Table]:
    return [table for section in sections for table in section.tables]


def _pictures(sections: Sequence[Section]) -> list[Picture]:
    return [picture for section in sections for picture in section.pictures]


def _about(sections: Sequence[Section], settings: Settings, processor_s: float) -> dict[str, Any]:
    """Return what the report says of the whole run, as JSON data."""
    return {
        "date": time.strftime("%Y-%m-%d"),
        "settings": asdict(settings),
        "machine": machine(settings.device),
        "versions": versions(PACKAGES),
        "processor_s": processor_s,
        "cells": sum(section.cells for section in sections),
        "failed": sum(len(section.errors) for section in sections),
    }


def _json(section_of_page: Section) -> dict[str, Any]:
    """Return a section as JSON data, without its pictures."""
    data = dict(vars(section_of_page))
    for name in ("pictures", "claims", "tables"):
        del data[name]
    data["claims"] = [asdict(claim) | {"paper": claim.paper} for claim in section_of_page.claims]
    data["tables"] = [asdict(table) for table in section_of_page.tables if not table.long]
    return data


def _kind(picture: Picture) -> str:
    """Return the format of a picture's file, which is also its suffix."""
    return "gif" if len(picture.frames) > 1 else "png"


def _encode(picture: Picture) -> bytes:
    """Return a picture as PNG, or a film as GIF."""
    from PIL import Image

    frames = [Image.fromarray(frame) for frame in picture.frames]
    buffer = io.BytesIO()
    if len(frames) == 1:
        frames[0].save(buffer, format="PNG", optimize=True)
    else:
        frames[0].save(
            buffer,
            format="GIF",
            save_all=True,
            append_images=frames[1:],
            duration=round(1000 * picture.frame_s),
            loop=0,
        )
    return buffer.getvalue()


def _page(
    sections: Sequence[Section],
    figures: Mapping[str, Figure],
    films: Mapping[str, bytes],
    about: dict[str, Any],
) -> str:
    """Return the report as a page of HTML without references to other files."""
    jinja2 = library("jinja2")
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    images = {name: _address("image/svg+xml", to_svg(figure)) for name, figure in figures.items()}
    for picture in _pictures(sections):
        images[picture.name] = _address(f"image/{_kind(picture)}", films[picture.name])
    compact = {table.name: pivoted(table) for table in _tables(sections) if not table.long}
    all_claims = [claim for section in sections for claim in section.claims]
    claims = {}
    for number, paper in PAPER.items():
        claims[number] = (paper, [claim for claim in all_claims if claim.number == number])

    template = environment.get_template("report.html.j2")
    page = template.render(
        sections=sections, claims=claims, images=images, compact=compact, about=about
    )
    return str(page)


def _address(kind: str, data: bytes) -> str:
    """Return data as an address that contains them."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def pivoted(table: Table) -> tuple[list[str], list[list[str]]]:
    """Return the headings and the cells of a table for reading.

    Standard deviations stand behind their values. The series of a chart become columns.
    """
    rows = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
    chart = table.chart
    if chart is None:
        names = [column for column in table.columns if column != STD]
        return names, [[_cell(table, row, name) for name in names] for row in rows]

    index = [name for name in dict.fromkeys((*chart.panels, chart.x)) if name in table.columns]
    series = list(dict.fromkeys(row[chart.series] for row in rows))
    text_of: dict[tuple[Value, ...], dict[Value, str]] = {}
    for row in rows:
        key = tuple(row[name] for name in index)
        text_of.setdefault(key, {})[row[chart.series]] = _cell(table, row, chart.y)
    lines = []
    for key, texts in text_of.items():
        lines.append([*map(shown, key), *(texts.get(name, "–") for name in series)])
    return [*index, *map(str, series)], lines


def _cell(table: Table, row: dict[str, Value], name: str) -> str:
    """Return a value as text, with its standard deviation if the next column has it."""
    after = table.columns.index(name) + 1
    has_std = after < len(table.columns) and table.columns[after] == STD
    text = shown(row[name])
    if has_std and row[name] is not None:
        text += f" ± {shown(row[STD], 2)}"
    return text


def shown(value: Value, digits: int = 3) -> str:
    """Return a value as a person reads it: a number with a few digits, or a dash for none."""
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 10**digits else f"{value:.{digits}g}"
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    return str(value)
