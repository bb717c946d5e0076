"""The inspector's values and the drawing of its clouds, without a browser."""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from amiwarp import (
    AmiwarpError,
    Calibration,
    Camera,
    Encoder,
    ErrorCode,
    Events,
    MemoryEvents,
    Prism,
    Recording,
    compensate_events,
    iwe,
    open_recording,
    save_recording,
    simulate,
)
from amiwarp.calib.bad_pixels import MaskedEventSource
from amiwarp.choices import Axis, Colour, View
from amiwarp.imaging.residuals import WIDEST_PX, residual
from amiwarp.io.spans import read_span
from amiwarp.optics import build_model, rungs
from amiwarp.viewer import Inspector, Look, Selection
from amiwarp.viewer.cloud_colours import axis_range, colours_of, third_axis, unknown_rows
from amiwarp.viewer.knobs import Knobs
from amiwarp.viewer.orbit_lines import orbit_lines
from amiwarp.viewer.page_state import legend
from amiwarp.viewer.scene import Scene
from reference.calibration_sample import exact_calibration
from tests.errors import refused

TRUE = Prism(math.radians(1.0))
PICTURES = Path(__file__).parent / "pictures"
SIZE = (480, 220)


@pytest.fixture(scope="module")
def recording(texture: np.ndarray) -> Recording:
    camera = Camera.from_fov(160, 120, math.radians(60))
    nominal = Prism(math.radians(1.2))
    return simulate(texture, camera, TRUE, duration_s=0.34, seed=1, nominal_prism=nominal)


@pytest.fixture
def inspector(recording: Recording) -> Inspector:
    return Inspector(recording)


def true_knobs(recording: Recording) -> Knobs:
    assert recording.truth is not None
    return Knobs(apex=TRUE.apex, phase=recording.truth.parameters["phase"])


def without_encoder(recording: Recording) -> Recording:
    return replace(recording, encoder=None)


def calibration_of(recording: Recording, **parameters: float) -> Calibration:
    assert recording.camera is not None
    values = {"apex": TRUE.apex, "phase": 0.2, **parameters}
    return exact_calibration(recording.camera, TRUE, values)


class Counted:
    """Event source that counts the events read from it."""

    def __init__(self, source: MemoryEvents) -> None:
        self.source, self.read, self.find = source, 0, source.find
        self.size, self.t_first, self.t_last = source.size, source.t_first, source.t_last

    def __len__(self) -> int:
        return len(self.source)

    def slice(self, start: int, stop: int) -> Events:
        out = self.source.slice(start, stop)
        self.read += len(out)
        return out


@pytest.fixture(scope="module")
def million() -> MemoryEvents:
    rng = np.random.default_rng(0)
    t = np.sort(rng.integers(0, 1_000_000, 1_000_000)) + np.arange(1_000_000) // 2
    zero = np.zeros(len(t), np.uint16)
    return MemoryEvents(Events(zero, zero, t, zero.astype(np.uint8)), 4, 4)


def test_every_source_finds_a_moment(million: MemoryEvents, tmp_path: Path) -> None:
    some = million.slice(0, 5000)
    text = "\n".join(
        f"{t * 1e-6:.6f} {x} {y} {p}"
        for t, x, y, p in zip(some.t, some.x, some.y, some.p, strict=True)
    )
    (tmp_path / "events.txt").write_text(text + "\n")
    save_recording(tmp_path / "events.h5", Recording(MemoryEvents(some, 4, 4)))
    hidden = MaskedEventSource(MemoryEvents(some, 4, 4), np.zeros((4, 4), np.bool_))
    sources = [open_recording(tmp_path / name).events for name in ("events.txt", "events.h5")] + [
        hidden
    ]
    for moment in (-5, int(some.t[0]), 3_456, int(some.t[-1]), 10_000_000):
        assert {source.find(moment) for source in sources} == {int(np.searchsorted(some.t, moment))}
    runs = [
        read_span(source, 1000, 5000, most_events=640).events
        for source in (*sources, MemoryEvents(some, 4, 4))
    ]
    assert len(runs[0]) == 640
    assert all(np.array_equal(run.t, runs[0].t) for run in runs)


def test_a_long_window_is_thinned_evenly_and_its_true_count_is_told(million: MemoryEvents) -> None:
    source = Counted(million)
    span = read_span(source, 200_000, 1_000_000, most_events=64_000)  # type: ignore[arg-type]
    t = million.slice(0, len(million)).t
    inside = t[(t >= 200_000) & (t < 1_200_000)]
    assert span.count == len(inside)
    assert len(span.events) == 64_000
    assert source.read == 64_000
    assert (np.diff(span.events.t) >= 0).all()
    shares = (
        np.histogram(span.events.t, 8, (200_000, 1_200_000))[0]
        / np.histogram(inside, 8, (200_000, 1_200_000))[0]
    )
    assert shares.max() < 1.3 * shares.min()
    whole = read_span(million, 200_000, 10_000, most_events=64_000)
    assert np.array_equal(whole.events.t, t[(t >= 200_000) & (t < 210_000)])


def test_the_first_window_is_one_turn_in_the_middle(
    inspector: Inspector, recording: Recording
) -> None:
    start, length = inspector.first_window()
    assert length == pytest.approx(60e6 / 720, rel=0.01)
    middle = (recording.events.t_first + recording.events.t_last) / 2
    assert start + length / 2 == pytest.approx(middle, abs=2)


@pytest.mark.parametrize("model", list(rungs()))
def test_what_is_shown_is_what_compensation_gives(
    inspector: Inspector, recording: Recording, model: str
) -> None:
    inspector.set(replace(true_knobs(recording), model=model, clock_offset=300.0))
    inspector.open(*inspector.first_window())
    shown = inspector.show()
    encoder = inspector.encoder_of(inspector.knobs)
    events = recording.events.between(
        shown.span.start_us, shown.span.start_us + shown.span.length_us
    )
    assert shown.span.count == shown.selected == len(events)
    expected = compensate_events(shown.events, inspector.model, encoder)
    # The clock offset is applied linearly
    np.testing.assert_allclose(shown.after, expected, atol=2e-3)
    image = iwe(events, *recording.events.size, model=inspector.model, encoder=encoder)
    raw = iwe(events, *recording.events.size)
    # the inspector counts at the nearest pixel: compare smoothed images
    for ours, plain in ((shown.image_after, image), (shown.image_before, raw)):
        ours, plain = (gaussian_filter(each, 2.0)[6:-6, 6:-6] for each in (ours, plain))
        assert np.abs(ours - plain).max() < 0.05 * plain.max()


def test_the_angles_of_drawn_events_follow_the_clock_offset(inspector: Inspector) -> None:
    inspector.open(*inspector.first_window())
    for offset in (0.0, 2500.0):
        inspector.set(replace(inspector.knobs, clock_offset=offset))
        shown = inspector.show()
        expected = inspector.encoder_of(inspector.knobs).angle_at(shown.events.t)
        away = np.abs(np.exp(1j * shown.theta) - np.exp(1j * expected))
        # Rad; of 0.19, as the offset is applied linearly and the speed varies
        assert away.max() < 0.01


def test_points_are_thinned_evenly(recording: Recording) -> None:
    shown = Inspector(recording, most_points=1000).show()
    assert len(shown.events) == len(shown.after) == 1000
    parts = np.histogram(
        shown.events.t, 4, (shown.span.start_us, shown.span.start_us + shown.span.length_us)
    )[0]
    assert parts.sum() == 1000
    assert shown.selected > 10_000


def test_sharpness_has_its_top_at_the_true_prism(
    inspector: Inspector, recording: Recording
) -> None:
    inspector.set(true_knobs(recording))
    shown = inspector.show()
    assert shown.sharpness_after > 1.2 * shown.sharpness_before
    for name, tolerance in (
        ("apex", math.radians(0.1)),
        ("phase", math.radians(8.0)),
    ):  # sharpness is biased
        values, scores = inspector.curve(name)
        at = getattr(inspector.knobs, name)
        assert values[0] < at < values[-1]
        assert values[np.argmax(scores)] == pytest.approx(at, abs=tolerance)


def test_an_orbit_is_where_the_model_sees_a_point(
    inspector: Inspector, recording: Recording
) -> None:
    inspector.set(true_knobs(recording))
    theta, xy = inspector.orbit(80.0, 60.0)
    back = inspector.model.compensate_points(xy, theta.astype(np.float32))
    np.testing.assert_allclose(back, [[80.0, 60.0]] * len(theta), atol=1e-3)
    assert np.ptp(theta) == pytest.approx(math.tau)


def test_a_selection_leaves_events_out(inspector: Inspector) -> None:
    start, length = inspector.first_window()
    inspector.open(start, length, Selection(polarity=1, region=(20, 10, 90, 50)))
    shown = inspector.show()
    e = shown.events
    assert (e.p == 1).all()
    assert 20 <= e.x.min() <= e.x.max() < 90
    assert 10 <= e.y.min() <= e.y.max() < 50
    assert 0 < shown.selected < shown.span.count


def test_hot_pixels_are_hidden(recording: Recording) -> None:
    events = recording.events.slice(0, len(recording.events))
    t = np.arange(recording.events.t_first, recording.events.t_last, 50)
    hot = Events(
        np.full(len(t), 33, np.uint16),
        np.full(len(t), 44, np.uint16),
        t,
        np.zeros(len(t), np.uint8),
    )
    both = Events.concatenate([events, hot])
    both = both[np.argsort(both.t, kind="stable")]
    inspector = Inspector(replace(recording, events=MemoryEvents(both, *recording.events.size)))
    start, length = inspector.first_window()
    inspector.open(start, length, Selection(hide_hot=True))
    assert not ((inspector.show().events.x == 33) & (inspector.show().events.y == 44)).any()
    assert inspector.show().selected > 0.9 * (inspector.show().span.count - length / 50)


def test_without_an_encoder_the_speed_is_a_knob(recording: Recording) -> None:
    inspector = Inspector(without_encoder(recording))
    assert "no encoder" in inspector.notes[0]
    assert math.isinf(inspector.turn_us)
    still = inspector.show()
    np.testing.assert_allclose(still.after, still.before, atol=1e-3)
    assert still.sharpness_after == pytest.approx(still.sharpness_before)
    assert recording.encoder is not None
    zero = float(recording.encoder.angle_at(np.array([inspector.zero_us]))[0])
    knobs = true_knobs(recording)
    inspector.set(replace(knobs, rpm=720.0, phase=knobs.phase + zero))
    assert inspector.show().sharpness_after > 1.2 * inspector.show().sharpness_before
    values, scores = inspector.curve("rpm")
    assert values[np.argmax(scores)] == pytest.approx(720.0, abs=3.0)


def test_an_unknown_camera_is_assumed_and_said(recording: Recording) -> None:
    inspector = Inspector(replace(recording, camera=None))
    assert "60° field of view assumed" in inspector.notes[-1]
    assert inspector.show().selected > 0


def test_a_calibration_sets_the_knobs_and_comes_back(recording: Recording) -> None:
    found = calibration_of(recording, clock_offset=120.0, tilt_x=0.01)
    inspector = Inspector(recording, found)
    assert inspector.knobs == Knobs("exact", TRUE.apex, 0.2, 120.0, others=(("tilt_x", 0.01),))
    assert inspector.as_calibration() is found
    inspector.set(replace(inspector.knobs, apex=0.02, model="circle"))
    moved = inspector.as_calibration()
    assert moved.model_name == "circle"
    assert moved.warnings == ("set by hand in the inspector",)
    assert moved.parameters["deflection"] == pytest.approx(replace(TRUE, apex=0.02).deflection)
    assert moved.parameters["clock_offset"] == 120.0


def test_an_encoder_s_own_clock_offset_counts_once(recording: Recording) -> None:
    assert recording.encoder is not None
    late = replace(recording, encoder=recording.encoder.with_clock_offset(2500.0))
    inspector = Inspector(late)
    assert inspector.knobs.clock_offset == 2500.0
    inspector.set(replace(true_knobs(recording), clock_offset=0.0))
    punctual = Inspector(recording)
    punctual.set(true_knobs(recording))
    for each in (inspector, punctual):
        each.open(*punctual.first_window())
    np.testing.assert_allclose(inspector.show().after, punctual.show().after, atol=0.01)
    assert inspector.encoder_of(inspector.knobs).clock_offset_us == 0.0
    found = calibration_of(recording, clock_offset=700.0)
    inspector = Inspector(late, found)
    assert inspector.encoder_of(inspector.knobs).clock_offset_us == 700.0


def test_an_encoder_s_error_that_a_calibration_found_is_corrected(recording: Recording) -> None:
    assert recording.encoder is not None
    error = (0.0, 0.05, 0.0, 0.0)
    wrong = replace(recording, encoder=recording.encoder.with_harmonics(tuple(-x for x in error)))
    found = replace(calibration_of(recording), harmonics=error)
    right, late, corrected = Inspector(recording), Inspector(wrong), Inspector(wrong, found)
    for each in (right, late, corrected):
        each.set(true_knobs(recording))
        each.open(*right.first_window())
    shown = [each.show().after for each in (right, late, corrected)]
    assert np.abs(shown[1] - shown[0]).max() > 0.1
    np.testing.assert_allclose(shown[2], shown[0], atol=0.01)  # the correction is of first order
    assert corrected.as_calibration().harmonics == error
    late.accept(found)
    late.set(true_knobs(recording))
    np.testing.assert_array_equal(late.show().after, shown[2])


def test_what_was_set_by_hand_can_be_saved_and_opened(
    inspector: Inspector, recording: Recording, tmp_path: Path
) -> None:
    inspector.set(true_knobs(recording))
    inspector.as_calibration().save(tmp_path / "c.json")
    again = Inspector(recording, Calibration.load(tmp_path / "c.json"))
    assert again.knobs == inspector.knobs
    assert again.show().sharpness_after == inspector.show().sharpness_after


def test_a_circle_s_calibration_gives_its_apex(recording: Recording) -> None:
    assert recording.camera is not None
    values = {"deflection": TRUE.deflection, "phase": 0.0}
    circle = replace(calibration_of(recording), model_name="circle", parameters=values)
    inspector = Inspector(recording, circle)
    assert inspector.knobs.apex == pytest.approx(TRUE.apex, rel=1e-6)
    assert inspector.model == build_model("circle", recording.camera, TRUE, values)


def test_what_cannot_be_shown_is_said(inspector: Inspector, recording: Recording) -> None:
    zero = np.zeros(0, np.uint16)
    nothing = MemoryEvents(Events(zero, zero, zero.astype(np.int64), zero.astype(np.uint8)), 8, 8)
    with refused(ErrorCode.CONTENT_MISSING):
        Inspector(replace(recording, events=nothing))
    with pytest.raises(AmiwarpError, match="take another window"):
        inspector.open(recording.events.t_last + 10, 1000)
    with pytest.raises(AmiwarpError, match="none of them selected"):
        inspector.open(*inspector.first_window(), Selection(region=(5, 5, 5, 9)))
    assert inspector.selection == Selection()
    assert inspector.show().region == (0, 0, *recording.events.size)  # unchanged
    other = replace(calibration_of(recording), camera=Camera.from_fov(64, 48, 1.0))
    with pytest.raises(AmiwarpError, match="64x48 pixels, the events are of 160x120"):
        Inspector(recording, other)


def test_events_before_the_encoder_are_left_out(recording: Recording) -> None:
    assert recording.encoder is not None
    middle = (recording.events.t_first + recording.events.t_last) // 2
    later = recording.encoder.t > middle
    late = Encoder(recording.encoder.t[later], recording.encoder.angle[later])
    inspector = Inspector(replace(recording, encoder=late))
    inspector.open(recording.events.t_first, recording.events.t_last - recording.events.t_first)
    assert inspector.show().events.t.min() >= late.coverage[0] > recording.events.t_first + 100_000
    assert inspector.show().selected < inspector.show().span.count


# the scene


@pytest.fixture(scope="module")
def scene() -> Iterator[Scene]:
    made = Scene(SIZE)
    yield made
    made.close()


LOOKS = {
    "polarity": (Look(point_size=1.5), View.FREE),
    "dark": (Look(Colour.ANGLE, Axis.TIME, point_size=3.0, dark=True), View.FREE),
    "image": (Look(Colour.DENSITY), View.XY),
    "side": (Look(Colour.RESIDUAL), View.X_THIRD),
    "overlaid": (Look(overlaid=True, opacity=0.5), View.Y_THIRD),
}


def away(a: np.ndarray, b: np.ndarray) -> float:
    """Return the mean difference of two smoothed pictures, because renderers round a point's pixel differently."""
    return float(
        np.abs(
            gaussian_filter(a.astype(float), (2, 2, 0))
            - gaussian_filter(b.astype(float), (2, 2, 0))
        ).mean()
    )


@pytest.mark.parametrize("name", LOOKS)
def test_pictures_are_as_they_were(
    scene: Scene, inspector: Inspector, recording: Recording, name: str
) -> None:
    """Each picture is close to its committed reference and far from the other references."""
    inspector.set(true_knobs(recording))
    look, view = LOOKS[name]
    scene.show(inspector.show(), look)
    scene.look_from(view, look)
    picture = scene.picture()
    assert picture.shape == (SIZE[1], SIZE[0], 3)
    known = {n: np.asarray(Image.open(PICTURES / f"view_{n}.png").convert("RGB")) for n in LOOKS}
    assert away(picture, known[name]) < 1.0
    assert all(away(picture, known[n]) > 4.0 for n in LOOKS if n != name)


def test_the_time_axis_counts_from_the_first_event(
    scene: Scene, inspector: Inspector, recording: Recording
) -> None:
    inspector.open(recording.events.t_first + 40_000, 20_000)
    shown = inspector.show()
    assert axis_range(shown, Axis.TIME) == (40.0, 60.0)
    t_ms = third_axis(shown, Axis.TIME)
    assert 40.0 <= t_ms.min() < t_ms.max() < 60.0
    scene.show(shown, Look(axis=Axis.TIME))
    z = scene.box.positions(shown.before, t_ms)[:, 2]
    assert 0.0 <= z.min() < z.max() <= scene.box.axis_height
    assert (scene.box.low, scene.box.high) == (40.0, 60.0)


def test_the_orbit_is_drawn_in_both_clouds_until_it_is_left_out(
    scene: Scene, inspector: Inspector
) -> None:
    def green() -> list[int]:
        near = np.abs(scene.picture().astype(int) - (0, 158, 115)).max(axis=2) < 30
        return [int(half.sum()) for half in np.split(near, 2, axis=1)]

    look, shown = Look(), inspector.show()
    for overlaid in (True, False):
        scene.show(shown, replace(look, overlaid=overlaid), orbit_lines(inspector, shown))
        scene.look_from(View.FREE, replace(look, overlaid=overlaid))
        assert sum(green()) >= 10
    assert min(green()) > 0
    scene.show(shown, look)
    assert sum(green()) == 0


def test_a_turntable_ends_where_it_began(scene: Scene, inspector: Inspector) -> None:
    look = Look()
    scene.show(inspector.show(), look)
    scene.look_from(View.FREE, look)
    frames = list(scene.turntable(4))
    assert len(frames) == 4
    assert away(frames[0], frames[1]) > 1.0
    assert away(frames[0], scene.picture()) < 0.2


def test_colours_tell_what_they_say(inspector: Inspector, recording: Recording) -> None:
    inspector.set(true_knobs(recording))
    shown = inspector.show()
    on = colours_of(shown, Look(), after=True)
    assert len({tuple(c) for c in on}) == 2
    assert np.array_equal(on[shown.events.p == 1][0], on[shown.events.p == 1][-1])


def test_residuals_fall_when_the_calibration_gets_better(
    inspector: Inspector, recording: Recording
) -> None:
    true = true_knobs(recording)
    wrong = [
        [replace(true, phase=true.phase + math.radians(step)) for step in (0.0, 25.0, 60.0, 180.0)],
        [replace(true, apex=factor * true.apex) for factor in (1.0, 1.4, 1.8)],
        [replace(true, apex=factor * true.apex) for factor in (1.0, 0.45, 0.0)],
    ]
    for worse_and_worse in wrong:
        shown = [inspector.show(knobs) for knobs in worse_and_worse]
        means = [np.nanmean(residual(each.image_after, each.after)) for each in shown]
        assert (np.diff(means) > 0.05).all()
    right = inspector.show(true)
    as_recorded = residual(right.image_before, right.before).mean()
    assert np.nanmean(residual(right.image_after, right.after)) < as_recorded - 0.3


@pytest.mark.parametrize("colour", [Colour.RESIDUAL, Colour.DENSITY])
def test_unknown_values_are_grey_and_counted(
    inspector: Inspector, recording: Recording, colour: Colour
) -> None:
    """Those of events that the model moves out of the region, or out of the image."""
    region = (0, 0, 40, 30)
    inspector.open(*inspector.first_window(), replace(inspector.selection, region=region))
    shown = inspector.show(replace(true_knobs(recording), apex=math.radians(2.5)))
    x, y = np.rint(shown.after).T
    known = (x >= 0) & (y >= 0)
    if colour is Colour.RESIDUAL:
        known &= (x < 40) & (y < 30)
    count = np.count_nonzero(~known)
    assert 10 < count < len(known)
    grey = (colours_of(shown, Look(colour), after=True) == 0xBB).all(axis=1)
    np.testing.assert_array_equal(grey, ~known)
    assert not (colours_of(shown, Look(colour), after=False) == 0xBB).all(axis=1).any()
    assert unknown_rows(shown, colour) == (("#bbbbbb", f"unknown: {count:,} events"),)
    assert legend(shown, colour, dark=False)["rows"] == [["#bbbbbb", f"unknown: {count:,} events"]]
    assert unknown_rows(shown, Colour.TIME) == ()
    # both clouds compensated
    both = inspector.show(against=replace(true_knobs(recording), apex=math.radians(2.5)))
    assert "of the first cloud" in unknown_rows(both, colour)[0][1]


@pytest.mark.parametrize(
    ("width", "tolerance"), [(0.3, 0.3), (1.0, 0.05), (2.0, 0.05), (3.0, 0.1), (5.0, 0.2)]
)
def test_a_residual_is_the_standard_deviation_across_an_edge(
    width: float, tolerance: float
) -> None:
    """It is the same for all events of the edge, however far from its middle they lie.

    An edge within one pixel may read 0, because its events round to one column.
    """
    rng, n = np.random.default_rng(0), 50_000
    x = 50.0 + rng.normal(0.0, width, n) + rng.uniform(-0.5, 0.5)
    y = rng.uniform(0.0, 79.0, n)
    x, y = (np.rint(each).astype(np.int64) for each in (x, y))
    none = np.zeros(n, np.int64)
    image = iwe(Events.from_arrays(x, y, none, none), 100, 80)
    xy = np.stack([x, y], axis=1).astype(np.float32)[(y > 12) & (y < 68)]
    found = residual(image, xy)
    assert found.mean() == pytest.approx(width, abs=tolerance)
    part = residual(image, xy, (slice(10, 70), slice(0, 100)))
    np.testing.assert_allclose(part, found, atol=1e-6)


def test_a_residual_of_a_lone_event_is_large() -> None:
    lone = np.zeros((20, 30), np.float32)
    lone[10, 12] = 1.0
    places = np.array([[12.0, 10.0], [25.0, 3.0], [np.nan, np.nan], [-5.0, 99.0]], np.float32)
    assert (residual(lone, places)[:2] > 3.0).all()
    assert residual(lone, places)[1] == pytest.approx(WIDEST_PX)
    assert np.isnan(residual(lone, places)[2:]).all()  # outside
