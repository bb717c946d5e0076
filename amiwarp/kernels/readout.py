"""Readout of the simulated sensor: rows that are read one after the other, and a bus with a queue of finite length."""

import warp as wp

from amiwarp.kernels.event_generation import LOW_BITS, LOW_MASK, TICKS

wp.set_module_options({"enable_backward": False})

PS_PER_US = wp.constant(wp.int64(1000000))
LAG_BIT = wp.constant(3)  # lowest bit of the lag in a key


@wp.struct
class RowScan:
    """Scan of the sensor's rows one after the other, without a pause."""

    row_ps: wp.int64  # time to read a row [ps]
    scan_ps: wp.int64  # time to read all rows [ps]
    origin: wp.int64  # time of a key's tick 0 since the first scan [us]
    width: int  # width of the sensor [px]
    shift: int  # bit position of the time in a key


@wp.func
def time_of_row(scan: RowScan, row: int, t: wp.int64) -> wp.int64:
    """Return the time at which a row is read next, at or after ``t`` [us], rounded up [us]."""
    phase = wp.int64(row) * scan.row_ps
    passed = wp.max((t + scan.origin) * PS_PER_US - phase, wp.int64(0))
    scans = (passed + scan.scan_ps - wp.int64(1)) / scan.scan_ps
    read = scans * scan.scan_ps + phase
    return (read + PS_PER_US - wp.int64(1)) / PS_PER_US - scan.origin


@wp.kernel
def stamp_rows(scan: RowScan, keys: wp.array(dtype=wp.int64), start: int):
    """Replace the time stamp of each key by the time at which its row is read; the time of its crossing stays."""
    i = start + wp.tid()
    key = keys[i]
    t = key >> wp.int64(scan.shift)
    low = key - (t << wp.int64(scan.shift))
    row = int(low >> wp.int64(LOW_BITS)) / scan.width
    read = time_of_row(scan, row, t)
    reversed_lag = (low & wp.int64(LOW_MASK)) >> wp.int64(LAG_BIT)
    shorter = wp.min((read - t) * wp.int64(TICKS), reversed_lag)
    keys[i] = (read << wp.int64(scan.shift)) + low - (shorter << wp.int64(LAG_BIT))


@wp.struct
class Bus:
    """Bus of the sensor, which transmits one event at a time."""

    event_ps: wp.int64  # time to transmit an event [ps]
    longest_ps: wp.int64  # longest time in the queue [ps]; events that would wait longer are lost
    row: int  # pixels of a row whose events share a time stamp; 0 if every event has its own


@wp.kernel
def queue_events(
    bus: Bus,
    t: wp.array(dtype=wp.int64),
    pixel: wp.array(dtype=int),
    free: wp.array(dtype=wp.int64),
    stamp: wp.array(dtype=wp.int64),
):
    """Transmit events in order, in one thread: ``stamp`` is the time of transmission [us], or -1 for a lost event.

    ``free`` holds the time at which the bus becomes free [ps].
    """
    until = free[0]
    for i in range(t.shape[0]):
        now = t[i] * PS_PER_US
        stamp[i] = wp.int64(-1)
        if until - now <= bus.longest_ps:
            begin = wp.max(until, now)
            stamp[i] = begin / PS_PER_US
            if bus.row > 0 and i > 0:
                if t[i - 1] == t[i] and pixel[i - 1] / bus.row == pixel[i] / bus.row and stamp[i - 1] >= wp.int64(0):
                    stamp[i] = stamp[i - 1]
            until = begin + bus.event_ps
    free[0] = until
