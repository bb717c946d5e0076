"""The paper for JOSS, the citation and Zenodo's metadata agree with the results and with each other."""

import json
import re
from typing import Any

import pytest
import yaml

import amiwarp
from paper.build import gathered
from tests import ROOT
from tests.report_texts import cited, listed, typed_numbers

PAPER = ROOT / "paper"
JOSS = (PAPER / "joss" / "paper.md").read_text(encoding="utf-8")

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


def test_what_the_joss_paper_cites_is_listed_as_in_the_report() -> None:
    assert cited(JOSS) == listed(PAPER / "joss" / "paper.bib")
    entries = (PAPER / "joss" / "paper.bib").read_text(encoding="utf-8").strip().split("\n\n")
    report = (PAPER / "references.bib").read_text(encoding="utf-8")
    assert all(entry in report for entry in entries)


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
