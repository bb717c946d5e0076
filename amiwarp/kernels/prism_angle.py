"""Prism angle at an event's time, in integer arithmetic with equal results on every device.

Angles are fractions of a turn that wrap on overflow: one turn is 2**64 internally and 2**32 in results. Times are whole
microseconds, so slopes may wrap too: a whole turn per microsecond adds whole turns. The host's version, in float64, is
:meth:`amiwarp.events.encoder.Encoder.angle_at`.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

# Unit of theta_u16, 2**-16 turn [rad]
THETA_U16_RAD = wp.constant(2.0 * 3.141592653589793 / 65536.0)
# Unit of theta_u32, 2**-32 turn [rad]
THETA_U32_RAD = wp.constant(2.0 * 3.141592653589793 / 4294967296.0)


@wp.struct
class EncoderParams:
    """Prism angle over time as a piecewise linear function.

    The first and last pieces extend beyond the samples.
    """

    origin: wp.int64  # event time at the start of the first bucket [us]
    shift: int  # base-2 logarithm of the length of a bucket of time [us]
    # Index of the piece at the start of each bucket; shape (buckets + 1,)
    first: wp.array(dtype=int)
    start: wp.array(dtype=wp.int64)  # first event time of each piece, relative to the origin [us]
    angle: wp.array(dtype=wp.uint64)  # prism angle at the start of each piece [2**-64 turn]
    slope: wp.array(dtype=wp.uint64)  # speed on each piece [2**-64 turn per us]
    # The same four arrays for the second prism of a pair; empty for one prism
    second_first: wp.array(dtype=int)
    second_start: wp.array(dtype=wp.int64)
    second_angle: wp.array(dtype=wp.uint64)
    second_slope: wp.array(dtype=wp.uint64)


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


@wp.func
def both_angles(encoder: EncoderParams, t: wp.int64):
    """Return the angles of both encoders, or of both commands, at event time ``t`` [us], from -pi to pi [rad]."""
    first = radians(theta_u32_at(encoder, t))
    return first, radians(theta_u32_at(of_second(encoder), t))
