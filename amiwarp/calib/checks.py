"""Checks of a recording and of calibrated parameters. A failed check raises an error with the reason and the remedy."""

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.bad_pixels import BadPixelSummary
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Recording
from amiwarp.imaging.canvas import Image
from amiwarp.imaging.edge_coherence import edge_coherence
from amiwarp.io.assumptions import ASSUMED_SIZE
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.registry import MODELS
from amiwarp.optics.prism import Prism

FEWEST_EVENTS = 2000
"""Smallest number of events for a calibration."""
SMALLEST_ROTATION = math.pi / 2
"""Smallest angle that the prism must turn during the events [rad]."""
LEAST_SIGNIFICANCE = 5.0
"""Smallest gain in sharpness of the calibrated parameters over the opposite phase, and over no compensation [standard
deviations]."""
LARGEST_FROM_NOMINAL = 0.18
"""Largest relative difference between the calibrated and the nominal size of the prism's orbit."""
LARGEST_FLICKER = 0.7
"""Largest share of the pixels that may be hot or flicker."""
LARGEST_DRIFT = 0.02
"""Largest drift of the index pulses relative to the encoder counts over a recording [turns]."""
FEWEST_PULSES = 3
"""Smallest number of index pulses for the check of an encoder's scale."""
STEADY = 0.2
"""Largest deviation of an index pulse from a straight line over time, as a share of the total drift. A drift with
smaller deviations is steady."""
LARGEST_COHERENCE = 0.97
"""Largest coherence of the edge directions for which a calibration is accepted: 0 if all directions are equally
frequent, 1 if all edges are parallel."""


class NoSharpOptimumError(AmiwarpError):
    """Raised if no motion of a prism makes the image of events sharp. A rotating camera can be the cause."""

    _KIND = ErrorCode.CALIBRATION_REFUSED


def check_events(count: int, name: str) -> None:
    """Raise :class:`AmiwarpError` if a recording has too few events for a calibration."""
    if count < FEWEST_EVENTS:
        raise AmiwarpError(
            f"{name}: {count} events are too few to calibrate; record at least {FEWEST_EVENTS}",
            ErrorCode.CALIBRATION_REFUSED,
        )


def check_unmasked_events(count: int, mask: NDArray[np.bool_], name: str) -> None:
    """Raise :class:`AmiwarpError` if too few events lie outside the bad pixels; ``mask`` is True for bad pixels."""
    if count < FEWEST_EVENTS:
        pixels = int(np.count_nonzero(mask))
        raise AmiwarpError(
            f"{name}: without the pixels that flicker or fire at random, {pixels:,} in all, {count} events are left; "
            f"record at least {FEWEST_EVENTS} events of edges all over the image",
            ErrorCode.CALIBRATION_REFUSED,
        )


def check_coverage(encoder: Encoder, t_first: int, t_last: int, name: str) -> None:
    """Check that the encoder gives the angle of every event."""
    if not encoder.covers(t_first, t_last):
        first, last = encoder.coverage
        raise AmiwarpError(
            f"{name}: encoder samples cover {first} .. {last} us, the events {t_first} .. {t_last} us; "
            "record the encoder for as long as the events, or select the covered events with a window",
            ErrorCode.CALIBRATION_REFUSED,
        )


def check_pulses(encoder: Encoder, name: str) -> None:
    """Check that successive index pulses are one encoder turn apart.

    A steady drift means a wrong scale: the counts per turn do not fit the encoder. Missing or additional pulses are
    tolerated. A drift in jumps means lost counts, which this check ignores.
    """
    if encoder.index_t is None or len(encoder.index_t) < FEWEST_PULSES:
        return
    pulse_turns = encoder.pulse_angles() / math.tau
    steps = np.diff(pulse_turns)
    turns = float(np.median(np.abs(steps)))
    if not turns > 0.0:
        return
    number = np.concatenate([[0.0], np.cumsum(np.rint(steps / turns))])
    slope, start = np.polyfit(number, pulse_turns, 1)
    drift = abs(abs(slope) - 1.0) * float(np.ptp(number))
    off = float(np.abs(pulse_turns - (start + slope * number)).max())
    # if every other pulse is missing, the pulses are a whole number of turns apart
    whole = abs(turns - max(1.0, round(turns))) * float(np.ptp(number)) <= LARGEST_DRIFT
    if drift > LARGEST_DRIFT and off <= STEADY * drift and not whole:
        raise wrong_scale(name, float(abs(slope)), "the index pulses come")


def wrong_scale(
    name: str, turns: float, what: str, cost: float | None = None, scaled_cost: float | None = None
) -> AmiwarpError:
    """Return the error for an encoder that counts ``turns`` while the prism turns once.

    ``what`` begins the sentence "... every 1.02 turns of the encoder". The costs are those of the photometric stage
    with the given and with the corrected scale.
    """
    evidence = (
        "the encoder slips, or"
        if cost is None or scaled_cost is None
        else f"with its angles divided by {turns:.4f} a still camera explains the events "
        f"({100 * scaled_cost:.0f} % of the residual remains instead of {100 * min(cost, 1.0):.0f} %):"
    )
    return AmiwarpError(
        f"{name}: {what} every {turns:.4f} turns of the encoder, not every turn; {evidence} its scale is off by a "
        f"factor of {turns:.4f}: read the encoder log again with counts_per_turn (--counts-per-turn) times {turns:.4f}",
        ErrorCode.CALIBRATION_REFUSED,
    )


def wrong_direction(name: str, cost: float, reversed_cost: float) -> AmiwarpError:
    """Return the error for an encoder that counts against the prism's direction of rotation.

    The costs are those of the photometric stage with the given and with the reversed direction.
    """
    return AmiwarpError(
        f"{name}: the prism turns against the direction of the encoder: with its angles reversed a still camera "
        f"explains the events ({100 * reversed_cost:.0f} % of the residual remains instead of "
        f"{100 * min(cost, 1.0):.0f} %); read the encoder log again with the other direction (--direction)",
        ErrorCode.CALIBRATION_REFUSED,
    )


HOLD_STILL = (
    "hold the camera still for three turns, at any time of the recording, or turn the prism faster"
)
"""Remedy for a camera in fast motion."""


def moves_too_fast(name: str, repetition: float, *, short: bool) -> AmiwarpError:
    """Return the error for a camera in fast motion; ``repetition`` is the correlation of events of successive turns.

    A longer recording may help one that is ``short``.
    """
    return AmiwarpError(
        f"{name}: the camera moves too fast for the prism: the events of one turn repeat in the next with a correlation"
        f" of {repetition:.2f} at most (0.9 at rest, 0.7 in a calm hand), and no motion of the camera explains them at "
        f"all times; {HOLD_STILL}{', or record such motion for 40 turns' if short else ''}",
        ErrorCode.CALIBRATION_REFUSED,
    )


def short_gyroscope(name: str, turns: int, least: int) -> AmiwarpError:
    """Return the error for a fast camera whose gyroscope covers too few ``turns``."""
    return AmiwarpError(
        f"{name}: the camera moves fast, and its gyroscope covers {turns} parts of one and a half turns; record at "
        f"least {least}",
        ErrorCode.CALIBRATION_REFUSED,
    )


def unexplained_by_gyroscope(name: str) -> AmiwarpError:
    """Return the error for a fast camera whose events are not explained with the gyroscope's rotation either."""
    return AmiwarpError(
        f"{name}: the gyroscope's rotation and a motion of the parts of the image do not explain the events of single "
        "turns of the prism; keep away from near things, or move more slowly",
        ErrorCode.CALIBRATION_REFUSED,
    )


def scatters(name: str, turns: int, stated_px: float, most_px: float) -> AmiwarpError:
    """Return the error for a fast camera if the answers of single turns differ too much for their mean to be used."""
    return AmiwarpError(
        f"{name}: the camera never rests, and the answers of {turns} turns of the prism differ: their mean is "
        f"uncertain by {stated_px:.2f} px, more than {most_px:g} px; {HOLD_STILL}, or record more turns",
        ErrorCode.CALIBRATION_REFUSED,
    )


def check_turned(theta: NDArray[np.float64], name: str, which: str = "the prism") -> None:
    """Check that a prism turned far enough; ``which`` names it.

    In less than a quarter turn, the size and the phase of the prism's orbit cannot be determined separately.
    """
    turned = float(np.ptp(theta))
    if turned < SMALLEST_ROTATION:
        raise AmiwarpError(
            f"{name}: {which} turned {math.degrees(turned):.1f} degrees during the events; "
            "record at least a quarter turn (90 degrees), better a whole one",
            ErrorCode.CALIBRATION_REFUSED,
        )


def check_light(mask: NDArray[np.bool_], summary: BadPixelSummary, name: str) -> None:
    """Check that most of the image neither flickers nor is hot, which hides the scene's edges."""
    if mask.mean() > LARGEST_FLICKER:
        if not summary.lamps_hz:
            raise AmiwarpError(
                f"{name}: {100 * mask.mean():.0f} % of the pixels are hot; record with other biases, or cooler",
                ErrorCode.CALIBRATION_REFUSED,
            )
        lamps = " and ".join(f"{hz:.0f}" for hz in summary.lamps_hz)
        raise AmiwarpError(
            f"{name}: {100 * mask.mean():.0f} % of the pixels flicker at {lamps} Hz; "
            "use daylight or flicker-free lighting",
            ErrorCode.CALIBRATION_REFUSED,
        )


CENTRED_PX = 0.01
"""Largest distance of a principal point from the centre of an image that it is placed at [px]."""


def size_warnings(recording: Recording) -> tuple[str, ...]:
    """Return a warning if the camera's centre follows from a sensor size that is assumed, and nothing otherwise."""
    camera = recording.camera
    if ASSUMED_SIZE not in recording.metadata or camera is None:
        return ()
    width, height = camera.width, camera.height
    if max(abs(camera.cx - (width - 1) / 2), abs(camera.cy - (height - 1) / 2)) > CENTRED_PX:
        return ()
    return (
        f"the file does not state the sensor size: {width}x{height} px is assumed, and the camera's centre with it; if "
        "the sensor has another size, give it with --size",
    )


def check_nominal(model: str, parameters: Mapping[str, float], nominal: Prism, name: str) -> None:
    """Check the prism's size against the nominal one.

    Prisms are made to within a few percent. A larger difference means another prism, or motion that is not the prism's.
    """
    kind = MODELS[model]
    size = kind.SIZE
    if size not in parameters:
        return
    share = parameters[size] / kind.size_from_apex(nominal.apex, nominal)
    if not abs(share - 1.0) <= LARGEST_FROM_NOMINAL:
        raise AmiwarpError(
            f"{name}: the calibrated size of the prism is {100 * share:.0f} % of its nominal {size} (nominal apex "
            f"{math.degrees(nominal.apex):.4g} deg): the camera shakes with the prism, or the nominal prism or the "
            f"focal length is wrong; correct these, or give bounds of {size} if the answer is right",
            ErrorCode.CALIBRATION_REFUSED,
        )


SWAPPED_SHARE = 1.0 / 3.0
LEAST_SWAPPED = 0.05
"""Two prisms look exchanged if, with their nominal apexes exchanged, the largest relative difference of an apex from
the nominal one is at most this share of that without, which must have this least size."""


def look_swapped(parameters: Mapping[str, float], nominal: Prism) -> bool:
    """Return whether the apexes of two prisms fit the nominal ones far better the other way round."""
    second = nominal.second
    if (
        second is None
        or not {"apex", "second_apex"} <= parameters.keys()
        or not min(nominal.apex, second.apex) > 0.0
    ):
        return False
    away = _from_nominal(parameters, (nominal.apex, second.apex))
    exchanged = (second.apex, nominal.apex)
    return away >= LEAST_SWAPPED and _from_nominal(parameters, exchanged) <= SWAPPED_SHARE * away


def pair_is_far(parameters: Mapping[str, float], nominal: Prism) -> bool:
    """Return whether a prism of a pair is so far from its nominal size that the answer is refused."""
    assert nominal.second is not None
    return _from_nominal(parameters, (nominal.apex, nominal.second.apex)) > LARGEST_FROM_NOMINAL


def _from_nominal(parameters: Mapping[str, float], apexes: tuple[float, float]) -> float:
    """Return the largest relative difference of the apexes of two prisms from nominal ones [rad]."""
    found = (parameters["apex"], parameters["second_apex"])
    return max(abs(apex / stated - 1.0) for apex, stated in zip(found, apexes, strict=True))


def swapped_encoders(
    given: Mapping[str, float], parameters: Mapping[str, float], nominal: Prism
) -> str:
    """Return that the encoders of two prisms seem to be swapped, in words.

    ``given`` are the parameters with the encoders as they are, ``parameters`` those with them exchanged.
    """
    assert nominal.second is not None

    def of_nominal(values: Mapping[str, float]) -> str:
        assert nominal.second is not None
        first = values["apex"] / nominal.apex
        second = values["second_apex"] / nominal.second.apex
        return f"{100 * first:.0f} and {100 * second:.0f} %"

    return (
        f"the encoders of the two prisms seem to be swapped: as given, the prisms have {of_nominal(given)} of their "
        f"nominal apexes, with the encoders exchanged {of_nominal(parameters)}; give --encoder that of the prism next "
        "to the camera and --second-encoder the other, or exchange the nominal apexes if those are swapped"
    )


def significance(best: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Return the mean of ``best - other``, a gain in sharpness of disjoint parts [standard deviations of the mean]."""
    gain = best - other
    spread = float(gain.std(ddof=1)) / math.sqrt(len(gain))
    return float(gain.mean()) / max(spread, 1e-12)


def _in_words(gain: float) -> str:
    """Return a significance as text. A negative number is not shown, because it carries no information."""
    return f"{gain:.1f} standard deviations" if gain > 0.0 else "it is less sharp, or the same"


def check_size(kind: type[Model], least: float, bound: float, name: str) -> None:
    """Check that the size of the orbit by a kind of model may be at least ``least`` under its upper ``bound`` [rad]."""
    if least > bound:
        size = kind.SIZE
        remedy = (
            "give the prism's nominal apex, or wider bounds" if kind.PRISM else "give wider bounds"
        )
        raise NoSharpOptimumError(
            f"{name}: the image is sharpest for the largest {size} that is tried, {math.degrees(bound):.3g} deg "
            f"({kind.SIZE_HINT}, unless bounds are given): {remedy} ({size}=0:{2.0 * math.degrees(bound):.3g}deg)"
        )


def check_texture(
    best: NDArray[np.float64],
    opposite: NDArray[np.float64],
    still: NDArray[np.float64],
    name: str,
    mover: str = Model.MOVER,
) -> None:
    """Check that the image is sharper at the optimum than by chance, and than without compensation.

    Each array holds the sharpness of disjoint parts of the events: at the optimum, half a turn later, and without
    motion compensation. ``mover`` names what moves the image.
    """
    gain = significance(best, opposite)
    if not gain >= LEAST_SIGNIFICANCE:
        raise NoSharpOptimumError(
            f"{name}: no motion of a {mover} makes the image sharper than chance does ({_in_words(gain)}): "
            "no texture, too few events, or a wrong encoder; show the camera a scene with edges"
        )
    gain = significance(best, still)
    if not gain >= LEAST_SIGNIFICANCE:
        cause = (
            "no prism turned, its apex is too small for these events, or the encoder is wrong; "
            "check prism and encoder"
        )
        if mover != Model.MOVER:
            cause = (
                f"the {mover} is too small for these events, or its frequency is wrong; give rpm"
            )
        raise NoSharpOptimumError(
            f"{name}: the image is as sharp with no motion compensation ({_in_words(gain)}): {cause}, or record more "
            "events"
        )


def check_sharper(gain: float, name: str) -> None:
    """Check that another cause makes the image sharper, by a ``gain`` in standard deviations."""
    if not gain >= LEAST_SIGNIFICANCE:
        raise AmiwarpError(
            f"{name}: this makes the image no sharper ({_in_words(gain)})",
            ErrorCode.CALIBRATION_REFUSED,
        )


def check_directions(image: Image, inset: int, name: str) -> None:
    """Check that the image has edges of more than one direction: motion along an edge is invisible.

    Pixels within ``inset`` of its border do not count.
    """
    coherence = edge_coherence(image, inset)
    if coherence > LARGEST_COHERENCE:
        raise AmiwarpError(
            f"{name}: all edges run in one direction (coherence {coherence:.2f} of 1), so motion along them is "
            "invisible; show the camera edges in at least two directions",
            ErrorCode.CALIBRATION_REFUSED,
        )
