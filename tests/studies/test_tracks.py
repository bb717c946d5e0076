"""Tracks of corners: association, truth by projection, lifetime and error with known answers."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

import amiwarp
from amiwarp.studies.evaluate import (
    Tracks,
    corner_tracks,
    lifetimes,
    link_corners,
    lives,
    quality_curve,
    track_quality,
    true_paths,
)


def two_lines(
    step_us: int = 1000, count: int = 50
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Two corners: one moves right by 0.5 px per step, one moves up, 20 px apart, in turns."""
    k = np.repeat(np.arange(count), 2)
    second = np.tile([0, 1], count)
    x = np.where(second, 40.0, 10.0 + 0.5 * k)
    y = np.where(second, 60.0 - 0.5 * k, 10.0)
    return k * step_us + second * 10, np.column_stack([x, y])


def test_corner_events_are_linked_to_their_tracks() -> None:
    t, xy = two_lines()
    found = link_corners(t, xy)
    np.testing.assert_array_equal(found.track, np.repeat([0, 1], 50))
    np.testing.assert_array_equal(
        found.index, np.concatenate([np.arange(0, 100, 2), np.arange(1, 100, 2)])
    )
    np.testing.assert_array_equal(found.xy, xy[found.index])
    np.testing.assert_array_equal(found.t, t[found.index])
    np.testing.assert_array_equal(found.first, [0, 50])


def test_a_gap_or_a_jump_starts_a_new_track() -> None:
    t, xy = two_lines()
    late = t + np.where(t > 25_000, 30_000, 0)
    assert len(link_corners(late, xy).first) == 4
    jumped = xy + np.where(t > 25_000, 7.0, 0.0)[:, None]
    assert len(link_corners(t, jumped).first) == 4
    assert len(link_corners(t, jumped, radius_px=12.0).first) == 2
    lost = xy.copy()
    lost[10:20] = np.nan
    found = link_corners(t, lost)
    assert len(found.first) == 2
    assert len(found.t) == 90


def test_the_nearest_track_is_chosen() -> None:
    xy = np.array([[10.0, 10.0], [14.0, 10.0], [12.5, 10.0], [10.5, 10.0]])
    found = link_corners(np.arange(4), xy)
    assert found.track.tolist() == [0, 0, 1, 1]
    assert found.index.tolist() == [0, 3, 1, 2]


def test_random_corners_agree_with_a_search_through_all_tracks() -> None:
    rng = np.random.default_rng(3)
    t, xy = np.sort(rng.integers(0, 400_000, 600)), rng.uniform(-5.0, 40.0, (600, 2))
    last: list[int] = []
    expected = np.zeros(600, int)
    for i in range(600):
        away = [
            math.inf if t[i] - t[k] > corner_tracks.GAP_US else math.hypot(*(xy[k] - xy[i]))
            for k in last
        ]
        best = int(np.argmin(away)) if away else 0
        if not away or away[best] > corner_tracks.RADIUS_PX:
            best = len(last)
            last.append(i)
        last[best], expected[i] = i, best
    kept = np.bincount(expected)[expected] >= 2
    found = link_corners(t, xy)
    assert len(found.t) == kept.sum() > 300
    numbers = np.unique(expected[kept])
    np.testing.assert_array_equal(numbers[found.track], expected[found.index])


def test_no_corners_give_no_tracks() -> None:
    found = link_corners(np.zeros(0, np.int64), np.zeros((0, 2)))
    assert len(found.first) == 0
    quality = track_quality(found, np.zeros((0, 2)), 5.0)
    assert quality.tracks == 0
    assert math.isnan(quality.lifetime_s)


def drifting() -> tuple[Tracks, NDArray[np.float64]]:
    """Two tracks with an update each ms for 100 ms: one drifts by 0.1 px per update, one is exact and hidden late."""
    number, k = np.repeat([0, 1], 101), np.tile(np.arange(101), 2)
    truth = np.column_stack([20.0 + k, np.full(202, 30.0)])
    xy = truth + np.where(number == 0, 0.1 * k, 0.0)[:, None] * [0.6, 0.8]
    truth[101 + 61 :] = np.nan
    return Tracks(number, k * 1000, xy, np.arange(202)), truth


def test_lifetime_error_and_rate_are_known() -> None:
    tracks, truth = drifting()
    for limit in (2.05, 5.05):
        updates = math.floor(limit * 10)
        np.testing.assert_allclose(
            lifetimes(tracks, truth, limit),
            [updates * 1e-3, 0.060],
            rtol=0,
            atol=1e-9,
        )
        quality = track_quality(tracks, truth, limit)
        assert quality.tracks == 2
        assert quality.lifetime_s == pytest.approx((updates * 1e-3 + 0.060) / 2)
        assert quality.update_hz == pytest.approx(1000.0)
        assert quality.error_px == pytest.approx(0.1 * updates * (updates + 1) / 2 / (updates + 60))
    curve = quality_curve(tracks, truth)
    assert [quality.limit_px for quality in curve] == [2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0]
    assert (np.diff([quality.lifetime_s for quality in curve]) > 0).all()


def test_a_track_does_not_return_from_its_end() -> None:
    tracks = Tracks(
        np.zeros(4, np.int64),
        np.arange(4) * 1000,
        np.array([[0, 0], [9, 0], [0, 0], [0, 0]], float),
        np.arange(4),
    )
    truth = np.zeros((4, 2))
    assert lives(tracks, truth, 5.0).tolist() == [True, False, False, False]
    assert lifetimes(tracks, truth, 5.0).tolist() == [0.0]
    assert track_quality(tracks, truth, 5.0).tracks == 0
    assert lifetimes(tracks, truth, 10.0).tolist() == [0.003]
    with pytest.raises(amiwarp.AmiwarpError, match="expected the shape of the tracks"):
        lives(tracks, truth[:2], 5.0)


def test_a_point_is_projected_where_the_camera_sees_it() -> None:
    """The camera moves right along x by 1 m/s and looks along +y at a wall 2 m away."""
    camera = amiwarp.Camera.from_fov(64, 48, 1.0)
    square = amiwarp.Mesh([[-2, 2, -2], [2, 2, -2], [2, 2, 2], [-2, 2, 2]], [[0, 1, 2], [0, 2, 3]])
    post = amiwarp.Mesh(
        [[0.25, 1, -1], [0.35, 1, -1], [0.35, 1, 1], [0.25, 1, 1]], [[0, 1, 2], [0, 2, 3]]
    )
    world = amiwarp.World("test", (amiwarp.Body("wall", square), amiwarp.Body("post", post)))
    still = amiwarp.Trajectory.still([0, 0, 0], look_at=[0, 1, 0])
    way = amiwarp.Trajectory(
        [0.0, 0.4], [[0, 0, 0], [0.4, 0, 0]], np.repeat(np.asarray(still.rotation), 2, axis=0)
    )
    simulation = amiwarp.Simulation(
        amiwarp.WorldScene(world, way), camera, amiwarp.Prism(0.01), duration_s=0.4
    )
    renderer = amiwarp.TruthRenderer(simulation)
    focal = (camera.width / 2) / math.tan(0.5)
    t = np.arange(0, 400_001, 20_000)
    tracks = Tracks(np.zeros(len(t), np.int64), t, np.zeros((len(t), 2)), np.arange(len(t)))
    place = np.array([[0.4, 2.0, 0.0]])
    truth = true_paths(tracks, place, camera, way)
    # Px
    np.testing.assert_allclose(
        truth[:, 0], 31.5 + focal * (0.4 - t * 1e-6) / 2.0, rtol=0, atol=1e-3
    )
    np.testing.assert_allclose(truth[:, 1], 23.5, rtol=0, atol=1e-3)
    seen = true_paths(tracks, place, camera, way, [renderer.at(int(k)) for k in t])
    # Where the line of sight crosses the post's plane, at half way [m]
    crossing = 0.5 * (t * 1e-6 + 0.4)
    hidden = np.isnan(seen[:, 0])
    assert hidden[abs(crossing - 0.3) < 0.02].all()
    assert not hidden[abs(crossing - 0.3) > 0.08].any()
    assert hidden.sum() >= 3
    np.testing.assert_array_equal(seen[~hidden], truth[~hidden])
    unknown = true_paths(tracks, np.full((1, 3), np.nan), camera, way)
    assert np.isnan(unknown).all()
