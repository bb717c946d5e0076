"""The benchmark runner on small scenes: right results pass, wrong ones are named, and the page shows the files."""

import ast
import dataclasses
import gc
import importlib.util
import json
import math
import os
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from amiwarp import (
    Camera,
    CircleModel,
    Encoder,
    Events,
    Prism,
    Vote,
    compensate_events,
)
from amiwarp.compensation.gpu_pieces import PIECE
from benchmarks import __main__ as runner
from benchmarks import (
    cases,
    compensate,
    copies,
    dataset,
    mutants_plugin,
    ours,
    planted,
    report,
    scenes,
    truth,
    walks,
)
from benchmarks.copies import files_of_tests
from benchmarks.job import Job
from benchmarks.libraries import Missing
from benchmarks.scenes import SECONDS, TURNS_PER_S, EventScene, RecordingScene, event_scene

EVENTS = 4_000
RECORDED = 60_000
LESS_SURE = {"model_px": 0.2, "decorrelation": 0.05}
"""Error limits for a recording of few events."""


@pytest.fixture(scope="module")
def scene() -> EventScene:
    return event_scene("small", EVENTS, points=50, width=160, height=120)


@pytest.fixture(scope="module")
def recorded(texture: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> RecordingScene:
    picture = tmp_path_factory.mktemp("picture") / "texture.png"
    Image.fromarray(texture).save(picture)
    return scenes.recording_scene(RECORDED, "cpu", picture)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, scene: EventScene) -> None:
    """Replace every scene by the small one."""
    kind = cases.SceneKind(lambda n, device, picture: scene, {"cpu": 1, "cuda": 1})
    monkeypatch.setattr(runner, "SCENES", dict.fromkeys(cases.EVENT_SCENES, kind))
    monkeypatch.setattr(runner, "REST_S", 0.0)


def test_events_are_in_order_and_on_their_orbits(scene: EventScene) -> None:
    e = scene.events
    assert (np.diff(e.t) >= 0).all()
    assert 0.99 * SECONDS < (e.t[-1] - e.t[0]) * 1e-6 <= SECONDS
    np.testing.assert_allclose(scene.theta, e.t * (2e-6 * math.pi * TURNS_PER_S), atol=1e-9)
    image = truth.images(scene, "plane circle")[Vote.NEAREST]
    assert image.sum() == EVENTS  # no event leaves the image
    assert np.count_nonzero(image) < 9 * 50  # each edge point is spread only by rounding to pixels


@pytest.mark.parametrize("model", ["circle", "radial", "ellipse", "exact", "plane circle"])
def test_models_agree_on_where_events_belong(scene: EventScene, model: str) -> None:
    """The true positions of every model are close to the exact ones, those of the other libraries' formula too."""
    xy, theta = scene.sample()
    away = truth.places(scene, model, xy, theta) - truth.places(scene, "exact", xy, theta)
    assert np.sqrt(np.mean(np.sum(away**2, axis=1))) <= cases.EXACT_PX[model]


OF_EVENTS = [
    pytest.param(case, {"cpu": "cpu", "cuda": "cuda:0"}[device], id=f"{case.name}-{device}")
    for case in cases.CASES if case.scenes[0] in cases.EVENT_SCENES for device in case.devices
]  # fmt: skip


@pytest.mark.parametrize(("case", "device"), OF_EVENTS, indirect=["device"])
def test_answers_are_right(scene: EventScene, case: cases.Case, device: str) -> None:
    try:
        job = case.make(scene, device, case.model, case.vote)
    except Missing as missing:  # check that it is not installed
        library, _, said = str(missing).partition(" ")
        assert said == "is not installed"
        assert importlib.util.find_spec(library) is None
        return
    for _ in range(2):  # a pass starts with an empty image
        job.run()
    assert runner.wrong(case, job.errors()) == []
    assert job.work == EVENTS * (ours.CANDIDATES if case.what == cases.PREPARED else 1)


@pytest.mark.parametrize(
    "case", [c for c in cases.CASES if cases.RECORDING in c.scenes], ids=lambda c: c.name
)
def test_whole_jobs_find_what_the_recording_was_made_with(
    recorded: RecordingScene, case: cases.Case, device: str
) -> None:
    job = case.make(recorded, device, case.model, case.vote)
    job.run()
    errors = job.errors()
    assert errors.keys() == case.bars.keys()
    assert (
        runner.wrong(
            dataclasses.replace(case, bars={name: LESS_SURE[name] for name in case.bars}), errors
        )
        == []
    )
    if case.what == cases.BOTH:
        sharpness = next(c for c in cases.CASES if c.what == cases.SHARPNESS)
        first = sharpness.make(recorded, device, sharpness.model, sharpness.vote)
        first.run()
        assert errors["model_px"] < 0.5 * first.errors()["model_px"]
        assert abs(job.also()["apex_error_deg"]) < 0.05
    if case.what == cases.PICTURE:
        assert job.also()["psnr_db"] > 20.0


def test_recordings_are_as_long_as_was_asked(recorded: RecordingScene) -> None:
    assert len(recorded) == pytest.approx(RECORDED, rel=0.15)
    camera = recorded.made.camera
    density = len(recorded) / (camera.width * camera.height * recorded.made.duration_s)
    assert density == pytest.approx(scenes.RECORDED / (640 * 480 * SECONDS), rel=0.15)
    assert recorded.recording.prism is not None
    assert recorded.recording.prism.apex == pytest.approx(1.2 * recorded.model.prism.apex)


@pytest.fixture
def strewn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use random events instead of half a second of simulation."""
    rng, n = np.random.default_rng(0), 100_000
    x, y = rng.integers(0, [640, 480], (n, 2)).astype(np.uint16).T
    times = np.sort(rng.integers(0, compensate.REPEATED_US, n))
    events = Events(x, y, times, rng.integers(0, 2, n).astype(np.uint8))
    monkeypatch.setattr(compensate, "half_a_second", lambda: events)


def run_files(tmp_path: Path, events: int) -> list[dict[str, Any]]:
    out = tmp_path / "speed.json"
    words = [
        "--scenes",
        cases.FILE,
        "--only",
        "exact",
        "--events",
        str(events),
        "--repeats",
        "2",
        "--out",
        str(out),
    ]
    assert runner.main(words) == 0
    rows: list[dict[str, Any]] = json.loads(out.read_text())["rows"]
    return rows


def test_files_are_compensated_in_a_process_of_their_own(strewn: None, tmp_path: Path) -> None:
    (row,) = run_files(tmp_path, PIECE)
    assert row["errors"]["places_px"] <= compensate.BAR_PX
    assert 50.0 < row["also"]["peak_mib"] < 1024.0
    assert (row["events"], len(row["seconds"]), row["note"]) == (PIECE, 2, "")
    assert "| peak memory [MiB] |" in "\n".join(report.measured([row]))


def test_files_are_bare_columns_where_filters_are_missing(
    strewn: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.setattr(scenes, "FILTERS", ("numpy", "nofilter"))
    (row,) = run_files(tmp_path, 10_000)
    assert row["errors"]["places_px"] <= compensate.BAR_PX
    assert row["note"] == "bare columns, without nofilter"
    assert "(bare columns, without nofilter)" in capsys.readouterr().out
    aim = next(a for a in cases.AIMS if (a.device, a.unit) == ("cpu", "MiB"))
    found = report.aim_cells(aim, {"device": "cpu", "rows": [row]})
    assert found[2].endswith(" (bare columns, without nofilter)")
    assert found[3] == "yes"


def test_files_go_when_the_scene_does(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compensate, "make", lambda path, n, columns: path.mkdir())
    made = scenes.file_scene(10)
    folder = made.source.parent
    assert made.source.is_dir()
    del made
    assert not folder.exists()


def test_without_a_picture_rows_are_skipped(monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.setitem(sys.modules, "pyvista", None)
    monkeypatch.setitem(sys.modules, "pyvista.examples", None)
    assert runner.main(["--scenes", cases.RECORDING, "--repeats", "1"]) == 0
    assert capsys.readouterr().out.count("skipped: no picture: give --picture") == 3


def test_wrong_answers_are_named(
    scene: EventScene, small: None, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    def a_third_missing(scene: EventScene, device: str, model: str, vote: Vote) -> Job:
        job = ours.image(scene, device, model, vote)
        image = truth.images(scene, model)[vote] * (2.0 / 3.0)
        places = truth.places(scene, model, *scene.sample())
        return dataclasses.replace(
            job, errors=lambda: truth.iwe_errors(scene, model, vote, image, places)
        )

    bad = dataclasses.replace(cases.LADDER[0], name="bad", make=a_third_missing)
    monkeypatch.setattr(runner, "CASES", (bad, cases.LADDER[6]))
    assert runner.main(["--events", "1", "--repeats", "1", "--scenes", "random pixels"]) == 1
    last = capsys.readouterr().out.splitlines()
    assert last[-2] == "wrong answers:"
    assert last[-1].startswith("random pixels, bad: misplaced 0.167 > 0.004; local 0.")


def test_nan_is_wrong() -> None:
    assert runner.wrong(
        cases.LADDER[0], {"misplaced": math.nan, "local": 0.0, "exact_px": 0.0}
    ) == ["misplaced nan > 0.004"]


def test_missing_libraries_are_seen_and_files_are_read(
    small: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def not_there(scene: EventScene, device: str, model: str, vote: Vote) -> Job:
        raise Missing("nolib is not installed")

    absent = dataclasses.replace(cases.LADDER[0], name="absent", make=not_there)
    monkeypatch.setattr(runner, "CASES", (*cases.LADDER, absent))
    file = tmp_path / "speed.json"
    assert runner.main(["--events", "1", "--repeats", "2", "--out", str(file)]) == 0
    results = json.loads(file.read_text())
    rows = results["rows"]
    assert len(rows) == 3 * (len(cases.LADDER) + 1)
    assert [row["skipped"] for row in rows if "skipped" in row] == ["nolib is not installed"] * 3
    text = report.page(f"a\n{report.BEGIN}\nold\n{report.END}\nb\n", [results])
    assert "old" not in text
    assert text.count("| absent | nolib is not installed |") == 3
    assert "| exact model over circle, time | ≤ 1.5 × |" in text
    assert "compared with NumPy" not in text  # NumPy was not in the run
    assert report.page(text, [results]) == text


def results_of(name: str, **seconds: float) -> dict[str, Any]:
    rows: list[dict[str, Any]] = [
        {"scene": s, "name": n, "work": 1e9, "seconds": [t, t, t], "median_s": t, "rate_per_s": 1e9 / t,
         "note": "", "also": {"peak_mib": 10.0 * t}}
        for s in cases.EVENT_SCENES
        for n, t in seconds.items()
    ]  # fmt: skip
    rows += [{"scene": s, "name": "none", "skipped": "not there"} for s in cases.EVENT_SCENES]
    return {"device": name, "rows": rows}


@pytest.mark.parametrize(
    ("aim", "expected"),
    [
        (cases.Aim("", "cuda", "a", dict(zip(cases.EVENT_SCENES, (3.0, 5.0, 6.0), strict=True)), "Gev/s"),
         ["", "≥ 3 / 5 / 6 Gev/s", "5.00 / 5.00 / 5.00", "yes / yes / no"]),
        (cases.Aim("", "cuda", "a", {"random pixels": 2.0}, "x faster", "b"), ["", "≥ 2 × faster", "2.50", "yes"]),
        (cases.Aim("", "cuda", "b", {"random pixels": 2.0}, "x time", "a"), ["", "≤ 2 ×", "2.50", "no"]),
        (cases.Aim("", "cuda", "a", {"random pixels": 0.3}, "s"), ["", "≤ 0.3 s", "0.20", "yes"]),
        (cases.Aim("", "cuda", "a", {"random pixels": 0.3}, "x time", "c"), []),
        (cases.Aim("", "cpu", "a", {"random pixels": 0.3}, "s"), []),
        (cases.Aim("", "cuda", "a", {"random pixels": 2.0}, "MiB"), ["", "≤ 2 MiB", "2.00", "yes"]),
        (cases.Aim("", "cuda", "a", {"random pixels": 2.0}, "x time", "none"),
         ["", "≤ 2 ×", "skipped: not there", "–"]),
    ],
)  # fmt: skip
def test_aims_are_judged(aim: cases.Aim, expected: list[str]) -> None:
    assert report.aim_cells(aim, results_of("cuda:0", a=0.2, b=0.5)) == expected


def test_aims_and_names_belong_together() -> None:
    names = [case.name for case in cases.CASES]
    assert len(set(names)) == len(names)
    for aim in cases.AIMS:
        for name in filter(None, (aim.of, aim.compared_with)):
            (case,) = (c for c in cases.CASES if c.name == name)
            assert aim.device in case.devices
            assert set(aim.bars) <= set(case.scenes)


def test_the_page_shows_the_files() -> None:
    results = [json.loads(path.read_text()) for path in report.FILES.values() if path.exists()]
    assert results
    text = report.PAGE.read_text()
    assert report.page(text, results) == text
    assert not [row["name"] for r in results for row in r["rows"] if row.get("wrong")]


def test_the_plan_of_data_sets_follows_from_the_fastest_row() -> None:
    counts = [(1, 1, 4.0), (2, 2, 6.0), (1, 4, 10.0), (2, 8, 18.0)]
    rows = [
        {"output": output, "gpus": gpus, "workers": workers, "items_per_s": faster * rate, "bytes_per_item": 2e6,
         "events_per_item": 1e6, "processor_s_per_item": 1.0 / faster}
        for output, faster in (("recordings", 1.0), ("voxel_grid", 4.0))
        for gpus, workers, rate in counts
    ]  # fmt: skip
    dataset.add_scaling(rows)
    assert [row["scaling"] for row in rows] == [1.0, 1.5, 1.0, 1.8] * 2
    assert [row["speed_up"] for row in rows] == [1.0] * 4 + [4.0] * 4
    assert [row["speed_up_by_processor_time"] for row in rows] == [1.0] * 4 + [4.0] * 4
    planned = dataset.plan(
        rows, [{"source": "pictures", "simulate": 0.1, "encode and write": 0.3}], "cuda"
    )
    assert (planned["recordings"], planned["devices"], planned["workers_per_device"]) == (
        100_000,
        16,
        4,
    )
    assert planned["hours"] == pytest.approx(100_000 / (16 * 9.0) / 3600.0, rel=1e-12)
    assert planned["terabytes"] == pytest.approx(0.2, rel=1e-12)
    assert planned["disk_mb_per_s"] == pytest.approx(288.0, rel=1e-12)
    assert (planned["bottleneck"], planned["bottleneck_share"]) == (
        "encode and write",
        pytest.approx(0.75, rel=1e-12),
    )


def test_the_results_of_data_sets_have_equal_files() -> None:
    results = [
        json.loads(path.read_text()) for path in sorted(dataset.RESULTS.glob("dataset_*.json"))
    ]
    assert len(results) == 2
    for result in results:
        assert {row["equal_to_one_worker"] for row in result["rows"]} == (
            {True} if result["measured"] else {None}
        )
        tensors = [
            row["tensors_equal"] for row in result["rows"] if row.get("output") == "voxel_grid"
        ]
        assert all(tensors)


def test_mutants_know_which_tests_read_files_with_a_module(tmp_path: Path) -> None:
    """Coverage does not run in the reading process."""
    test = "tests/io/test_io_formats.py::test_arrays_of_ros[True-dvs_msgs]"
    subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "benchmarks.mutants_plugin", test],
        cwd=report.ROOT, env=os.environ | {"MUTANTS_DURATIONS": str(tmp_path / "tests.json")}, check=True,
        stdout=subprocess.DEVNULL,
    )  # fmt: skip
    found = json.loads((tmp_path / "tests.json").read_text())
    assert "amiwarp.io.ros.reader" in found["called"][test]
    assert found["seconds"][test] > 0


def test_explained_mutants_and_their_modules_are_in_the_code() -> None:
    config = tomllib.loads((report.ROOT / "benchmarks" / "mutants.toml").read_text())
    for area in config["area"]:
        assert len(set(area["modules"])) == len(area["modules"])
        assert all(list(report.ROOT.glob(module)) for module in area["modules"])
        assert files_of_tests(report.ROOT, area["tests"])
    lines = {
        one["module"]: set(map(str.strip, (report.ROOT / one["module"]).read_text().splitlines()))
        for one in config["equivalent"]
    }
    assert [
        one["before"] for one in config["equivalent"] if one["before"] not in lines[one["module"]]
    ] == []


def test_planted_defects_are_in_the_code_once() -> None:
    defects = planted.load()
    assert [f"{one.file}: {one.before}" for one in defects if planted.is_stale(one)] == []
    assert len({one.name for one in defects}) == len(defects)
    assert all(files_of_tests(report.ROOT, one.tests) for one in defects)
    for one in defects:
        code = (report.ROOT / one.file).read_text()
        changed = planted.planted_in(code, one)
        assert changed is not None
        ast.parse(changed, one.file)
        assert changed != code


def test_the_place_of_a_planted_defect_does_not_depend_on_the_form_of_the_code() -> None:
    code = "call(\n    first,  # why\n    'b c',\n)\nfirst = 2\n"
    assert planted.place_of(code, "first, 'b c')") == (10, 36)
    assert planted.place_of(code, "'b  c'") is None
    assert planted.place_of(code, "first") is None
    assert planted.place_of(code, "first=2") == (37, 46)


def test_a_planted_defect_is_killed_or_survives_or_is_stale(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, path = "ONE, TWO, THREE = 1, 2, 3\n", tmp_path / "amiwarp" / "one.py"
    for name in ("amiwarp", "tests"):
        (tmp_path / name).mkdir()
    (tmp_path / "amiwarp" / "__init__.py").touch()
    path.write_text(code)
    (tmp_path / "tests" / "test_one.py").write_text(
        "from amiwarp.one import ONE\n\ndef test_one():\n    assert ONE == 1\n"
    )
    monkeypatch.setattr(planted, "ROOT", tmp_path)
    trials = (
        ("= 1", "= 4", "killed"),
        (" 3", " 4", "survived"),
        (", ", ",", "stale"),
        ("ONE", "NONE", "stale"),
    )
    for before, after, outcome in trials:
        defect = planted.Defect(2, "area", "amiwarp/one.py", before, after, "", ("one",))
        assert planted.judge(defect, tmp_path, 1.0, tmp_path / "kernels")[0] == outcome
        assert path.read_text() == code


def test_copies_have_all_of_the_package_but_no_results_of_benchmarks(tmp_path: Path) -> None:
    (copy,) = copies.make_copies(tmp_path, 1)
    for folder in ("amiwarp", "benchmarks"):
        found = {path.relative_to(copy) for path in (copy / folder).rglob("*.py")}
        root = copies.ROOT
        assert found == {path.relative_to(root) for path in (root / folder).rglob("*.py")}
    assert not (copy / "benchmarks" / "results").exists()
    assert not (copy / ".git").exists()


def test_each_round_of_planted_defects_keeps_its_first_score() -> None:
    rows = [{"round": 2, "outcome": "killed"}, {"round": 3, "outcome": "survived"}]
    earlier = {"round 2": {"survived": 1}}
    now = planted.score(rows)
    assert planted.first_scores({}, now) == now
    assert planted.first_scores(earlier, now) == {
        "round 2": {"survived": 1},
        "round 3": {"survived": 1},
    }


def test_mutants_replace_functions_that_are_hidden_from_the_collector(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a_mutated_module.py"
    path.write_text("class A:\n    def f(self):\n        return 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    module = importlib.import_module(path.stem)
    gc.freeze()
    try:
        assert mutants_plugin._replace(str(path), "A.f", path.read_text().replace("1", "2"))
        assert module.A().f() == 2
        assert not mutants_plugin._replace(str(path), "A.g", path.read_text())
        assert mutants_plugin._replace(str(tmp_path / "b.py"), "A.f", "")
    finally:
        gc.freeze()
        del sys.modules[path.stem]


def test_a_walk_has_the_functions_that_run_and_the_frames_above_the_deepest_launch() -> None:
    camera = Camera.from_fov(32, 24, 1.0)
    model = CircleModel.from_prism(camera, Prism(0.02), 0.3)
    events = Events.from_arrays([10, 20], [12, 14], [0, 1000], [0, 1])
    encoder = Encoder.constant_speed(720.0, 0, 2000)
    walker = walks.Walker()

    def call() -> None:
        sys.setprofile(walker)
        try:
            compensate_events(events, model, encoder)
        finally:
            sys.setprofile(None)

    call()
    with walker.following() as walk:
        call()
    assert "compensate_events" in walk.functions["compensation/in_memory.py"]
    assert "LaunchPlan.run" in walk.functions["kernels/compensation.py"]
    assert not any(path.startswith("calib") for path in walk.functions)
    assert walk.deepest == (
        "schema/calls.py _checked_call.<locals>.call",
        "compensation/in_memory.py compensate_events",
        "compensation/in_memory.py BlockCompensator.__call__",
        "compensation/in_memory.py BlockCompensator._on_cpu",
        "kernels/compensation.py LaunchPlan.run",
        "kernels/launch.py launch",
        "kernels/workers.py run_together",
    )

    before = {path: set(functions) for path, functions in walk.functions.items()}
    sys.setprofile(walker)
    Camera.from_fov(16, 12, 1.0)
    sys.setprofile(None)
    assert walk.functions == before  # nothing is followed outside the block


def test_a_walk_counts_neither_bodies_nor_comprehensions() -> None:
    source = "class A:\n    def f(self):\n        return [lambda: k for k in ()]\n"
    module = compile(source, "a.py", "exec")
    body = next(each for each in module.co_consts if hasattr(each, "co_code"))
    function = next(each for each in body.co_consts if hasattr(each, "co_code"))
    inner = [each for each in function.co_consts if hasattr(each, "co_code")]
    assert [walks.is_function(each) for each in (module, body, function)] == [False, False, True]
    comprehensions = [each for each in inner if each.co_name == "<listcomp>"]
    assert not any(walks.is_function(each) for each in comprehensions)
