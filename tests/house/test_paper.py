"""Technical report, paper for JOSS and citation: numbers come from the results, and what is named exists."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

import amiwarp
from paper.build import SUBJECTS, build, gathered
from paper.sources import claims, fixed, one, percents, results, significant, table_after
from paper.subjects.claims import short
from paper.subjects.whole_turn import outcome
from tests import ROOT

PAPER = ROOT / "paper"
TEXTS = [PAPER / "report.typ", *sorted((PAPER / "sections").glob("*.typ"))]
JOSS = (PAPER / "joss" / "paper.md").read_text(encoding="utf-8")
YEAR = re.compile(r"(19|20)\d\d")
NAME = re.compile(r"[A-Za-z][\w*-]*")
"""A word that begins with a letter, such as H200 or E2VID, is a name."""


def stripped(text: str) -> str:
    """Return a text of the report without comments, imports, references, labels and values of results."""
    text = re.sub(r"//.*", "", text)
    text = re.sub(r"^#(import|include|bibliography).*", "", text, flags=re.M)
    text = re.sub(r"#value\(\"[^\"]*\"\)", " ", text)
    text = re.sub(r"#(chart|results-table)\(\"[^\"]*\"", " ", text)
    text = re.sub(r"\b(width|trim|size|columns|align): (\([^)]*\)|\S+)", " ", text)
    return re.sub(r"[@<][a-z][\w-]*>?", " ", text)


def typed_numbers(text: str) -> Iterator[str]:
    """Yield the numbers of a text that are typed by hand; in formulas only numbers with decimals count."""
    text = stripped(text)
    for formula in re.findall(r"\$[^$]*\$", text):
        yield from re.findall(r"\d+\.\d+", formula)
    for word in re.findall(r"[\w*.,-]*\d[\w*.,-]*", re.sub(r"\$[^$]*\$", " ", text)):
        bare = word.strip(".,-*")
        if not YEAR.fullmatch(bare) and not NAME.fullmatch(bare):
            yield bare


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


def test_what_the_report_and_the_joss_paper_cite_is_listed() -> None:
    for text, folder in (
        (written(), PAPER / "references.bib"),
        (JOSS, PAPER / "joss" / "paper.bib"),
    ):
        listed = re.findall(r"^@\w+\{(\w+),", folder.read_text(encoding="utf-8"), flags=re.M)
        cited = set(re.findall(r"@([a-z]+\d{4}[a-z]?)\b", text))
        assert cited == set(listed)
        assert len(listed) == len(set(listed))  # fmt: skip


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
    ("trust.mutants_noticed", "docs/explanation/reliability.md", "the tests noticed {} of those"),
)  # fmt: skip
"""Value of the report, page of the documentation, and how that page says the same."""


@pytest.mark.parametrize(("key", "page", "sentence"), PAGES)
def test_the_report_agrees_with_the_pages(key: str, page: str, sentence: str) -> None:
    text = " ".join((ROOT / page).read_text(encoding="utf-8").split())
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


def test_the_report_is_built(tmp_path: Path) -> None:
    typst = pytest.importorskip("typst", reason="needs Typst: pip install '.[paper]'")
    path = build(tmp_path)
    assert path.read_bytes().startswith(b"%PDF")
    source = tmp_path / "report.typ"
    last = typst.query(source, "<last-page>", field="value", one=True, root=tmp_path)
    assert 8 <= json.loads(last) <= 12


SAID = (
    ("the best circle is {} px off", "optics.circle_60"),
    ("a view of {}", "conditions.fov"),
    ("On {} recordings of its own simulator", "calibration.recordings"),
    ("error of the calibration is {} px", "calibration.both_median"),
    ("On {} recordings of an independent simulator", "turn.drawn"),
    ("{} were answered", "turn.drawn_answered"),
    ("a median error of {} px, and", "turn.drawn_median"),
    ("{} were wrong without a warning", "turn.drawn_silent"),
    ("is calibrated in {} s", "speed.cuda_calibration_s"),
    ("two CPU cores in {} s", "speed.cpu_calibration_s"),
    ("of {} parts of claims", "claims.parts"),
    ("{} are reproduced", "claims.reproduced"),
    ("{} are undecided", "claims.undecided"),
    ("and {} cannot be tested", "claims.not_testable"),
    ("agree within {} ms", "two.clock_ms"),
)
"""What the paper for JOSS says, and the value of the report in it."""


def joss_body() -> str:
    """Return the text of the paper for JOSS, in one line."""
    return " ".join(JOSS.split("---", 2)[2].split())


@pytest.mark.parametrize(("sentence", "key"), SAID)
def test_the_joss_paper_says_what_was_measured(sentence: str, key: str) -> None:
    assert sentence.format(gathered()["values"][key]) in joss_body()


def test_the_joss_paper_has_no_other_numbers() -> None:
    values = gathered()["values"]
    body = joss_body()
    for sentence, key in SAID:
        body = body.replace(sentence.format(values[key]), " ")
    assert list(typed_numbers(body)) == []


def test_the_joss_paper_keeps_the_rules() -> None:
    head = yaml.safe_load(JOSS.split("---", 2)[1])
    assert head["bibliography"] == "paper.bib"
    assert head["title"].startswith("amiwarp: ")
    assert head["authors"][0]["name"] == "The amiwarp developers"
    assert 250 <= len(joss_body().split()) <= 1000
    sections = re.findall(r"^# (.*)", JOSS, flags=re.M)
    for section in ("Summary", "Statement of need", "State of the field", "References"):
        assert section in sections


def citation() -> dict[str, Any]:
    """Return the content of the citation file."""
    content: dict[str, Any] = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    return content


def test_zenodo_and_the_citation_agree() -> None:
    zenodo = json.loads((ROOT / ".zenodo.json").read_text(encoding="utf-8"))
    cited = citation()
    assert zenodo["version"] == cited["version"] == amiwarp.__version__
    assert zenodo["title"] == cited["title"]
    assert zenodo["license"] == cited["license"]
    assert [one["name"] for one in zenodo["creators"]] == [one["name"] for one in cited["authors"]]
    assert set(cited["keywords"]) == set(zenodo["keywords"])
    assert zenodo["related_identifiers"][0]["identifier"] == cited["references"][0]["doi"]


def test_the_report_has_the_title_that_is_cited() -> None:
    title = citation()["references"][1]["title"]
    assert f'title: "{title}"' in (PAPER / "report.typ").read_text(encoding="utf-8")
    assert f"*[{title}]" in (PAPER / "resources-entry.md").read_text(encoding="utf-8")
