"""Content of a simulated world: trajectories, bodies with meshes and materials, lights and a sky."""

from __future__ import annotations

import math
from array import array as plain_array
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.choices import Seeing
from amiwarp.errors import AmiwarpError
from amiwarp.io.files import text_lines, write_text
from amiwarp.io.formats import POSE_ENDINGS, check_ending
from amiwarp.validation import array, choice, guarded, instance, one_of, real, shown, vector, whole

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation


# Position and orientation of a camera or a body over time.

LARGEST_SPEED = 1e3
"""Largest speed of a body or camera [m/s]. A higher speed is refused as a jump."""
BLUR_PX = 0.5
"""Default standard deviation of the optical blur, including the area of the pixel [sensor px]."""
LARGEST_TURN_RATE = 1e3
"""Largest angular velocity of a body or camera [rad/s]. A higher angular velocity is refused as a jump."""
MOST_POSES = 500_000
"""Largest number of poses of a trajectory: 8 minutes at 1 kHz. Its splines take 1.7 kB for each pose."""
COLUMNS = 8
"""Number of columns of a table of poses: t, x, y, z, qx, qy, qz, qw."""


@guarded
@dataclass(frozen=True, eq=False)
class Trajectory:
    """Pose of a camera or a body over time, interpolated smoothly between given poses.

    With three or more poses the position follows a cubic spline and the orientation a spline with continuous angular
    acceleration; with two poses both change linearly. Before the first and after the last pose nothing moves. Raises
    :class:`AmiwarpError` if arrays have the wrong shape, if times do not increase, or if the trajectory jumps.

    Examples
    --------
    >>> import numpy as np
    >>> path = amiwarp.Trajectory([0.0, 1.0], [[0, 0, 0], [1, 0, 0]], [[0, 0, 0, 1], [0, 0, 0, 1]])
    >>> rotation, position = path.poses(np.array([0.25]))
    >>> position.tolist()
    [[0.25, 0.0, 0.0]]
    """

    t: ArrayLike
    """Times from the start of the recording [s], increasing, shape ``(n,)``."""
    position: ArrayLike
    """Positions in the world [m], shape ``(n, 3)``."""
    rotation: ArrayLike
    """Orientations as unit quaternions (x, y, z, w), shape ``(n, 4)``.

    A quaternion rotates from the frame of the camera or body to the world's frame.
    """

    def __post_init__(self) -> None:
        t = array(self.t, "trajectory's times").astype(np.float64)
        position = array(self.position, "trajectory's positions").astype(np.float64)
        rotation = array(self.rotation, "trajectory's orientations").astype(np.float64)
        if t.size > MOST_POSES:
            raise AmiwarpError(f"trajectory has {t.size} poses; give at most {MOST_POSES}, at a lower rate")
        if t.ndim != 1 or not t.size or position.shape != (t.size, 3) or rotation.shape != (t.size, 4):
            raise AmiwarpError(
                f"trajectory has times {t.shape}, positions {position.shape}, orientations {rotation.shape}; "
                "give shapes (n,), (n, 3) and (n, 4)"
            )
        if not all(np.isfinite(values).all() for values in (t, position, rotation)):
            raise AmiwarpError("trajectory holds values that are not finite; remove these poses")
        if not (np.diff(t) > 0).all():
            raise AmiwarpError("trajectory's times do not increase; sort the poses and remove duplicates")
        with np.errstate(over="ignore"):  # the length of huge values is infinite
            length = np.linalg.norm(rotation, axis=1, keepdims=True)
        off = np.abs(length - 1.0)
        if not (off < 0.01).all():
            raise AmiwarpError(
                f"trajectory has a quaternion of length {float(length[np.argmax(off), 0]):.3g}; give unit quaternions"
            )
        for name, values in (("t", t), ("position", position), ("rotation", rotation / length)):
            object.__setattr__(self, name, values)
        self._check_jumps()

    def _check_jumps(self) -> None:
        """Raise :class:`AmiwarpError` if the camera or body moves or turns too fast between two poses."""
        from scipy.spatial.transform import Rotation

        t, position = self._table()
        if t.size < 2:
            return
        step = np.diff(t)
        with np.errstate(over="ignore"):
            speed = np.linalg.norm(np.diff(position, axis=0), axis=1) / step
        orientation: Any = Rotation.from_quat(np.asarray(self.rotation, np.float64))
        rate = (orientation[:-1].inv() * orientation[1:]).magnitude() / step
        for what, found, limit, unit in (
            ("moves", speed, LARGEST_SPEED, "m/s"), ("turns", rate, LARGEST_TURN_RATE, "rad/s")
        ):  # fmt: skip
            if found.max() > limit:
                at = float(t[int(np.argmax(found))])
                raise AmiwarpError(
                    f"trajectory {what} at {found.max():.3g} {unit} after {at:.6g} s, faster than {limit:g} {unit}; "
                    "check the units of the times (s) and positions (m), or split the trajectory at the jump"
                )

    def _table(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return times [s] and positions [m] as arrays."""
        return np.asarray(self.t, np.float64), np.asarray(self.position, np.float64)

    @property
    def moves(self) -> bool:
        """Whether any two of the given poses differ."""
        position, rotation = np.asarray(self.position), np.asarray(self.rotation)
        return bool((position != position[0]).any() or (rotation != rotation[0]).any())

    @cached_property
    def _splines(self) -> tuple[Any, Any]:
        """Splines of the orientation and of the position over time [s]."""
        from scipy.interpolate import CubicSpline
        from scipy.spatial.transform import Rotation, RotationSpline

        at, position = self._table()
        orientation: Any = Rotation.from_quat(np.asarray(self.rotation, np.float64))
        return RotationSpline(at, orientation), CubicSpline(at, position)

    def poses(self, t: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the orientations and positions at given times.

        Parameters
        ----------
        t : array_like
            Times [s], shape ``(k,)``.

        Returns
        -------
        rotation : ndarray
            Rotation matrices from the frame of the camera or body to the world's frame, shape ``(k, 3, 3)``.
        position : ndarray
            Positions in the world [m], shape ``(k, 3)``.

        Raises
        ------
        AmiwarpError
            If the times are no one-dimensional array of numbers, or hold NaN.
        """
        from scipy.spatial.transform import Rotation, Slerp

        at, position = self._table()
        orientation: Any = Rotation.from_quat(np.asarray(self.rotation, np.float64))
        given = np.atleast_1d(np.asarray(array(t, "t"), np.float64))
        if given.ndim != 1 or np.isnan(given).any():
            what = "holds NaN" if given.ndim == 1 else f"has shape {given.shape}"
            raise AmiwarpError(f"t {what}; give times in seconds, shape (k,)")
        inside = np.clip(given, at[0], at[-1])
        if at.size == 1:
            ones = np.ones(inside.size)
            return np.repeat(orientation.as_matrix(), inside.size, axis=0), ones[:, None] * position
        if at.size == 2:
            along = (inside - at[0]) / (at[1] - at[0])
            between = position[0] + along[:, None] * (position[1] - position[0])
            return Slerp(at, orientation)(inside).as_matrix(), between
        turn, place = self._splines
        return turn(inside).as_matrix(), np.asarray(place(inside))

    @classmethod
    def still(
        cls, position: ArrayLike, *, look_at: ArrayLike | None = None, rotation: ArrayLike = (0, 0, 0, 1)
    ) -> Trajectory:
        """Return a trajectory that never moves.

        Parameters
        ----------
        position : array_like
            Position [m], shape ``(3,)``.
        look_at : array_like, optional
            Point in the world that the camera looks at [m], shape ``(3,)``. With it, ``rotation`` is ignored.
        rotation : array_like
            Orientation as a unit quaternion (x, y, z, w), from the frame of the camera or body to the world's frame.

        Returns
        -------
        Trajectory
            Trajectory with one pose for all times.
        """
        quaternion = rotation if look_at is None else looking_at(position, look_at).as_quat()
        return cls([0.0], array(position, "position")[None], array(quaternion, "rotation")[None])

    @classmethod
    def from_function(
        cls, pose: Callable[[float], tuple[Rotation, ArrayLike]], duration_s: float, *, rate_hz: float = 100.0
    ) -> Trajectory:
        """Return a trajectory sampled from a function of time.

        Parameters
        ----------
        pose : callable
            Function that returns the orientation (``scipy.spatial.transform.Rotation``) and the position [m] at a time
            [s].
        duration_s : float
            Length of the trajectory [s].
        rate_hz : float
            Number of samples per second.

        Returns
        -------
        Trajectory
            The sampled trajectory.
        """
        duration_s = real(duration_s, "duration_s", 1e-6, 1e6, " s")
        count = max(2, round(duration_s * real(rate_hz, "rate_hz", 1e-3, 1e6)) + 1)
        if count > MOST_POSES:
            raise AmiwarpError(f"trajectory has {count} poses; give at most {MOST_POSES}, by a smaller rate_hz")
        t = np.linspace(0.0, duration_s, count)
        poses = [pose(float(at)) for at in t]
        places = np.stack([np.asarray(place, np.float64) for _, place in poses])
        return cls(t, places, np.stack([turn.as_quat() for turn, _ in poses]))

    @classmethod
    def from_file(cls, path: str | Path) -> Trajectory:
        """Read a trajectory from a TUM or CSV file of poses.

        Parameters
        ----------
        path : str or Path
            Text file with the columns t [s], x, y, z [m], qx, qy, qz, qw, separated by spaces (TUM) or commas (CSV).
            The file may begin with a header line, and contain comments after ``#``.

        Returns
        -------
        Trajectory
            The poses. Times count from the first pose.

        Raises
        ------
        AmiwarpError
            If the file cannot be read, or is not a table of poses.
        """
        path = Path(path)
        values = plain_array("d")
        for number, line in text_lines(path):
            words = line.split("#")[0].replace(",", " ").split()
            if not words or (not values and words[0].lower() in ("t", "time", "timestamp", "t_s")):
                continue
            try:
                row = [float(word) for word in words]
            except ValueError as error:
                raise AmiwarpError(
                    f"{path}: line {number} is {line[:60]!r}; expected 8 numbers t x y z qx qy qz qw"
                ) from error
            if len(row) != COLUMNS:
                raise AmiwarpError(f"{path}: line {number} has {len(row)} numbers; expected 8: t x y z qx qy qz qw")
            if len(values) == COLUMNS * MOST_POSES:
                raise AmiwarpError(f"{path}: has over {MOST_POSES} poses; give fewer, at a lower rate")
            values.extend(row)
        if not values:
            raise AmiwarpError(f"{path}: holds no poses; expected lines of 8 numbers t x y z qx qy qz qw")
        table = np.frombuffer(values).reshape(-1, COLUMNS)
        with np.errstate(invalid="ignore", over="ignore"):  # refused below
            t = table[:, 0] - table[0, 0]
        try:
            return cls(t, table[:, 1:4], table[:, 4:])
        except AmiwarpError as error:
            raise AmiwarpError(f"{path}: {error}") from error

    def save_tum(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the poses to a TUM file: lines of t x y z qx qy qz qw, separated by spaces.

        Parameters
        ----------
        path : str or Path
            File to write, with the suffix .txt or .tum.
        overwrite : bool
            Whether to replace an existing file.
        """
        path = Path(path)
        check_ending(path, "poses are written", POSE_ENDINGS)
        table = np.column_stack([self.t, self.position, self.rotation])
        lines = [" ".join(repr(float(value)) for value in row) for row in table]
        write_text(path, "# t x y z qx qy qz qw\n" + "\n".join(lines) + "\n", overwrite=overwrite)


def looking_at(position: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Rotation:
    """Return the orientation of a camera at ``position`` [m] that looks at ``target`` [m].

    ``up``: direction in the world that appears upwards in the image.
    """
    from scipy.spatial.transform import Rotation

    for point in (array(position, "position"), array(target, "look_at")):
        if point.shape != (3,) or not (np.abs(point) <= 1e9).all():
            raise AmiwarpError(f"a point of a camera that looks at a place is {shown(point)}; give 3 numbers in m")
    forward = np.asarray(target, np.float64) - np.asarray(position, np.float64)
    distance = float(np.linalg.norm(forward))
    if not distance > 0.0:
        raise AmiwarpError("the camera looks at its own position; give a target at another position")
    forward /= distance
    right: Any = np.cross(forward, np.asarray(up, np.float64))
    if np.linalg.norm(right) < 1e-9:
        right = np.cross(forward, [0.0, 1.0, 0.0] if abs(forward[1]) < 0.9 else [1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    return Rotation.from_matrix(np.column_stack([right, down, forward]))


# Bodies with meshes and materials, lights and a sky.

MOST_INSTANCES = 65535
"""Largest number of instances of a world. Instance numbers are stored as uint16, and number 0 is the sky."""


@guarded
@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangle mesh.

    Raises :class:`AmiwarpError` if the mesh has no faces, or if a face refers to a vertex that does not exist.
    """

    vertices: ArrayLike
    """Vertices in the body's frame [m], shape ``(n, 3)``."""
    faces: ArrayLike
    """Indices of the vertices of each triangle, shape ``(m, 3)``, counter-clockwise as seen from outside."""
    uv: ArrayLike | None = None
    """Texture coordinates of each vertex, shape ``(n, 2)``.

    u points to the right in units of the texture's width, v points up in units of its height.
    """
    light: ArrayLike | None = None
    """Factor by which the reflectance is multiplied at each vertex, 0 to 1, shape ``(n,)``. None stands for 1."""

    def __post_init__(self) -> None:
        vertices = array(self.vertices, "mesh's vertices").astype(np.float64)
        faces = array(self.faces, "mesh's faces")
        if vertices.ndim != 2 or vertices.shape[1] != 3 or not np.isfinite(vertices).all():
            raise AmiwarpError(f"mesh's vertices have shape {vertices.shape}; give finite numbers of shape (n, 3)")
        if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
            raise AmiwarpError(f"mesh's faces have shape {faces.shape}; give at least one triangle, shape (m, 3)")
        if faces.dtype.kind not in "iu" or faces.min() < 0 or faces.max() >= len(vertices):
            raise AmiwarpError(f"mesh's faces refer to vertices outside of 0 .. {len(vertices) - 1}; check the indices")
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces.astype(np.int32))
        for name, shape in (("uv", (len(vertices), 2)), ("light", (len(vertices),))):
            if getattr(self, name) is not None:
                values = array(getattr(self, name), f"mesh's {name}").astype(np.float64)
                if values.shape != shape or not np.isfinite(values).all():
                    raise AmiwarpError(f"mesh's {name} has shape {values.shape}; give finite numbers of shape {shape}")
                if name == "light" and not 0.0 <= values.min() <= values.max() <= 1.0:
                    raise AmiwarpError(f"mesh's light is {values.min():g} .. {values.max():g}; give factors in 0 .. 1")
                object.__setattr__(self, name, values)

    @cached_property
    def bounding_sphere(self) -> tuple[NDArray[np.float64], float]:
        """Centre [m], shape ``(3,)``, and radius [m] of a sphere that contains all vertices."""
        vertices = np.asarray(self.vertices)
        centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
        return centre, float(np.linalg.norm(vertices - centre, axis=1).max())


@guarded
@dataclass(frozen=True, eq=False)
class Material:
    """Material of a surface that reflects light evenly in all directions (Lambert)."""

    reflectance: float = 0.5
    """Fraction of the incident light that the surface reflects, 0 to 1."""
    texture: NDArray[Any] | None = None
    """Factors by which the reflectance is multiplied, linear, shape (height, width).

    The texture repeats beyond the range 0 to 1 of ``Mesh.uv``. None stands for the factor 1.
    """
    emission: float = 0.0
    """Luminance that the surface emits, relative to a white surface in full light."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "reflectance", real(self.reflectance, "material reflectance", 0.0, 1.0))
        object.__setattr__(self, "emission", real(self.emission, "material emission", 0.0, 1e6))
        if self.texture is not None:
            with np.errstate(over="ignore"):  # infinity is refused
                texture = array(self.texture, "material texture").astype(np.float32)
            if texture.ndim != 2 or min(texture.shape) < 2 or not (np.isfinite(texture).all() and texture.min() >= 0):
                raise AmiwarpError(f"material texture has shape {texture.shape}; give values >= 0, (height, width)")
            object.__setattr__(self, "texture", texture)


@guarded
@dataclass(frozen=True, eq=False)
class Body:
    """Rigid body of a world."""

    name: str
    """Name of the body, unique in the world."""
    mesh: Mesh
    """Surface of the body, in the body's frame."""
    material: Material = field(default_factory=Material)
    """Material of the whole surface."""
    trajectory: Trajectory | None = None
    """Pose of the body's frame in the world over time. None for a body at rest whose frame is the world's."""
    category: str = ""
    """Class label, for example ``wall`` or ``person``."""
    instance: str | None = None
    """Instance label. Bodies with the same label count as one object. None stands for the body's name."""


@guarded
@dataclass(frozen=True, slots=True)
class Sun:
    """Distant light source, whose light comes from one direction everywhere."""

    direction: tuple[float, float, float]
    """Vector towards the sun in the world's frame. The length has no effect."""
    intensity: float = 0.6
    """Luminance that the sun gives to a white surface that faces the sun."""
    shadows: bool = True
    """Whether bodies cast shadows in this light."""

    def __post_init__(self) -> None:
        direction = vector(self.direction, 3, "sun direction", real)
        length = math.hypot(*direction)
        if not 0.0 < length < math.inf:
            raise AmiwarpError(f"sun direction has length {length:.3g}; give the direction towards the sun")
        object.__setattr__(self, "direction", tuple(float(x) / length for x in direction))
        object.__setattr__(self, "intensity", real(self.intensity, "sun intensity", 0.0, 1e6))


@guarded
@dataclass(frozen=True, slots=True)
class Lamp:
    """Point light source."""

    position: tuple[float, float, float]
    """Position in the world's frame [m]."""
    intensity: float = 1.0
    """Luminance that the lamp gives to a white surface that faces the lamp at a distance of 1 m."""
    flicker_hz: float = 0.0
    """Frequency of the flicker [1/s]; 0 for steady light.

    A lamp on alternating current flickers at twice the frequency of the current.
    """
    flicker_depth: float = 1.0
    """Amplitude of the flicker as a fraction of the intensity, 0 to 1."""
    shadows: bool = False
    """Whether bodies cast shadows in this light."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", tuple(float(x) for x in vector(self.position, 3, "lamp position", real)))
        for name, high in (("intensity", 1e6), ("flicker_hz", 1e4), ("flicker_depth", 1.0)):
            object.__setattr__(self, name, real(getattr(self, name), f"lamp {name}", 0.0, high))


@guarded
@dataclass(frozen=True, eq=False)
class Sky:
    """Background at infinity, which is seen where no body is."""

    luminance: float = 0.6
    """Luminance of an even sky, or factor by which the panorama is multiplied."""
    panorama: NDArray[Any] | None = None
    """Linear luminance in all directions, shape (height, width); None for an even sky.

    The picture is equirectangular with the elevation up: width and height cover 360 and 180 degrees, whatever their
    ratio. Its middle column shows the direction +x, its right half -y.
    """

    def __post_init__(self) -> None:
        object.__setattr__(self, "luminance", real(self.luminance, "sky luminance", 0.0, 1e6))
        if self.panorama is not None:
            with np.errstate(over="ignore"):  # infinity is refused
                panorama = array(self.panorama, "sky panorama").astype(np.float32)
            if (
                panorama.ndim != 2
                or min(panorama.shape) < 2
                or not (np.isfinite(panorama).all() and panorama.min() >= 0)
            ):
                raise AmiwarpError(f"sky panorama has shape {panorama.shape}; give values >= 0, (height, width)")
            object.__setattr__(self, "panorama", panorama)


@guarded
@dataclass(frozen=True, eq=False)
class World:
    """Three-dimensional scene: bodies, lights and a sky.

    The world's frame is right-handed, with z up and metres as unit.
    """

    name: str
    """Name of the world, used in messages and stored in recordings."""
    bodies: tuple[Body, ...]
    """All bodies of the world, at least one."""
    ambient: float = 0.4
    """Luminance of a white surface in the shade, where only ambient light falls."""
    sun: Sun | None = None
    """Distant light source; None for none."""
    lamps: tuple[Lamp, ...] = ()
    """Point light sources."""
    sky: Sky = field(default_factory=Sky)
    """Background at infinity."""
    joints: Mapping[str, Trajectory] = field(default_factory=dict)
    """Trajectories of named points, such as the joints of a figure."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "bodies", tuple(self.bodies))
        object.__setattr__(self, "lamps", tuple(self.lamps))
        object.__setattr__(self, "ambient", real(self.ambient, "world ambient", 0.0, 1e6))
        if not self.bodies:
            raise AmiwarpError(f"world {self.name!r} has no bodies; give at least one")
        for body in self.bodies:
            instance(body, Body, "world's body")
        names = [body.name for body in self.bodies]
        doubles = sorted({name for name in names if names.count(name) > 1}) if len(set(names)) < len(names) else []
        if doubles:
            raise AmiwarpError(f"world {self.name!r} has several bodies named {doubles[0]!r}; give unique names")
        if len(self.instances) > MOST_INSTANCES:
            raise AmiwarpError(f"world {self.name!r} has {len(self.instances)} instances; give up to {MOST_INSTANCES}")

    @property
    def instances(self) -> tuple[str, ...]:
        """Instance labels in the order of the bodies.

        The label at index i has the instance number i + 1; number 0 is the sky.
        """
        return tuple(dict.fromkeys(body.instance or body.name for body in self.bodies))

    @property
    def categories(self) -> tuple[str, ...]:
        """Class label of each instance, in the order of :attr:`instances`."""
        labels: dict[str, str] = {}
        for body in self.bodies:
            labels.setdefault(body.instance or body.name, body.category)
        return tuple(labels[name] for name in self.instances)

    @property
    def moving(self) -> tuple[Body, ...]:
        """Bodies whose pose changes over time."""
        return tuple(body for body in self.bodies if body.trajectory is not None and body.trajectory.moves)

    @property
    def triangles(self) -> int:
        """Number of triangles of all bodies."""
        return sum(len(np.asarray(body.mesh.faces)) for body in self.bodies)


# World and camera trajectory, as the scene of a simulation.

SAMPLES = (1, 4, 9, 16)
"""Allowed numbers of rays per pixel or per texel."""


@guarded
@dataclass(frozen=True, eq=False)
class WorldScene:
    """Scene of a simulation in which a camera moves through a world, as an alternative to :class:`amiwarp.Scene`."""

    world: World
    """World that the camera sees."""
    trajectory: Trajectory
    """Pose of the camera over time."""
    blur: float = BLUR_PX
    """Standard deviation of the optical blur, including the area of the pixel [px].

    The blur has no effect with ``seeing="rays"`` and ``samples=1``.
    """
    seeing: Seeing = Seeing.MAPS
    """Method by which the light that each pixel receives is computed."""
    samples: int | None = None
    """Number of rays: 1, 4, 9 or 16; None stands for 4.

    With maps, the rays of each texel at an edge; with rays, the rays of each pixel, which search the whole world only
    at edges.
    """
    motion_px: float = 0.5
    """Largest motion of the image between two successive maps [px], 0.01 to 2. Has no effect with rays."""

    def __post_init__(self) -> None:
        instance(self.world, World, "world scene's world")
        instance(self.trajectory, Trajectory, "world scene's trajectory")
        object.__setattr__(self, "blur", real(self.blur, "scene blur", 0.0, 20.0, " px"))
        object.__setattr__(self, "seeing", choice(Seeing, self.seeing, "seeing"))
        object.__setattr__(self, "motion_px", real(self.motion_px, "motion_px", 0.01, 2.0, " px"))
        if self.samples is not None:
            samples = whole(self.samples, "samples", SAMPLES[0], SAMPLES[-1])
            one_of(str(samples), [str(n) for n in SAMPLES], "samples")
            object.__setattr__(self, "samples", samples)
