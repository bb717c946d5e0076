# Public names of this room. Written by .ci/public_names.py from the front door's.

from .film import FilmSummary as FilmSummary
from .film import render as render
from .meshes import event_clouds as event_clouds

# Names that are in this room only, kept by hand: what people who add to it need.

from .colours import Scale as Scale
from .colours import depth_image as depth_image
