"""Encoder parameters on a device, for kernels."""

import math
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from amiwarp.kernels.encoder_angle import EncoderParams

if TYPE_CHECKING:
    from amiwarp.events.encoder import Encoder


@lru_cache(maxsize=4)
def azimuths(device: str) -> wp.array:
    """Return cosine and sine of 65,536 angles of a turn, interleaved, float32.

    They are computed by NumPy in float64, so that every device has the same bits.
    """
    angle = np.arange(1 << 16) * (2.0 * math.pi / (1 << 16))
    table = np.stack([np.cos(angle), np.sin(angle)], axis=1).astype(np.float32)
    return wp.array(table.ravel(), dtype=float, device=device)


def encoder_params(encoder: "Encoder", t_first: int, t_last: int, device: Any) -> EncoderParams:
    """Return the encoder's samples around a span of event times [us] as parameters of the device function ``angle_at``.

    Raises :class:`AmiwarpError` if the encoder does not cover that span.
    """
    encoder.angle_at(np.array([t_first, t_last], np.int64))
    origin, start, angle, slope = encoder_pieces(encoder, t_first, t_last)
    # a bucket of samples lasts 2**shift us, at most the mean interval between samples
    shift = max(int(start[-1]) // start.size, 1).bit_length() - 1
    edges = np.arange((int(start[-1]) >> shift) + 1, dtype=np.int64) << shift
    first = np.append(np.searchsorted(start, edges, side="right") - 1, start.size - 1)
    p = EncoderParams()
    p.origin, p.shift = origin, shift
    p.first = wp.array(first.astype(np.int32), dtype=int, device=device)
    pieces = np.stack([start, angle.view(np.int64), slope.view(np.int64)])
    rows = wp.array(pieces, dtype=wp.int64, device=device)  # one copy to the device instead of three
    p.start, p.angle, p.slope = rows[0], rows[1].view(wp.uint64), rows[2].view(wp.uint64)
    return p


def encoder_pieces(encoder: "Encoder", t_first: int, t_last: int) -> tuple[int, Any, Any, Any]:
    """Return origin, starts, angles and slopes of :class:`EncoderParams`.

    The encoder must cover the span of event times.
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


def _wrapped(turns: Any) -> Any:
    """Return turns without their whole part as uint64, in units of 2**-64 turn."""
    part = np.maximum(turns - np.floor(turns + 0.5), -0.5)
    return np.ldexp(part, 64).astype(np.int64).view(np.uint64)
