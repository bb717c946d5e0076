# Public names of the evaluations, kept by hand: what a new measure is made of.

from .claims import Verdict as Verdict
from .claims import judge as judge
from .conditions import Condition as Condition
from .conditions import QUICK as QUICK
from .optical_flow import flow_error as flow_error
from .results import CellResult as CellResult
from .results import Chart as Chart
from .results import Table as Table
from .streams import Frames as Frames
from .streams import Setup as Setup
from .streams import Stream as Stream
from .streams import Streams as Streams
