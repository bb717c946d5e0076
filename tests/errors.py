"""Expectation of an error by its code, for tests to which its words do not matter."""

import pytest

from amiwarp import AmiwarpError, ErrorCode


def refused(code: ErrorCode) -> pytest.RaisesExc[AmiwarpError]:
    """Return the context in which an :class:`AmiwarpError` with this code must be raised."""
    return pytest.raises(AmiwarpError, check=lambda error: error.code is code)
