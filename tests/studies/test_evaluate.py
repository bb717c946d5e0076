"""Evaluations of the AMI-EV paper: measures on cases with a known answer, cells, and the report."""

import json
import math
import os
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from scipy.spatial.distance import cdist
from scipy.special import ndtr

import amiwarp
from amiwarp import SensorModel
from amiwarp.cli.common import made_again
from amiwarp.io.finished_work import sealed
from amiwarp.studies import cluster
from amiwarp.studies.cluster import single_worker
from amiwarp.studies.evaluate import (
    QUICK,
    CellResult,
    Condition,
    Frames,
    Setup,
    Stream,
    Streams,
    Table,
    Verdict,
    apex_speed,
    corners,
    evaluation,
    fading,
    link_corners,
    project,
    seen_places,
    texture,
    track_frames,
)
from amiwarp.studies.evaluate.catalogue import EVALUATIONS, load
from amiwarp.studies.evaluate.conditions import DISCS, IDEAL
from amiwarp.studies.evaluate.discs import DiscTarget, robust_spread
from amiwarp.studies.evaluate.edge_agreement import Counts, best_f, binary_entropy, match
from amiwarp.studies.evaluate.evaluation import _run
from amiwarp.studies.evaluate.evenness import density_variance, event_counts
from amiwarp.studies.evaluate.jobs import Job, JobResult, Store, plan, run_job
from amiwarp.studies.evaluate.report import section, write
from amiwarp.studies.evaluate.results import grouped
from amiwarp.studies.evaluate.stored_pictures import encode_picture
from amiwarp.studies.evaluate.streams import EXPOSURE_US, RecordedStreams, sensor_delay
from amiwarp.studies.evaluate.true_edges import geometric_edges
from amiwarp.tasks import silent
from reference.mutation_files import stored_edges, stored_fading

SMALL = replace(QUICK, width=64, height=48, duration_s=0.1, seeds=1)


def poisson(rate: float, size: tuple[int, int], seed: int) -> np.ndarray:
    """Return the places of a Poisson process of ``rate`` events/px² in an image."""
    rng = np.random.default_rng(seed)
    width, height = size
    n = rng.poisson(rate * width * height)
    return rng.uniform(-0.5, [width - 0.5, height - 0.5], (n, 2))


def variance(places: np.ndarray, size: tuple[int, int], h: float) -> float:
    """Return the variance of the density at places, shape (n, 2)."""
    return density_variance(event_counts(*places.T, size), h)


@pytest.mark.parametrize(("rate", "h"), [(0.1, 3.0), (1.0, 3.0), (0.5, 5.0)])
def test_density_of_a_poisson_process(rate: float, h: float) -> None:
    size = (320, 240)
    found = np.mean([variance(poisson(rate, size, seed), size, h) for seed in range(4)])
    own = 1.0 / (2.0 * math.pi * h**2)
    expected = rate / (4.0 * math.pi * h**2) / (rate + own) ** 2
    assert found == pytest.approx(expected, rel=0.12)


@pytest.mark.parametrize(("h", "bound"), [(1.0, 0.05), (3.0, 0.01)])
def test_density_agrees_with_the_sum_over_pairs(h: float, bound: float) -> None:
    """Uneven places: the sum of the kernel over all pairs, by the part of the kernel in the image."""
    size = (48, 36)
    places = poisson(3.0, size, 1)
    places = places[
        np.random.default_rng(2).random(len(places)) < 0.2 + 0.8 * (np.sin(0.4 * places[:, 0]) > 0)
    ]
    for given in (places, np.rint(places).clip(0, np.array(size) - 1)):
        pairs = np.exp(-np.sum((given[:, None] - given) ** 2, axis=2) / (2.0 * h * h)).sum(axis=1)
        reach = [(np.array([-0.5, n - 0.5]) - given[:, k, None]) / h for k, n in enumerate(size)]
        share = np.prod([np.diff(ndtr(r), axis=1)[:, 0] for r in reach], axis=0)
        density = pairs / share
        assert variance(given, size, h) == pytest.approx(
            np.var(density / density.mean()), rel=bound
        )


def test_density_of_a_regular_grid_is_even() -> None:
    x, y = np.meshgrid(np.arange(64.0), np.arange(48.0))
    assert variance(np.stack([x.ravel(), y.ravel()], axis=1), (64, 48), 3.0) < 1e-5


def test_density_of_half_an_image() -> None:
    """Events in two halves of rates 1 : 3 have two densities: 0.4 and 1.2 times their mean."""
    rng = np.random.default_rng(0)
    size, n = (4000, 40), 300_000
    left = rng.random(n) < 0.25
    x = np.where(left, rng.uniform(-0.5, 1999.5, n), rng.uniform(1999.5, 3999.5, n))
    places = np.stack([x, rng.uniform(-0.5, 39.5, n)], axis=1)
    assert variance(places, size, 3.0) == pytest.approx(0.25 * 0.6**2 + 0.75 * 0.2**2, abs=0.01)


def line(column: int, shape: tuple[int, int] = (40, 60)) -> np.ndarray:
    """Return an image with a vertical line."""
    mask = np.zeros(shape, np.bool_)
    mask[:, column] = True
    return mask


@pytest.mark.parametrize("shift", [0, 1, 2, 5])
def test_f_score_of_a_shifted_line(shift: int) -> None:
    tolerances = (1.0, 2.0, 4.0, 6.0)
    for tolerance, matched in zip(
        tolerances, match(line(20 + shift), line(20), tolerances), strict=True
    ):
        assert matched.sum() == (40 if shift <= tolerance else 0)
        assert not matched[:, :20].any()


def test_pixels_match_one_to_one() -> None:
    thick = line(19) | line(20) | line(21)
    (matched,) = match(thick, line(20), [3.0])
    counts = Counts(*(np.array([n]) for n in (matched.sum(), thick.sum(), 40)))
    assert best_f(counts) == (0, pytest.approx(2 * 40 / (120 + 40)))
    assert counts.precision[0] == pytest.approx(1 / 3)
    assert counts.recall[0] == 1.0
    (matched,) = match(line(20), thick, [3.0])
    assert matched.sum() == 40


def test_as_many_pairs_as_possible_are_found() -> None:
    """The number of pairs is that of augmenting paths, which the test searches itself."""
    rng = np.random.default_rng(0)
    found, true = (rng.random((24, 32)) < 0.15 for _ in range(2))
    tolerances = (3.0, 1.0)
    for tolerance, matched in zip(tolerances, match(found, true, tolerances), strict=True):
        near = cdist(np.argwhere(true), np.argwhere(found)) <= tolerance
        partner: dict[int, int] = {}

        def augment(k: int, near: np.ndarray, partner: dict[int, int], seen: set[int]) -> bool:
            for j in np.flatnonzero(near[k]).tolist():
                if j not in seen:
                    seen.add(j)
                    if j not in partner or augment(partner[j], near, partner, seen):
                        partner[j] = k
                        return True
            return False

        largest = sum(augment(k, near, partner, set()) for k in range(len(near)))
        assert matched.sum() == largest
        assert not (matched & ~true).any()
        assert near[matched[true]].any(axis=1).all()


def test_entropy_of_binary_images() -> None:
    assert binary_entropy(np.zeros((4, 4), np.bool_)) == 0.0
    assert binary_entropy(np.eye(2, dtype=np.bool_)) == 1.0


@pytest.fixture(scope="module")
def streams() -> Streams:
    return Streams(
        Condition(width=64, height=48, duration_s=0.1, trajectory="handheld"),
        setup=Setup(None, 200.0, 0.0),
    )


def test_streams_belong_together(streams: Streams) -> None:
    raw, true = (streams.window(s, 0, streams.end_us) for s in (Stream.RAW, Stream.TRUE))
    assert raw.whole_pixels
    assert not true.whole_pixels
    assert len(raw) == streams.count(Stream.RAW, 0, streams.end_us) >= len(true) > 0
    points = streams.event_truth(Stream.TRUE, 0, streams.end_us).points
    assert points is not None
    apart = np.hypot(true.x - points[:, 0], true.y - points[:, 1])
    assert np.nanmedian(apart) < 0.3  # px: half a pixel of quantisation and the sensor's delay


def test_windows_hold_the_events_of_their_time(streams: Streams) -> None:
    for stream in (Stream.PLAIN, Stream.TRUE, Stream.RAW):
        events = streams.window(stream, 20_000, 50_000)
        assert len(events)
        assert 20_000 <= events.t[0] <= events.t[-1] < 50_000


def test_the_same_count(streams: Streams) -> None:
    wanted = streams.count(Stream.RAW, 40_000, 42_000)
    found = streams.window(Stream.SAME_COUNT, 40_000, 42_000)
    assert len(found) == min(wanted, len(streams.plain.events))
    assert (np.diff(found.t) >= 0).all()
    cause = streams.event_truth(Stream.SAME_COUNT, 40_000, 42_000).cause
    assert cause is not None
    assert len(cause) == len(found)


def test_geometric_edges_lie_between_instances(streams: Streams) -> None:
    frame = streams.frame(50_000)
    edges = geometric_edges(frame)
    assert 0 < edges.mean() < 0.4
    flat = replace(frame, instance=np.ones_like(frame.instance), depth=np.ones_like(frame.depth),
                   normal=np.broadcast_to(np.float32([0, 0, 1]), frame.normal.shape))  # fmt: skip
    assert not geometric_edges(flat).any()


def test_a_recording_without_truth() -> None:
    rng = np.random.default_rng(0)
    n = 20_000
    events = amiwarp.Events.from_arrays(
        rng.integers(0, 64, n),
        rng.integers(0, 48, n),
        np.sort(rng.integers(0, 100_000, n)),
        rng.integers(0, 2, n),
    )
    recording = amiwarp.Recording(amiwarp.MemoryEvents(events, 64, 48))
    found = texture.measure(RecordedStreams(recording), SMALL)
    assert found["rates"][0] == {"stream": "S-EV", "rate": pytest.approx(n / 100_000, rel=1e-3)}
    (row,) = [r for r in found["rows"] if (r["h"], r["window"]) == (3.0, 33.0)]
    rate = n * 0.33 / (64 * 48)
    assert row["variance"] == pytest.approx(
        rate / (36 * math.pi) / (rate + 1 / (18 * math.pi)) ** 2, rel=0.25
    )


def test_a_frame_is_the_mean_over_its_exposure() -> None:
    """8 bits of the mean of renders by a simulation's own frame truth, at twice as many moments."""
    streams = Streams(Condition(width=64, height=48, duration_s=0.1, trajectory="fast"))
    middle = int(streams.exposures(Frames.FAST)[2])
    moments = middle + EXPOSURE_US * ((np.arange(24) + 0.5) / 24 - 0.5)
    truth = amiwarp.TruthRenderer(streams.simulation)
    renders = [truth.at(round(t)).intensity.astype(np.float64) for t in moments]
    grey = streams.grey_frame(middle)
    assert grey.dtype == np.uint8
    blurred, sharp = (streams._white * np.clip(np.array(image) / streams._white, 0.0, 1.0)
                      for image in (np.mean(renders, axis=0), renders[12]))  # fmt: skip
    errors = [np.abs(streams.frame_luminance(middle) - image).mean() for image in (blurred, sharp)]
    assert errors[0] < 0.01
    assert errors[1] > 3.0 * errors[0]
    stated = (grey / 255.0) ** 2.2 * streams._white
    np.testing.assert_allclose(streams.frame_luminance(middle), stated, rtol=1e-12)


def test_frames_are_complete_when_they_are_used() -> None:
    streams = Streams(Condition(width=64, height=48, duration_s=0.25, seed=3))
    for camera, count in ((Frames.SLOW, 7), (Frames.FAST, 14)):
        middles = streams.exposures(camera)
        assert len(middles) in (count, count + 1)
        assert set(np.diff(middles)) == {camera.interval_us}
        assert middles[0] >= EXPOSURE_US / 2
        assert middles[-1] + EXPOSURE_US / 2 <= streams.end_us
        assert streams.last_exposure(camera, int(middles[2]) + EXPOSURE_US // 2) == middles[2]
        assert streams.last_exposure(camera, int(middles[2]) + EXPOSURE_US // 2 - 1) == middles[1]
        assert streams.last_exposure(camera, int(middles[0])) is None


def test_a_still_camera_is_rendered_once() -> None:
    streams = Streams(Condition(width=64, height=48, duration_s=0.1, trajectory="still"))
    render = mock.Mock(side_effect=streams._truth.luminance)
    with mock.patch.object(streams._truth, "luminance", render):
        first, last = (streams.grey_frame(int(t)) for t in streams.exposures(Frames.FAST)[[0, -1]])
    assert render.call_count == 1
    np.testing.assert_array_equal(first, last)


def test_the_prism_is_calibrated_once_and_the_calibration_reused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Recordings of two seeds and lenses begin at other angles of one prism, which a third one is calibrated from."""
    monkeypatch.setattr("amiwarp.studies.evaluate.conditions.SETUP_S", 0.2)
    calls: list[str] = []

    def counted(recording: amiwarp.Recording, settings: Any, **options: Any) -> amiwarp.Calibration:
        calls.append("called")
        return amiwarp.calibrate(recording, settings, **options)

    monkeypatch.setattr("amiwarp.studies.evaluate.streams.calibrate", counted)
    lenses = (554.0, 200.0)  # px
    conditions = [
        Condition(width=96, height=72, duration_s=0.05, seed=k, focal_px=lenses[k - 1])
        for k in (1, 2)
    ]
    assert conditions[0].setup == conditions[1].setup
    found = [Streams(condition) for condition in conditions]
    for streams in found:
        assert Stream.CALIBRATED in streams.names
        assert Stream.SELF not in streams.names
        calibration, condition = streams.calibration, streams.condition
        assert calibration is not None
        lag = math.remainder(condition.phase - calibration.parameters["phase"], 2.0 * math.pi)
        assert 0.0 < lag < 0.2  # rad: the delay of the sensor, up to 2.6 ms at 720 turns/min
        assert calibration.parameters["apex"] == pytest.approx(condition.apex, rel=0.05)
        apart = [streams.window(s, 0, streams.end_us) for s in (Stream.CALIBRATED, Stream.TRUE)]
        assert np.abs(np.subtract(apart[0].x[-100:], apart[1].x[-100:])).max() < 0.3  # px
    assert calls == ["called"]
    assert found[0].setup is found[1].setup


@pytest.mark.parametrize("rpm", [720.0, 1440.0])
def test_the_delay_of_a_sensor_is_found(rpm: float) -> None:
    """A sensor that only is late differs from an ideal one by its latency, at any speed; 80 us are 0.02 to 0.03 px."""
    delay = {}
    for only in (IDEAL, "latency jitter"):
        condition = Condition(
            width=96, height=72, duration_s=0.1, trajectory="still", rpm=rpm, only=only
        )
        delay[only] = sensor_delay(Streams(condition))
    assert 0.0 <= delay[IDEAL] < 300.0  # us: up to 0.04 px by the rounding to pixels
    latency = SensorModel.preset("dvxplorer").latency_us
    assert delay["latency jitter"] - delay[IDEAL] == pytest.approx(latency, abs=80.0)


def test_corners_of_shifted_frames() -> None:
    """Squares that move by 3 px per frame are tracked, and a new one starts a new track."""
    grey = np.full((6, 80, 120), 40, np.uint8)
    for k in range(6):
        grey[k, 20:35, 10 + 3 * k : 25 + 3 * k] = 200
        if k >= 3:
            grey[k, 50:65, 60:75] = 220
    tracks = track_frames(list(grey), [k * 10_000 for k in range(6)])
    begin, last = tracks.first, np.append(tracks.first[1:], len(tracks.t)) - 1
    moved = (tracks.xy[last] - tracks.xy[begin]) / np.maximum(
        tracks.index[last] - tracks.index[begin], 1
    )[:, None]
    first = tracks.index[begin] == 0
    assert first.sum() == 4
    np.testing.assert_allclose(moved[first], [[3.0, 0.0]] * 4, rtol=0, atol=0.1)  # px
    np.testing.assert_allclose(
        moved[tracks.index[begin] == 3][:4], [[0.0, 0.0]] * 4, rtol=0, atol=0.1
    )
    np.testing.assert_array_equal(tracks.t, tracks.index * 10_000)


def test_places_that_a_camera_sees(streams: Streams) -> None:
    """Seen points project to where they were seen."""
    scene = streams.simulation.scene
    assert isinstance(scene, amiwarp.WorldScene)
    xy = np.array([[10.0, 20.0], [40.0, 30.0]])
    places = seen_places(
        streams.frame(50_000), streams.camera, scene.trajectory, xy, [50_000, 50_000]
    )
    found, depth = project(streams.camera, scene.trajectory, places, [50_000, 50_000])
    np.testing.assert_allclose(found, xy, rtol=0, atol=1e-3)  # px
    np.testing.assert_allclose(depth, streams.frame(50_000).depth[[20, 30], [10, 40]], rtol=1e-5)


def test_corners_at_random_places_are_joined_within_the_radius(streams: Streams) -> None:
    """Where corners are dense, the tracker's radius of 3 px alone gives errors of about 2 px and many tracks."""
    t = np.sort(np.random.default_rng(0).integers(0, streams.end_us, 20_000))
    frames = [streams.frame(t_us) for t_us in (0, 50_000, 99_999)]
    row = next(
        r for r in corners._chance_quality(streams, t, frames) if r["limit"] == corners.LIMIT_PX
    )
    assert 1.5 < row["error_px"] < 3.0
    assert row["number"] > 100
    tracks = link_corners(t, np.random.default_rng(1).uniform(-0.5, [63.5, 47.5], (len(t), 2)))
    curve = corners._curve(streams, tracks, corners._begun_on(streams, tracks, frames), frames)
    expected = curve[3]["lifetime_ms"] * 1e-3 * len(tracks.first) / (streams.end_us * 1e-6)
    assert curve[3]["alive"] == pytest.approx(expected)


def test_fading_classes() -> None:
    counts, speeds = np.array([[10.0, 100.0], [30.0, 100.0]]), np.array([[0.1, 1.1], [1.1, 1.1]])
    rows = {r["speed"]: r["rate"] for r in fading._classes(10 * counts, speeds)}
    assert rows[0.125] == 0.5
    assert rows[1.125] == pytest.approx((1.5 + 1.0 + 1.0) / 3)


def test_grouped_rows() -> None:
    rows = [{"a": 1, "v": 1.0}, {"a": 1, "v": 3.0}, {"a": 2, "v": None}]
    assert grouped(rows, ["a"], ["v"]) == [(1, 2, 2.0, 1.0), (2, 1, None, None)]


def test_corners_of_uncompensated_events_leave_the_truth() -> None:
    condition = Condition(width=64, height=48, duration_s=0.08, apex=math.radians(1.0))
    streams = Streams(condition, setup=Setup(None, 0.0, 0.0))
    result = corners.measure(streams, QUICK)
    lives = {
        (row["detector"], row["stream"]): row["lifetime_ms"]
        for row in result["rows"]
        if row["limit"] == corners.LIMIT_PX
    }
    for detector in ("efast", "arc"):
        assert lives[detector, Stream.TRUE.value] > 5.0
        assert lives[detector, Stream.TRUE.value] > 5.0 * lives[detector, Stream.RAW.value]
    assert {row["gap"] for row in result["gaps"]} == {10.0, 25.0, 50.0}
    cell = CellResult("corners", condition, result)
    table = corners.tables([cell])[0]
    assert {row[2] for row in table.rows} == {"efast", "arc", "frames"}
    assert json.loads(json.dumps(result, allow_nan=False)) == result


@pytest.mark.parametrize("name", EVALUATIONS)
def test_every_evaluation_keeps_the_contract(name: str) -> None:
    evaluation = load(name)
    assert evaluation.TITLE
    assert evaluation.PROTOCOL
    assert evaluation.DIFFERENCES
    assert {c.seed for c in evaluation.conditions(QUICK)} == {1, 2}
    assert {c.verdict for c in evaluation.claims([])} <= {Verdict.NOT_TESTABLE}


def test_a_quick_run_holds_every_evaluation() -> None:
    jobs = plan(EVALUATIONS, QUICK, [])
    assert {name for job in jobs for name in job.evaluations} == set(EVALUATIONS)
    for job in jobs:
        calibrated = not set(job.evaluations) <= {"apex_speed", "fading", "convexity"}
        assert (job.setup_condition is not None) == calibrated
    setups = {c for job in jobs if (c := job.setup_condition) is not None}
    # Seeds, scenes and lenses share them
    assert sorted(c.apex for c in setups) == [
        math.radians(0.5),
        math.radians(1.0),
    ]


def test_a_missing_scheduler_library_names_the_extra_of_the_evaluation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(
        amiwarp.AmiwarpError,
        match=r"'amiwarp evaluate' needs Dask; run: pip install 'amiwarp\[evaluate\]'",
    ):
        amiwarp.evaluate(tmp_path / "evaluation", only=["texture"], seeds=1, workers=2)


def test_the_number_of_workers_is_limited_by_cores_and_memory(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(cluster, "cpu_threads", lambda: 6)
    monkeypatch.setattr(cluster, "gpu_count", lambda _: 2)
    assert [cluster.worker_count(None, device) for device in ("cpu", "cuda", "cuda:1")] == [6, 6, 1]
    monkeypatch.setattr("distributed.system.MEMORY_LIMIT", 10 << 30)
    assert [cluster.worker_count(n, "cpu", 4 << 30) for n in (None, 5)] == [2, 5]
    assert cluster.worker_count(None, "cuda", 20 << 30) == 1


def test_jobs_share_conditions() -> None:
    jobs = plan(EVALUATIONS, QUICK, [])
    assert any({"texture", "edges"} <= set(job.evaluations) for job in jobs)
    assert len({job.condition for job in jobs}) == len(jobs)


def test_unknown_evaluation(tmp_path: Path) -> None:
    with pytest.raises(
        amiwarp.AmiwarpError, match="unknown evaluation 'nothing'; choose among texture"
    ):
        amiwarp.evaluate(tmp_path / "out", only=["nothing"])
    assert not list(tmp_path.iterdir())


def test_distances_from_known_edges() -> None:
    discs = DiscTarget.of_seed((240, 180), 3)
    assert discs.centres.shape == (4, 2)
    angle = np.linspace(0.0, 2.0 * math.pi, 50)
    ray = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    places = np.concatenate([discs.centres[1] + r * ray for r in (17.0, 20.0, 26.0, 39.0)])
    distance, luminance = discs.distances(places)
    np.testing.assert_allclose(distance, np.repeat([-3.0, 0.0, 6.0], 50), rtol=0, atol=1e-9)  # px
    assert set(luminance) == {discs.luminance[1]}


def test_robust_spread_of_normal_distances() -> None:
    rng = np.random.default_rng(0)
    group = rng.integers(0, 2, 100_000)
    distance = rng.normal(3.0 * group, 2.5)
    distance[:3000] = 18.0  # noise far away
    assert robust_spread(distance, group) == pytest.approx(2.5, rel=0.05)
    assert robust_spread(np.zeros(0), np.zeros(0)) == math.inf


def test_the_blur_grows_with_the_lag_of_the_photoreceptors() -> None:
    blur = {}
    for cutoff in (0.0, 100.0):
        condition = Condition(
            DISCS,
            "still",
            width=120,
            height=100,
            duration_s=60 / 1440,
            rpm=1440.0,
            cutoff_hz=cutoff,
            only=IDEAL,
        )
        (row,) = apex_speed.measure(Streams(condition), SMALL)["rows"]
        blur[cutoff] = row["blur"]
    assert 0.3 < blur[0.0] < 0.6  # px: quantisation and the width of the edge
    assert blur[100.0] > 1.5 * blur[0.0]


def test_cells_are_kept_and_the_report_is_one_file(tmp_path: Path) -> None:
    condition = Condition(
        DISCS, "still", width=120, height=100, duration_s=60 / 1440, rpm=1440.0, cutoff_hz=0.0
    )
    cells = run_job(Job(condition, ("apex_speed",), SMALL)).cells
    assert not cells[0].error
    store = Store(tmp_path)
    store.save(cells[0], SMALL)
    known = store.load("apex_speed", condition, SMALL)
    assert known is not None
    assert known.values == cells[0].values
    for other in (
        replace(SMALL, first_seed=2),
        replace(SMALL, device="cuda:0"),
        replace(SMALL, duration_s=0.2),
    ):
        assert store.load("apex_speed", condition, other) is None
    assert store.load("apex_speed", condition, replace(SMALL, seeds=5)) is not None
    with mock.patch.object(apex_speed, "VERSION", -1):
        assert store.load("apex_speed", condition, SMALL) is None
    files = write(tmp_path, [section("apex_speed", [known])], SMALL, 1.0)
    page = files["report"].read_text()
    assert page.count("data:image/svg+xml;base64,") == 5
    assert "not testable" in page
    assert 'src="http' not in page
    assert 'href="http' not in page
    data = json.loads(files["data"].read_text())
    assert data["evaluations"][0]["tables"][0]["rows"][0][2] == 1440.0
    assert (tmp_path / "figures" / "apex_speed_blur.pdf").stat().st_size > 1000
    assert (
        (tmp_path / "tables" / "apex_speed_rate.csv")
        .read_text()
        .startswith("apex,bandwidth,speed [rpm]")
    )


Change = Callable[[dict[str, Any]], object]
WRONG_EDGES: dict[str, tuple[Change, str]] = {
    "huge": (lambda v: v["sectors"][0].update(angle=1e300), r"sectors\[0\]\.angle = 1e\+300 is not a finite number"),
    "share": (lambda v: v["images"][0]["entropy"].__setitem__(3, 1.5), r"entropy\[3\] = 1\.5 is not .* in 0 \.\. 1"),
    "count": (lambda v: v["rows"][0].update(true=True), r"rows\[0\]\.true = True is not a whole number"),
    "stream": (lambda v: v["sectors"][0].update(stream="mine"), r"sectors\[0\]\.stream is 'mine'; choose among S-EV"),
    "unknown": (lambda v: v.update(colour=1), r"values\.colour is unknown"),
    "missing": (lambda v: v["rows"][0].pop("truth"), r"values\.rows\[0\]\.truth is missing"),
    "no list": (lambda v: v.update(rows=1), r"values\.rows is 1; expected a list"),
    "short": (lambda v: v["rows"][0]["matched"].pop(), r"values\.rows\[0\]\.matched has 32 numbers; expected 33"),
    "no images": (lambda v: v["images"].pop(0), "values.rows has a row of S-EV, whose images are missing"),
    "no chance": (lambda v: v["rows"][1]["chance"].pop(), r"values\.rows\[1\]\.chance has 32 numbers; expected 33"),
    "no picture": (lambda v: v["pictures"].update(Canny="AAAA"), r"values\.pictures cannot be decoded"),
    "two sizes": (
        lambda v: v["pictures"].update(Canny=encode_picture(np.zeros((3, 5), np.uint8))), "expected one shape of 2 axes"
    ),
    "large picture": (
        lambda v: v["pictures"].update(Canny=encode_picture(np.zeros((2049, 2048), np.uint8))), "has 2048x2049 px"
    ),
}  # fmt: skip
WRONG_FADING: dict[str, tuple[Change, str]] = {
    "ragged": (
        lambda v: v["tiles"]["speed"][0].pop(),
        r"values\.tiles has rows of unequal lengths",
    ),
    "no columns": (
        lambda v: v["tiles"].update(columns=0),
        r"tiles\.columns = 0 is not a whole number in 1",
    ),
    "grey film": (
        lambda v: v.update(film=[encode_picture(np.zeros((3, 4), np.uint8))]),
        "one shape of 3 axes",
    ),
}


@pytest.mark.parametrize(
    ("cell", "change", "message"),
    [
        *((stored_edges(), *case) for case in WRONG_EDGES.values()),
        *((stored_fading(), *c) for c in WRONG_FADING.values()),
    ],
    ids=[*WRONG_EDGES, *WRONG_FADING],
)
def test_a_cell_of_wrong_values_is_run_again(
    tmp_path: Path, cell: CellResult, change: Change, message: str
) -> None:
    store = Store(tmp_path)
    store.save(cell, SMALL)
    known = store.load(cell.evaluation, cell.condition, SMALL)
    assert known == cell
    section(cell.evaluation, [known])
    (path,) = tmp_path.iterdir()
    data = json.loads(path.read_text())
    del data["checksum"]
    change(data["values"])
    path.write_text(json.dumps(sealed(data)))  # anybody can compute the checksum
    assert store.load(cell.evaluation, cell.condition, SMALL) is None
    (said,) = store.damaged
    assert said.startswith(f"{path}: is damaged: field values")
    assert re.search(message, said), said


def test_damaged_cells_are_run_again_and_said(tmp_path: Path) -> None:
    """A cell that is cut off, not finite or a pipe is run again by the command, which says so in one line."""
    condition = Condition(
        DISCS, "still", width=120, height=100, duration_s=60 / 1440, rpm=1440.0, cutoff_hz=0.0
    )
    jobs, store = [Job(condition, ("apex_speed",), SMALL)], Store(tmp_path)
    with single_worker() as workers:
        first, *_ = _run(jobs, store, workers, silent)
        (path,) = tmp_path.iterdir()
        whole = path.read_bytes()
        for content in (
            whole[:-20],
            whole.replace(b'"blur":', b'"blur":1e300,"old":', 1),
            b"{}",
            None,
        ):
            path.unlink()
            os.mkfifo(path) if content is None else path.write_bytes(content)
            again, new, _ = _run(jobs, store, workers, silent)
            assert (new, again[0].values) == (1, first[0].values)
            assert _run(jobs, store, workers, silent)[1] == 0
    assert len(store.damaged) == 4
    assert all(said.startswith(f"{path}: ") for said in store.damaged)
    (line,) = made_again(store.damaged)
    assert line == f"damaged, and made again: {store.damaged[0]}, and 3 more"


def test_a_table_without_values_has_no_chart() -> None:
    from amiwarp.studies.evaluate import Chart
    from amiwarp.studies.evaluate.charts import draw

    empty = Table("t", "t", ("x", "y", "s"), [(1, None, "a")], chart=Chart("x", "y", "s"))
    assert draw(empty) is None


def test_a_recording_from_the_command_line(tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from tests.command_line import app

    rng = np.random.default_rng(0)
    n = 5_000
    events = amiwarp.Events.from_arrays(
        rng.integers(0, 64, n),
        rng.integers(0, 48, n),
        np.sort(rng.integers(0, 100_000, n)),
        rng.integers(0, 2, n),
    )
    path = tmp_path / "plain.h5"
    amiwarp.save_recording(path, amiwarp.Recording(amiwarp.MemoryEvents(events, 64, 48)))
    words = ["evaluate", "--out", str(tmp_path / "out"), "--recording", str(path), "--workers", "1", "--device", "cpu",
             "--json"]  # fmt: skip
    done = [CliRunner().invoke(app, words) for _ in range(2)]
    assert [d.exit_code for d in done] == [0, 0], [d.stderr for d in done]
    first, second = (json.loads(d.stdout) for d in done)
    assert (first["cells"], first["new_cells"], first["failed"]) == (1, 1, 0)
    assert (second["cells"], second["new_cells"]) == (1, 0)
    assert "plain.h5" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.parametrize("only", [",", "", " , "])
def test_no_names_are_not_all_names(tmp_path: Path, only: str) -> None:
    from typer.testing import CliRunner

    from tests.command_line import app

    out = tmp_path / "out"
    result = CliRunner().invoke(app, ["evaluate", "--out", str(out), "--only", only])
    assert result.exit_code != 0
    assert "names no evaluation; give names such as texture,flow" in result.output
    assert not out.exists()


def test_a_recording_that_fails_does_not_end_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from typer.testing import CliRunner

    from tests.command_line import app

    rng = np.random.default_rng(0)
    words = ["evaluate", "--out", str(tmp_path / "out"), "--workers", "1", "--device", "cpu"]
    for name, n in (("good", 5_000), ("odd", 4_000), ("broken", 0)):
        events = amiwarp.Events.from_arrays(
            rng.integers(0, 64, n),
            rng.integers(0, 48, n),
            np.sort(rng.integers(0, 100_000, n)),
            rng.integers(0, 2, n),
        )
        path = tmp_path / f"{name}.h5"
        amiwarp.save_recording(path, amiwarp.Recording(amiwarp.MemoryEvents(events, 64, 48)))
        words += ["--recording", str(path)]
    whole = (tmp_path / "broken.h5").read_bytes()
    (tmp_path / "broken.h5").write_bytes(whole[:100])
    measure = texture.measure

    def planted(streams: RecordedStreams, *args: Any) -> Any:
        if len(streams.recording.events) == 4_000:
            raise np.linalg.LinAlgError("Singular matrix")
        return measure(streams, *args)

    with monkeypatch.context() as patch:
        patch.setattr(texture, "measure", planted)
        first = CliRunner().invoke(app, words)
    assert first.exit_code == 0, first.output
    (odd,) = (line for line in first.stdout.splitlines() if "LinAlgError" in line)
    assert odd.startswith(
        f"failed: texture, {tmp_path / 'odd.h5'}: LinAlgError: Singular matrix (in _run_cell, studies/"
    )
    assert f"failed: texture, {tmp_path / 'broken.h5'}: " in first.stdout
    assert first.stdout.endswith("; 2 failed: run the same command again to try them again\n")
    page = (tmp_path / "out" / "report.html").read_text()
    assert "<dd>2 of 3 cells" in page
    assert f"{tmp_path / 'odd.h5'}: LinAlgError: Singular matrix" in page
    assert "good.h5" in (tmp_path / "out" / "tables" / "event_rate.csv").read_text()
    (said,) = json.loads((tmp_path / "out" / "report.json").read_text())["evaluations"]
    assert (said["cells"], len(said["errors"])) == (3, 2)

    again = json.loads(CliRunner().invoke(app, [*words, "--json"]).stdout)
    assert (again["cells"], again["new_cells"], again["failed"]) == (3, 2, 1)
    assert list(again["failures"]) == [f"texture, {tmp_path / 'broken.h5'}"]
    only = [*words[:7], "--recording", str(tmp_path / "broken.h5"), "--json"]
    nothing = CliRunner().invoke(app, only)
    assert nothing.exit_code == 1
    assert json.loads(nothing.stdout)["failed"] == 1
    assert "<dd>1 of 1 cells" in (tmp_path / "out" / "report.html").read_text()


def test_a_prism_whose_calibration_fails_and_a_worker_that_dies_fail_their_cells_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual, other = (
        Condition(world, "still", width=64, height=48, duration_s=60 / rpm, rpm=rpm, cutoff_hz=0.0)
        for world, rpm in ((DISCS, 1440.0), ("room", 720.0))
    )
    jobs = [
        Job(usual, ("fading", "apex_speed"), SMALL),
        Job(other, ("texture", "edges", "fading"), SMALL),
    ]
    dead = {usual}

    def simulated(job: Job) -> JobResult:
        if job.condition in dead:
            raise MemoryError
        return JobResult(
            [CellResult(name, job.condition, known_values(name)) for name in job.evaluations], 1.0
        )

    def known_values(name: str) -> dict[str, Any]:
        cell: CellResult = stored_fading()
        assert name == cell.evaluation
        return cell.values

    def refused(job: Job) -> tuple[Setup, float]:
        raise amiwarp.AmiwarpError("too few events")

    monkeypatch.setattr(evaluation, "run_job", simulated)
    monkeypatch.setattr(evaluation, "run_setup", refused)
    with single_worker() as workers:
        results, new, _ = _run(jobs, Store(tmp_path), workers, silent)
        assert new == 5
        found = {
            (r.condition.world, r.evaluation): r.error
            for r in results
            if isinstance(r.condition, Condition)
        }
        assert [key for key, error in found.items() if not error] == [("room", "fading")]
        assert all(
            found[DISCS, name].startswith("MemoryError") for name in ("fading", "apex_speed")
        )
        assert {re.sub(r" \(in .*", "", found["room", name]) for name in ("texture", "edges")} == {
            "calibration of the prism: too few events"
        }
        dead.clear()
        jobs = [Job(usual, ("fading",), SMALL), jobs[1]]
        results, new, _ = _run(jobs, Store(tmp_path), workers, silent)
    assert new == 3
    failed = {(r.evaluation, r.condition) for r in results if r.error}
    assert (len(results), failed) == (4, {("texture", other), ("edges", other)})


def test_a_report_that_is_not_ours_is_kept(tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text("mine")
    with pytest.raises(amiwarp.AmiwarpError, match=r"report\.html"):
        amiwarp.evaluate(tmp_path, only=["texture"], seeds=1, workers=1)
    assert (tmp_path / "report.html").read_text() == "mine"
