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
from numpy.typing import NDArray

from amiwarp.calib.photometric.distances import over_a_turn
from amiwarp.calib.photometric.equations import Equations, Problem, collect_equations
from amiwarp.calib.photometric.limits import LARGEST_COST
from amiwarp.calib.preparation import prepare
from amiwarp.calib.settings import PhotometricSettings, Settings
from amiwarp.calib.sharpness_search import Search
from amiwarp.calib.start_burst import without_start_burst
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import MemoryEvents, Recording
from amiwarp.lens.board import Board, Corners, opencv
from amiwarp.lens.corner_fit import Fit, fit_lens
from amiwarp.lens.corner_match import match_corners
from amiwarp.lens.joint_prism import (
    ALL_FREE,
    FINE,
    PROBED,
    TILTED,
    TOLERANCE_PX,
    JointPrism,
    for_each_pose,
    some_pixels,
)
from amiwarp.lens.poses import Pose, still_poses
from amiwarp.lens.result import GOOD_POSES, BoardPose, LensCalibration, advice_on
from amiwarp.optics.camera import Camera
from amiwarp.optics.distortion import Fisheye
from amiwarp.optics.models.comparison import rms
from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.prism import Prism
from amiwarp.reconstruction.reconstruct import Reconstruction
from amiwarp.results.parameters import like_size
from amiwarp.schema.calls import guarded
from amiwarp.tasks import Progress, in_order, silent
from amiwarp.validation import instance, real

USUAL_FOV = math.radians(60.0)
"""Horizontal field of view that is assumed if none is known [rad]."""
LEAST_POSES = 4
"""Smallest number of poses for a calibration."""
SMOOTHNESS = 0.02
"""Weight of the pictures' smoothness prior. Choosing it for each picture takes as long as the picture; the corners'
errors change by a tenth between 0.02 and 0.1."""
PICTURE_TURNS = 1.25
"""Length of the events that make a picture [turns]. After a turn, pixels fire where they fired at the start, and so
compare the brightness with that at the start. With one turn, corners of a board in orbits of 2.4 px were off by 0.027
px, in a direction that turns with the prism's angle at the start; with 1.25 turns by 0.011 px."""
FIRST_POSES = 6
"""Number of poses that give the first prism and lens, with which the pictures of all poses are made."""
MOST_PASSES = 4
ENOUGH_PX = 0.08
"""Largest number of times that the pictures are made, and the least change of the compensation by a new lens for which
they are made again [px rms]. A change of 0.36 px moved the principal point by 1.5 px."""
SIZES = (0.6, 1.6)
"""Range of the prism's size that is searched, as a multiple of a nominal one. The rough lens may be wrong by 20 % and
the nominal prism by 20 %. A wider range lets an orbit as large as a square of the board match another square."""
SEARCHED = 3
"""Number of poses in which the prism is searched by sharpness. Each answer is tried on the others."""
PAIRS = 600_000
FINE_PAIRS = 1_200_000
"""Number of pairs of events of all poses together, and at most a sixth of it in one pose: at first, and with the last
lens, when maps have several nodes per pixel."""
STEEPEST = math.radians(45.0)
"""Largest angle from the optical axis of the events that are used with the rough lens [rad]. Farther out, orbits grow
so fast with the angle that a wrong focal length gives a wrong prism."""
FIRST_TOLERANCE_PX = 0.01
"""Length of a step that ends the search for the prism with a lens that is not the last one [px]."""
BAD_COST = 1.6
"""A pose is left out if its photometric cost exceeds this multiple of the median of all poses. Still poses reached 1.3
times the median; one with the prism's zero off by 10 deg had 2.4, and boards that moved by 0.9 and 2.6 px in a turn had
1.9 and 2.5 times the median."""
BAD_POSE = 3.0
LEAST_BAD_PX = 0.3
"""A pose is left out if its corners miss by this multiple of the median of all poses, and by this much [px rms]."""
CERTAIN = 4.0
DOUBTFUL = 1.5
"""Ratio of a parameter's distance from its nominal value to its standard deviation at which it is believed; and of
the index at which a third of the poses let all of them be asked."""
LARGEST_DEVIATION = {"index": 0.02, "tilt": math.radians(0.5)}
"""Standard deviation above which an index or a tilt [rad] counts as not determined."""
SHARED_FOCAL = 0.00011
SHARED_CENTRE_PX = 0.04
"""Standard deviations of errors that the pictures of a set share, so that leaving out a pose does not show them: of the
focal length, as a share, and of each coordinate of the principal point [px]. The first makes the errors of 50 sets of
poses of two lenses as likely as possible, and 50 others give the same; the second was found from 175 sets."""
INDEX_ROUNDS = 2
"""Number of times that the prism's index is asked for again about its answer: the maps are biased to the index of their
fit."""
TWO_BOARDS = "two boards are seen; leave one of them in the picture"


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
        Rough horizontal field of view [rad], right within 20 %; by default the field of view of the recordings' camera,
        else 60 deg.
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
        raise AmiwarpError("no recordings are given; give at least one", ErrorCode.CONTENT_MISSING)
    sizes = {recording.events.size for recording in given}
    if len(sizes) > 1:
        raise AmiwarpError(
            f"the recordings have sensors of {sorted(sizes)} px; give recordings of one camera"
        )
    first = given[0]
    camera = first_camera(first.events.size, first.camera, fov, fisheye=fisheye)
    notes: list[str] = []
    for k, recording in enumerate(given):
        given[k], warnings = without_start_burst(recording)
        notes += [f"{recording.name}: {text}" for text in warnings]
    poses, reasons = still_poses(given)
    work = LensWork(board, camera, poses, device, progress or silent, reasons)
    found = work.run()
    return replace(found, notes=(*found.notes, *notes))


def first_camera(
    size: tuple[int, int],
    known: Camera | None,
    fov: float | None,
    *,
    fisheye: bool,
) -> Camera:
    """Return the camera to start with: without distortion, its principal point in the middle.

    Without ``fov``, it has the field of view of the camera ``known``, else :data:`USUAL_FOV`.
    """
    width, height = size
    if fov is None:
        fov = USUAL_FOV if known is None else _fov_of(known, width)
    most_deg = 200.0 if fisheye else 150.0
    fov = real(fov, "fov", math.radians(1.0), math.radians(most_deg), " rad")
    if not fisheye:
        return Camera.from_fov(width, height, fov)
    focal = width / fov  # of an equidistant lens
    return Camera(
        width=width,
        height=height,
        fx=focal,
        fy=focal,
        cx=(width - 1) / 2.0,
        cy=(height - 1) / 2.0,
        distortion=Fisheye(),
    )


def _fov_of(camera: Camera, width: int) -> float:
    """Return the horizontal field of view of a camera for images with a width [rad]."""
    if isinstance(camera.distortion, Fisheye):
        return width / camera.fx
    return 2.0 * math.atan(0.5 * width / camera.fx)


Pictures = dict[str, NDArray[np.uint8]]
"""Pictures by name of the pose, each of shape (height, width)."""


@dataclass(frozen=True, eq=False)
class Sight:
    """What is seen with a prism and a lens, and the lens that it determines."""

    pictures: Pictures
    """Pictures by name of the pose, each of shape (height, width)."""
    corners: dict[str, Corners]
    """Corners by name of each pose of the fit."""
    fit: Fit
    """Lens and poses."""


def poses_of(sight: Sight) -> tuple[BoardPose, ...]:
    """Return the poses of the fit, with the evidence."""
    found = []
    fit = sight.fit
    parts = zip(sight.corners.items(), fit.residuals, fit.poses, strict=True)
    for (name, corners), residuals, pose in parts:
        picture = sight.pictures[name]
        found.append(BoardPose(name, corners, residuals, pose[:3], pose[3:], picture))
    return tuple(found)


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
        joint = self._first_joint(self._first_prism())
        joint, sight = self._prism_and_lens(joint)
        joint, sight, uncertainty, notes = self._whole_prism(joint, sight)
        for name, corners in sight.corners.items():
            if self.board.has_another(sight.pictures[name], corners):
                raise AmiwarpError(f"{name}: {TWO_BOARDS}")

        fit = sight.fit
        if fit.left_out:
            names = ", ".join(fit.left_out)
            notes = (f"the corners do not determine {names}, which stay 0", *notes)
        used = poses_of(sight)
        seconds = time.perf_counter() - began
        return LensCalibration(
            camera=fit.camera,
            uncertainty=fit.deviations,
            prism=joint.calibration(self.camera, uncertainty, seconds),
            poses=used,
            left_out=self.left_out,
            notes=notes,
            advice=advice_on(used, fit),
            seconds=seconds,
        )

    def _first_joint(self, values: Mapping[str, float]) -> JointPrism:
        """Return the fit of the prism to the events of some poses; of all, if some are not enough."""
        everyone = [pose.name for pose in self.poses]
        first = _some(everyone)
        equations = self._equations(first, values, 0)
        if len(equations) < LEAST_POSES:
            rest = [name for name in everyone if name not in first]
            equations |= self._equations(rest, values, 0)
        self._check_count(len(equations), "with enough events")
        return JointPrism.start(equations, self.full, values)

    def _prism_and_lens(self, joint: JointPrism) -> tuple[JointPrism, Sight]:
        """Fit prism and lens in turn until the lens no longer changes the pictures.

        Return the fit of the prism, and what is seen with both.

        Pass 0 makes pictures of some poses, pass 1 of all; from pass 2 on the events of all poses determine the prism.
        """
        everyone = [pose.name for pose in self.poses]
        shown = joint.model(self.camera)
        sight = None
        for k in range(MOST_PASSES + 1):
            self.progress("prism", (k + 0.1) / (MOST_PASSES + 1))
            if sight is not None and k == 2:
                # The first lens was found from some of the poses only.
                self.inside = self._between(sight.corners)
                equations = self._equations(everyone, joint.values, k, fine=True)
                self._check_count(len(equations), "with enough events")
                joint = joint.on(equations, self.inside)
            tolerance = TOLERANCE_PX if k > 1 else FIRST_TOLERANCE_PX
            joint = joint.refine(self.camera, ("apex", "phase"), tolerance=tolerance)
            # The first lenses explain no pose well.
            bad = self._unexplained(joint) if k > 1 else []
            joint = joint.without(bad)
            model = joint.model(self.camera)
            settled = k > 1 and not bad and self._change(shown, model) < ENOUGH_PX
            if k == MOST_PASSES or settled:
                break

            # New pictures, and the lens that their corners determine.
            everyone = [name for name in everyone if name not in bad]
            shown = model
            sight = self._sight(model, everyone, k)
            joint = self._with_lens(joint, sight)
        assert sight is not None
        return joint, sight

    def _sight(self, model: ExactModel, everyone: list[str], k: int) -> Sight:
        """Return what is seen with a model of the prism in pass ``k``, and the lens that it determines."""
        names = everyone
        if k != 1:
            names = [name for name in everyone if name not in self.left_out]
        first = names if k else _some(names)
        turns = PICTURE_TURNS if k else 0.5
        pictures = self.pictures(model, first, k, turns=turns)
        try:
            return self._lens(pictures, matched=k > 0)
        except AmiwarpError:  # the first poses alone do not suffice
            rest = [name for name in names if name not in first]
            if not rest:
                raise
            pictures |= self.pictures(model, rest, k, turns=0.5)
            return self._lens(pictures, matched=k > 0)

    def _check_count(self, count: int, what: str) -> None:
        """Raise :class:`AmiwarpError` if too few poses are left."""
        if count < LEAST_POSES:
            reasons = "".join(f"; {name}: {why}" for name, why in self.left_out.items())
            raise AmiwarpError(
                f"a lens needs {LEAST_POSES} poses of the board or more, better {GOOD_POSES}, tilted in different "
                f"directions; {what}: {count}{reasons}"
            )

    def _first_prism(self) -> dict[str, float]:
        """Return the prism's parameters by sharpness: the answer of one pose that is best for all poses searched."""
        every = max(1, len(self.poses) // SEARCHED)
        chosen = self.poses[::every][:SEARCHED]
        to_run = [search for _, search in self.searches(chosen, ("apex", "phase"), {})]
        searches = []
        for k, search in enumerate(to_run):
            self.progress("search", 0.1 * k / len(to_run) / (MOST_PASSES + 1))
            searches.append(search.run())

        answers = [dict(search.best) for search in searches]
        totals = []
        for answer in answers:
            shares = [search.fine.measure(answer)[0] / search.score for search in searches]
            totals.append(sum(shares))
        best = int(np.argmax(totals))
        return answers[best]

    def searches(
        self,
        poses: Iterable[Pose],
        free: tuple[str, ...],
        start: Mapping[str, float],
        *,
        fine: bool = False,
    ) -> Iterator[tuple[Recording, Search]]:
        """Yield the search for some parameters of the prism by sharpness, in each pose, and its recording."""
        of_all = FINE_PAIRS if fine else PAIRS
        density = FINE if fine else 1.0
        pairs = min(of_all // 6, of_all // len(self.poses))
        photometric = PhotometricSettings(pairs=pairs, density=density)
        jobs = (partial(self._inside_of, pose) for pose in poses)
        with contextlib.closing(in_order(jobs)) as recordings:
            for recording in recordings:
                bounds = {}
                if isinstance(recording.prism, Prism):
                    apex = recording.prism.apex
                    smallest, largest = SIZES
                    bounds["apex"] = (smallest * apex, largest * apex)
                settings = Settings(
                    model="exact",
                    free=free,
                    start=start,
                    bounds=bounds,
                    photometric=photometric,
                )
                search, *_ = prepare(recording, settings, device=self.device)
                yield recording, search

    def _inside_of(self, pose: Pose) -> Recording:
        """Return the recording of a pose with the present camera and only the events of pixels that are used."""
        source = pose.recording.events
        events = source.slice(0, len(source))
        used = self.inside[events.y, events.x]
        inside = MemoryEvents(events[used], *source.size)
        return replace(pose.recording, camera=self.camera, events=inside)

    def _equations(
        self,
        names: Sequence[str],
        values: Mapping[str, float],
        done: int,
        *,
        fine: bool = False,
    ) -> dict[str, Equations]:
        """Return the photometric equations of some poses, by name, with fine maps or not. ``done`` passes are over.

        A pose without enough events is left out.
        """
        equations = {}
        poses = [pose for pose in self.poses if pose.name in names]
        searches = self.searches(poses, ALL_FREE, values, fine=fine)
        for k, (pose, (recording, search)) in enumerate(zip(poses, searches, strict=True)):
            share = (done + 0.1 * k / len(poses)) / (MOST_PASSES + 1)
            self.progress("events", share)
            self.full = search.full_space
            search = search.at({**self.full.start, **values})
            # Parameters that act like the size would ask for a coarse map.
            without_such = self.full.without(like_size(self.full.names))
            search = replace(search, full_space=without_such)
            problem = Problem(recording, search)
            sensor = search.settings.photometric.sensor
            try:
                equations[pose.name] = collect_equations(problem, sensor)
            except AmiwarpError as error:
                prefix = f"{pose.recording.name}: "
                self.left_out[pose.name] = str(error).removeprefix(prefix)
        return equations

    def pictures(
        self,
        model: ExactModel,
        names: Sequence[str],
        done: int,
        *,
        turns: float,
    ) -> Pictures:
        """Return pictures of some poses, each from some turns of the prism, by name. ``done`` passes are over.

        Pictures of more than a turn start at prism angles that are evenly spread over the poses. An error that depends
        on the start would otherwise be common to all poses: the principal point would follow it, and the scatter of the
        poses not show it.
        """
        recordings = {pose.name: pose.recording for pose in self.poses}

        def jobs() -> Iterator[Callable[[], NDArray[np.uint8]]]:
            for k, name in enumerate(names):
                share = (done + 0.2 + 0.8 * k / len(names)) / (MOST_PASSES + 1)
                self.progress(f"picture {k + 1} of {len(names)}", share)
                angle = math.tau * k / len(names)
                yield partial(self._picture, recordings[name], model, turns, angle)

        return dict(zip(names, for_each_pose(jobs(), self.device), strict=True))

    def _picture(
        self,
        recording: Recording,
        model: ExactModel,
        turns: float,
        angle: float,
    ) -> NDArray[np.uint8]:
        """Return a picture from some turns of the prism. More than a turn start at an angle of the prism [rad]."""
        work = Reconstruction(
            recording,
            model=model,
            smoothness=SMOOTHNESS,
            with_silence=False,
            device=self.device,
        )
        assert work.turn_us is not None  # a still span has turns
        start = None
        if turns > 1.0:
            start = window_start(recording, turns, work.turn_us, angle)
        span = work.span(start, turns=turns)
        log = work.window(*span).to_host().log
        low, high = np.percentile(log, (1.0, 99.0))
        grey = (log - low) / max(high - low, 1e-6) * 255.0
        return np.clip(grey, 0.0, 255.0).astype(np.uint8)

    def _with_lens(self, joint: JointPrism, sight: Sight) -> JointPrism:
        """Go on with the lens that was seen. Return the fit of a prism whose orbits stay as large."""
        larger = self.camera.fx / sight.fit.camera.fx
        self.camera = sight.fit.camera
        return joint.with_values(apex=joint.values["apex"] * larger)

    def _lens(self, pictures: Pictures, *, matched: bool) -> Sight:
        """Return the lens that the corners of the pictures determine, with the corners.

        The rough lens smears the first pictures, each in its way: corners that were ``matched`` in them would agree too
        well, and free coefficients that mean nothing. Poses are left out that show no board, or whose corners miss.
        """
        jobs = [partial(self.board.find, picture) for picture in pictures.values()]
        found = dict(zip(pictures, in_order(jobs), strict=True))
        self.left_out = {name: why for name, why in self.left_out.items() if name not in found}
        seen = {}
        for name, corners in found.items():
            if corners is None:
                self.left_out[name] = self.board.missing(pictures[name])
            else:
                seen[name] = corners
        self._check_count(len(seen), "seen")
        if matched:
            seen = self._matched(pictures, seen)

        # Errors that all poses share: one of the focal lengths, and one of each coordinate of the middle.
        fit = self._fit_that_fits(seen)
        shared = np.zeros((3, len(fit.names)))
        shared[0, 0] = SHARED_FOCAL * fit.camera.fx
        shared[0, 1] = SHARED_FOCAL * fit.camera.fy
        shared[1, 2] = SHARED_CENTRE_PX
        shared[2, 3] = SHARED_CENTRE_PX
        covariance = fit.covariance + shared.T @ shared
        return Sight(pictures, seen, replace(fit, covariance=covariance))

    def _matched(
        self,
        pictures: Mapping[str, NDArray[np.uint8]],
        seen: Mapping[str, Corners],
    ) -> dict[str, Corners]:
        """Return the corners, matched with the mean patch of their pictures."""
        fit = fit_lens(self.camera, self.board, list(seen.values()))
        jobs = []
        for (name, corners), pose in zip(seen.items(), fit.poses, strict=True):
            job = partial(match_corners, pictures[name], self.board, corners, fit.camera, pose)
            jobs.append(job)
        return dict(zip(seen, in_order(jobs), strict=True))

    def _fit_that_fits(self, seen: dict[str, Corners]) -> Fit:
        """Return the fit to all corners after poses whose corners miss are taken out of ``seen``, the worst first."""
        while True:
            fit = fit_lens(self.camera, self.board, list(seen.values()))
            misses = {}
            for name, residuals in zip(seen, fit.residuals, strict=True):
                misses[name] = rms(residuals)
            worst = max(misses, key=lambda name: misses[name])
            usual = float(np.median(list(misses.values())))
            if misses[worst] <= max(BAD_POSE * usual, LEAST_BAD_PX):
                return fit
            self.left_out[worst] = (
                f"its corners miss by {misses[worst]:.2f} px rms, the corners of the others by {usual:.2f} px"
            )
            del seen[worst]
            self._check_count(len(seen), "that fit together")

    def _before_the_lens(self) -> NDArray[np.bool_]:
        """Return the pixels whose events are used with the rough lens, shape (height, width)."""
        camera = self.camera
        columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        xy = np.stack([columns, rows], axis=-1).reshape(-1, 2)
        rays = np.asarray(camera.pixels_to_rays(xy.astype(np.float64)))
        is_steep = rays[:, 2] > math.cos(STEEPEST)
        return is_steep.reshape(camera.height, camera.width)

    def _between(self, seen: Mapping[str, Corners]) -> NDArray[np.bool_]:
        """Return the pixels between the corners of all poses, shape (height, width)."""
        cv2 = opencv()
        inside = np.zeros((self.camera.height, self.camera.width), np.uint8)
        xy = np.concatenate([corners.xy for corners in seen.values()])
        hull = cv2.convexHull(np.rint(xy).astype(np.int32))
        cv2.fillConvexPoly(inside, hull, 1)
        return inside > 0

    def _change(self, old: ExactModel, new: ExactModel) -> float:
        """Return the change of the compensation from one model to another [px rms]."""
        before, after = over_a_turn((old, new), some_pixels(self.inside))
        return rms((after - before).reshape(-1, 2))

    def _unexplained(self, joint: JointPrism) -> list[str]:
        """Return the names of the poses whose events the prism of all poses does not explain, and note why."""
        usual = float(np.median(list(joint.costs.values())))
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
        self._check_count(len(joint.equations) - len(bad), "that agree on the prism")
        return bad

    def _whole_prism(
        self,
        joint: JointPrism,
        sight: Sight,
    ) -> tuple[JointPrism, Sight, dict[str, float], tuple[str, ...]]:
        """Return the last fit, what is seen, the standard deviations of the prism, and what is not determined.

        Index and tilt are only freed if they differ from their nominal values with certainty.
        """
        notes: list[str] = []
        index_off, joint, sight = self._free_index(joint, sight, notes)
        joint, deviations = self._free_tilt(joint, sight, notes)
        joint = joint.with_size_corrected(self.camera)
        if index_off:
            by_index = joint.values["apex"] / (joint.values["index"] - 1.0) * index_off
            of_apex = math.hypot(deviations["apex"], by_index)
            deviations = {**deviations, "apex": of_apex, "index": index_off}
        return joint, sight, deviations, tuple(notes)

    def _free_tilt(
        self,
        joint: JointPrism,
        sight: Sight,
        notes: list[str],
    ) -> tuple[JointPrism, dict[str, float]]:
        """Find the prism's tilt if it differs from the given one with certainty. Return the fit and its deviations."""
        joint = joint.linearised(self.camera, TILTED)
        off = joint.deviations(TILTED, sight.fit)
        better = joint.next_values()
        tilts = TILTED[2:]
        if max(off[name] for name in tilts) > LARGEST_DEVIATION["tilt"]:
            notes.append("the tilt of the prism is not determined, and stays as given")
        elif any(abs(better[name] - joint.values[name]) > CERTAIN * off[name] for name in tilts):
            joint = joint.refine(self.camera, TILTED).linearised(self.camera, TILTED)
            return joint, joint.deviations(TILTED, sight.fit)
        return joint, joint.deviations(TILTED[:2], sight.fit)

    def _free_index(
        self,
        joint: JointPrism,
        sight: Sight,
        notes: list[str],
    ) -> tuple[float, JointPrism, Sight]:
        """Find the prism's index if it differs from the given one with certainty.

        Return its deviation, or 0 if it is held, the fit, and what is seen with it. Pictures that were made with a
        wrong index bend the lens, so they are made again once another index is likely.
        """
        given = dict(joint.values)
        camera_before = self.camera
        sight_before = sight
        names = list(joint.equations)
        index = given["index"]
        off = math.inf

        def ask(names: Sequence[str]) -> tuple[float, float]:
            index, scatter = joint.index(self.camera, names)
            return index, math.hypot(scatter, joint.systematic_of_index(sight.fit))

        def differs(enough: float) -> bool:
            return abs(index - given["index"]) > enough * off

        enough = len(names) >= GOOD_POSES
        most_off = DOUBTFUL * LARGEST_DEVIATION["index"]
        if enough and joint.systematic_of_index(sight.fit) < most_off:
            index, off = ask(names[::PROBED])  # a few tell whether it is worth while
            for k in range(INDEX_ROUNDS):
                if not differs(DOUBTFUL):
                    break
                joint = joint.with_index(index)
                if k == 0:
                    model = joint.model(self.camera)
                    seen = list(sight.corners)
                    pictures = self.pictures(model, seen, MOST_PASSES, turns=PICTURE_TURNS)
                    sight = self._lens(pictures, matched=True)
                    joint = self._with_lens(joint, sight)
                joint = joint.refine(self.camera, ("apex", "phase"))
                index, off = ask(names)

        # Another index only with certainty; else all is as before.
        sure = off < LARGEST_DEVIATION["index"]
        another = sure and differs(CERTAIN)
        if joint.values != given:
            if another:
                joint = joint.with_index(index)
            else:
                joint = joint.with_values(**given)
                self.camera = camera_before
                sight = sight_before
            joint = joint.refine(self.camera, ("apex", "phase"))
        if not another and off < math.inf and differs(DOUBTFUL):
            notes.append(
                f"the events prefer an index of {index:.3f} ± {off:.3f}, but not with certainty: the given one, "
                f"{given['index']:g}, is used"
            )
        elif not sure:
            notes.append(
                f"the index of the prism is not determined, and stays as given, {given['index']:g}"
            )
        return (off if another else 0.0), joint, sight


def window_start(recording: Recording, turns: float, turn_us: float, angle: float) -> int:
    """Return the latest start of some turns of the prism at which its encoder has an angle [rad], as a time [us].

    If the recording is too short for it, return its start. ``turn_us`` is the duration of a turn [us].
    """
    events = recording.events
    encoder = recording.encoder
    assert encoder is not None
    latest = events.t_last + 1 - round(turns * turn_us)
    (angle_at_latest,) = encoder.angle_at(np.array([latest])).tolist()
    direction = math.copysign(1.0, encoder.rpm)
    beyond = direction * (angle_at_latest - angle)
    beyond_us = round(beyond % math.tau / math.tau * turn_us)
    return max(events.t_first, latest - beyond_us)


def _some(names: Sequence[str]) -> Sequence[str]:
    """Return about :data:`FIRST_POSES` of the names of poses, evenly chosen."""
    every = max(1, len(names) // FIRST_POSES)
    return names[::every]
