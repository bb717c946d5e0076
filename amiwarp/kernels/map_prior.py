"""Prior for map unknowns that no equation determines: damping, and links between neighbouring nodes."""

import warp as wp

wp.set_module_options({"enable_backward": False})


EXTRA = wp.constant(2)  # number of unknowns that follow the map nodes: leak and OFF threshold


@wp.struct
class Prior:
    """Prior cost of a map x: damping x² plus the sum of weight (xᵢ - xⱼ)² over all links. No link leaves a tile."""

    damping: wp.array(dtype=float)  # one element
    linked: int  # 1 if there are links, else 0
    columns: int
    held: int  # index from which on the unknowns are fixed
    smooth: wp.array(dtype=float)  # one element: weight of a link between equal neighbours
    right: wp.array(dtype=float)  # weight of the link to the next node; 0 in a tile's last column
    down: wp.array(dtype=float)  # weight of the link to the node below; 0 in a tile's last row


@wp.func
def prior_product(prior: Prior, vector: wp.array(dtype=float), i: int) -> float:
    """Return element ``i`` of the prior's operator times a vector."""
    total = prior.damping[0] * vector[i]
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
    """Return element ``i`` of the diagonal of the prior's operator.

    For a fixed unknown it is so large that the preconditioner suppresses every step.
    """
    if i >= prior.held:
        return 1.0e30
    total = prior.damping[0]
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
    """Return Charbonnier's weight of a link, which decreases if neighbours differ by more than ``edge`` [thresholds].

    An ``edge`` of 0 gives all links equal weight.
    """
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
    """Compute the weights of the links from each node of the map."""
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
