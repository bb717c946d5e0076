"""Calibration: find the prism's parameters in the recording itself."""

from amiwarp.calib.calibration import calibrate
from amiwarp.calib.result import Calibration
from amiwarp.calib.settings import Settings

__all__ = ["Calibration", "Settings", "calibrate"]
