"""Parts of a calibration's result: the search stages, the photometric stage and the choice of the model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from amiwarp.calib.nlopt_solver import SearchStage
    from amiwarp.calib.parameters import ParameterSpace


@dataclass(frozen=True, kw_only=True)
class StageSummary:
    """One stage of the search, as the calibration's file stores it."""

    name: str
    """Stage: ``global``, ``local``, ``photometric`` or ``grid``."""
    algorithm: str
    """Name of the algorithm."""
    evaluations: int
    """Number of evaluations of the score."""
    seconds: float
    """Run time [s]."""
    sharpness: float
    """Score of the stage's answer. Scores of different stages are not comparable: their images differ."""
    ended: str
    """Reason why the search ended."""
    points: list[dict[str, float]] = field(default_factory=list, repr=False)
    """Free parameters of every evaluation, each with its ``score``, in order."""

    @classmethod
    def of(cls, name: str, stage: SearchStage, space: ParameterSpace) -> StageSummary:
        """Return the summary of one run of a search algorithm.

        Parameters
        ----------
        name : str
            Stage: ``global``, ``local``, ``photometric`` or ``grid``.
        stage : SearchStage
            The run.
        space : ParameterSpace
            Space whose vectors the run evaluated.

        Returns
        -------
        StageSummary
            The summary.
        """
        points = []
        for x, score in zip(stage.points, stage.scores, strict=True):
            values = space.to_values(x)
            points.append({**{n: values[n] for n in space.names}, "score": float(score)})
        return cls(
            name=name, algorithm=stage.algorithm, evaluations=stage.evaluations, seconds=stage.seconds,
            sharpness=stage.score, ended=stage.ended, points=points,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class PhotometricSummary:
    """Result of the photometric stage, and whether it is accepted."""

    accepted: bool
    """Whether the result passed all checks."""
    verdict: str
    """Reason why the result is accepted or rejected, in words."""
    parameters: Mapping[str, float]
    """The stage's answer, also if it is rejected: values by name, in the parameters' units."""
    uncertainty: Mapping[str, float]
    """Standard deviation of each free parameter, in its unit."""
    sharpness_parameters: Mapping[str, float]
    """Answer of the sharpness stage: values by name, in the parameters' units."""
    moved_px: float
    """Distance between the answers of the two stages [px rms]."""
    cost: float
    """Mean robust residual at the answer, relative to that without a brightness map."""
    cost_at_sharpness: float
    """Cost at the answer of the sharpness stage, relative to that without a brightness map."""
    residual: float
    """Median magnitude of the residuals [ON thresholds]."""
    pairs: int
    """Number of pairs of events used."""
    off_over_on: float
    """Ratio of the OFF to the ON threshold: estimated if it was free, else taken from the numbers of events."""
    leak: float = 0.0
    """Drift of a pixel's reference level [thresholds/s]: solved for if it was free, else 0."""
    held: tuple[str, ...] = ()
    """Free parameters that the events do not determine. They keep their start values."""


@dataclass(frozen=True, kw_only=True)
class ModelCandidate:
    """One model that the automatic choice considered, and the evidence for and against it."""

    model: str
    """Name of the model."""
    numbers: str
    """Number of the model's parameters, and which are given."""
    predicted_px: float
    """Predicted error: rms distance [px] at the events between the exact model and this model fitted to it."""
    sharpness: float
    """Sharpness on held-out turns."""
    loss: float
    """Sharpness of the exact model on held-out turns, minus this model's."""
    loss_std: float
    """Standard deviation of the loss, from its scatter over disjoint parts of the events."""
    seen_px: tuple[float, float]
    """Displacements that would cost as much sharpness as the loss minus and plus two standard deviations [px rms].

    Negative values are gains."""
    cost_ns: float
    """Measured time for one event's angle, displacement and vote [ns]."""
    chosen: bool
    """Whether this model was chosen."""
    verdict: str
    """Reason for the decision, in words."""


@dataclass(frozen=True, kw_only=True)
class FreedParameter:
    """One parameter, or a pair, that the first calibration kept fixed: whether it was freed, and why."""

    name: str
    """Name of the parameter or the pair: ``clock_offset``, ``tilt``, ``index`` or ``rpm``."""
    freed: bool
    """Whether it was freed."""
    determined: bool
    """Whether the recording determines it."""
    std_px: float | None
    """Its standard deviation, as displacement of events [px rms]; None if it hardly moves them."""
    gain_px: tuple[float, float] | None
    """Gain on held-out turns as a displacement, like :attr:`ModelCandidate.seen_px`; None if it was not measured."""
    verdict: str
    """Reason for the decision, in words."""


@dataclass(frozen=True, kw_only=True)
class ModelChoice:
    """Automatic choice of the model: the candidates and the evidence."""

    budget_px: float
    """Largest model error that is tolerated [px rms]."""
    timing_px: float
    """Estimated blur from encoder noise, clock resolution and latency jitter [px rms]."""
    agreed: bool
    """Whether prediction and held-out turns agree on the chosen model and on all smaller ones."""
    exact: Mapping[str, float]
    """Parameters of the exact model, to which the smaller models were fitted: values by name, in their units."""
    exact_uncertainty: Mapping[str, float]
    """Their standard deviations, in the same units."""
    rungs: tuple[ModelCandidate, ...]
    """The candidates, from the smallest model to the exact one."""
    parameters: tuple[FreedParameter, ...]
    """Parameters that were considered for freeing."""
    seconds: float
    """Time for the choice, without the first calibration of the exact model [s]."""
