"""Charts: errors against float64, Pareto fronts, budgets, files, and presets for calibrate and compensate."""

import csv
import itertools
import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.text import Text
from PIL import Image
from typer.testing import CliRunner, Result

import benchmarks.chart
from amiwarp import (
    AmiwarpError,
    Calibration,
    Camera,
    ExactModel,
    FlatSide,
    MemoryEvents,
    Model,
    Prism,
    RadialTangential,
    Recording,
    Settings,
    Vote,
    iwe,
    open_recording,
    predicted_error,
    save_recording,
)
from amiwarp.calib import Preset
from amiwarp.calib.presets import check, settings_from, settings_to, simplified
from amiwarp.optics import rungs
from amiwarp.plotting import figures
from amiwarp.studies.chart import calibration_rows, compensation_rows
from amiwarp.studies.chart.charts import Charts
from amiwarp.studies.chart.rows import (
    Row,
    beaten_by,
    fastest_within,
    front,
    most_accurate_within,
    near_front,
    told_apart,
)
from amiwarp.studies.chart.timing import Task, Timed, measure, slowness
from amiwarp.studies.chart.truth import KnownRecording, exact_image, exact_places, rms
from amiwarp.tasks import silent
from benchmarks import libraries as peers
from reference import optics as oracle
from tests.command_line import app


def run(*args: str | Path) -> Result:
    return CliRunner().invoke(app, [str(arg) for arg in args])


def fails(*args: str | Path) -> str:
    result = run(*args)
    assert result.exit_code == 1, result.output
    assert result.stderr.count("\n") == 1, result.stderr
    return str(result.stderr)


@pytest.fixture(scope="module")
def known(recording: Recording) -> KnownRecording:
    """The first 0.1 s of the shared recording."""
    events = recording.events.between(0, 100_000)
    return KnownRecording.of(
        replace(recording, events=MemoryEvents(events, *recording.events.size))
    )


@pytest.fixture(scope="module")
def charted(
    recording: Recording, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, dict[str, Any]]:
    """A folder with the recording's file and a quick chart of it, and the output of the command."""
    folder = tmp_path_factory.mktemp("chart")
    save_recording(folder / "recording.h5", recording)
    words = (
        "chart",
        folder / "recording.h5",
        "--quick",
        "--out",
        folder / "out",
        "--budget-px",
        "0.3",
        "--json",
    )
    result = run(*words, "--device", "cpu")
    assert result.exit_code == 0, result.output
    return folder, json.loads(result.stdout)


@pytest.mark.parametrize("side", list(FlatSide))
@pytest.mark.parametrize(
    "uneven", [{}, {"cylinder": (0.01, -0.02)}, {"cylinder": (0.0, 0.01), "wobble": (0.05, 0.03)}]
)
@pytest.mark.parametrize(
    ("distortion", "bar"),
    [(None, 1e-9), (RadialTangential(-0.2, 0.05, 1e-3, -5e-4), 1e-3)],
    ids=["pinhole", "lens"],
)
def test_exact_places_are_those_of_the_trace(
    side: FlatSide, uneven: Any, distortion: Any, bar: float
) -> None:
    camera = Camera.from_fov(320, 240, math.radians(70.0), distortion)
    model = ExactModel(camera, Prism(math.radians(3.0), 1.6, side), 0.7, (0.02, -0.03), **uneven)
    rng = np.random.default_rng(0)
    xy = np.stack([rng.integers(0, 320, 2000), rng.integers(0, 240, 2000)], axis=1).astype(
        np.float64
    )
    theta = rng.uniform(-10.0, 10.0, 2000)
    expected = oracle.move(
        camera, model.prism, xy, theta, to_scene=True, phase=model.phase, tilt=model.tilt, **uneven
    )
    assert np.isfinite(expected).all()
    np.testing.assert_allclose(exact_places(model, xy, theta), expected, rtol=0.0, atol=bar)


def test_exact_image_is_the_one_that_votes_make(known: KnownRecording) -> None:
    image = iwe(
        known.events,
        known.camera.width,
        known.camera.height,
        model=known.model,
        encoder=known.encoder,
    )
    truth = exact_image(known)
    assert np.sqrt(np.mean((image - truth) ** 2)) < 0.005 * np.std(truth)


def test_every_library_makes_the_same_image(known: KnownRecording) -> None:
    n = 20_000
    theta = known.encoder.angle_at(known.events.t[:n])
    events = peers.PeerEvents(
        known.events.x[:n],
        known.events.y[:n],
        np.remainder(theta, 2.0 * np.pi).astype(np.float32),
        5.5,
        200,
        150,
        8,
    )
    places = events.places(slice(None)).astype(np.float64)
    inside = (places > 0).all(axis=1) & (places < (199, 149)).all(axis=1)
    images = {}
    for name, make in peers.PEERS.items():
        try:
            peer = make(events, "cpu")
        except peers.Missing:
            continue
        for _ in range(2):  # a pass starts with an empty image
            peer.run()
        images[name] = peer.image()
        assert images[name].shape == (150, 200)
        assert inside.sum() <= images[name].sum() <= n
        assert np.abs(images[name] - images["NumPy"]).max() < 0.01, name
    assert "CuPy" not in images
    moved = places - np.stack([events.x, events.y], axis=1)
    np.testing.assert_allclose(np.hypot(*moved.T), 5.5, atol=1e-4)


def test_compensation_rows_tell_speed_and_error(
    known: KnownRecording, device: str, tmp_path: Path
) -> None:
    said = []
    failed: dict[str, str] = {}
    rows, _ = compensation_rows.compensation_rows(
        known,
        device,
        repeats=1,
        quick=True,
        folder=tmp_path,
        progress=lambda what, share: said.append((what, share)),
        failed=failed,
    )
    assert failed == {}
    by_label = {row.label: row for row in rows}
    assert by_label["exact, bilinear"].error_px < 0.001
    assert by_label["exact, bilinear"].image_error < 0.005
    assert by_label["exact, file to file"].error_px < 0.001
    # a nearest vote rounds both axes
    assert by_label["exact, nearest"].error_px == pytest.approx(math.sqrt(2.0 / 12.0), abs=0.02)
    assert 0.001 < by_label["exact, bilinear, 1024 angles"].error_px < 0.05
    assert by_label["circle, bilinear"].error_px > 0.05
    few = by_label["exact, bilinear, 1/16 of events"]
    assert few.image_error > 0.1
    assert not few.comparable
    assert all(row.seconds > 0.0 and row.events % len(known.events) == 0 for row in rows)
    assert [row.label for row in rows if row.default] == ["exact, bilinear", "exact, file to file"]
    assert len({row.label for row in rows}) == len(rows)
    assert said[-1][1] == 1.0
    assert not list(tmp_path.iterdir())


def test_an_image_that_is_wrong_is_refused(
    known: KnownRecording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        compensation_rows, "exact_image", lambda known: np.roll(exact_image(known), 1, axis=1)
    )
    with pytest.raises(AmiwarpError, match=r"exact, bilinear differs from the float64 one"):
        compensation_rows.compensation_rows(
            known, "cpu", repeats=1, quick=True, folder=tmp_path, progress=silent, failed={}
        )


def test_settings_are_different_and_one_is_the_default(known: KnownRecording) -> None:
    for quick in (False, True):
        ways = calibration_rows.calibration_settings(known, quick=quick)
        assert len({way.label for way in ways}) == len(ways)
        assert [way.label for way in ways if way.row_fields("cpu")["default"]] == ["default"]
        for way in ways:
            way.settings.check()
            check("calibration", settings_to(way.settings))
        plain = [json.dumps(settings_to(way.settings)) for way in ways if way.comparable]
        assert len(set(plain)) == len(plain)


def test_what_cannot_be_charted_is_refused(recording: Recording) -> None:
    for lacking in ({"truth": None}, {"encoder": None}, {"camera": None}, {"prism": None}):
        with pytest.raises(AmiwarpError, match="amiwarp simulate"):
            KnownRecording.of(replace(recording, **lacking))


def row(label: str, seconds: float, error_px: float, **more: Any) -> Row:
    fixed: dict[str, Any] = {"chart": "calibration", "job": "calibration", "family": "model", "mark": "both stages",
                             "settings": {"device": "cpu"}}  # fmt: skip
    return Row(**{**fixed, "label": label, "events": 1_000_000, "seconds": seconds, "spread": 0.0, "repeats": 1,
                  "error_px": error_px, **more})  # fmt: skip


ROWS = [
    row("slow", 2.0, 0.01),
    row("fast", 0.5, 0.2),
    row("fastest", 0.49, 0.4),
    row("worse", 1.0, 0.3),
    row("noisy", 0.1, 0.001, comparable=False),
    row("a little better", 3.0, 0.009),
]


def test_front() -> None:
    assert [r.label for r in front(ROWS)] == ["fastest", "fast", "slow", "a little better"]
    assert ROWS[0].mev_per_s == 0.5


def test_what_beats_a_row() -> None:
    assert [r.label for r in beaten_by(ROWS[3], ROWS)] == ["slow", "fast"] or [
        r.label for r in beaten_by(ROWS[3], ROWS)
    ] == ["fast"]
    # 2 % of speed and 0.001 px are within the variation between runs
    assert beaten_by(ROWS[1], ROWS) == []
    assert beaten_by(ROWS[0], ROWS) == []


@pytest.mark.parametrize(
    ("px", "label"), [(0.5, "fast"), (0.25, "fast"), (0.1, "slow"), (0.0095, "a little better")]
)
def test_fastest_within(px: float, label: str) -> None:
    found = fastest_within(ROWS, px)
    assert found is not None
    assert found.label == label


@pytest.mark.parametrize(
    ("seconds", "label"), [(0.495, "fastest"), (1.5, "fast"), (2.5, "slow"), (9.0, "slow")]
)
def test_most_accurate_within(seconds: float, label: str) -> None:
    found = most_accurate_within(ROWS, seconds)
    assert found is not None
    assert found.label == label


def test_nothing_within() -> None:
    assert fastest_within(ROWS, 1e-4) is None
    assert most_accurate_within(ROWS, 0.2) is None


def test_of_a_front_what_differs_is_named() -> None:
    rows = [row(str(k), 1.0 - 0.04 * k, 0.1 + 0.1 * k) for k in range(4)]  # 1.0, 0.96, 0.92, 0.88 s
    assert [r.label for r in front(rows)] == ["3", "2", "1", "0"]
    assert [r.label for r in told_apart(front(rows))] == ["2", "0"]
    assert [r.label for r in told_apart(front([*rows[:3], replace(rows[3], default=True)]))] == [
        "3",
        "2",
        "0",
    ]


def test_what_cannot_reach_the_front_is_not_repeated() -> None:
    rows = [
        row("best", 1.0, 0.1),
        row("near", 1.3, 0.1),
        row("far", 1.5, 0.1),
        row("nearer", 9.0, 0.09),
        None,
    ]
    assert near_front(rows) == [True, True, False, True, False]
    assert near_front([rows[0], row("default", 5.0, 0.2, default=True)]) == [True, True]
    # a row that needs an initial guess beats no other row
    assert near_front([replace(row("best", 1.0, 0.1), comparable=False), row("far", 1.5, 0.1)]) == [
        True,
        True,
    ]
    ran: list[str] = []
    tasks = [Task(lambda name=name: ran.append(name), 1) for name in "abc"]
    timed = measure(
        tasks,
        3,
        silent,
        "measuring",
        warm_up=False,
        again=lambda once: [t.task is not tasks[1] for t in once],
    )
    assert "".join(ran[:3]) == "abc"
    assert sorted(ran[3:5]) == sorted(ran[5:]) == ["a", "c"]
    assert [len(t.times) for t in timed] == [3, 1, 3]


def test_slow_rounds_do_not_change_the_measured_times() -> None:
    usual, slow = np.array([1.0, 2.0, 5.0]), np.array([1.0, 1.4, 0.9, 1.0, 3.0])
    times = [*(usual[:, None] * slow).tolist(), [4.0]]  # the last task was not repeated
    times[0][3] = 1.5  # one run was slow by itself
    assert slowness(times) == pytest.approx(slow)
    found = [Timed(Task(lambda: None, 1), tuple(t), slowness(times)[: len(t)], None) for t in times]
    fields = {
        "chart": "calibration",
        "job": "job",
        "label": "a",
        "family": "",
        "mark": "",
        "settings": {},
    }
    rows = [replace(t, task=replace(t.task, fields=fields)).row(0.0) for t in found]
    assert [r.seconds for r in rows] == pytest.approx([1.0, 2.0, 5.0, 4.0])
    assert [r.spread for r in rows] == pytest.approx([2.1, 2.1, 2.1, 0.0])
    assert [r.repeats for r in rows] == [5, 5, 5, 1]


def test_tasks_take_turns_in_changing_order() -> None:
    order: list[str] = []
    shares: list[float] = []
    names = "abcd"
    tasks = [
        Task(lambda name=name: order.append(name), 1, keep=lambda _: len(order)) for name in names
    ]

    def progress(what: str, share: float) -> None:
        assert what == "measuring"
        shares.append(share)

    timed = measure(tasks, 3, progress, "measuring")
    rounds = ["".join(order[k : k + 4]) for k in range(0, 16, 4)]
    assert rounds[:2] == [names, names]
    assert all(sorted(each) == sorted(names) for each in rounds)
    assert len(set(rounds[1:])) == 3  # another order in each timed round
    assert [len(t.times) for t in timed] == [3, 3, 3, 3]
    assert [t.result for t in timed] == [5, 6, 7, 8]  # results of the first timed round
    assert shares == [(k + 1) / 16 for k in range(16)]
    order.clear()
    assert [
        len(t.times) for t in measure(tasks, 9, progress, "measuring", warm_up=False, limit_s=0.0)
    ] == [1] * 4


def test_a_task_that_fails_is_not_run_again_and_the_others_are() -> None:
    runs: list[str] = []

    def run_task(name: str) -> None:
        runs.append(name)
        if name == "early" or (name == "late" and runs.count("late") == 3):
            raise MemoryError("too large")

    names = ("early", "good", "late")
    timed = measure(
        [Task(lambda name=name: run_task(name), 1) for name in names], 3, silent, "measuring"
    )
    assert [runs.count(name) for name in names] == [1, 4, 3]
    assert [(len(t.times), len(t.slowness)) for t in timed] == [(0, 0), (3, 3), (0, 0)]
    assert [t.failure[:22] for t in timed] == [
        "MemoryError: too large",
        "",
        "MemoryError: too large",
    ]
    (gone,) = measure([Task(lambda: run_task("early"), 1)], 3, silent, "measuring")
    assert gone.failure


def test_quick_chart_writes_everything(charted: tuple[Path, dict[str, Any]]) -> None:
    folder, data = charted
    names = {"chart.json", "chart.csv", "preset_calibration.json", "preset_compensation.json"}
    names |= {
        f"{chart}.{ending}"
        for chart in ("compensation", "calibration")
        for ending in ("png", "svg")
    }
    assert {file.name for file in (folder / "out").iterdir()} == names
    whole = json.loads((folder / "out" / "chart.json").read_text())
    assert whole["device"] == "cpu"
    assert {"amiwarp", "python", "numpy", "warp-lang"} <= set(whole["versions"])
    assert whole["recording"]["width"] == 200
    with (folder / "out" / "chart.csv").open() as file:
        table = list(csv.DictReader(file))
    rows = [r for chart in ("compensation", "calibration") for r in whole[chart]["rows"]]
    assert [line["label"] for line in table] == [r["label"] for r in rows]
    assert all(float(line["ms"]) > 0.0 and float(line["error_px"]) >= 0.0 for line in table)
    on_front = {line["label"] for line in table if line["on_front"] == "True"}
    assert on_front == {
        n for c in ("compensation", "calibration") for f in whole[c]["fronts"].values() for n in f
    }
    for chart in ("compensation", "calibration"):
        assert np.asarray(Image.open(folder / "out" / f"{chart}.png")).shape[1] > 1000
        assert (folder / "out" / f"{chart}.svg").read_text().rstrip().endswith("</svg>")
    # the chosen settings are a row of the same run
    for kind, unit in (("calibration", "ms"), ("compensation", "mev_per_s")):
        preset = json.loads((folder / "out" / f"preset_{kind}.json").read_text())
        (same,) = (r for r in whole[kind]["rows"] if r["label"] == preset["measured"]["label"])
        assert preset["measured"]["error_px"] == same["error_px"] <= 0.3
        assert preset["measured"][unit] == same[unit] == pytest.approx(data["answers"][kind][unit])


@pytest.mark.slow
def test_settings_that_fail_do_not_end_the_command(
    charted: tuple[Path, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calibrate, compensate, bent = (
        calibration_rows.calibrate,
        compensation_rows.compensate,
        compensation_rows._places,
    )

    def planted(recording: Recording, settings: Settings, **more: Any) -> Calibration:
        if settings.model == "circle":
            raise np.linalg.LinAlgError("Singular matrix")
        return calibrate(recording, settings, **more)

    def also(source: Recording, calibration: Calibration, *args: Any, **more: Any) -> Any:
        if calibration.model_name == "circle":
            raise AmiwarpError("no disk")
        return compensate(source, calibration, *args, **more)

    def nowhere(model: Model, *args: Any) -> np.ndarray:
        places = bent(model, *args)
        return places if isinstance(model, ExactModel) else places * np.nan

    monkeypatch.setattr(calibration_rows, "calibrate", planted)
    monkeypatch.setattr(compensation_rows, "compensate", also)
    monkeypatch.setattr(compensation_rows, "_places", nowhere)
    folder, _ = charted
    words = (
        "chart",
        folder / "recording.h5",
        "--quick",
        "--out",
        tmp_path / "out",
        "--device",
        "cpu",
    )
    done = run(*words)
    assert done.exit_code == 0, done.output
    whole = json.loads((tmp_path / "out" / "chart.json").read_text())
    failed = whole["failed"]
    sharp = "circle, 50 k events, sharpness"
    assert failed[sharp].startswith(
        "LinAlgError: Singular matrix (in run, studies/chart/calibration_rows.py:"
    )
    assert failed["circle, file to file"].startswith("no disk (in run, ")
    assert failed["circle, bilinear"].startswith("no event has a finite position in both models")
    labels = {
        chart: [r["label"] for r in whole[chart]["rows"]]
        for chart in ("compensation", "calibration")
    }
    assert labels["calibration"] == ["default", "50 k events, sharpness"]
    assert {"exact, bilinear", "exact, file to file"} < set(labels["compensation"])
    assert not set(failed) & {*labels["compensation"], *labels["calibration"]}
    assert len(failed) == 5
    assert all(f"failed: {label}: {error}" in done.stdout for label, error in failed.items())
    assert done.stdout.endswith(
        f"{sum(map(len, labels.values()))} settings measured; {len(failed)} failed\n"
    )
    assert Charts.load(tmp_path / "out" / "chart.json").failed == failed

    def never(*_: Any, **__: Any) -> None:
        raise MemoryError

    monkeypatch.setattr(calibration_rows, "calibrate", never)
    for name in ("compensate", "_places"):
        monkeypatch.setattr(compensation_rows, name, never)
    nothing = run(*words[:4], tmp_path / "none", *words[5:])
    assert nothing.exit_code == 1, nothing.output
    assert "note: calibration: not drawn, no setting was measured" in nothing.stdout
    assert sorted(file.name for file in (tmp_path / "none").iterdir()) == [
        "chart.csv",
        "chart.json",
    ]


def test_charts_are_drawn_later(
    charted: tuple[Path, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Charts are drawn from the data file alone, as after a run without the drawing packages."""
    folder, data = charted
    loaded = Charts.load(folder / "out" / "chart.json")

    def missing(*_: Any) -> None:
        raise ModuleNotFoundError("No module named 'matplotlib'")

    with monkeypatch.context() as patch:
        patch.setattr(sys.modules["amiwarp.studies.chart.charts"], "draw", missing)
        note = loaded.draw(tmp_path).notes[-1]
    assert "No module named 'matplotlib'" in note
    assert "benchmarks.chart --from chart.json" in note
    assert not list(tmp_path.iterdir())
    monkeypatch.setattr(figures, "save_svg", lambda figure, path: None)
    drawn = loaded.draw(tmp_path)
    assert set(data["notes"]) == set(drawn.notes)
    for chart in ("compensation", "calibration"):
        assert drawn.files[chart] == tmp_path / f"{chart}.png"
        before, again = (
            np.asarray(Image.open(at / f"{chart}.png")) for at in (folder / "out", tmp_path)
        )
        np.testing.assert_array_equal(before, again)
    assert loaded.answer(tmp_path, budget_px=0.3)["calibration"] is not None
    (tmp_path / "chart.json").write_text('{"compensation": {}}')
    with pytest.raises(AmiwarpError, match=r"chart\.json: cannot be read as the data of charts"):
        Charts.load(tmp_path / "chart.json")
    words = [
        "chart",
        "--from",
        str(folder / "out" / "chart.json"),
        "--out",
        str(tmp_path / "out"),
        "--budget-ms",
    ]
    monkeypatch.setattr(sys, "argv", [*words, "1e9"])
    assert benchmarks.chart.main() == 0
    assert (tmp_path / "out" / "calibration.png").exists()
    best = min(loaded.calibration, key=lambda r: r.error_px)
    preset = json.loads((tmp_path / "out" / "preset_calibration.json").read_text())
    assert preset["measured"]["error_px"] == pytest.approx(best.error_px, abs=0.003)


def test_presets_are_taken(charted: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    folder, _ = charted
    preset = tmp_path / "preset.json"
    values = settings_to(
        Settings(events=30_000, fold=1 << 17, global_evaluations=40, stages=("sharpness",))
    )
    Preset("calibration", values, {}).save(preset)
    words = (
        "calibrate",
        folder / "recording.h5",
        tmp_path / "c.json",
        "--preset",
        preset,
        "--json",
    )
    assert "fold = 131072 angles a turn" in fails(*words)
    result = run(*words, "--global-evaluations", "30", "--fold", "512")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["events"] <= 30_000
    assert found["stages"][0]["name"] == "global"
    assert found["stages"][0]["evaluations"] == 30  # an option takes precedence over the preset
    assert "photometric" not in [stage["name"] for stage in found["stages"]]
    for model in rungs():
        preset = tmp_path / f"{model}.json"
        Preset("compensation", {"model": model}, {}).save(preset)
        words = (
            "compensate",
            folder / "recording.h5",
            tmp_path / f"{model}.h5",
            "--calibration",
            tmp_path / "c.json",
        )
        result = run(*words, "--preset", preset)
        assert result.exit_code == 0, result.output
        assert f"by the {model} model" in result.stdout
        assert open_recording(tmp_path / f"{model}.h5").metadata["compensated_with"] == model
    first = {m: open_recording(tmp_path / f"{m}.h5").events.slice(0, 10_000) for m in rungs()}
    away = {
        m: rms(np.stack([e.x - first["exact"].x, e.y - first["exact"].y], axis=1))
        for m, e in first.items()
    }
    assert away["exact"] == 0.0 < away["ellipse"] < away["radial"] < away["circle"] < 0.5


BAD = [
    ({"format": "other"}, "amiwarp-preset"),
    ({"kind": "compensation"}, "kind is 'compensation'"),
    ({"settings": [1]}, "settings is [1]"),
    ({"settings": {"modell": "exact"}}, "field settings.modell is unknown; expected model"),
    ({"settings": {"model": "round"}}, "'round'"),
    ({"settings": {"events": "many"}}, "field settings.events = 'many' is not a whole number"),
    ({"settings": {"events": True}}, "field settings.events = True is not a whole number"),
    ({"settings": {"events": 0}}, "events = 0"),
    ({"settings": {"stages": ["photometric"]}}, "stages"),
    ({"settings": {"global_algorithm": "GD_STOGO"}}, "GD_STOGO"),
    ({"settings": {"photometric": 3}}, "field settings.photometric is 3; expected an object"),
    (
        {"settings": {"photometric": {"pears": 3}}},
        "field settings.photometric.pears is unknown; expected pairs",
    ),
    (
        {"settings": {"photometric": {"pairs": 1.5}}},
        "field settings.photometric.pairs = 1.5 is not a whole number",
    ),
]


@pytest.mark.parametrize(("change", "said"), BAD, ids=[said for _, said in BAD])
def test_bad_presets_are_named(tmp_path: Path, change: dict[str, Any], said: str) -> None:
    data = {
        "format": "amiwarp-preset",
        "version": 1,
        "kind": "calibration",
        "settings": {},
        "measured": {},
    }
    file = tmp_path / "p.json"
    file.write_text(json.dumps(data | change))
    with pytest.raises(AmiwarpError) as error:
        Preset.load(file, "calibration")
    assert str(file) in str(error.value)
    assert said in str(error.value)


def test_presets_that_are_no_files_are_named(
    charted: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    folder, _ = charted
    words = (
        "compensate",
        folder / "recording.h5",
        tmp_path / "o.h5",
        "--calibration",
        folder / "recording.h5",
    )
    assert "recording.h5" in fails(*words)
    words = ("calibrate", folder / "recording.h5", tmp_path / "c.json", "--preset")
    assert "missing.json" in fails(*words, tmp_path / "missing.json")
    assert "give a preset for calibration" in fails(
        *words, folder / "out" / "preset_compensation.json"
    )
    file = tmp_path / "p.json"
    file.write_text(
        '{"format": "amiwarp-preset", "version": 1, "kind": "compensation", "settings": {}}'
    )
    with pytest.raises(AmiwarpError, match="model is None"):
        Preset.load(file, "compensation")


def test_settings_survive_the_file(tmp_path: Path) -> None:
    s = Settings(
        model="radial", global_algorithm=None, events=1234, fold=256, stages=("sharpness",)
    )
    Preset("calibration", settings_to(s), {"ms": 1.0}).save(tmp_path / "p.json")
    assert Preset.load(tmp_path / "p.json", "calibration").calibration_settings() == s
    assert settings_from({}) == Settings()


def test_chart_refuses_what_makes_no_sense(
    charted: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    folder, _ = charted
    file = folder / "recording.h5"
    assert "give one of them" in fails("chart", file, "--budget-px", "1", "--budget-ms", "1")
    assert "give one of them" in fails("chart", file, "--picture", "x.png")
    save_recording(tmp_path / "plain.h5", replace(open_recording(file), truth=None))
    assert "has no ground truth" in fails("chart", tmp_path / "plain.h5", "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_simpler_models_of_the_same_prism(known: KnownRecording) -> None:
    exact = known.calibration()
    errors = [
        predicted_error(simplified(exact, m).model, known.model).rms
        for m in ("circle", "radial", "ellipse")
    ]
    assert errors[0] > errors[1] > errors[2] > 0.0
    assert simplified(exact, "exact") is exact
    # a circle of any other size would be worse
    circle = simplified(exact, "circle")
    for factor in (0.98, 1.02):
        values = {**circle.parameters, "deflection": factor * circle.parameters["deflection"]}
        assert (
            predicted_error(replace(circle, parameters=values).model, known.model).rms > errors[0]
        )
    radial: Calibration = simplified(exact, "radial")
    assert simplified(radial, "circle").model_name == "circle"
    for model in ("exact", "ellipse"):
        with pytest.raises(AmiwarpError, match="calibrate with exact"):
            simplified(radial, model)
    with pytest.raises(AmiwarpError, match="calibrate with exact"):
        simplified(circle, "radial")


def calibrations(
    known: KnownRecording, low_ms: float, high_ms: float, error_px: float
) -> list[Row]:
    """The calibration rows of a whole chart with times and errors within these limits."""
    rng = np.random.default_rng(0)
    out = []
    for way in calibration_rows.calibration_settings(known, quick=False):
        late = 0.25 + 0.5 * (len(way.settings.stages) - 1) + rng.normal(0.0, 0.1)
        px = {"circle": 0.2, "radial": 0.06}.get(way.settings.model, error_px) * rng.uniform(
            1.0, 3.0
        )
        took = 1e-3 * low_ms * (high_ms / low_ms) ** min(max(late, 0.0), 1.0)
        out.append(
            Row(
                **way.row_fields("cpu"),
                events=10**7,
                seconds=took,
                spread=0.1,
                repeats=3,
                error_px=px,
            )
        )
    return out


def compensations(mev_per_s: dict[str, float], others: dict[str, float], files: float) -> list[Row]:
    """The compensation rows of a whole chart, with the given speeds of each model and of other libraries."""
    rng = np.random.default_rng(0)
    errors = {"circle": 0.21, "radial": 0.05, "ellipse": 3e-3, "exact": 2e-4}

    def made(fields: dict[str, Any], speed: float, error_px: float) -> Row:
        return Row(
            **fields, events=10**6, seconds=1.0 / speed, spread=0.1, repeats=7, error_px=error_px
        )

    out = []
    for way in compensation_rows.compensation_settings(quick=False):
        speed = mev_per_s[way.model] * rng.uniform(0.95, 1.05) * way.share
        rough = math.hypot(
            errors[way.model], 12.0 / way.angles, 0.408 if way.vote is Vote.NEAREST else 0.0
        )
        out.append(made(way.row_fields("cpu"), speed, rough))
    fixed: dict[str, Any] = {
        "chart": "compensation",
        "job": compensation_rows.IMAGE,
        "family": "other libraries",
    }
    for name, speed in others.items():
        mark = name.partition(",")[0]
        out.append(
            made({**fixed, "label": f"{name} (circle)", "mark": mark, "settings": {}}, speed, 0.5)
        )
    for model, px in errors.items():
        file = {**fixed, "job": compensation_rows.FILE, "label": f"{model}, file to file", "family": model,
                "mark": compensation_rows.FILE, "settings": {"model": model}, "default": model == "exact"}  # fmt: skip
        out.append(made(file, files * rng.uniform(0.8, 1.2), px))
    return out


GPU = {"circle": 8e4, "radial": 7.5e4, "ellipse": 5e4, "exact": 7e4}
CPU = {"circle": 420.0, "radial": 390.0, "ellipse": 250.0, "exact": 290.0}
SLOW = {"circle": 80.0, "radial": 14.0, "ellipse": 31.0, "exact": 71.0}
ON_CPU = {"NumPy": 22.0, "Numba": 42.0, "Numba, table": 96.0, "PyTorch": 30.0}
DRAWN = {
    "a GPU's images": lambda _: compensations(
        GPU, {**ON_CPU, "PyTorch": 6e3, "CuPy": 5.8e3, "CuPy, CUDA C++": 2.4e4}, 110.0
    ),
    "slow images on a GPU": lambda _: compensations(dict.fromkeys(GPU, 1e3), ON_CPU, 60.0),
    "images on two cores": lambda _: compensations(CPU, ON_CPU, 45.0),
    "images on slow cores": lambda _: compensations(SLOW, {**ON_CPU, "PyTorch": 2.2}, 20.0),
    "a GPU's calibrations": lambda known: calibrations(known, 50.0, 1500.0, 0.012),
    "fast calibrations": lambda known: calibrations(known, 3.0, 90.0, 0.002),
    "slow calibrations": lambda known: calibrations(known, 2000.0, 60_000.0, 0.3),
    "calibrations as fast as each other": lambda known: calibrations(known, 900.0, 1100.0, 0.01),
    # a front with many neighbouring points
    "a long front": lambda known: [
        *(
            row(f"{k} k events, folded to {k} angles, sharpness", 1.0 + 0.06 * k, 0.5 * 0.8**k)
            for k in range(14)
        ),
        row("default", 3.0, 0.02, default=True, family="default"),
    ],
    "one row": lambda known: [row("default", 3.0, 0.02, default=True, family="default")],
}


@pytest.mark.parametrize("name", DRAWN)
def test_letters_do_not_overlap(
    name: str, known: KnownRecording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from amiwarp.studies.chart.drawing import draw

    drawn: list[Any] = []
    monkeypatch.setattr(figures, "save", lambda figure, path: drawn.append(figure))
    monkeypatch.setattr(figures, "save_svg", lambda figure, path: None)
    rows = DRAWN[name](known)
    draw(
        tmp_path / "chart",
        rows,
        "Chart on 2 cores of Intel(R) Xeon(R) Platinum 8488C CPU @ 2.40GHz: 8 M events",
        "n",
    )
    (figure,) = drawn
    figure.canvas.draw()
    texts = [t for t in figure.findobj(Text) if t.get_text().strip() and t.get_visible()]
    # Without the line from a label to its point
    boxes = [(t.get_text(), Text.get_window_extent(t)) for t in texts]
    assert len(boxes) > (15 if len(rows) == 1 else 30)
    inner = [(text, box.shrunk(0.95, 0.85)) for text, box in boxes]
    clashes = [
        (a, b) for (a, box), (b, other) in itertools.combinations(inner, 2) if box.overlaps(other)
    ]
    assert clashes == []
    size = figure.bbox
    assert [
        t for t, b in boxes if b.x0 < 0 or b.x1 > size.x1 + 1 or b.y0 < 0 or b.y1 > size.y1 + 1
    ] == []
    # every axis has enough numbers
    for ax in figure.axes:
        for axis in (ax.xaxis, ax.yaxis):
            assert (
                len(
                    [
                        t
                        for t in axis.get_major_ticks()
                        if axis.get_view_interval()[0] <= t.get_loc()
                    ]
                )
                >= 3
            )
