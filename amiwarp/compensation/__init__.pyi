# Public names of this room. Written by .ci/public_names.py from the front door's.

from .in_memory import compensate_events as compensate_events
from .recordings import CompensationSummary as CompensationSummary
from .recordings import compensate as compensate
from .streams import Compensated as Compensated
from .streams import Compensator as Compensator
from .streams import DeviceCompensated as DeviceCompensated

# Names that are in this room only, kept by hand: what people who add to it need.

from .streams import EXTRAPOLATED as EXTRAPOLATED
from .streams import NO_ANGLE as NO_ANGLE
from .streams import OUTSIDE as OUTSIDE
