# Public names of this room. Written by .ci/public_names.py from the front door's.

from .calibration import calibrate as calibrate
from .settings import CalibrationOptions as CalibrationOptions
from .settings import PhotometricSettings as PhotometricSettings
from .settings import Settings as Settings

# Names that are in this room only, kept by hand: what people who add to it need.

from .nlopt_solver import GLOBAL_ALGORITHMS as GLOBAL_ALGORITHMS
from .nlopt_solver import LOCAL_ALGORITHMS as LOCAL_ALGORITHMS
from .paper_method import calibrate_as_paper as calibrate_as_paper
from .presets import Preset as Preset
