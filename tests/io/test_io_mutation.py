"""Damaged files of every kind: each is read or refused by one AmiwarpError, without crash, hang or partial output."""

import gc
import os
import random
from collections.abc import Iterator
from dataclasses import replace

import h5py
import numpy as np
import pytest

from amiwarp import convert, open_recording
from reference.io_samples import WRITERS, make_events, refusal, write_sample
from reference.mutation_events import (
    DECODERS,
    OUTCOMES,
    VARIANTS,
    assert_said,
    count_outcomes,
    event_checker,
    rows_of,
    said_by_evt,
)
from reference.mutation_events import check as check_events
from reference.mutation_events import sample as event_sample
from reference.mutation_files import KINDS, Checker, check, mutated, sample

MUTANTS = 20
"""Mutants per kind of input. ``benchmarks.fuzz``, which ``.ci/run`` runs too, checks as many others as time allows."""
CONVERTED = 30, 60
"""Least and most mutants per format that are converted: of formats with checksums, few are read."""
COMPARED = 40
"""Mutants per decoder whose events are compared."""
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


@pytest.fixture(scope="module")
def comparer() -> Iterator[Checker]:
    found = event_checker()
    yield found
    found.close()


@pytest.mark.parametrize("decoder", DECODERS)
def test_events_of_mutants_are_those_of_the_bytes_or_the_change_is_said(
    tmp_path, capfd, comparer, decoder
):
    """No event may be lost or changed unsaid: see ``reference.mutation_events``. ``benchmarks.fuzz`` tries more."""
    outcomes = count_outcomes(comparer, decoder, range(COMPARED), tmp_path, tmp_path / "kept")
    assert outcomes["defects"] == 0, capfd.readouterr().err
    assert set(outcomes) <= {*OUTCOMES, "defects"}
    assert outcomes.total() == COMPARED
    assert 0 < outcomes["refused"] < COMPARED  # if all were refused, nothing would be compared


@pytest.mark.parametrize("name", VARIANTS)
def test_samples_of_events_are_sound(tmp_path, name):
    path = tmp_path / f"sample{VARIANTS[name][0]}"
    path.write_bytes(event_sample(name))
    assert check_events(path, name) == "same"


def test_a_second_decoder_notices_lost_and_changed_events_and_counts(tmp_path):
    path = tmp_path / "a.raw"
    path.write_bytes(event_sample("evt3/vectors"))
    recording = open_recording(path)
    rows = rows_of(recording)
    said = said_by_evt(recording, path.read_bytes())
    assert_said(recording, rows, said)
    changed = rows.copy()
    changed[7, 3] ^= 1
    for wrong in (rows[:-1], changed):
        with pytest.raises(AssertionError, match="events read, 300 expected, or other values"):
            assert_said(recording, wrong, said)
    for name in (
        "unknown_words",
        "repaired_time_events",
        "dropped_outside_events",
        "truncated_bytes",
    ):
        uncounted = replace(recording, metadata={**recording.metadata, name: 1})
        with pytest.raises(AssertionError, match=f"{name}: 1 stated, 0 found"):
            assert_said(uncounted, rows, said)


MEANINGS = {
    np.nan: {
        "truth/x",
        "truth/y",
        "truth/events/place",
        "truth/frames/flow",
        "truth/frames/flow_with_prism",
        "truth/frames/displacement",
        "truth/frames/displacement_with_prism",
        "truth/frames/backward",
        "truth/frames/backward_with_prism",
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
            lambda key, item: (
                found.append(key) if getattr(item, "dtype", np.dtype(int)).kind == "f" else None
            )
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
    assert [
        file
        for file in os.listdir(tmp_path / "out")
        if not file.endswith(".h5") or file.startswith(".")
    ] == []
    assert min(outcomes.values()) > 0, outcomes
