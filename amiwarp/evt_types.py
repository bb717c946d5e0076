"""Types of the words of Prophesee's EVT: their upper four bits; of EVT 2.1, the upper bits of the half with the time.

The words are described at https://docs.prophesee.ai/stable/data/encoding_formats/index.html. This file imports nothing,
so that readers that run without Warp share it with the kernels.
"""

# In all versions.
TIME_HIGH = 0x8
"""Upper bits of the time."""
TRIGGER = 0xA
"""Edge of an external trigger."""
OTHERS = 0xE
"""Events of other kinds, such as what a monitor of the sensor counts."""
CONTINUED = 0xF
"""More of the word before."""

# In EVT 2.0 and 2.1.
OFF = 0x0
"""Event, or events, whose polarity is OFF."""
ON = 0x1
"""Event, or events, whose polarity is ON."""
EVT2 = (OFF, ON, TIME_HIGH, TRIGGER, OTHERS, CONTINUED)
"""All types of EVT 2.0 and 2.1."""

# In EVT 3.0.
ROW = 0x0
"""Row of the next events."""
SINGLE = 0x2
"""Event: column and polarity."""
VECTOR_BASE = 0x3
"""Column of the next vector, and polarity of the next vectors."""
VECTOR_12 = 0x4
"""Which of 12 pixels have an event."""
VECTOR_8 = 0x5
"""Which of 8 pixels have an event."""
TIME_LOW = 0x6
"""Lower bits of the time."""
CONTINUED_4 = 0x7
"""Four more bits of the word before."""
EVT3 = (
    ROW,
    SINGLE,
    VECTOR_BASE,
    VECTOR_12,
    VECTOR_8,
    TIME_LOW,
    CONTINUED_4,
    TIME_HIGH,
    TRIGGER,
    OTHERS,
    CONTINUED,
)
"""All types of EVT 3.0."""
