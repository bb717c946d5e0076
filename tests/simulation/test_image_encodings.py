"""Images that an EventSensor takes: encodings, colours, types, strides, other libraries, and its warnings."""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

from amiwarp import AmiwarpError, Events, EventSensor, SensorModel
from amiwarp.simulation import DARK, ImageEncoding, linear_luminance

SHAPE = (2, 6, 7)
STEP_US = 1000


def lights(colours: int = 0) -> NDArray[np.float32]:
    """Return two images of linear luminance of two cameras, shape (2, 2, 6, 7) or with an axis of colours."""
    shape = (2, *SHAPE, colours) if colours else (2, *SHAPE)
    first = np.random.default_rng(3).uniform(0.2, 0.8, shape[1:])
    change = np.random.default_rng(4).uniform(0.6, 1.6, shape[1:])
    return np.stack([first, first * change]).astype(np.float32)


def events_of(images: Any, encoding: str, device: str = "cpu", cameras: int = 2) -> Events:
    sensor = EventSensor(cameras, *SHAPE[1:], SensorModel.ideal(0.2), device=device)
    sensor.step(images[0], 0, encoding)
    return sensor.step(images[1], STEP_US, encoding)[0].to_host()


def nearly(found: Events, expected: Events) -> None:
    """Compare events whose times may differ by 1 us, because logarithms are rounded differently."""
    assert len(expected) > 20
    for name in ("x", "y", "p"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    np.testing.assert_allclose(found.t, expected.t, rtol=0, atol=1)


def same(found: Events, expected: Events) -> None:
    assert len(expected) > 5
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def logs(light: NDArray[Any]) -> NDArray[np.float32]:
    return np.log(light.astype(np.float64) + DARK).astype(np.float32)


def test_linear_luminance_is_the_log_of_it_plus_the_dark(device: str) -> None:
    images = lights()
    nearly(events_of(images, "linear", device), events_of(logs(images), "log", device))


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_colours_count_by_their_luminance(device: str, channels: int) -> None:
    images = lights(channels)
    light = images[..., 0]
    if channels > 1:
        light = images[..., :3].astype(np.float64) @ [0.2126, 0.7152, 0.0722]
    nearly(events_of(images, "linear", device), events_of(logs(light), "log", device))


@pytest.mark.parametrize("channels", [0, 3])
@pytest.mark.filterwarnings("ignore:8-bit images", "ignore:.* of the pixels")
def test_8_bit_values_are_decoded_as_pictures_are(device: str, channels: int) -> None:
    images = (255.0 * lights(channels) ** 0.4).astype(np.uint8)
    light = np.stack([[linear_luminance(each) for each in cameras] for cameras in images])
    nearly(events_of(images, "srgb8", device), events_of(logs(light), "log", device))


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
@pytest.mark.parametrize("encoding", ["linear", "log"])
def test_floats_of_any_size_give_the_same_events(
    device: str, dtype: type[np.floating[Any]], encoding: str
) -> None:
    values = lights().astype(np.float16)  # all types hold these
    same(events_of(values.astype(dtype), encoding, device), events_of(values, encoding, device))


def as_warp(values: NDArray[Any], device: str) -> Any:
    return wp.array(values, dtype=wp.dtype_from_numpy(values.dtype), device=device)


def as_torch(values: NDArray[Any], device: str) -> Any:
    torch = pytest.importorskip("torch")
    return torch.tensor(values, device=device)


def as_vectors(values: NDArray[Any], device: str) -> Any:
    """Return colours as a Warp array of vectors."""
    return wp.array(values, dtype=wp.vec3, device=device)


@pytest.mark.parametrize("made", [as_warp, as_torch, as_vectors])
def test_other_libraries_give_the_same_events(
    device: str, made: Callable[[NDArray[Any], str], Any]
) -> None:
    images = lights(3)
    given = [made(image, device) for image in images]
    same(events_of(given, "linear", device), events_of(images, "linear", device))


def test_any_strides_give_the_same_events(device: str) -> None:
    torch = pytest.importorskip("torch")
    images = lights(3)
    planes = torch.tensor(np.moveaxis(images, -1, 2).copy(), device=device)
    seen = planes.movedim(2, -1)  # channels first in memory
    assert not seen.is_contiguous()
    expected = events_of(images, "linear", device)
    same(events_of(seen, "linear", device), expected)
    fortran = [np.asfortranarray(image) for image in images]
    same(events_of(fortran, "linear", device), expected)


def test_one_camera_needs_no_axis_of_cameras(device: str) -> None:
    for colours in (0, 4):
        images = lights(colours)[:, :1]
        whole = events_of(images, "linear", device, cameras=1)
        same(events_of(images[:, 0], "linear", device, cameras=1), whole)


@pytest.mark.parametrize(
    ("images", "encoding", "words"),
    [
        (lights(2)[0], "linear", "shape"),
        (lights(3)[0], "log", "shape"),
        (lights()[0], "srgb8", "uint8"),
        (lights()[0].astype(int), "linear", "int64"),
        (-lights()[0], "linear", "linear luminance of at least 0"),
        (lights()[0], "sRGB", "linear, srgb8, log"),
    ],
)
def test_other_images_are_refused(images: Any, encoding: str, words: str) -> None:
    sensor = EventSensor(2, *SHAPE[1:])
    with pytest.raises(AmiwarpError, match=words):
        sensor.step(images, 0, encoding)


def test_8_bits_are_named_as_stairs_once() -> None:
    sensor = EventSensor(2, *SHAPE[1:], SensorModel.ideal(0.15))
    dark = np.full(SHAPE, 46, np.uint8)
    with pytest.warns(
        UserWarning, match=r"stairs of up to 0\.023 .* 15% of the threshold"
    ) as caught:
        sensor.step(dark, 0, "srgb8")
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sensor.step(dark, 1000, "srgb8")
        bright = EventSensor(2, *SHAPE[1:], SensorModel.ideal(0.15))
        bright.step(np.full(SHAPE, 250, np.uint8), 0, "srgb8")
        low = EventSensor(2, *SHAPE[1:], SensorModel.ideal(0.25))
        low.step(dark, 0, "srgb8")


def test_images_too_far_apart_are_named_once() -> None:
    sensor = EventSensor(2, *SHAPE[1:], SensorModel.ideal(0.2))
    images = np.full((3, *SHAPE), 0.2, np.float32)
    images[1, 0, 0, :2] = 0.7  # log changes by 1.19, 5.9 thresholds, in 2 of 84 pixels
    images[2, 0, 0, 2] = 0.7
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sensor.step(images[0], 0, "linear")
    with pytest.warns(UserWarning, match=r"2\.4% of the pixels .* in bands") as caught:
        sensor.step(images[1], 1000, "linear")
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sensor.step(images[0], 2000, "linear")


def test_few_or_small_changes_are_not_named() -> None:
    images = np.full((3, 1, 30, 40), 0.2, np.float32)
    images[1] = 0.4  # 3.2 thresholds in all pixels
    images[2] = 0.4
    images[2, 0, 0, :12] = 0.02  # more than 4 thresholds in 1 % of the pixels
    sensor = EventSensor(1, 30, 40, SensorModel.ideal(0.2))
    for k, image in enumerate(images):
        sensor.step(image, 1000 * k, "linear")


def test_a_camera_that_starts_anew_is_not_compared_with_its_last_image() -> None:
    sensor = EventSensor(2, *SHAPE[1:], SensorModel.ideal(0.2))
    images = np.full((2, *SHAPE), 0.2, np.float32)
    images[1, 1] = 0.9
    sensor.step(images[0], 0, "linear")
    sensor.reset(1)
    sensor.step(images[1], 1000, "linear")


def test_the_encodings_are_listed() -> None:
    assert list(ImageEncoding) == ["linear", "srgb8", "log"]
