"""Device side of the encoder: the prism's angle at an event's time, in whole numbers, the same on every device.

Angles are fractions of a turn that wrap by themselves: 2**64 (inside) or 2**32 (outside) is one turn. Times are whole
microseconds, so that a slope, too, may wrap: whole turns a microsecond add whole turns.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class EncoderParams:
    """Linear pieces between samples, the first and last also beyond them; see ``events.device_encoder``."""

    origin: wp.int64  # event time at which the first bucket starts [us]
    shift: int  # a bucket is 2**shift us long
    first: wp.array(dtype=int)  # per bucket the piece at its start; one entry past the buckets ends the last
    start: wp.array(dtype=wp.int64)  # per piece its first event time, from the origin [us]
    angle: wp.array(dtype=wp.uint64)  # there [2**-64 turn]
    slope: wp.array(dtype=wp.uint64)  # [2**-64 turn per us]


@wp.func
def piece_at(encoder: EncoderParams, elapsed: wp.int64) -> int:
    """The piece of a time from the origin: its bucket's, bisected where several pieces start in one bucket."""
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
def angle_on(encoder: EncoderParams, piece: int, elapsed: wp.int64) -> wp.uint32:
    """The angle [2**-32 turn] on a piece, at a time from the origin [us]."""
    since = wp.uint64(elapsed - encoder.start[piece])
    return wp.uint32((encoder.angle[piece] + since * encoder.slope[piece]) >> wp.uint64(32))


@wp.func
def angle_at(encoder: EncoderParams, t: wp.int64) -> wp.uint32:
    """The prism's angle at an event's time [us], as a fraction of a turn in 1 / 2**32."""
    elapsed = t - encoder.origin
    return angle_on(encoder, piece_at(encoder, elapsed), elapsed)
