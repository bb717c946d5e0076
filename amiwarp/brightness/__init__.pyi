# Public names of this room. Written by .ci/public_names.py from the front door's.

from .sensor_timing import SensorTiming as SensorTiming
