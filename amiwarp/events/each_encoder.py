"""The encoders of an optic with two angles, one by one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from amiwarp.events.encoder import Encoder


def each_encoder(encoder: Encoder) -> tuple[Encoder, ...]:
    """Return an encoder for each angle of the optic, in their order: the encoder itself if there is one angle."""
    if encoder.second is None:
        return (encoder,)
    return replace(encoder, second=None), encoder.second


def together(encoders: Sequence[Encoder]) -> Encoder:
    """Return the encoder of an optic from the encoders of its angles. Inverse of :func:`each_encoder`."""
    first, *others = encoders
    for second in others:
        first = first.with_second(second)
    return first
