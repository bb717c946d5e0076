"""Kernels that the demo needs on a CPU, to be compiled before they are needed.

Each is followed by the structs of its generic arguments. The other kernels of its module are compiled with it.
"""

from amiwarp.calib.groundwork import CIRCLES
from amiwarp.imaging.sharpness import gaussian
from amiwarp.kernels.camera import PinholeParams, fill_rays
from amiwarp.kernels.checksum import compute_checksums
from amiwarp.kernels.compensation import compensate_blocks
from amiwarp.kernels.conjugate_gradients import descend, link
from amiwarp.kernels.edge_directions import find_largest
from amiwarp.kernels.equations_cpu import apply_normal, make_chains
from amiwarp.kernels.event_keys import unpack
from amiwarp.kernels.events_with_angles import store_turns
from amiwarp.kernels.exact import ExactParams
from amiwarp.kernels.iwe import CPU_WIDTH, read_sums
from amiwarp.kernels.known_nodes import mark_known
from amiwarp.kernels.map_positions import find_places, place_blocks
from amiwarp.kernels.mask_regions import find_large_regions
from amiwarp.kernels.multilevel import prolong_rows
from amiwarp.kernels.pairs import mark_spans
from amiwarp.kernels.pixel_votes import vote_event_blocks, vote_point_blocks
from amiwarp.kernels.pixels import run_pixels_ahead, start_pixels
from amiwarp.kernels.prism_view import see_without_prism
from amiwarp.kernels.refraction import compensate_points
from amiwarp.kernels.residual_slopes import slope_between
from amiwarp.kernels.residual_sums import sum_costs
from amiwarp.kernels.slow_pixels import write_brightness, write_time_constants
from amiwarp.kernels.smoothing import smooth, smooth_and_sum
from amiwarp.kernels.square_sums import find_squares
from amiwarp.optics.models.registry import MODELS

EXACT_KERNELS = (
    (store_turns,),
    (vote_event_blocks, ExactParams, PinholeParams),
    (read_sums,),
    # Coarse and fine images of a calibration
    *((smooth_and_sum(len(gaussian(sigma))),) for sigma in (2.0, 1.0)),
    (smooth(int(CPU_WIDTH)),),
    (find_largest,),
    (mark_spans,),
    (find_places, ExactParams, PinholeParams),
    (place_blocks, ExactParams),
    (make_chains,),
    (apply_normal,),
    (descend,),
    (sum_costs,),
    (slope_between,),
    (write_brightness, ExactParams),
    (write_time_constants, ExactParams),
    (find_squares,),
    (compensate_blocks, ExactParams, PinholeParams),
    (compute_checksums,),
    (vote_point_blocks,),
    (link,),
    (prolong_rows,),
    (mark_known,),
    (find_large_regions,),
)
"""Kernels of calibration, compensation and reconstruction by the exact model, in the order of their use."""
SIMULATION_KERNELS = (
    (compensate_points, ExactParams),
    (fill_rays,),
    (see_without_prism,),
    (run_pixels_ahead,),
    (start_pixels,),
    (unpack,),
)
"""Kernels of a simulation of the exact model, in the order of their use."""
CHOICE_KERNELS = tuple((compensate_points, MODELS[name].STRUCT) for name in CIRCLES)
"""Kernels of the choice among optical models, which the demo leaves out and ``calibrate`` makes by default."""
