"""Output of the stability study: rates and aims from cells, files, figures, and the complete command."""

import csv
import json
import math
import os
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import dask
import distributed
import numpy as np
import pytest
from matplotlib.text import Text
from PIL import Image
from typer.testing import CliRunner, Result

from amiwarp import AmiwarpError
from amiwarp.io.finished_work import sealed
from amiwarp.studies.cluster import LOCAL_CONFIGURATION
from amiwarp.studies.stability import (
    Axis,
    Cell,
    Condition,
    Outcome,
    Store,
    Stored,
    axes,
    judging,
    mild_troubles,
    recordings,
)
from amiwarp.studies.stability import Result as Found
from amiwarp.studies.stability import cells as study
from amiwarp.studies.stability.atlas import Atlas, aggregate, load
from amiwarp.studies.stability.cells import identity
from amiwarp.studies.stability.figures import OVERVIEW, _overview, _page, draw
from amiwarp.studies.stability.points import JUDGED, Rate, most_common_message, value_label
from amiwarp.studies.stability.report import markdown, write
from tests.command_line import app

METHOD = {m.name: m for m in judging.METHODS}
NOISE = Axis("background noise", "noise", (0.0, 0.25, 0.5, 0.8), "of all events")
SCENE = Axis("scene", "scene", ("dense texture", "one edge direction", "blank wall"))
AXES = (NOISE, SCENE)


def run(*args: str | Path) -> Result:
    return CliRunner().invoke(app, ["stability", *(str(arg) for arg in args)])


def fails(*args: str | Path) -> str:
    result = run(*args)
    assert result.exit_code == 1, result.output
    assert result.stderr.count("\n") == 1, result.stderr
    return str(result.stderr)


def found(
    outcome: Outcome, error: float | None = 0.02, said: str = "", limit: float = 0.1
) -> Found:
    return Found(outcome, None if outcome is Outcome.REFUSAL else error, limit, 1.5, said)


def good(hard: float) -> Found:
    return (
        found(Outcome.SUCCESS)
        if hard < 0.7
        else found(Outcome.REFUSAL, said=f"simulation: too hard by {hard:.2f}")
    )


def poor(hard: float) -> Found:
    return (
        found(Outcome.SUCCESS, 0.2, limit=0.3) if hard < 0.3 else found(Outcome.SILENT, 3.0 * hard)
    )


def cells(
    make: dict[str, Callable[[float], Found]], *, seeds: int = 8, events: int = 100_000
) -> list[Stored]:
    """All cells of :data:`AXES`. Results depend on the difficulty: the position on the axis, from 0 to 1."""
    hard: dict[Condition, float] = {}
    for axis in AXES:
        for k, condition in enumerate(axis.conditions()):
            hard.setdefault(condition, k / (len(axis.values) - 1))
    return [
        Stored(Cell(c, seed), events, {identity(METHOD[name]): f(h) for name, f in make.items()})
        for c, h in hard.items()
        for seed in range(seeds)
    ]


@pytest.fixture(scope="module")
def atlas() -> Atlas:
    return aggregate(
        cells({"default": good, "paper": poor, "circle": poor}),
        AXES,
        judging.METHODS,
        {"machine": "this one"},
    )


def test_rates_have_wilsons_interval() -> None:
    """Compare with the formula of Wilson, "Probable inference", JASA 1927."""
    k, n, z = 7, 20, 1.959963984540054
    middle = (k / n + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(k / n * (1 - k / n) / n + z * z / (4 * n * n))
    assert Rate(k, n).interval == pytest.approx((middle - half, middle + half), abs=1e-12)
    assert Rate(20, 20).interval[1] == pytest.approx(1.0, abs=1e-12)
    assert str(Rate(0, 0)) == "0 of 0"
    assert Rate(0, 0).to_json()["share"] is None


def test_spots_count_what_the_cells_hold(atlas: Atlas) -> None:
    assert (atlas.cells, atlas.methods) == (6 * 8, ["default", "paper", "circle"])
    spot = atlas.of(NOISE)["default", 0.8]
    assert [spot.rate(o).count for o in JUDGED] == [0, 0, 8, 0]
    assert (spot.errors, spot.quantiles, spot.common_message(Outcome.REFUSAL)) == (
        [],
        {},
        "too hard by 1.00",
    )
    silent = atlas.of(SCENE)["paper", "one edge direction"]
    assert silent.rate(Outcome.SILENT) == Rate(8, 8)
    assert silent.quantiles[50] == pytest.approx(1.5, abs=1e-12)
    assert silent.common_message(Outcome.REFUSAL, Outcome.SILENT) == ""
    assert [s.value for s in atlas.failing(Outcome.REFUSAL)] == [0.8, "blank wall"]


def test_summary_names_the_values_that_work(atlas: Atlas) -> None:
    assert (atlas.works(NOISE, "default"), atlas.works(NOISE, "paper")) == ("0 % to 50 %", "0 %")
    assert atlas.works(SCENE, "default") == "dense texture, one edge direction"
    never = aggregate(
        cells({"default": lambda h: found(Outcome.SILENT, 5.0)}), AXES, judging.METHODS, {}
    )
    assert (never.works(NOISE, "default"), never.works(NOISE, "paper")) == ("nowhere", "nowhere")
    gap = aggregate(
        cells({"default": lambda h: good(0.0 if h in (0.0, 1.0) else 1.0)}),
        AXES,
        judging.METHODS,
        {},
    )
    assert gap.works(NOISE, "default") == "0 %, 80 %"


def test_aims_look_inside_and_outside_of_the_sensible_region(atlas: Atlas) -> None:
    aims = atlas.aims
    # noise up to half and dense texture are in the sensible range; the harmless value is on both axes
    assert (aims.inside, aims.outside) == (Rate(24, 24), Rate(0, 24))
    assert (set(aims.holds.values()), aims.worse) == ({True}, ())
    few = aggregate(
        cells({"default": good, "paper": poor}, events=1000), AXES, judging.METHODS, {}
    ).aims
    assert (few.inside, few.outside) == (Rate(0, 0), Rate(0, 48))
    assert not few.holds["success inside"]
    swapped = aggregate(cells({"default": poor, "paper": good}), AXES, judging.METHODS, {}).aims
    assert (swapped.inside, swapped.outside) == (Rate(8, 24), Rate(24, 24))
    assert set(swapped.holds.values()) == {False}
    assert all("MISSED" in line for line in swapped.lines())


def test_deviations_are_counted_for_combinations_and_the_sensible_range() -> None:
    name = identity(METHOD["default"])
    right = replace(found(Outcome.SUCCESS), deviations={"apex": 0.5, "phase": 2.5})
    wrong = replace(found(Outcome.SUCCESS), deviations={"apex": 1.5})
    drawn = [
        Stored(Cell(mild_troubles.mild(seed), seed), 100_000, {name: wrong if seed else right})
        for seed in range(4)
    ]
    drawn.append(Stored(Cell(mild_troubles.mild(9), 9), 100_000, {name: found(Outcome.REFUSAL)}))
    known = cells({"default": lambda h: right}, seeds=2)
    atlas = aggregate([*drawn, *known], AXES, judging.METHODS, {})
    assert [(d.where, d.quantity, *(r.count for r in d.within), d.within[0].total) for d in atlas.stated] == [
        ("random combinations", "apex", 1, 4, 4, 4), ("random combinations", "phase", 0, 0, 1, 1),
        ("sensible range", "apex", 6, 6, 6, 6), ("sensible range", "phase", 0, 0, 6, 6),
    ]  # fmt: skip
    assert "| random combinations | apex | 25 % (4.56 % to 69.9 %; 1 of 4) | 100 %" in markdown(
        atlas
    )


def test_recordings_that_failed_are_named_and_part_of_no_rate(tmp_path: Path) -> None:
    every = cells({"default": good, "paper": poor})
    default, paper = identity(METHOD["default"]), identity(METHOD["paper"])
    lost = [s for s in every if s.cell.condition == NOISE.conditions()[1] and s.cell.seed < 3]
    gone = [s for s in every if s.cell.condition == SCENE.conditions()[1]]
    for stored in lost:
        stored.results[default] = found(Outcome.FAILED, None, "no such scene (in make, cells.py:1)")
    for stored in gone:
        stored.results = dict.fromkeys(
            (default, paper), found(Outcome.FAILED, None, "its worker died")
        )
    atlas = aggregate(every, AXES, judging.METHODS[:2], {})
    spot = atlas.of(NOISE)["default", 0.25]
    assert (spot.failed, str(spot.rate(Outcome.SUCCESS))) == (3, "100 % (56.6 % to 100 %; 5 of 5)")
    assert (atlas.failed_cells, atlas.cells, atlas.measured) == (11, 48, True)
    assert (atlas.works(SCENE, "default"), atlas.works(SCENE, "paper")) == (
        "dense texture",
        "dense texture",
    )
    hard = [s for s in every if s.cell.condition == SCENE.conditions()[2]]
    partial = aggregate([s for s in every if s not in hard], AXES, judging.METHODS[:2], {})
    assert partial.works(SCENE, "default") == "everywhere measured"
    assert sum(rate.total for rate in (atlas.aims.inside, atlas.aims.outside)) == 48 - 11
    assert all(w.default.total in (5, 8) for w in atlas.aims.worse)
    files = write(atlas, tmp_path)
    with files["table"].open() as file:
        rows = {(r["axis"], r["value"], r["method"]): r for r in csv.DictReader(file)}
    row = rows["scene", "one edge direction", "default"]
    assert (row["n"], row["failed"], row["success"], row["seconds"]) == ("0", "8", "0", "")
    data = json.loads(files["data"].read_text())
    assert [s["failed"] for s in data["spots"]] == [s.failed for s in atlas.spots]
    assert {f["message"] for f in data["failures"]} == {
        "no such scene (in make, cells.py:1)",
        "its worker died",
    }
    text = files["summary"].read_text()
    assert "48 recordings, 11 failed in the study itself" in text
    one = f"| {gone[0].cell.name} | scene one edge direction | default, paper | its worker died |"
    assert one in text
    assert (
        f"| {lost[2].cell.name} | background noise 25 % | default | no such scene (in make, cells.py:1) |"
        in text
    )
    words = [t.get_text() for t in _page(atlas, SCENE).axes[0].texts]
    assert words.count("8 failed") == words.count("–") == 2
    assert "5/5, 3 failed" in [t.get_text() for t in _page(atlas, NOISE).axes[0].texts]
    sheet = _overview(atlas)
    assert sheet.texts[-1].get_text().endswith("; 11 failed")
    assert sheet.legends[0].get_texts()[-1].get_text().endswith("–: failed in the study")


def test_worse_than_the_paper_is_told_by_the_same_recordings() -> None:
    """McNemar's exact test: the probability is 2^-n if all n differing recordings favour the paper's method."""
    swapped = aggregate(cells({"default": poor, "paper": good}), AXES, judging.METHODS, {}).aims
    assert [(w.axis.name, w.value) for w in swapped.worse] == [
        ("background noise", 0.25), ("background noise", 0.5), ("scene", "one edge direction"),
    ]  # fmt: skip
    assert [w.p_value for w in swapped.worse] == pytest.approx([2.0**-8] * 3, abs=1e-12)
    once = cells({"default": good, "paper": good})
    once[0].results[identity(METHOD["default"])] = found(Outcome.SILENT, 5.0)
    (first, second) = aggregate(once, AXES, judging.METHODS, {}).aims.worse
    assert (first.p_value, first.significant, first.default) == (0.5, False, Rate(7, 8))
    assert second.value == "dense texture"


def test_messages_that_differ_in_numbers_are_one() -> None:
    said = [
        "simulation: 1000 events are too few",
        "no edges",
        "simulation: 1,200 events are too few",
        "",
    ]
    assert most_common_message(said) == "1000 events are too few"
    assert most_common_message(["", ""]) == ""


def test_values_read_as_people_write_them() -> None:
    assert value_label(Axis("events", "window_events", (0,)), 0) == "all"
    assert value_label(Axis("events", "window_events", (0,)), 300_000) == "300,000"
    assert value_label(Axis("hot pixels", "hot", (), "of all pixels"), 0.0002) == "0.02 %"
    assert value_label(Axis("direction", "backwards", ()), True) == "wrong"


def test_files_hold_every_spot(atlas: Atlas, tmp_path: Path) -> None:
    files = write(atlas, tmp_path)
    data = json.loads(files["data"].read_text())
    lines = list(csv.DictReader(files["table"].read_text().splitlines()))
    assert len(data["spots"]) == len(lines) == 7 * 3
    assert (data["machine"], data["cells"], data["aims"]["holds"]["success inside"]) == (
        "this one",
        48,
        True,
    )
    spot = next(s for s in data["spots"] if (s["value"], s["method"]) == (0.5, "paper"))
    assert (spot["silent"]["count"], spot["error_px"]["50 %"]) == (8, 2.0)
    line = next(each for each in lines if (each["value"], each["method"]) == ("0.5", "paper"))
    assert (line["silent"], line["error_px_50"], line["n"]) == ("8", "2", "8")
    text = files["summary"].read_text()
    assert "| background noise [of all events] | 0 % to 50 % | 0 % | 0 % |" in text
    assert "| scene | blank wall | 100 % (67.6 % to 100 %; 8 of 8) | too hard by 1.00 |" in text
    assert sorted(p.name for p in tmp_path.iterdir()) == ["atlas.csv", "atlas.json", "summary.md"]


def test_nothing_to_report_is_an_error() -> None:
    with pytest.raises(AmiwarpError, match=r"no results of single runs \(cells\) for these axes"):
        aggregate(cells({"gradient": good}), AXES, judging.METHODS[:2], {})


def test_cells_are_loaded_and_those_of_other_versions_left_out(tmp_path: Path) -> None:
    some = cells({"default": good}, seeds=2)
    for stored in some:
        Store(tmp_path).save(stored)
    path = tmp_path / f"{some[0].cell.name}.json"
    old = json.loads(path.read_text())
    rewrite(tmp_path / "old_0.json", {**old, "condition": {"colour": "red"}})
    rewrite(tmp_path / "older_0.json", {**old, "format": 2})
    rewrite(tmp_path / "renamed_0.json", old)
    store = Store(tmp_path)
    assert {s.cell.name: s.results for s in load(store)} == {s.cell.name: s.results for s in some}
    assert store.damaged == []
    with pytest.raises(AmiwarpError, match=r"no results of single runs \(cells\) of this version"):
        load(Store(tmp_path / "empty"))


def rewrite(path: Path, data: dict[str, Any]) -> None:
    """Write the fields of a cell with the checksum that they need."""
    path.write_text(
        json.dumps(sealed({name: value for name, value in data.items() if name != "checksum"}))
    )


def of_result(**values: Any) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """Return a function that changes values of the only result of a cell."""
    return lambda data: {
        **data,
        "results": {name: {**r, **values} for name, r in data["results"].items()},
    }


WRONG: dict[str, tuple[Callable[[dict[str, Any]], dict[str, Any]], str]] = {
    "huge": (
        of_result(error_px=1e300, outcome="silent failure"),
        r"error_px = 1e\+300 is not a finite number in 0",
    ),
    "negative": (of_result(seconds=-1.0), r"seconds = -1\.0 is not a finite number"),
    "outcome": (
        of_result(outcome="triumph"),
        r"outcome is 'triumph'; choose among success, refusal, named, silent failure, f",
    ),
    "failed": (of_result(outcome="failed"), r"outcome failed does not fit error_px = 0\.02"),
    "contradiction": (of_result(error_px=99.0), r"outcome success does not fit error_px = 99\.0"),
    "field": (of_result(colour="red"), r"colour is unknown; expected outcome, error_px"),
    "missing": (
        lambda data: {**data, "results": {"a": {}}},
        r"field results\.a\.outcome is missing",
    ),
    "events": (lambda data: {**data, "events": -1}, r"field events = -1 is not a whole number"),
    "condition": (
        lambda data: {**data, "condition": {**data["condition"], "width": "320"}},
        r"condition\.width = '320' is not a whole number",
    ),
    "results": (
        lambda data: {**data, "results": [1]},
        r"field results is \[1\]; expected an object",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_cell_of_wrong_values_is_not_used(tmp_path: Path, case: str) -> None:
    (stored,) = (s for s in cells({"default": good}, seeds=1) if s.cell.condition == Condition())
    Store(tmp_path).save(stored)
    path, (change, message) = tmp_path / f"{stored.cell.name}.json", WRONG[case]
    data = json.loads(path.read_text())
    data.pop("checksum")
    rewrite(path, change(data))
    store = Store(tmp_path)
    assert store.load(stored.cell) == Stored(stored.cell)
    (said,) = store.damaged
    assert re.search(message, said), said
    assert said.startswith(f"{path}: is damaged: ")
    assert "\n" not in said


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is not JSON"),
        (b"[" * 100_000, "nests too deeply"),
        (b'{"seed": NaN}', "holds NaN"),
        (b"[]", "holds []; expected an object"),
        (b"{}", "field checksum is missing"),
        (b" " * (9 << 20), "is larger than 8 MiB"),
        (None, "is a named pipe"),
    ],
)
def test_a_damaged_cell_is_made_again(tmp_path: Path, content: bytes | None, message: str) -> None:
    (stored,) = (s for s in cells({"default": good}, seeds=1) if s.cell.condition == Condition())
    store, path = Store(tmp_path), tmp_path / f"{stored.cell.name}.json"
    if content is None:
        os.mkfifo(path)
    else:
        path.write_bytes(content)
    assert store.load_all() == []
    assert message in store.damaged[0]
    store.save(stored)
    whole = path.read_bytes()
    assert store.load_all() == [stored]
    path.write_bytes(whole.replace(b'"seconds":', b'"seconds":1', 1))
    assert store.load_all() == []
    assert store.damaged[1].endswith("not of this content")
    path.unlink()
    path.mkdir()
    with pytest.raises(
        AmiwarpError, match="is a folder, where the file of a cell belongs; remove it"
    ):
        store.load(stored.cell)


def test_pages_show_every_share_and_nothing_overlaps(atlas: Atlas, tmp_path: Path) -> None:
    for figure, methods in ((_page(atlas, SCENE), atlas.methods), (_overview(atlas), OVERVIEW[:2])):
        figure.draw_without_rendering()
        heat = figure.axes[0]
        assert [t.get_text() for t in heat.get_yticklabels()] == [*methods]
        boxes = [t.get_window_extent() for ax in figure.axes for t in _texts(ax)]
        crossed = [
            (a, b) for k, a in enumerate(boxes) for b in boxes[:k] if a.shrunk(0.9, 0.9).overlaps(b)
        ]
        assert crossed == []
    shares = [t.get_text() for t in _page(atlas, SCENE).axes[0].texts]
    assert [shares.count(s) for s in ("100 %", "0 %", "8/8, 1.5 s", "0/8, 1.5 s")] == [4, 5, 4, 5]


def _texts(ax: Any) -> list[Text]:
    return [
        t
        for t in (*ax.texts, *ax.get_xticklabels(), *ax.get_yticklabels())
        if t.get_text() and t.get_visible()
    ]


def test_figures_are_written_with_a_page_for_each_axis(atlas: Atlas, tmp_path: Path) -> None:
    files = draw(atlas, tmp_path)
    assert set(files) == {"overview", "pages", "background noise", "scene"}
    assert files["pages"].read_bytes().count(b"/Type /Page ") == 3
    page = np.asarray(Image.open(files["scene"]).convert("RGB")).reshape(-1, 3)
    for colour in ((0x56, 0xB4, 0xE9), (0xD0, 0xD0, 0xD0), (0xE6, 0x70, 0x2E)):
        near = np.abs(page.astype(np.int16) - colour).max(axis=1) <= 8
        assert near.mean() > 0.02
    assert {p.suffix for p in tmp_path.iterdir()} == {".png", ".pdf"}


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> Axis:
    """Give the command a single axis with two small cameras."""
    axis = Axis("width", "width", (48, 64), "px", (("height", 48), ("turns", 1.0)))
    monkeypatch.setattr(axes, "AXES", (axis,))
    monkeypatch.setattr(axes, "quick_axes", lambda: (replace(axis, values=(48,)),))
    return axis


@pytest.mark.filterwarnings("ignore::DeprecationWarning:distributed.*")
def test_command_runs_goes_on_and_redraws(tiny: Axis, tmp_path: Path) -> None:
    words = (
        "--out",
        tmp_path,
        "--methods",
        "sharpness",
        "--seeds",
        "1",
        "--draws",
        "0",
        "--device",
        "cpu",
        "--json",
    )
    with (
        dask.config.set(LOCAL_CONFIGURATION),
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, dashboard_address="127.0.0.1:0"
        ) as cluster,
    ):
        first = run("--quick", "--scheduler", cluster.scheduler_address, *words)
        assert first.exit_code == 0, first.output
        second = run("--scheduler", cluster.scheduler_address, *words)
        assert second.exit_code == 0, second.output
    one, two = json.loads(first.stdout), json.loads(second.stdout)
    assert [(d["new_cells"], d["cells"], d["cells_left"]) for d in (one, two)] == [
        (1, 1, 0),
        (1, 2, 0),
    ]
    assert len(list((tmp_path / "cells").iterdir())) == 2
    assert {s["method"] for s in json.loads((tmp_path / "atlas.json").read_text())["spots"]} == {
        "default", "paper", "sharpness",
    }  # fmt: skip
    before = (tmp_path / "atlas.csv").read_text()
    (tmp_path / "atlas.csv").unlink()
    third = run("--redraw", "--out", tmp_path, "--device", "cpu")
    assert third.exit_code == 0, third.output
    assert "2 cells in all" in third.stdout
    assert (tmp_path / "atlas.csv").read_text() == before


def test_a_cell_that_fails_does_not_end_the_command(
    tiny: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = (
        "--out",
        tmp_path,
        "--methods",
        "sharpness",
        "--seeds",
        "1",
        "--draws",
        "0",
        "--device",
        "cpu",
    )
    monkeypatch.setattr("amiwarp.studies.stability.commands.cpu_threads", lambda: 1)
    make, judge = recordings.make, judging.judge

    def planted(condition: Condition, *args: Any) -> recordings.SimulatedSample:
        if condition.width == 48:
            raise np.linalg.LinAlgError("Singular matrix")
        return make(condition, *args)

    def also(cell: Cell, method: judging.Method, *args: Any) -> Found:
        if method.name == "sharpness":
            raise MemoryError
        return judge(cell, method, *args)

    monkeypatch.setattr(study, "make", planted)
    monkeypatch.setattr(study, "judge", also)
    first = run(*words)
    assert first.exit_code == 0, first.output
    every = "failed: width 48, seed 0, default, paper, sharpness: LinAlgError: Singular matrix (in run_cell, studies/"
    assert every in first.stdout
    assert "failed: width 64, seed 0, sharpness: MemoryError" in first.stdout
    assert first.stdout.endswith("cells; 2 failed: run the same command again to try them again\n")
    assert (
        "| width 48 | default, paper, sharpness | LinAlgError"
        in (tmp_path / "summary.md").read_text()
    )
    with (tmp_path / "atlas.csv").open() as file:
        counts = {(r["value"], r["method"]): (r["n"], r["failed"]) for r in csv.DictReader(file)}
    assert counts == {(v, m): ("1", "0") if (v, m) in (("64", "default"), ("64", "paper")) else ("0", "1")
                      for v in ("48", "64") for m in ("default", "paper", "sharpness")}  # fmt: skip
    redrawn = run("--redraw", "--out", tmp_path, "--device", "cpu")
    assert redrawn.exit_code == 0, redrawn.output
    assert every in redrawn.stdout

    monkeypatch.undo()
    monkeypatch.setattr(axes, "AXES", (tiny,))
    monkeypatch.setattr("amiwarp.studies.stability.commands.cpu_threads", lambda: 1)
    again = run(*words, "--json")
    assert again.exit_code == 0, again.output
    data = json.loads(again.stdout)
    assert (data["new_cells"], data["cells_failed"], data["failed"]) == (2, 0, [])


def test_a_study_in_which_all_fails_writes_its_report_and_exits_with_1(
    tiny: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def planted(*args: Any) -> recordings.SimulatedSample:
        raise AmiwarpError("no recording today")

    monkeypatch.setattr("amiwarp.studies.stability.commands.cpu_threads", lambda: 1)
    monkeypatch.setattr(study, "make", planted)
    done = run(
        "--out",
        tmp_path,
        "--methods",
        "sharpness",
        "--seeds",
        "1",
        "--draws",
        "0",
        "--device",
        "cpu",
    )
    assert done.exit_code == 1, done.output
    assert "2 failed: run the same command again" in done.stdout
    assert done.stdout.count("no recording today (in ") == 2
    assert "not measured" in (tmp_path / "summary.md").read_text()
    assert (tmp_path / "overview.png").stat().st_size > 1000


def test_command_says_what_is_wrong(tiny: Axis, tmp_path: Path) -> None:
    words = ("--out", tmp_path, "--device", "cpu")
    assert "unknown axis 'colour'; choose among width" in fails("--axes", "colour", *words)
    assert "unknown method 'magic'; choose among default, paper" in fails(
        "--methods", "magic", *words
    )
    assert "no results of single runs (cells) of this version" in fails("--redraw", *words)
    (tmp_path / "file").write_text("")
    assert "cannot be made a folder" in fails(
        "--out", tmp_path / "file" / "deeper", "--device", "cpu"
    )


def test_command_names_the_extra_that_is_missing(
    tiny: Axis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    # A single worker needs no cluster
    monkeypatch.setattr("amiwarp.studies.stability.commands.cpu_threads", lambda: 2)
    assert "pip install 'amiwarp[cluster]'" in fails(
        "--quick", "--out", tmp_path, "--device", "cpu"
    )
