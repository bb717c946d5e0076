"""Calibration of a lens from recordings of a board that stands still: prism, pictures, corners, lens, and again.

The prism is found first with a rough lens, by sharpness and then photometrically from all poses together. With it, each
pose gives a picture of the board, and the pictures' corners the lens. As compensation itself uses the lens, pictures
and corners are made again until the lens no longer changes them. The orbit has f·δ pixels, so focal length and
deflection cannot be told apart in one recording: the board's known size separates them.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.calib.calibration import prepare
from amiwarp.calib.parameters import ParameterSpace, like_size, nominal
from amiwarp.calib.photometric.cost import Cost
from amiwarp.calib.photometric.descent import Slopes
from amiwarp.calib.photometric.distances import FOLLOW_PX, displacements, over_a_turn
from amiwarp.calib.photometric.equations import Equations, Problem, collect_equations
from amiwarp.calib.photometric.limits import LARGEST_COST
from amiwarp.calib.result import Calibration
from amiwarp.calib.settings import PhotometricSettings, Settings
from amiwarp.calib.sharpness_search import Search
from amiwarp.calib.start_burst import without_start_burst
from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import MemoryEvents, Recording
from amiwarp.lens.board import Board, Corners, opencv
from amiwarp.lens.corner_fit import STEEP, Fit, fit_lens, lens_values, match_corners, tilt_of, with_lens_values
from amiwarp.lens.poses import Pose, still_poses
from amiwarp.optics.camera import Camera, Fisheye
from amiwarp.optics.models import ExactModel, rms
from amiwarp.optics.prism import Prism, as_wedge
from amiwarp.reconstruction.picture import Reconstruction
from amiwarp.tasks import Progress, Result, in_order, silent
from amiwarp.validation import array, finite, guarded, instance, real

Vector = NDArray[np.float64]

USUAL_FOV = math.radians(60.0)
"""Horizontal field of view that is assumed if none is known [rad]."""
LEAST_POSES, GOOD_POSES = 4, 12
"""Smallest number of poses for a calibration, and the number that suffices for a good one."""
SMOOTHNESS = 0.02
"""Weight of the pictures' smoothness prior. Choosing it for each picture takes as long as the picture; the corners'
errors change by a tenth between 0.02 and 0.1."""
PICTURE_TURNS = 1.25
"""Length of the events that make a picture [turns]. After a turn, pixels fire where they fired at the start, and so
compare the brightness with that at the start. With one turn, corners of a board in orbits of 2.4 px were off by 0.027
px, in a direction that turns with the prism's angle at the start; with 1.25 turns by 0.011 px."""
FIRST_POSES = 6
"""Number of poses that give the first prism and lens, with which the pictures of all poses are made."""
MOST_PASSES, ENOUGH_PX = 4, 0.08
"""Largest number of times that the pictures are made, and the change of the compensation by a new lens from which on
they are made again [px rms]. A change of 0.36 px moved the principal point by 1.5 px."""
SIZES = (0.6, 1.6)
"""Range of the prism's size that is searched, as a multiple of a nominal one. The rough lens may be wrong by 20 % and
the nominal prism by 20 %. A wider range lets an orbit as large as a square of the board match another square."""
SEARCHED = 3
"""Number of poses in which the prism is searched by sharpness. Each answer is tried on the others."""
PAIRS, FINE_PAIRS = 600_000, 1_200_000
"""Number of pairs of events of all poses together, and at most a sixth of it in one pose: at first, and with the last
lens, when maps have several nodes per pixel."""
FINE, FINEST, FINEST_STEPS = 2.0, 3.0, 2
"""Map nodes per pixel with the last lens, and those with which the last steps correct the orbits' size; number of these
steps. Maps are looked up bilinearly and so make small orbits too large: a radius of 3 px with one node per pixel by 0.4
%, one of 2.4 px with two, three and four nodes by 0.16, 0.028 and 0.003 %."""
BOARD_DAMPING = 0.00125
"""Damping of the fine maps. Most of a board is flat, so it gets no smaller damping for its contrast; the usual one, of
0.02, made orbits of 2.4 px too large by 0.1 %."""
STEEPEST = math.radians(45.0)
"""Largest angle from the optical axis of the events that are used with the rough lens [rad]. Farther out, orbits grow
so fast with the angle that a wrong focal length gives a wrong prism."""
FIRST_TOLERANCE_PX = 0.01
"""Length of a step that ends the search for the prism with a lens that is not the last one [px]."""
MOST_STEPS, TOLERANCE_PX, LARGEST_GAIN = 10, 0.004, 5.0
"""Largest number of steps towards the prism; length of a step that ends them [px]; and the largest factor by which a
step is lengthened, because the weights of outliers make Gauss-Newton steps too short."""
PROBED, PROBE_PX = 3, 0.05
"""Every which pose tells how the gradient changes, and the step of the parameters that shows it [px]."""
BAD_COST = 1.6
"""A pose is left out if its photometric cost exceeds this multiple of the median of all poses. Still poses reached 1.3
times the median; one with the prism's zero off by 10 deg had 2.4, and boards that moved by 0.9 and 2.6 px in a turn had
1.9 and 2.5 times the median."""
BAD_POSE, LEAST_BAD_PX = 3.0, 0.3
"""A pose is left out if its corners miss by this multiple of the median of all poses, and by this much [px rms]."""
CERTAIN, DOUBTFUL = 4.0, 1.5
"""Ratio of a parameter's distance from its nominal value to its standard deviation from which on it is believed; and of
the index from which on a third of the poses let all of them be asked."""
LARGEST_DEVIATION = {"index": 0.02, "tilt": math.radians(0.5)}
"""Standard deviation above which an index or a tilt [rad] counts as not determined."""
SIZE_ERROR, SHAPE_ERROR = 0.0056, 0.2
"""Standard deviations of errors of the orbits' size and of their shape that all poses share [px], times the radius of
the orbits at the centre of the image [px], and times its cube. The share by which orbits come out too large or too
small falls about with the square of their radius: in 25 sets of poses each, a fisheye's orbits of 2.8 px at the centre
were too large by 0.0022 px rms, those of 4.7 px of another lens too small by 0.0011 px. In orbits of 5.4 px, indices of
1.6 came out 0.01 too large."""
SHARED_FOCAL, SHARED_CENTRE_PX = 0.00011, 0.04
"""Standard deviations of errors that the pictures of a set share, so that leaving out a pose does not show them: of the
focal length, as a share, and of each coordinate of the principal point [px]. The first makes the errors of 50 sets of
poses of two lenses as likely as possible, and 50 others give the same; the second was found from 175 sets."""
REGIONS = (("upper", "middle", "lower"), ("left", "centre", "right"))
"""Names of the nine regions of the image in which corners are counted."""
TWO_BOARDS = "two boards are seen; leave one of them in the picture"


@guarded
@dataclass(frozen=True, eq=False)
class BoardPose:
    """One pose of the board, and how well the calibrated lens explains it."""

    name: str
    """Recording, with the time span if it has several."""
    corners: Corners
    """Corners in the picture [px]."""
    residuals: NDArray[np.float64]
    """Predicted minus seen position of each corner [px], shape ``(n, 2)``."""
    rotation: NDArray[np.float64]
    """Rotation vector from the board's frame to the camera's [rad], shape ``(3,)``."""
    translation: NDArray[np.float64]
    """Position of the board's first inner corner in the camera's frame [m], shape ``(3,)``."""
    picture: NDArray[np.uint8]
    """Picture in which the corners were found, shape ``(height, width)``."""

    def __post_init__(self) -> None:
        shape = array(self.residuals, "pose's residuals").shape
        if shape != self.corners.xy.shape:
            raise AmiwarpError(f"pose's residuals have shape {shape}; give {self.corners.xy.shape}, as its corners")
        for name in ("residuals", "rotation", "translation"):
            finite(array(getattr(self, name), f"pose's {name}"), f"pose's {name}")

    @property
    def rms(self) -> float:
        """Distance of predicted and seen corners [px rms]."""
        return rms(self.residuals)


@guarded
@dataclass(frozen=True, eq=False)
class LensCalibration:
    """Calibrated lens and prism, with the evidence."""

    camera: Camera
    """The camera."""
    uncertainty: Mapping[str, float]
    """Standard deviations of the free parameters of the camera by name: px for fx, fy, cx and cy."""
    prism: Calibration
    """Calibration of the prism with this camera, for ``compensate`` and all else."""
    poses: tuple[BoardPose, ...]
    """Poses that the lens was fitted to."""
    left_out: Mapping[str, str]
    """Reason by name of each pose that was left out."""
    notes: tuple[str, ...]
    """What the recordings do not determine, and events that were left out, one sentence each."""
    advice: tuple[str, ...]
    """What would improve the calibration most, one sentence each; the most helpful first."""
    seconds: float
    """Computing time [s]."""

    def __post_init__(self) -> None:
        if not self.poses:
            raise AmiwarpError("a lens calibration has no poses; give those of the fit")
        for pose in self.poses:
            instance(pose, BoardPose, "lens calibration's pose")
        real(self.seconds, "lens calibration's seconds")

    @property
    def rms(self) -> float:
        """Distance of predicted and seen corners over all poses [px rms]."""
        return rms(np.concatenate([pose.residuals for pose in self.poses]))

    @property
    def coverage(self) -> NDArray[np.int64]:
        """Number of corners in each of the nine regions of the image, shape ``(3, 3)``."""
        return coverage_of([pose.corners for pose in self.poses], self.camera.width, self.camera.height)


def coverage_of(seen: Sequence[Corners], width: int, height: int) -> NDArray[np.int64]:
    """Return the number of corners in each third of the image's rows and columns, shape (3, 3)."""
    xy = np.concatenate([corners.xy for corners in seen])
    ranges = [[-0.5, height - 0.5], [-0.5, width - 0.5]]
    return np.histogram2d(xy[:, 1], xy[:, 0], bins=3, range=ranges)[0].astype(np.int64)


@guarded
def calibrate_lens(
    recordings: Recording | Sequence[Recording],
    board: Board,
    *,
    fov: float | None = None,
    fisheye: bool = False,
    device: Any = "cpu",
    progress: Progress | None = None,
) -> LensCalibration:
    """Calibrate a camera's lens, and the prism with it, from recordings of a board that stands still.

    Parameters
    ----------
    recordings : Recording or sequence of Recording
        One recording per pose of the board, or recordings in which the board is moved and held still in turn, all with
        the same camera, prism and encoder. A prism that a recording names serves as a start and gives the index.
    board : Board
        The board.
    fov : float, optional
        Rough horizontal field of view [rad], right within 20 %; by default that of the recordings' camera, else 60 deg.
    fisheye : bool, optional
        Whether to fit OpenCV's fisheye model instead of the radial-tangential one.
    device : str or warp.Device, optional
        Device to compute on.
    progress : Progress, optional
        Called with the current step and the finished share.

    Returns
    -------
    LensCalibration
        Camera, prism, poses, and what is missing.

    Raises
    ------
    AmiwarpError
        If fewer than four poses show the board, the board has another size or is mirrored, two boards are seen, or the
        poses do not determine the focal length.

    Notes
    -----
    The corners' fit is Zhang's (2000) with the lens models of OpenCV. ``docs/how-to/lens.md`` describes the steps and
    gives measured errors.

    Examples
    --------
    >>> board = amiwarp.Board(9, 6, 0.03)
    >>> amiwarp.calibrate_lens([], board)
    Traceback (most recent call last):
    ...
    amiwarp.errors.AmiwarpError: no recordings are given; give at least one
    """
    given = [recordings] if isinstance(recordings, Recording) else list(recordings)
    instance(board, Board, "board")
    for recording in given:
        instance(recording, Recording, "recording")
    if not given:
        raise AmiwarpError("no recordings are given; give at least one")
    sizes = {recording.events.size for recording in given}
    if len(sizes) > 1:
        raise AmiwarpError(f"the recordings have sensors of {sorted(sizes)} px; give recordings of one camera")
    camera = first_camera(given[0].events.size, given[0].camera, fov, fisheye=fisheye)
    notes = list[str]()
    for k, recording in enumerate(given):
        given[k], warnings = without_start_burst(recording)
        notes += [f"{recording.name}: {text}" for text in warnings]
    poses, reasons = still_poses(given)
    found = LensWork(board, camera, poses, device, progress or silent, reasons).run()
    return replace(found, notes=(*found.notes, *notes))


def first_camera(size: tuple[int, int], known: Camera | None, fov: float | None, *, fisheye: bool) -> Camera:
    """Return the camera to start with: without distortion, its principal point in the middle.

    Without ``fov``, its field of view is that of the camera ``known``, else :data:`USUAL_FOV`.
    """
    width, height = size
    if fov is None:
        fov = USUAL_FOV if known is None else 2.0 * math.atan(0.5 * width / known.fx)
        if known is not None and isinstance(known.distortion, Fisheye):
            fov = width / known.fx
    fov = real(fov, "fov", math.radians(1.0), math.radians(200.0 if fisheye else 150.0), " rad")
    if not fisheye:
        return Camera.from_fov(width, height, fov)
    focal = width / fov  # of an equidistant lens
    return Camera(width, height, focal, focal, (width - 1) / 2.0, (height - 1) / 2.0, Fisheye())


@dataclass(frozen=True, eq=False)
class Sight:
    """What is seen with a prism and a lens, and the lens that it determines."""

    pictures: dict[str, NDArray[np.uint8]]
    """Pictures by name of the pose, each of shape (height, width)."""
    corners: dict[str, Corners]
    """Corners by name of each pose of the fit."""
    fit: Fit
    """Lens and poses."""


@dataclass
class LensWork:
    """Steps of a lens calibration, to be read from top to bottom."""

    board: Board
    camera: Camera
    """Camera, rough at first."""
    poses: list[Pose]
    device: Any
    progress: Progress
    left_out: dict[str, str] = field(default_factory=dict)
    """Reason by name of each pose that was left out."""
    inside: NDArray[np.bool_] = field(init=False)
    """Pixels whose events determine the prism, those for which the lens is known; shape (height, width)."""

    def __post_init__(self) -> None:
        self.inside = self._before_the_lens()

    def run(self) -> LensCalibration:
        """Calibrate; raise :class:`AmiwarpError` as :func:`calibrate_lens` does."""
        began = time.perf_counter()
        self._check_count(len(self.poses), "given")
        values = self._first_prism()
        everyone = [pose.name for pose in self.poses]
        first = _some(everyone)
        equations = self._equations(first, values, 0)
        if len(equations) < LEAST_POSES:
            equations |= self._equations([name for name in everyone if name not in first], values, 0)
        self._check_count(len(equations), "with enough events")
        joint = JointPrism(equations, self.full, values)
        shown, sight = joint.model(self.camera, values), None
        for k in range(MOST_PASSES + 1):
            self.progress("prism", (k + 0.1) / (MOST_PASSES + 1))
            if sight is not None and k == 2:  # the first lens was that of some of the poses
                self.inside = self._between(sight.corners)
                equations = self._equations(everyone, joint.values, k, fine=True)
                self._check_count(len(equations), "with enough events")
                joint.use(equations, self.inside)
            values = joint.refine(
                self.camera, ("apex", "phase"), tolerance=TOLERANCE_PX if k > 1 else FIRST_TOLERANCE_PX
            )
            bad = self._drop_unexplained(joint) if k > 1 else []  # the first lenses explain no pose well
            model = joint.model(self.camera, values)
            if k == MOST_PASSES or (k > 1 and not bad and self._change(shown, model) < ENOUGH_PX):
                break
            everyone = [name for name in everyone if name not in bad]
            shown, names = model, [name for name in everyone if k == 1 or name not in self.left_out]
            first = names if k else _some(names)
            pictures = self.pictures(model, first, k, turns=PICTURE_TURNS if k else 0.5)
            try:
                sight = self._lens(pictures, matched=k > 0)
            except AmiwarpError:  # the first poses alone do not suffice
                rest = [name for name in names if name not in first]
                if not rest:
                    raise
                pictures |= self.pictures(model, rest, k, turns=0.5)
                sight = self._lens(pictures, matched=k > 0)
            self._use_lens(joint, sight)
        assert sight is not None
        sight, values, uncertainty, notes = self._whole_prism(joint, sight)
        fit = sight.fit
        for name, corners in sight.corners.items():
            if self.board.has_another(sight.pictures[name], corners):
                raise AmiwarpError(f"{name}: {TWO_BOARDS}")
        used = [
            BoardPose(n, c, r, v[:3], v[3:], sight.pictures[n])
            for (n, c), r, v in zip(sight.corners.items(), fit.residuals, fit.poses, strict=True)
        ]
        if fit.left_out:
            notes = (f"the corners do not determine {', '.join(fit.left_out)}, which stay 0", *notes)
        seconds = time.perf_counter() - began
        prism = joint.calibration(self.camera, values, uncertainty, seconds)
        return LensCalibration(
            fit.camera, fit.deviations, prism, tuple(used), self.left_out, notes, advice_on(used, fit), seconds
        )

    def _check_count(self, count: int, what: str) -> None:
        if count < LEAST_POSES:
            reasons = "".join(f"; {name}: {why}" for name, why in self.left_out.items())
            raise AmiwarpError(
                f"a lens needs {LEAST_POSES} poses of the board or more, better {GOOD_POSES}, tilted in different "
                f"directions; {what}: {count}{reasons}"
            )

    def _first_prism(self) -> dict[str, float]:
        """Return the prism's parameters by sharpness: the answer of one pose that is best for all poses searched."""
        chosen = self.poses[:: max(1, len(self.poses) // SEARCHED)][:SEARCHED]
        searches = [search for _, search in self.searches(chosen, ("apex", "phase"), {})]
        for k, search in enumerate(searches):
            self.progress("search", 0.1 * k / len(searches) / (MOST_PASSES + 1))
            search.run()
        answers = [dict(search.best) for search in searches]
        totals = [sum(s.fine.measure(a)[0] / s.score for s in searches) for a in answers]
        return answers[int(np.argmax(totals))]

    def searches(
        self, poses: Iterable[Pose], free: tuple[str, ...], start: Mapping[str, float], *, fine: bool = False
    ) -> Iterator[tuple[Recording, Search]]:
        """Yield the search for some parameters of the prism by sharpness, in each pose, and its recording."""
        with contextlib.closing(in_order(partial(self._inside_of, pose) for pose in poses)) as recordings:
            for recording in recordings:
                prism = recording.prism
                bounds = {"apex": (SIZES[0] * prism.apex, SIZES[1] * prism.apex)} if isinstance(prism, Prism) else {}
                pairs, density = (FINE_PAIRS, FINE) if fine else (PAIRS, 1.0)
                pairs = min(pairs // 6, pairs // len(self.poses))
                photometric = PhotometricSettings(pairs=pairs, density=density)
                settings = Settings(model="exact", free=free, start=start, bounds=bounds, photometric=photometric)
                yield recording, prepare(recording, settings, device=self.device)[0]

    def _inside_of(self, pose: Pose) -> Recording:
        """Return the recording of a pose with the present camera and only the events of pixels that are used."""
        source = pose.recording.events
        events = source.slice(0, len(source))
        events = events[self.inside[events.y, events.x]]
        return replace(pose.recording, camera=self.camera, events=MemoryEvents(events, *source.size))

    def _equations(
        self, names: Sequence[str], values: Mapping[str, float], done: int, *, fine: bool = False
    ) -> dict[str, Equations]:
        """Return the photometric equations of some poses, by name, with fine maps or not. ``done`` passes are over.

        A pose without enough events is left out.
        """
        out, poses = {}, [pose for pose in self.poses if pose.name in names]
        searches = self.searches(poses, ALL_FREE, values, fine=fine)
        for k, (pose, (recording, search)) in enumerate(zip(poses, searches, strict=True)):
            self.progress("events", (done + 0.1 * k / len(poses)) / (MOST_PASSES + 1))
            self.full, search.best = search.full_space, dict(search.full_space.start) | dict(values)
            search.full_space = self.full.without(like_size(self.full.names))  # those would ask for a coarse map
            try:
                out[pose.name] = collect_equations(Problem(recording, search), search.settings.photometric.sensor)
            except AmiwarpError as error:
                self.left_out[pose.name] = str(error).removeprefix(f"{pose.recording.name}: ")
        return out

    def pictures(
        self, model: ExactModel, names: Sequence[str], done: int, *, turns: float
    ) -> dict[str, NDArray[np.uint8]]:
        """Return pictures of some poses, each from some turns of the prism, by name. ``done`` passes are over.

        Those of more than a turn start at prism angles that are evenly spread over the poses. An error that depends on
        the start would otherwise be common to all poses: the principal point would follow it, and the scatter of the
        poses not show it.
        """
        recordings = {pose.name: pose.recording for pose in self.poses}

        def picture(name: str, angle: float) -> NDArray[np.uint8]:
            work = Reconstruction(recordings[name], model=model, device=self.device)
            work.smoothness, work.with_silence = SMOOTHNESS, False
            assert work.turn_us is not None  # a still span has turns
            start = window_start(recordings[name], turns, work.turn_us, angle) if turns > 1.0 else None
            log = work.window(*work.span(start, turns=turns)).to_host().log
            low, high = np.percentile(log, (1.0, 99.0))
            return np.clip((log - low) / max(high - low, 1e-6) * 255.0, 0.0, 255.0).astype(np.uint8)

        def jobs() -> Iterator[Callable[[], NDArray[np.uint8]]]:
            for k, name in enumerate(names):
                share = 0.2 + 0.8 * k / len(names)
                self.progress(f"picture {k + 1} of {len(names)}", (done + share) / (MOST_PASSES + 1))
                yield partial(picture, name, math.tau * k / len(names))

        return dict(zip(names, for_each_pose(jobs(), self.device), strict=True))

    def _use_lens(self, joint: JointPrism, sight: Sight) -> None:
        """Go on with the lens that was seen; the prism's orbits stay as large."""
        joint.values["apex"] *= self.camera.fx / sight.fit.camera.fx
        self.camera = sight.fit.camera

    def _lens(self, pictures: dict[str, NDArray[np.uint8]], *, matched: bool) -> Sight:
        """Return the lens that the corners of the pictures determine, with the corners.

        The rough lens smears the first pictures, each in its way: corners that were ``matched`` in them would agree too
        well, and free coefficients that mean nothing.
        """
        jobs = [partial(self.board.find, picture) for picture in pictures.values()]
        found = dict(zip(pictures, in_order(jobs), strict=True))
        self.left_out = {name: why for name, why in self.left_out.items() if name not in found}
        seen = {name: corners for name, corners in found.items() if corners is not None}
        for name, corners in found.items():
            if corners is None:
                self.left_out[name] = self.board.missing(pictures[name])
        self._check_count(len(seen), "seen")
        if matched:
            fit = fit_lens(self.camera, self.board, list(seen.values()))
            matches = [
                partial(match_corners, pictures[name], self.board, corners, fit.camera, pose)
                for (name, corners), pose in zip(seen.items(), fit.poses, strict=True)
            ]
            seen = dict(zip(seen, in_order(matches), strict=True))
        while True:
            fit = fit_lens(self.camera, self.board, list(seen.values()))
            misses = {name: rms(r) for name, r in zip(seen, fit.residuals, strict=True)}
            worst = max(misses, key=lambda name: misses[name])
            usual = float(np.median([*misses.values()]))
            if misses[worst] <= max(BAD_POSE * usual, LEAST_BAD_PX):
                break
            self.left_out[worst] = (
                f"its corners miss by {misses[worst]:.2f} px rms, those of the others by {usual:.2f} px"
            )
            del seen[worst]
            self._check_count(len(seen), "that fit together")
        shared = np.zeros((3, len(fit.names)))
        shared[0, :2] = SHARED_FOCAL * fit.camera.fx, SHARED_FOCAL * fit.camera.fy
        shared[1, 2] = shared[2, 3] = SHARED_CENTRE_PX
        return Sight(pictures, seen, replace(fit, covariance=fit.covariance + shared.T @ shared))

    def _before_the_lens(self) -> NDArray[np.bool_]:
        """Return the pixels whose events are used with the rough lens, shape (height, width)."""
        camera = self.camera
        xy = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1).reshape(-1, 2)
        along = np.asarray(camera.pixels_to_rays(xy.astype(np.float64)))[:, 2]
        return (along > math.cos(STEEPEST)).reshape(camera.height, camera.width)

    def _between(self, seen: Mapping[str, Corners]) -> NDArray[np.bool_]:
        """Return the pixels between the corners of all poses, shape (height, width)."""
        cv2, inside = opencv(), np.zeros((self.camera.height, self.camera.width), np.uint8)
        xy = np.concatenate([corners.xy for corners in seen.values()])
        cv2.fillConvexPoly(inside, cv2.convexHull(np.rint(xy).astype(np.int32)), 1)
        return inside > 0

    def _change(self, old: ExactModel, new: ExactModel) -> float:
        """Return the change of the compensation from one model to another [px rms]."""
        before, after = over_a_turn((old, new), _places(self.inside))
        return rms((after - before).reshape(-1, 2))

    def _drop_unexplained(self, joint: JointPrism) -> list[str]:
        """Leave out the poses whose events the prism of all poses does not explain, and return their names."""
        usual = float(np.median([*joint.costs.values()]))
        if usual > LARGEST_COST:
            raise AmiwarpError(
                f"no prism explains the events of the poses (cost {usual:.2f}, at most {LARGEST_COST:g}): hold "
                "the board still, with the same zero of the encoder in all recordings"
            )
        bad = [name for name, cost in joint.costs.items() if cost > BAD_COST * usual]
        for name in bad:
            self.left_out[name] = (
                f"the prism of the other poses does not explain its events (cost {joint.costs[name]:.2f}, usual "
                f"{usual:.2f}): the board moves, or the encoder's zero changed; use an index pulse"
            )
            del joint.equations[name]
        self._check_count(len(joint.equations), "that agree on the prism")
        return bad

    def _whole_prism(
        self, joint: JointPrism, sight: Sight
    ) -> tuple[Sight, dict[str, float], dict[str, float], tuple[str, ...]]:
        """Return what is seen, all parameters of the prism, their standard deviations, and what is not determined.

        Index and tilt are only freed if they differ from their nominal values with certainty.
        """
        notes = list[str]()
        index_off, sight = self._free_index(joint, sight, notes)
        fit = sight.fit
        joint.linearise(self.camera, TILTED)
        values, deviations, off = dict(joint.values), joint.deviations(TILTED[:2], fit), joint.deviations(TILTED, fit)
        better = joint.step()
        if max(off[n] for n in TILTED[2:]) > LARGEST_DEVIATION["tilt"]:
            notes.append("the tilt of the prism is not determined, and stays as given")
        elif any(abs(better[n] - values[n]) > CERTAIN * off[n] for n in TILTED[2:]):
            joint.refine(self.camera, TILTED)
            joint.linearise(self.camera, TILTED)
            deviations = joint.deviations(TILTED, fit)
        values = joint.correct_size(self.camera)
        if index_off:
            by_index = values["apex"] / (values["index"] - 1.0) * index_off
            deviations = {**deviations, "apex": math.hypot(deviations["apex"], by_index), "index": index_off}
        return sight, values, deviations, tuple(notes)

    def _free_index(self, joint: JointPrism, sight: Sight, notes: list[str]) -> tuple[float, Sight]:
        """Set the prism's index if it differs from the given one with certainty.

        Return its deviation, or 0 if it is held, and what is seen with it. Pictures that were made with a wrong index
        bend the lens, so they are made again once another index is likely.
        """
        given, before, names = dict(joint.values), (self.camera, sight), [*joint.equations]
        index, off = given["index"], math.inf

        def ask(names: Sequence[str]) -> tuple[float, float]:
            index, off = joint.index(self.camera, names)
            return index, math.hypot(off, joint.systematic_of_index(sight.fit))

        def differs(enough: float) -> bool:
            return abs(index - given["index"]) > enough * off

        enough = len(names) >= GOOD_POSES
        if enough and joint.systematic_of_index(sight.fit) < DOUBTFUL * LARGEST_DEVIATION["index"]:
            index, off = ask(names[::PROBED])  # a few tell whether it is worth while
            for k in range(INDEX_ROUNDS):
                if not differs(DOUBTFUL):
                    break
                joint.set_index(index)
                if not k:
                    model = joint.model(self.camera, joint.values)
                    pictures = self.pictures(model, [*sight.corners], MOST_PASSES, turns=PICTURE_TURNS)
                    sight = self._lens(pictures, matched=True)
                    self._use_lens(joint, sight)
                joint.refine(self.camera, ("apex", "phase"))
                index, off = ask(names)
        sure = off < LARGEST_DEVIATION["index"]
        another = sure and differs(CERTAIN)
        if joint.values != given:
            if another:
                joint.set_index(index)
            else:
                joint.values, (self.camera, sight) = given, before
            joint.refine(self.camera, ("apex", "phase"))
        if not another and off < math.inf and differs(DOUBTFUL):
            notes.append(
                f"the events prefer an index of {index:.3f} ± {off:.3f}, but not with certainty: the given one, "
                f"{given['index']:g}, is used"
            )
        elif not sure:
            notes.append(f"the index of the prism is not determined, and stays as given, {given['index']:g}")
        return (off if another else 0.0), sight


ALL_FREE = ("apex", "phase", "tilt_x", "tilt_y", "index")
"""Parameters of the prism that poses can determine together."""
TILTED = ALL_FREE[:4]
INDEX_STEP, INDEX_STEPS, INDEX_ROUNDS = 0.1, 4, 2
"""Distance of the indices at which the cost is compared, number of Gauss-Newton steps at each, and number of times that
the comparison is repeated about its answer: the maps are biased to the index of their fit."""


PLACES = 63
"""Number of pixels at which displacements are compared."""
AT_ONCE = 2
"""Largest number of poses that are worked on at the same time on a CPU. More would take more memory."""


class JointPrism:
    """Photometric fit of one prism to the events of all poses."""

    def __init__(self, equations: Mapping[str, Equations], full: ParameterSpace, values: Mapping[str, float]) -> None:
        """Start at ``values``; ``full`` is the space of all parameters."""
        self.equations, self.full = dict(equations), full
        self.values = dict(full.start) | dict(values)
        """Present values of all parameters."""
        self.inside: NDArray[np.bool_] | None = None
        """Pixels whose events are used, shape (height, width); all if None."""
        self.costs: dict[str, float] = {}
        """Cost of each pose relative to that without a map, by name."""
        self.space: ParameterSpace
        """Space of the last fit or linearisation."""
        self._each: list[Slopes]
        self._longer = 1.0

    def model(self, camera: Camera, values: Mapping[str, float]) -> ExactModel:
        """Return the optical model of some parameter values."""
        return ExactModel.from_values(camera, as_wedge(self.full.prism), values)

    def use(self, equations: Mapping[str, Equations], inside: NDArray[np.bool_]) -> None:
        """Go on with the equations of the events ``inside``, weighted alike in all poses, and with little damping."""
        self.equations, self.inside = dict(equations), inside
        costs = [each.cost for each in self.equations.values()]
        usual = float(np.median([cost.scale for cost in costs]))
        for cost in costs:
            cost.set_scale(usual)
            cost.brightness.set_damping(BOARD_DAMPING)

    def refine(
        self, camera: Camera, names: tuple[str, ...], most: int = MOST_STEPS, tolerance: float = TOLERANCE_PX,
        poses: Iterable[str] = (),
    ) -> dict[str, float]:  # fmt: skip
        """Fit the parameters ``names`` in at most ``most`` steps from the present values. Return all values.

        A step shorter than ``tolerance`` [px] ends the fit. Without names of ``poses`` all are used.
        """
        costs = self._costs(camera, names, poses)
        space = self.space
        v, last, gain = space.to_vector(self.values), np.zeros(0), self._longer
        for _ in range(most):
            step = _total(self._slopes(costs.values(), v)).step()
            if len(last):  # the weights of outliers make steps too short, by the same factor: take their sum
                left = 1.0 - (1.0 - float(step @ last) / max(float(last @ last), 1e-12)) / gain
                gain = 1.0 / (1.0 - min(max(left, 0.0), 1.0 - 1.0 / LARGEST_GAIN))
            v = v + np.clip(gain * step, -1.0, 1.0)
            if len(last) and gain * float(np.abs(step).max()) < tolerance:
                break
            last = step
        self._longer = gain
        self.costs = {name: cost.mean() for name, cost in costs.items()}
        self.values = {**self.values, **space.to_values(v)}
        return dict(self.values)

    def correct_size(self, camera: Camera) -> dict[str, float]:
        """Correct the orbits' size, and the phase, with :data:`FINEST` maps. Return all values.

        Poses whose events do not determine a fine map keep their coarse one.
        """
        for name, each in self.equations.items():
            if each.cost.brightness.tiles.density == FINE:
                self.equations[name] = finest = each.at_density(FINEST)
                finest.cost.brightness.set_damping(BOARD_DAMPING)
        return self.refine(camera, ("apex", "phase"), FINEST_STEPS, 0.0)

    def set_index(self, index: float) -> None:
        """Change the prism's index, and its apex with it, so that the orbit stays as large."""
        thinner = (self.values["index"] - 1.0) / (index - 1.0)
        self.values = {**self.values, "index": index, "apex": thinner * self.values["apex"]}

    def index(self, camera: Camera, names: Sequence[str]) -> tuple[float, float]:
        """Return the prism's index by some poses, and its standard deviation; infinity where they do not tell it.

        Apex and index trade against each other, but for a part of the orbit that grows with the angle of incidence. So
        the cost is compared at three indices, with apex and phase fitted at each from the same maps. The minimum of the
        parabola is the index, and its jackknife over the poses the deviation. The fit stays as it was.
        """
        fit, values, rows = dict(vars(self)), self.values, []
        costs = [self.equations[name].cost for name in names]
        maps = [cost.brightness.copy_unknowns() for cost in costs]
        middle = values["index"]
        for index in (middle - INDEX_STEP, middle, middle + INDEX_STEP):
            for cost, unknowns in zip(costs, maps, strict=True):
                cost.replace_map(unknowns)
                cost.replace_map(cost.brightness.copy_unknowns())
            self.values = values
            self.set_index(index)
            self.refine(camera, ("apex", "phase"), INDEX_STEPS, 0.0, names)
            rows.append([*self.costs.values()])
        for cost, unknowns in zip(costs, maps, strict=True):
            cost.replace_map(unknowns)
        vars(self).update(fit)
        low, at, high = np.array(rows)
        bend, slope = low - 2.0 * at + high, high - low
        if not bend.sum() > 0.0:
            return middle, math.inf
        without = (slope.sum() - slope) / (bend.sum() - bend)
        off = 0.5 * INDEX_STEP * math.sqrt((len(without) - 1) * float(np.var(without)))
        return middle - 0.5 * INDEX_STEP * float(slope.sum() / bend.sum()), off

    def _costs(self, camera: Camera, names: tuple[str, ...], poses: Iterable[str] = ()) -> dict[str, Cost]:
        """Return the costs of some poses, or of all, by name, as functions of the parameters ``names``."""
        self.space = replace(self.full, camera=camera, names=names).holding(self.values)
        return {name: self.equations[name].cost.in_space(self.space) for name in poses or self.equations}

    def _slopes(self, costs: Iterable[Cost], v: Vector) -> list[Slopes]:
        """Return the derivatives of the cost of each pose at a vector of parameters."""

        def slopes(cost: Cost) -> Slopes:
            cost.predict(v)
            cost.residuals(v, rounds=2)
            return cost.slopes(v, with_parts=True)

        costs = list(costs)
        return [*for_each_pose((partial(slopes, cost) for cost in costs), costs[0].brightness.device)]

    def linearise(self, camera: Camera, names: tuple[str, ...]) -> None:
        """Find how the costs of all poses change with the parameters ``names`` at the present values.

        The weights of outliers change with the parameters. So the gradient at a board changes only a third as fast as
        the Gauss-Newton Hessian says. Some of the poses tell the factor, for size and phase.
        """
        some = self._costs(camera, TILTED[:2], [*self.equations][::PROBED]).values()
        v, changes = self.space.to_vector(self.values), []
        at = _total(self._slopes(some, v))
        for unit in np.eye(2):
            moved = _total(self._slopes(some, v + PROBE_PX * unit))
            changes.append((moved.gradient - at.gradient) / PROBE_PX)
        shares = np.linalg.eigvals(np.linalg.lstsq(at.hessian, np.stack(changes, axis=1), rcond=None)[0]).real
        self._longer = 1.0 / float(np.clip(shares.mean(), 1.0 / LARGEST_GAIN, 1.0))
        costs = self._costs(camera, names).values()
        self._each = self._slopes(costs, self.space.to_vector(self.values))

    def step(self) -> dict[str, float]:
        """Return the values to which :meth:`linearise` points."""
        return self.space.to_values(self.space.to_vector(self.values) + self._longer * _total(self._each).step())

    def deviations(self, names: tuple[str, ...], fit: Fit) -> dict[str, float]:
        """Return the standard deviations of some parameters that are linearised, with the others held.

        They come from the scatter of the poses and within them, and from errors of the lens and of the orbits.
        """
        each = [slopes.restricted_to([self.space.names.index(n) for n in names]) for slopes in self._each]
        total, space = _total(each), replace(self.space, names=names)
        of_poses = replace(total, parts=np.stack([s.gradient for s in each], axis=1))
        v, random = space.to_vector(self.values), self._longer**2 * (total.covariance() + of_poses.covariance())
        return space.deviations(v, random + self._systematic(space, v, fit))

    def systematic_of_index(self, fit: Fit) -> float:
        """Return the standard deviation of the index that errors of the lens and of the orbits' shape cause."""
        space = replace(self.full, camera=fit.camera, names=("apex", "phase", "index")).holding(self.values)
        v = space.to_vector(self.values)
        return space.deviations(v, self._systematic(space, v, fit))["index"]

    def _systematic(self, space: ParameterSpace, v: Vector, fit: Fit) -> Vector:
        """Return the covariance of the prism's parameters that errors of the lens and of the orbits cause [px²].

        The first two parameters are the orbits' size and phase. The others change the shape of the orbits only, and how
        it varies over the image.
        """
        size = (fit.camera.height, fit.camera.width)
        xy = _places(np.ones(size, bool) if self.inside is None else self.inside)

        values, steps, shares = space.to_values(v), *fit.axes(xy)
        models = [space.build(space.to_values(v + FOLLOW_PX * unit)) for unit in np.eye(len(v))]
        given = lens_values(fit.camera, fit.names)
        for step in np.concatenate([steps, -steps]):
            lens_moved = {name: x + by for (name, x), by in zip(given.items(), step.tolist(), strict=True)}
            models.append(replace(space, camera=with_lens_values(fit.camera, lens_moved)).build(values))
        at, *ends = displacements([space.build(values), *models], xy)
        prism = (np.stack(ends[: len(v)], axis=1) - at[:, None]) / FOLLOW_PX
        there, back = np.split(np.stack(ends[len(v) :], axis=1), 2, axis=1)
        lens = (there - back) / (2.0 * shares)
        seen = np.isfinite(prism).all(axis=1) & np.isfinite(lens).all(axis=1)
        prism, follows = prism[seen], -np.linalg.lstsq(prism[seen], lens[seen], rcond=None)[0]
        middle = np.array([[fit.camera.cx, fit.camera.cy]])
        radius = rms(displacements([space.build(values)], middle).reshape(-1, 2))
        larger = np.zeros(len(v))
        larger[:2] = v[:2] / np.linalg.norm(v[:2]) if space.cartesian else (1.0, 0.0)
        by_size = SIZE_ERROR / radius / math.sqrt(2.0 * float(np.mean((prism @ larger) ** 2))) * larger
        by_shape = np.zeros(len(v))
        for k in range(2, len(v)):
            others = np.delete(prism, k, axis=1)
            own = prism[:, k] - others @ np.linalg.lstsq(others, prism[:, k], rcond=None)[0]
            by_shape[k] = SHAPE_ERROR / radius**3 / math.sqrt(2.0 * float(np.mean(own**2)))
        return np.asarray(follows @ follows.T + np.outer(by_size, by_size) + np.diag(by_shape**2))

    def calibration(
        self, camera: Camera, values: Mapping[str, float], uncertainty: Mapping[str, float], seconds: float
    ) -> Calibration:
        """Return the result as a calibration of the prism with ``camera``."""
        search = next(iter(self.equations.values())).problem.sharp
        found = {n: values[n] for n in values if n in ALL_FREE}
        space = replace(self.full, camera=camera)
        return Calibration(
            model_name="exact", camera=camera, prism=nominal(space.prism), parameters=found,
            uncertainty=dict(uncertainty), free=tuple(uncertainty), sharpness_name=search.settings.sharpness.value,
            sharpness_before=search.fine.measure({**search.best, "apex": 0.0})[0],
            sharpness_after=search.sharpness_in(space, found), stages=(), events=len(search.calibration_events.events),
            seconds=seconds,
        )  # fmt: skip


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


def window_start(recording: Recording, turns: float, turn_us: float, angle: float) -> int:
    """Return the latest start of some turns of the prism at which its encoder has an angle [rad], as a time [us].

    If the recording is too short for it, return its start. ``turn_us`` is the duration of a turn [us].
    """
    events, encoder = recording.events, recording.encoder
    assert encoder is not None
    latest = events.t_last + 1 - round(turns * turn_us)
    beyond = math.copysign(1.0, encoder.rpm) * (float(encoder.angle_at(np.array([latest]))[0]) - angle)
    return max(events.t_first, latest - round(beyond % math.tau / math.tau * turn_us))


def _some(names: Sequence[str]) -> Sequence[str]:
    """Return about :data:`FIRST_POSES` of the names of poses, evenly chosen."""
    return names[:: max(1, len(names) // FIRST_POSES)]


def _places(inside: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return :data:`PLACES` of the pixels that are marked in an image, evenly chosen, as x and y."""
    yx = np.argwhere(inside)
    return yx[np.linspace(0, len(yx) - 1, PLACES).astype(np.int64), ::-1]


def _total(each: Sequence[Slopes]) -> Slopes:
    """Return the derivatives of the cost of several poses together."""
    return Slopes(
        np.sum([s.hessian for s in each], axis=0), np.sum([s.gradient for s in each], axis=0),
        np.concatenate([s.parts for s in each], axis=1),
    )  # fmt: skip


def advice_on(poses: Sequence[BoardPose], fit: Fit) -> tuple[str, ...]:
    """Return what would improve a calibration most, one sentence each."""
    tilts = [tilt_of(np.concatenate([p.rotation, p.translation])) for p in poses]
    said = lacking(tilts, coverage_of([p.corners for p in poses], fit.camera.width, fit.camera.height))
    if len(poses) < GOOD_POSES:
        said.append(f"record more poses: {len(poses)} were used, and {GOOD_POSES} halve the deviation of four")
    return tuple(said)


def lacking(tilts: Sequence[float], coverage: NDArray[np.int64]) -> list[str]:
    """Return what the poses lack in tilt [rad] and in coverage of the image, one sentence each."""
    said = []
    if (usual := float(np.median(tilts))) < STEEP:
        said.append(f"tilt the board more: half of the poses are tilted by less than {math.degrees(usual):.0f} deg")
    empty = [f"{REGIONS[0][a]} {REGIONS[1][b]}" for a, b in np.argwhere(coverage == 0)]
    if empty:
        said.append(f"no corner lies in the {', '.join(empty)} of the image: hold the board there")
    return said
