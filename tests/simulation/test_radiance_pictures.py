"""Pictures of high dynamic range, as skies and as scenes, written by OpenCV."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

import amiwarp

WEIGHTS = np.array([0.2126, 0.7152, 0.0722])
"""Luminance of linear red, green and blue (ITU-R BT.709)."""


@pytest.fixture
def colours(tmp_path: Path) -> np.ndarray:
    """Linear red, green and blue, from 0.02 to 60 times white; also in the file ``sky.hdr``."""
    rng = np.random.default_rng(2)
    values = np.exp(rng.uniform(np.log(0.02), np.log(60.0), (16, 32, 3))).astype(np.float32)
    assert cv2.imwrite(str(tmp_path / "sky.hdr"), values[..., ::-1])
    return values


def test_a_sky_of_high_dynamic_range_keeps_its_light_and_colour(
    colours: np.ndarray, tmp_path: Path
) -> None:
    (tmp_path / "tile.obj").write_text("v 0 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\n")
    (tmp_path / "world.toml").write_text(
        'format = "amiwarp-world"\nversion = 1\nsky = {panorama = "sky.hdr", luminance = 0.5}\n'
        'bodies = [{name = "tile", mesh = "tile.obj"}]\n'
    )
    world, _ = amiwarp.load_world(tmp_path / "world.toml")
    assert world.sky.panorama is not None
    light = colours @ WEIGHTS
    # Eight bits for the largest colour of a pixel, which the others share
    error = colours.max(axis=2) / 128.0
    assert (np.abs(world.sky.panorama - light) <= error).all()
    assert world.sky.panorama.max() > 20.0
    assert world.sky.luminance == 0.5
    seen = world.sky.colour * world.sky.panorama[..., None]
    assert (np.abs(seen - colours) <= 2.0 * error[..., None]).all()


def test_a_scene_of_high_dynamic_range_is_linear(colours: np.ndarray, tmp_path: Path) -> None:
    ((_, light),) = amiwarp.Scene.from_picture(tmp_path / "sky.hdr").frames.read()
    np.testing.assert_allclose(light, colours @ WEIGHTS, rtol=0, atol=0.6)


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "bad.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 9 +X 9\n")
    with pytest.raises(amiwarp.AmiwarpError, match=r"bad\.hdr: cannot be read as a Radiance"):
        amiwarp.Scene.from_picture(tmp_path / "bad.hdr")
