"""Evaluation of pictures that are reconstructed from events."""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any, Literal, TypedDict

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events, Recording
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.prism import Prism
from amiwarp.reconstruction.reconstruct import Reconstruction
from amiwarp.simulation.picture_light import DARK
from amiwarp.studies.evaluate.camera_motion import estimate_rotation
from amiwarp.studies.evaluate.claims import Claim, differences, judge, untestable
from amiwarp.studies.evaluate.conditions import Condition, Settings
from amiwarp.studies.evaluate.naturalness import BLOCK, niqe
from amiwarp.studies.evaluate.results import (
    Amount,
    CellResult,
    Chart,
    Compared,
    Table,
    grouped,
    rows_of,
    where,
)
from amiwarp.studies.evaluate.similarity import displayed, fitted, similarity
from amiwarp.studies.evaluate.streams import Frames, Stream, Streams
from amiwarp.validation import real

# Grey pictures of a stream: by our own reconstruction, or by a given function such as a learned one.

Made = list[tuple["Window", "NDArray[np.float64]"]]
"""Windows with their pictures."""
Reconstructor = Callable[[Events], NDArray[Any]]
"""Function that returns the picture of a window's events, shape (height, width), in any unit of log intensity. The
events are compensated, with float32 coordinates, or come from a plain camera."""

LEAST_CONTRAST = 1e-4
"""Range of log intensity up to which our own picture is uniform: rounding leaves about 1e-8, a faint edge 0.01."""


@dataclass(frozen=True, slots=True)
class Window:
    """Time window of a picture."""

    start_us: int
    """Start [us]."""
    end_us: int
    """End [us]."""

    @property
    def middle_us(self) -> int:
        """Middle, the time that the picture shows [us]."""
        return (self.start_us + self.end_us) // 2


@dataclass
class PictureMaker:
    """Makes the pictures of a stream. Without ``reconstructor``, our own reconstruction makes them."""

    streams: Streams
    """Streams of a recording."""
    stream: Stream
    """Stream; our own reconstruction refuses the stream of equal count, because it needs all events of a pixel."""
    reconstructor: Reconstructor | None = None
    """Function that makes a picture of events, or None."""
    _work: Reconstruction | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        if self.reconstructor is None:
            recording, model, encoder = own_inputs(self.streams, self.stream)
            if len(recording.events):
                self._work = Reconstruction(
                    recording,
                    model=model,
                    encoder=encoder,
                    camera_rotation=self._rotation(),
                    device=self.streams.device,
                )

    def _rotation(self) -> CameraRotation:
        """Return the camera's mean rotation, as found in the middle of the recording."""
        if not self.streams.simulation.scene.trajectory.moves:  # type: ignore[union-attr]  # a world
            return CameraRotation()
        middle = (self.streams.start_us + self.streams.end_us) // 2
        half = 25_000
        return estimate_rotation(
            self.streams.window(self.stream, middle - half, middle + half), self.streams.camera
        )

    def pictures(self, windows: Sequence[Window]) -> Iterator[NDArray[np.float64]]:
        """Yield the picture of each window, shape (height, width).

        It is 0 everywhere before there are enough events, or where they tell nothing of the scene, as without prism and
        motion: what the solver then leaves is rounding, which scores must not take for a picture.
        """
        last = None
        width, height = self.streams.size
        for window in windows:
            if self.reconstructor is not None:
                events = self.streams.window(self.stream, window.start_us, window.end_us)
                yield np.asarray(self.reconstructor(events), np.float64)
                continue
            if self._work is not None:
                with contextlib.suppress(
                    AmiwarpError
                ):  # no pixel fires twice: the picture before stays
                    last = self._work.window(
                        window.start_us, window.end_us - window.start_us, last=last
                    )
            picture = np.zeros((height, width)) if last is None else last.log.astype(np.float64)
            yield picture if np.ptp(picture) > LEAST_CONTRAST else np.zeros_like(picture)


def own_inputs(streams: Streams, stream: Stream) -> tuple[Recording, Any, Encoder]:
    """Return recording, model and encoder for our own reconstruction of a stream."""
    nothing = ExactModel(streams.camera, Prism(0.0))
    resting = Encoder.constant_speed(0.0, streams.start_us - 1_000_000, streams.end_us + 1_000_000)
    if stream is Stream.PLAIN:
        return streams.plain, nothing, resting
    recording = streams.recording
    if stream is Stream.RAW:
        return recording, nothing, resting
    model, encoder = streams.optics(stream)
    if model is None:
        raise AmiwarpError(f"stream {stream.value!r} has no reconstruction; choose another stream")
    return recording, model, encoder


def reconstructed_streams(streams: Streams) -> list[Stream]:
    """Return the streams of which our own reconstruction makes pictures."""
    return [stream for stream in streams.names if stream is not Stream.SAME_COUNT]


TITLE = "Pictures"
PROTOCOL = (
    "Our own reconstruction, which needs no training, makes a picture of each time window; windows follow each other "
    "every millisecond (1,000 pictures/s). PSNR and SSIM (scikit-image) compare it with the true luminance without the "
    "prism in the middle of the window, in log intensity, after a fit of gain and offset, which events do not "
    "determine. NIQE needs no truth; its natural pictures are eight of scikit-image's own (astronaut, brick, camera, "
    "chelsea, coffee, grass, gravel, rocket; public domain or CC0), each in three sizes. Without usable events "
    "a picture is uniform and has no NIQE. NIQE is the paper's measure; it may prefer a worse picture to the truth "
    "(see the tables), and no other implementation of it was compared. Of the standard camera, the last frame that is "
    "complete at the end of the window is compared."
)
DIFFERENCES = (
    "The paper uses the network E2VID, which is not part of amiwarp, and reports NIQE only, as curves, by statistics "
    "that its authors fitted to other pictures. Values of NIQE are therefore comparable between our streams only."
)
VERSION = 6
NEEDS_TRUTH = True

STEP_US = 1000
"""Time between the pictures [us]: 1,000 pictures/s."""
STANDARD_TURNS = 0.25
"""Length of the windows of the pictures over time [turns]."""
TURNS = (0.25, 0.5, 1.0)
QUICK_TURNS = (0.25, 1.0)
"""Lengths in the sensitivity curve [turns]."""
RATES_HZ = (30.0, 100.0, 1000.0)
HOLD = (0.0, 0.5, 1.0)
"""Rates of the pictures in the sensitivity curve [1/s], and times of comparison as shares of the interval."""
PICTURES = 6
QUICK_PICTURES = 3
"""Number of pictures over time."""


class _Quality(TypedDict):
    stream: Compared
    method: Literal["own", "frames"]
    psnr: Annotated[float, partial(real, low=-1e3, high=1e3)] | None
    ssim: Annotated[float, partial(real, low=-1.0, high=1.0)]


class _Row(_Quality):
    time_ms: Amount
    niqe: Amount | None
    niqe_truth: Amount | None


class _OverLength(_Row):
    turns: Amount


class _OverRate(_Quality):
    rate: Amount


class Values(TypedDict):
    """What :func:`measure` returns."""

    time: list[_Row]
    length: list[_OverLength]
    rate: list[_OverRate]


def conditions(settings: Settings) -> list[Condition]:
    """Return the room at rest and moving; in full also in fast motion, and the desk, moving."""
    scenes = [("room", "still"), ("room", "handheld")]
    scenes += [] if settings.quick else [("room", "fast"), ("desk", "handheld")]
    return [
        c for world, motion in scenes for c in settings.conditions(world=world, trajectory=motion)
    ]


def measure(
    streams: Streams, settings: Settings, reconstructors: Mapping[str, Reconstructor] | None = None
) -> dict[str, Any]:
    """Return PSNR, SSIM and NIQE over time, and over the length of the window.

    ``reconstructors``: learned or other reconstructions by name, which are judged next to our own.
    """
    methods: dict[str, Reconstructor | None] = {"own": None, **(reconstructors or {})}
    over_time = []
    over_length = []
    over_rate = []
    count = QUICK_PICTURES if settings.quick else PICTURES
    for method, reconstructor in methods.items():
        for stream in reconstructed_streams(streams):
            maker = PictureMaker(streams, stream, reconstructor)
            known = {"stream": stream.value, "method": method}
            over_time += [
                {**known, **row} for row in _scores(streams, _made(maker, STANDARD_TURNS, count))
            ]
            for turns in QUICK_TURNS if settings.quick else TURNS:
                made = _made(maker, turns, 1)
                over_length += [{**known, "turns": turns, **row} for row in _scores(streams, made)]
                if turns == STANDARD_TURNS:
                    over_rate += [{**known, **row} for row in _held(streams, made)]
    for camera in Frames:
        known = {"stream": camera.value, "method": "frames"}
        over_time += [{**known, **row} for row in _scores(streams, _frames(streams, camera, count))]
    return {"time": over_time, "length": over_length, "rate": over_rate}


def _frames(streams: Streams, camera: Frames, count: int) -> Made:
    """Return the windows of the pictures over time, with the last frame that is complete at the end of each."""
    pictures = []
    for window in windows(streams, STANDARD_TURNS, count):
        exposed_us = streams.last_exposure(camera, window.end_us)
        if exposed_us is not None:
            pictures.append((window, np.log(streams.frame_luminance(exposed_us) + DARK)))
    return pictures


def windows(streams: Streams, turns: float, count: int) -> list[Window]:
    """Return up to ``count`` windows, one every millisecond, about the middle of the recording."""
    length = round(turns * 60e6 / streams.condition.rpm)
    spare = streams.end_us - streams.start_us - length
    count = min(count, spare // STEP_US + 1)
    first = streams.start_us + (spare - (count - 1) * STEP_US) // 2
    starts = [first + index * STEP_US for index in range(max(count, 0))]
    return [Window(start, start + length) for start in starts]


def _made(maker: PictureMaker, turns: float, count: int) -> Made:
    """Return windows of a length, see :func:`windows`, with their pictures."""
    chosen = windows(maker.streams, turns, count)
    return list(zip(chosen, maker.pictures(chosen), strict=True))


def _scores(streams: Streams, made: Made) -> list[dict[str, Any]]:
    """Return time and scores of each picture."""
    if not made:
        return []
    first_window, _ = made[0]
    rows = []
    for window, picture in made:
        truth = log_truth(streams, window.middle_us)
        score = similarity(*fitted(picture, truth))
        rows.append(
            {
                "time_ms": (window.middle_us - first_window.middle_us) * 1e-3,
                "psnr": score.psnr_db,
                "ssim": score.ssim,
                "niqe": naturalness(picture),
                "niqe_truth": naturalness(truth),
            }
        )
    return rows


def _held(streams: Streams, made: Made) -> list[dict[str, Any]]:
    """Return the scores of pictures that are shown until the next one, for several rates of the pictures."""
    rows = []
    for window, picture in made:
        for rate in RATES_HZ:
            for share in HOLD:
                t_us = min(window.middle_us + round(share * 1e6 / rate), streams.end_us)
                score = similarity(*fitted(picture, log_truth(streams, t_us)))
                rows.append({"rate": rate, "psnr": score.psnr_db, "ssim": score.ssim})
    return rows


def log_truth(streams: Streams, t_us: int) -> NDArray[np.float64]:
    """Return the logarithm of the true luminance without the prism at a time."""
    return np.asarray(np.log(streams.frame(t_us).intensity.astype(np.float64) + DARK))


def naturalness(picture: NDArray[Any]) -> float | None:
    """Return the NIQE of a picture, or None if it is uniform or smaller than two blocks."""
    rows, columns = (side // BLOCK for side in picture.shape)
    if rows * columns >= 2 and np.ptp(picture) > 0.0:
        return niqe(displayed(picture))
    return None


def tables(results: Sequence[CellResult]) -> list[Table]:
    """Return the mean scores, and the scores over time, over the length of the window, and over the pictures' rate."""
    over_time = rows_of(results, "time")
    over_length = rows_of(results, "length")
    over_rate = rows_of(results, "rate")
    names = ("scene", "camera", "method", "stream")
    columns = (
        "seeds x pictures",
        "PSNR [dB]",
        "std of PSNR",
        "SSIM",
        "std of SSIM",
        "NIQE",
        "std of NIQE",
    )
    scores = ["psnr", "ssim", "niqe"]
    return [
        Table(
            "pictures",
            "Quality of the pictures, windows of a quarter turn",
            (*names, *columns, "NIQE of the truth", "std of the truth"),
            grouped(over_time, names, [*scores, "niqe_truth"]),
            "PSNR and SSIM: higher is better. NIQE: lower is better.",
        ),
        Table(
            "pictures_time",
            "Quality over time, 1,000 pictures/s",
            (*names, "time [ms]", *columns),
            grouped(over_time, (*names, "time_ms"), scores),
            "The first picture is solved from scratch.",
            Chart("time [ms]", "NIQE", "stream", "std of NIQE", panels=("scene", "camera")),
        ),
        Table(
            "pictures_window",
            "Quality over the length of the window",
            (*names, "window [turns]", *columns),
            grouped(over_length, (*names, "turns"), scores),
            "A long window has more events and more motion.",
            Chart(
                "window [turns]",
                "SSIM",
                "stream",
                "std of SSIM",
                panels=("scene", "camera"),
                log_x=True,
            ),
        ),
        Table(
            "pictures_rate",
            "Quality over the rate of the pictures",
            (*names, "rate [1/s]", *columns[:5]),
            grouped(over_rate, (*names, "rate"), scores[:2]),
            "A picture is shown until the next one, and "
            "compared with the truth at three times in between.",
            Chart(
                "rate [1/s]",
                "SSIM",
                "stream",
                "std of SSIM",
                panels=("scene", "camera"),
                log_x=True,
            ),
        ),
    ]


def claims(results: Sequence[CellResult]) -> list[Claim]:
    """Return the verdicts on the quality at rest and in motion by NIQE; and by SSIM and PSNR."""
    rows = where(rows_of(results, "time"), method="own")
    at_rest = where(rows, camera="still")
    moving = [row for row in rows if row["camera"] != "still"]
    lengths = where(rows_of(results, "length"), method="own")
    verdicts = [
        _is_better(
            4,
            "Pictures are better at rest (SSIM of our own reconstruction; recordings begin at rest, so that an "
            "S-EV's are uniform, which has no NIQE).",
            at_rest,
            "ssim",
        ),
        untestable(
            4,
            "Pictures are better in motion.",
            "the paper reconstructs them with the network E2VID, which remembers what it saw before and is not "
            "part of amiwarp, and NIQE depends on the window that our own reconstruction gets; see the checks",
        ),
        untestable(
            4,
            "Pictures of both cameras are satisfying in motion.",
            "the paper states no NIQE at which a picture is satisfying",
        ),
        _is_better(
            None, "Pictures are better in motion (NIQE with statistics of our own).", moving, "niqe"
        ),
        _is_better(None, "Pictures are better in motion (SSIM).", moving, "ssim"),
        _is_better(None, "Better in motion by PSNR.", moving, "psnr", "dB"),
    ]
    for score in ("ssim", "niqe"):
        text = f"Better in motion if each has the window that is best for it ({score.upper()})."
        best = [row for row in _best_lengths(lengths, score) if row["camera"] != "still"]
        verdicts.append(_is_better(None, text, best, score))
    return verdicts


def _is_better(
    number: int | None, text: str, rows: Sequence[dict[str, Any]], score: str, unit: str = ""
) -> Claim:
    """Judge whether the AMI-EV's pictures have a better score than the S-EV's: a lower NIQE, or a higher other one."""
    name = score.upper()
    return judge(
        number,
        text,
        differences(rows, score, {"stream": Stream.CALIBRATED}, {"stream": Stream.PLAIN}),
        f"the {name} of '{Stream.CALIBRATED}' less the {name} of '{Stream.PLAIN}'",
        unit=unit,
        **({"below": 0.0} if score == "niqe" else {"above": 0.0}),
    )


def _best_lengths(rows: Sequence[dict[str, Any]], score: str) -> list[dict[str, Any]]:
    """Return the rows of each stream's best length of the window, by the mean SSIM or NIQE over the seeds of a case."""
    rows = [row for row in rows if row[score] is not None]
    names = ("scene", "camera", "stream", "turns")
    # Mean score of each case, by the length of the window
    means: dict[tuple[Any, ...], dict[Any, Any]] = {}
    for scene, camera, stream, turns, _, mean, *_ in grouped(rows, names, [score]):
        means.setdefault((scene, camera, stream), {})[turns] = mean

    choose = min if score == "niqe" else max
    best_turns = {}
    for case, by_turns in means.items():
        best_turns[case] = choose(by_turns, key=by_turns.__getitem__)
    return [
        row
        for row in rows
        if row["turns"] == best_turns[row["scene"], row["camera"], row["stream"]]
    ]
