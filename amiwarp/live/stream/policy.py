"""The policy of a full queue."""

import enum


class Policy(enum.StrEnum):
    """What a queue does that is full."""

    BLOCK = "block"
    """The source waits, and with it whoever sends: nothing is lost here."""
    DROP_OLDEST = "drop-oldest"
    """The events that have waited longest go: what comes out is late by no more than the queue is long."""
    THIN = "thin"
    """Events are left out evenly, so that all places and times are still seen."""
