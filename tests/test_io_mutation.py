"""Damaged files of every format: each gives sound events or one AmiwarpError; never a crash, a hang or a half output.

HDF5 files without checksums (DSEC's) can still bring the HDF5 library down in rare cases that no reader can foresee:
the seeds here are fixed.
"""

import os
import random
import time
from pathlib import Path

import pytest
from io_samples import WRITERS, make_events, refusal, write_sample

from amiwarp.events import check_events
from amiwarp.io import convert, open_recording, read_encoder_csv

MUTANTS = 150
"""Per format; with ten formats more than a thousand."""

LONGEST_S = 5.0
"""A file of a few kilobytes that takes longer hangs."""


def truncate(data: bytearray, at: int, rng: random.Random) -> bytearray:
    return data[:at]


def flip(data: bytearray, at: int, rng: random.Random) -> bytearray:
    data[at] ^= 1 << rng.randrange(8)
    return data


def zeros(data: bytearray, at: int, rng: random.Random) -> bytearray:
    length = len(data[at : at + rng.choice([1, 4, 64])])
    data[at : at + length] = bytes(length)
    return data


def ones(data: bytearray, at: int, rng: random.Random) -> bytearray:
    length = len(data[at : at + rng.choice([1, 4, 64])])
    data[at : at + length] = b"\xff" * length
    return data


def remove(data: bytearray, at: int, rng: random.Random) -> bytearray:
    return data[:at] + data[at + rng.choice([1, 2, 100]) :]


def splice(data: bytearray, at: int, rng: random.Random) -> bytearray:
    other = rng.randrange(len(data))
    return data[:at] + data[other : other + rng.choice([1, 8, 300])] + data[at:]


def mutate(data: bytes, seed: str) -> bytes:
    """One to four edits, half of them in the header."""
    rng = random.Random(seed)
    mutant = bytearray(data)
    for _ in range(rng.choice([1, 1, 2, 4])):
        if mutant:
            at = rng.randrange(min(len(mutant), 300) if rng.random() < 0.5 else len(mutant))
            mutant = rng.choice([truncate, flip, flip, zeros, ones, remove, splice])(mutant, at, rng)
    return bytes(mutant)


def read_all(path: Path) -> None:
    """Read in every way there is, and check what comes."""
    recording = open_recording(path)
    source = recording.events
    count = 0
    for block in source.blocks(count=150):
        check_events(block, *source.size, where="mutant")
        count += len(block)
    assert count == len(source)
    if count:
        assert len(source.between(source.t_first, source.t_last + 1)) == count
        assert len(source.slice(1, 7)) == min(count - 1, 6)
    if recording.truth is not None:
        recording.truth.points(0, count)


def check(said: str | None, path: Path) -> None:
    """A refusal is one line with the file's name."""
    assert said is None or (str(path) in said and "\n" not in said), said


@pytest.mark.parametrize("name", WRITERS)
def test_mutants(tmp_path, name):
    original = write_sample(tmp_path, name, make_events(300))
    data = original.read_bytes()
    outcomes = {"read": 0, "refused": 0}
    (tmp_path / "out").mkdir()
    for seed in range(MUTANTS):
        # A name of its own: HDF5 shares what it knows of a file that is still open under the same one.
        path = tmp_path / f"mutant{seed}{original.suffix}"
        path.write_bytes(mutate(data, f"{name} {seed}"))
        began = time.monotonic()
        said = refusal(read_all, path)
        outcomes["read" if said is None else "refused"] += 1
        check(said, path)
        out = tmp_path / "out" / f"{seed}.h5"
        if refusal(convert, path, out) is None:
            assert len(open_recording(out).events) > 0
        else:
            assert not out.exists()
        assert time.monotonic() - began < LONGEST_S, f"{name} seed {seed}"
        path.unlink()
    assert [file for file in os.listdir(tmp_path / "out") if not file.endswith(".h5") or file.startswith(".")] == []
    # Were all refused, or none, the mutants would test nothing.
    assert min(outcomes.values()) > 0, outcomes


def read_log(path: Path) -> None:
    encoder = read_encoder_csv(path, counts_per_turn=4000)
    encoder.angle_at(encoder.t)


def test_mutants_of_encoder_logs(tmp_path):
    data = "t_us,count,index\n" + "".join(
        f"{t},{t // 5 % 4000},{int(t % 20_000 == 0)}\n" for t in range(0, 300_000, 1000)
    )
    outcomes = {"read": 0, "refused": 0}
    path = tmp_path / "mutant.csv"
    for seed in range(MUTANTS):
        path.write_bytes(mutate(data.encode(), f"csv {seed}"))
        said = refusal(read_log, path)
        outcomes["read" if said is None else "refused"] += 1
        check(said, path)
    assert min(outcomes.values()) > 0, outcomes
