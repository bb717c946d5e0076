"""Prism angle at an event's time, in integer arithmetic with equal results on every device.

Angles are fractions of a turn that wrap on overflow: one turn is 2**64 internally and 2**32 in results. Times are whole
microseconds, so slopes may wrap too: a whole turn per microsecond adds whole turns. The host's version, in float64, is
:meth:`amiwarp.events.encoder.Encoder.angle_at`.
"""

import math
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

wp.set_module_options({"enable_backward": False})

THETA_U16_RAD = wp.constant(2.0 * 3.141592653589793 / 65536.0)  # unit of theta_u16, 2**-16 turn [rad]
THETA_U32_RAD = wp.constant(2.0 * 3.141592653589793 / 4294967296.0)  # unit of theta_u32, 2**-32 turn [rad]


@wp.struct
class EncoderParams:
    """Prism angle over time as a piecewise linear function.

    The first and last pieces extend beyond the samples.
    """

    origin: wp.int64  # event time at the start of the first bucket [us]
    shift: int  # base-2 logarithm of the length of a bucket of time [us]
    first: wp.array(dtype=int)  # index of the piece at the start of each bucket; shape (buckets + 1,)
    start: wp.array(dtype=wp.int64)  # first event time of each piece, relative to the origin [us]
    angle: wp.array(dtype=wp.uint64)  # prism angle at the start of each piece [2**-64 turn]
    slope: wp.array(dtype=wp.uint64)  # speed on each piece [2**-64 turn per us]
    second_first: wp.array(dtype=int)  # the same four arrays for the second prism of a pair; empty for one prism
    second_start: wp.array(dtype=wp.int64)
    second_angle: wp.array(dtype=wp.uint64)
    second_slope: wp.array(dtype=wp.uint64)


# From the samples of an encoder to its pieces, on the host.


def encoder_params(encoder: Any, t_first: int, t_last: int, device: Any) -> EncoderParams:
    """Return an encoder's samples around a span of event times [us] for the device functions.

    Raises :class:`AmiwarpError` if the encoder does not cover that span.
    """
    encoder.angle_at(np.array([t_first, t_last], np.int64))
    origin, start, angle, slope = encoder_pieces(encoder, t_first, t_last)
    # a bucket of samples lasts 2**shift us, at most the mean interval between samples
    shift = max(int(start[-1]) // start.size, 1).bit_length() - 1
    p = EncoderParams()
    p.origin, p.shift = origin, shift
    p.first, p.start, p.angle, p.slope = _on_device(start, angle, slope, shift, device)
    if encoder.second is None:
        return p
    start, angle, slope = second_pieces(encoder.second, t_first, t_last, p.origin)
    p.second_first, p.second_start, p.second_angle, p.second_slope = _on_device(start, angle, slope, shift, device)
    return p


def _on_device(
    start: NDArray[np.int64], angle: NDArray[np.uint64], slope: NDArray[np.uint64], shift: int, device: Any
) -> tuple[wp.array, ...]:
    """Return the arrays of :class:`EncoderParams` for pieces whose times are relative to its origin."""
    edges = np.arange((max(int(start[-1]), 0) >> shift) + 1, dtype=np.int64) << shift
    first = np.append(np.maximum(np.searchsorted(start, edges, side="right") - 1, 0), start.size - 1)
    pieces = np.stack([start, angle.view(np.int64), slope.view(np.int64)])
    rows = wp.array(pieces, dtype=wp.int64, device=device)  # one copy to the device instead of three
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
    low = min(max(int(np.searchsorted(begins, t_first, side="right")) - 1, 0), begins.size - 2)
    high = min(max(int(np.searchsorted(begins, t_last, side="right")), low + 1), begins.size - 1)
    turns = encoder.angle[low : high + 1] / (2.0 * math.pi)
    slope = np.diff(turns) / np.diff(encoder.t[low : high + 1])
    origin = int(begins[low])
    angle = _wrapped(turns[:-1] + slope * (encoder.clock_offset_us - whole))
    return origin, begins[low:high] - origin, angle, _wrapped(slope)


def second_pieces(
    second: Any, t_first: int, t_last: int, origin: int
) -> tuple[NDArray[np.int64], NDArray[np.uint64], NDArray[np.uint64]]:
    """Return the starts, angles and slopes of the pieces of a second encoder.

    ``origin``: event time from which the starts count, that of the first encoder [us].
    """
    own, start, angle, slope = encoder_pieces(second, t_first, t_last)
    start, behind = start + (own - origin), own - origin
    if behind > 0:  # the first piece reaches back to the origin
        start[:1], angle[:1] = 0, angle[:1] - slope[:1] * np.uint64(behind)
    return start, angle, slope


def _wrapped(turns: NDArray[np.float64]) -> NDArray[np.uint64]:
    """Return turns without their whole part as uint64, in units of 2**-64 turn."""
    part = np.maximum(turns - np.floor(turns + 0.5), -0.5)
    return np.ldexp(part, 64).astype(np.int64).view(np.uint64)


# The angle at a time, on the device.


@wp.func
def piece_at(encoder: EncoderParams, elapsed: wp.int64) -> int:
    """Return the index of the piece at ``elapsed`` [us] from the origin, found by its bucket and bisection."""
    buckets = encoder.first.shape[0] - 1
    bucket = int(wp.clamp(elapsed >> wp.int64(encoder.shift), wp.int64(0), wp.int64(buckets - 1)))
    low = encoder.first[bucket]
    high = encoder.first[bucket + 1]
    while low < high:
        middle = (low + high + 1) / 2
        if encoder.start[middle] <= elapsed:
            low = middle
        else:
            high = middle - 1
    return low


@wp.func
def theta_u32_on(encoder: EncoderParams, piece: int, elapsed: wp.int64) -> wp.uint32:
    """Return theta_u32, the prism angle [2**-32 turn], on a given piece at ``elapsed`` [us] from the origin."""
    since = wp.uint64(elapsed - encoder.start[piece])
    return wp.uint32((encoder.angle[piece] + since * encoder.slope[piece]) >> wp.uint64(32))


@wp.func
def theta_u32_at(encoder: EncoderParams, t: wp.int64) -> wp.uint32:
    """Return theta_u32, the prism angle [2**-32 turn], at event time ``t`` [us]."""
    elapsed = t - encoder.origin
    return theta_u32_on(encoder, piece_at(encoder, elapsed), elapsed)


@wp.func
def of_second(encoder: EncoderParams) -> EncoderParams:
    """Return the path of the second prism of a pair. Times are relative to the same origin."""
    second = EncoderParams()
    second.origin = encoder.origin
    second.shift = encoder.shift
    second.first = encoder.second_first
    second.start = encoder.second_start
    second.angle = encoder.second_angle
    second.slope = encoder.second_slope
    return second


@wp.func
def radians(theta: wp.uint32) -> float:
    """Return theta_u32 as an angle from -pi to pi [rad]."""
    return float(wp.float64(wp.int32(theta)) * wp.float64(THETA_U32_RAD))
