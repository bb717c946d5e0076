"""Rotation of a moving camera from its gyroscope: how the gyroscope's axes and clock lie to the camera's.

Events at the same angle of the prism form the same image one turn later, moved by the camera alone. Under the right
rotation from the gyroscope's axes to the camera's, the integrated rates undo that motion, and the images agree.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.axes import angle_between, axes_in_words, orientations
from amiwarp.events.encoder import Encoder
from amiwarp.events.other_sensors import ImuSamples
from amiwarp.events.recording import Recording
from amiwarp.optics.camera import Camera
from amiwarp.optics.rotation_path import RotationPath

if TYPE_CHECKING:
    Vector = NDArray[np.float64]

ANGLE_RANGES = 24
"""Number of ranges of prism angles per turn, each of which makes an image."""
MOST_PAIRS = 60
"""Largest number of pairs of images that are compared."""
COLUMNS = 80
"""Number of cells along the image's width in which events are counted."""
SMOOTHING = (1.5, 0.7)
"""Standard deviations of the Gaussians that smooth the images of the first and of the second search [cells]. In the
first, an unknown bias matters less; in the second, right axes stand out more."""
EVERY = 2
"""Every how many cells along each side one is compared."""
BEST = 3
"""Number of orientations of the gyroscope's axes from which the search starts."""
STEPS = np.array([0.15, 0.15, 0.15, 0.1, 0.1, 0.1, 5000.0])
"""First steps of the search: rotation of the axes [rad], bias [rad/s] and offset of the clock [us]."""
BIAS_ALONE = np.arange(3, 6)
AXES_AND_BIAS = np.arange(6)
BIAS_AND_OFFSET = np.arange(3, 7)
"""Entries of the search vector that vary."""
LARGEST_OFFSET_US = 30_000.0
"""Largest offset of the gyroscope's clock that is looked for [us]."""
LEAST_SAMPLES = 10
"""Smallest number of samples of a gyroscope that is used."""
LEAST_OFFSET_US = 10_000.0
LEAST_OFFSET_GAIN = 0.05
"""Smallest offset of its clock that is taken for one, and the increase of the correlation that it must bring. The
camera's translation alone seemed to shift the clock by 6 ms, and where the images hardly agree by any amount."""
LEAST_GAIN = 0.05
"""Smallest increase of this correlation over that without a rotation, and over other orientations of the axes."""
OTHER_RAD = math.radians(40.0)
"""Angle above which two orientations of the axes are different ones."""
LARGEST_TILT_RAD = math.radians(12.0)
LEAST_TILT_GAIN = 0.06
"""Angle beside the camera's axes, and increase of the correlation there, above which the axes count as tilted. The
camera's translation alone seemed to tilt them by 23 deg, and increased the correlation by 0.05; a tilt of 25 deg
increased it by 0.08 and 0.10."""


@dataclass(frozen=True, eq=False)
class Gyroscope:
    """A gyroscope whose axes and clock are known in the camera's frame."""

    imu: ImuSamples
    """Samples as they were recorded."""
    to_camera: NDArray[np.float64]
    """Rotation matrix from the gyroscope's axes to the camera's, shape (3, 3)."""
    offset_us: float
    """What is added to the times of its samples [us]."""
    found: bool
    """Whether the rotation was found in the events; else it was given."""
    agreement: float
    """Correlation of images one turn apart, with the camera's rotation undone."""
    still: float
    """The same without a rotation."""
    other: float
    """The best correlation with another orientation of the axes."""

    @property
    def span(self) -> tuple[int, int]:
        """First and last time [us] of its samples, on the clock of the events."""
        shift = round(self.offset_us)
        first = int(self.imu.t[0])
        last = int(self.imu.t[-1])
        return first + shift, last + shift

    def path(self, span: tuple[int, int]) -> RotationPath:
        """Return the camera's rotation over a time span [us], with the gyroscope's bias in it."""
        t = self.imu.t + round(self.offset_us)
        rates = self.imu.angular_velocity @ self.to_camera.T
        return RotationPath.from_rates(t, rates, span)

    def in_words(self) -> str:
        """Return how the axes and the clock lie, and how that is known."""
        how = "as found in the events" if self.found else "as given"
        clock = "; its clock was taken to be that of the events"
        if self.offset_us:
            clock = (
                f"; its clock was set {self.offset_us * 1e-3:+.1f} ms forward, as the events show"
            )
        axes = axes_in_words(self.to_camera)
        return (
            f"the camera's x, y, z are the gyroscope's {axes}, {how}: with its rotation undone, images one turn apart "
            f"correlate by {self.agreement:.2f}, without by {self.still:.2f}, with other axes by {self.other:.2f} at "
            f"most{clock}"
        )


def find_gyroscope(recording: Recording, encoder: Encoder, camera: Camera) -> Gyroscope:
    """Return the gyroscope of a recording in the camera's frame.

    Its axes are as given in the samples, else found in the events. The offset of its clock is found in the events.

    Raises
    ------
    AmiwarpError
        If it has no angular velocities, does not cover two turns, or does not explain how the images move.
    """
    imu = recording.imu
    name = recording.name
    if imu is None or len(imu) < LEAST_SAMPLES or not np.isfinite(imu.angular_velocity).all():
        raise AmiwarpError(
            f"{name}: the recording has no angular velocities of a gyroscope",
            ErrorCode.CONTENT_MISSING,
        )
    pairs = ImagePairs(recording, encoder, camera, imu)
    coarse, fine = map(pairs.smoothed, SMOOTHING)
    # Known axes and the best others, or the best of all.
    known = imu.to_camera
    others = orientations()
    if known is not None:
        others = [rotation for rotation in others if angle_between(rotation, known) > OTHER_RAD]
    first = [coarse.agreement(rotation, np.zeros(7)) for rotation in others]
    best_first = np.argsort(first, kind="stable")[::-1]
    tried = [others[k] for k in best_first[:BEST]]
    if known is not None:
        tried = [known, *tried[:1]]
    runs = []
    for rotation in tried:
        rough = coarse.search(rotation, BIAS_ALONE)
        runs.append(fine.search(rotation, BIAS_ALONE, rough.v))
    best = runs[0]
    if known is None:
        best = max(runs, key=lambda run: run.agreement)
    other = max(run.agreement for run in runs if run is not best)
    still = fine.agreement(np.eye(3), np.zeros(7), turns=False)
    compared = f"images one turn apart correlate by {best.agreement:.2f}"
    if best.agreement < still + LEAST_GAIN:
        raise AmiwarpError(
            f"{name}: the gyroscope does not explain how the image moves: {compared} with its rotation undone, by "
            f"{still:.2f} without; check its clock and, if they are given, its axes (--imu-rotation)",
            ErrorCode.CALIBRATION_REFUSED,
        )
    if known is None and best.agreement < other + LEAST_GAIN:
        raise AmiwarpError(
            f"{name}: the events do not tell how the gyroscope's axes lie: {compared} with the best orientation, and "
            f"by {other:.2f} with another one; give the right one (--imu-rotation), which a recording with more "
            "rotation, far from near things, tells",
            ErrorCode.CALIBRATION_REFUSED,
        )
    if known is not None and other > best.agreement + LEAST_GAIN:
        best_other = max(runs[1:], key=lambda run: run.agreement)
        there = axes_in_words(best_other.to_camera)
        raise AmiwarpError(
            f"{name}: the gyroscope's axes seem not to lie as given: {compared}, and by {other:.2f} if the camera's x, "
            f"y, z are its {there}; check --imu-rotation",
            ErrorCode.CALIBRATION_REFUSED,
        )
    if known is None:
        tilted = fine.search(best.to_camera, AXES_AND_BIAS, best.v)
        off = angle_between(tilted.to_camera, best.to_camera)
        if off > LARGEST_TILT_RAD and tilted.agreement > best.agreement + LEAST_TILT_GAIN:
            raise AmiwarpError(
                f"{name}: the gyroscope's axes seem to lie {math.degrees(off):.0f} deg beside the camera's, which the "
                "events do not tell well enough; give their rotation (--imu-rotation)",
                ErrorCode.CALIBRATION_REFUSED,
            )
    late = fine.search(best.to_camera, BIAS_AND_OFFSET, best.v)
    late_us = float(late.v[6])
    is_notable = LEAST_OFFSET_US < abs(late_us) < LARGEST_OFFSET_US
    is_better = late.agreement > best.agreement + LEAST_OFFSET_GAIN
    return Gyroscope(
        imu=imu,
        to_camera=best.to_camera,
        offset_us=late_us if is_notable and is_better else 0.0,
        found=known is None,
        agreement=best.agreement,
        still=still,
        other=other,
    )


@dataclass(frozen=True, eq=False)
class Alignment:
    """Result of a search for the gyroscope's axes and clock."""

    agreement: float
    """Correlation of the images."""
    to_camera: NDArray[np.float64]
    """Rotation matrix from the gyroscope's axes to the camera's, shape (3, 3)."""
    v: NDArray[np.float64]
    """Search vector, see :class:`ImagePairs`, shape (7,)."""


def _range_edges(encoder: Encoder, first: int, last: int) -> NDArray[np.int64]:
    """Return the times [us] between ranges of angles of the optic, for whole ranges from ``first`` on."""
    samples = max(2, (last - first) // 500)
    sample_times = np.linspace(first, last, samples)
    turned = np.abs(
        encoder.angle_at(sample_times.astype(np.int64)) - float(encoder.angle_at(first))
    )
    ranges = np.maximum.accumulate(turned) * (ANGLE_RANGES / math.tau)
    count = int(ranges[-1])
    return np.interp(np.arange(count + 1), ranges, sample_times).astype(np.int64)


class ImagePairs:
    """Pairs of images of events at the same angle of the prism, one turn apart, and the gyroscope's rotation between.

    A search vector has a small rotation of the axes [rad], a bias in the camera's frame [rad/s], and the clock's
    offset [us].
    """

    def __init__(
        self,
        recording: Recording,
        encoder: Encoder,
        camera: Camera,
        imu: ImuSamples,
    ) -> None:
        margin = round(LARGEST_OFFSET_US)
        first_covered, last_covered = encoder.coverage
        first = max(recording.events.t_first, first_covered, int(imu.t[0]) + margin)
        last = min(recording.events.t_last, last_covered, int(imu.t[-1]) - margin)
        edges = _range_edges(encoder, first, last)
        count = len(edges) - 1
        if last <= first or count < ANGLE_RANGES + 1:
            raise AmiwarpError(
                f"{recording.name}: the gyroscope and the encoder together cover less than a turn",
                ErrorCode.CALIBRATION_REFUSED,
            )
        self._camera = camera
        self._side = max(2, round(camera.width / COLUMNS))
        rows = math.ceil(camera.height / self._side)
        columns = math.ceil(camera.width / self._side)

        def image(k: int) -> Vector:
            """Return ON minus OFF events in each cell, of one range of angles."""
            events = recording.events.between(int(edges[k]), int(edges[k + 1]))
            row = (events.y // self._side).astype(np.int64)
            column = events.x // self._side
            signs = 2.0 * events.p - 1.0
            counts = np.bincount(row * columns + column, weights=signs, minlength=rows * columns)
            return np.asarray(counts.reshape(rows, columns), np.float64)

        last_pair = count - ANGLE_RANGES - 1
        pairs = np.unique(np.linspace(0, last_pair, MOST_PAIRS).astype(int))
        self._before = np.stack([image(k) for k in pairs])
        self._after = np.stack([image(k + ANGLE_RANGES) for k in pairs])
        middles = 0.5 * (edges[1:] + edges[:-1])
        self._from = middles[pairs]
        self._to = middles[pairs + ANGLE_RANGES]

        # Some of the cells, and their rays.
        y, x = np.mgrid[:rows:EVERY, :columns:EVERY]
        self._cells = np.stack([x.ravel(), y.ravel()], axis=1)
        pixels = (self._cells + 0.5) * self._side - 0.5
        self._rays = np.asarray(camera.pixels_to_rays(pixels.astype(np.float32)), np.float64)
        span = (first - margin, last + margin)
        self._path = RotationPath.from_rates(imu.t, imu.angular_velocity, span)

    def smoothed(self, deviation: float) -> ImagePairs:
        """Return the pairs with images smoothed by a Gaussian of this standard deviation [cells]."""
        from scipy.ndimage import gaussian_filter

        deviations = (0.0, deviation, deviation)
        smooth = copy(self)
        smooth._before = gaussian_filter(self._before, deviations)
        smooth._after = gaussian_filter(self._after, deviations)
        return smooth

    def agreement(self, to_camera: Vector, v: Vector, *, turns: bool = True) -> float:
        """Return the correlation of the images with the camera's rotation undone, or as they are without ``turns``."""
        from scipy.ndimage import map_coordinates
        from scipy.spatial.transform import Rotation

        pairs = len(self._from)
        turned = np.zeros((pairs, 3))
        if turns:
            axes = Rotation.from_rotvec(v[:3]).as_matrix() @ to_camera
            before = self._path.orientations(np.rint(self._from - v[6]))
            after = self._path.orientations(np.rint(self._to - v[6]))
            seconds = (self._to - self._from)[:, None] * 1e-6
            turned = (before.inv() * after).as_rotvec() @ axes.T + v[3:6] * seconds
        # a static point moves against the camera's rotation
        rotations = Rotation.from_rotvec(-turned).as_matrix()
        rays = np.einsum("pij,cj->pci", rotations, self._rays)
        moved = self._camera.rays_to_pixels(rays.reshape(-1, 3).astype(np.float32))
        pixels = np.asarray(moved, np.float64)
        cells = (pixels + 0.5) / self._side - 0.5
        places = cells.reshape(pairs, -1, 2)
        inside = np.asarray(np.isfinite(places).all(axis=2))
        places = np.where(inside[:, :, None], places, -1e3)

        row = places[..., 1]
        column = places[..., 0]
        number = np.broadcast_to(np.arange(pairs)[:, None], inside.shape)
        after_there = map_coordinates(self._after, [number, row, column], order=1, mode="constant")
        before_here = self._before[:, self._cells[:, 1], self._cells[:, 0]]
        energy = float((before_here**2).sum()) * float((after_there**2).sum())
        product = float((before_here * after_there).sum())
        return product / math.sqrt(max(energy, 1e-30))

    def search(
        self, to_camera: Vector, free: NDArray[np.int_], start: Vector | None = None
    ) -> Alignment:
        """Return the best alignment near an orientation of the axes.

        ``free`` lists the entries of the search vector that vary; the others stay as in ``start``, by default 0.
        """
        from scipy.optimize import minimize
        from scipy.spatial.transform import Rotation

        begin = np.zeros(7) if start is None else start

        def whole(part: Vector) -> Vector:
            v = begin.copy()
            v[free] += part * STEPS[free]
            v[6] = min(max(v[6], -LARGEST_OFFSET_US), LARGEST_OFFSET_US)
            return v

        def disagreement(part: Vector) -> float:
            return -self.agreement(to_camera, whole(part))

        origin = np.zeros(len(free))
        simplex = np.vstack([origin, np.eye(len(free))])
        options: Any = {
            "initial_simplex": simplex,
            "xatol": 0.02,
            "fatol": 3e-4,
            "maxfev": 60 * len(free),
        }
        run = minimize(disagreement, origin, method="Nelder-Mead", options=options)
        v = whole(run.x)
        axes = Rotation.from_rotvec(v[:3]).as_matrix() @ to_camera
        return Alignment(-float(run.fun), axes, v)
