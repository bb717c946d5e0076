# Public names of this room. Written by .ci/public_names.py from the front door's.

from .camera import Camera as Camera
from .camera_rotation import CameraRotation as CameraRotation
from .distortion import Distortion as Distortion
from .distortion import Fisheye as Fisheye
from .distortion import RadialTangential as RadialTangential
from .models.base import Model as Model
from .models.circle import CircleModel as CircleModel
from .models.circle import RadialCircleModel as RadialCircleModel
from .models.comparison import ModelError as ModelError
from .models.comparison import predicted_error as predicted_error
from .models.ellipse import EllipseModel as EllipseModel
from .models.exact import ExactModel as ExactModel
from .models.mirror import MirrorModel as MirrorModel
from .models.pair import RisleyModel as RisleyModel
from .models.parameter import Parameter as Parameter
from .models.plate import PlateModel as PlateModel
from .models.steerer import SteererModel as SteererModel
from .models.vibration import VibrationModel as VibrationModel
from .orbit import LockedAngles as LockedAngles
from .prism import FlatSide as FlatSide
from .prism import NominalPrism as NominalPrism
from .prism import Plate as Plate
from .prism import Prism as Prism
from .prism import UnsizedPrism as UnsizedPrism
from .prism import apex_from_deflection as apex_from_deflection
from .prism import deflection_from_apex as deflection_from_apex
from .rotation_path import RotationPath as RotationPath

# Names that are in this room only, kept by hand: what people who add to it need.

from .models.angles import wrap_angle as wrap_angle
from .models.registry import MODELS as MODELS
from .models.registry import build_model as build_model
from .models.registry import rungs as rungs
