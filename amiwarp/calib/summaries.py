"""Parts of a calibration's result: the search stages, the photometric stage and the choice of the model."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from amiwarp.errors import AmiwarpError
from amiwarp.validation import guarded, shown

if TYPE_CHECKING:
    from amiwarp.calib.nlopt_solver import SearchStage


@guarded
@dataclass(frozen=True, kw_only=True)
class StageSummary:
    """Summary of one stage of the search, as the calibration file stores it."""

    name: str
    """Name of the stage: ``global``, ``local``, ``photometric`` or ``grid``."""
    algorithm: str
    """Name of the search algorithm, such as ``GN_DIRECT_L`` or ``gauss-newton``."""
    evaluations: int
    """Number of evaluations of the sharpness or of the photometric score."""
    seconds: float
    """Run time of the stage [s]."""
    sharpness: float
    """Score of the best parameters of the stage. Scores of different stages are not comparable, because their images
    differ."""
    ended: str
    """Reason why the search ended, in words."""
    points: list[dict[str, float]] = field(default_factory=list, repr=False)
    """Values of the free parameters at every evaluation, each with its ``score``, in the order of evaluation."""

    @classmethod
    def of(
        cls, name: str, stage: SearchStage, names: tuple[str, ...], values: Iterable[Mapping[str, float]]
    ) -> StageSummary:
        """Return the summary of one run of a search algorithm.

        Parameters
        ----------
        name : str
            Stage: ``global``, ``local``, ``photometric`` or ``grid``.
        stage : SearchStage
            The run.
        names : tuple of str
            Names of the free parameters.
        values : iterable of mappings
            Parameter values at every evaluated point of the run, in their units.

        Returns
        -------
        StageSummary
            The summary.
        """
        scores, found = stage.scores.tolist(), list(values)
        if len(found) != len(scores) or not all(isinstance(at, Mapping) and at.keys() >= {*names} for at in found):
            raise AmiwarpError(f"values are {shown(found)}; give {', '.join(names)} at each of {len(scores)} points")
        points = [{**{n: at[n] for n in names}, "score": score} for at, score in zip(found, scores, strict=True)]
        return cls(
            name=name, algorithm=stage.algorithm, evaluations=stage.evaluations, seconds=stage.seconds,
            sharpness=stage.score, ended=stage.ended, points=points,
        )  # fmt: skip


@guarded
@dataclass(frozen=True, kw_only=True)
class PhotometricSummary:
    """Result of the photometric stage, and whether it is accepted."""

    accepted: bool
    """Whether the result of the photometric stage passed all checks and is the calibration's result."""
    verdict: str
    """Reason why the result is accepted or rejected, in words."""
    parameters: Mapping[str, float]
    """Parameter values that the stage found, even if they are rejected: by name, in the parameters' units."""
    uncertainty: Mapping[str, float]
    """Standard deviation of each free parameter, in its unit."""
    sharpness_parameters: Mapping[str, float]
    """Parameter values that the sharpness stage found: by name, in the parameters' units."""
    moved_px: float
    """Distance between the results of the sharpness and the photometric stage [px rms]."""
    cost: float
    """Mean robust residual at the stage's result, relative to that without a brightness map."""
    cost_at_sharpness: float
    """Mean robust residual at the result of the sharpness stage, relative to that without a brightness map."""
    residual: float
    """Median magnitude of the residuals of the brightness equations [ON thresholds]."""
    pairs: int
    """Number of pairs of successive events of a pixel that were used."""
    off_over_on: float
    """Ratio of the OFF to the ON threshold: estimated if it was free, else taken from the numbers of events."""
    leak: float = 0.0
    """Drift of a pixel's reference level [thresholds/s]: estimated if it was free, else 0."""
    refractory_us: float = 0.0
    """Refractory period of the pixels [us]: the given or the estimated one; 0 if there is none."""
    time_constant_us: float = 0.0
    """Estimated time constant of slow photoreceptors at the median brightness [us]; 0 if they are not slow.

    The events come late by it, and more so in the dark. The mean lag is part of the phase.
    """
    rotation_gain: float = 0.0
    """Share of the squared residuals that a slow rotation of the camera would remove, by a linearised fit; 0 if it is
    not significant or was not examined."""
    center_px: tuple[float, float] | None = None
    """Correction of the principal point that the events ask for, by a linearised fit, and its standard deviation, as
    displacements of events [px rms]; None if it was not examined.

    A tilt of the prism's axis asks for nearly the same correction."""
    held: tuple[str, ...] = ()
    """Free parameters that the events do not determine. They keep the values of the sharpness stage."""
    warnings: tuple[str, ...] = ()
    """Corrections of the given camera and prism, and where the result does not hold, one sentence each."""


@guarded
@dataclass(frozen=True, kw_only=True)
class ModelCandidate:
    """One model that the automatic choice considered, and the evidence for and against it."""

    model: str
    """Name of the candidate model."""
    numbers: str
    """Number of the model's free parameters, and the parameters that must be known."""
    predicted_px: float
    """Predicted error: rms distance [px] at the events between the exact model and this model fitted to it."""
    sharpness: float | None
    """Mean sharpness of the model on held-out turns; None if it was not measured, as it could not change the choice."""
    loss: float | None
    """Sharpness of the exact model on held-out turns, minus this model's; None if it was not measured."""
    loss_std: float | None
    """Standard deviation of the loss, from its scatter over disjoint parts of the events; None if it was not measured.
    """
    seen_px: tuple[float, float] | None
    """Displacements that would cost as much sharpness as the loss minus and plus two standard deviations [px rms].

    Negative values are gains. None if the loss was not measured."""
    cost_ns: float | None
    """Measured time for one event's angle, displacement and vote [ns]; None if the sharpness was not measured."""
    chosen: bool
    """Whether the automatic choice selected this model."""
    verdict: str
    """Reason why the model was chosen or not, in words."""


@guarded
@dataclass(frozen=True, kw_only=True)
class FreedParameter:
    """One parameter, or a pair, that the first calibration kept fixed: whether it was freed, and why."""

    name: str
    """Name of the parameter or the pair: ``clock_offset``, ``tilt``, ``index`` or ``rpm``."""
    freed: bool
    """Whether the parameter was freed in a second calibration."""
    determined: bool
    """Whether the recording determines the parameter."""
    std_px: float | None
    """Standard deviation of the parameter, as displacement of events [px rms]; None if the parameter hardly moves
    events."""
    gain_px: tuple[float, float] | None
    """Gain in sharpness on held-out turns with the parameter free, converted to a displacement [px]; None if it was not
    measured."""
    verdict: str
    """Reason why the parameter was freed or not, in words."""


@guarded
@dataclass(frozen=True, kw_only=True)
class ModelChoice:
    """Result of the automatic choice of the model: the candidates and the evidence."""

    budget_px: float
    """Largest tolerated error of a smaller model relative to the exact model [px rms]."""
    timing_px: float
    """Estimated blur from encoder noise, clock resolution and latency jitter [px rms]."""
    agreed: bool
    """Whether the predicted errors and the held-out turns agree on every model whose sharpness was measured."""
    exact: Mapping[str, float]
    """Parameters of the exact model, to which the smaller models were fitted: values by name, in their units."""
    exact_uncertainty: Mapping[str, float]
    """Standard deviations of the exact model's free parameters, in the parameters' units."""
    rungs: tuple[ModelCandidate, ...]
    """Candidate models, from the smallest one to the exact model."""
    parameters: tuple[FreedParameter, ...]
    """Parameters that might have been freed, with the decision for each."""
    seconds: float
    """Time for the choice, without the first calibration of the exact model [s]."""
