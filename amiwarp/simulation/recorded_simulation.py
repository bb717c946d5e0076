"""What a simulation records: blocks of events, and the prism that is stored with them."""

from __future__ import annotations

from collections.abc import Iterator

from amiwarp.optics.prism import Plate, Prism
from amiwarp.simulation.description import SimulationValues
from amiwarp.simulation.device_block import DeviceBlock
from amiwarp.simulation.engine import Engine
from amiwarp.simulation.motion import Moved
from amiwarp.tasks import Progress


def blocks_of(
    simulation: SimulationValues, chunk_us: int | None = None, progress: Progress | None = None
) -> Iterator[tuple[DeviceBlock, int]]:
    """Yield the blocks of successive time spans of a simulation, each with the end of its span [us]."""
    engine = Engine(simulation, chunk_us)
    for block in engine.run():
        yield block, engine.now_us
        if progress is not None:
            progress("simulating", min(1.0, engine.now_us / simulation.duration_us))


def stored_prism(simulation: SimulationValues) -> Prism | Plate | None:
    """Return the nominal prism or plate to store with the recording, or None for a camera without glass."""
    prism = simulation.prism
    if simulation.encoder_model is None or isinstance(prism, Moved):
        return None
    glass = prism if isinstance(prism, Plate) else simulation.glass
    return simulation.nominal_prism or glass
