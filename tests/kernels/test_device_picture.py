"""Pictures from sums in phase as a GPU makes them, compared with those of the CPU; their kernels run on both."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.fft
import warp as wp
from numpy.typing import NDArray

from amiwarp import (
    AmiwarpError,
    Camera,
    DeviceEvents,
    DeviceMemoryEvents,
    Encoder,
    Events,
    ExactModel,
    PhaseReconstruction,
    PhaseSums,
    Prism,
    PrismMotion,
    Recording,
    Scene,
    Simulation,
    phase_picture,
    phase_sums,
)
from amiwarp.events.device_events import all_events, ranges_between
from amiwarp.imaging.phase import copied_sums
from amiwarp.imaging.phase_device import DeviceSums
from amiwarp.imaging.windows import turn_edges, turn_end
from amiwarp.kernels import phase_lines
from amiwarp.kernels.phase_grid import SIDE
from amiwarp.reconstruction import phase_lag, phase_tiles
from amiwarp.reconstruction.device_picture import DevicePictures, cosines
from amiwarp.reconstruction.phase_window import harmonics_for, whole_turns
from reference.calibration_sample import exact_calibration

PHASE = 2.0
START_US = 100_000
TURN_US = 83_340
ROUNDING = 1e-4
"""Largest difference that the rounding of float32 makes in a picture with a range of 10 to 20 [thresholds]."""


class Case:
    """Recording of a scene, and one turn of it."""

    def __init__(
        self, texture: NDArray[np.uint8], width: int, height: int, apex_deg: float
    ) -> None:
        self.camera = Camera.from_fov(width, height, math.radians(50.0))
        self.prism = Prism(math.radians(apex_deg))
        scene = Scene.from_picture(texture)
        motion = PrismMotion(720.0, PHASE)
        through = Simulation(scene, self.camera, self.prism, 0.25, motion, seed=4)
        self.recording = through.run()
        self.model = ExactModel(self.camera, self.prism, PHASE)
        self.harmonics = harmonics_for(self.model)
        assert self.recording.encoder is not None
        self.encoder = self.recording.encoder
        stop_us, _ = whole_turns(self.encoder, START_US, TURN_US)
        self.events = self.recording.events.between(START_US, stop_us)

    def sums(self, events: Events) -> PhaseSums:
        width, height = self.camera.width, self.camera.height
        return phase_sums(events, self.encoder, width, height, turns=1.0, harmonics=self.harmonics)

    def on_device(self, device: str) -> DeviceSums:
        size = self.camera.width, self.camera.height
        return DeviceSums(*size, self.harmonics, 64, device, extremes=True)

    def work(self, recording: Recording, device: str | None = None) -> PhaseReconstruction:
        values = {"apex": self.prism.apex, "phase": PHASE}
        calibration = exact_calibration(self.camera, self.prism, values)
        return PhaseReconstruction(recording, calibration, device=device)


def on(recording: Recording, device: str) -> Recording:
    """Return a recording with its events on a device."""
    events = recording.events[:]
    there = DeviceEvents.from_arrays(events.x, events.y, events.t, events.p, device=device)
    source = DeviceMemoryEvents(there, *recording.events.size)
    return replace(recording, events=source)


# Some tiles and an even number of pixels; one row of tiles and an odd number, with a small orbit; a single tile.
SIZES = {"200x150": (200, 150, 1.2), "231x77": (231, 77, 0.4), "64x48": (64, 48, 1.2)}


@pytest.fixture(scope="module", params=SIZES)
def case(request: pytest.FixtureRequest, texture: NDArray[np.uint8]) -> Case:
    return Case(texture, *SIZES[request.param])


def test_pictures_are_those_of_the_cpu(case: Case, device: str) -> None:
    """Also after the sums of other events: the first ones are upside down, and fewer."""
    there = case.on_device(device)
    pictures = DevicePictures(case.model, there.values)
    few = case.events[: len(case.events) // 2]
    other = Events(few.x, case.camera.height - 1 - few.y, few.t, few.p)
    for events in (other, case.events):
        sums = case.sums(events)
        there.sum(events, case.encoder, turns=1.0, direction=1)
        pictures.draw()
        lag = phase_lag.lag_of(sums, case.model)
        assert float(pictures.lag.numpy()[0]) == pytest.approx(lag, abs=1e-5)
        expected = phase_tiles.scene_of_tiles(sums, case.model, lag, with_rest=False).detail
        found = pictures.detail.numpy()
        np.testing.assert_allclose(found, expected, rtol=0, atol=ROUNDING)
        log = phase_picture(sums, case.model)
        np.testing.assert_allclose(pictures.log(), log, rtol=0, atol=ROUNDING)
        assert np.ptp(log) > 2.0


def test_a_picture_is_the_same_each_time(case: Case, device: str) -> None:
    found = []
    for _ in range(2):
        there = case.on_device(device)
        pictures = DevicePictures(case.model, there.values)
        for _ in range(2):
            there.sum(case.events, case.encoder, turns=1.0, direction=1)
            pictures.draw()
            found.append(pictures.log())
    for log in found[1:]:
        np.testing.assert_array_equal(log, found[0])


def test_windows_of_a_recording_on_a_device(case: Case, device: str) -> None:
    work = case.work(on(case.recording, device))
    expected = case.work(case.recording).window(START_US, TURN_US)
    for picture in (*work._streamed([START_US], TURN_US), work.window(START_US, TURN_US)):
        np.testing.assert_allclose(picture.log, expected.log, rtol=0, atol=ROUNDING)
        np.testing.assert_array_equal(picture.known, expected.known)
        assert picture.known.dtype == np.bool_
        assert picture.off_excess == expected.off_excess


def test_pictures_of_a_stream_are_those_of_its_windows(case: Case, device: str) -> None:
    """Each is read when the next one is under way; an error comes after the pictures before it."""
    work = case.work(on(case.recording, device))
    starts = [START_US, START_US + 20_000, START_US + 5000]
    streamed = []
    for picture in work._streamed(starts, TURN_US):
        work._finished(work._started(START_US + 9000, TURN_US))  # another one in between
        streamed.append(picture)
    assert [picture.start_us for picture in streamed] == starts
    for picture in streamed:
        alone = work._finished(work._started(picture.start_us, TURN_US))
        np.testing.assert_array_equal(picture.log, alone.log)
        np.testing.assert_array_equal(picture.known, alone.known)
        assert picture.off_excess == alone.off_excess
    assert not np.array_equal(streamed[0].log, streamed[1].log)

    late = work._streamed([START_US, 240_000], TURN_US)
    np.testing.assert_array_equal(next(late).log, streamed[0].log)
    with pytest.raises(AmiwarpError):
        next(late)


@pytest.mark.parametrize("columns", [False, True])
def test_transforms_of_lines(device: str, *, columns: bool) -> None:
    random = np.random.default_rng(3)
    values = random.normal(size=(2, SIDE, SIDE)) + 1j * random.normal(size=(2, SIDE, SIDE))
    kernel = phase_lines.transform_columns if columns else phase_lines.transform_lines
    axis = 1 if columns else 2
    pairs = values.astype(np.complex64).view(np.float32).reshape(*values.shape, 2)
    planes = wp.array(pairs, dtype=wp.vec2, device=device)
    turns = phase_lines.turns_of_places().astype(np.complex64).view(np.float32).reshape(-1, 2)
    inputs = [wp.array(turns, dtype=wp.vec2, device=device)]
    inputs.append(wp.empty(phase_lines.ROOM, dtype=wp.vec2, device=device))
    expected = np.fft.fft(values, axis=axis)
    for sign in (1.0, -1.0):
        wp.launch_tiled(
            kernel,
            dim=[2, SIDE // phase_lines.LINES],
            inputs=[planes, *inputs, sign],
            block_dim=phase_lines.THREADS,
            device=device,
        )
        found = planes.numpy().view(np.complex64)[..., 0]
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4 * SIDE)
        expected = SIDE * values


def test_cosine_waves_are_those_of_the_transform() -> None:
    line = np.random.default_rng(0).normal(size=23)
    expected = scipy.fft.dct(line, norm="ortho")
    np.testing.assert_allclose(cosines(23, 23) @ line, expected, atol=1e-12)
    np.testing.assert_allclose(cosines(23, 5) @ line, expected[:5], atol=1e-12)


def test_the_end_of_turns_is_that_of_all_edges() -> None:
    """For clocks and speeds of all kinds. An optic that turns back has no short way."""
    random = np.random.default_rng(8)
    found = 0
    for offset_us in (0.0, 0.3141, -3.57, 1700.2):
        times = 10**12 + np.cumsum(random.integers(1, 2000, 300))
        way = random.choice([-1.0, 1.0])
        angle = 12.0 + way * random.uniform(1e-4, 3e-4) * (times - times[0])
        uneven = angle + 0.3 * np.sin(0.5 * angle)
        encoder = Encoder(times, uneven, clock_offset_us=offset_us)
        first_us, last_us = encoder.coverage
        for start_us in random.integers(first_us, last_us, 25).tolist():
            edges = turn_edges(encoder, start_us, last_us, 1.0, incomplete=False)
            start = float(encoder.angle_at(np.array([start_us]))[0])
            for turns in range(1, 4):
                end_us = turn_end(encoder, start_us, start, last_us, turns)
                if end_us is not None:
                    found += 1
                    assert end_us == edges[turns]
    assert found > 100
    back = Encoder(times, np.abs(angle - angle[150]))
    start = float(back.angle_at(times[:1])[0])
    assert turn_end(back, int(times[0]), start, int(times[-1]), 1) is None


def test_ranges_of_windows(device: str) -> None:
    t = np.array([0, 10, 10, 20, 35])
    ones = np.ones(5, np.uint16)
    there = DeviceEvents.from_arrays(ones, ones, t, ones, device=device)
    source = DeviceMemoryEvents(there, 4, 4)
    windows = [(10, 20), (0, 36), (11, 20), (20, 35), (40, 50)]
    assert ranges_between(source, windows) == [
        (1, 2, 10, 10),
        (0, 5, 0, 35),
        (3, 0, 0, 0),
        (3, 1, 20, 20),
        (5, 0, 0, 0),
    ]


@pytest.mark.parametrize("way", ["on", "back", "there and back"])
def test_sums_of_a_part_of_a_recording(device: str, way: str) -> None:
    """The direction is that from the first event of the part to its last one."""
    random = np.random.default_rng(2)
    count = 4000
    x = random.integers(0, 12, count).astype(np.uint16)
    y = random.integers(0, 9, count).astype(np.uint16)
    t = np.sort(random.integers(0, 200_000, count))
    events = Events(x, y, t, (random.random(count) < 0.4).astype(np.uint8))
    times = np.arange(0, 201_000, 1000)
    angle = 7e-5 * times
    if way == "back":
        angle = -angle
    if way == "there and back":
        angle = np.abs(angle - 5.0)
    encoder = Encoder(times, angle)
    there = DeviceEvents.from_arrays(x, y, t, events.p, device=device)
    source = DeviceMemoryEvents(there, 12, 9)
    # One and two more than the three harmonics that are summed at once
    for harmonics in (4, 5):
        sums = DeviceSums(12, 9, harmonics, 64, device, extremes=True)
        for span in ((0, 90_000), (50_000, 150_000), (120_000, 200_000)):
            part = events[slice(*np.searchsorted(t, span))]
            expected = phase_sums(part, encoder, 12, 9, turns=1.0, harmonics=harmonics)
            (found,) = ranges_between(source, [span])
            sums.sum_range(all_events(source), found, encoder, turns=1.0)
            copied = copied_sums(sums)
            np.testing.assert_array_equal(copied.values, expected.values)
            np.testing.assert_array_equal(copied.on, expected.on)
            assert copied.off_ratio == expected.off_ratio
