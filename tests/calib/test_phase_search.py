"""Calibration from sums of events in phase with the prism: the cost, the search without a guess, and its refusals."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import jv

from amiwarp import (
    AmiwarpError,
    Camera,
    Encoder,
    ErrorCode,
    MemoryEvents,
    Prism,
    PrismMotion,
    Recording,
    SearchCost,
    Settings,
    calibrate,
    simulate,
)
from amiwarp.calib.nlopt_solver import GLOBAL_ALGORITHMS, LOCAL_ALGORITHMS
from amiwarp.calib.phase_search import OrbitGrid, tiles_of
from amiwarp.calib.phase_tiles import SIDE, PhaseTiles
from amiwarp.calib.preparation import prepare
from amiwarp.calib.sharpness_search import Search
from amiwarp.imaging.phase_costs import DAMPING, LONGEST_WAVES
from amiwarp.optics.models.registry import build_model
from amiwarp.optics.orbit import orbits_of
from tests.errors import refused

APEX = math.radians(1.5)
PHASE_RAD = -2.0
SIZE = (160, 120)
LAG_PX = 0.5
"""Largest distance of an answer from the mechanical motion: events come after their edges [px]."""


@pytest.fixture(scope="module")
def recording(texture: np.ndarray) -> Recording:
    """Two turns of a still scene. The nominal apex is a fifth too large."""
    return simulate(
        texture,
        Camera.from_fov(*SIZE, math.radians(50.0)),
        Prism(APEX),
        duration_s=0.17,
        motion=PrismMotion(720.0, phase=PHASE_RAD),
        nominal_prism=Prism(1.2 * APEX),
        seed=2,
    )


def searched(recording: Recording, **settings: object) -> Search:
    """Return the sharpness stage's search after its run."""
    given = {"model": "exact", "events": 60_000, **settings}
    return prepare(recording, Settings(**given))[0].run()  # type: ignore[arg-type]


def away_px(search: Search) -> float:
    """Return how far size and phase of an answer move events from where the truth moves them [px]."""
    true = {**search.space.start, "apex": APEX, "phase": PHASE_RAD}
    difference = search.space.to_vector(search.best) - search.space.to_vector(true)
    return float(np.linalg.norm(difference))


# -- the cost


def oracle(
    spectra: np.ndarray, a: np.ndarray, b: np.ndarray, coarsest: float, finest: float
) -> float:
    """Return the cost of an orbit over all waves and all harmonics, in float64."""
    left = total = 0.0
    _, harmonics, side, _ = spectra.shape
    frequencies = 2.0 * np.pi * np.fft.fftfreq(side)
    opposite = -np.arange(side) % side
    for tile in range(len(spectra)):
        for row, ky in enumerate(frequencies):
            for column, kx in enumerate(frequencies):
                if not coarsest <= math.hypot(kx, ky) <= finest:
                    continue
                k = complex(kx, ky)
                c = np.conj(k) * a[tile] + k * np.conj(b[tile])
                at = [
                    *(spectra[tile, :, row, column]),
                    *np.conj(spectra[tile, :, opposite[row], opposite[column]]),
                ]
                orders = np.array([*range(1, harmonics + 1), *range(-1, -harmonics - 1, -1)])
                h = 1j * orders * (1j * np.exp(1j * np.angle(c))) ** orders * jv(orders, abs(c))
                seen = np.array(at, dtype=np.complex128)
                scene = (np.conj(h) * seen).sum() / ((np.abs(h) ** 2).sum() + DAMPING)
                left += float((np.abs(seen - h * scene) ** 2).sum())
                total += float((np.abs(seen) ** 2).sum())
    return left / total


def random_tiles(shrink: int = 1) -> PhaseTiles:
    rng = np.random.default_rng(4)
    shape = (2, 3, 16, 16)
    spectra = rng.normal(size=shape) + 1j * rng.normal(size=shape)
    return PhaseTiles(spectra.astype(np.complex64), np.zeros((2, 2)), shrink)


@pytest.mark.parametrize("finest", [0.6, 1.3, 2.4])
def test_the_cost_is_that_of_the_formula(finest: float) -> None:
    tiles = random_tiles()
    orbits = np.array([[[1.5 + 0.4j, -0.3j], [0.2 - 1.9j, 0.4]], [[3.0, 0.1], [2.5j, -0.2j]]])
    found = tiles.costs(orbits, finest)
    for orbit, cost in zip(orbits, found, strict=True):
        expected = oracle(tiles.spectra, *orbit.T, LONGEST_WAVES, finest)
        assert cost == pytest.approx(expected, rel=0.0, abs=1e-4)  # table of Bessel functions


def test_an_orbit_in_shrunk_pixels_is_smaller() -> None:
    orbits = np.array([[[1.5 + 0.4j, -0.3j], [0.2 - 1.9j, 0.4]]])
    assert random_tiles(shrink=2).costs(2.0 * orbits) == random_tiles().costs(orbits)


def test_a_scene_of_the_right_orbit_leaves_nothing() -> None:
    """The sums are made of a random scene by the expansion of Jacobi and Anger."""
    rng = np.random.default_rng(8)
    side = 32
    scene = np.fft.fft2(rng.normal(size=(side, side)))
    kx, ky = np.meshgrid(*2 * [2.0 * np.pi * np.fft.fftfreq(side)])
    k = kx + 1j * ky
    a = 2.0 * np.exp(0.7j)
    b = 0.3 * np.exp(-1.1j)
    c = np.conj(k) * a + k * np.conj(b)
    orders = np.arange(1, 7)[:, None, None]
    response = 1j * orders * (1j * np.exp(1j * np.angle(c))) ** orders * jv(orders, np.abs(c))
    tiles = PhaseTiles((response * scene)[None].astype(np.complex64), np.zeros((1, 2)), 1)
    right, other, reverse = tiles.costs(np.array([[[a, b]], [[1.3 * a, b]], [[b, a]]]), 1.5)
    assert right < 0.01
    assert other > 0.05
    assert reverse > 0.3


def test_the_same_events_give_the_same_bits(recording: Recording) -> None:
    first, second = (searched(recording, cost="phase") for _ in range(2))
    assert first.best == second.best
    assert [stage.points for stage in first.stages] == [stage.points for stage in second.stages]


# -- the orbits


@pytest.mark.parametrize("model", ["circle", "radial", "ellipse", "exact"])
def test_orbits_between_the_grid_are_those_of_the_model(recording: Recording, model: str) -> None:
    search = prepare(recording, Settings(model=model, events=20_000))[0]
    space = search.space
    tiles = tiles_of(search.calibration_events, space)
    grid = OrbitGrid.of(space, tiles)
    size = 0.43 * space.high[space.size_name]
    values = {**space.start, space.size_name: size, "phase": 2.1}
    built = build_model(space.model, space.camera, space.prism, values)
    expected = orbits_of(built, tiles.middles)
    found = grid.at(size, 2.1)
    assert np.abs(found[:, 0] - expected.forward).max() < 0.01  # px
    assert np.abs(found[:, 1] - expected.backward).max() < 0.01  # px


# -- the tiles


def test_only_whole_turns_about_the_middle_count(recording: Recording) -> None:
    """Events of the first and of the last part of a turn are left out."""
    source = recording.events
    turn_us = 60e6 / 720.0
    middle_us = (source.t_first + source.t_last) / 2.0
    spectra = []
    for turns in (1.9, 1.0):
        half_us = turns * turn_us / 2.0
        cut = source.between(round(middle_us - half_us), round(middle_us + half_us))
        part = replace(recording, events=MemoryEvents(cut, *SIZE))
        search = prepare(part, Settings(model="exact", events=len(cut)))[0]
        spectra.append(tiles_of(search.calibration_events, search.space).spectra)
    changed = np.abs(spectra[0] - spectra[1]).sum() / np.abs(spectra[1]).sum()
    assert changed < 0.03  # the cuts differ by a few events


def test_large_images_and_orbits_are_shrunk(recording: Recording) -> None:
    events = recording.events[:5000]
    encoder = recording.encoder
    assert encoder is not None
    for width, radius, shrink in ((160, 5.0, 1), (400, 14.0, 1), (401, 5.0, 2), (160, 30.0, 3)):
        tiles = PhaseTiles.of(events, encoder, width, 120, radius)
        assert tiles.shrink == shrink
        assert tiles.spectra.shape[2:] == (SIDE, SIDE)
        # a pixel of the shrunk image has its middle in the middle of the pixels that it joins
        first = shrink * (SIDE - 1) / 2 + (shrink - 1) / 2
        assert tiles.middles[0] == pytest.approx((first, min(first, 119.0)))
        assert (tiles.middles <= (width - 1, 119)).all()


# -- the search without a guess


@pytest.mark.parametrize("cost", list(SearchCost))
def test_the_motion_is_found_without_a_guess(recording: Recording, cost: SearchCost) -> None:
    found = searched(recording, cost=cost)
    assert away_px(found) < LAG_PX
    assert [stage.algorithm for stage in found.stages] == ["phase", "LN_BOBYQA"]
    assert found.stages[0].name == "global"


@pytest.mark.parametrize("phase", [-2.9, -1.4, 0.1, 1.6, 3.1])
def test_every_phase_is_found(texture: np.ndarray, phase: float) -> None:
    recording = simulate(
        texture,
        Camera.from_fov(*SIZE, math.radians(50.0)),
        Prism(APEX),
        duration_s=0.09,
        motion=PrismMotion(-720.0, phase=phase),
    )
    found = searched(recording, cost="phase")
    shift = math.remainder(found.best["phase"] - phase, math.tau)
    assert abs(shift) < math.radians(12.0)
    assert found.best["apex"] == pytest.approx(APEX, rel=0.1)


@pytest.mark.parametrize("algorithm", GLOBAL_ALGORITHMS)
def test_every_global_algorithm_finds_the_optimum_of_the_cost(
    recording: Recording, algorithm: str
) -> None:
    found = searched(recording, cost="phase", global_algorithm=algorithm)
    assert found.stages[0].algorithm == algorithm
    assert away_px(found) < LAG_PX


@pytest.mark.parametrize("algorithm", LOCAL_ALGORITHMS)
def test_every_local_algorithm_finds_the_optimum_of_the_cost(
    recording: Recording, algorithm: str
) -> None:
    found = searched(recording, cost="phase", local_algorithm=algorithm)
    assert found.stages[1].algorithm == algorithm
    assert away_px(found) < LAG_PX


def test_other_parameters_may_be_free_with_the_cost_and_nlopt(recording: Recording) -> None:
    found = searched(
        recording,
        cost="phase",
        global_algorithm="GN_DIRECT_L",
        free=("apex", "phase", "tilt_x"),
        stages=("sharpness",),
    )
    assert found.space.names == ("apex", "phase", "tilt_x")
    assert found.best["apex"] == pytest.approx(APEX, rel=0.1)


def test_the_whole_calibration_by_the_cost_is_as_right(recording: Recording) -> None:
    found = calibrate(recording, cost="phase", model="exact")
    assert found.parameters["apex"] == pytest.approx(APEX, abs=math.radians(0.02))
    assert math.isfinite(found.sharpness_after)


# -- when the sums do not tell


def test_less_than_a_turn_is_searched_in_the_events(recording: Recording) -> None:
    half = recording.events.between(0, 41_000)
    cut = replace(recording, events=MemoryEvents(half, *SIZE))
    assert searched(cut).stages[0].algorithm == "GN_DIRECT_L"
    with pytest.raises(AmiwarpError, match="need a whole turn in one direction"):
        searched(cut, cost="phase")


def test_a_prism_that_turns_back_is_searched_in_the_events(recording: Recording) -> None:
    encoder = recording.encoder
    assert encoder is not None
    back = replace(encoder, angle=encoder.angle + 3.0 * np.sin(1e-4 * encoder.t), index_t=None)
    turning = replace(recording, encoder=back)
    assert searched(turning).stages[0].algorithm == "GN_DIRECT_L"
    with pytest.raises(AmiwarpError, match="need a whole turn in one direction"):
        searched(turning, global_algorithm="phase")


def test_the_direction_of_rotation_is_found(recording: Recording) -> None:
    encoder = recording.encoder
    assert encoder is not None
    reverse = replace(recording, encoder=replace(encoder, angle=-encoder.angle, index_t=None))
    with refused(ErrorCode.CALIBRATION_REFUSED):
        searched(reverse, cost="phase")
    with pytest.raises(AmiwarpError, match="against the direction of the encoder"):
        searched(reverse, global_algorithm="phase")
    assert searched(reverse).stages[0].algorithm == "GN_DIRECT_L"


def test_noise_does_not_tell_the_motion(recording: Recording) -> None:
    rng = np.random.default_rng(0)
    source = recording.events[:]
    x = rng.permutation(source.x)
    y = rng.permutation(source.y)
    noise = replace(recording, events=MemoryEvents(replace(source, x=x, y=y), *SIZE))
    with pytest.raises(AmiwarpError, match="do not tell the motion"):
        searched(noise, global_algorithm="phase")


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"free": ("apex", "phase", "clock_offset")}, "fixed clock offset"),
        ({"free": ("apex", "phase", "motion")}, "camera at rest"),
        ({"free": ("apex",)}, "free size, and a free phase"),
        ({"bounds": {"phase": (0.0, 1.0)}}, "free size, and a free phase"),
        ({"free": ("apex", "phase", "tilt_x")}, "tilt_x"),
    ],
)
def test_settings_that_the_sums_cannot_serve_are_refused(
    recording: Recording, settings: dict[str, object], said: str
) -> None:
    with pytest.raises(AmiwarpError, match=said) as error:
        searched(recording, global_algorithm="phase", stages=("sharpness",), **settings)
    assert error.value.code is ErrorCode.OPTIONS


def test_a_recording_without_an_encoder_is_refused(recording: Recording) -> None:
    with pytest.raises(AmiwarpError, match="no encoder"):
        searched(replace(recording, encoder=None), cost="phase", start={"rpm": 720.0})


@pytest.mark.parametrize(
    ("model", "said"), [("risley", "2 angles"), ("vibration", "turning prism")]
)
def test_other_optics_are_refused(recording: Recording, model: str, said: str) -> None:
    encoder = Encoder.constant_speed(720.0, 0, 200_000)
    two = encoder.with_second(-0.7) if model == "risley" else encoder
    changed = replace(recording, encoder=two, prism=None if model == "vibration" else Prism(APEX))
    with pytest.raises(AmiwarpError, match=said):
        searched(changed, cost="phase", model=model, free=None)
