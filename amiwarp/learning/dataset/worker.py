"""Making of one recording of a data set, by a worker."""

from __future__ import annotations

import math
import os
import re
import socket
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from amiwarp._version import __version__
from amiwarp.errors import AmiwarpError
from amiwarp.events.device_events import DeviceEvents
from amiwarp.events.recording import Events
from amiwarp.events.truth import MAPS, FrameTruth
from amiwarp.imaging.windows import windows
from amiwarp.io import convert, open_recording, open_rig
from amiwarp.io.recorded_dataset import rig_events
from amiwarp.io.tensor_files import save_tensors
from amiwarp.learning.dataset import specification as spec
from amiwarp.learning.dataset.drawn_rig import rig_of
from amiwarp.learning.dataset.drawn_scene import drawn_world, picture_scene, shaken_motion
from amiwarp.learning.dataset.items import Item
from amiwarp.learning.dataset.randomise import SENSOR
from amiwarp.learning.dataset.stored import put_stored, stored_bytes, stored_digest
from amiwarp.optics.camera import LARGEST_SIZE, Camera
from amiwarp.optics.prism import Prism
from amiwarp.schema.records import LARGEST_INTEGER
from amiwarp.simulation.engine import Engine
from amiwarp.simulation.motion import PrismMotion
from amiwarp.simulation.recorded_truth import RecordedTruth, chosen_instants
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.simulation.simulator import Simulation
from amiwarp.simulation.translation.translator import translation
from amiwarp.simulation.worlds.world_scene import BLUR_PX, WorldScene
from amiwarp.studies import cluster
from amiwarp.studies.failures import failure_text
from amiwarp.tasks import limited_cpu_threads
from amiwarp.validation import real, shown, whole


def _of_pattern(pattern: str, text: str, what: str) -> str:
    """Return text that a regular expression matches; raise :class:`AmiwarpError` for other text."""
    if not re.fullmatch(pattern, text):
        raise AmiwarpError(f"{what} is {shown(text)}; expected text of the form {pattern}")
    return text


@dataclass(frozen=True)
class Made:
    """A recording that was made, as the journal keeps it."""

    key: Annotated[str, partial(_of_pattern, "[0-9a-f]{16}")]
    """Key of the item."""
    file: Annotated[
        str, partial(_of_pattern, "[A-Za-z0-9_-]+/[A-Za-z0-9_-]*-[0-9a-f]{16}([.]h5|[.]npz)?")
    ]
    """Path, relative to the folder of the data set. The path of a rig is a folder."""
    bytes: Annotated[int, partial(whole, low=0, high=LARGEST_INTEGER)]
    """Size [bytes]."""
    sha256: Annotated[str, partial(_of_pattern, "[0-9a-f]{64}")]
    """SHA-256 of the file, or of the files of a rig, in hexadecimal."""
    events: Annotated[int, partial(whole, low=0, high=LARGEST_INTEGER)]
    """Number of events."""
    duration_s: Annotated[float, partial(real, low=0.0, high=LARGEST_INTEGER * 1e-6)]
    """Duration: as simulated, or from the first event to the last [s]."""
    width: Annotated[int, partial(whole, low=1, high=LARGEST_SIZE)] | None
    """Width of the sensor [px]; None for a rig."""
    height: Annotated[int, partial(whole, low=1, high=LARGEST_SIZE)] | None
    """Height of the sensor [px]; None for a rig."""
    seconds: Annotated[float, partial(real, low=0.0, high=1e9)]
    """Time that the worker took [s]."""
    processor_s: Annotated[float, partial(real, low=0.0, high=1e9)]
    """Processor time that its process took [s]."""
    device: Annotated[str, partial(_of_pattern, "cpu|cuda:[0-9]{1,3}")]
    """Device that it was computed on."""
    amiwarp: Annotated[str, partial(_of_pattern, "[A-Za-z0-9.+-]{1,64}")]
    """Version of amiwarp."""

    def __post_init__(self) -> None:
        if not Path(self.file).stem.endswith(self.key):  # the file may be moved or removed
            raise AmiwarpError(
                f"file is {shown(self.file)}; expected a name with the key {self.key}"
            )


@dataclass(frozen=True)
class Failed:
    """A recording that could not be made."""

    key: str
    """Key of the item."""
    error: str
    """Message of the error."""


@dataclass(frozen=True)
class Job:
    """What a worker gets."""

    item: Item
    """Recording to make."""
    out: Path
    """Folder of the data set."""
    scratch: Path
    """Folder for unfinished files, on the same disk."""
    device: str
    """Device; :data:`amiwarp.studies.cluster.ANY_GPU` is the worker's GPU."""
    threads: int | None
    """Number of CPU threads that the worker may use; None for all."""


def make(job: Job) -> Made | Failed:
    """Make a recording. Raises :class:`AmiwarpError` if the folder of the data set is not visible to this worker."""
    if not job.scratch.is_dir():
        raise AmiwarpError(
            f"the worker on {socket.gethostname()} does not see {job.scratch.parent}; put the data set and its sources "
            "on a disk that all workers share under the same path"
        )
    try:
        with limited_cpu_threads(job.threads):
            return _make(job)
    except Exception as error:  # whatever one recording raises must not stop the others
        return Failed(job.item.key, failure_text(error))


def _make(job: Job) -> Made:
    began = time.perf_counter()
    began_processor = time.process_time()
    item = job.item
    device = "cuda:0" if job.device == cluster.ANY_GPU else job.device
    path = job.out / item.file
    part = job.scratch / path.name
    written = write_recording(item, part, device)
    size = stored_bytes(part, item.cameras)
    digest = stored_digest(part, item.cameras)
    put_stored(part, path, item.cameras)
    return Made(
        item.key,
        item.file,
        size or 0,
        digest,
        *written,
        seconds=round(time.perf_counter() - began, 6),
        processor_s=round(time.process_time() - began_processor, 6),
        device=device,
        amiwarp=__version__,
    )


def write_recording(
    item: Item, path: Path, device: str, duration_s: float | None = None
) -> tuple[int, float, int | None, int | None]:
    """Write a recording or its tensors to ``path``, replacing it. ``duration_s`` shortens a simulated recording.

    Return its number of events, its duration (as simulated, or from the first event to the last) [s], and the width and
    height of the sensor [px], which are None for a rig.
    """
    if item.cameras:
        rig = rig_of(item, device, duration_s)
        rig.write(path, overwrite=True)
        return rig_events(open_rig(path)), rig.duration_s, None, None
    if item.kind == "recordings":
        return _write_existing(item, path, device)
    simulation = simulation_of(item, device, duration_s)
    rate = item.recipe.get("truth_hz")
    size = (simulation.camera.width, simulation.camera.height)
    if item.output is None:
        events = simulation.write(path, truth_hz=rate, overwrite=True)
    else:
        events = _write_simulated_tensors(simulation, item.output, path, rate)
    return events, simulation.duration_s, *size


def _write_existing(item: Item, path: Path, device: str) -> tuple[int, float, int, int]:
    """Write what a source of the kind ``recordings`` gives, as :func:`write_recording` does."""
    source = item.folder / item.source
    if item.output is None:
        converted = convert(source, path, overwrite=True)
        duration_s = 0.0
        if converted.t_first is not None and converted.t_last is not None:
            duration_s = (converted.t_last - converted.t_first) * 1e-6
        return converted.events, duration_s, converted.width, converted.height
    events = open_recording(source).events
    count = len(events)
    duration_s = (events.t_last - events.t_first) * 1e-6 if count else 0.0
    tensors = _tensors(events.slice(0, count), events.size, item.output, device=device)
    save_tensors(path, tensors)
    return count, duration_s, *events.size


def _write_simulated_tensors(
    simulation: Simulation, output: spec.OutputEntry, path: Path, truth_hz: float | None
) -> int:
    """Simulate a recording and write its tensors, which are made on the device. Return the number of events.

    The ground truth of instants is written too, if there is some. The ground truth of events is not computed.
    """
    recorded = RecordedTruth(simulation, chosen_instants(simulation.duration_us, truth_hz))
    blocks = list[DeviceEvents]()
    frames = list[FrameTruth]()
    engine = Engine(simulation)
    for block in engine.run():
        blocks.append(block.on_device()[0])
        frames.extend(recorded.frames_before(engine.now_us))
    events = DeviceEvents.concatenate(blocks)
    arrays = _tensors(events, (simulation.camera.width, simulation.camera.height), output)
    if frames:
        arrays["truth_t"] = np.array([frame.t_us for frame in frames], np.int64)
        arrays |= {name: np.stack([getattr(frame, name) for frame in frames]) for name in MAPS}
    save_tensors(path, arrays)
    return len(events)


def _tensors(
    events: Events | DeviceEvents, size: tuple[int, int], output: spec.OutputEntry, **options: Any
) -> dict[str, NDArray[Any]]:
    """Return the tensors of a recording by name: ``tensor``, and the times of its windows if there are several."""
    cut = windows(events, **output.windows) if output.windows else None
    tensor = output.function(events, *size, windows=cut, **output.options, **options)
    if not isinstance(tensor, np.ndarray):
        tensor = tensor.numpy()
    arrays = {"tensor": tensor}
    if cut is not None:
        arrays |= {"t_start": cut.t_start, "t_end": cut.t_end}
    return arrays


def simulation_of(item: Item, device: str, duration_s: float | None = None) -> Simulation:
    """Return the simulation of a recording, which stores the values that it drew. ``duration_s`` shortens it."""
    drawn = item.drawn
    if item.recipe["prism"] is None:
        simulation = _seen_through(item, Prism(0.0), PrismMotion(), device, duration_s)
        simulation = simulation.without_prism()
    else:
        entry = spec.PrismEntry(**item.recipe["prism"])
        prism = replace(entry, apex_deg=drawn.get("apex_deg", entry.apex_deg)).build()
        start = math.radians(drawn.get("start_deg", 0.0))
        motion = PrismMotion(drawn.get("rpm", item.recipe["rpm"]), start)
        simulation = _seen_through(item, prism, motion, device, duration_s)
    stored = {f"drawn_{name}": value for name, value in drawn.items()}
    return replace(simulation, source={**simulation.source, **stored})


def _seen_through(
    item: Item, prism: Prism, motion: PrismMotion, device: str, duration_s: float | None
) -> Simulation:
    """Return the simulation of a recording through a prism."""
    recipe = item.recipe
    camera = spec.CameraEntry(**recipe["camera"])
    source = os.fspath(item.folder / item.source)
    length = recipe["duration_s"] if duration_s is None else duration_s
    sensor_values = {name: value for name, value in recipe["sensor"].items() if name != "name"}
    drawn = item.drawn
    sensor_values |= {name: value for name, value in drawn.items() if name in SENSOR}
    common: dict[str, Any] = {
        "prism": prism,
        "duration_s": length,
        "motion": motion,
        "sensor": SensorModel(**sensor_values),
        "seed": item.seed,
        "device": device,
    }
    if item.kind == "translated":
        return translation(open_recording(source), **common)
    if item.kind == "videos":
        return _of_video(item, source, camera, **common)
    if item.kind != "pictures":
        return Simulation(_world(item), camera.build(), **common)
    rates = [math.radians(rate) for rate in recipe.get("rotate_deg_s", (0.0, 0.0, 0.0))]
    return Simulation(
        picture_scene(source, drawn),
        camera.build(),
        camera_motion=shaken_motion(rates, drawn, recipe["duration_s"]),
        **common,
    )


def _of_video(item: Item, source: str, entry: spec.CameraEntry, **settings: Any) -> Simulation:
    """Return the simulation of a video, whose size is the camera's unless the specification gives one."""
    from amiwarp.simulation.picture_opening import open_pictures

    pictures = open_pictures(source, fps=item.recipe["fps"])
    camera: Camera = entry.build(pictures.size)
    return translation(pictures, camera=camera, **settings)


def _world(item: Item) -> WorldScene:
    """Return the scene of a recording of a world."""
    world, trajectory = drawn_world(item)
    return WorldScene(world, trajectory, blur=item.drawn.get("blur_px", BLUR_PX))
