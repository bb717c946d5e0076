"""Optical models without their rare cases, for loops that CPUs vectorise.

LLVM vectorises a loop with a branch by computing both of its sides. So a loop over a plain model costs less: half,
for the exact model. A loop over an even model leaves out the rarest case.
"""

from typing import Any

import warp as wp

from amiwarp.kernels.exact import ExactParams

# Fused multiply-add is off because CPUs and GPUs apply it at different places: results are then bit-identical.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def is_plain(model: Any) -> int:
    """Return 1 if :func:`plain` of the model is the same model."""
    return 1


@wp.func
def is_plain(model: ExactParams) -> int:
    """Return 1 if :func:`plain` of the model is the same model. An uneven prism counts as tilted."""
    return (1 - model.tilted) * model.flat_to_scene


@wp.func
def is_even(model: Any) -> int:
    """Return 1 if :func:`even` of the model is the same model."""
    return 1


@wp.func
def is_even(model: ExactParams) -> int:
    """Return 1 if :func:`even` of the model is the same model."""
    return 1 - model.uneven


@wp.func
def even(model: Any):
    """Return the model itself, which has no rarest case."""
    return model


@wp.func
def even(model: ExactParams) -> ExactParams:
    """Return the exact model of a prism without cylinder power and wobble.

    Every field is copied but the fields of cylinder power and wobble.
    """
    m = ExactParams()
    m.sin_apex = model.sin_apex
    m.cos_apex = model.cos_apex
    m.index2 = model.index2
    m.phase = model.phase
    m.phase_cos = model.phase_cos
    m.phase_sin = model.phase_sin
    m.axis = model.axis
    m.flat_to_scene = model.flat_to_scene
    m.tilted = model.tilted
    m.uneven = 0
    return m


@wp.func
def plain(model: Any):
    """Return the model itself, which has no rare case."""
    return model


@wp.func
def plain(model: ExactParams) -> ExactParams:
    """Return the exact model of an even prism that is not tilted and has its flat face to the scene."""
    m = even(model)
    m.flat_to_scene = 1
    m.tilted = 0
    return m
