"""From the samples of an encoder to the pieces in which kernels find angles, on the host."""

import math
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.kernels.prism_angle import EncoderParams

wp.set_module_options({"enable_backward": False})


def encoder_params(encoder: Any, t_first: int, t_last: int, device: Any) -> EncoderParams:
    """Return an encoder's samples around a span of event times [us] for the device functions.

    Raises :class:`AmiwarpError` if the encoder does not cover that span.
    """
    encoder.angle_at(np.array([t_first, t_last], np.int64))
    origin, start, angle, slope = encoder_pieces(encoder, t_first, t_last)
    # a bucket of samples lasts 2**shift us, at most the mean interval between samples
    shift = max(int(start[-1]) // start.size, 1).bit_length() - 1
    p = EncoderParams()
    p.origin = origin
    p.shift = shift
    p.first, p.start, p.angle, p.slope = _on_device(start, angle, slope, shift, device)
    if encoder.second is None:
        return p
    start, angle, slope = second_pieces(encoder.second, t_first, t_last, p.origin)
    p.second_first, p.second_start, p.second_angle, p.second_slope = _on_device(
        start, angle, slope, shift, device
    )
    return p


def _on_device(
    start: NDArray[np.int64],
    angle: NDArray[np.uint64],
    slope: NDArray[np.uint64],
    shift: int,
    device: Any,
) -> tuple[wp.array, ...]:
    """Return the arrays of :class:`EncoderParams` for pieces whose times are relative to its origin."""
    edges = np.arange((max(int(start[-1]), 0) >> shift) + 1, dtype=np.int64) << shift
    piece_of_edge = np.maximum(np.searchsorted(start, edges, side="right") - 1, 0)
    first = np.append(piece_of_edge, start.size - 1)
    pieces = np.stack([start, angle.view(np.int64), slope.view(np.int64)])
    # One copy to the device instead of three
    rows = wp.array(pieces, dtype=wp.int64, device=device)
    buckets = wp.array(first.astype(np.int32), dtype=int, device=device)
    return buckets, rows[0], rows[1].view(wp.uint64), rows[2].view(wp.uint64)


def encoder_pieces(
    encoder: Any, t_first: int, t_last: int
) -> tuple[int, NDArray[np.int64], NDArray[np.uint64], NDArray[np.uint64]]:
    """Return an encoder's samples as the pieces of :class:`EncoderParams`.

    The result is the origin, and the starts, angles and slopes. The encoder must cover the span of event times. An
    event at ``t`` belongs to the sample time ``t + encoder.clock_offset_us``.
    """
    # The clock offset is split into its whole and its fractional part. A piece starts at the first whole event time
    # at or after its sample.
    whole = math.floor(encoder.clock_offset_us)
    begins = encoder.t - whole

    # The samples around the span of event times, at least two.
    low = int(np.searchsorted(begins, t_first, side="right")) - 1
    low = min(max(low, 0), begins.size - 2)
    high = int(np.searchsorted(begins, t_last, side="right"))
    high = min(max(high, low + 1), begins.size - 1)
    turns = encoder.angle[low : high + 1] / (2.0 * math.pi)
    slope = np.diff(turns) / np.diff(encoder.t[low : high + 1])
    origin = int(begins[low])
    angle = _wrapped(turns[:-1] + slope * (encoder.clock_offset_us - whole))
    return origin, begins[low:high] - origin, angle, _wrapped(slope)


def second_pieces(
    second: Any, t_first: int, t_last: int, origin: int
) -> tuple[NDArray[np.int64], NDArray[np.uint64], NDArray[np.uint64]]:
    """Return the starts, angles and slopes of the pieces of a second encoder.

    ``origin``: event time from which the starts count, the origin of the first encoder [us].
    """
    own_origin, start, angle, slope = encoder_pieces(second, t_first, t_last)
    behind = own_origin - origin
    start = start + behind
    if behind > 0:  # the first piece reaches back to the origin
        start[:1] = 0
        angle[:1] = angle[:1] - slope[:1] * np.uint64(behind)
    return start, angle, slope


def _wrapped(turns: NDArray[np.float64]) -> NDArray[np.uint64]:
    """Return turns without their whole part as uint64, in units of 2**-64 turn."""
    part = np.maximum(turns - np.floor(turns + 0.5), -0.5)
    return np.ldexp(part, 64).astype(np.int64).view(np.uint64)
