# Public names of this room. Written by .ci/public_names.py from the front door's.

from .bytes_decoder import BytesDecoder as BytesDecoder
from .camera_files import load_camera as load_camera
from .camera_files import save_camera as save_camera
from .conversion import ConversionSummary as ConversionSummary
from .conversion import convert as convert
from .encoder_csv import read_encoder_csv as read_encoder_csv
from .encoder_triggers import read_encoder_triggers as read_encoder_triggers
from .formats import Format as Format
from .formats import detect_format as detect_format
from .formats import open_recording as open_recording
from .native.copying import save_recording as save_recording
from .native.writer import RecordingWriter as RecordingWriter
from .output_formats import Codec as Codec
from .output_formats import OutputFormat as OutputFormat
from .output_formats import Rounding as Rounding
from .prophesee.evt_decoder import EvtDecoder as EvtDecoder
from .prophesee.evt_decoder import Triggers as Triggers
from .recorded_dataset import RecordedDataset as RecordedDataset
from .rig_files import RigWriter as RigWriter
from .rig_files import open_rig as open_rig
from .rig_files import save_rig as save_rig
from .rig_formats.conversion import RigConversionSummary as RigConversionSummary
from .rig_formats.conversion import RigFormat as RigFormat
from .rig_formats.conversion import convert_rig as convert_rig
from .truth_files import save_flow_dsec as save_flow_dsec
from .truth_files import save_flow_mvsec as save_flow_mvsec
from .truth_files import save_poses_tum as save_poses_tum

# Names that are in this room only, kept by hand: what people who add to it need.

from .camera_files import read_calib as read_calib
from .native.live_writer import LiveWriter as LiveWriter
from .prophesee.evt3_encoder import Evt3Encoder as Evt3Encoder
