"""The inspector's values for its page: suggested region, sharpness, residuals, event rates and state."""

import json
import math
import re
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from amiwarp import (
    AmiwarpError,
    Camera,
    DepthMap,
    Encoder,
    ErrorCode,
    Events,
    MemoryEvents,
    Model,
    Plate,
    PlateModel,
    Prism,
    Recording,
    Settings,
    Sharpness,
    compensate_events,
    deflection_from_apex,
    find_background_activity,
    open_recording,
    reconstruct,
    sharpness,
    simulate,
)
from amiwarp.choices import Axis, Colour, View
from amiwarp.imaging import CanvasShape, Votes, regions
from amiwarp.imaging.export import save_values
from amiwarp.imaging.regions import suggest_region
from amiwarp.imaging.relative_variance import random_variance, relative_variance
from amiwarp.io import event_rates, spans
from amiwarp.io.event_rates import EventRates
from amiwarp.optics import MODELS
from amiwarp.optics.models.registry import size_names
from amiwarp.plotting import Scale
from amiwarp.plotting.colours import table_of
from amiwarp.viewer import (
    ImageKind,
    Inspector,
    Selection,
    ViewState,
    apply_state,
    calibration_job,
    current_state,
    decode_state,
    downloads,
    encode_state,
    estimate_phase,
    images,
    log_intensity,
    make_images,
    page_state,
    selected_part,
    window_statistics,
)
from amiwarp.viewer import inspector as viewer
from amiwarp.viewer.captions import events_text
from amiwarp.viewer.cost_surface import cost_surface, surface_marks
from amiwarp.viewer.downloads import COLUMNS, write_events
from amiwarp.viewer.images import prepare
from amiwarp.viewer.knobs import Knobs, Source, foreign_names, size_name
from amiwarp.viewer.layout import initial_state
from amiwarp.viewer.sliders import SLIDERS, UNITS, knob_values, orbit_text, sliders
from amiwarp.viewer.view_state import History
from amiwarp.viewer.window_images import thinned
from tests.errors import refused

TRUE = Prism(math.radians(1.0))


@pytest.fixture(scope="module")
def recording(texture: np.ndarray) -> Recording:
    camera, nominal = Camera.from_fov(160, 120, math.radians(60)), Prism(math.radians(1.2))
    return simulate(texture, camera, TRUE, duration_s=0.25, seed=1, nominal_prism=nominal)


@pytest.fixture
def inspector(recording: Recording) -> Inspector:
    made = Inspector(recording)
    made.take_truth()
    return made


def random_events(n: int, width: int, height: int, seed: int = 0) -> Events:
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, 100_000, n))
    x, y = (rng.integers(0, size, n).astype(np.uint16) for size in (width, height))
    return Events(x, y, t, rng.integers(0, 2, n).astype(np.uint8))


def every_other(recording: Recording) -> Recording:
    """Return a recording with half of the events, chosen at random."""
    events = recording.events.slice(0, len(recording.events))
    kept = events[np.random.default_rng(3).random(len(events)) < 0.5]
    return replace(recording, events=MemoryEvents(kept, *recording.events.size), truth=None)


# the slider of the size


def size_of(model: Model) -> float:
    """Return the size of a model: the apex of its prism, or its field."""
    return float(
        getattr(model, "prism", model).apex if model.SIZE == "apex" else getattr(model, model.SIZE)
    )


@pytest.mark.parametrize(
    ("model", "name", "label", "given", "size"),
    [
        ("exact", "apex", ("apex angle", "°"), 1.5, math.radians(1.5)),
        (
            "circle",
            "apex",
            ("apex angle", "°"),
            1.5,
            deflection_from_apex(math.radians(1.5), 1.5168),
        ),
        ("risley", "apex", ("apex angle", "°"), 1.5, math.radians(1.5)),
        ("vibration", "amplitude", ("amplitude", "°"), 0.4, math.radians(0.4)),
        ("mirror", "amplitude", ("amplitude", "°"), 0.4, math.radians(0.4)),
        ("steerer", "amplitude", ("amplitude", "°"), 0.4, math.radians(0.4)),
        ("plate", "inverse_depth", ("inverse depth", "1/m"), 1.5, 1.5),
    ],
)
def test_the_slider_of_the_size_has_name_and_unit_of_the_optic_s_own(
    model: str, name: str, label: tuple[str, str], given: float, size: float
) -> None:
    kind, encoder = MODELS[model], Encoder.constant_speed(720.0, 0, 100_000)
    recording = Recording(
        MemoryEvents(random_events(2000, 40, 30), 40, 30), Camera.from_fov(40, 30, 1.0),
        encoder.with_second(-0.5) if kind.ANGLES == 2 else encoder,
        Plate(0.01, 0.8) if model == "plate" else TRUE if kind.PRISM else None,
    )  # fmt: skip
    inspector = Inspector(recording)
    inspector.use_model(model)
    assert size_name(model) == name
    assert SLIDERS[name][:2] == label
    sizes = [each["name"] for each in sliders(inspector) if each["name"] in size_names()]
    assert sizes == [name]  # the others are not shown
    assert size_of(inspector.model) > 0.0  # a typical value, at first
    assert inspector.sources[name] is not Source.HAND
    inspector.set(inspector.knobs.with_values({name: given * UNITS[name]}))
    assert size_of(inspector.model) == pytest.approx(size, rel=1e-9)
    assert inspector.sources[name] is Source.HAND
    again = Inspector(recording, inspector.as_calibration())
    assert knob_values(again)[name] == pytest.approx(given, abs=1e-4)
    assert orbit_text(model, again.knobs.value, 0.0).startswith(
        f"{name.replace('_', ' ')} {given:g}"
    )


@pytest.mark.parametrize(
    ("shown", "calibrated"),
    [
        ("exact", "auto"),
        ("circle", "auto"),
        ("mirror", "mirror"),
        ("steerer", "steerer"),
        ("risley", "risley"),
        ("vibration", "vibration"),
    ],
)
def test_calibration_is_that_of_the_shown_optic(
    shown: str, calibrated: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    encoder, given = Encoder.constant_speed(720.0, 0, 100_000), []
    events = MemoryEvents(random_events(2000, 40, 30), 40, 30)
    encoder = encoder.with_second(-0.5) if MODELS[shown].ANGLES == 2 else encoder
    inspector = Inspector(Recording(events, Camera.from_fov(40, 30, 1.0), encoder))
    inspector.use_model(shown)

    def refusing(recording: Recording, settings: Settings, **_: Any) -> None:
        given.append(settings.model)
        raise AmiwarpError("enough")

    monkeypatch.setattr(calibration_job, "calibrate", refusing)
    with pytest.raises(AmiwarpError, match="enough"):
        calibration_job.find_calibration(inspector)
    assert given == [calibrated] * 2  # the second time by sharpness alone


def test_a_recording_that_names_its_optic_is_shown_with_its_model() -> None:
    events, encoder = (
        MemoryEvents(random_events(2000, 40, 30), 40, 30),
        Encoder.constant_speed(720.0, 0, 100_000),
    )
    recording = Recording(events, Camera.from_fov(40, 30, 1.0), encoder.with_second(-0.5))
    assert Inspector(recording).knobs.model == "risley"  # two angles may be those of two prisms
    inspector = Inspector(replace(recording, metadata={"optic": "mirror"}))
    assert inspector.knobs.model == "mirror"
    assert inspector.show().sharpness_after != inspector.show().sharpness_before


# depth maps of recordings behind a plate


def behind_a_plate() -> tuple[Inspector, np.ndarray]:
    """Return an inspector with a depth map, and the inverse depths: known in the left half, of two values."""
    camera, plate = Camera.from_fov(40, 30, 1.0), Plate(0.01, 0.8)
    source = MemoryEvents(random_events(4000, 40, 30), 40, 30)
    recording = Recording(source, camera, Encoder.constant_speed(720.0, 0, 100_000), plate)
    inverse = np.full((30, 40), np.nan, np.float32)
    inverse[:15, :20], inverse[15:, :20] = 2.0, 1.25
    y, x = np.mgrid[:30, :40]
    points = (
        camera.pixels_to_rays(np.stack([x.ravel(), y.ravel()], axis=1)).reshape(30, 40, 3)
        / inverse[..., None]
    )
    inspector = Inspector(recording)
    inspector.use_depths(DepthMap(inverse, 0.05 * inverse, points.astype(np.float32)))
    inspector.set(replace(inspector.knobs, phase=0.4))
    return inspector, inverse


def test_events_behind_a_plate_are_compensated_at_the_depths_of_the_map() -> None:
    inspector, inverse = behind_a_plate()
    shown = inspector.show()
    assert inspector.depth is not None
    xy, filled = shown.before, inspector.depth.filled()
    plane = PlateModel(inspector.camera, Plate(0.01, 0.8), 0.4)
    theta = inspector.encoder.angle_at(shown.events.t)
    expected = plane.compensate_at(xy, theta, filled[shown.events.y, shown.events.x])
    np.testing.assert_allclose(shown.after, expected, rtol=0, atol=2e-3)  # px
    assert np.abs(shown.after - xy).max() > 0.2
    unmoved = inspector.show(replace(inspector.knobs, others=())).after  # without the plate
    np.testing.assert_allclose(unmoved, xy, rtol=0, atol=1e-5)
    # of a part of the image, every second column and row
    part = replace(inspector.camera, width=10, height=8, fx=inspector.camera.fx / 2, fy=inspector.camera.fy / 2,
                   cx=(inspector.camera.cx - 6) / 2, cy=(inspector.camera.cy - 10) / 2)  # fmt: skip
    small = inspector.model_of(inspector.knobs, part, np.s_[10:26:2, 6:26:2])
    at = np.array([[0.0, 0.0], [9.0, 7.0], [3.0, 2.0]])
    angles = np.array([0.0, 1.0, 2.0])
    moved = small.compensate_points(at, angles)
    np.testing.assert_allclose(
        2.0 * moved + [6.0, 10.0],
        inspector.model.compensate_points(2.0 * at + [6.0, 10.0], angles),
        rtol=0,
        atol=2e-3,
    )
    # the drawn orbit is that of a point at the depth of its pixel
    for x, y in ((5.0, 20.0), (5.0, 4.0)):
        theta, orbit = inspector.orbit(x, y)
        own = replace(plane, inverse_depth=float(inverse[int(y), int(x)]))
        np.testing.assert_allclose(
            own.compensate_points(orbit, theta.astype(np.float32)), [[x, y]] * 181, atol=2e-3
        )


def test_a_depth_map_is_shown_in_metres_with_unknown_pixels_in_a_colour_of_their_own() -> None:
    inspector, inverse = behind_a_plate()
    inspector.open(*inspector.first_window(), Selection(region=(4, 3, 36, 28)))
    images, counts = (make_images(inspector, kind) for kind in (ImageKind.DEPTH, ImageKind.COUNT))
    assert images.before is not None
    np.testing.assert_array_equal(images.before, counts.before)
    np.testing.assert_allclose(images.after, 1.0 / inverse[3:28, 4:36], rtol=1e-6)
    scale = images.after_scale
    assert scale is not None
    assert (scale.low, scale.high, scale.label) == (
        pytest.approx(0.5),
        pytest.approx(0.8),
        "depth [m]; blue: unknown",
    )
    rgb, table = scale.rgb(images.after), table_of(scale.colours).astype(int)
    missing = rgb[np.isnan(images.after)].astype(int)
    assert len(np.unique(missing, axis=0)) == 1
    assert np.abs(table - missing[0]).max(axis=1).min() > 60  # no colour of the scale is near
    state = page_state.picture_state(images.after, scale)
    assert state["missing"] == [*missing[0].tolist(), "unknown"]
    assert (np.frombuffer(state["values"], np.float32) == images.after.ravel())[
        ~np.isnan(images.after.ravel())
    ].all()
    assert initial_state(inspector)["kinds"] == [kind.value for kind in ImageKind]
    assert "depth" not in initial_state(Inspector(inspector.recording))["kinds"]
    with pytest.raises(AmiwarpError, match="there is no depth map"):
        make_images(Inspector(inspector.recording), ImageKind.DEPTH)


def test_a_depth_map_of_another_optic_or_size_is_refused(inspector: Inspector) -> None:
    behind, inverse = behind_a_plate()
    depth = behind.depth
    assert depth is not None
    with pytest.raises(
        AmiwarpError, match="a depth map is for a rotating tilted plate, but a prism moves"
    ):
        inspector.use_depths(depth)
    with pytest.raises(AmiwarpError, match="the camera's rows and columns"):
        behind.use_depths(DepthMap(inverse[1:], inverse[1:], depth.points[1:]))
    assert behind.depth is depth


# sharpness


@pytest.mark.parametrize("smoothing", [0.0, 1.0, 2.0])
@pytest.mark.parametrize("n", [20_000, 200_000])
def test_random_events_have_no_sharpness(n: int, smoothing: float) -> None:
    rng = np.random.default_rng(1)
    width, height = 200, 150
    votes = Votes(CanvasShape(width, height), "cpu")
    x, y = (rng.uniform(-0.5, side - 0.5, n).astype(np.float32) for side in (width, height))
    votes.add_unmoved(Events(x, y, np.zeros(n, np.int64), np.zeros(n, np.uint8)))
    image = votes.take()[0][8:-8, 8:-8]
    found = sharpness(image, Sharpness.VARIANCE, smoothing=smoothing)
    pixels = image.size
    noise = random_variance(smoothing) * math.sqrt(
        2.0 * 4.0 * math.pi * max(smoothing, 0.4) ** 2 / pixels
    )
    border = 0.1 * smoothing * float(image.mean())  # smoothing darkens the border
    assert found == pytest.approx(random_variance(smoothing), abs=4.0 * noise + border)
    assert relative_variance(found, float(image.mean()), smoothing) == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize("region", [None, (30, 20, 110, 80)])
def test_half_of_the_events_have_the_same_sharpness(
    recording: Recording, inspector: Inspector, region: tuple[int, int, int, int] | None
) -> None:
    window = inspector.first_window()
    inspector.open(*window, Selection(region=region))
    half = Inspector(every_other(recording))
    half.open(*window, Selection(region=region))
    all_of_them, some = inspector.show(), half.show(inspector.knobs)
    assert some.selected == pytest.approx(0.5 * all_of_them.selected, rel=0.05)
    for name in ("sharpness_before", "sharpness_after"):
        assert getattr(some, name) == pytest.approx(getattr(all_of_them, name), rel=0.03)
    assert all_of_them.sharpness_after > 1.2 * all_of_them.sharpness_before


def test_the_curve_and_the_images_have_one_sharpness(inspector: Inspector) -> None:
    inspector.open(*inspector.first_window(), Selection(region=(30, 20, 110, 80)))
    values, scores = inspector.curve("apex")
    at_apex = np.interp(inspector.knobs.apex, values, scores)
    assert at_apex == pytest.approx(inspector.show().sharpness_after, rel=0.03)


def test_events_that_move_into_a_region_are_in_its_image(inspector: Inspector) -> None:
    window, region = inspector.first_window(), (40, 30, 90, 70)
    inspector.open(*window)
    whole = inspector.show()
    inspector.open(*window, Selection(region=region))
    part = inspector.show()
    left, top, right, bottom = region
    for name in ("image_before", "image_after"):
        cut, expected = (getattr(shown, name)[top:bottom, left:right] for shown in (part, whole))
        assert cut.sum() == pytest.approx(expected.sum(), rel=2e-3)
    assert ((part.before >= (left, top)) & (part.before < (right, bottom))).all()


# suggested region


def test_the_region_with_the_largest_gain_is_suggested() -> None:
    rng = np.random.default_rng(0)
    before = rng.poisson(4.0, (300, 400)).astype(np.float32)
    before[40, 50] = before[41, 300] = 5000.0  # hot pixels
    after = before.copy()
    after[150:240, 230:340] = np.where(np.arange(110) % 10 < 2, 20.0, 0.0)
    left, top, right, bottom = found = suggest_region(before, after)
    assert right - left == 120
    assert bottom - top == 90
    assert left == pytest.approx(225, abs=12)
    assert top == pytest.approx(150, abs=12)
    # Without a gain, where most structure is
    assert suggest_region(after, after) == pytest.approx(found, abs=12)


@pytest.mark.parametrize("shape", [(3, 5), (60, 80), (10, 1000), (1000, 10), (720, 1280)])
def test_a_suggested_region_lies_in_the_image(shape: tuple[int, int]) -> None:
    for image in (np.zeros(shape, np.float32), np.eye(*shape, dtype=np.float32)):
        left, top, right, bottom = suggest_region(image, image)
        assert 0 <= left < right <= shape[1]
        assert 0 <= top < bottom <= shape[0]
        assert right - left <= 120


def test_compensation_sharpens_the_suggested_region(inspector: Inspector) -> None:
    whole, found = inspector.show(), inspector.suggest_region()
    span = inspector.loaded.span
    inspector.open(span.start_us, span.length_us, Selection(region=found))
    shown = inspector.show()
    assert shown.sharpness_after > 1.3 * shown.sharpness_before
    assert (
        shown.sharpness_after - shown.sharpness_before
        > whole.sharpness_after - whole.sharpness_before
    )
    assert inspector.suggest_region() == found  # a region that is shown does not matter


def test_edges_that_come_from_outside_suggest_no_region() -> None:
    rng = np.random.default_rng(0)
    before = rng.poisson(4.0, (300, 400)).astype(np.float32)
    after = before.copy()
    after[150:240, 230:340] = np.where(np.arange(110) % 10 < 2, 20.0, 0.0)
    before[:90, :120] = 0.05
    after[:90, :120] = np.where(np.arange(120) < 4, 40.0, 0.05)
    left, top, _, _ = suggest_region(before, after)
    assert left > 120
    assert top > 90


def test_neither_the_border_nor_an_empty_part_counts_as_a_gain() -> None:
    """Compensation moves events away from the border, and both parts with edges get sharper, the full one by more."""
    rng = np.random.default_rng(0)
    before, columns = rng.poisson(4.0, (300, 400)).astype(np.float32), np.arange(130)
    after = before.copy()
    for image, full, empty in ((before, 5, 10), (after, 2, 6)):
        image[150:250, 230:360] = np.where(columns % 10 < full, 60.0 / full, 0.0)
        image[150:250, 60:190] = np.where(abs(columns - 65) < empty / 2, 300.0 / empty, 0.0)
    after[:8], after[:, :8] = 0.0, 0.0
    left, top, right, bottom = suggest_region(before, after, margin=10)
    assert left >= 220
    assert right <= 370
    before[20:], after[20:] = 4.0, 4.0
    left, top, right, bottom = suggest_region(before, after, margin=10)
    assert min(left, top, 400 - right, 300 - bottom) >= 10


# estimate of the phase


@pytest.mark.parametrize("phase", [-2.6, 0.0, 1.3])
def test_an_unknown_phase_is_estimated(recording: Recording, phase: float) -> None:
    encoder = recording.encoder
    assert encoder is not None
    turned = replace(recording, encoder=Encoder(encoder.t, encoder.angle - phase), truth=None)
    inspector = Inspector(turned)
    assert estimate_phase(inspector)
    assert math.remainder(inspector.knobs.phase - phase, math.tau) == pytest.approx(
        0.0, abs=math.radians(6.0)
    )
    assert inspector.sources["phase"] == "estimated"
    shown = inspector.show()
    assert shown.sharpness_after > 1.1 * shown.sharpness_before
    assert not estimate_phase(inspector)  # it is no longer unknown


def test_a_phase_is_kept_if_it_is_known_or_sharpens_nothing(recording: Recording) -> None:
    by_hand = Inspector(recording)
    by_hand.set(replace(by_hand.knobs, phase=1.0))
    flat = MemoryEvents(random_events(50_000, 160, 120), 160, 120)
    without = replace(recording, encoder=None, truth=None)
    for inspector in (
        by_hand,
        Inspector(replace(recording, events=flat, truth=None)),
        Inspector(without),
    ):
        before = inspector.knobs, inspector.sources["phase"]
        assert not estimate_phase(inspector)
        assert (inspector.knobs, inspector.sources["phase"]) == before


# background activity


def reference_background(events: Events, window_us: int) -> np.ndarray:
    out = np.ones(len(events), np.bool_)
    for k in range(len(events)):
        dx = np.abs(events.x[:k].astype(int) - int(events.x[k]))
        dy = np.abs(events.y[:k].astype(int) - int(events.y[k]))
        near = (np.maximum(dx, dy) == 1) & (events.t[k] - events.t[:k] <= window_us)
        out[k] = not near.any()
    return out


def test_background_activity_is_what_no_neighbour_supports() -> None:
    events = random_events(1500, 24, 17)
    for window_us in (1, 500, 5000):
        found = find_background_activity(events, (24, 17), window_us=window_us)
        np.testing.assert_array_equal(found, reference_background(events, window_us))
    assert not find_background_activity(Events.empty(), (4, 4)).size


def test_background_activity_needs_events_of_a_sensor() -> None:
    events = random_events(10, 24, 17)
    with pytest.raises(AmiwarpError, match="window_us = 0"):
        find_background_activity(events, (24, 17), window_us=0)
    with pytest.raises(AmiwarpError, match="outside"):
        find_background_activity(events, (5, 5))
    moved = Events(events.x.astype(np.float32), events.y.astype(np.float32), events.t, events.p)
    with pytest.raises(AmiwarpError, match="compensated"):
        find_background_activity(moved, (24, 17))


def test_the_noise_filter_leaves_events_out(inspector: Inspector) -> None:
    window = inspector.first_window()
    inspector.open(*window)
    everything = inspector.show().selected
    inspector.open(*window, Selection(noise_us=2000))
    assert 0.3 * everything < inspector.show().selected < everything


# parameters


def test_every_parameter_has_a_source(recording: Recording, inspector: Inspector) -> None:
    truth = inspector.truth
    assert truth is not None
    assert truth.apex == TRUE.apex
    assert inspector.knobs == truth
    foreign = foreign_names(truth.model)
    assert {source for name, source in inspector.sources.items() if name not in foreign} == {
        Source.TRUTH,
        Source.FILE,
    }
    assert {inspector.sources[name] for name in foreign & inspector.sources.keys()} == {
        Source.ASSUMED
    }
    fresh = Inspector(recording)
    assert fresh.sources["apex"] is Source.FILE
    assert fresh.sources["phase"] is Source.ASSUMED
    fresh.set(replace(fresh.knobs, phase=0.3))
    assert fresh.sources["phase"] is Source.HAND
    assert fresh.sources["tilt_x"] is Source.ASSUMED
    made = fresh.as_calibration()
    fresh.accept(replace(made, free=("apex", "phase")))
    assert fresh.sources["apex"] is fresh.sources["model"] is Source.CALIBRATED
    assert fresh.sources["tilt_x"] is Source.FILE
    bare = Inspector(replace(recording, truth=None, prism=None, encoder=None, camera=None))
    assert bare.truth is None
    assert set(bare.sources.values()) == {Source.ASSUMED}
    with pytest.raises(AmiwarpError, match="no true parameters"):
        bare.take_truth()


def test_a_closed_inspector_measures_no_longer(inspector: Inspector) -> None:
    """So a server ends soon, even in the middle of a curve of a large sensor."""
    measure = inspector.sharpness_meter()
    measure(inspector.knobs)
    inspector.close()
    with pytest.raises(AmiwarpError, match="is closed"):
        measure(inspector.knobs)


def test_of_a_large_image_the_square_with_most_events_is_searched(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(0)
    before = rng.poisson(1.0, (700, 900)).astype(np.float32)
    before[320:640, 512:832] += 3.0
    after = before.copy()
    after[450:540, 600:700] = np.where(np.arange(100) % 10 < 2, 20.0, 0.0)
    monkeypatch.setattr(regions, "MOST_SEARCHED", 330**2)
    assert regions.busiest(before) == (512, 320, 832, 640)
    left, top, right, bottom = suggest_region(before, after)
    assert 590 < left < right < 720
    assert 440 < top < bottom < 560


def test_two_sets_of_parameters_are_compared(inspector: Inspector) -> None:
    wrong = replace(inspector.knobs, phase=inspector.knobs.phase + math.pi)
    both = inspector.show(against=wrong)
    alone = inspector.show(wrong)
    np.testing.assert_array_equal(both.before, alone.after)
    np.testing.assert_array_equal(both.image_before, alone.image_after)
    assert both.sharpness_before == alone.sharpness_after < both.sharpness_after
    np.testing.assert_array_equal(both.after, inspector.show().after)


def test_a_calibration_without_encoder_keeps_its_phase(recording: Recording) -> None:
    """The time at which the angle is 0 differs between inspector and calibration."""
    encoder = recording.encoder
    assert encoder is not None
    inspector = Inspector(replace(recording, encoder=None))
    inspector.set(replace(Knobs(), apex=TRUE.apex, phase=0.4, rpm=720.0))
    made = inspector.as_calibration()
    assert made.zero_us == inspector.zero_us
    later = 10_000
    shift = 720.0 * math.tau / 60e6 * later
    moved = replace(
        made,
        zero_us=inspector.zero_us + later,
        parameters={**made.parameters, "phase": 0.4 + shift},
    )
    other = Inspector(replace(recording, encoder=None), moved)
    np.testing.assert_allclose(other.show().after, inspector.show().after, atol=2e-3)
    assert other.as_calibration() is moved


def test_a_constant_speed_equals_its_encoder(recording: Recording, inspector: Inspector) -> None:
    steady = Encoder.constant_speed(720.0, 0, recording.events.t_last)
    with_encoder = Inspector(replace(recording, encoder=steady))
    with_encoder.set(inspector.knobs)
    without = Inspector(replace(recording, encoder=None))
    zero = float(steady.angle_at([without.zero_us])[0])
    without.set(replace(inspector.knobs, rpm=720.0, phase=inspector.knobs.phase + zero))
    without.open(*with_encoder.first_window())
    np.testing.assert_allclose(without.show().after, with_encoder.show().after, atol=5e-3)


# kinds of images


def test_counts_and_polarities_are_those_of_the_window(inspector: Inspector) -> None:
    region = (30, 20, 110, 80)
    inspector.open(*inspector.first_window(), Selection(region=region))
    shown, counts = inspector.show(), make_images(inspector, ImageKind.COUNT)
    two = make_images(inspector, ImageKind.POLARITY)
    left, top, right, bottom = region
    for both, one, of_window in (
        (two.before, counts.before, shown.image_before),
        (two.after, counts.after, shown.image_after),
    ):
        assert both is not None
        assert one is not None
        np.testing.assert_array_equal(one, of_window[top:bottom, left:right])
        np.testing.assert_array_equal(both.sum(axis=0), one)
        np.testing.assert_array_equal(one, np.rint(one))
    events = inspector.loaded.counted
    expected = np.zeros((inspector.camera.height, inspector.camera.width))
    np.add.at(expected, (events.y, events.x), 1)
    np.testing.assert_array_equal(counts.before, expected[top:bottom, left:right])
    assert two.scale.colours == "polarity"
    assert counts.scale.unit == "per pixel"
    change = make_images(inspector, ImageKind.COUNT, difference=True)
    np.testing.assert_array_equal(change.after, counts.after - counts.before)
    assert change.after_scale is not None
    assert change.after_scale.high == np.abs(change.after).max()
    assert change.after_scale.low == -change.after_scale.high
    inspector.open(*inspector.first_window(), Selection(region=region, polarity=1))
    only_on = make_images(inspector, ImageKind.POLARITY).after
    assert not only_on[0].any()
    np.testing.assert_array_equal(only_on[1], two.after[1])


def test_a_time_surface_holds_the_latest_times(inspector: Inspector) -> None:
    inspector.open(*inspector.first_window())
    found = make_images(inspector, ImageKind.TIME_SURFACE)
    window = inspector.loaded
    expected = np.full(found.after.shape, np.nan)
    for x, y, t in zip(window.counted.x, window.counted.y, window.counted.t, strict=True):
        expected[y, x] = (t - window.span.start_us) * 1e-3
    assert found.before is not None
    np.testing.assert_allclose(found.before, expected, atol=1e-4)
    # Compensated events gather
    assert np.isfinite(found.after).sum() < np.isfinite(found.before).sum()
    assert found.scale.unit == "ms"
    assert np.nanmax(found.after) <= found.scale.high


def test_a_log_intensity_is_that_of_the_scene(inspector: Inspector) -> None:
    region = (30, 20, 110, 80)
    inspector.open(*inspector.first_window(), Selection(region=region))
    found = make_images(inspector, ImageKind.LOG_INTENSITY)
    assert found.before is None
    assert found.after.shape == (60, 80)
    whole = reconstruct(
        inspector.recording, model=inspector.model, start_us=inspector.loaded.span.start_us,
        length_us=inspector.loaded.span.length_us,
    ).log[20:80, 30:110]  # fmt: skip
    assert np.corrcoef(found.after.ravel(), whole.ravel())[0, 1] > 0.95
    wrong = replace(inspector.knobs, phase=inspector.knobs.phase + math.pi)
    both = make_images(inspector, ImageKind.LOG_INTENSITY, against=wrong)
    np.testing.assert_array_equal(both.after, found.after)
    assert both.before is not None
    assert np.corrcoef(both.before.ravel(), whole.ravel())[0, 1] < 0.8


def test_differences_are_thinned_to_the_values_farthest_from_zero() -> None:
    values = np.array([[0.0, -3.0, 1.0], [2.0, 0.0, np.nan], [0.0, 0.0, -1.0]], np.float32)
    np.testing.assert_array_equal(thinned(values, 2, signed=True), [[-3.0, 1.0], [0.0, -1.0]])
    np.testing.assert_array_equal(thinned(values, 2), [[2.0, 1.0], [0.0, -1.0]])


def test_edges_are_where_the_log_intensity_changes(inspector: Inspector) -> None:
    region = (30, 20, 110, 80)
    inspector.open(*inspector.first_window(), Selection(region=region))
    edges = make_images(inspector, ImageKind.EDGES)
    assert edges.before is None
    assert edges.after.shape == (60, 80)
    log = make_images(inspector, ImageKind.LOG_INTENSITY).after
    rows, columns = np.gradient(gaussian_filter(log, 1.0))
    expected = np.hypot(rows, columns)
    assert np.corrcoef(edges.after.ravel(), expected.ravel())[0, 1] > 0.8
    ratio = (edges.after * expected).sum() / (expected**2).sum()
    assert 0.8 < ratio < 1.25
    assert edges.note.startswith("1 turn from ")


def test_the_misfit_tells_wrong_parameters(inspector: Inspector) -> None:
    inspector.open(*inspector.first_window())
    wrong = replace(inspector.knobs, phase=inspector.knobs.phase + math.pi / 2.0)
    found = make_images(inspector, ImageKind.MISFIT, against=wrong)
    assert found.before is not None
    assert np.nanmedian(found.before) > np.nanmedian(found.after) + 0.1
    assert (found.scale.low, found.scale.high) == (0.0, 1.0)
    assert found.scale.missing_text == "hardly any events"


def test_a_short_window_is_lengthened_to_a_turn(inspector: Inspector) -> None:
    start_us, length_us = inspector.first_window()
    inspector.open(start_us, length_us)
    expected = make_images(inspector, ImageKind.EDGES).after
    inspector.open(start_us, length_us // 5)
    np.testing.assert_array_equal(make_images(inspector, ImageKind.EDGES).after, expected)
    last_us = inspector.recording.events.t_last - length_us // 5
    inspector.open(last_us, length_us // 5)
    assert np.isfinite(make_images(inspector, ImageKind.EDGES).after).all()


def test_an_optic_at_rest_has_no_edges_in_phase(inspector: Inspector) -> None:
    inspector.open(*inspector.first_window())
    plain = Inspector(replace(inspector.recording, encoder=None))
    plain.open(*plain.first_window())
    with pytest.raises(AmiwarpError, match="an optic that rotates"):
        make_images(plain, ImageKind.EDGES)


def test_the_camera_of_a_part_sees_along_the_same_rays(inspector: Inspector) -> None:
    inspector.open(*inspector.first_window())
    for most, step in ((math.inf, 1), (12_000.0, 2)):
        part, _, _, found = selected_part.select_part(
            inspector, inspector.loaded, (30, 20, 110, 80), most=most
        )
        assert found == step
        assert part.camera is not None
        xy = np.array([[0.0, 0.0], [13.0, 7.0], [39.0, 29.0]])
        expected = inspector.camera.pixels_to_rays(np.array([30.0, 20.0]) + step * xy)
        np.testing.assert_allclose(part.camera.pixels_to_rays(xy), expected, rtol=0, atol=1e-6)


def test_preparing_a_log_intensity_does_not_change_it(
    inspector: Inspector, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(images, "_prepared", set())
    expected = make_images(inspector, ImageKind.LOG_INTENSITY).after
    inspector.loaded.last_picture.clear()
    prepare(inspector)
    assert images._prepared == {"cpu"}
    assert inspector.loaded.last_picture == []
    np.testing.assert_array_equal(make_images(inspector, ImageKind.LOG_INTENSITY).after, expected)


def test_the_smoothness_of_a_log_intensity_is_chosen_again_if_the_residual_changes(
    inspector: Inspector,
) -> None:
    inspector.open(*inspector.first_window(), Selection(region=(30, 20, 110, 80)))
    make_images(inspector, ImageKind.LOG_INTENSITY)
    (first,) = inspector.loaded.last_picture
    truth = inspector.knobs
    inspector.set(replace(truth, apex=1.01 * truth.apex))
    make_images(inspector, ImageKind.LOG_INTENSITY)
    assert inspector.loaded.last_picture == [first]
    inspector.set(replace(truth, phase=truth.phase + math.pi))
    make_images(inspector, ImageKind.LOG_INTENSITY)
    (other,) = inspector.loaded.last_picture
    assert other.residual > 2.0 * first.residual
    inspector.set(truth)
    make_images(inspector, ImageKind.LOG_INTENSITY)
    (again,) = inspector.loaded.last_picture
    np.testing.assert_array_equal(again.log, first.log)


def test_a_log_intensity_needs_a_prism_that_rotates(recording: Recording) -> None:
    with pytest.raises(AmiwarpError, match="a prism that rotates"):
        make_images(Inspector(replace(recording, encoder=None)), ImageKind.LOG_INTENSITY)


def test_a_log_intensity_of_a_large_image_uses_a_part_of_its_pixels(
    inspector: Inspector, monkeypatch: pytest.MonkeyPatch
) -> None:
    inspector.open(*inspector.first_window())
    whole = make_images(inspector, ImageKind.LOG_INTENSITY).after
    monkeypatch.setattr(log_intensity, "MOST_WORK", 20_000)
    monkeypatch.setattr(selected_part, "MOST_EVENTS", 40_000)
    found = make_images(inspector, ImageKind.LOG_INTENSITY)
    assert found.after.shape == whole.shape
    assert "25 % of the pixels" in found.note
    assert "ms in the middle" in found.note
    assert np.corrcoef(found.after.ravel(), whole.ravel())[0, 1] > 0.5
    # As calibrated, and the same
    inspector.set(replace(inspector.knobs, focal_length=inspector.camera.fx))
    np.testing.assert_allclose(
        make_images(inspector, ImageKind.LOG_INTENSITY).after, found.after, rtol=0, atol=1e-4
    )


def test_a_scale_gives_colours_and_marks() -> None:
    scale = Scale("events", "per pixel", 0.0, 100.0, "gray", 0.5)
    colours = scale.rgb(np.array([[0.0, 25.0, 100.0, 400.0, np.nan]]))
    assert colours[0, :, 0].tolist() == [0, 127, 255, 255, 0]
    assert scale.ticks() == ((0.0, "0"), (0.5, "25"), (pytest.approx(0.7071, abs=1e-3), "50"),
                             (pytest.approx(0.866, abs=1e-3), "75"), (1.0, "100"))  # fmt: skip
    # There is no half event
    assert [text for _, text in replace(scale, high=3.0).ticks()] == [
        "0",
        "1",
        "2",
        "3",
    ]
    two = Scale("events", "per pixel", 0.0, 10.0, "polarity").rgb(
        np.array([[[10.0, 0.0, 0.0]], [[0.0, 10.0, 0.0]]])
    )
    assert two[0, 0, 2] > two[0, 0, 0]  # OFF is blue
    assert two[0, 1, 0] > two[0, 1, 2]
    assert not two[0, 2].any()


# event rates


def expected_rates(events: Events, edges: np.ndarray) -> np.ndarray:
    counts = np.array([np.diff(np.searchsorted(events.t[events.p == p], edges)) for p in (0, 1)])
    return np.asarray(counts / np.diff(edges) * 1e6)


def test_rates_are_counted_at_any_zoom(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(event_rates, "MOST_BINS", 4096)
    events = random_events(50_000, 16, 16)
    rates = EventRates(MemoryEvents(events, 16, 16))
    assert rates.share == 0.0
    assert rates.fill(60.0)
    assert rates.share == 1.0
    first, stop = int(events.t[0]), int(events.t[-1]) + 1
    for start, end, bins in ((first, stop, 100), (first, stop, 7), (first - 5000, stop + 5000, 50),
                             (40_000, 41_000, 200), (40_000, 40_010, 200), (0, 60_000, 4000)):  # fmt: skip
        edges, found = rates.curve(start, end, bins)
        assert (edges[0], edges[-1]) == (start, end)
        assert found.shape[1] <= bins
        expected, lengths = expected_rates(events, edges), np.diff(edges)
        # an edge between two edges of the recording's bins counts part of a bin in the next one
        most = 3.0 * 25.0 / lengths.min() * 1e6 * 0.5
        assert np.abs(found[1] - expected[1]).max() <= most
        np.testing.assert_allclose(
            (found * lengths).sum(axis=1), (expected * lengths).sum(axis=1), rtol=2e-3
        )
    edges, exact = rates.curve(40_000, 41_000, 200)
    assert exact.shape == (2, 200)
    np.testing.assert_array_equal(exact, expected_rates(events, edges))
    monkeypatch.setattr(event_rates, "MOST_EXACT", 10)
    edges, coarse = rates.curve(40_000, 41_000, 200)
    assert 30 < coarse.shape[1] < 60
    np.testing.assert_allclose(coarse[0, 1:-1], expected_rates(events, edges)[0, 1:-1])


class BreakingOff(MemoryEvents):
    """Events whose second block cannot be read."""

    def blocks(self, **_: Any) -> Iterator[Events]:
        yield self.slice(0, 1000)
        raise AmiwarpError("the rest cannot be read")


def test_rates_of_a_damaged_recording_are_unknown_after_the_damage() -> None:
    events = random_events(3000, 16, 16)
    rates = EventRates(BreakingOff(events, 16, 16))
    with pytest.raises(AmiwarpError, match="cannot be read"):
        rates.fill(60.0)
    assert rates.ended
    assert rates.fill(60.0)
    assert 0.3 < rates.share < 0.4
    first, stop = int(events.t[0]), int(events.t[-1]) + 1
    _, found = rates.curve(first, stop, 30)
    assert np.isfinite(found[:, :9]).all()
    assert np.isnan(found[:, 11:]).all()


def test_rates_are_known_as_far_as_the_recording_is_read(tmp_path: Path) -> None:
    events = random_events(3 * (1 << 20), 16, 16)
    stretched = Events(events.x, events.y, events.t * 1000, events.p)
    rates = EventRates(MemoryEvents(stretched, 16, 16))
    first, stop = int(stretched.t[0]), int(stretched.t[-1]) + 1
    assert np.isnan(rates.curve(first, stop, 100)[1]).all()
    assert not rates.fill(0.0)
    assert rates.share == pytest.approx(1 / 3, abs=0.01)
    _, some = rates.curve(first, stop, 90)
    assert np.isfinite(some[:, :29]).all()
    assert np.isnan(some[:, 31:]).all()
    while not rates.fill(0.0):
        pass
    edges, full = rates.curve(first, stop, 90)
    np.testing.assert_array_equal(full[:, :29], some[:, :29])
    assert (full[1] * np.diff(edges)).sum() * 1e-6 == pytest.approx(stretched.p.sum())
    text = tmp_path / "events.txt"
    text.write_text("".join(f"{k * 1e-3:.6f} 1 2 {k % 2}\n" for k in range(1000)))
    of_file = EventRates(open_recording(text).events)
    assert of_file.fill(60.0)
    np.testing.assert_allclose(of_file.curve(0, 999_000, 9)[1], 500.0, rtol=0.02)


# state


def decode(
    query: str, default: ViewState, inspector: Inspector
) -> tuple[ViewState, tuple[str, ...]]:
    events = inspector.recording.events
    return decode_state(
        query, default, size=events.size, duration_us=events.t_last - events.t_first + 1
    )


def test_a_state_comes_back_from_its_address(inspector: Inspector, recording: Recording) -> None:
    default = current_state(Inspector(recording))
    assert encode_state(default, default) == ""
    assert decode("", default, inspector) == (default, ())
    state = replace(
        default, start_us=12_345, length_us=40_001, selection=Selection(0, (3, 4, 160, 120), True, 1500),
        knobs=replace(inspector.knobs, phase=-0.5, clock_offset=-120.5, model="circle"), image=ImageKind.TIME_SURFACE,
        colour=Colour.RESIDUAL, axis=Axis.TIME, view=View.XY, overlaid=True, against=replace(inspector.knobs, apex=0.0),
        sources=tuple(inspector.sources.items()),
    )  # fmt: skip
    query = encode_state(state, default)
    assert len(query) < 600
    found, wrong = decode("?" + query, default, inspector)
    assert wrong == ()
    for ours, given in ((found.knobs, state.knobs), (found.against, state.against)):
        assert ours is not None
        assert given is not None
        assert ours.model == given.model
        assert ours.phase == pytest.approx(given.phase, rel=1e-9)
        assert ours.apex == pytest.approx(given.apex, rel=1e-9)
        assert ours.clock_offset == given.clock_offset
    assert replace(found, knobs=state.knobs, against=state.against) == state


@pytest.mark.parametrize(
    "query",
    [
        "apex=nan", "apex=inf", "apex=-1", "apex=1e400", "apex=", "apex", "phase=x", "model=sphere", "image=film",
        "region=1,2,3", "region=5,5,5,9", "region=0,0,999,9", "region=-1,0,9,9", "region=1.5,0,9,9", "start_ms=-1",
        "start_ms=1e99", "length_ms=0", "polarity=2", "hide_hot=yes", "noise_us=-5", "noise_us=\u0663", "sources=apex",
        "sources=x:hand", "sources=apex:god", "unknown=1", "b_=1", "b_model=", "%ff=%ff", "<script>=1",
        "focal_length=0", "region=0,0,161,9", "region=0,0,9,121",
    ],
)  # fmt: skip
def test_a_wrong_address_is_explained_and_the_rest_is_taken(
    inspector: Inspector, query: str
) -> None:
    default = current_state(inspector)
    found, wrong = decode(f"{query}&polarity=on", default, inspector)
    assert found.selection == Selection(polarity=1)
    assert replace(found, selection=default.selection) == default
    assert len(wrong) == 1
    assert wrong[0].startswith("the address gives")


def test_a_long_address_is_refused(inspector: Inspector) -> None:
    default = current_state(inspector)
    found, wrong = decode("apex=1&" * 2000, default, inspector)
    assert found == default
    assert "14,000 characters" in wrong[0]


def test_states_are_undone_and_redone(inspector: Inspector) -> None:
    first = current_state(inspector)
    history = History(first)
    assert not history.can_undo
    assert history.undo() == history.redo() == first
    dragged = [replace(first, knobs=replace(first.knobs, apex=apex)) for apex in (0.01, 0.02, 0.03)]
    for state in dragged:
        history.add(state, "apex")
    moved = replace(dragged[-1], start_us=5)
    history.add(moved, "window")
    assert history.undo() == dragged[-1]
    assert history.can_redo
    assert history.undo() == first
    assert history.redo() == dragged[-1]
    assert history.redo() == history.redo() == moved
    history.undo()
    history.add(first)
    assert not history.can_redo
    assert history.undo() == dragged[-1]
    for k in range(1000):
        history.add(replace(first, start_us=k))
    undone = 0
    while history.can_undo:
        history.undo()
        undone += 1
    assert undone == 199


def test_a_state_sets_the_inspector(inspector: Inspector, recording: Recording) -> None:
    inspector.open(*inspector.first_window(), Selection(region=(10, 10, 80, 70)))
    state, shown = current_state(inspector), inspector.show()
    other = Inspector(recording)
    apply_state(other, state)
    assert current_state(other) == state
    np.testing.assert_array_equal(other.show().after, shown.after)
    empty = replace(state, selection=Selection(region=(0, 0, 1, 1)), length_us=1, knobs=Knobs())
    with pytest.raises(AmiwarpError, match="another window"):
        apply_state(other, empty)
    assert current_state(other) == state


def test_camera_and_index_set_by_hand_are_undone_and_in_the_address(recording: Recording) -> None:
    made = Inspector(replace(recording, camera=None, prism=None))
    history = History(first := current_state(made))
    made.set_camera(72.5)
    made.set_index(1.7)
    history.add(by_hand := current_state(made))
    shown = made.show().after
    apply_state(made, history.undo())
    assert (made.fov_deg, made.prism.index, current_state(made)) == (60.0, first.prism_index, first)
    assert "field of view assumed" in made.notes[-1]
    assert np.abs(made.show().after - shown).max() > 0.01
    found, wrong = decode(encode_state(by_hand, first), first, made)
    assert (found, wrong) == (by_hand, ())
    apply_state(made, found)
    np.testing.assert_array_equal(made.show().after, shown)
    assert not made.notes
    assert decode("fov_deg=171", first, made)[1] != ()
    known = current_state(Inspector(recording))
    assert decode("fov_deg=50", known, made) == (known, decode("fov_deg=50", known, made)[1])
    assert "fov_deg" in decode("fov_deg=50", known, made)[1][0]


# calibration


@pytest.mark.parametrize(
    ("region", "model"), [(None, "exact"), ((20, 10, 140, 110), "exact"), (None, "circle")]
)
def test_a_calibration_uses_what_is_selected(
    recording: Recording, inspector: Inspector, region: tuple[int, int, int, int] | None, model: str
) -> None:
    first, truth = recording.events.t_first, inspector.truth
    assert truth is not None
    inspector.open(first + 20_000, 180_000, Selection(region=region))
    inspector.set(replace(truth, apex=0.5 * truth.apex))
    said: list[str] = []
    settings = Settings(model=model, stages=("sharpness",))
    found, text = calibration_job.find_calibration(
        inspector, settings, progress=lambda what, share: said.append(what)
    )
    assert said
    assert found.camera == recording.camera
    apex = inspector.knobs_of(found).apex  # of a circle, that of the same size
    assert apex == pytest.approx(truth.apex, abs=math.radians(0.12))
    words = re.search(r"region ([\d.]+) as recorded, ([\d.]+) now, ([\d.]+) with the result", text)
    assert words is not None
    before, now, after = map(float, words.groups())
    assert before < now < after
    assert after == pytest.approx(
        inspector.show(replace(truth, model=model)).sharpness_after, rel=0.1
    )
    scope = calibration_job.calibrated_events(inspector)[1]
    assert scope.startswith(f"{inspector.loaded.selected:,} events from 0.020 s to 0.200 s")
    assert ("x 20 to 140, y 10 to 110 px" in scope) is (region is not None)
    assert text.startswith(f"found on {scope}: {model} model, apex {math.degrees(apex):.4g}°")
    assert inspector.knobs.apex == 0.5 * truth.apex  # nothing is accepted yet
    inspector.accept(found)
    assert inspector.sources["apex"] is Source.CALIBRATED
    shown = inspector.show()
    assert (shown.sharpness_before, shown.sharpness_after) == pytest.approx(
        (before, after), rel=0.03
    )


def test_a_selection_that_the_photometric_stage_refuses_is_calibrated_by_sharpness_and_says_so(
    inspector: Inspector, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the demo in the view with which the inspector starts. The whole recording is refused as it is."""
    asked: list[tuple[str, ...]] = []
    calibrate = calibration_job.calibrate

    def refusing(recording: Recording, settings: Settings, **options: Any) -> Any:
        asked.append(settings.stages)
        if "photometric" in settings.stages:
            raise AmiwarpError(
                f"{recording.name}: photometric stage: the camera shakes by 0.1 px; mount it; or not"
            )
        return calibrate(recording, settings, **options)

    monkeypatch.setattr(calibration_job, "calibrate", refusing)
    truth = inspector.truth
    assert truth is not None
    found, text = calibration_job.find_calibration(inspector)
    assert asked == [("sharpness", "photometric"), ("sharpness",)]
    assert inspector.knobs_of(found).apex == pytest.approx(truth.apex, abs=math.radians(0.12))
    assert (
        "by sharpness alone, as the photometric stage refused so few events (the camera shakes by 0.1 px)"
        in text
    )
    assert "calibrate on the whole recording" in text
    assert "mount it" not in text
    with pytest.raises(AmiwarpError, match="the camera shakes"):
        calibration_job.find_calibration(inspector, whole=True)
    asked.clear()
    calibration_job.find_calibration(inspector, Settings(stages=("sharpness",)))
    assert asked == [("sharpness",)]


def test_a_selection_that_determines_nothing_is_refused(inspector: Inspector) -> None:
    start, length = inspector.first_window()
    inspector.open(start, length // 10, Selection(1, (20, 10, 140, 110), noise_us=3000))
    _, scope = calibration_job.calibrated_events(inspector)
    assert scope.count(",") >= 3
    assert "ON events" in scope
    assert "without background activity (3 ms)" in scope
    with pytest.raises(AmiwarpError, match=r"quarter turn|too few"):
        calibration_job.find_calibration(inspector)


def surface_values(surface: dict[str, Any]) -> np.ndarray:
    """Return the sharpness of a map as the page gets it, by row and column of its parameters."""
    picture = surface["picture"]
    return np.frombuffer(picture["values"], np.float32).reshape(
        picture["height"], picture["width"]
    )[::-1]


def test_the_cost_surface_has_its_top_at_the_truth(inspector: Inspector) -> None:
    truth = inspector.knobs
    inspector.set(replace(truth, apex=0.8 * truth.apex, phase=truth.phase + 0.6))
    shares: list[float] = []
    surface = cost_surface(
        inspector, points=(9, 13), progress=lambda what, share: shares.append(share)
    )
    assert (surface["x_title"], surface["y_title"]) == ("apex angle (°)", "phase (°)")
    sharpness = surface_values(surface)
    assert sharpness.shape == (13, 9)
    assert shares == pytest.approx(np.arange(13) / 13)
    row, column = np.unravel_index(np.argmax(sharpness), sharpness.shape)
    apex, phase = math.radians(surface["x"][column]), math.radians(surface["y"][row])
    assert apex == pytest.approx(truth.apex, abs=0.21 * truth.apex)
    assert abs(math.remainder(phase - truth.phase, math.tau)) < math.radians(31.0)
    still = np.ptp(sharpness[:, 0])
    assert still < 0.01 * np.ptp(sharpness)  # without an apex, the phase does not matter
    (now, at_truth), places = (
        surface["marks"],
        [(0.8 * truth.apex, truth.phase + 0.6), (truth.apex, truth.phase)],
    )
    for mark, (x, y) in zip((now, at_truth), places, strict=True):
        assert mark["x"] == pytest.approx(math.degrees(x))
        assert mark["y"] == pytest.approx(math.degrees(y))


def test_the_marks_of_a_map_follow_the_parameters(inspector: Inspector) -> None:
    about = inspector.knobs
    inspector.set(replace(about, apex=1.5 * about.apex, phase=about.phase + math.tau - 0.3))
    now, at_truth = surface_marks(inspector, ("apex", "phase"), about, None)
    assert (now["sign"], at_truth["sign"]) == ("○", "◇")
    assert now["x"] == pytest.approx(math.degrees(1.5 * about.apex))
    # On the map, which has one turn
    assert now["y"] == pytest.approx(math.degrees(about.phase - 0.3))
    assert at_truth["x"] == pytest.approx(math.degrees(about.apex))


def test_the_cost_surface_without_encoder_is_over_the_speed(
    recording: Recording, inspector: Inspector
) -> None:
    without = Inspector(replace(recording, encoder=None))
    encoder = recording.encoder
    assert encoder is not None
    zero = float(encoder.angle_at([without.zero_us])[0])
    without.set(replace(inspector.knobs, rpm=718.0, phase=inspector.knobs.phase + zero))
    surface = cost_surface(without, points=(5, 7))
    assert surface["y_title"] == "speed of the prism (rpm)"
    sharpness = surface_values(surface)
    at_truth = sharpness[4, 2]  # within one turn, sharpness hardly depends on the speed
    assert surface["y"][4] == pytest.approx(720.0, abs=0.1)
    assert sharpness.max() - at_truth < 0.05 * np.ptp(sharpness[:, 3])


@pytest.mark.parametrize("count", [1, 7, 1000])
def test_a_window_holds_the_wanted_number_of_events(count: int) -> None:
    t = np.arange(1000) * 10 + 500
    x = np.zeros(1000, np.uint16)
    inspector = Inspector(Recording(MemoryEvents(Events(x, x, t, x.astype(np.uint8)), 4, 3)))
    assert not inspector.has_optic
    for start_us in (500, 505, 5000, 10_480):
        start, length = inspector.window_of(start_us, count)
        assert np.count_nonzero((t >= start) & (t < start + length)) == count
        assert start == min(start_us, t[-count])
    assert inspector.window_of(500, 5000) == (500, 9991)
    assert inspector.window_of(520, 0) == (520, 1)


def test_the_page_says_how_many_events_were_read_of_a_full_window(
    inspector: Inspector, monkeypatch: pytest.MonkeyPatch
) -> None:
    window = inspector.first_window()
    inspector.open(*window)
    total = inspector.loaded.span.count
    assert events_text(inspector.show()) == f"{total:,} events, all drawn"
    third = len(inspector.show().every(3).events)
    assert events_text(inspector.show(), 3) == f"{total:,} events, {third:,} of these drawn"
    monkeypatch.setattr(viewer, "MOST_EVENTS", 6400)
    thinned = Inspector(inspector.recording)
    thinned.open(*window, Selection(polarity=1))
    selected = thinned.loaded.selected
    assert 0 < selected < 6400 < total
    text = events_text(thinned.show())
    assert (
        text
        == f"{total:,} events, 6,400 of them read, {selected:,} of these selected, all of these drawn"
    )


# downloads


@pytest.mark.parametrize("compensated", [False, True])
@pytest.mark.parametrize("most_events", [4_000_000, 6400])
def test_the_events_of_the_window_are_downloaded(
    inspector: Inspector,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    *,
    compensated: bool,
    most_events: int,
) -> None:
    monkeypatch.setattr(viewer, "MOST_EVENTS", most_events)
    monkeypatch.setattr(spans, "BLOCK", 10_000)
    region, (start, length) = (20, 10, 140, 110), inspector.first_window()
    inspector.open(start, length, Selection(1, region))
    path = tmp_path / "events.h5"
    count = write_events(inspector, path, compensated=compensated)
    events = inspector.recording.events.between(start, start + length)
    inside = (events.x >= 20) & (events.x < 140) & (events.y >= 10) & (events.y < 110)
    expected = events[(events.p == 1) & inside]
    assert count == len(expected) > inspector.loaded.selected * (1 if most_events == 6400 else 0)
    written = open_recording(path)
    found = written.events.slice(0, count)
    np.testing.assert_array_equal(found.t, expected.t)
    xy = np.stack([found.x, found.y], axis=1).astype(np.float32)
    moved = compensate_events(expected, inspector.model, inspector.encoder)
    np.testing.assert_allclose(
        xy, moved if compensated else np.stack([expected.x, expected.y], axis=1), atol=1e-3
    )
    assert written.encoder is not None
    assert inspector.recording.encoder is not None
    np.testing.assert_allclose(
        written.encoder.angle_at(found.t), inspector.encoder.angle_at(found.t)
    )
    assert len(written.encoder.t) < len(inspector.recording.encoder.t)
    with pytest.raises(AmiwarpError, match="write to another file"):
        write_events(inspector, path, compensated=compensated)


@pytest.mark.parametrize("offset", [0.0, 50_000.0])
def test_events_of_two_prisms_are_downloaded_with_both_encoders(
    tmp_path: Path, offset: float
) -> None:
    events = MemoryEvents(random_events(2000, 40, 30), 40, 30)
    first, second = (
        Encoder.constant_speed(rpm, 0, 200_000).with_clock_offset(offset) for rpm in (720.0, -500.0)
    )
    inspector = Inspector(
        Recording(events, Camera.from_fov(40, 30, 1.0), first.with_second(second))
    )
    inspector.open(40_000, 20_000, Selection())
    write_events(inspector, tmp_path / "events.h5", compensated=False)
    written = open_recording(tmp_path / "events.h5").encoder
    assert written is not None
    assert written.second is not None
    t = np.arange(40_000, 60_000, 1000)
    for found, whole in ((written, first), (written.second, second)):
        np.testing.assert_allclose(found.angle_at(t), whole.angle_at(t))
        assert len(found.t) < len(whole.t)


@pytest.mark.parametrize("kind", [np.uint16, np.float32])
def test_a_table_holds_the_places_that_the_model_gives(kind: Any, tmp_path: Path) -> None:
    """Events between pixels, of a compensated file, are moved like those of a sensor."""
    events = random_events(500, 40, 30)
    events = Events(events.x.astype(kind), events.y.astype(kind), events.t, events.p)
    inspector = Inspector(
        Recording(
            MemoryEvents(events, 40, 30),
            Camera.from_fov(40, 30, 1.0),
            Encoder.constant_speed(720.0, 0, 100_000),
        )
    )
    inspector.open(0, 100_000, Selection())
    downloads.write_table(inspector, tmp_path / "table.npz")
    table = np.load(tmp_path / "table.npz")
    xy = np.stack([events.x, events.y], axis=1).astype(np.float32)
    moved = inspector.model.compensate_points(
        xy, inspector.encoder.angle_at(events.t).astype(np.float32)
    )
    found = np.stack([table["x_compensated"], table["y_compensated"]], axis=1)
    np.testing.assert_allclose(found, moved, atol=1e-3)


def test_the_noise_filter_of_a_download_does_not_restart_at_its_blocks(
    inspector: Inspector, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    window = inspector.first_window()
    inspector.open(*window, Selection(noise_us=300))
    expected = inspector.loaded.counted
    assert 0.2 * inspector.loaded.span.count < len(expected) < 0.95 * inspector.loaded.span.count
    monkeypatch.setattr(viewer, "MOST_EVENTS", 6400)
    assert spans.blocks_between.__kwdefaults__ is not None
    monkeypatch.setitem(spans.blocks_between.__kwdefaults__, "count", 500)
    thinned = Inspector(inspector.recording)
    thinned.open(*window, Selection(noise_us=300))
    assert write_events(thinned, tmp_path / "events.h5", compensated=False) == len(expected)
    np.testing.assert_array_equal(
        open_recording(tmp_path / "events.h5").events.slice(0, len(expected)).t, expected.t
    )


def test_images_are_downloaded(inspector: Inspector, tmp_path: Path) -> None:
    inspector.open(*inspector.first_window(), Selection(region=(30, 20, 110, 80)))
    for kind in (ImageKind.COUNT, ImageKind.POLARITY, ImageKind.TIME_SURFACE):
        images = make_images(inspector, kind)
        save_values(tmp_path / f"{kind}.tif", images.after)
        with Image.open(tmp_path / f"{kind}.tif") as picture:
            assert picture.n_frames == (2 if kind is ImageKind.POLARITY else 1)
            for page, values in enumerate(
                images.after if kind is ImageKind.POLARITY else [images.after]
            ):
                picture.seek(page)
                np.testing.assert_array_equal(np.asarray(picture), values)
    with pytest.raises(AmiwarpError, match=r"as \.tif, not"):
        save_values(tmp_path / "image.jpg", images.after)
    save_values(tmp_path / "image.tif", images.after)
    with refused(ErrorCode.OUTPUT_EXISTS):
        save_values(tmp_path / "image.tif", images.after)


def test_the_events_shown_are_downloaded_as_tables(
    inspector: Inspector, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(spans, "BLOCK", 10_000)
    inspector.open(*inspector.first_window(), Selection(region=(20, 10, 140, 110), polarity=1))
    downloads.write_table(inspector, tmp_path / "events.csv")
    downloads.write_table(inspector, tmp_path / "events.npz")
    shown, text = (
        inspector.show(),
        np.genfromtxt(tmp_path / "events.csv", delimiter=",", names=True),
    )
    table = np.load(tmp_path / "events.npz")
    assert text.dtype.names == COLUMNS
    assert len(text) == len(table["t"]) == shown.selected == len(shown.events)
    for found in (text, table):
        for name in ("t", "x", "y", "p"):
            np.testing.assert_array_equal(found[name], getattr(shown.events, name))
        np.testing.assert_allclose(found["theta"], shown.theta, atol=1e-5)
        moved = np.column_stack([found["x_compensated"], found["y_compensated"]])
        np.testing.assert_allclose(moved, shown.after, atol=2e-3)
    again = open_recording(tmp_path / "events.npz").events
    np.testing.assert_array_equal(again.slice(0, len(again)).t, shown.events.t)
    with pytest.raises(AmiwarpError, match=r"\.csv or \.npz"):
        downloads.write_table(inspector, tmp_path / "events.txt")


def test_a_calibration_is_downloaded(inspector: Inspector, tmp_path: Path) -> None:
    inspector.as_calibration().save(tmp_path / "calibration.json")
    data = json.loads((tmp_path / "calibration.json").read_text())
    assert data["parameters"]["apex"]["value"] == TRUE.apex


@pytest.mark.parametrize("polarity", [None, 1])
def test_statistics_of_a_region(polarity: int | None) -> None:
    events = random_events(20_000, 40, 30)
    made = Inspector(Recording(MemoryEvents(events, 40, 30)))
    made.open(10_000, 50_000, Selection(region=(5, 7, 25, 20), polarity=polarity))
    last: dict[tuple[int, int], int] = {}
    intervals, ons, n = [], 0, 0
    for x, y, t, p in zip(*(getattr(events, name).tolist() for name in "xytp"), strict=True):
        if 10_000 <= t < 60_000 and 5 <= x < 25 and 7 <= y < 20 and polarity in (None, p):
            intervals += [t - last[x, y]] if (x, y) in last else []
            last[x, y] = t
            ons, n = ons + p, n + 1
    found = made.statistics()
    assert [text for _, text in found["rows"]] == [
        f"{n / 0.05:,.0f} events/s", f"{n / 260:.3g}", f"{100.0 * ons / n:.1f} %", f"{100.0 * len(last) / 260:.1f} %",
        f"{np.median(intervals):,.0f} µs",
    ]  # fmt: skip
    assert found["median"] == pytest.approx(math.log10(np.median(intervals)))
    counts = [
        sum(low <= each < high for each in intervals)
        for low, high in pairwise(window_statistics.INTERVALS_US)
    ]
    np.testing.assert_allclose(found["y"], 100.0 * np.array(counts) / len(intervals))


def test_intervals_between_two_runs_are_not_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    events = random_events(6400, 2, 1)
    monkeypatch.setattr(viewer, "MOST_EVENTS", 3200)
    made = Inspector(Recording(MemoryEvents(events, 2, 1)))
    made.open(0, 100_000)
    found = made.statistics()
    assert found["rows"][0] == ["rate", "64,000 events/s"]  # 3,200 in 50 ms
    assert ["pixels with events", "100.0 %"] in found["rows"]
    counts = np.array(found["y"]) / 100.0 * (3200 - 2 * spans.RUNS)
    np.testing.assert_allclose(counts, np.rint(counts), rtol=0, atol=1e-6)


@pytest.mark.parametrize("offset", [0.0, 4000.0])
def test_a_recording_beside_has_the_angles_of_the_same_time(
    recording: Recording, offset: float
) -> None:
    assert recording.encoder is not None
    inspector = Inspector(replace(recording, encoder=recording.encoder.with_clock_offset(offset)))
    events = random_events(1000, 160, 120)
    later = Events(events.x, events.y, events.t + 7_000_000, events.p)
    inspector.put_beside(Recording(MemoryEvents(later, 160, 120)))
    assert inspector.beside is not None
    own = inspector.encoder.angle_at(recording.events.t_first + events.t - events.t[0])
    np.testing.assert_allclose(inspector.beside.encoder.angle_at(later.t), own, rtol=0, atol=1e-9)


def test_another_recording_is_shown_beside(
    recording: Recording, inspector: Inspector, tmp_path: Path
) -> None:
    """A compensated one, on another clock, and without an encoder: its events lie where the inspector puts its own."""
    assert recording.encoder is not None
    events = recording.events.slice(0, len(recording.events))  # type: ignore[attr-defined]
    moved = compensate_events(events, inspector.model, recording.encoder)
    inside = (np.abs(moved + 0.5 - np.array([80, 60])) < np.array([80, 60])).all(axis=1)
    compensated = Events(
        moved[inside, 0], moved[inside, 1], events.t[inside] + 7_000_000, events.p[inside]
    )
    other = replace(
        recording,
        events=MemoryEvents(compensated, 160, 120),
        encoder=None,
        truth=None,
        name="other",
    )
    inspector.put_beside(other)
    # The times count from the first events
    first = int(events.t[inside][0]) - recording.events.t_first
    inspector.open(50_000, 80_000, Selection(region=(20, 15, 140, 105)))
    shown = inspector.show()
    assert shown.beside is not None
    t = shown.first.events.t - compensated.t[0] + first
    within = (t >= 50_000 - recording.events.t_first) & (
        t < 130_000 - recording.events.t_first + first
    )
    assert within.all()
    order = {
        tuple(row)
        for row in np.column_stack(
            [shown.events.t - recording.events.t_first, shown.after]
        ).tolist()
    }
    same = [tuple(row) in order for row in np.column_stack([t, shown.first.before]).tolist()]
    assert np.mean(same) > 0.9  # the others came over the border of the region
    state = page_state.cloud_state(shown, Colour.CAUSE, Axis.ANGLE, dark=False)
    theta = np.frombuffer(state["third_before"], np.float32)
    expected = np.degrees(
        np.mod(recording.encoder.angle_at(t + recording.events.t_first), math.tau)
    )
    np.testing.assert_allclose(theta, expected, atol=0.2)
    assert shown.sharpness_before == pytest.approx(shown.sharpness_after, rel=0.1)
    assert inspector.show(against=inspector.knobs).beside is None
    alone = MemoryEvents(Events(*moved[inside].T, events.t[inside], compensated.p), 160, 120)
    with pytest.raises(AmiwarpError, match="already compensated"):
        Inspector(replace(other, events=alone)).show()
    small = MemoryEvents(random_events(10, 8, 8), 8, 8)
    with pytest.raises(AmiwarpError, match="8x8 pixels, simulation has 160x120"):
        inspector.put_beside(Recording(small))
