"""Policies of a full queue of events."""

import enum


class Policy(enum.StrEnum):
    """What a full queue does with further events."""

    BLOCK = "block"
    """Make the source and its sender wait until the queue has room. No event is lost in the queue."""
    DROP_OLDEST = "drop-oldest"
    """Drop the oldest events. The size of the queue then bounds the delay."""
    THIN = "thin"
    """Drop events evenly, so that all pixels and times remain represented."""
