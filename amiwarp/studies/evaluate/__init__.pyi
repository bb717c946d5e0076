# Public names of the evaluations, kept by hand: what a new measure is made of.

from .claims import Verdict as Verdict
from .claims import judge as judge
from .conditions import Condition as Condition
from .conditions import QUICK as QUICK
from .corner_tracks import Tracks as Tracks
from .corner_tracks import link_corners as link_corners
from .frame_tracks import track_frames as track_frames
from .optical_flow import flow_error as flow_error
from .results import CellResult as CellResult
from .results import Chart as Chart
from .results import Table as Table
from .streams import Frames as Frames
from .streams import Setup as Setup
from .streams import Stream as Stream
from .streams import Streams as Streams
from .track_quality import lifetimes as lifetimes
from .track_quality import lives as lives
from .track_quality import quality_curve as quality_curve
from .track_quality import track_quality as track_quality
from .track_truth import project as project
from .track_truth import seen_places as seen_places
from .track_truth import true_paths as true_paths
