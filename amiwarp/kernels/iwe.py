"""Voting events into the image of warped events (IWE), in fixed point, and sums over that image.

Votes are integers of 1/256: integer sums do not depend on order, so the image is the same bit for bit. A pixel of
int32 holds 2**31 / 256 = 8.4 million full votes; :mod:`amiwarp.iwe` moves votes on before that many events came.
"""

from typing import Any

import warp as wp

from amiwarp.kernels.camera import CameraParams, TurningParams, turn_back
from amiwarp.kernels.optics import MODEL_STRUCTS, azimuth, compensate

wp.set_module_options({"enable_backward": False})

VOTE = wp.constant(256)  # one full vote
SEGMENT = wp.constant(64)  # pixels that one thread sums
VARIANCE = wp.constant(0)
GRADIENT = wp.constant(1)
LAPLACIAN = wp.constant(2)
PAPER_J = wp.constant(3)
ENTROPY = wp.constant(4)


@wp.struct
class EventArrays:
    """Events on a device. ``theta``: the encoder's angle [rad]; ``slope``: its change per unit of drift, or empty;
    ``time``: from the window's middle [s], or empty where the camera does not turn."""

    x: wp.array(dtype=wp.uint16)
    y: wp.array(dtype=wp.uint16)
    p: wp.array(dtype=wp.uint8)
    theta: wp.array(dtype=float)
    slope: wp.array(dtype=float)
    time: wp.array(dtype=float)


@wp.struct
class Canvas:
    """Where votes go: the image grown by ``pad`` pixels on each side, then scaled."""

    pad: float
    scale: float
    per_polarity: int
    nearest: int
    dither: int


@wp.func
def cast_vote(image: wp.array3d(dtype=wp.int32), layer: int, row: int, col: int, weight: int):
    if row >= 0 and col >= 0 and row < image.shape[1] and col < image.shape[2] and weight != 0:
        wp.atomic_add(image, layer, row, col, weight)


@wp.func
def vote(canvas: Canvas, xy: wp.vec2, polarity: wp.uint8, image: wp.array3d(dtype=wp.int32)):
    """One event's vote, nearest or bilinear; the four weights sum to exactly one vote. NaN votes nowhere."""
    x = (xy[0] + canvas.pad + 0.5) * canvas.scale - 0.5
    y = (xy[1] + canvas.pad + 0.5) * canvas.scale - 0.5
    if not (x > -1.0 and y > -1.0 and x < float(image.shape[2]) and y < float(image.shape[1])):
        return
    layer = wp.where(canvas.per_polarity != 0 and polarity != wp.uint8(0), 1, 0)
    if canvas.nearest != 0:
        cast_vote(image, layer, int(wp.floor(y + 0.5)), int(wp.floor(x + 0.5)), VOTE)
        return
    col = int(wp.floor(x))
    row = int(wp.floor(y))
    fx = int((x - float(col)) * 256.0 + 0.5)
    fy = int((y - float(row)) * 256.0 + 0.5)
    both = (fx * fy + 128) / 256
    cast_vote(image, layer, row, col, VOTE - fx - fy + both)
    cast_vote(image, layer, row, col + 1, fx - both)
    cast_vote(image, layer, row + 1, col, fy - both)
    cast_vote(image, layer, row + 1, col + 1, both)


@wp.func
def somewhere_in_pixel(i: int) -> wp.vec2:
    """A place in the pixel, even over it, the same for event ``i`` at every call."""
    state = wp.rand_init(0, i)
    return wp.vec2(wp.randf(state) - 0.5, wp.randf(state) - 0.5)


@wp.kernel
def vote_events(
    model: Any,
    camera: CameraParams,
    events: EventArrays,
    drift: float,
    turning: TurningParams,
    canvas: Canvas,
    start: int,
    image: wp.array3d(dtype=wp.int32),
):
    """Angle, displacement and vote of one event, fused."""
    i = start + wp.tid()
    theta = events.theta[i]
    if events.slope.shape[0] > 0:
        theta += drift * events.slope[i]
    xy = compensate(model, camera, wp.vec2(float(events.x[i]), float(events.y[i])), azimuth(model, theta))
    if events.time.shape[0] > 0:
        xy = turn_back(camera, xy, turning, events.time[i])
    if canvas.dither != 0:
        xy += somewhere_in_pixel(i)
    vote(canvas, xy, events.p[i], image)


@wp.kernel
def vote_points(
    xy: wp.array(dtype=wp.vec2),
    p: wp.array(dtype=wp.uint8),
    canvas: Canvas,
    start: int,
    image: wp.array3d(dtype=wp.int32),
):
    i = start + wp.tid()
    vote(canvas, xy[i], p[i], image)


@wp.kernel
def gather_votes(slices: wp.array2d(dtype=wp.int32), start: int, total: wp.array(dtype=wp.int64)):
    """Adds the votes of all slices to a total, both flat; the slices are left as they are."""
    i = start + wp.tid()
    votes = wp.int64(0)
    for k in range(slices.shape[0]):
        votes += wp.int64(slices[k, i])
    total[i] = total[i] + votes


# -- smoothing and sums: every thread writes a place of its own, so the bits do not depend on the schedule


@wp.kernel
def smooth_along_x(
    slices: wp.array2d(dtype=wp.int32),
    weights: wp.array(dtype=float),
    width: int,
    start: int,
    out: wp.array(dtype=float),
):
    """Votes of all slices (slice, flat pixel) to events, smoothed along x with a symmetric kernel (centre first)."""
    i = start + wp.tid()
    col = i % width
    radius = weights.shape[0] - 1
    total = float(0.0)
    for k in range(wp.max(-radius, -col), wp.min(radius, width - 1 - col) + 1):
        votes = int(0)
        for s in range(slices.shape[0]):
            votes += slices[s, i + k]
        total += weights[wp.abs(k)] * float(votes)
    out[i] = total / float(VOTE)


@wp.kernel
def smooth_along_y(
    image: wp.array(dtype=float),
    weights: wp.array(dtype=float),
    width: int,
    height: int,
    start: int,
    out: wp.array(dtype=float),
):
    i = start + wp.tid()
    row = (i / width) % height
    radius = weights.shape[0] - 1
    total = float(0.0)
    for k in range(wp.max(-radius, -row), wp.min(radius, height - 1 - row) + 1):
        total += weights[wp.abs(k)] * image[i + k * width]
    out[i] = total


@wp.func
def neighbour(image: wp.array(dtype=float), i: int, step: int, exists: bool) -> float:
    """The pixel ``step`` on, zero past the border (the padding holds no events)."""
    if exists:
        return image[i + step]
    return 0.0


@wp.func
def gradient2(image: wp.array(dtype=float), i: int, width: int, height: int) -> float:
    """Squared central-difference gradient."""
    col = i % width
    row = (i / width) % height
    dx = neighbour(image, i, 1, col + 1 < width) - neighbour(image, i, -1, col > 0)
    dy = neighbour(image, i, width, row + 1 < height) - neighbour(image, i, -width, row > 0)
    return 0.25 * (dx * dx + dy * dy)


@wp.func
def laplacian2(image: wp.array(dtype=float), i: int, width: int, height: int) -> float:
    """Squared five-point Laplacian."""
    col = i % width
    row = (i / width) % height
    total = neighbour(image, i, 1, col + 1 < width) + neighbour(image, i, -1, col > 0)
    total += neighbour(image, i, width, row + 1 < height) + neighbour(image, i, -width, row > 0)
    value = total - 4.0 * image[i]
    return value * value


@wp.func
def pixel_term(kind: int, image: wp.array(dtype=float), i: int, width: int, height: int, eta: float) -> float:
    h = image[i]
    if kind == GRADIENT:
        return gradient2(image, i, width, height)
    if kind == LAPLACIAN:
        return laplacian2(image, i, width, height)
    if kind == PAPER_J:
        return wp.where(h > 0.0, 1.0 / (1.0 + wp.exp(wp.min(h / eta, 80.0))), 0.0)
    if kind == ENTROPY:
        return wp.where(h > 0.0, h * wp.log(wp.max(h, 1.0e-30)), 0.0)
    return h * h


@wp.kernel
def sum_terms(
    kind: int,
    image: wp.array(dtype=float),
    width: int,
    height: int,
    eta: float,
    start: int,
    sums: wp.array(dtype=wp.vec2d),
):
    """Per segment of SEGMENT pixels: the sum of the image and the sum of the sharpness' terms."""
    segment = start + wp.tid()
    total = wp.float64(0.0)
    terms = wp.float64(0.0)
    for i in range(segment * SEGMENT, wp.min((segment + 1) * SEGMENT, image.shape[0])):
        total += wp.float64(image[i])
        terms += wp.float64(pixel_term(kind, image, i, width, height, eta))
    sums[segment] = wp.vec2d(total, terms)


for _struct in MODEL_STRUCTS:
    wp.overload(vote_events, {"model": _struct})
