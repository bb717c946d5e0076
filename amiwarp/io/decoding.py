"""What the decoders of event files share: blocks that are decoded at the same time, and where their output begins."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

BLOCK_RECORDS = {True: 1 << 15, False: 1 << 12}
"""Number of records that one thread decodes, on a CPU (True) and on CUDA (False)."""


def sums_before(values: NDArray[Any]) -> NDArray[np.int64]:
    """Return for each value the sum of those before it, so that blocks know where their output begins."""
    sums = np.zeros(values.size, np.int64)
    np.cumsum(values[:-1], out=sums[1:])
    return sums
