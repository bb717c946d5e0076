"""Simulate the events of an event camera from a picture, a camera and a prism, with ground truth."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.events import Events, MemoryEvents
from amiwarp.events.recording import MetadataValue, Recording
from amiwarp.events.truth import EventTruth
from amiwarp.io import RecordingWriter
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import Prism
from amiwarp.progress import Progress
from amiwarp.simulation.engine import Engine
from amiwarp.simulation.motion import LONGEST_S, CameraMotion, EncoderModel, PrismMotion
from amiwarp.simulation.scene import Scene
from amiwarp.simulation.sensor import SensorModel
from amiwarp.simulation.worlds.recorded_truth import RecordedTruth, chosen_instants
from amiwarp.simulation.worlds.world_scene import WorldScene
from amiwarp.validation import instance, real, whole

if TYPE_CHECKING:
    from amiwarp.events.encoder import Encoder


@dataclass(frozen=True, eq=False)
class Simulation:
    """Everything that determines a simulated recording.

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

    scene: Scene | WorldScene
    """The scene: pictures at infinity, or a world."""
    camera: Camera
    """The camera, of at most 4194304 pixels."""
    prism: Prism
    """The true prism."""
    duration_s: float
    """Duration [s]."""
    motion: PrismMotion = field(default_factory=PrismMotion)
    """Motion of the prism."""
    camera_motion: CameraMotion = field(default_factory=CameraMotion)
    """Rotation of the camera."""
    sensor: SensorModel = field(default_factory=SensorModel)
    """Pixels of the sensor."""
    encoder_model: EncoderModel | None = field(default_factory=EncoderModel)
    """Errors of the encoder; None for a camera without a prism, whose recording has neither encoder nor prism."""
    nominal_prism: Prism | None = None
    """The prism stored with the recording; None for the true one."""
    seed: int = 0
    """Seed of all random numbers."""
    device: str = "cpu"
    """Device to compute on."""
    source: Mapping[str, MetadataValue] = field(default_factory=dict)
    """What the scene was made from; it becomes part of the recording's metadata."""

    def __post_init__(self) -> None:
        if not isinstance(self.scene, WorldScene):
            instance(self.scene, Scene, "simulation's scene")
        kinds: dict[str, type] = {"camera": Camera, "prism": Prism, "motion": PrismMotion, "sensor": SensorModel,
                 "camera_motion": CameraMotion}  # fmt: skip
        if self.encoder_model is not None:
            kinds["encoder_model"] = EncoderModel
        for name, kind in kinds.items():
            instance(getattr(self, name), kind, f"simulation's {name}")
        real(self.duration_s, "duration_s", 1e-3, LONGEST_S, " s")
        if self.camera.width * self.camera.height > 1 << 22:
            given = f"{self.camera.width}x{self.camera.height}"
            raise AmiwarpError(f"camera of {given} has more than 4194304 pixels; give a smaller camera")
        whole(self.seed, "seed", 0, (1 << 31) - 1)

    @property
    def duration_us(self) -> int:
        """Duration, rounded [us]."""
        return round(self.duration_s * 1e6)

    def without_prism(self) -> Simulation:
        """Return the same simulation of a plain event camera: the prism is taken out.

        Returns
        -------
        Simulation
            The same scene, sensor and seed with an apex angle of 0. Its recording has neither encoder nor prism.
        """
        return replace(self, prism=replace(self.prism, apex=0.0), nominal_prism=None, encoder_model=None)

    def encoder(self) -> Encoder | None:
        """Sample the encoder.

        Returns
        -------
        Encoder or None
            Samples of the encoder, or None without a prism. Its clock offset is only in the ground truth.
        """
        if self.encoder_model is None:
            return None
        return self.encoder_model.sample(self.motion, self.duration_us, self.seed)

    def truth_parameters(self) -> dict[str, float]:
        """Return the true parameter values.

        Returns
        -------
        dict
            Values by the names that calibration uses, and those of the sensor.
        """
        constant = self.camera_motion.constant and not (
            isinstance(self.scene, WorldScene) and self.scene.trajectory.moves
        )  # a trajectory has no constant angular velocity
        rates = np.asarray(self.camera_motion.rates) if constant else np.full(3, np.nan)
        omega = dict(zip(("omega_x", "omega_y", "omega_z"), rates.ravel()[-3:].tolist(), strict=True))
        clock = {} if self.encoder_model is None else {"clock_offset_us": self.encoder_model.clock_offset_us}
        return {
            "apex": self.prism.apex,
            "index": self.prism.index,
            "phase": self.motion.phase,
            **clock,
            "tilt_x": self.motion.tilt[0],
            "tilt_y": self.motion.tilt[1],
            **{name: value for name, value in omega.items() if math.isfinite(value)},
            **asdict(self.sensor),
        }

    def metadata(self) -> dict[str, MetadataValue]:
        """Describe how the recording was made.

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
        for events, truth, _ in self._run_engine(chunk_us, progress):
            points = truth.points
            assert points is not None
            yield events, points

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
        for events, truth, _ in self._run_engine(chunk_us, progress):
            yield events, truth

    def _run_engine(self, chunk_us: int | None, progress: Progress | None) -> Iterator[tuple[Events, EventTruth, int]]:
        """Yield events, their ground truth, and the end of their time span [us]."""
        engine = Engine(self, chunk_us)
        for block in engine.run():
            yield block.to_host()[0], block.truth(), engine.now_us
            if progress is not None:
                progress("simulating", min(1.0, engine.now_us / self.duration_us))

    def log_view(self) -> NDArray[np.float32]:
        """Return the first picture as the camera sees it at t = 0 without the prism.

        Returns
        -------
        ndarray
            Log intensity, float32, shape ``(height, width)``.
        """
        from amiwarp.simulation.scenery import log_view

        return log_view(self)

    def run(
        self,
        *,
        truth_hz: float | None = None,
        truth_times_us: ArrayLike | None = None,
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
        progress : Progress, optional
            Called with the finished share.

        Returns
        -------
        Recording
            The recording, with ground truth.
        """
        recorded = RecordedTruth(self, chosen_instants(self.duration_us, truth_hz, truth_times_us))
        blocks: list[Events] = []
        for events, truth, now_us in self._run_engine(None, progress):
            blocks.append(events)
            recorded.keep(truth, now_us)
        return Recording(
            MemoryEvents(Events.concatenate(blocks), self.camera.width, self.camera.height),
            self.camera,
            self.encoder(),
            self._stored_prism,
            recorded.kept(self.truth_parameters()),
            self.metadata(),
            "simulation",
        )

    @property
    def _stored_prism(self) -> Prism | None:
        """The nominal prism of the recording, or None for a plain event camera."""
        return None if self.encoder_model is None else self.nominal_prism or self.prism

    def write(
        self,
        path: str | Path,
        *,
        truth_hz: float | None = None,
        truth_times_us: ArrayLike | None = None,
        progress: Progress | None = None,
        overwrite: bool = False,
    ) -> None:
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
            for events, truth, now_us in self._run_engine(None, progress):
                writer.append(events, truth=truth)
                for frame in recorded.frames_before(now_us):
                    writer.append_frame(frame)
                for t_us, mask in recorded.known.take():
                    writer.append_known(t_us, mask)
                poses = recorded.poses_before(now_us)
                if poses is not None:
                    writer.append_poses(poses)


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
    truth_hz: float | None = None,
    progress: Progress | None = None,
) -> Recording:
    """Simulate a recording.

    For recordings larger than memory, use :meth:`Simulation.write` or :meth:`Simulation.blocks`.

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
    ).run(truth_hz=truth_hz, progress=progress)
