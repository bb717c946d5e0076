# Public names of this room. Written by .ci/public_names.py from the front door's.

from .depth_at_rest import depth as depth
from .image_in_phase import PhaseImage as PhaseImage
from .image_in_phase import phase_image as phase_image
from .phase_camera import LivePicture as LivePicture
from .phase_camera import PhaseCamera as PhaseCamera
from .phase_window import PhaseReconstruction as PhaseReconstruction
from .picture import Picture as Picture
from .picture_in_phase import phase_picture as phase_picture
from .pixels import pixel_thresholds as pixel_thresholds
from .reconstruct import Reconstruction as Reconstruction

# Names that are in this room only, kept by hand: what people who add to it need.

from .depth_in_phase import TileDepths as TileDepths
from .depth_in_phase import depths_in_phase as depths_in_phase
from .film_files import save_film as save_film
from .locked_angles import MotionPeriod as MotionPeriod
from .phase_paths import detail_of_paths as detail_of_paths
from .phase_paths import is_orbit as is_orbit
from .phase_paths import lag_of_paths as lag_of_paths
from .phase_paths import path_plan_of as path_plan_of
from .phase_window import harmonics_for as harmonics_for
from .picture_files import save_picture as save_picture
