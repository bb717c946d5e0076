"""Recordings of the stability study, the methods that run on them, and calibration of formerly failing cases."""

import math
from concurrent.futures import Executor, Future
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest

from amiwarp import (
    AmiwarpError,
    Calibration,
    Events,
    ExactModel,
    MemoryEvents,
    calibrate,
    model_error,
)
from amiwarp.calib import calibrate_as_paper
from amiwarp.studies.cluster import Workers, single_worker
from amiwarp.studies.stability import Axis, Condition, Outcome, SceneKind, Store
from amiwarp.studies.stability.axes import AXES, conditions, quick_axes
from amiwarp.studies.stability.cells import cells_of, identity, run
from amiwarp.studies.stability.condition import sensible
from amiwarp.studies.stability.judging import best_fit, chosen, compare, deviations
from amiwarp.studies.stability.mild_troubles import TROUBLES, mild
from amiwarp.studies.stability.recordings import SimulatedSample, make, skewed
from amiwarp.studies.stability.scenes import draw
from tests.conftest import COARSE

SMALL = Condition(width=160, height=120, turns=3.0)


def error_px(condition: Condition, seed: int) -> tuple[float, str]:
    """Return the model error of the exact model's answer, and the warnings."""
    sample = make(condition, seed)
    found = calibrate(sample.recording, photometric=COARSE)
    assert sample.recording.truth is not None
    truth = ExactModel(
        condition.camera, condition.prism, sample.recording.truth.parameters["phase"]
    )
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
    assert replace(Condition(), cutoff_hz=300.0).key not in {
        Condition().key,
        replace(Condition(), cutoff_hz=100.0).key,
    }


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


def error_of_encoder(sample: SimulatedSample) -> np.ndarray:
    """Return the angle of each encoder sample minus the true one [rad]."""
    encoder = sample.recording.encoder
    assert encoder is not None
    return np.asarray(encoder.angle - sample.motion.angle(encoder.t))


def test_troubles_of_encoder_and_speed_are_made() -> None:
    wrong = error_of_encoder(make(replace(SMALL, eccentric_deg=3.0, second_deg=1.0), 0))
    assert np.degrees(np.abs(wrong).max()) == pytest.approx(3.5, abs=0.5)
    assert np.degrees(wrong.std()) == pytest.approx(math.hypot(3.0, 1.0) / math.sqrt(2.0), rel=0.05)
    pulses = make(replace(SMALL, turn_ripple=0.1, index_only=True), 0)
    assert np.abs(error_of_encoder(pulses)).max() < 1e-4
    middle = pulses.recording.encoder
    assert middle is not None
    assert np.unique(np.round(np.diff(middle.angle) / (2.0 * math.pi), 9)) == 1.0
    t = np.arange(0, 200_000, 100)
    ripple = middle.angle_at(t) - pulses.motion.angle(t)
    assert np.ptp(ripple) == pytest.approx(2 * 0.1, rel=0.02)  # rad: 0.1 of the speed, once a turn
    rising = make(replace(SMALL, ramp=1.0, no_encoder=True), 0)
    assert rising.recording.encoder is None
    assert rising.motion.angle([SMALL.duration_s * 1e6])[0] == pytest.approx(
        math.pi * SMALL.turns, rel=1e-3
    )


def test_troubles_of_prism_camera_and_readout_are_made() -> None:
    plain = make(SMALL, 0)
    truth = make(replace(SMALL, cylinder_deg=0.1, wobble_deg=2.0, index_error=0.06), 0)
    assert np.degrees(math.hypot(*truth.truth.cylinder)) == pytest.approx(0.05, abs=1e-9)
    assert np.degrees(math.hypot(*truth.truth.wobble)) == pytest.approx(2.0, abs=1e-9)
    assert truth.recording.prism is not None
    assert truth.truth.prism.index - truth.recording.prism.index == pytest.approx(0.06, abs=1e-12)
    wide = make(replace(SMALL, aspect_error=0.03), 0)
    assert wide.truth.camera.fy == pytest.approx(1.03 * wide.truth.camera.fx, abs=1e-9)
    assert wide.recording.camera is not None
    assert wide.recording.camera.fy == wide.recording.camera.fx == wide.truth.camera.fx
    some = make(replace(SMALL, lost_part=0.4), 0)
    hits = np.histogram(
        some.motion.angle(some.recording.events.slice(0, 10**9).t) % (2.0 * math.pi),
        20,
        (0.0, 2.0 * math.pi),
    )[0]
    assert 7 <= (hits == 0).sum() <= 8
    events = plain.recording.events.slice(0, 10**9)
    late = skewed(events, replace(SMALL, column_us=5.0, line_us=10.0))
    assert (np.diff(late.t) >= 0).all()
    np.testing.assert_array_equal(
        np.sort(late.t - 5 * late.x.astype(int) - 10 * late.y.astype(int)), events.t
    )
    assert late.t.mean() - events.t.mean() == pytest.approx(
        5.0 * events.x.mean() + 10.0 * events.y.mean(), abs=1e-6
    )
    assert len(make(replace(SMALL, row_us=20.0), 0).recording.events) < len(plain.recording.events)


def calibrated(sample: SimulatedSample, **changes: float) -> Calibration:
    """Return a calibration of the true values, with changes."""
    truth = sample.truth
    values = {"apex": truth.prism.apex, "phase": truth.phase} | changes
    return Calibration(
        model_name="exact", camera=truth.camera, prism=truth.prism, parameters=values,
        uncertainty={"apex": 1e-4, "phase": 1e-3}, free=("apex", "phase"), sharpness_name="variance",
        sharpness_before=1.0, sharpness_after=2.0, stages=(), events=1, seconds=1.0,
    )  # fmt: skip


def test_the_error_includes_the_encoder_and_not_a_constant_lag() -> None:
    narrow = replace(SMALL, fov_deg=20.0)
    right, sample = make(narrow, 0), make(replace(narrow, eccentric_deg=3.0), 0)
    assert compare(calibrated(right, phase=right.truth.phase - 0.2), right).rms < 1e-3
    assert compare(calibrated(right), right).lag == pytest.approx(0.0, abs=1e-6)
    large = calibrated(right, apex=1.02 * right.truth.prism.apex, phase=right.truth.phase - 0.3)
    assert compare(large, right).rms == pytest.approx(
        model_error(large.model, right.truth).rms, rel=0.01
    )
    assert compare(large, right).gain == pytest.approx(0.02, abs=1e-4)
    assert compare(large, right).lag == pytest.approx(0.3, abs=1e-3)
    wrong = calibrated(sample)
    # a harmonic of amplitude a moves events by a times the radius of the orbit, of which its rms is 1 / sqrt 2
    radius = sample.truth.camera.fx * sample.truth.prism.deflection
    assert compare(wrong, sample).rms == pytest.approx(
        math.radians(3.0) / math.sqrt(2.0) * radius, rel=0.05
    )
    true = sample.motion.angle(np.arange(0, 83_000, 100))
    assert sample.plain is not None
    error = sample.plain.angle_at(np.arange(0, 83_000, 100)) - true
    found = np.linalg.lstsq(np.stack([np.cos(true), np.sin(true)], axis=1), -error, rcond=None)[0]
    corrected = compare(replace(wrong, harmonics=(*found, 0.0, 0.0)), sample)
    assert corrected.rms < 0.05 * compare(wrong, sample).rms


def test_deviations_are_those_that_were_made() -> None:
    sample = make(SMALL, 0)
    found = calibrated(sample, apex=sample.truth.prism.apex + 2e-4, phase=sample.truth.phase - 3e-3)
    known = deviations(found, replace(SMALL, timing_known=True), sample)
    assert known == pytest.approx({"apex": 2.0, "phase": 3.0, "size": 2.0}, abs=0.05)
    assert set(deviations(found, SMALL, sample)) == {"apex", "size"}


def test_random_combinations_are_mild_and_different() -> None:
    drawn = [mild(seed) for seed in range(40)]
    assert drawn == [mild(seed) for seed in range(40)]
    assert len(set(drawn)) == 40
    assert all(sensible(c, 100_000) for c in drawn)
    counts = [sum(getattr(c, name) != 0 for name in TROUBLES) for c in drawn]
    assert 2.0 < np.mean(counts) < 4.0
    assert max(counts) >= 5
    cells = cells_of([a for a in AXES if a.name == "wobble"], 2, first=3, draws=4)
    assert [c.seed for c in cells] == [0, 1, 2, 3, *[3] * 5, *[4] * 5]


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
        # Like a wrong scale
        (
            {"camera_deg_s": 10.0, "width": 96, "height": 72},
            "the camera turned at 10.0 deg/s",
        ),
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
        ({"cancelled": 0.6, "width": 320, "height": 240}, "shakes with the prism"),
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


@pytest.mark.parametrize("ramp", [0.0, 0.5])
def test_the_papers_method_without_an_encoder(ramp: float) -> None:
    """Its result gives the angle of the prism over the recording, in either sense of rotation."""
    condition = replace(SMALL, scene=SceneKind.EDGES.value, fov_deg=30.0, apex_deg=2.0, turns=8.0)
    condition = replace(condition, no_encoder=True, ramp=ramp)
    sample = make(condition, 2)
    assert sample.hardware == {}
    events = sample.recording.events.slice(0, len(sample.recording.events))
    mirrored = Events(condition.width - 1 - events.x, events.y, events.t, events.p)
    first, last = int(events.t[0]), int(events.t[-1])
    true = float(np.ptp(sample.motion.angle(np.array([first, last]))))
    for seen, sense in ((events, 1.0), (mirrored, -1.0)):
        source = MemoryEvents(seen, condition.width, condition.height)
        found = calibrate_as_paper(replace(sample.recording, events=source))
        assert found.model_name == "circle"
        start, end = found.encoder_for(None, first, last).angle_at(np.array([first, last]))
        assert end - start == pytest.approx(sense * true, abs=0.3)  # rad, of eight turns or six
    assert math.isfinite(compare(calibrate_as_paper(sample.recording), sample).rms)


class Killed(Executor):
    """Executor that runs its jobs at once, and whose first job ends with an error as of a worker that died."""

    def __init__(self, error: BaseException) -> None:
        self.errors = [error]

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        if self.errors:
            future.set_exception(self.errors.pop())
        else:
            future.set_result(fn(*args, **kwargs))
        return future


def test_a_worker_that_dies_fails_its_cell_alone_and_the_cell_is_run_again(tmp_path: Path) -> None:
    small = [Axis("width", "width", (48, 64), also=(("height", 48), ("turns", 1.0)))]
    cells, methods = cells_of(small, 1), chosen(("sharpness",))[1:]
    dead = type("KilledWorker", (Exception,), {})("cell-1")
    first = run(cells, methods, Store(tmp_path), Workers(Killed(dead), lambda: 1))
    assert {r.message for r in first[0].results.values()} == {
        "its worker died, out of memory or killed: KilledWorker: cell-1"
    }
    assert [{r.outcome is Outcome.FAILED for r in stored.results.values()} for stored in first] == [
        {True},
        {False},
    ]
    assert Store(tmp_path).load(cells[0]) == first[0]
    with single_worker() as worker:
        again = run(cells, methods, Store(tmp_path), worker)
    assert [stored.events > 0 for stored in again] == [True, True]
    assert again[1] == first[1]
    assert all(r.outcome is not Outcome.FAILED for stored in again for r in stored.results.values())
    assert set(again[0].results) == {identity(m) for m in methods}

    more = chosen(("sharpness", "gradient"))[1:]
    lost = run(cells, more, Store(tmp_path), Workers(Killed(dead), lambda: 1))[0]
    assert lost.events == again[0].events
    assert [lost.results[identity(m)] for m in methods] == [
        again[0].results[identity(m)] for m in methods
    ]
    assert lost.lacks(more[-1])


def test_an_interrupt_and_a_lost_scheduler_end_the_study(tmp_path: Path) -> None:
    cells, methods = (
        cells_of([Axis("width", "width", (48,), also=(("height", 48),))], 1),
        chosen(("sharpness",)),
    )
    with pytest.raises(KeyboardInterrupt):
        run(cells, methods, Store(tmp_path), Workers(Killed(KeyboardInterrupt()), lambda: 1))
    dropped: Future[Any] = Future()
    dropped.cancel()
    dropped.set_running_or_notify_cancel()
    with (
        mock.patch.object(Killed, "submit", return_value=dropped),
        pytest.raises(
            AmiwarpError,
            match="the scheduler stopped or dropped the work; run the same command again",
        ),
    ):
        run(cells, methods, Store(tmp_path), Workers(Killed(KeyboardInterrupt()), lambda: 1))
    assert list(tmp_path.iterdir()) == []


def test_cells_are_kept_and_only_what_misses_is_run(tmp_path: Path) -> None:
    axes = [a for a in quick_axes() if a.name == "direction"]
    small = [replace(a, also=(("width", 96), ("height", 72), ("turns", 1.5))) for a in axes]
    methods = chosen(("sharpness",))
    assert [m.name for m in methods] == ["default", "paper", "sharpness"]
    calls: list[tuple[str, float]] = []
    with single_worker() as worker:
        some = run(
            cells_of(small, 1),
            methods[:1],
            Store(tmp_path),
            worker,
            progress=lambda *a: calls.append(a),
        )
        assert calls == [("1 of 2 cells", 0.5), ("2 of 2 cells", 1.0)]
        every = run(cells_of(small, 1), methods, Store(tmp_path), worker)
        again = run(
            cells_of(small, 1),
            methods,
            Store(tmp_path),
            worker,
            progress=lambda *a: calls.append(a),
        )
    assert len(calls) == 2
    name = identity(methods[0])
    for a, b, c in zip(some, every, again, strict=True):
        assert a.results[name] == b.results[name] == c.results[name]
        assert set(b.results) == {identity(m) for m in methods}
        assert all(
            (r.error_px is None) == (r.outcome is Outcome.REFUSAL) for r in b.results.values()
        )
    store, path = Store(tmp_path), tmp_path / f"{every[0].cell.name}.json"
    path.write_text("{")
    assert store.load(every[0].cell).results == {}
    assert [text.split(": ")[0] for text in store.damaged] == [str(path)]
    store.save(every[0])
    assert Store(tmp_path).load(every[0].cell) == every[0]
