# Public names of the stability study, kept by hand: its cells, their recordings and outcomes.

from .axes import Axis as Axis
from .cells import Store as Store
from .cells import Stored as Stored
from .condition import Cell as Cell
from .condition import Condition as Condition
from .judging import Outcome as Outcome
from .judging import Result as Result
from .scenes import SceneKind as SceneKind
