# Public names of this room. Written by .ci/public_names.py from the front door's.

from .board import Board as Board
from .board import Corners as Corners
from .calibration import calibrate_lens as calibrate_lens
from .result import BoardPose as BoardPose
from .result import LensCalibration as LensCalibration
