"""Make the tables and figures of the page on the paper's results from the reports of ``amiwarp evaluate``.

The reports are ``benchmarks/results/evaluate/*.json``, each a ``report.json``. What is made from them is not under
version control: ``docs/reference/paper-results/``, with the text ``content.md``, which
``benchmarks/results/paper_results.md`` includes.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from generated_files import write_page
from sphinx.application import Sphinx

from amiwarp.studies.evaluate.charts import draw, save
from amiwarp.studies.evaluate.claims import PAPER
from amiwarp.studies.evaluate.report import pivoted
from amiwarp.studies.evaluate.results import Chart, ChartKind, Table

FOLDER = "paper-results"
"""Name of the folder of the figures and of the text."""
LONGEST = 60
"""Largest number of rows of a table without a chart on the page."""


def table_of(data: dict[str, Any]) -> Table:
    """Return a table from its JSON form."""
    chart = data["chart"]
    if chart is not None:
        chart = Chart(
            **{**chart, "panels": tuple(chart["panels"]), "kind": ChartKind(chart["kind"])}
        )
    rows = [tuple(row) for row in data["rows"]]
    return Table(data["name"], data["title"], tuple(data["columns"]), rows, data["caption"], chart)


def markdown_table(headings: list[str], rows: list[list[str]]) -> str:
    """Return a table in Markdown."""
    lines = [headings, ["---"] * len(headings), *rows]
    return (
        "\n".join(
            "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines
        )
        + "\n\n"
    )


def verdicts(reports: dict[str, Any]) -> str:
    """Return the claims with their rules, and the results and the verdicts of each report, by evaluation."""
    first = next(iter(reports.values()))
    text = ""
    for section in first["evaluations"]:
        rows = []
        for claim in section["claims"]:
            cells = (cell for report in reports.values() for cell in judged(report, claim))
            number = "*Robustness:* " if claim["number"] is None else f"{claim['number']}. "
            rows.append(
                [f"{number}{claim['text']} *Rule: {claim['rule']}.*", claim["paper"], *cells]
            )
        names = [cell for name in reports for cell in (f"here ({name})", "verdict")]
        text += f"### {section['title']}\n\n" + markdown_table(["claim", "paper", *names], rows)
    return text


def overview(reports: dict[str, Any]) -> str:
    """Return the paper's claims with the verdicts on their parts in each report."""
    rows = []
    for number, paper in PAPER.items():
        verdicts = []
        for report in reports.values():
            found = [
                c["verdict"]
                for s in report["evaluations"]
                for c in s["claims"]
                if c["number"] == number
            ]
            counts = (f"{found.count(verdict)} {verdict}" for verdict in dict.fromkeys(found))
            verdicts.append(", ".join(counts) or "–")
        rows.append([str(number), paper.text, paper.value, *verdicts, paper.elsewhere])
    names = (f"parts of the claim ({name})" for name in reports)
    return markdown_table(["", "the paper says", "its number", *names, "without a recording"], rows)


def judged(report: dict[str, Any], claim: dict[str, Any]) -> tuple[str, str]:
    """Return the result and the verdict on a claim in a report."""
    for other in (c for section in report["evaluations"] for c in section["claims"]):
        if other["text"] == claim["text"]:
            return other["ours"], f"**{other['verdict']}**"
    return "not run", "–"


def run_of(name: str, report: dict[str, Any]) -> str:
    """Return how a report was made, as an item of a list."""
    about, settings = report["about"], report["about"]["settings"]
    cells = sum(section["cells"] for section in report["evaluations"])
    failed = sum(len(section["errors"]) for section in report["evaluations"])
    return (
        f"- **{name}**: {about['date']}, {settings['seeds']} seeds, images of {settings['width']} × "
        f"{settings['height']} px, {settings['duration_s']} s; {cells:,} cells, {failed} of them failed; "
        f"{about['machine']}; amiwarp {about['versions']['amiwarp']}\n"
    )


def sections(report: dict[str, Any], folder: Path) -> Iterator[str]:
    """Yield the text of each evaluation, and draw its charts into a folder."""
    for section in report["evaluations"]:
        yield f"## {section['title']}\n\n{section['protocol']}\n\n"
        yield f"*Different from the paper.* {section['differences']}\n\n"
        for table in map(table_of, section["tables"]):
            figure = draw(table)
            if figure is not None:
                save(figure, folder / f"{table.name}.png")
                yield f"![{table.title}](../{FOLDER}/{table.name}.png)\n\n*{table.title}. {table.caption}*\n\n"
            elif len(table.rows) <= LONGEST:
                yield f"*{table.title}. {table.caption}*\n\n" + markdown_table(*pivoted(table))


def content(reports: dict[str, Any], folder: Path) -> str:
    """Return the text that the page includes, and draw its figures into a folder."""
    if not reports:
        return "No report lies in `benchmarks/results/evaluate`.\n"
    runs = "".join(run_of(name, report) for name, report in reports.items())
    first = next(iter(reports))
    judging = {
        name: report
        for name, report in reports.items()
        if any(s["claims"] for s in report["evaluations"])
    }
    return (
        f"## The claims, and verdicts on them\n\n{overview(judging)}{verdicts(judging) if judging else ''}"
        f"## Reports\n\n{runs}\nFigures and tables below come from the run {first}.\n\n"
        + "".join(sections(reports[first], folder))
    )


def make(app: Sphinx) -> None:
    """Write the text and the figures."""
    source = Path(app.srcdir)
    folder = source / "reference" / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("*.png"):
        old.unlink()
    files = (source.parent / "benchmarks" / "results" / "evaluate").glob("*.json")
    files = sorted(
        files, key=lambda path: -path.stat().st_size
    )  # the one with most recordings first
    reports = {path.stem: json.loads(path.read_text()) for path in files}
    write_page(folder / "content.md", content(reports, folder))


def setup(app: Sphinx) -> dict[str, bool]:
    """Make the content before Sphinx reads its sources."""
    app.connect("builder-inited", make)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
