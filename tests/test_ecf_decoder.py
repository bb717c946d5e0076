"""The decoder of Prophesee's ECF codec: against the NumPy decoder, whole chunks and damaged ones."""

import itertools
import random

import numpy as np
import pytest

from amiwarp import AmiwarpError
from amiwarp.io import ecf
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
