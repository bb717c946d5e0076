"""What a file does not state, and is assumed: such assumptions are in the metadata of a recording."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from amiwarp.events.recording import MetadataValue

SENSORS = (
    (128, 128),  # DVS128; it also holds the events of the SciDVS (126x112)
    (132, 104),  # DVS132S
    (240, 180),  # DAVIS240
    (304, 240),  # ATIS
    (320, 240),  # DVXplorer Lite
    (346, 260),  # DAVIS346
    (320, 320),  # Prophesee GenX320
    (640, 480),  # Prophesee Gen3.1, DVXplorer, DAVIS640
    (640, 512),
    (1280, 720),  # Prophesee Gen4.1, IMX636, IMX646
    (1280, 800),  # CeleX-V
    (1280, 960),  # Samsung DVS-Gen4
)
"""Sizes of known sensors (width, height) [px], for files that do not state a size: the first that holds all
events is taken. They grow in their number of pixels, but the common DVS128 comes before the rare DVS132S."""


def smallest_sensor(
    x_max: int, y_max: int, sensors: tuple[tuple[int, int], ...] = SENSORS
) -> tuple[int, int]:
    """Return the size of the smallest known sensor with pixel (x_max, y_max), or the smallest frame that holds it."""
    for width, height in sensors:
        if x_max < width and y_max < height:
            return width, height
    return x_max + 1, y_max + 1


ASSUMED = "assumed_"
"""Prefix of the names of assumptions in the metadata of a recording."""

ASSUMED_SIZE = ASSUMED + "size"
"""Name of the assumption of a sensor size."""


@dataclass(frozen=True, slots=True)
class Assumption:
    """Property of a file that the file does not state."""

    what: str
    """Name of the property, such as "time unit"."""
    value: str
    """Value that is assumed."""
    why: str
    """Reason for it."""
    option: str
    """Option of the command line that overrides it."""

    @property
    def entry(self) -> tuple[str, str]:
        """Name and text of the assumption in the metadata of a recording."""
        return ASSUMED + self.what.replace(" ", "_"), f"{self.value}: {self.why}; {self.option}"


def assumed_texts(metadata: Mapping[str, MetadataValue]) -> list[str]:
    """Return for each assumption in the metadata of a recording what is assumed, and the option that overrides it."""
    return [
        f"{assumption.what} {assumption.value} ({assumption.option})"
        for assumption in assumptions_of(metadata)
    ]


def assumptions_of(metadata: Mapping[str, MetadataValue]) -> list[Assumption]:
    """Return the assumptions in the metadata of a recording."""
    assumptions = []
    for name, text in metadata.items():
        if name.startswith(ASSUMED):
            value, _, rest = str(text).partition(": ")
            why, _, option = rest.rpartition("; ")
            assumptions.append(
                Assumption(name.removeprefix(ASSUMED).replace("_", " "), value, why, option)
            )
    return assumptions


def assumed_size(size: tuple[int, int], sensors: Iterable[tuple[int, int]] = SENSORS) -> Assumption:
    """Return the assumption of a sensor size."""
    holds = "the smallest known sensor" if size in sensors else "the smallest frame"
    return Assumption(
        "size",
        f"{size[0]}x{size[1]}",
        f"the file does not state it; {holds} with all events",
        "--size",
    )
