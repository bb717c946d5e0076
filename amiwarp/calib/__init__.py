"""Calibration: the prism's parameters from the recording itself."""

from amiwarp.calib.calibrate import calibrate
from amiwarp.calib.result import Calibration
from amiwarp.calib.search import Settings

__all__ = ["Calibration", "Settings", "calibrate"]
