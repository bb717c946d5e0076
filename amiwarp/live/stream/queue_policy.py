"""Policies for a full queue."""

import enum


class Policy(enum.StrEnum):
    """What a full queue does with further events."""

    BLOCK = "block"
    """Make the source and its sender wait. No event is lost here."""
    DROP_OLDEST = "drop-oldest"
    """Drop the oldest events. The size of the queue then bounds the delay."""
    THIN = "thin"
    """Drop events evenly, so that all pixels and times remain represented."""
