"""The technical report: its numbers come from the results, and what it names exists."""

import json
import re
import statistics
from pathlib import Path

import pytest

from paper.build import SUBJECTS, build, gathered
from paper.sources import claims, fixed, one, page, percents, results, significant, table_after
from paper.subjects import optics, whole_turn
from paper.subjects.calibration import apex_coverage
from paper.subjects.claims import draw_claims, short
from paper.subjects.trust import unsaid_share
from paper.subjects.whole_turn import outcome, plate_errors
from tests import ROOT
from tests.report_texts import cited, listed, typed_numbers

PAPER = ROOT / "paper"
TEXTS = [PAPER / "report.typ", *sorted((PAPER / "sections").glob("*.typ"))]


def written() -> str:
    """Return the whole text of the report."""
    return "\n".join(path.read_text(encoding="utf-8") for path in TEXTS)


def test_no_number_of_the_report_is_typed_by_hand() -> None:
    found = {path.name: list(typed_numbers(path.read_text(encoding="utf-8"))) for path in TEXTS}
    assert {name: numbers for name, numbers in found.items() if numbers} == {}


@pytest.mark.parametrize(
    ("text", "numbers"),
    [
        ("The error is 0.02 px.", ["0.02"]),
        ("It takes 3 ms at 60°.", ["3", "60"]),
        ("about 1,500 recordings", ["1,500"]),
        ("$x = 0.3 y$", ["0.3"]),
        ("an image of 640 × 480", ["640", "480"]),
        ('#chart("a", [Up to 7 px.], width: 50%) <a2>', ["7"]),
        ("in 2024 on an H200 with E2VID, see @he2024", []),
        ('#value("turn.drawn2") px, $n^2 - 1$ // 5 px', []),
        ('#results-table("two", [Errors.], columns: (1fr, 2fr), size: 7.5pt) <two>', []),
    ],
)
def test_a_typed_number_is_seen(text: str, numbers: list[str]) -> None:
    assert list(typed_numbers(text)) == numbers


def test_the_text_uses_every_value_table_and_figure_and_no_other() -> None:
    data = gathered()
    names = {name for subject in SUBJECTS for name in subject.figures()}
    assert set(re.findall(r'value\("([^"]+)"\)', written())) == set(data["values"])
    assert set(re.findall(r'results-table\("([^"]+)"', written())) == set(data["tables"])
    assert set(re.findall(r'chart\("([^"]+)"', written())) == names | {"sketch"}
    assert all(text and "nan" not in text for text in data["values"].values())


def test_no_semicolon_is_swallowed() -> None:
    """Typst takes a semicolon after a call for the call's end."""
    assert re.findall(r'value\("[^"]+"\);', written()) == []


def test_what_the_report_cites_is_listed() -> None:
    assert cited(written()) == listed(PAPER / "references.bib")


PAGES = (
    ("calibration.both_median", "benchmarks/results/calibration_photometric.md", "the median over all is {} px"),
    ("turn.drawn_coverage", "docs/reference/measurements.md", "within 1, 2, 3 deviations | {} |"),
    ("turn.drawn_total", "docs/reference/measurements.md", "truth within the total | {} |"),
    ("turn.drawn_median", "docs/reference/measurements.md", "median stated deviation | {};"),
    ("turn.atlas_recordings", "docs/explanation/stability.md", "{} recordings at 320×240"),
    ("phase.cuda_detail_ms", "docs/explanation/phase.md", "events to the detail | {} |"),
    ("phase.cuda_window_ms", "docs/explanation/phase.md", "copy of the picture | {} |"),
    ("claims.ssim_hand", "benchmarks/results/paper_results.md", "SSIM of {}, without a prism 0.44"),
    ("two.exact_2_timing", "benchmarks/results/paper_results.md", "2° has {} px"),
    ("two.clock_ms", "benchmarks/results/paper_results.md", "if the clocks agree within {} ms"),
    ("optics.circle_60", "benchmarks/results/optics.md", "| {}/3.65 |"),
    ("speed.cuda_file_mev", "docs/explanation/performance.md", "a file at {} million events a second"),
    ("speed.cpu_fastest", "docs/explanation/performance.md", "479 to {} million"),
    ("speed.cpu_stream_mev", "docs/explanation/performance.md", "up with {} million events a second, with the exact"),
    ("speed.cuda_calibration_s", "benchmarks/results/speed.md", "| ≤ 0.08 s | {}4 |"),
    ("claims.even_still", "benchmarks/results/paper_results.md", "has 0.10, the AMI-EV {}."),
    ("claims.ssim_fast_frames", "benchmarks/results/paper_results.md", "blurs it: SSIM {} (AMI-EV 0.81)"),
    ("claims.j_ideal", "benchmarks/results/paper_results.md", "{} px; 1 minimum"),
    ("claims.j_noise", "benchmarks/results/paper_results.md", "| J, large η | DVXplorer | {} |"),
    ("two.circle_90_largest", "benchmarks/results/paper_results.md", "in the rms, and {} px at the corner"),
    ("phase.lamp_whole", "docs/explanation/phase.md", "the whole picture correlates by {},"),
    ("phase.cuda_picture_ms", "docs/explanation/phase.md", "events to the whole picture | {} |"),
    ("calibration.gradient", "docs/explanation/calibration.md", "| `gradient` | {} / 0.023 |"),
    ("calibration.variance", "docs/explanation/calibration.md", "**{} / 0.124**"),
    ("trust.mutants_noticed", "docs/explanation/reliability.md", "the tests noticed {} of those"),
)  # fmt: skip
"""Value of the report, page of the documentation, and how that page says the same."""


@pytest.mark.parametrize(("key", "path", "sentence"), PAGES)
def test_the_report_agrees_with_the_pages(key: str, path: str, sentence: str) -> None:
    text = " ".join((ROOT / path).read_text(encoding="utf-8").split())
    assert sentence.format(gathered()["values"][key]) in text


def test_numbers_are_written_as_said() -> None:
    assert [significant(value) for value in (0.06039, 0.3157, 1.96, 3028.7, 0.0997)] == [
        "0.060", "0.32", "2.0", "3,000", "0.10",
    ]  # fmt: skip
    assert significant(0.00034, 1) == "0.0003"
    assert fixed(-1234.5678, 1) == "−1,234.6"
    assert percents([0.754, 0.8113, 1.0]) == "75, 81, 100 %"


def test_a_row_must_be_the_only_one() -> None:
    rows = [{"a": 1, "b": 2}, {"a": 1, "b": 3}]
    assert one(rows, a=1, b=3) is rows[1]
    with pytest.raises(ValueError, match="2 rows"):
        one(rows, a=1)


def test_a_table_is_read_after_its_text() -> None:
    rows = table_after("speed.md", "### NVIDIA H200")
    assert list(rows[0]) == ["task", "target", "measured", "met"]
    assert [row["met"] for row in rows[:2]] == ["no", "no"]


def test_a_claim_is_shortened_without_losing_what_is_compared() -> None:
    assert short("A larger apex (720 rpm) gives more events.") == "A larger apex gives more events"
    assert short("No worse (x, per event, y).") == "No worse, per event"
    assert short("Steadier (a (b) c).") == "Steadier"
    texts = [(claim["number"], short(claim["text"])) for claim in claims("gpu")]
    numbered = [text for text in texts if text[0] is not None]
    assert len(set(numbered)) == len(numbered)


def test_outcomes_are_the_ones_that_the_files_count() -> None:
    for name in ("true_optics_drawn8000_cuda.json", "true_optics_fresh9000_cuda.json"):
        data = results(name)
        found = [outcome(row) for row in data["rows"]]
        assert found.count("silent") == data["summary"]["silent"]
        assert found.count("answered") == data["summary"]["within_0.02_px"]
        assert len(found) - found.count("refused") == data["summary"]["answered"]


def test_least_is_at_most_the_most() -> None:
    values = gathered()["values"]
    pairs = [(key, key.replace("_least", "_most")) for key in values if key.endswith("_least")]
    pairs += [(key, key.replace("_slowest", "_fastest")) for key in values if "_slowest" in key]
    assert len(pairs) == 6
    for low, high in pairs:
        assert float(values[low].replace(",", "")) < float(values[high].replace(",", ""))


def lines_of(path: str) -> list[str]:
    """Return the lines of a page, tables without markup of bold."""
    return (ROOT / path).read_text(encoding="utf-8").replace("**", "").splitlines()


def test_tables_are_the_ones_of_the_pages() -> None:
    tables = gathered()["tables"]
    stability = lines_of("docs/explanation/stability.md")
    for row in tables["atlas"]["rows"]:
        assert f"| {' | '.join(row)} |" in stability
    claims_page = lines_of("benchmarks/results/paper_results.md")
    for row, name in (
        (0, "circle"),
        (1, "circle, timing error of 1 ms"),
        (3, "exact refraction, timing error of 1 ms"),
    ):
        assert f"| {name} | {' | '.join(tables['two']['rows'][row][1:])} |" in claims_page
    measurements = " ".join(lines_of("docs/reference/measurements.md"))
    answered, within = (tables["sets"]["rows"][place][1:] for place in (1, 2))
    expected = f"| {answered[0]}; {within[0]} | {answered[1]}; {within[1]} |"
    assert f"answered; within 0.02 px {expected}" in measurements


def test_a_line_of_the_table_of_phase_holds_medians_of_its_recordings() -> None:
    rows = [row for row in results("phase_cpu.json")["rows"] if row["axis"] == "table"]
    some = [row for row in rows if (row["apex_deg"], row["noise"]) == (1.0, 0.2)]

    def median(method: str, field: str) -> float:
        return statistics.median(row[method][field] for row in some)

    line = next(
        line for line in gathered()["tables"]["phase"]["rows"] if line[:2] == ["1°", "20 %"]
    )
    assert line[2:4] == [f"{median(method, 'detail'):.3f}" for method in ("phase", "solver")]
    assert line[4:6] == [f"{median(method, 'whole'):.3f}" for method in ("phase", "solver")]
    assert line[6:] == [
        f"{1e3 * median(method, 'processor_s'):.0f}" for method in ("phase", "solver")
    ]


def test_figures_show_what_their_axes_say() -> None:
    rows = [*whole_turn.answered(whole_turn.DRAWN), *whole_turn.answered(whole_turn.FURTHER)]
    for panel, field in zip(whole_turn.draw_errors().axes, ("stated_px", "total_px"), strict=True):
        silent = panel.lines[2]
        expected = [row for row in rows if outcome(row) == "silent"]
        assert list(silent.get_xdata()) == [row[field] for row in expected]
        assert list(silent.get_ydata()) == [row["error_px"] for row in expected]
    ladder = optics.draw_rungs().axes[1].lines
    values = gathered()["values"]
    assert f"{ladder[1].get_ydata()[1]:.2f}" == values["optics.circle_60"]
    assert f"{ladder[3].get_ydata()[1]:.3f}" == values["optics.ellipse_60"]
    pictures = draw_claims().axes[0].containers
    assert [f"{bar.get_height():.2f}" for bar in pictures[1]] == [
        values[f"claims.ssim_{camera}"] for camera in ("still", "hand", "fast")
    ]


def test_coverage_of_the_apex_is_the_page_s() -> None:
    text = page("calibration_photometric.md")
    counts = re.findall(r"(\d+) / (\d+) / (\d+) of 27", text)
    assert len(counts) == 3
    totals = [sum(int(count[place]) for count in counts) for place in range(3)]
    assert apex_coverage() == [total / 81 for total in totals]


def test_the_bounds_cover_the_plates_as_the_text_says() -> None:
    rows = results("true_optics_drawn8000_cuda.json")["rows"]
    over = [row for row in rows if row["optic"] == "plate" and (row["error_px"] or 0.0) > 0.02]
    assert len(over) == len(plate_errors())
    assert all(row["error_px"] < row["total_px"] for row in over)
    assert {row["trouble"] for row in over} == {"another thickness", "faces not parallel"}


def test_damaged_files_are_counted_whole() -> None:
    total = results("fuzz_events.json")["events"]["total"]
    unsaid = sum(count for name, count in total.items() if name.startswith("silent"))
    assert sum(total.values()) == 48_000
    assert unsaid_share() == unsaid / 48_000


def test_the_report_is_built(tmp_path: Path) -> None:
    typst = pytest.importorskip("typst", reason="needs Typst: pip install '.[paper]'")
    path = build(tmp_path)
    assert path.read_bytes().startswith(b"%PDF")
    source = tmp_path / "report.typ"
    last = typst.query(source, "<last-page>", field="value", one=True, root=tmp_path)
    assert 8 <= json.loads(last) <= 12
