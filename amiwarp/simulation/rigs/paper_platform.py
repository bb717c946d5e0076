"""Cameras of the platform of the AMI-EV paper: a camera behind a wedge, a plain one, and a RealSense D435."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
from numpy.typing import NDArray

from amiwarp.optics.camera import LARGEST_SIZE, Camera
from amiwarp.optics.prism import Prism
from amiwarp.simulation.imu_model import ImuModel
from amiwarp.simulation.rigs.cameras import (
    RigCamera,
    RigDepthCamera,
    RigEventCamera,
    RigFrameCamera,
)
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.validation import vector, whole

PAPER_PLATFORM = "paper-platform"
"""Name of the platform in rig files."""
VGA = (640, 480)
"""Size of all images [px]."""
APEX = math.radians(1.0)
"""Apex angle of the wedge [rad]."""
RPM = 720.0
"""Speed of the wedge [turns/min]."""
EVENT_FOV = math.radians(60.0)
COLOUR_FOV = math.radians(54.8)
STEREO_FOV = math.radians(75.0)
"""Horizontal fields of view of the event cameras, the D435's colour camera, and its imagers of grey and depth [rad]."""


def paper_platform(size: tuple[int, int] = VGA, apex: float = APEX) -> dict[str, RigCamera]:
    """Return the cameras by name. ``size``: width and height of all images [px]; ``apex``: apex of the wedge [rad].

    The frame of the rig is the frame of the camera behind the wedge.
    """
    dvxplorer = SensorModel.preset("dvxplorer")
    imu = ImuModel.preset("bmi160")
    width, height = vector(size, 2, "size", partial(whole, low=1, high=LARGEST_SIZE, hint=" px"))
    events = Camera.from_fov(width, height, EVENT_FOV)
    stereo = Camera.from_fov(width, height, STEREO_FOV)
    d435 = _placed(0.035, -0.06)  # its left imager, the origin of its depth
    return {
        "ami": RigEventCamera(events, Prism(apex), motion=RPM, sensor=dvxplorer, imu=imu),
        "plain": RigEventCamera(events, to_rig=_placed(0.07, 0.0), sensor=dvxplorer, imu=imu),
        "colour": RigFrameCamera(
            Camera.from_fov(width, height, COLOUR_FOV),
            to_rig=_placed(0.05, -0.06),
            colour=True,
            exposure_us=8000,
            readout_us=16000,
        ),
        "grey": RigFrameCamera(stereo, to_rig=d435, exposure_us=8000),
        "depth": RigDepthCamera(stereo, to_rig=d435, nearest_m=0.2, farthest_m=10.0),
    }


def _placed(right_m: float, down_m: float) -> NDArray[np.float64]:
    """Return the matrix of a camera that looks ahead, from a place to the right of the origin and below it [m]."""
    return np.column_stack([np.eye(3), (right_m, down_m, 0.0)])
