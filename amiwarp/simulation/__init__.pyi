# Public names of this room. Written by .ci/public_names.py from the front door's.

from .choices import FrameEncoding as FrameEncoding
from .choices import Seeing as Seeing
from .description import Frames as Frames
from .description import Scene as Scene
from .description import SimulationValues as SimulationValues
from .encoder_model import EncoderModel as EncoderModel
from .event_sensor import EventSensor as EventSensor
from .imu_model import ImuModel as ImuModel
from .motion import CameraMotion as CameraMotion
from .motion import Mirror as Mirror
from .motion import PrismMotion as PrismMotion
from .motion import Steerer as Steerer
from .motion import Vibration as Vibration
from .other_camera import PlacesInCamera as PlacesInCamera
from .other_camera import disparity as disparity
from .other_camera import places_in as places_in
from .pictures import PictureFolder as PictureFolder
from .pictures import PictureStack as PictureStack
from .pictures import Pictures as Pictures
from .pictures import VideoFile as VideoFile
from .rigs.cameras import RigDepthCamera as RigDepthCamera
from .rigs.cameras import RigEventCamera as RigEventCamera
from .rigs.cameras import RigFrameCamera as RigFrameCamera
from .rigs.rig import Rig as Rig
from .rigs.rig_specification import load_rig as load_rig
from .sensor_model import SensorModel as SensorModel
from .simulator import Simulation as Simulation
from .simulator import simulate as simulate
from .translation.datasets import DataSet as DataSet
from .translation.picture_pair import Interpolation as Interpolation
from .translation.translator import translate as translate
from .truth_renderer import TruthRenderer as TruthRenderer
from .worlds.bodies import Body as Body
from .worlds.bodies import Material as Material
from .worlds.bodies import Mesh as Mesh
from .worlds.lights import Lamp as Lamp
from .worlds.lights import Sky as Sky
from .worlds.lights import Sun as Sun
from .worlds.named.catalogue import named_world as named_world
from .worlds.trajectory import Trajectory as Trajectory
from .worlds.world import World as World
from .worlds.world_files import load_world as load_world
from .worlds.world_scene import WorldScene as WorldScene

# Names that are in this room only, kept by hand: what people who add to it need.

from .image_levels import ImageEncoding as ImageEncoding
from .picture_light import DARK as DARK
from .picture_light import linear_luminance as linear_luminance
from .picture_opening import open_pictures as open_pictures
from .picture_light import read_picture as read_picture
