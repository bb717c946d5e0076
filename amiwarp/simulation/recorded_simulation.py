"""Recording of a simulation: what is stored of it, and its way into a file block by block."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from amiwarp.io import RecordingWriter
from amiwarp.optics.prism import Plate, Prism
from amiwarp.simulation.description import SimulationValues
from amiwarp.simulation.device_block import DeviceBlock
from amiwarp.simulation.engine import Engine
from amiwarp.simulation.motion import Moved
from amiwarp.simulation.recorded_truth import RecordedTruth
from amiwarp.tasks import Progress

if TYPE_CHECKING:
    from amiwarp.simulation.simulator import Simulation


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


def header_of(simulation: Simulation, recorded: RecordedTruth) -> dict[str, Any]:
    """Return the arguments of :class:`RecordingWriter` that describe the recording of a simulation."""
    return {
        "width": simulation.camera.width,
        "height": simulation.camera.height,
        "camera": simulation.camera,
        "prism": stored_prism(simulation),
        "encoder": simulation.encoder(),
        "truth_parameters": simulation.truth_parameters(),
        "truth_labels": recorded.labels,
        "metadata": simulation.metadata(),
    }


def write_recording(
    simulation: Simulation,
    recorded: RecordedTruth,
    writer: RecordingWriter,
    progress: Progress | None = None,
) -> None:
    """Simulate a whole recording into an open writer, in constant memory."""
    imu = simulation.imu_samples()
    if imu is not None:
        writer.append_imu(imu)
    for block, now_us in blocks_of(simulation, progress=progress):
        writer.append(block.events(), truth=block.truth())
        for frame in recorded.frames_before(now_us):
            writer.append_frame(frame)
        for t_us, mask in recorded.known.take():
            writer.append_known(t_us, mask)
        poses = recorded.poses_before(now_us)
        if poses is not None:
            writer.append_poses(poses)
