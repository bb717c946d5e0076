"""Photometric fit of one prism to the events of all poses of a board."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.calib.photometric.cost import Cost
from amiwarp.calib.photometric.descent import Slopes
from amiwarp.calib.photometric.distances import FOLLOW_PX, displacements
from amiwarp.calib.photometric.equations import Equations
from amiwarp.lens.corner_fit import Fit
from amiwarp.lens.projection import Vector, lens_values, with_lens_values
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.comparison import rms
from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.prism import as_wedge
from amiwarp.results.calibration import Calibration
from amiwarp.results.parameters import ParameterSpace, nominal
from amiwarp.tasks import Result, in_order

FINE = 2.0
FINEST = 3.0
FINEST_STEPS = 2
"""Map nodes per pixel with the last lens, and those with which the last steps correct the orbits' size; number of these
steps. Maps are looked up bilinearly and so make small orbits too large: a radius of 3 px with one node per pixel by 0.4
%, one of 2.4 px with two, three and four nodes by 0.16, 0.028 and 0.003 %."""
BOARD_DAMPING = 0.00125
"""Damping of the fine maps. Most of a board is flat, so it gets no smaller damping for its contrast; the usual one, of
0.02, made orbits of 2.4 px too large by 0.1 %."""
MOST_STEPS = 10
TOLERANCE_PX = 0.004
LARGEST_GAIN = 5.0
"""Largest number of steps towards the prism; length of a step that ends them [px]; and the largest factor by which a
step is lengthened, because the weights of outliers make Gauss-Newton steps too short."""
PROBED = 3
PROBE_PX = 0.05
"""Every which pose tells how the gradient changes, and the step of the parameters that shows it [px]."""
SIZE_ERROR = 0.0056
SHAPE_ERROR = 0.2
"""Standard deviations of errors of the orbits' size and of their shape that all poses share [px], times the radius of
the orbits at the centre of the image [px], and times its cube. The share by which orbits come out too large or too
small falls about with the square of their radius: in 25 sets of poses each, a fisheye's orbits of 2.8 px at the centre
were too large by 0.0022 px rms, orbits of 4.7 px of another lens too small by 0.0011 px. In orbits of 5.4 px, indices
of 1.6 came out 0.01 too large."""
ALL_FREE = ("apex", "phase", "tilt_x", "tilt_y", "index")
"""Parameters of the prism that poses can determine together."""
TILTED = ALL_FREE[:4]
INDEX_STEP = 0.1
INDEX_STEPS = 4
"""Distance of the indices at which the cost is compared, and number of Gauss-Newton steps at each."""
PLACES = 63
"""Number of pixels at which displacements are compared."""
AT_ONCE = 2
"""Largest number of poses that are worked on at the same time on a CPU. More would take more memory."""


@dataclass(frozen=True, eq=False)
class Linearisation:
    """How the costs of all poses change with the parameters of a space."""

    space: ParameterSpace
    each: Sequence[Slopes]
    """Derivatives of the cost of each pose."""


@dataclass(frozen=True, eq=False)
class JointPrism:
    """Photometric fit of one prism to the events of all poses.

    It never changes: each step returns another fit. Only the brightness maps of the equations do, as starts of the next
    solution.
    """

    equations: Mapping[str, Equations]
    """Equations of the poses, by name."""
    full: ParameterSpace
    """Space of all parameters."""
    values: Mapping[str, float]
    """Values of all parameters."""
    inside: NDArray[np.bool_] | None = None
    """Pixels whose events are used, shape (height, width); all if None."""
    costs: Mapping[str, float] = field(default_factory=dict)
    """Cost of each pose in the last fit, relative to its cost without a map, by name."""
    longer: float = 1.0
    """Factor by which steps are lengthened, because the weights of outliers make them too short."""
    linear: Linearisation | None = None
    """How the costs change at these values; None if that was not found."""

    @classmethod
    def start(
        cls,
        equations: Mapping[str, Equations],
        full: ParameterSpace,
        values: Mapping[str, float],
    ) -> JointPrism:
        """Return the fit before the first step. Other values than the given ones are the start of the space."""
        return cls(equations, full, {**full.start, **values})

    def model(self, camera: Camera) -> ExactModel:
        """Return the optical model with the present values."""
        prism = as_wedge(self.full.prism)
        return ExactModel.from_values(camera, prism, self.values)

    def on(self, equations: Mapping[str, Equations], inside: NDArray[np.bool_]) -> JointPrism:
        """Return the fit to the equations of the events ``inside``.

        They are weighted alike in all poses, and their maps get little damping.
        """
        costs = [equations_of_pose.cost for equations_of_pose in equations.values()]
        usual = float(np.median([cost.scale for cost in costs]))
        for cost in costs:
            cost.set_scale(usual)
            cost.brightness.set_damping(BOARD_DAMPING)
        return replace(self, equations=equations, inside=inside)

    def without(self, poses: Collection[str]) -> JointPrism:
        """Return the fit to the other poses."""
        kept = {}
        for name, equations in self.equations.items():
            if name not in poses:
                kept[name] = equations
        return replace(self, equations=kept)

    def refine(
        self,
        camera: Camera,
        names: tuple[str, ...],
        most: int = MOST_STEPS,
        tolerance: float = TOLERANCE_PX,
        poses: Iterable[str] = (),
    ) -> JointPrism:
        """Return the fit of the parameters ``names`` after at most ``most`` steps from the present values.

        A step shorter than ``tolerance`` [px] ends the fit. Without names of ``poses`` all are used.
        """
        space = self._space(camera, names)
        costs = self._costs(space, poses)
        vector = space.to_vector(self.values)
        last: Vector | None = None
        gain = self.longer
        for _ in range(most):
            slopes = self._slopes(costs.values(), vector)
            step = _total(slopes).step()
            if last is not None:
                gain = _lengthened(gain, step, last)
            vector = vector + np.clip(gain * step, -1.0, 1.0)
            largest = gain * float(np.abs(step).max())
            if last is not None and largest < tolerance:
                break
            last = step
        return replace(
            self,
            values={**self.values, **space.to_values(vector)},
            costs={name: cost.mean() for name, cost in costs.items()},
            longer=gain,
            linear=None,
        )

    def with_size_corrected(self, camera: Camera) -> JointPrism:
        """Return the fit after the orbits' size, and the phase, were corrected with :data:`FINEST` maps.

        Poses whose events do not determine a fine map keep their coarse one.
        """
        equations = dict(self.equations)
        for name, coarse in self.equations.items():
            if coarse.cost.brightness.tiles.density == FINE:
                finest = coarse.at_density(FINEST)
                finest.cost.brightness.set_damping(BOARD_DAMPING)
                equations[name] = finest
        finer = replace(self, equations=equations)
        return finer.refine(camera, ("apex", "phase"), FINEST_STEPS, 0.0)

    def with_values(self, **values: float) -> JointPrism:
        """Return the fit with other values of some parameters."""
        return replace(self, values={**self.values, **values}, linear=None)

    def with_index(self, index: float) -> JointPrism:
        """Return the fit with another index of the prism, and an apex with which the orbit stays as large."""
        thinner = (self.values["index"] - 1.0) / (index - 1.0)
        return self.with_values(index=index, apex=thinner * self.values["apex"])

    def index(self, camera: Camera, names: Sequence[str]) -> tuple[float, float]:
        """Return the prism's index by some poses, and its standard deviation; infinity where they do not tell it.

        Apex and index trade against each other, but for a part of the orbit that grows with the angle of incidence. So
        the cost is compared at three indices, with apex and phase fitted at each from the same maps. The minimum of the
        parabola is the index, and its jackknife over the poses the deviation. The maps stay as they were.
        """
        costs = [self.equations[name].cost for name in names]
        maps = [cost.brightness.copy_unknowns() for cost in costs]
        middle = self.values["index"]
        rows = []
        probe = self
        for index in (middle - INDEX_STEP, middle, middle + INDEX_STEP):
            for cost, unknowns in zip(costs, maps, strict=True):
                cost.replace_map(unknowns)
                cost.replace_map(cost.brightness.copy_unknowns())
            probe = probe.with_values(**self.values).with_index(index)
            probe = probe.refine(camera, ("apex", "phase"), INDEX_STEPS, 0.0, names)
            rows.append(list(probe.costs.values()))
        for cost, unknowns in zip(costs, maps, strict=True):
            cost.replace_map(unknowns)

        # The parabola through the three costs of each pose.
        low, at_vector, high = np.array(rows)
        bend = low - 2.0 * at_vector + high
        slope = high - low
        if not bend.sum() > 0.0:
            return middle, math.inf
        # Minus twice the answer, in steps, of all poses, and without each of them.
        of_all = float(slope.sum() / bend.sum())
        without = (slope.sum() - slope) / (bend.sum() - bend)
        spread = math.sqrt((len(without) - 1) * float(np.var(without)))
        half_step = 0.5 * INDEX_STEP
        return middle - half_step * of_all, half_step * spread

    def _space(self, camera: Camera, names: tuple[str, ...]) -> ParameterSpace:
        """Return the space of the parameters ``names``, in which the others are held."""
        space = replace(self.full, camera=camera, names=names)
        return space.holding(self.values)

    def _costs(self, space: ParameterSpace, poses: Iterable[str] = ()) -> dict[str, Cost]:
        """Return the costs of some poses, or of all, by name, as functions of the parameters of a space."""
        costs = {}
        for name in poses or self.equations:
            costs[name] = self.equations[name].cost.in_space(space)
        return costs

    def _slopes(self, costs: Iterable[Cost], v: Vector) -> list[Slopes]:
        """Return the derivatives of the cost of each pose at a vector of parameters."""

        def slopes(cost: Cost) -> Slopes:
            cost.predict(v)
            cost.residuals(v, rounds=2)
            return cost.slopes(v, with_parts=True)

        costs = list(costs)
        jobs = [partial(slopes, cost) for cost in costs]
        return list(for_each_pose(jobs, costs[0].brightness.device))

    def linearised(self, camera: Camera, names: tuple[str, ...]) -> JointPrism:
        """Return the fit with how the costs of all poses change with the parameters ``names`` at its values."""
        longer = self._probed_factor(camera)
        space = self._space(camera, names)
        costs = self._costs(space)
        vector = space.to_vector(self.values)
        slopes_of_poses = self._slopes(costs.values(), vector)
        return replace(self, longer=longer, linear=Linearisation(space, slopes_of_poses))

    def _probed_factor(self, camera: Camera) -> float:
        """Return the factor by which steps are to be lengthened, from some of the poses, for size and phase.

        The weights of outliers change with the parameters. So the gradient at a board changes only a third as fast as
        the Gauss-Newton Hessian says.
        """
        space = self._space(camera, TILTED[:2])
        poses = list(self.equations)[::PROBED]
        some = self._costs(space, poses).values()
        vector = space.to_vector(self.values)
        total = _total(self._slopes(some, vector))
        changes = []
        for unit in np.eye(2):
            moved = _total(self._slopes(some, vector + PROBE_PX * unit))
            changes.append((moved.gradient - total.gradient) / PROBE_PX)
        hessian = np.stack(changes, axis=1)
        by_hessian, *_ = np.linalg.lstsq(total.hessian, hessian, rcond=None)
        shares = np.linalg.eigvals(by_hessian).real
        share = np.clip(shares.mean(), 1.0 / LARGEST_GAIN, 1.0)
        return 1.0 / float(share)

    def next_values(self) -> dict[str, float]:
        """Return the values to which the linearisation points."""
        assert self.linear is not None
        space = self.linear.space
        here = space.to_vector(self.values)
        step = self.longer * _total(self.linear.each).step()
        return space.to_values(here + step)

    def deviations(self, names: tuple[str, ...], fit: Fit) -> dict[str, float]:
        """Return the standard deviations of some parameters that are linearised, with the others held.

        They come from the scatter of the poses and within them, and from errors of the lens and of the orbits.
        """
        assert self.linear is not None
        numbers = [self.linear.space.names.index(name) for name in names]
        restricted = [slopes.restricted_to(numbers) for slopes in self.linear.each]
        within_poses = _total(restricted)
        gradients = np.stack([slopes.gradient for slopes in restricted], axis=1)
        between_poses = replace(within_poses, parts=gradients)
        scatter = within_poses.covariance() + between_poses.covariance()
        random = self.longer**2 * scatter

        space = replace(self.linear.space, names=names)
        vector = space.to_vector(self.values)
        systematic = self._systematic(space, vector, fit)
        return space.deviations(vector, random + systematic)

    def systematic_of_index(self, fit: Fit) -> float:
        """Return the standard deviation of the index that errors of the lens and of the orbits' shape cause."""
        names = ("apex", "phase", "index")
        space = self._space(fit.camera, names)
        vector = space.to_vector(self.values)
        systematic = self._systematic(space, vector, fit)
        return space.deviations(vector, systematic)["index"]

    def _systematic(self, space: ParameterSpace, vector: Vector, fit: Fit) -> Vector:
        """Return the covariance of the prism's parameters that errors of the lens and of the orbits cause [px²].

        The first two parameters are the orbits' size and phase. The others change the shape of the orbits only, and how
        it varies over the image.
        """
        by_prism, by_lens = self._moves(space, vector, fit)
        middle = np.array([[fit.camera.cx, fit.camera.cy]])
        model = space.build(space.to_values(vector))
        radius = rms(displacements([model], middle).reshape(-1, 2))

        # The prism follows an error of the lens, so that the orbits stay as they were seen.
        explained, *_ = np.linalg.lstsq(by_prism, by_lens, rcond=None)
        follows = -explained

        # Errors of the orbits' size move the first two parameters together.
        larger = np.zeros(len(vector))
        larger[0] = 1.0
        if space.cartesian:
            orbit = vector[:2]
            larger[:2] = orbit / np.linalg.norm(orbit)
        moved = _radius_px(by_prism @ larger)
        by_size = SIZE_ERROR / radius / moved * larger

        # Errors of their shape move each of the others by what no other parameter can explain.
        by_shape = np.zeros(len(vector))
        for k in range(2, len(vector)):
            others = np.delete(by_prism, k, axis=1)
            explained, *_ = np.linalg.lstsq(others, by_prism[:, k], rcond=None)
            unexplained = by_prism[:, k] - others @ explained
            by_shape[k] = SHAPE_ERROR / radius**3 / _radius_px(unexplained)
        of_lens = follows @ follows.T
        of_size = np.outer(by_size, by_size)
        of_shape = np.diag(by_shape**2)
        return np.asarray(of_lens + of_size + of_shape)

    def _moves(self, space: ParameterSpace, vector: Vector, fit: Fit) -> tuple[Vector, Vector]:
        """Return how displacements change with the prism's parameters, and by the errors of the lens.

        The first has the shape (displacements, parameters); the second a column for each axis of the lens's covariance.
        """
        inside = self.inside
        if inside is None:
            inside = np.ones((fit.camera.height, fit.camera.width), bool)
        xy = some_pixels(inside)
        values = space.to_values(vector)
        count = len(vector)
        steps, shares = fit.axes(xy)

        models = [space.build(values)]
        for unit in np.eye(count):
            moved_values = space.to_values(vector + FOLLOW_PX * unit)
            models.append(space.build(moved_values))
        for step in np.concatenate([steps, -steps]):
            camera = _with_other_lens(fit, step)
            models.append(replace(space, camera=camera).build(values))

        at_point, *ends = displacements(models, xy)
        with_other_prism = np.stack(ends[:count], axis=1)
        with_other_lens = np.stack(ends[count:], axis=1)
        by_prism = (with_other_prism - at_point[:, None]) / FOLLOW_PX
        there, back = np.split(with_other_lens, 2, axis=1)
        by_lens = (there - back) / (2.0 * shares)
        seen = np.isfinite(by_prism).all(axis=1) & np.isfinite(by_lens).all(axis=1)
        return by_prism[seen], by_lens[seen]

    def calibration(
        self,
        camera: Camera,
        uncertainty: Mapping[str, float],
        seconds: float,
    ) -> Calibration:
        """Return the result as a calibration of the prism with ``camera``."""
        search = next(iter(self.equations.values())).problem.sharp
        found = {name: value for name, value in self.values.items() if name in ALL_FREE}
        space = replace(self.full, camera=camera)
        return Calibration(
            model_name="exact",
            camera=camera,
            prism=nominal(space.prism),
            parameters=found,
            uncertainty=dict(uncertainty),
            free=tuple(uncertainty),
            sharpness_name=search.settings.sharpness.value,
            sharpness_before=search.fine.measure({**search.best, "apex": 0.0})[0],
            sharpness_after=search.sharpness_in(space, found),
            stages=(),
            events=len(search.calibration_events.events),
            seconds=seconds,
        )


def for_each_pose(jobs: Iterable[Callable[[], Result]], device: Any) -> Iterator[Result]:
    """Run the jobs of poses, and yield their results in order.

    On a CPU some run at the same time, as one alone leaves cores idle between its kernels. On a GPU they take turns, as
    its graphs cannot be recorded in several threads.
    """
    if not wp.get_device(device).is_cpu:
        yield from (job() for job in jobs)
        return
    with contextlib.closing(in_order(jobs, AT_ONCE, fill_cores=True)) as results:
        yield from results


def some_pixels(inside: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return :data:`PLACES` of the pixels that are marked in an image, evenly chosen, as x and y."""
    yx = np.argwhere(inside)
    chosen = np.linspace(0, len(yx) - 1, PLACES).astype(np.int64)
    return yx[chosen, ::-1]


def _with_other_lens(fit: Fit, step: Vector) -> Camera:
    """Return the camera of a fit with other values of the lens, by a step in the fit's parameters."""
    changes = dict(zip(fit.names, step.tolist(), strict=True))
    moved = {}
    for name, value in lens_values(fit.camera, fit.names).items():
        moved[name] = value + changes[name]
    return with_lens_values(fit.camera, moved)


def _radius_px(displaced: Vector) -> float:
    """Return the radius of orbits [px] from their displacements along x and y, one after the other."""
    return math.sqrt(2.0 * float(np.mean(displaced**2)))


def _lengthened(gain: float, step: Vector, last: Vector) -> float:
    """Return the factor of a step after the last one, which was lengthened by the factor ``gain``.

    The weights of outliers make steps too short, by the same factor: take their sum.
    """
    kept = float(step @ last) / max(float(last @ last), 1e-12)
    left = 1.0 - (1.0 - kept) / gain
    most_left = 1.0 - 1.0 / LARGEST_GAIN
    return 1.0 / (1.0 - min(max(left, 0.0), most_left))


def _total(slopes_of_poses: Sequence[Slopes]) -> Slopes:
    """Return the derivatives of the cost of several poses together."""
    return Slopes(
        np.sum([slopes.hessian for slopes in slopes_of_poses], axis=0),
        np.sum([slopes.gradient for slopes in slopes_of_poses], axis=0),
        np.concatenate([slopes.parts for slopes in slopes_of_poses], axis=1),
    )
