"""Simulate the events of an event camera from a picture, a camera and a prism, with ground truth."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from amiwarp.events.device_events import NAMES, DeviceEvents, DeviceMemoryEvents, DeviceValues, join, wait
from amiwarp.events.encoder import Encoder
from amiwarp.events.events import Events, EventSource, MemoryEvents
from amiwarp.events.recording import MetadataValue, Recording
from amiwarp.events.truth import EventTruth, EventValues
from amiwarp.io import RecordingWriter
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import Prism
from amiwarp.progress import Progress
from amiwarp.simulation import scenery
from amiwarp.simulation.description import Scene, SimulationValues
from amiwarp.simulation.engine import DeviceBlock, Engine
from amiwarp.simulation.motion import CameraMotion, EncoderModel, PrismMotion
from amiwarp.simulation.sensor import SensorModel
from amiwarp.simulation.worlds.world import WorldScene
from amiwarp.simulation.worlds.world_truth import RecordedTruth, chosen_instants
from amiwarp.validation import guarded

# Values of a simulation: their checks, and the true parameters that they mean.


def true_parameters(simulation: SimulationValues) -> dict[str, float]:
    """Return the true values by the names that calibration uses, and those of the sensor."""
    constant = simulation.camera_motion.constant and not (
        isinstance(simulation.scene, WorldScene) and simulation.scene.trajectory.moves
    )  # a trajectory has no constant angular velocity
    rates = np.asarray(simulation.camera_motion.rates) if constant else np.full(3, np.nan)
    omega = dict(zip(("omega_x", "omega_y", "omega_z"), rates.ravel()[-3:].tolist(), strict=True))
    clock = {} if simulation.encoder_model is None else {"clock_offset_us": simulation.encoder_model.clock_offset_us}
    return {
        "apex": simulation.prism.apex,
        "index": simulation.prism.index,
        "phase": simulation.motion.phase,
        **clock,
        **{
            f"{name}_{axis}": angle
            for name in ("tilt", "cylinder", "wobble")
            for axis, angle in zip("xy", getattr(simulation.motion, name), strict=True)
        },
        **{name: value for name, value in omega.items() if math.isfinite(value)},
        **asdict(simulation.sensor),
    }


# Events of a simulation and their ground truth, collected in the memory of the host or of the device.


class CollectedEvents:
    """Columns of successive blocks of events and of their ground truth."""

    def __init__(self, *, on_device: bool) -> None:
        """Prepare to collect events on the device that simulates them, or on the host."""
        self._on_device = on_device
        self._parts: dict[str, list[Any]] = {}

    def add(self, block: DeviceBlock) -> None:
        """Add a block. In a world, call this method before the engine simulates the next chunk."""
        for name, values in block.columns().items():
            self._parts.setdefault(name, []).append(values if self._on_device else values.numpy())

    def take(self, width: int, height: int) -> tuple[EventSource, dict[str, EventValues]]:
        """Return a source of all events, and their ground truth by the names of :class:`EventTruth`.

        The blocks of a column are released once they are joined, so that only one column is held twice.
        """
        unite = join if self._on_device else np.concatenate
        found = {name: unite(self._parts.pop(name)) for name in list(self._parts)}
        events = [found.pop(name) for name in NAMES]
        if not self._on_device:
            return MemoryEvents(Events(*events), width, height), found
        source = DeviceMemoryEvents(DeviceEvents(*events), width, height)
        wait(source.device)
        return source, {name: DeviceValues(values) for name, values in found.items()}


@guarded
@dataclass(frozen=True, eq=False)
class Simulation(SimulationValues):
    """Description of a simulated recording, :class:`SimulationValues`, and the methods that simulate it.

    Equal values give equal events, bit for bit, on one kind of device.

    Examples
    --------
    >>> import numpy as np
    >>> picture = np.random.default_rng(0).random((64, 64)).astype(np.float32)
    >>> simulation = amiwarp.Simulation(
    ...     scene=amiwarp.Scene.from_picture(picture), camera=amiwarp.Camera.from_fov(32, 24, 1.0),
    ...     prism=amiwarp.Prism(0.03), duration_s=0.01)
    >>> recording = simulation.run()
    >>> recording.events.size
    (32, 24)
    """

    def without_prism(self) -> Simulation:
        """Return this simulation with the prism taken out, which makes it that of a plain event camera.

        Returns
        -------
        Simulation
            The same scene, sensor and seed with an apex angle of 0. Its recording has neither encoder nor prism.
        """
        prism, motion = replace(self.prism, apex=0.0), replace(self.motion, cylinder=(0.0, 0.0))
        return replace(self, prism=prism, motion=motion, nominal_prism=None, encoder_model=None)

    def encoder(self) -> Encoder | None:
        """Sample the prism's encoder.

        Returns
        -------
        Encoder or None
            Samples of the encoder, or None without a prism. Its clock offset is only in the ground truth.
        """
        if self.encoder_model is None:
            return None
        return self.encoder_model.sample(self.motion, self.duration_us, self.seed)

    def truth_parameters(self) -> dict[str, float]:
        """Return the true values of the parameters of prism, encoder, camera motion and sensor.

        Returns
        -------
        dict
            Values by the names that calibration uses, and those of the sensor.
        """
        return true_parameters(self)

    def metadata(self) -> dict[str, MetadataValue]:
        """Return the metadata that the recording stores about its simulation.

        Returns
        -------
        dict
            Seed and duration, and :attr:`source`.
        """
        return {"simulated": True, "seed": self.seed, "duration_us": self.duration_us, **self.source}

    def blocks(
        self, *, chunk_us: int | None = None, progress: Progress | None = None
    ) -> Iterator[tuple[Events, NDArray[np.float32]]]:
        """Yield the events of successive time spans. Memory use is constant.

        Parameters
        ----------
        chunk_us : int, optional
            Length of a span [us]. The default depends on the device. The events do not depend on it.
        progress : Progress, optional
            Called with the finished share.

        Yields
        ------
        tuple
            Events, and the scene point of each event: its pixel without the prism [px], shape ``(n, 2)``, NaN if its
            ray misses the image plane.
        """
        for block, _ in self._run_engine(chunk_us, progress):
            yield block.events(), block.points()

    def blocks_with_truth(
        self, *, chunk_us: int | None = None, progress: Progress | None = None
    ) -> Iterator[tuple[Events, EventTruth]]:
        """Yield the events of successive time spans with all their ground truth. Memory use is constant.

        Parameters
        ----------
        chunk_us : int, optional
            Length of a span [us]. The default depends on the device. The events do not depend on it.
        progress : Progress, optional
            Called with the finished share.

        Yields
        ------
        tuple
            Events, and their ground truth: points and causes; in a world also instances, depths and places.
        """
        for block, _ in self._run_engine(chunk_us, progress):
            yield block.events(), block.truth()

    def device_blocks(
        self, *, chunk_us: int | None = None, progress: Progress | None = None
    ) -> Iterator[tuple[DeviceEvents, wp.array]]:
        """Yield the events of successive time spans on the device that simulates them, without a copy to the host.

        Parameters
        ----------
        chunk_us : int, optional
            Length of a span [us]. The default depends on the device. The events do not depend on it.
        progress : Progress, optional
            Called with the finished share.

        Yields
        ------
        tuple
            Events, and the scene point of each event, as in :meth:`blocks`: a Warp array of vec2, shape ``(n,)``, which
            other libraries read as ``(n, 2)``.
        """
        for block, _ in self._run_engine(chunk_us, progress):
            yield block.on_device()

    def _run_engine(self, chunk_us: int | None, progress: Progress | None) -> Iterator[tuple[DeviceBlock, int]]:
        """Yield the blocks of successive time spans, each with the end of its span [us]."""
        engine = Engine(self, chunk_us)
        for block in engine.run():
            yield block, engine.now_us
            if progress is not None:
                progress("simulating", min(1.0, engine.now_us / self.duration_us))

    def log_view(self) -> NDArray[np.float32]:
        """Return the first picture as the camera sees it at t = 0 without the prism.

        Returns
        -------
        ndarray
            Log intensity, float32, shape ``(height, width)``.
        """
        return scenery.log_view(self)

    def run(
        self,
        *,
        truth_hz: float | None = None,
        truth_times_us: ArrayLike | None = None,
        on_device: bool = False,
        progress: Progress | None = None,
    ) -> Recording:
        """Simulate the whole recording in memory.

        Parameters
        ----------
        truth_hz : float, optional
            Rate of the instants whose depth, normals, instances, flow and luminance are recorded [1/s]. Only worlds
            have them. By default there are none.
        truth_times_us : array_like, optional
            The instants themselves instead of a rate [us], shape (k,), rising.
        on_device : bool, optional
            Keep the events and their ground truth on :attr:`device`, as :func:`simulate` does.
        progress : Progress, optional
            Called with the finished share.

        Returns
        -------
        Recording
            The recording, with ground truth.
        """
        recorded = RecordedTruth(self, chosen_instants(self.duration_us, truth_hz, truth_times_us))
        collected = CollectedEvents(on_device=on_device)
        for block, now_us in self._run_engine(None, progress):
            collected.add(block)
            recorded.keep(now_us)
        events, of_events = collected.take(self.camera.width, self.camera.height)
        truth = recorded.kept(self.truth_parameters(), of_events)
        camera, encoder, prism = self.camera, self.encoder(), self._stored_prism
        return Recording(events, camera, encoder, prism, truth, self.metadata(), "simulation")

    @property
    def _stored_prism(self) -> Prism | None:
        """Nominal prism to store with the recording, or None for a plain event camera."""
        return None if self.encoder_model is None else self.nominal_prism or self.prism

    def write(
        self,
        path: str | Path,
        *,
        truth_hz: float | None = None,
        truth_times_us: ArrayLike | None = None,
        progress: Progress | None = None,
        overwrite: bool = False,
    ) -> int:
        """Simulate the whole recording to a file, in constant memory.

        Parameters
        ----------
        path : str or Path
            Path of the recording.
        truth_hz : float, optional
            Rate of the instants whose depth, normals, instances, flow and luminance are recorded [1/s], as in
            :meth:`run`.
        truth_times_us : array_like, optional
            The instants themselves instead of a rate [us], shape (k,), rising.
        progress : Progress, optional
            Called with the finished share.
        overwrite : bool, optional
            Replace an existing file.

        Returns
        -------
        int
            Number of events.
        """
        recorded = RecordedTruth(self, chosen_instants(self.duration_us, truth_hz, truth_times_us))
        with RecordingWriter(
            path,
            width=self.camera.width,
            height=self.camera.height,
            camera=self.camera,
            prism=self._stored_prism,
            encoder=self.encoder(),
            truth_parameters=self.truth_parameters(),
            truth_labels=recorded.labels,
            metadata=self.metadata(),
            overwrite=overwrite,
        ) as writer:
            for block, now_us in self._run_engine(None, progress):
                writer.append(block.events(), truth=block.truth())
                for frame in recorded.frames_before(now_us):
                    writer.append_frame(frame)
                for t_us, mask in recorded.known.take():
                    writer.append_known(t_us, mask)
                poses = recorded.poses_before(now_us)
                if poses is not None:
                    writer.append_poses(poses)
        return len(writer)


@guarded
def simulate(
    scene: Scene | WorldScene | str | Path | NDArray[Any],
    camera: Camera,
    prism: Prism,
    *,
    duration_s: float,
    motion: PrismMotion | float = 720.0,
    camera_motion: CameraMotion | None = None,
    sensor: SensorModel | None = None,
    encoder: EncoderModel | None = None,
    nominal_prism: Prism | None = None,
    seed: int = 0,
    device: str = "cpu",
    on_device: bool = False,
    truth_hz: float | None = None,
    progress: Progress | None = None,
) -> Recording:
    """Simulate a recording.

    For recordings larger than memory, use :meth:`Simulation.write`, :meth:`Simulation.blocks` or
    :meth:`Simulation.device_blocks`.

    Parameters
    ----------
    scene : Scene, WorldScene, str, Path or ndarray
        Scene, world, picture file, or pixel values (see :meth:`Scene.from_picture`).
    camera : Camera
        The camera.
    prism : Prism
        The true prism.
    duration_s : float
        Duration [s].
    motion : PrismMotion or float, optional
        Motion of the prism, or its constant speed [turns/min].
    camera_motion : CameraMotion, optional
        Rotation of the camera; by default none.
    sensor : SensorModel, optional
        Pixels of the sensor.
    encoder : EncoderModel, optional
        Errors of the encoder.
    nominal_prism : Prism, optional
        The prism stored with the recording; by default the true one.
    seed : int, optional
        Seed of all random numbers.
    device : str, optional
        Device to compute on.
    on_device : bool, optional
        Keep the events and their ground truth on ``device``: the recording has :class:`DeviceMemoryEvents`. By default,
        they are copied to the host's memory.
    truth_hz : float, optional
        Rate of the instants whose depth, normals, instances, flow and luminance are recorded [1/s], in a world.
    progress : Progress, optional
        Called with the finished share.

    Returns
    -------
    Recording
        The recording, with ground truth.

    Raises
    ------
    AmiwarpError
        If a value is out of range, or the camera turns away from the picture.

    Examples
    --------
    >>> import numpy as np
    >>> picture = np.random.default_rng(0).random((64, 64)).astype(np.float32)
    >>> camera = amiwarp.Camera.from_fov(32, 24, 1.0)
    >>> recording = amiwarp.simulate(picture, camera, amiwarp.Prism(0.03), duration_s=0.01)
    >>> len(recording.events) > 0
    True
    """
    return Simulation(
        scene=scene if isinstance(scene, Scene | WorldScene) else Scene.from_picture(scene),
        camera=camera,
        prism=prism,
        duration_s=duration_s,
        motion=motion if isinstance(motion, PrismMotion) else PrismMotion(motion),
        camera_motion=camera_motion or CameraMotion(),
        sensor=sensor or SensorModel(),
        encoder_model=encoder or EncoderModel(),
        nominal_prism=nominal_prism,
        seed=seed,
        device=device,
    ).run(truth_hz=truth_hz, on_device=on_device, progress=progress)
