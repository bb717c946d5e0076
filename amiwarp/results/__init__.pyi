# Public names of this room. Written by .ci/public_names.py from the front door's.

from .calibration import Calibration as Calibration
from .calibration import FreedParameter as FreedParameter
from .calibration import ModelCandidate as ModelCandidate
from .calibration import ModelChoice as ModelChoice
from .calibration import PhotometricSummary as PhotometricSummary
from .calibration import StageSummary as StageSummary
from .depth_map import DepthMap as DepthMap
from .parameters import ParameterSpace as ParameterSpace
from .pixel_map import PixelMap as PixelMap
from .search_stage import SearchStage as SearchStage

# Names that are in this room only, kept by hand: what people who add to it need.

from .parameters import best_model as best_model
from .space_setup import make_space as make_space
