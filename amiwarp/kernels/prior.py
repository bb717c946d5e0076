"""Device side of what holds the unknowns that no equation determines: damping, and links between neighbouring nodes."""

import warp as wp

wp.set_module_options({"enable_backward": False})


EXTRA = wp.constant(2)  # unknowns behind the map: leak, OFF threshold


@wp.struct
class Prior:
    """Cost damping x² + sum over links of weight (xᵢ - xⱼ)²; no link leaves a tile."""

    damping: float
    linked: int
    columns: int
    held: int  # unknowns from here on keep their values
    smooth: wp.array(dtype=float)  # one number: weight of a link between equal neighbours
    right: wp.array(dtype=float)  # weight of the link to the next node; 0 in a tile's last column
    down: wp.array(dtype=float)  # to the node below; 0 in a tile's last row


@wp.func
def prior_product(prior: Prior, vector: wp.array(dtype=float), i: int) -> float:
    """Row i of the prior's operator times a vector."""
    total = prior.damping * vector[i]
    if prior.linked == 0:
        return total
    if prior.right[i] > 0.0:
        total += prior.right[i] * (vector[i] - vector[i + 1])
    if prior.down[i] > 0.0:
        total += prior.down[i] * (vector[i] - vector[i + prior.columns])
    if i > 0 and prior.right[i - 1] > 0.0:
        total += prior.right[i - 1] * (vector[i] - vector[i - 1])
    if i >= prior.columns and prior.down[i - prior.columns] > 0.0:
        total += prior.down[i - prior.columns] * (vector[i] - vector[i - prior.columns])
    return total


@wp.func
def prior_diagonal(prior: Prior, i: int) -> float:
    """The operator's diagonal; for an unknown that is held so large that the preconditioner stops all steps to it."""
    if i >= prior.held:
        return 1.0e30
    total = prior.damping
    if prior.linked == 0:
        return total
    total += prior.right[i] + prior.down[i]
    if i > 0:
        total += prior.right[i - 1]
    if i >= prior.columns:
        total += prior.down[i - prior.columns]
    return total


@wp.func
def link_weight(difference: float, smooth: float, edge: float) -> float:
    """Charbonnier's weight: links let go where neighbours differ by more than ``edge``; 0 for equal weights."""
    if edge <= 0.0:
        return smooth
    return smooth / wp.sqrt(1.0 + (difference / edge) * (difference / edge))


@wp.kernel
def link(
    image: wp.array(dtype=float),
    rows: int,
    edge: float,
    prior: Prior,
    start: int,
    right: wp.array(dtype=float),
    down: wp.array(dtype=float),
):
    """Weights of the links from each node of the map, into the prior's arrays."""
    i = start + wp.tid()
    if i >= right.shape[0]:
        return
    right[i] = 0.0
    down[i] = 0.0
    columns = prior.columns
    row = i / columns
    if i < image.shape[0] - EXTRA:
        if i % columns < columns - 1:
            right[i] = link_weight(image[i + 1] - image[i], prior.smooth[0], edge)
        if row % rows < rows - 1:
            down[i] = link_weight(image[i + columns] - image[i], prior.smooth[0], edge)
