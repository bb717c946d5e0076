"""Damaged files of every kind: each is read or refused by one AmiwarpError, without crash, hang or partial output."""

import gc
import os
import random
from collections.abc import Iterator

import h5py
import numpy as np
import pytest

from amiwarp import convert, open_recording
from reference.io_samples import WRITERS, make_events, refusal, write_sample
from reference.mutation_files import KINDS, Checker, check, mutated, sample

MUTANTS = 20
"""Mutants per kind of input. ``benchmarks.fuzz``, which ``.ci/run`` runs too, checks as many others as time allows."""
CONVERTED = 30, 60
"""Least and most mutants per format that are converted: of formats with checksums, few are read."""
ENDLESS = {"native": (31,), "truth": (52,)}
"""More mutants, in which HDF5 searches without end."""


@pytest.fixture(scope="module", autouse=True)
def only_new_garbage() -> None:
    """Leave what earlier tests loaded out of the garbage collections here, which would take ten times as long."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="module")
def checker() -> Iterator[Checker]:
    found = Checker(cpu_seconds=2)
    yield found
    found.close()


@pytest.mark.parametrize("name", KINDS)
def test_samples_are_sound(tmp_path, name):
    path = tmp_path / f"sample{KINDS[name][0]}"
    path.write_bytes(sample(name))
    assert check(path, name) is None


@pytest.mark.parametrize("name", KINDS)
def test_mutants_are_read_or_refused(tmp_path, checker, name):
    outcomes = {"read": 0, "refused": 0}
    for seed in (*range(MUTANTS), *ENDLESS.get(name, ())):
        path = tmp_path / f"mutant{seed}{KINDS[name][0]}"
        path.write_bytes(mutated(sample(name), random.Random(f"{name} {seed}")))
        outcomes["read" if checker.check(path, name) is None else "refused"] += 1
        path.unlink()
    # If none were refused, the mutants would test nothing. Nearly all mutants of kinds with checksums are refused.
    assert outcomes["refused"] > 0


MEANINGS = {
    np.nan: {
        "truth/x",
        "truth/y",
        "truth/events/place",
        "truth/frames/flow",
        "truth/frames/flow_with_prism",
        "truth/frames/displacement",
        "truth/frames/displacement_with_prism",
    },
    np.inf: {"truth/events/depth", "truth/frames/depth"},
    -np.inf: set(),
}
"""Values that are not finite, with the datasets in which they have a meaning."""


@pytest.mark.parametrize("value", MEANINGS)
@pytest.mark.parametrize("name", ["truth_plain", "sensors_plain", "hdf5_plain"])
def test_values_that_are_not_finite_are_refused(tmp_path, name, value):
    """One element of each floating dataset."""
    path = tmp_path / "sample.h5"
    path.write_bytes(sample(name))
    with h5py.File(path) as file:
        found = []
        file.visititems(
            lambda key, item: found.append(key) if getattr(item, "dtype", np.dtype(int)).kind == "f" else None
        )
    read = set()
    for key in found:
        path.write_bytes(sample(name))
        with h5py.File(path, "r+") as file:
            values = file[key][()]
            values.reshape(-1)[values.size // 2] = value
            file[key][...] = values
        if check(path, name) is None:
            read.add(key)
        gc.collect()  # a reader that is part of a cycle holds HDF5's lock
    assert len(found) >= 1
    assert read == MEANINGS[value] & set(found)


@pytest.mark.parametrize("name", WRITERS)
def test_converted_mutants_are_whole_or_absent(tmp_path, name):
    original = write_sample(tmp_path, name, make_events(300))
    data = original.read_bytes()
    (tmp_path / "out").mkdir()
    outcomes = {"read": 0, "refused": 0}
    for seed in range(CONVERTED[1]):
        if seed >= CONVERTED[0] and min(outcomes.values()) > 0:
            break
        path = tmp_path / f"mutant{seed}{original.suffix}"
        path.write_bytes(mutated(data, random.Random(f"convert {name} {seed}")))
        out = tmp_path / "out" / f"{seed}.h5"
        said = refusal(convert, path, out)
        outcomes["read" if said is None else "refused"] += 1
        if said is None:
            assert len(open_recording(out).events) > 0
        else:
            assert str(path) in said or str(out) in said
            assert not out.exists()
        path.unlink()
    assert [file for file in os.listdir(tmp_path / "out") if not file.endswith(".h5") or file.startswith(".")] == []
    assert min(outcomes.values()) > 0, outcomes
