"""Clocks of camera and controller in simulated time, with the troubles of a rig: no measured angle is ever wrong."""

from __future__ import annotations

from dataclasses import replace

import pytest

from benchmarks.clocks import Troubles, draw, run, summary

QUIET = Troubles(
    seconds=12.0,
    serial_delay_us=0,
    camera_delay_us=0,
    stalls=(),
    lost=0.0,
    trigger_cable=(0, 0),
    camera_returns_us=-1,
    faults=(),
    drift_ppm=80.0,
    regular=False,
)


@pytest.mark.parametrize(
    ("changes", "paired_by_s", "least_measured"),
    [
        pytest.param({}, 1.0, 0.99, id="nothing"),
        pytest.param({"camera_delay_us": 4_900_000}, 5.8, 0.55, id="camera late", marks=pytest.mark.slow),
        pytest.param({"serial_delay_us": 4_900_000}, 5.8, 0.55, id="controller late", marks=pytest.mark.slow),
        pytest.param(
            {"lost": 0.3, "faults": ("reset@5",)}, 3.0, 0.8, id="lost pulses and a reset", marks=pytest.mark.slow
        ),
        pytest.param(
            {"trigger_cable": (4_000_000, 9_000_000), "camera_delay_us": 300_000}, 1.5, 0.9, id="pulled cable",
            marks=pytest.mark.slow,
        ),
        pytest.param({"camera_returns_us": 6_000_000}, 1.0, 0.85, id="camera restarts", marks=pytest.mark.slow),
        pytest.param(
            {"stalls": tuple((k * 900_000, k * 900_000 + 700_000) for k in range(12))}, 2.0, 0.8, id="busy computer",
            marks=pytest.mark.slow,
        ),
    ],
)  # fmt: skip
def test_measured_angles_are_right(
    changes: dict[str, object], paired_by_s: float, least_measured: float
) -> None:
    outcome = run(1, replace(QUIET, **changes))  # type: ignore[arg-type]
    assert outcome.wrong == 0
    assert outcome.paired_s is not None
    assert outcome.paired_s <= paired_by_s
    assert outcome.measured >= least_measured
    assert outcome.error_us is not None
    assert outcome.error_us <= 1.0


def test_angles_by_regular_pulses_never_count_as_measured() -> None:
    """The camera's reports are late by more than half an interval, by which pulses of neighbours would be paired."""
    outcome = run(2, replace(QUIET, regular=True, camera_delay_us=70_000, seconds=6.0))
    assert (outcome.measured, outcome.wrong, outcome.paired_s) == (0.0, 0, None)
    assert any("older controller" in message for message in outcome.messages)


def test_a_wrong_clock_would_be_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the camera's times 2 ms late behind the judge's back."""
    from benchmarks import clocks

    true_time = clocks.SimulatedCamera.time
    monkeypatch.setattr(
        clocks.SimulatedCamera,
        "world_time",
        lambda self, t: (t - 2000 - true_time(self, 0)) / (1.0 + self._drift),
    )
    outcome = run(1, replace(QUIET, seconds=3.0))
    assert outcome.wrong > 1000
    assert outcome.worst_us == pytest.approx(2000.0, abs=50.0)
    assert summary([outcome])["wrong_runs"] == 1


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1000, 1006))
def test_no_run_with_drawn_troubles_has_a_wrong_angle(seed: int) -> None:
    assert run(seed).wrong == 0, draw(seed)
