"""Prophesee's HDF5 files with the ECF codec, by its description, not with the package's own code."""

import itertools
import struct
from pathlib import Path

import h5py
import numpy as np

from amiwarp import Events


def ecf_runs(values: list[int], bits: int, words: str) -> bytes:
    """Runs of equal values, with their lengths in the lowest bits, or behind them if they are long."""
    out = b""
    for value, group in itertools.groupby(values):
        count = len(list(group))
        longest = (1 << bits) - 1
        if count >= longest:
            out += struct.pack(f"<{words}", value << bits | longest) + struct.pack("<H", count)
        else:
            out += struct.pack(f"<{words}", value << bits | count)
    return out


def ecf_packed(values: list[int], bits: int) -> bytes:
    """Groups of four values: their bits in the order v0, low bits of v1, rest of v1, ... as three words."""
    part = bits // 3
    out = b""
    for at in range(0, len(values), 4):
        # The codec does not clear the last ones
        v0, v1, v2, v3 = [*values[at : at + 4], 1, 2, 3][:4]
        first = v0 << part | v1 % 2**part
        second = v1 >> part << 2 * part | v2 % 2 ** (2 * part)
        third = v2 >> 2 * part << 3 * part | v3
        out += struct.pack("<3H" if bits == 12 else "<3I", first, second, third)
    return out


def ecf_chunk(events: Events, mode: str) -> bytes:
    """A chunk by the description of Prophesee's codec."""
    x, y, t, p = (column.tolist() for column in (events.x, events.y, events.t, events.p))
    out = struct.pack("<Iq", len(t) << 2 | {"packed": 2, "rows": 1, "masks": 0}[mode], t[0])
    now = t[0]
    for time, group in itertools.groupby(t):
        count = len(list(group))
        step = time - now
        now = time
        gap = step if step >= 15 else 0
        step -= gap
        while gap:
            out += bytes([0xF0 | gap & 15])
            gap >>= 4
        if count >= 15:
            out += bytes([step << 4 | 15]) + struct.pack("<H", count)
        else:
            out += bytes([step << 4 | count])
    if mode == "packed":
        return out + ecf_packed(
            [row << 12 | column << 1 | on for column, row, on in zip(x, y, p, strict=True)], 24
        )
    out += ecf_runs(y, 5, "H")
    if mode == "rows":
        return out + ecf_packed([column << 1 | on for column, on in zip(x, p, strict=True)], 12)
    at = 0
    while at < len(x):
        first, mask = x[at], 0
        at += 1
        for bit in range(5):
            if at < len(x) and x[at] == first + bit + 1:
                mask |= 16 >> bit
                at += 1
        # What lies behind the last event is not cleared.
        out += struct.pack("<H", first << 5 | (mask | 1 if at == len(x) and mask < 2 else mask))
    return out + ecf_runs(p, 7, "B")


def write_ecf(
    path: Path, chunks: list[bytes], count: int, length: int, *filters: int, mask: int = 0
) -> None:
    """A file as Metavision writes it: chunks of ``length`` events in the ECF codec."""
    rows = np.dtype({"names": ["x", "y", "p", "t"], "formats": ["<u2", "<u2", "<i2", "<i8"],
                     "offsets": [0, 2, 4, 8], "itemsize": 16})  # fmt: skip
    creation = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    creation.set_chunk((length,))
    for number in (*filters, 0x8ECF):
        creation.set_filter(number, h5py.h5z.FLAG_OPTIONAL, ())
    with h5py.File(path, "w") as file:
        group = file.create_group("CD")
        kind, space = h5py.h5t.py_create(rows), h5py.h5s.create_simple((count,))
        dataset = h5py.h5d.create(group.id, b"events", kind, space, creation)
        for k, chunk in enumerate(chunks):
            dataset.write_direct_chunk((k * length,), chunk, mask if k == 0 else 0)
        file.attrs["geometry"] = "320x240"


def ecf_events(count: int) -> Events:
    """Rows of events next to each other, long runs, gaps of time, and the largest coordinates."""
    rng = np.random.default_rng(3)
    t = 10**15 + np.cumsum(rng.choice([0, 0, 0, 0, 1, 14, 15, 16, 255, 300_000], count))
    t[50:400] = t[50]
    t[400:] += t[50] - t[399] + 350_000_000 if t[399] > t[50] else 0
    t = np.maximum.accumulate(t)
    x = (np.arange(count) * rng.choice([1, 1, 1, 2, 7], count)) % 320
    y = np.repeat(rng.integers(0, 240, count), rng.integers(1, 70, count))[:count]
    p = np.repeat(rng.integers(0, 2, count), rng.integers(1, 300, count))[:count]
    x[1], y[1] = 319, 239
    return Events.from_arrays(x, y, t, p)
