"""Calibration: the prism's parameters from the recording itself."""

from amiwarp.calib.calibrate import Settings, calibrate
from amiwarp.calib.result import Calibration

__all__ = ["Calibration", "Settings", "calibrate"]
