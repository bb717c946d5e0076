"""Kernels that check decoded events in blocks: their order in time, and their largest coordinates."""

import warp as wp

from amiwarp.kernels.native_code import load_int64, load_uint16, store_int64

wp.set_module_options({"enable_backward": False})


@wp.struct
class Survey:
    """What a block of events holds."""

    first: wp.int64
    """Time of its first event [us]."""
    latest: wp.int64
    """Largest time [us]."""
    falls: int
    """Number of events that are earlier than the one before."""
    right: int
    """Largest column [px]."""
    bottom: int
    """Largest row [px]."""


@wp.kernel
def survey_events(
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    t: wp.array(dtype=wp.int64),
    length: int,
    start: int,
    surveys: wp.array(dtype=Survey),
):
    """Note what each block of ``length`` events holds. One thread reads one block."""
    block = wp.tid() + start
    survey = Survey()
    first = block * length
    survey.first = load_int64(t, first)
    before = survey.first
    latest = before
    for i in range(first, wp.min(first + length, t.shape[0])):
        now = load_int64(t, i)
        survey.falls += wp.where(now < before, 1, 0)
        latest = wp.max(latest, now)
        before = now
        survey.right = wp.max(survey.right, int(load_uint16(x, i)))
        survey.bottom = wp.max(survey.bottom, int(load_uint16(y, i)))
    survey.latest = latest
    surveys[block] = survey


@wp.kernel
def raise_times(
    length: int,
    floors: wp.array(dtype=wp.int64),
    start: int,
    t: wp.array(dtype=wp.int64),
    raised: wp.array(dtype=int),
    furthest: wp.array(dtype=wp.int64),
):
    """Raise each time of a block to the largest so far, and note how many were raised, and by how much at most [us].

    ``floors``: largest time before each block [us].
    """
    block = wp.tid() + start
    latest = floors[block]
    count = int(0)
    most = wp.int64(0)
    for i in range(block * length, wp.min((block + 1) * length, t.shape[0])):
        now = load_int64(t, i)
        if now < latest:
            store_int64(t, i, latest)
            most = wp.max(most, latest - now)
            count += 1
        else:
            latest = now
    raised[block] = count
    furthest[block] = most
