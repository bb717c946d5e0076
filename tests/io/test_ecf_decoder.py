"""The decoder of Prophesee's ECF codec: against the NumPy decoder, whole chunks and damaged ones."""

import itertools
import random
import struct

import numpy as np
import pytest
import warp as wp

from amiwarp import AmiwarpError
from amiwarp.io.prophesee import ecf
from amiwarp.kernels import ecf as kernels
from amiwarp.kernels.event_arrays import new_event_arrays
from amiwarp.kernels.launch import launch
from reference import ecf_codec
from reference.ecf_files import ecf_chunk, ecf_events
from reference.mutation_files import mutated

MODES = ["packed", "rows", "masks"]


def known(chunks: list[bytes]) -> list[np.ndarray]:
    """Return the columns of some chunks, as NumPy decodes them."""
    decoded = [ecf_codec.decode_chunk(chunk) for chunk in chunks]
    return [np.concatenate(columns) for columns in zip(*decoded, strict=True)]


@pytest.mark.parametrize("mode", MODES)
def test_chunks_that_follow_one_another_are_decoded_as_numpy_does(mode: str, device: str) -> None:
    events = ecf_events(5000)
    cuts = [0, 1, 4, 800, 801, 803, 2500, 5000]
    chunks = [ecf_chunk(events[first:stop], mode) for first, stop in itertools.pairwise(cuts)]
    chunks.insert(3, ecf.HEAD.pack({"packed": 2, "rows": 1, "masks": 0}[mode], 5))  # without events
    found, counts = ecf.decode_chunks(b"".join(chunks), [len(chunk) for chunk in chunks], device)
    assert str(found.device) == device
    assert counts.tolist() == [1, 3, 796, 0, 1, 2, 1697, 2500]
    for name, column in zip("xytp", known(chunks), strict=True):
        np.testing.assert_array_equal(getattr(found, name).numpy(), column)


@pytest.mark.parametrize(("count", "is_damaged"), [(15, False), (16, True)])
def test_a_gap_of_time_has_at_most_fifteen_bytes(count: int, is_damaged: bool, device: str) -> None:
    packed = bytes(12)
    chunk = ecf.HEAD.pack(1 << 2 | 2, 7) + b"\xf0" * (count - 2) + b"\xf1\xf0" + b"\x21" + packed
    if is_damaged:
        with pytest.raises(
            AmiwarpError,
            match=r"the times of a chunk of the ECF codec, number \d+ of \d+, are damaged",
        ):
            ecf.decode_chunks(chunk, [len(chunk)], device)
    else:
        found, _ = ecf.decode_chunks(chunk, [len(chunk)], device)
        assert found.t.numpy().tolist() == [7 + (1 << 4 * 13) + 2] == known([chunk])[2].tolist()


def test_columns_behind_the_last_event_are_not_written(device: str) -> None:
    """The last word tells of five more. An array with room for them keeps what it holds."""
    # Times, rows, columns, polarities
    data = struct.pack("<BHHB", 1 << 4 | 2, 5 << 5 | 2, 3 << 5 | 31, 2)
    chunk = np.zeros(1, kernels.Chunk.numpy_dtype())
    chunk["stop"] = len(data)
    chunk["count"] = 2
    arrays = new_event_arrays(8, device)
    arrays.x.fill_(9)
    words = wp.array(np.frombuffer(data, np.uint8), dtype=wp.uint8, device=device)
    chunks = wp.array(chunk, dtype=kernels.Chunk, device=device)
    parts = wp.empty(1, dtype=kernels.Parts, device=device)
    launch(kernels.survey_ecf, 1, [words, chunks], [parts], device=device, smallest=1)
    launch(kernels.decode_ecf, 1, [words, chunks, parts], [arrays], device=device, smallest=1)
    assert arrays.x.numpy().tolist() == [3, 4, 9, 9, 9, 9, 9, 9]


@pytest.mark.parametrize("mode", MODES)
def test_damaged_chunks_are_decoded_or_refused_as_numpy_does(mode: str, device: str) -> None:
    """With the same words: the first part that holds no events is named."""
    whole = ecf_chunk(ecf_events(800), mode)
    refused = []
    for seed in range(400):
        chunk = mutated(whole, random.Random(seed))
        said = None
        try:
            columns = known([chunk])
        except AmiwarpError as error:
            said = str(error)
        if said is None:
            found, _ = ecf.decode_chunks(chunk, [len(chunk)], device)
            for name, column in zip("xytp", columns, strict=True):
                np.testing.assert_array_equal(getattr(found, name).numpy(), column)
            continue
        refused.append(said)
        with pytest.raises(AmiwarpError) as raised:
            ecf.decode_chunks(chunk, [len(chunk)], device)
        assert str(raised.value) == said
    assert 0 < len(refused) < 400
    assert len(set(refused)) > 2
