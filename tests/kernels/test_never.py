"""Time of a pixel without events."""

from amiwarp.kernels.background_activity import NEVER, never


def test_the_time_of_no_event_is_the_lowest() -> None:
    assert int(never()) == NEVER == -(2**63)
