"""Event clouds for PyVista: every event, with its time, angle, place and truth."""

import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import amiwarp
from amiwarp import (
    AmiwarpError,
    Camera,
    Events,
    MemoryEvents,
    Prism,
    Recording,
    compensate_events,
    simulate,
)
from reference.calibration_sample import exact_calibration

LATE_US = 1 << 53
"""A time at which float64 no longer holds every microsecond [us]."""


@pytest.fixture(scope="module")
def recording(texture: np.ndarray) -> Recording:
    camera = Camera.from_fov(120, 90, math.radians(50))
    return simulate(texture, camera, Prism(math.radians(1.0)), duration_s=0.25, seed=1)


@pytest.fixture(scope="module")
def calibration(recording: Recording) -> amiwarp.Calibration:
    assert recording.camera is not None
    assert recording.truth is not None
    values = {"apex": math.radians(1.0), "phase": recording.truth.parameters["phase"]}
    return exact_calibration(recording.camera, Prism(math.radians(1.0)), values)


def test_the_clouds_hold_all_events_with_their_values(
    recording: Recording, calibration: amiwarp.Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However few events the inspector draws."""
    monkeypatch.setattr("amiwarp.viewer.inspector.MOST_EVENTS", 1000)
    monkeypatch.setattr("amiwarp.viewer.inspector.MOST_POINTS", 100)
    before, after = amiwarp.event_clouds(recording, calibration)
    events, encoder = recording.events.slice(0, len(recording.events)), recording.encoder
    assert encoder is not None
    assert before.n_points == after.n_points == len(events)
    theta = np.mod(encoder.angle_at(events.t), math.tau)
    moved = compensate_events(events, calibration.model, encoder)
    for cloud, xy in (
        (before, np.column_stack([events.x, events.y]).astype(float)),
        (after, moved),
    ):
        np.testing.assert_array_equal(cloud["index"], np.arange(len(events)))
        np.testing.assert_array_equal(cloud["t_us"], events.t - events.t[0])
        np.testing.assert_array_equal(cloud["polarity"], events.p)
        np.testing.assert_allclose(cloud["theta_rad"], theta, atol=1e-9)
        z = np.degrees(theta) * cloud.field_data["z_scale"]
        np.testing.assert_allclose(
            cloud.points, np.column_stack([xy[:, 0], -xy[:, 1], z]), atol=1e-3
        )
        assert recording.truth is not None
        assert recording.truth.stored_causes is not None
        np.testing.assert_array_equal(cloud["cause"], recording.truth.stored_causes[: len(events)])
        assert list(cloud.field_data["axes"])[2] == "(theta [deg] - z_start) * z_scale"
    assert np.nanmean(after["residual_px"]) < before["residual_px"].mean() - 0.2


def test_a_residual_is_unknown_where_the_model_moves_an_event_out(
    recording: Recording, calibration: amiwarp.Calibration
) -> None:
    """Out of the region, or of the sensor. All others are what they are in a larger region."""
    region = (20, 10, 70, 60)
    whole_before, whole_after = amiwarp.event_clouds(recording, calibration)
    before, after = amiwarp.event_clouds(recording, calibration, region=region)
    for cloud, whole in ((before, whole_before), (after, whole_after)):
        x, y = np.rint(cloud.points[:, 0]), np.rint(-cloud.points[:, 1])
        in_region = (x >= 20) & (x < 70) & (y >= 10) & (y < 60)
        np.testing.assert_array_equal(np.isfinite(cloud["residual_px"]), in_region)
        same = whole["residual_px"][np.searchsorted(whole["index"], cloud["index"])]
        np.testing.assert_allclose(cloud["residual_px"][in_region], same[in_region], atol=1e-5)
    assert np.isfinite(before["residual_px"]).all()
    assert 100 < np.count_nonzero(np.isnan(after["residual_px"])) < 0.2 * after.n_points
    x, y = np.rint(whole_after.points[:, 0]), np.rint(-whole_after.points[:, 1])
    width, height = recording.events.size
    on_sensor = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    assert not on_sensor.all()
    np.testing.assert_array_equal(np.isfinite(whole_after["residual_px"]), on_sensor)


def test_window_region_and_time_axis(
    recording: Recording, calibration: amiwarp.Calibration
) -> None:
    first = recording.events.t_first
    window, region = (first + 50_000, first + 90_000), (20, 10, 70, 60)
    before, after = amiwarp.event_clouds(
        recording, calibration, window=window, region=region, axis="time"
    )
    events = recording.events.slice(0, len(recording.events))
    chosen = np.flatnonzero((events.t >= window[0]) & (events.t < window[1])
                            & (events.x >= 20) & (events.x < 70) & (events.y >= 10) & (events.y < 60))  # fmt: skip
    np.testing.assert_array_equal(before["index"], chosen)
    np.testing.assert_array_equal(after["index"], chosen)
    t_ms = after.points[:, 2] / after.field_data["z_scale"] + after.field_data["z_start"]
    np.testing.assert_allclose(t_ms, after["t_us"] * 1e-3, atol=1e-3)
    assert after.points[:, 2].max() == pytest.approx(0.75 * 50, rel=0.01)


def test_times_are_exact_on_a_late_clock(
    recording: Recording, calibration: amiwarp.Calibration
) -> None:
    events, encoder = recording.events.slice(0, 5000), recording.encoder
    assert encoder is not None
    late = Events(events.x, events.y, events.t + LATE_US + 1, events.p)
    moved = amiwarp.Encoder(encoder.t + LATE_US + 1, encoder.angle)
    given = replace(
        recording, events=MemoryEvents(late, *recording.events.size), encoder=moved, truth=None
    )
    cloud, _ = amiwarp.event_clouds(given, calibration)
    np.testing.assert_array_equal(cloud["t_us"], events.t - events.t[0])
    assert int(cloud.field_data["t_first_us"][0]) == late.t[0]
    assert cloud["t_us"].dtype == np.int64
    assert "cause" not in cloud.point_data


def test_a_cloud_comes_back_from_a_file(
    recording: Recording, calibration: amiwarp.Calibration, tmp_path: Path
) -> None:
    import pyvista

    _, after = amiwarp.event_clouds(recording, calibration)
    after.save(tmp_path / "after.vtp")
    again = pyvista.read(tmp_path / "after.vtp")
    np.testing.assert_array_equal(again.points, after.points)
    for name in after.point_data:
        np.testing.assert_array_equal(again[name], after[name])
    assert list(again.field_data["axes"]) == list(after.field_data["axes"])


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"window": (5, 5)}, "give start and end"),
        ({"window": (-500, -100)}, "take another window"),
        ({"region": (0, 0, 500, 9)}, "in an image of 120x90 px"),
        ({"axis": "depth"}, "axis"),
    ],
)
def test_what_cannot_be_shown_is_said(
    recording: Recording, calibration: amiwarp.Calibration, given: dict[str, object], says: str
) -> None:
    with pytest.raises(AmiwarpError, match=says):
        amiwarp.event_clouds(recording, calibration, **given)  # type: ignore[arg-type]


def test_the_function_is_there_before_pyvista_is_loaded() -> None:
    code = "import sys, amiwarp; amiwarp.event_clouds; assert 'pyvista' not in sys.modules and 'vtk' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
