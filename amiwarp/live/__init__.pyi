# Public names of this room. Written by .ci/public_names.py from the front door's.

from .camera import CameraPackets as CameraPackets
from .camera import open_camera as open_camera
from .compensated import compensate_live as compensate_live
from .items import LivePackets as LivePackets
from .pictures import pictures_live as pictures_live
from .plain import stream_live as stream_live
from .queues import Policy as Policy
from .stream.camera_settings import CameraSettings as CameraSettings
from .stream.packets import Packet as Packet
from .stream.session_status import StageStatus as StageStatus

# Names that are in this room only, kept by hand: what people who add to it need.

from .queues import PacketQueue as PacketQueue
