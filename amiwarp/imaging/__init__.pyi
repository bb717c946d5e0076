# Public names of this room. Written by .ci/public_names.py from the front door's.

from .background_activity import find_background_activity as find_background_activity
from .corners import CornerDetector as CornerDetector
from .corners import detect_corners as detect_corners
from .filters import EventFilter as EventFilter
from .filters import FilterSummary as FilterSummary
from .filters import filter_recording as filter_recording
from .filters import find_hot_pixels as find_hot_pixels
from .metrics import edge_blur as edge_blur
from .metrics import model_error as model_error
from .metrics import truth_model as truth_model
from .phase import PhaseSums as PhaseSums
from .phase import phase_sums as phase_sums
from .phase import weighted_sums as weighted_sums
from .phase_ring import PhaseRing as PhaseRing
from .phase_ring import PhaseUpdate as PhaseUpdate
from .phase_ring import RingPart as RingPart
from .recent_tensors import event_spike_tensor as event_spike_tensor
from .recent_tensors import mixed_density_stack as mixed_density_stack
from .recent_tensors import tore_volume as tore_volume
from .tensor_stream import StreamTensor as StreamTensor
from .tensor_stream import TensorStream as TensorStream
from .tensors import event_count as event_count
from .tensors import latest_times as latest_times
from .tensors import polarity_histogram as polarity_histogram
from .tensors import stacked_histogram as stacked_histogram
from .tensors import time_surface as time_surface
from .tensors import voxel_grid as voxel_grid
from .to_tensor import ToTensor as ToTensor
from .windows import Windows as Windows
from .windows import collate as collate

# Names that are in this room only, kept by hand: what people who add to it need.

from .canvas import CanvasShape as CanvasShape
from .canvas import Image as Image
from .metrics import picture_quality as picture_quality
from .sharpness import SharpnessMeter as SharpnessMeter
from .uploaded_events import upload_events as upload_events
from .votes import Votes as Votes
