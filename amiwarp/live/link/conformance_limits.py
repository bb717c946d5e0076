"""Times that the conformance suite takes, and the limits that it sets."""

from amiwarp.live.link import protocol

LISTEN_S = 2.5
"""Longest wait for the first frames [s]."""
ANSWER_S = 1.0
"""Longest wait for an answer [s]."""
PING_S = 0.25
"""Interval of pings [s]."""
PONG_S = 0.05
"""Longest usual round trip of a ping [s]."""
BURST = 3
"""Number of pings sent at once."""
STATUS_S = 1.3
"""Longest time between two statuses [s]."""
CHANGE_S = 0.3
"""Longest time until a status reports a change [s]."""
LEAST_HZ = 990.0
"""Smallest rate of encoder samples [1/s]."""
LONGEST_GAP_US = 20_000
"""Longest time between two encoder samples [us]."""
CLOCK_TOLERANCE = 0.01
"""Largest relative difference between the rates of the controller's and the host's clocks."""
SPEED_TOLERANCE = 0.02
"""Largest relative error of the mean speed after the ramp."""
OVERSHOOT = 0.15
"""Largest relative error of the speed at the end of the ramp."""
RAMP_S = 1.0
"""Duration of the ramp [s]."""
SETTLE_S = 5.0
"""Longest time from the end of the ramp to the state "at speed" [s]."""
STEADY_S = 3.0
"""Time at constant speed [s]."""
STOP_S = 8.0
"""Longest time to stop [s]."""
EARLY_SHARE = 0.25, 0.65
"""Smallest and largest mean speed in the second time of :data:`SLICE_S` of the ramp, as a part of the speed."""
SLICE_S = 0.3
"""Time over which the speed is measured during the ramp, and for which a stopped motor must stand still [s]."""
LATCH_US = 2
"""Coarsest resolution of the controller's clock [us]."""
LATCH_COUNTS = 2.0
"""Largest distance of an index pulse from the samples [counts]."""
INDEX_COUNTS = 6.0
"""Largest error of the counts between index pulses [counts]; :data:`INDEX_SHARE`, if that is more."""
INDEX_SHARE = 0.001
"""Largest error of the counts between index pulses [turns]; :data:`INDEX_COUNTS`, if that is more."""
PLACE_SHARE = 0.002
"""Largest difference between the places of the index in the two directions [turns]."""
LAG_US = 35_000
"""Longest time for which a sample may wait to be sent [us]."""
STALE_US = 1_000
"""Largest error of the time of a pong or status [us]."""
JUMP = 4.0
"""Speed at which counts may change, as a multiple of the largest speed of the suite."""
SYNC_HZ = (1.5, 30.0)
"""Smallest and largest rate of sync pulses [1/s]."""
SILENCE_S = 10.0
"""Longest silence of the host until the controller must report it [s]."""
LOST_HOST_S = 2
"""Silence after which the controller is told to stop the motor [s]."""
MOST_SUPPLY_V = 60.0
"""Largest plausible voltage of the motor's supply [V]."""
STEEP_RPM_S = 1e5
"""Ramp that no motor follows [rpm/s]."""
STEEP_SLICE_S = 0.05
"""Least time in which the speed is measured during the steep ramp [s]."""
STEEP_COUNTS = 20.0
"""Least number of counts by which the speed is measured during the steep ramp."""
HOST_TIMEOUT = [setting.name for setting in protocol.SETTINGS].index("host-timeout")
"""Key of the setting host-timeout."""
LOST_HOST_STOP = 1 << protocol.FAULTS.index("stopped for lost host")
"""Fault bit of a motor that was stopped for a lost host."""
