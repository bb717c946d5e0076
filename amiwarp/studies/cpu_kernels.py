"""Kernels that the steps after a simulation need on a CPU, to be compiled before they are needed.

Each is followed by the structs of its generic arguments. The other kernels of its module are compiled with it.
"""

from amiwarp.imaging.sharpness_costs import gaussian
from amiwarp.kernels.camera import PinholeParams
from amiwarp.kernels.checksum import compute_checksums
from amiwarp.kernels.compensation import compensate_blocks
from amiwarp.kernels.conjugate_gradients import descend
from amiwarp.kernels.edge_directions import find_largest
from amiwarp.kernels.equation_blocks import apply_normal
from amiwarp.kernels.iwe import CPU_WIDTH, read_sums, smooth, smooth_and_sum
from amiwarp.kernels.known_nodes import mark_known
from amiwarp.kernels.map_positions import find_places, place_blocks
from amiwarp.kernels.map_prior import link
from amiwarp.kernels.multilevel import prolong
from amiwarp.kernels.pair_chains import make_chains
from amiwarp.kernels.pairs import mark_spans
from amiwarp.kernels.pixel_votes import vote_event_blocks, vote_point_blocks
from amiwarp.kernels.refraction import (
    CircleParams,
    ExactParams,
    RadialCircleParams,
    compensate_points,
)
from amiwarp.kernels.regions import find_large_regions
from amiwarp.kernels.residual_slopes import sum_costs
from amiwarp.kernels.slow_pixels import find_time_constants
from amiwarp.kernels.square_sums import find_squares
from amiwarp.kernels.votes import turn_events

EXACT_KERNELS = (
    (turn_events,),
    (vote_event_blocks, ExactParams, PinholeParams),
    (read_sums,),
    *((smooth_and_sum(len(gaussian(sigma))),) for sigma in (2.0, 1.0)),  # coarse and fine images of a calibration
    (smooth(int(CPU_WIDTH)),),
    (find_largest,),
    (mark_spans,),
    (find_places, ExactParams, PinholeParams),
    (place_blocks, ExactParams),
    (make_chains,),
    (apply_normal,),
    (descend,),
    (sum_costs,),
    (find_time_constants, ExactParams),
    (find_squares,),
    (compensate_blocks, ExactParams, PinholeParams),
    (compute_checksums,),
    (link,),
    (prolong,),
    (mark_known,),
    (find_large_regions,),
)
"""Kernels of calibration, compensation and reconstruction by the exact model, in the order of their use."""
FIGURE_KERNELS = (
    *((compensate_points, struct) for struct in (CircleParams, RadialCircleParams)),
    (vote_point_blocks,),
)
"""Kernels of the demo's figure and of its comparison of simpler models."""
