"""Recordings of the stability study, the methods that run on them, and calibration of formerly failing cases."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from amiwarp import AmiwarpError, ExactModel, calibrate, model_error
from amiwarp.calib.paper_method import calibrate_as_paper
from amiwarp.studies.cluster import single_worker
from amiwarp.studies.stability.cells import (
    AXES,
    Condition,
    Outcome,
    SceneKind,
    Store,
    best_fit,
    chosen,
    conditions,
    draw,
    identity,
    make,
    quick_axes,
    run,
    sensible,
)
from tests.conftest import COARSE

SMALL = Condition(width=160, height=120, turns=3.0)


def error_px(condition: Condition, seed: int) -> tuple[float, str]:
    """Return the model error of the exact model's answer, and the warnings."""
    sample = make(condition, seed)
    found = calibrate(sample.recording, photometric=COARSE)
    assert sample.recording.truth is not None
    truth = ExactModel(condition.camera, condition.prism, sample.recording.truth.parameters["phase"])
    return model_error(found.exact.model, truth).rms, "; ".join(found.warnings)


def test_equal_conditions_make_equal_recordings() -> None:
    one, two, other = make(SMALL, 1), make(SMALL, 1), make(SMALL, 2)
    a, b = (s.recording.events.slice(0, 10**9) for s in (one, two))
    np.testing.assert_array_equal(a.t, b.t)
    np.testing.assert_array_equal(a.x, b.x)
    assert one.hardware == two.hardware
    assert one.hardware != other.hardware
    assert SMALL.key == replace(SMALL).key != replace(SMALL, noise=0.1).key


@pytest.mark.parametrize("axis", AXES, ids=lambda a: a.name)
def test_axes_name_fields_and_begin_harmless(axis: object) -> None:
    made = axis.conditions()  # type: ignore[attr-defined]
    assert len({c.key for c in made}) == len(axis.values)  # type: ignore[attr-defined]
    assert sensible(made[0], 100_000) or axis.name in ("apex", "thin lines and noise")  # type: ignore[attr-defined]


def test_the_harmless_end_is_run_once() -> None:
    every = conditions(AXES)
    assert every.count(Condition()) == 1
    assert len(every) < sum(len(a.values) for a in AXES)
    assert set(conditions(quick_axes())) <= set(every)


def test_earlier_conditions_keep_their_keys() -> None:
    assert Condition().key == "898bfb2cde7c0008"
    assert replace(Condition(), noise=0.1).key == "e73b64fa3a7134e3"
    assert replace(Condition(), cutoff_hz=300.0).key not in {Condition().key, replace(Condition(), cutoff_hz=100.0).key}


@pytest.mark.parametrize("kind", SceneKind)
def test_scenes(kind: SceneKind) -> None:
    light = draw(kind, 200, 150, period=12.0, seed=3)
    assert light.shape == (150, 200)
    assert light.min() > 0.1
    assert light.max() <= 1.0
    assert (np.ptp(light) > 0.3) == (kind is not SceneKind.BLANK)
    np.testing.assert_array_equal(light, draw(kind, 200, 150, period=12.0, seed=3))


def test_what_is_asked_for_is_made() -> None:
    plain = make(SMALL, 0).recording
    noisy = make(replace(SMALL, noise=0.5), 0).recording
    assert len(noisy.events) == pytest.approx(2.0 * len(plain.events), rel=0.1)
    window = make(replace(SMALL, window_events=5000), 0).recording.events
    cut = window.slice(0, len(window))
    assert 5000 <= len(cut) < 5600
    assert np.ptp(cut.x) < 100
    scans = make(replace(SMALL, readout_us=500.0), 0).recording.events.slice(0, 10**9)
    assert not (scans.t % 500).any()
    assert (np.diff(scans.t) >= 0).all()
    slow = make(replace(SMALL, cutoff_hz=30.0), 0).recording
    assert len(slow.events) < 0.6 * len(plain.events)
    most = 0.3 * SMALL.duration_s * 1e6
    assert len(plain.events) > 1.2 * most
    jammed = make(replace(SMALL, bus_rate_mev_s=0.3), 0).recording.events
    assert len(jammed) <= most + 1
    lost = make(replace(SMALL, lost=0.3), 0).recording
    assert len(lost.events) == pytest.approx(0.7 * len(plain.events), rel=0.02)
    back = make(replace(SMALL, backwards=True), 0).recording
    assert plain.encoder is not None
    assert back.encoder is not None
    assert plain.encoder.rpm == pytest.approx(720.0, rel=1e-2)
    assert back.encoder.rpm == pytest.approx(-720.0, rel=1e-2)
    slipping = make(replace(SMALL, slip_deg=20.0), 0).recording.encoder
    assert slipping is not None
    assert slipping.rpm == pytest.approx(720.0 - 20.0 / 6.0, abs=0.5)
    still = make(replace(SMALL, cancelled=1.0), 0).recording
    assert len(still.events) < 0.15 * len(plain.events)


def test_best_fit_of_each_model() -> None:
    assert best_fit(SMALL, "exact") == 0.0
    circle = best_fit(SMALL, "circle")
    assert 0.05 < circle < 0.5
    assert best_fit(replace(SMALL, fov_deg=30.0), "circle") < 0.5 * circle
    assert best_fit(replace(SMALL, focal_error=0.3), "exact") == 0.0


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"noise": 0.5, "width": 112, "height": 84}, ""),
        ({"hot": 0.05}, "hot pixels left out"),
        ({"lamp": 0.2, "turns": 4.0, "width": 128, "height": 96}, "flicker at 100 Hz"),
        ({"camera_deg_s": 10.0, "width": 96, "height": 72}, "the camera turned at 10.0 deg/s"),  # like a wrong scale
        ({"turns": 0.5, "width": 320, "height": 240}, ""),
        ({"window_events": 20_000}, "over the whole image"),
        ({"readout_us": 500.0}, ""),
    ],
    ids=lambda v: str(v)[:30],
)
def test_what_sharpness_alone_gets_wrong(changes: dict[str, float], says: str) -> None:
    error, warnings = error_px(replace(SMALL, **changes), 1)  # type: ignore[arg-type]
    assert error < 0.1
    assert says in warnings


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"lost": 0.9}, "--stages sharpness"),
        ({"cancelled": 0.6, "width": 320, "height": 240}, "nominal apex"),
        ({"lamp": 0.9, "width": 48, "height": 36}, "flicker"),
        ({"backwards": True, "width": 128, "height": 96}, "."),
        ({"counts_per_turn": 4, "width": 80, "height": 60}, "--stages sharpness"),
        ({"contrast": 1.0}, "."),
    ],
    ids=lambda v: str(v)[:30],
)
def test_what_cannot_be_determined_is_refused(changes: dict[str, float], reason: str) -> None:
    with pytest.raises(AmiwarpError, match=reason):
        calibrate(make(replace(SMALL, **changes), 1).recording, photometric=COARSE)  # type: ignore[arg-type]


def test_the_papers_method_on_sparse_edges() -> None:
    """It finds the circle from the phase that the hardware reports. On dense texture its cost J fails."""
    condition = replace(SMALL, scene=SceneKind.EDGES.value, fov_deg=30.0, apex_deg=2.0)
    sample = make(condition, 3)
    found = calibrate_as_paper(sample.recording, start=sample.hardware)
    assert found.model_name == "circle"
    assert found.sharpness_name == "paper_j"
    assert found.stages[0].evaluations == 3 * 11 * 11
    nominal = sample.recording.prism
    assert nominal is not None
    assert 0.35 <= found.parameters["deflection"] / nominal.deflection <= 1.65
    away = math.remainder(found.parameters["phase"] - sample.hardware["phase"], 2.0 * math.pi)
    assert abs(away) <= math.radians(45.0) * 1.3
    anywhere = calibrate_as_paper(sample.recording)
    assert anywhere.stages[0].evaluations > found.stages[0].evaluations


def test_cells_are_kept_and_only_what_misses_is_run(tmp_path: Path) -> None:
    axes = [a for a in quick_axes() if a.name == "direction"]
    small = [replace(a, also=(("width", 96), ("height", 72), ("turns", 1.5))) for a in axes]
    methods = chosen(("sharpness",))
    assert [m.name for m in methods] == ["default", "paper", "sharpness"]
    calls: list[tuple[str, float]] = []
    with single_worker() as worker:
        some = run(small, 1, methods[:1], Store(tmp_path), worker, progress=lambda *a: calls.append(a))
        assert calls == [("1 of 2 cells", 0.5), ("2 of 2 cells", 1.0)]
        every = run(small, 1, methods, Store(tmp_path), worker)
        again = run(small, 1, methods, Store(tmp_path), worker, progress=lambda *a: calls.append(a))
    assert len(calls) == 2
    name = identity(methods[0])
    for a, b, c in zip(some, every, again, strict=True):
        assert a.results[name] == b.results[name] == c.results[name]
        assert set(b.results) == {identity(m) for m in methods}
        assert all((r.error_px is None) == (r.outcome is Outcome.REFUSAL) for r in b.results.values())
    store, path = Store(tmp_path), tmp_path / f"{every[0].cell.name}.json"
    path.write_text("{")
    assert store.load(every[0].cell).results == {}
    assert [text.split(": ")[0] for text in store.damaged] == [str(path)]
    store.save(every[0])
    assert Store(tmp_path).load(every[0].cell) == every[0]
