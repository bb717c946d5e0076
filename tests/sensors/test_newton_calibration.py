"""A prism in Newton is calibrated from its events, as accurately as one of the simulator. Skipped without Newton."""

import pytest

from benchmarks.sensors import prism_row

pytest.importorskip("newton")


def test_the_prism_is_calibrated_from_events_of_newton() -> None:
    row = prism_row((128, 96), "cpu")
    assert row["newton_events"] > 100_000
    assert row["newton_error_px"] < 0.01
    assert row["between_px"] < 0.01
