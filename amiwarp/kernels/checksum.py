"""Fletcher-32 checksum of bytes on a CPU, in vectorised loops and without Python's lock."""

from collections.abc import Sequence

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.kernels.launch import RecordedLaunch

wp.set_module_options({"enable_backward": False})

ROWS = 16
"""Largest number of blocks of bytes whose checksums a launch computes."""


@wp.func_native("""
#ifndef __CUDACC__
    typedef uint16_t words __attribute__((vector_size(32), aligned(1)));
    typedef uint32_t sums __attribute__((vector_size(64)));
    const words* next = (const words*)address;
    uint64_t first = 0, second = 0;
    int rows;
    for (uint64_t left = size / 32; left > 0; left -= rows) {
        // After n rows, a is up to 65535 n, and b up to 65535 n (n + 1) / 2: 360 rows fit 32 bits
        sums a = {}, b = {};
        rows = left < 360 ? (int)left : 360;
        for (int k = 0; k < rows; ++k) {
            a += __builtin_convertvector(*next++, sums);
            b += a;
        }
        // Each word adds the sum before these rows once more; word k of a row comes k words later than b counts
        second = (second + 16 * rows * first) % 65535;
        for (uint64_t k = 0; k < 16; ++k) {
            first += a[k];
            second += 16 * (uint64_t)b[k] - k * a[k];
        }
    }
    const uint8_t* rest = (const uint8_t*)next;
    for (int k = 0; k < size % 32; k += 2) {
        first += rest[k] + (k + 1 < size % 32 ? rest[k + 1] << 8 : 0);
        second += first;
    }
    // Words are big-endian: times 256 swaps bytes modulo 65535. A remainder of 0 is stored as 65535
    const uint64_t high = (256 * second + 65534) % 65535 + 1, low = (256 * first + 65534) % 65535 + 1;
    return first ? high << 16 | low : 0;
#else
    return 0;
#endif
""")
def fletcher32(address: wp.uint64, size: wp.uint64) -> wp.uint64:
    """Return the checksum of ``size`` bytes in memory, as :func:`amiwarp.io.hdf5.fletcher32.checksum`. Only for CPUs.

    Words are added to 16 pairs of sums, in rows of 16. A sum of up to 360 rows, and the sum of these sums, fit 32 bits.
    """


@wp.kernel
def compute_checksums(table: wp.array2d(dtype=wp.uint64)):
    """Compute the checksum of each row of a table: address and size of a block [bytes], and the checksum."""
    row = wp.tid()
    table[row, 2] = fletcher32(table[row, 0], table[row, 1])


class Checksums:
    """Fletcher-32 checksums of several blocks of bytes at a time. Any thread may call it."""

    def __init__(self) -> None:
        """Load the kernel."""
        self._idle: list[tuple[RecordedLaunch, NDArray[np.uint64]]] = [_recorded()]

    def __call__(self, parts: Sequence[bytes | memoryview]) -> list[int]:
        """Return the checksum of each block, as :func:`amiwarp.io.hdf5.fletcher32.checksum`."""
        try:
            launch, table = self._idle.pop()
        except IndexError:
            launch, table = _recorded()
        found: list[int] = []
        for first in range(0, len(parts), ROWS):
            blocks = [np.frombuffer(part, np.uint8) for part in parts[first : first + ROWS]]
            table[:, 1] = 0
            table[: len(blocks), :2] = [(block.ctypes.data, len(block)) for block in blocks]
            launch.repeat()
            found += table[: len(blocks), 2].tolist()
        self._idle.append((launch, table))
        return found


def _recorded() -> tuple[RecordedLaunch, NDArray[np.uint64]]:
    """Return a recorded launch of the kernel, and its table."""
    table = wp.zeros((ROWS, 3), dtype=wp.uint64, device="cpu")
    return RecordedLaunch(compute_checksums, [table], [], device="cpu", n=ROWS), table.numpy()
