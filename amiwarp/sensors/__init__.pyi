# Public names of this room. Written by .ci/public_names.py from the front door's.

from .event_camera import EventCamera as EventCamera
from .rays import Rays as Rays
from .renderer import Renderer as Renderer
from .renderer import Surfaces as Surfaces

# Names that are in this room only, kept by hand: what people who add to it need.

from .gym_observation import EventObservation as EventObservation
from .gym_observation import EventVectorObservation as EventVectorObservation
from .mujoco_camera import MujocoWarpEventCamera as MujocoWarpEventCamera
from .mujoco_camera import MujocoWarpRenderer as MujocoWarpRenderer
from .newton_camera import NewtonEventCamera as NewtonEventCamera
from .newton_camera import NewtonRenderer as NewtonRenderer
from .versions import DISTRIBUTIONS as DISTRIBUTIONS
from .versions import EXTRAS as EXTRAS
from .versions import TESTED as TESTED
from .versions import simulator as simulator
from .wide_view import look_up as look_up
from .wide_view import wide_camera as wide_camera
