# Public names of this room. Written by .ci/public_names.py from the front door's.

from .handle import InspectorHandle as InspectorHandle
from .handle import view as view

# Names that are in this room only, kept by hand: what people who add to it need.

from .address import decode_state as decode_state
from .address import encode_state as encode_state
from .filters import Selection as Selection
from .first_phase import estimate_phase as estimate_phase
from .images import ImageKind as ImageKind
from .images import make_images as make_images
from .inspector import Inspector as Inspector
from .library import Library as Library
from .look import Look as Look
from .panel import Panel as Panel
from .rig_pictures import ShownRig as ShownRig
from .rig_pictures import main_sensor as main_sensor
from .view_state import ViewState as ViewState
from .view_state import apply_state as apply_state
from .view_state import current_state as current_state
from .window import Window as Window
