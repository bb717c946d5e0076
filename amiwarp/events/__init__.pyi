# Public names of this room. Written by .ci/public_names.py from the front door's.

from .device_events import DeviceEvents as DeviceEvents
from .device_events import DeviceMemoryEvents as DeviceMemoryEvents
from .encoder import Encoder as Encoder
from .encoder_stream import EncoderStream as EncoderStream
from .other_sensors import ImageStore as ImageStore
from .other_sensors import ImuSamples as ImuSamples
from .other_sensors import MemoryImages as MemoryImages
from .poses import PoseStore as PoseStore
from .poses import Poses as Poses
from .recording import EventSource as EventSource
from .recording import Events as Events
from .recording import MemoryEvents as MemoryEvents
from .recording import MetadataValue as MetadataValue
from .recording import Recording as Recording
from .rig_recording import RigRecording as RigRecording
from .rig_recording import RigSensor as RigSensor
from .rig_recording import SensorKind as SensorKind
from .truth import Cause as Cause
from .truth import EventTruth as EventTruth
from .truth import EventValues as EventValues
from .truth import FrameStore as FrameStore
from .truth import FrameTruth as FrameTruth
from .truth import KnownStore as KnownStore
from .truth import PointStore as PointStore
from .truth import Truth as Truth
from .truth import WorldLabels as WorldLabels

# Names that are in this room only, kept by hand: what people who add to it need.

from .axes import axes_in_words as axes_in_words
from .axes import orientations as orientations
from .truth import MemoryMasks as MemoryMasks
