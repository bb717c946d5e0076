"""The decoders of AEDAT 2.0 records and AEDAT 3.1 packets: against the NumPy decoders, in pieces and blocks."""

from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

from amiwarp.io import aedat2, aedat3
from amiwarp.io.aedat2 import Aedat2Decoder
from amiwarp.io.aedat2_header import CHIPS
from amiwarp.io.decoding import sums_before
from reference.aedat_records import Aedat2Records, polarity_events


def assert_columns(events: Any, known: Any) -> None:
    """Compare decoded events with columns; a coordinate outside the frame becomes a large number."""
    x, y, t, p = known
    host = events.to_host()
    for found, column in ((host.x, x), (host.y, y), (host.t, t), (host.p, p)):
        np.testing.assert_array_equal(found, column.astype(found.dtype))


def random_records(n: int, rng: np.random.Generator) -> NDArray[Any]:
    """Return records of all kinds, whose times wrap, step back and jump."""
    words = rng.integers(0, 1 << 32, (n, 2))
    words[:, 0] &= np.where(rng.random(n) < 0.2, 0xFFF, 0xFFFFFFFF) | (1 << 31)  # some of the first pixel
    words[:, 0] &= np.where(rng.random(n) < 0.5, 0x7FFFFFFF, 0xFFFFFFFF)
    near = (2**32 - 40 + np.cumsum(rng.integers(-3, 9, n))) % 2**32
    words[:, 1] = np.where(rng.random(n) < 0.9, near, words[:, 1])
    return words.astype(">u4")


@pytest.mark.parametrize("name", ["dvs128", "davis346"])
@pytest.mark.parametrize("length", [1, 5, 1 << 14])
def test_aedat2_records_are_decoded_as_numpy_does(
    name: str, length: int, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(aedat2, "BLOCK_RECORDS", {True: length, False: length})
    rng = np.random.default_rng(5)
    seen = 0
    for _ in range(12):
        records = random_records(int(rng.integers(0, 400)), rng)
        decoder = Aedat2Decoder(CHIPS[name], device)
        expected = Aedat2Records(CHIPS[name])
        for piece in np.split(records, np.sort(rng.integers(0, len(records) + 1, 3))):
            words = wp.array(np.ascontiguousarray(piece).view("<u4").ravel(), dtype=wp.uint32, device=device)
            events, others = decoder.decode(words)
            columns, known = expected.decode(piece)
            assert str(events.device) == device
            assert_columns(events, columns)
            for field in ("edge_t", "imu_t", "imu_words"):
                np.testing.assert_array_equal(getattr(others, field), known[field])
            assert others.frames == known["frames"]
            seen += others.frames + others.edge_t.size
    assert seen > 20


@pytest.mark.parametrize("length", [1, 3, 1 << 15])
def test_aedat3_packets_are_decoded_as_numpy_does(length: int, device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(aedat3, "BLOCK_RECORDS", {True: length, False: length})
    rng = np.random.default_rng(6)
    for trial in range(8):
        counts = rng.integers(0, 90, trial)
        parts = [rng.integers(0, 1 << 32, (n, 2)).astype("<u4").tobytes() for n in counts]
        bases = rng.integers(0, 2**31, trial) << 31
        # Something else may lie between the packets.
        gap = 4 * (trial % 3)
        data = b"".join(bytes(gap) + part for part in parts)
        words = wp.array(np.frombuffer(data, "<u4"), dtype=wp.uint32, device=device)
        starts = 2 * sums_before(counts) + gap // 4 * (1 + np.arange(trial))
        events = aedat3.decode_packets(words, starts, counts, bases)
        assert str(events.device) == device
        assert_columns(events, polarity_events(parts, bases.tolist()))
