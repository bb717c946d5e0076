"""The calibration's JSON file: saved and loaded again, and every kind of damage."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from amiwarp import (
    AmiwarpError,
    Calibration,
    Camera,
    Encoder,
    ErrorCode,
    Fisheye,
    Prism,
    RadialTangential,
)
from amiwarp.optics.camera import camera_from_json, camera_to_json
from tests.errors import refused


def test_there_and_back(calibration: Calibration, tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    calibration.save(path)
    assert Calibration.load(path) == calibration
    assert list(tmp_path.iterdir()) == [path]


def test_units_are_said(calibration: Calibration) -> None:
    apex = calibration.to_json()["parameters"]["apex"]
    assert apex["unit"] == "rad"
    assert apex["degrees"] == pytest.approx(math.degrees(apex["value"]))
    assert apex["std"] > 0


def test_the_representation_is_short_and_in_degrees(calibration: Calibration) -> None:
    first, second = repr(calibration).splitlines()
    assert first.startswith("Calibration(exact: apex ")
    assert f"apex {math.degrees(calibration.parameters['apex']):.5g} ± " in first
    assert first.count(" deg") == 2
    assert f", {calibration.events:,} events" in second
    assert len(first) < 120


@pytest.mark.parametrize("count", [0, 1, 2])
def test_the_representation_counts_the_warnings(count: int) -> None:
    warned = {0: "", 1: ", 1 warning", 2: ", 2 warnings"}[count]
    calibration = _without_encoder(warnings=("the lens is wide",) * count)
    assert repr(calibration).endswith(f" events{warned})")


def test_a_path_found_in_the_events_holds_only_where_it_is_known() -> None:
    path = Encoder.constant_speed(720.0, 0, 1_000_000)
    calibration = _without_encoder(path=path, zero_us=0)
    first, last = path.coverage
    assert calibration.encoder_for(None, first, last) is path
    for span in ((first - 1, last), (first, last + 1)):
        with pytest.raises(AmiwarpError, match="the prism's path for one recording only"):
            calibration.encoder_for(None, *span)


def _without_encoder(**fields: Any) -> Calibration:
    """Return a calibration of a recording without an encoder."""
    return Calibration(
        model_name="exact",
        camera=Camera.from_fov(64, 48, 1.0),
        prism=Prism(0.035),
        parameters={"apex": 0.026, "phase": 0.4},
        uncertainty={},
        free=("apex", "phase"),
        sharpness_name="variance",
        sharpness_before=1.0,
        sharpness_after=2.0,
        stages=(),
        events=300_000,
        seconds=1.5,
        **fields,
    )


@pytest.mark.parametrize(
    "distortion",
    [
        None,
        RadialTangential(-0.3, 0.1, 1e-3, 2e-3, 0.01),
        RadialTangential(k1=0.3, k6=0.1),
        Fisheye(0.1, 0.02),
    ],
)
def test_cameras(distortion: RadialTangential | Fisheye | None) -> None:
    camera = Camera(640, 480, 500.0, 501.0, 320.0, 240.0, distortion)
    assert camera_from_json(json.loads(json.dumps(camera_to_json(camera)))) == camera


def drop(*keys: str) -> Callable[[dict[str, Any]], None]:
    def change(data: dict[str, Any]) -> None:
        for key in keys[:-1]:
            data = data[key]
        del data[keys[-1]]

    return change


def put(value: Any, *keys: str) -> Callable[[dict[str, Any]], None]:
    def change(data: dict[str, Any]) -> None:
        for key in keys[:-1]:
            data = data[key]
        data[keys[-1]] = value

    return change


DAMAGE = [
    drop("model"),
    drop("camera"),
    drop("camera", "fx"),
    drop("parameters", "apex"),
    drop("parameters", "phase", "value"),
    put("sphere", "model"),
    put(float("nan"), "parameters", "apex", "value"),
    put("1", "parameters", "apex", "value"),
    put(99.0, "parameters", "apex", "value"),
    put({"value": 1.0, "free": True}, "parameters", "focal"),
    put("sideways", "prism", "flat_side"),
    put(-1, "camera", "width"),
    put(7, "version"),
    put("other", "format"),
    put([{"name": "x"}], "stages"),
    put(None, "sharpness"),
    put("noon", "zero_us"),
    put(0.5, "zero_us"),
]


@pytest.mark.parametrize("damage", DAMAGE)
def test_damage_is_named(
    calibration: Calibration, tmp_path: Path, damage: Callable[[dict[str, Any]], None]
) -> None:
    path = tmp_path / "c.json"
    data = calibration.to_json()
    damage(data)
    path.write_text(json.dumps(data))
    with pytest.raises(AmiwarpError, match=r"c\.json"):
        Calibration.load(path)


@pytest.mark.parametrize("text", ["", "{", "[]", "null", "\x00\x01", '{"format": 1}'])
def test_no_calibration_at_all(tmp_path: Path, text: str) -> None:
    path = tmp_path / "c.json"
    path.write_text(text)
    with pytest.raises(AmiwarpError, match=r"c\.json"):
        Calibration.load(path)


def test_missing_file_and_folder(calibration: Calibration, tmp_path: Path) -> None:
    with pytest.raises(AmiwarpError, match=r"none\.json"):
        Calibration.load(tmp_path / "none.json")
    with refused(ErrorCode.OUTPUT_FAILED):
        calibration.save(tmp_path / "nowhere" / "c.json")
