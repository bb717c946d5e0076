"""Settings of a calibration and of its stages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypedDict

from amiwarp.brightness.sensor_timing import SensorTiming
from amiwarp.calib.nlopt_solver import GLOBAL_ALGORITHMS, LOCAL_ALGORITHMS
from amiwarp.choices import SearchCost, Sharpness
from amiwarp.errors import AmiwarpError
from amiwarp.optics.models.registry import MODELS
from amiwarp.results.parameters import check_names
from amiwarp.schema.calls import guarded
from amiwarp.validation import choice, one_of, real, shown, whole

LARGEST_BUDGET = 10**12
"""Upper limit of the settings that give numbers of evaluations and of events."""
LARGEST_FOLD = 1 << 20
"""Upper limit of the setting ``fold``, a number of angle bins per turn."""
AUTO = "auto"
"""Name in the settings for the automatic choice of the model."""
STAGES = ("sharpness", "photometric")
"""Names of the stages of a calibration, in order."""
GAUSS_NEWTON = "gauss-newton"
"""Name of the Gauss-Newton method in the settings."""
PHASE = "phase"
"""Name in the settings of the global search over sums in phase with the prism."""
SEARCH_IF_UNCLEAR = "GN_DIRECT_L"
"""Global search of :data:`AUTO` where sums in phase do not tell the motion, and on GPUs, where it takes a few ms."""


@guarded
@dataclass(frozen=True)
class PhotometricSettings:
    """Settings of the photometric stage of a calibration.

    Examples
    --------
    >>> settings = amiwarp.PhotometricSettings(pairs=100_000)
    >>> settings.check()
    >>> settings.algorithm
    'gauss-newton'
    """

    pairs: int = 300_000
    """Approximate largest number of pairs of events, from whole turns spread over the recording. Mirrors and vibrating
    cameras, which have more parameters, get three times as many."""
    algorithm: str = GAUSS_NEWTON
    """Algorithm: ``gauss-newton`` or one of NLopt's derivative-free local algorithms."""
    evaluations: int = 80
    """Largest number of evaluations in each of the two runs of an NLopt algorithm."""
    tolerance_px: float = 0.002
    """Length below which the search's steps end it, as displacement of events [px]."""
    steps: int = 20
    """Number of conjugate-gradient steps that solve the brightness map in each evaluation, starting from the previous
    map."""
    density: float = 2.0
    """Nodes of the brightness map per pixel along each axis. With too few pairs of events for it, there is one node per
    pixel."""
    sensor: SensorTiming = field(default_factory=SensorTiming)
    """Known latency and refractory period of the sensor. If they are unknown, the calibrated phase contains their
    effect."""

    def check(self) -> None:
        """Check the settings.

        Raises
        ------
        AmiwarpError
            If the algorithm is unknown or a number out of range.
        """
        one_of(self.algorithm, (GAUSS_NEWTON, *LOCAL_ALGORITHMS), "algorithm")
        for name in ("pairs", "evaluations", "steps"):
            whole(getattr(self, name), f"photometric {name}", 1, 10**12)
        real(self.tolerance_px, "photometric tolerance_px", 0.0, 1e3, " px")
        real(self.density, "photometric density", 0.01, 100.0)


@guarded
@dataclass(frozen=True)
class Settings:
    """Settings of a calibration.

    The defaults were chosen by measurement, see ``docs/explanation/calibration.md``.

    Examples
    --------
    >>> amiwarp.Settings(model="circle", events=100_000).sharpness.value
    'variance'
    """

    model: str = AUTO
    """Name of the model, such as ``exact``, or ``auto`` for that of the recording's optic; of the models of a wedge,
    for the smallest with a tolerable error."""
    budget_px: float | None = None
    """Largest tolerated error of a smaller model for ``auto``, relative to the exact model [px rms]; None: a tenth of
    the blur by quantisation and timing."""
    sharpness: Sharpness = Sharpness.VARIANCE
    """Measure of sharpness that the search maximises."""
    cost: SearchCost = SearchCost.SHARPNESS
    """What global and local search optimise: the sharpness, or the cost of sums in phase with the prism."""
    global_algorithm: str | None = AUTO
    """Global search: an NLopt algorithm; ``phase``, a coarse-to-fine search over sums in phase; or ``auto``, on CPUs
    ``phase`` where it tells the motion, else ``GN_DIRECT_L``. None: no global search, the local search starts at
    ``start``."""
    local_algorithm: str = "LN_BOBYQA"
    """NLopt algorithm of the local search that follows the global search."""
    free: tuple[str, ...] | None = None
    """Names of the free parameters, or one name; None: size and phase, and without an encoder ``rpm``."""
    start: Mapping[str, float] = field(default_factory=dict)
    """Known or start values by parameter name, in rad, us, 1/min or px. A value of a parameter that is not free stays
    fixed."""
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Lower and upper bounds of free parameters by name, in the units of ``start``."""
    global_evaluations: int = 120
    """Number of evaluations of the global search by an NLopt algorithm. Another number than the default makes ``auto``
    search with ``GN_DIRECT_L``."""
    local_evaluations: int = 200
    """Largest number of evaluations of each local search."""
    tolerance_px: float = 0.002
    """Length below which the steps of the local search end it, as displacement of events [px]."""
    smoothing_px: float = 1.0
    """Standard deviation of the Gaussian that smooths the fine image [px]; 4 px are used for the coarse image."""
    per_polarity: bool = False
    """Whether ON and OFF events form separate images."""
    events: int = 300_000
    """Largest number of events that are used, thinned evenly; the global search uses a third of them."""
    fold: int = 0
    """Number of angle bins per turn into which each pixel's events are folded as weighted points; 0: no folding."""
    seed: int = 0
    """Seed of the algorithms that use random numbers."""
    stages: tuple[str, ...] = STAGES
    """Stages to run: ``"sharpness"`` or ``("sharpness", "photometric")``."""
    photometric: PhotometricSettings = field(default_factory=PhotometricSettings)
    """Settings of the photometric stage."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "sharpness", choice(Sharpness, self.sharpness, "sharpness"))
        object.__setattr__(self, "cost", choice(SearchCost, self.cost, "cost"))

    def check(self) -> None:
        """Check the settings.

        Raises
        ------
        AmiwarpError
            If a name is unknown or a number out of range.
        """
        one_of(self.model, (AUTO, *MODELS), "model")
        if self.global_algorithm is not None:
            one_of(self.global_algorithm, (AUTO, PHASE, *GLOBAL_ALGORITHMS), "global_algorithm")
        one_of(self.local_algorithm, LOCAL_ALGORITHMS, "local_algorithm")
        words = isinstance(self.stages, tuple) and all(
            isinstance(stage, str) for stage in self.stages
        )
        if not words or self.stages not in (STAGES, STAGES[:1]):
            raise AmiwarpError(f"stages is {shown(self.stages)}; expected 'sharpness' or {STAGES}")
        for name in ("global_evaluations", "local_evaluations", "events"):
            whole(getattr(self, name), name, 1, LARGEST_BUDGET)
        whole(self.fold, "fold", 0, LARGEST_FOLD)
        whole(self.seed, "seed", 0, 2**31 - 1)
        real(self.tolerance_px, "tolerance_px", 0.0, 1e3, " px")
        real(self.smoothing_px, "smoothing_px", 0.0, 1e3, " px")
        check_names(self.free, self.start, self.bounds)
        self.photometric.check()


class CalibrationOptions(TypedDict, total=False):
    """Names and types of the keyword arguments of :func:`calibrate`: the fields of :class:`Settings`.

    Type checkers and editors know the keyword arguments by it. Defaults and meanings are those of :class:`Settings`.

    Examples
    --------
    >>> options: amiwarp.CalibrationOptions = {"model": "exact", "events": 100_000}
    >>> amiwarp.Settings(**options).events
    100000
    """

    model: str
    budget_px: float | None
    sharpness: Sharpness
    cost: SearchCost
    global_algorithm: str | None
    local_algorithm: str
    free: str | tuple[str, ...] | None
    start: Mapping[str, float]
    bounds: Mapping[str, tuple[float, float]]
    global_evaluations: int
    local_evaluations: int
    tolerance_px: float
    smoothing_px: float
    per_polarity: bool
    events: int
    fold: int
    seed: int
    stages: str | tuple[str, ...]
    photometric: PhotometricSettings


def stage_share(settings: Settings, stage: str, share: float) -> tuple[str, float]:
    """Return a progress message and the finished share of a calibration, assuming that all stages take equally long."""
    names = [] if settings.global_algorithm is None else ["global"]
    names += ["local", "photometric"][: len(settings.stages)]
    return f"calibrating, {stage}", (names.index(stage) + min(share, 1.0)) / len(names)
