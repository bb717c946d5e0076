"""Two recordings in the inspector, side by side: names, numbers, brightness and prism angles of each."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from amiwarp import (
    Camera,
    DepthMap,
    Encoder,
    MemoryEvents,
    PixelMap,
    Prism,
    Recording,
    save_recording,
    simulate,
)
from amiwarp.choices import Axis
from amiwarp.viewer import ImageKind, Inspector, Library, Selection, captions, filters, make_images

SHIFT_US = 5_000_000
KINDS = {name: kinds[0] for name, kinds in PixelMap._KINDS.items()}
"""Kind of the data type of each array of a map of pixels."""


@pytest.fixture(scope="module")
def turning(texture: np.ndarray) -> Recording:
    camera = Camera.from_fov(96, 72, math.radians(60))
    made = simulate(texture, camera, Prism(math.radians(1.0)), duration_s=0.25, seed=1)
    return replace(made, name="turning")


@pytest.fixture(scope="module")
def thin(turning: Recording) -> Recording:
    """Return a tenth of the events, 5 s later, without an encoder."""
    events = turning.events.slice(0, len(turning.events))[::10]
    later = MemoryEvents(replace(events, t=events.t + SHIFT_US), *turning.events.size)
    return Recording(later, turning.camera, name="thin")


@pytest.fixture
def both(turning: Recording, thin: Recording) -> Inspector:
    made = Inspector(turning)
    made.take_truth()
    made.put_beside(thin)
    return made


def test_titles_have_both_names_and_say_whose_angles_are_shown(
    both: Inspector, turning: Recording
) -> None:
    assert both.angles_lent
    lent = ("thin, as recorded, at the prism angles of turning", "turning, compensated")
    assert captions.cloud_titles(both, "recorded", Axis.ANGLE) == lent
    assert captions.cloud_titles(both, "recorded", Axis.TIME) == (
        "thin, as recorded",
        "turning, compensated",
    )
    assert captions.cloud_titles(both, "B") == ("compensated with B", "compensated with A")
    own = Inspector(turning)
    own.put_beside(replace(turning, name="other"))
    assert captions.cloud_titles(own, "recorded", Axis.ANGLE)[0] == "other, as recorded"
    plain = Inspector(replace(turning, encoder=None, prism=None, truth=None))
    plain.put_beside(replace(turning, name="other", encoder=None))
    assert captions.cloud_titles(plain, "recorded", Axis.TIME) == (
        "other, as recorded",
        "turning, as recorded",
    )


def test_each_recording_has_its_own_numbers(both: Inspector) -> None:
    both.open(*both.first_window(), Selection(region=(20, 10, 80, 60), polarity=1))
    shown = both.show()
    assert shown.beside is not None
    assert captions.sharpness_text(shown, compensated=True) == ""
    rows = captions.beside_rows(both, shown)
    assert [row[0] for row in rows] == ["thin", "turning"]
    parts = ((shown.beside, shown.beside.sharpness_before), (shown, shown.sharpness_after))
    for row, (part, sharpness) in zip(rows, parts, strict=True):
        assert row[1] == f"{part.span.count:,} events, {part.selected:,} of these selected"
        assert row[2] == filters.rate_text(1e6 * part.selected / part.span.length_us)
        assert row[3] in (f"sharpness {sharpness:.3f}", "sharpness unknown: too few events")
    assert shown.beside.selected < 0.2 * shown.selected
    words = captions.caption(both, shown)
    assert "thin: " in words
    assert "turning: " in words
    assert "→" not in words
    assert "×" not in words
    against = both.show(against=both.knobs)
    assert captions.beside_rows(both, against) == []
    assert "→" in captions.sharpness_text(against, compensated=True)


def test_each_image_has_its_own_brightness_or_both_have_one(both: Inspector) -> None:
    both.open(*both.first_window())
    shown = both.show()
    for kind in (ImageKind.COUNT, ImageKind.POLARITY):
        own = make_images(both, kind, shown=shown)
        assert own.after_scale is not None
        assert own.scale.high < own.after_scale.high
        common = make_images(both, kind, shown=shown, same_scale=True)
        assert common.after_scale is None
        assert common.scale.high == own.after_scale.high
    alone = make_images(both, ImageKind.COUNT, against=both.knobs)
    assert alone.after_scale is None


@pytest.mark.parametrize("offset_us", [0.0, 4000.0])
def test_lent_angles_follow_the_clock_offset_that_is_set(
    both: Inspector, turning: Recording, offset_us: float
) -> None:
    both.open(*both.first_window())
    both.set(replace(both.knobs, clock_offset=offset_us))
    part = both.show().beside
    assert part is not None
    assert turning.encoder is not None
    theta = turning.encoder.with_clock_offset(offset_us).angle_at(part.events.t - SHIFT_US)
    # 0.4°: the speed is taken for constant
    np.testing.assert_allclose(np.cos(part.theta - theta), 1.0, atol=2e-5)


def test_lent_angles_follow_the_speed_that_is_set(turning: Recording, thin: Recording) -> None:
    made = Inspector(replace(turning, encoder=None))
    made.put_beside(thin)
    made.set(replace(made.knobs, rpm=600.0))
    made.open(*made.first_window())
    shown = made.show()
    assert shown.beside is not None
    assert np.ptp(shown.beside.theta) > 5.0
    expected = made.encoder.angle_at(shown.beside.events.t - SHIFT_US)
    np.testing.assert_allclose(np.cos(shown.beside.theta - expected), 1.0, atol=1e-6)


def test_an_encoder_of_its_own_is_kept(turning: Recording, thin: Recording) -> None:
    first = thin.events.t_first
    slow = Encoder.constant_speed(300.0, first - 5000, thin.events.t_last + 5000)
    made = Inspector(turning)
    made.put_beside(replace(thin, encoder=slow))
    made.open(*made.first_window())
    made.set(replace(made.knobs, clock_offset=4000.0))
    part = made.show().beside
    assert not made.angles_lent
    assert part is not None
    np.testing.assert_allclose(np.cos(part.theta - slow.angle_at(part.events.t)), 1.0, atol=1e-6)


def test_events_that_cannot_be_compensated_are_counted_apart(both: Inspector) -> None:
    both.beside = None
    both.open(*both.first_window())
    shown = both.show()
    assert "not compensated" not in captions.events_text(shown)
    after = shown.after.copy()
    after[3:10, 0] = np.nan
    assert captions.events_text(replace(shown, after=after)).endswith(", 7 not compensated")


def test_maps_are_not_listed_among_the_recordings(turning: Recording, tmp_path: Path) -> None:
    save_recording(tmp_path / "turning.h5", turning)
    events = turning.events.slice(0, 100)
    np.savez(tmp_path / "events.npz", t=events.t, x=events.x, y=events.y, p=events.p)
    values = np.ones((72, 96), np.float32)
    DepthMap(values, 0.1 * values, np.zeros((72, 96, 3), np.float32)).save(tmp_path / "depth.npz")
    mask = np.zeros((72, 96), np.bool_)
    PixelMap(**{name: values if kind == "f" else mask for name, kind in KINDS.items()}).save(
        tmp_path / "pixels.npz"
    )
    (tmp_path / "broken.npz").write_bytes(b"no archive")
    library = Library(tmp_path, lambda path: Inspector(turning))
    assert [name for name, _ in library.files()] == ["broken.npz", "events.npz", "turning.h5"]
