"""Readout of the simulated sensor: rows that are read one after the other, and a bus with a queue of finite length."""

import warp as wp

from amiwarp.kernels.event_keys import OPTIONS
from amiwarp.kernels.pixels import LAG_BIT, LOW_BITS, LOW_MASK, TICKS

wp.set_module_options(OPTIONS)


PS_PER_US = wp.constant(wp.int64(1000000))


@wp.struct
class RowScan:
    """Scan of the sensor's rows one after the other, without a pause."""

    row_ps: wp.int64  # time to read a row [ps]
    scan_ps: wp.int64  # time to read all rows [ps]
    since_scan_us: wp.int64  # time of a key's tick 0 since the first scan [us]
    width: int  # width of the sensor [px]
    height: int  # height of the sensor [px]; the pixels of several cameras follow each other
    shift: int  # bit position of the time in a key


@wp.func
def time_of_row(scan: RowScan, row: int, t: wp.int64) -> wp.int64:
    """Return the time at which a row is read next, at or after ``t`` [us], rounded up [us]."""
    phase = wp.int64(row) * scan.row_ps
    passed = wp.max((t + scan.since_scan_us) * PS_PER_US - phase, wp.int64(0))
    scans = (passed + scan.scan_ps - wp.int64(1)) / scan.scan_ps
    read = scans * scan.scan_ps + phase
    return (read + PS_PER_US - wp.int64(1)) / PS_PER_US - scan.since_scan_us


@wp.kernel(module="unique", module_options=OPTIONS)
def stamp_rows(scan: RowScan, keys: wp.array(dtype=wp.int64), start: int):
    """Replace the time stamp of each key by the time at which its row is read; the time of its crossing stays."""
    i = start + wp.tid()
    key = keys[i]
    t = key >> wp.int64(scan.shift)
    low = key - (t << wp.int64(scan.shift))
    row = (int(low >> wp.int64(LOW_BITS)) / scan.width) % scan.height
    read = time_of_row(scan, row, t)
    # The lag is stored reversed: a later stamp makes it longer, so that the stored number falls; it stops at 0.
    reversed_lag = (low & wp.int64(LOW_MASK)) >> wp.int64(LAG_BIT)
    shorter = wp.min((read - t) * wp.int64(TICKS), reversed_lag)
    keys[i] = (read << wp.int64(scan.shift)) + low - (shorter << wp.int64(LAG_BIT))


@wp.struct
class Bus:
    """Bus of a sensor, which transmits one event at a time."""

    event_ps: wp.int64  # time to transmit an event [ps]
    longest_ps: wp.int64  # longest time in the queue [ps]; events that would wait longer are lost
    shares_stamps: int  # 1 if the events of a row that is read share a time stamp; 0 if every event has its own
    origin: wp.int64  # time from which picoseconds are counted [us]


@wp.func
def transmission(bus: Bus, now: wp.int64, until: wp.int64) -> wp.int64:
    """Return the time at which a bus that is busy ``until`` transmits an event of time ``now`` [ps], or -1 if lost."""
    if until - now > bus.longest_ps:
        return wp.int64(-1)
    return wp.max(until, now)


@wp.kernel(module="unique", module_options=OPTIONS)
def queue_events(
    bus: Bus,
    t: wp.array(dtype=wp.int64),
    row: wp.array(dtype=wp.uint16),
    first: wp.array(dtype=int),
    free: wp.array(dtype=wp.int64),
    stamp: wp.array(dtype=wp.int64),
):
    """Transmit events in order, one thread per sensor: ``stamp`` is the time of transmission [us], or -1 if lost.

    ``first``: index of each sensor's first event, and behind them the number of events. ``free`` holds the time at
    which each bus becomes free [ps since the origin].
    """
    sensor = wp.tid()
    until = free[sensor]
    for i in range(first[sensor], first[sensor + 1]):
        now = (t[i] - bus.origin) * PS_PER_US
        stamp[i] = wp.int64(-1)
        begin = transmission(bus, now, until)
        if begin >= wp.int64(0):
            stamp[i] = begin / PS_PER_US + bus.origin
            if bus.shares_stamps > 0 and i > first[sensor]:
                if t[i - 1] == t[i] and row[i - 1] == row[i] and stamp[i - 1] >= wp.int64(0):
                    stamp[i] = stamp[i - 1]
            until = begin + bus.event_ps
    free[sensor] = until


@wp.kernel(module="unique", module_options=OPTIONS)
def queue_keys(
    bus: Bus,
    shift: int,
    width: int,
    key_origin_us: wp.int64,
    duration: wp.int64,
    keys: wp.array(dtype=wp.int64),
    free: wp.array(dtype=wp.int64),
    stamp: wp.array(dtype=wp.int64),
    kept: wp.array(dtype=int),
):
    """Transmit the events of one sensor in order, as :func:`queue_events` does, given as ``keys``; one thread.

    ``keys`` and ``stamp`` keep the events that are transmitted before ``duration`` [us]; ``kept`` is their number.
    ``shift``: bit position of the time in a key; ``width``: width of the sensor [px]; ``key_origin_us``:
    time from which the times of keys are counted.
    """
    until = free[0]
    n = int(0)
    t_before = wp.int64(-1)
    row_before = wp.int64(-1)
    stamp_before = wp.int64(-1)
    for i in range(keys.shape[0]):
        key = keys[i]
        t = key >> wp.int64(shift)
        begin = transmission(bus, (t + key_origin_us) * PS_PER_US, until)
        at = wp.int64(-1)
        if begin >= wp.int64(0):
            at = begin / PS_PER_US
            until = begin + bus.event_ps
        if bus.shares_stamps > 0:
            row = ((key - (t << wp.int64(shift))) >> wp.int64(LOW_BITS)) / wp.int64(width)
            if (
                at >= wp.int64(0)
                and t == t_before
                and row == row_before
                and stamp_before >= wp.int64(0)
            ):
                at = stamp_before
            t_before = t
            row_before = row
            stamp_before = at
        if at >= wp.int64(0) and at < duration:
            keys[n] = key
            stamp[n] = at
            n += 1
    free[0] = until
    kept[0] = n
