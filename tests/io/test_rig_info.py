"""``amiwarp info`` of a rig: sensors, places, rates, and clocks that do not fit."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import amiwarp
from amiwarp import Camera, Events, ImuSamples, MemoryEvents, MemoryImages, Recording, RigSensor
from tests.command_line import app

CAMERA = Camera.from_fov(6, 4, np.radians(60.0))
TIMES = np.arange(5) * 25_000


def place(degrees: float, x: float, y: float, z: float) -> Any:
    turned = Rotation.from_rotvec([0, np.radians(degrees), 0]).as_matrix()
    return np.column_stack([turned, [x, y, z]])


def write(folder: Path, *, late_us: int) -> None:
    t = np.arange(1001) * 100
    events = Events.from_arrays(x=t % 6, y=t % 4, t=t, p=t % 2)
    imu = ImuSamples(np.arange(51) * 2000, np.zeros((51, 3)), np.zeros((51, 3)))
    depth = MemoryImages(TIMES + late_us, np.ones((5, 4, 6), np.float32))
    nothing = MemoryEvents(events[:0], 6, 4)
    left = Recording(events, CAMERA, imu=imu)
    rig = amiwarp.RigRecording(
        {
            "left": RigSensor("events", left, place(10, 0, 0, 1)),
            "tof": RigSensor("depth", Recording(nothing, depth=depth), place(13, 0, 0.3, 1)),
        },
        {"world": "room"},
    )
    amiwarp.save_rig(folder, rig)


def info(path: Path) -> tuple[str, dict[str, Any]]:
    text = CliRunner().invoke(app, ["info", str(path)])
    data = CliRunner().invoke(app, ["info", str(path), "--json"])
    assert (text.exit_code, data.exit_code) == (0, 0)
    return " ".join(text.output.split()), json.loads(data.output)


def test_info_shows_sensors_and_places(tmp_path: Path) -> None:
    write(tmp_path / "rig", late_us=500)
    text, data = info(tmp_path / "rig")
    left, tof = data["sensors"]["left"], data["sensors"]["tof"]
    assert (left["events"], left["rate_mev_per_s"], left["fov_deg"]) == (
        1001,
        pytest.approx(0.01001),
        pytest.approx(60),
    )
    assert left["imu"] == {"count": 51, "rate_hz": pytest.approx(500)}
    assert tof["depth_maps"] == {"count": 5, "rate_hz": pytest.approx(40)}
    assert tof["angle_deg"] == pytest.approx(3, abs=1e-9)
    assert tof["position_mm"] == pytest.approx([0, 300, 0], abs=1e-9)
    assert (data["common_us"], data["warnings"]) == ([500, 100_000], [])
    assert "300 mm from left (x 0, y 300, z 0), turned by 3 deg" in text
    assert "events, 6 x 4 px, FOV 60 deg, 1,001 events (0.01 Mev/s), 51 IMU samples" in text
    assert "world room" in text


@pytest.mark.parametrize(
    ("late_us", "common", "warning"),
    [
        (49_000, [49_000, 100_000], None),
        (51_000, [51_000, 100_000], "overlap only by 0.049 s"),
        (200_000, None, "(0 .. 100000 us) and tof (200000 .. 300000 us) do not overlap"),
    ],
)
def test_clocks_that_do_not_fit_are_named(
    tmp_path: Path, late_us: int, common: Any, warning: str | None
) -> None:
    write(tmp_path / "rig", late_us=late_us)
    text, data = info(tmp_path / "rig")
    assert data["common_us"] == common
    assert [warning in line for line in data["warnings"] if warning] == [True] * bool(warning)
    assert ("a rig has one clock" in text) == bool(warning)


def test_a_rig_is_no_recording(tmp_path: Path) -> None:
    write(tmp_path / "rig", late_us=0)
    with pytest.raises(amiwarp.AmiwarpError, match=r"is a rig of .* with amiwarp\.open_rig"):
        amiwarp.open_recording(tmp_path / "rig")
