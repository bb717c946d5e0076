"""Pictures from sums in phase as a GPU makes them, compared with those of the CPU; their kernels run on both."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.fft
from numpy.typing import NDArray

from amiwarp import (
    Camera,
    DeviceEvents,
    DeviceMemoryEvents,
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

    def work(self, recording: Recording, device: str | None = None) -> PhaseReconstruction:
        values = {"apex": self.prism.apex, "phase": PHASE}
        calibration = exact_calibration(self.camera, self.prism, values)
        return PhaseReconstruction(recording, calibration, device=device)


# Some tiles and an even number of pixels; one row of tiles and an odd number, with a small orbit; a single tile.
SIZES = {"200x150": (200, 150, 1.2), "231x77": (231, 77, 0.4), "64x48": (64, 48, 1.2)}


@pytest.fixture(scope="module", params=SIZES)
def case(request: pytest.FixtureRequest, texture: NDArray[np.uint8]) -> Case:
    return Case(texture, *SIZES[request.param])


def test_pictures_are_those_of_the_cpu(case: Case, device: str) -> None:
    """Also after the sums of other events: the first ones are upside down, and fewer."""
    pictures = DevicePictures(case.model, case.harmonics, device)
    few = case.events[: len(case.events) // 2]
    other = Events(few.x, case.camera.height - 1 - few.y, few.t, few.p)
    for events in (other, case.events):
        sums = case.sums(events)
        pictures.sums.sum(events, case.encoder, turns=1.0, direction=1)
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
        pictures = DevicePictures(case.model, case.harmonics, device)
        for _ in range(2):
            pictures.sums.sum(case.events, case.encoder, turns=1.0, direction=1)
            pictures.draw()
            found.append(pictures.log())
    for log in found[1:]:
        np.testing.assert_array_equal(log, found[0])


def test_windows_of_a_recording_on_a_device(case: Case, device: str) -> None:
    events = case.recording.events[:]
    width, height = case.camera.width, case.camera.height
    there = DeviceEvents.from_arrays(events.x, events.y, events.t, events.p, device=device)
    source = DeviceMemoryEvents(there, width, height)
    recording = replace(case.recording, events=source)
    work = case.work(recording)
    expected = case.work(case.recording).window(START_US, TURN_US)
    log, known, off_ratio = work._drawn_on_device(START_US, TURN_US)
    picture = work.window(START_US, TURN_US)
    for found in (log, picture.log):
        np.testing.assert_allclose(found, expected.log, rtol=0, atol=ROUNDING)
    for marks in (known, picture.known):
        np.testing.assert_array_equal(marks, expected.known)
        assert marks.dtype == np.bool_
    assert off_ratio == picture.off_excess + 1.0 == expected.off_excess + 1.0


def test_cosine_waves_are_those_of_the_transform() -> None:
    line = np.random.default_rng(0).normal(size=23)
    expected = scipy.fft.dct(line, norm="ortho")
    np.testing.assert_allclose(cosines(23, 23) @ line, expected, atol=1e-12)
    np.testing.assert_allclose(cosines(23, 5) @ line, expected[:5], atol=1e-12)
