"""Result of a calibration: parameters with units and uncertainty, the search that found them, and the JSON file."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import Sharpness
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.encoder import Encoder, each_encoder
from amiwarp.io.inputs import errors_name
from amiwarp.io.json_files import read_json
from amiwarp.io.output_formats import check_ending
from amiwarp.io.outputs import write_text
from amiwarp.optics.camera import Camera, camera_from_json, camera_to_json
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.models.registry import MODELS, build_model
from amiwarp.optics.prism import Plate, Prism, as_wedge
from amiwarp.results.parameters import MOTION, rotation_from_values, units
from amiwarp.results.search_stage import SearchStage
from amiwarp.schema.calls import guarded
from amiwarp.schema.records import build, fields_of
from amiwarp.validation import one_of, real, shown


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
        cls,
        name: str,
        stage: SearchStage,
        names: tuple[str, ...],
        values: Iterable[Mapping[str, float]],
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
        scores = stage.scores.tolist()
        values = list(values)
        complete = all(isinstance(row, Mapping) and row.keys() >= {*names} for row in values)
        if len(values) != len(scores) or not complete:
            raise AmiwarpError(
                f"values are {shown(values)}; give {', '.join(names)} at each of {len(scores)} points"
            )
        points = []
        for at_point, score in zip(values, scores, strict=True):
            point = {name: at_point[name] for name in names}
            points.append({**point, "score": score})
        return cls(
            name=name,
            algorithm=stage.algorithm,
            evaluations=stage.evaluations,
            seconds=stage.seconds,
            sharpness=stage.score,
            ended=stage.ended,
            points=points,
        )


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
    """Mean robust residual at the stage's result, relative to the residual without a brightness map."""
    cost_at_sharpness: float
    """Mean robust residual at the result of the sharpness stage, relative to the residual without a brightness map."""
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
    harmonics: tuple[float, ...] = ()
    """Correction of the encoder's angle by an error that repeats every turn, in the form of
    :attr:`Calibration.harmonics`, if the events ask for one; else empty."""
    moving: tuple[tuple[bool, ...], ...] = ()
    """Parts of the image, row by row, in which something moves while the other parts are still: True for those; empty
    if there are no such parts."""
    deviation_px: float | None = None
    """Standard deviation of the motion that the result takes out of the events, as far as they determine it [px rms],
    without a constant lag; None if it was not examined."""
    hidden_px: Mapping[str, float] = field(default_factory=dict)
    """By how much each cause of an error that was looked for may still change that motion [px rms], by its words: twice
    the standard deviation of what the events show of it, beyond its estimate."""
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


FORMAT = "amiwarp-calibration"
"""Value of the calibration file's field ``format``."""
VERSION = 1
"""Version of the calibration file's layout."""
NEEDED = (
    "format",
    "version",
    "model",
    "camera",
    "prism",
    "parameters",
    "sharpness",
    "zero_us",
    "photometric",
    "events",
    "seconds",
    "warnings",
    "stages",
)
"""Fields that every calibration file has."""
OPTIONAL = ("middle_us", "ladder", "harmonics", "path")
"""Fields of the calibration file that files of earlier versions lack."""
SHARPNESS = [kind.value for kind in Sharpness]
"""Names of the sharpness measures."""


@guarded
@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Calibrated parameters of one model of a camera and its prism.

    Angles are in rad; the JSON file also gives them in degrees. Construction takes keyword arguments only.

    Examples
    --------
    >>> camera, prism = amiwarp.Camera.from_fov(64, 48, 1.0), amiwarp.Prism(0.035)
    >>> calibration = amiwarp.Calibration(
    ...     model_name="exact", camera=camera, prism=prism, parameters={"apex": 0.026, "phase": 0.4}, uncertainty={},
    ...     free=("apex", "phase"), sharpness_name="variance", sharpness_before=1.0, sharpness_after=2.0, stages=(),
    ...     events=300_000, seconds=1.5,
    ... )
    >>> calibration.model.prism.apex
    0.026
    >>> calibration.save("calibration.json")
    >>> amiwarp.Calibration.load("calibration.json").parameters["phase"]
    0.4
    """

    model_name: str
    """Name of the model, such as ``exact``."""
    camera: Camera
    """Given camera, corrected where the events contradict it. If ``parameters`` contain a focal length, it replaces the
    camera's focal length."""
    prism: Prism | Plate
    """Nominal prism. It gives the flat side, corrected if the events contradict it, and the index if that was not free.
    Its apex is 0 for a camera without a prism.
    """
    parameters: Mapping[str, float]
    """Parameter values by name: angles in rad, ``clock_offset`` in us, ``rpm`` in 1/min, ``focal_length`` in px,
    ``rate_*`` in rad/s, ``change_*`` in rad/s²."""
    uncertainty: Mapping[str, float]
    """Standard deviations of the free parameters by name, in the units of ``parameters``."""
    free: tuple[str, ...]
    """Names of the parameters that the calibration determined."""
    sharpness_name: str
    """Name of the sharpness measure, a value of :class:`amiwarp.Sharpness`."""
    sharpness_before: float
    """Sharpness of the events before compensation."""
    sharpness_after: float
    """Sharpness of the events after compensation by this calibration."""
    stages: tuple[StageSummary, ...]
    """Stages of the search (global, local, photometric), in the order in which they ran."""
    events: int
    """Number of events that the last sharpness search used."""
    seconds: float
    """Total run time of the calibration, reading included [s]."""
    warnings: tuple[str, ...] = ()
    """Warnings for the user, one sentence each."""
    zero_us: int | None = None
    """Time on the events' clock at which the prism angle is 0 [us], if the recording has no encoder; else None."""
    photometric: PhotometricSummary | None = None
    """Result of the photometric stage; None if it did not run."""
    middle_us: int | None = None
    """Time on the events' clock for which the camera's rates hold [us]; None if its rotation was not free."""
    ladder: ModelChoice | None = None
    """Evidence for the choice of the model; None if the settings named a model."""
    harmonics: tuple[float, ...] | None = None
    """Correction of the encoder's angle e by an error that repeats every turn: the factors of cos e, sin e, cos 2e and
    sin 2e [rad], and the factors of 3e and 4e if it has them, for a pair of prisms or a mirror as many for each of its
    angles (see :meth:`amiwarp.Encoder.with_harmonics`); None for no correction."""
    path: Encoder | None = None
    """Path of the prism's angle that was found in the events. Without an encoder, the path of a speed that is not
    constant. With one, the angles instead of its own, on its clock, if these were wrong: after counts that were lost,
    or between index pulses that come once a turn; of a pair of prisms, both paths. Else None. It holds for its own
    recording only."""

    def __repr__(self) -> str:
        values = ", ".join(map(self._in_words, self.parameters))
        gain = f"{self.sharpness_name} {self.sharpness_before:.3g} -> {self.sharpness_after:.3g}"
        warned = ""
        if len(self.warnings) == 1:
            warned = ", 1 warning"
        elif self.warnings:
            warned = f", {len(self.warnings)} warnings"
        return f"Calibration({self.model_name}: {values};\n            {gain}, {self.events:,} events{warned})"

    def _in_words(self, name: str) -> str:
        """Return a parameter with its standard deviation and unit, angles in degrees."""
        unit = units().get(name, "")
        scale = 1.0
        if unit.startswith("rad"):
            scale = math.degrees(1.0)
            unit = unit.replace("rad", "deg", 1)
        std = f" ± {self.uncertainty[name] * scale:.2g}" if name in self.uncertainty else ""
        return f"{name} {self.parameters[name] * scale:.5g}{std} {unit}".rstrip()

    @property
    def model(self) -> Model:
        """Optical model with the calibrated parameters."""
        return build_model(self.model_name, self.camera, self.prism, self.parameters)

    @property
    def exact(self) -> Calibration:
        """Calibration of the exact model to which a smaller model was fitted; itself if the settings named a model."""
        if self.ladder is None:
            return self
        size = MODELS[self.model_name].SIZE
        exact = ExactModel
        free = tuple(exact.SIZE if name == size else name for name in self.free)
        return replace(
            self,
            model_name=exact.NAME,
            parameters=self.ladder.exact,
            uncertainty=self.ladder.exact_uncertainty,
            free=free,
            ladder=None,
        )

    @property
    def camera_rotation(self) -> CameraRotation | None:
        """Rotation of the camera about the time ``middle_us``; None if it was neither free nor given."""
        if not any(name in self.parameters for name in MOTION):
            return None
        return rotation_from_values(self.parameters, self.middle_us or 0)

    def encoder_for(self, encoder: Encoder | None, t_first: int, t_last: int) -> Encoder:
        """Return the encoder to compensate a recording with.

        Parameters
        ----------
        encoder : Encoder or None
            The recording's encoder, if it has one.
        t_first : int
            Time of the first event [us].
        t_last : int
            Time of the last event [us].

        Returns
        -------
        Encoder
            The given encoder with the calibrated clock offset and correction, or with the path instead of its angles
            if it was found for this encoder's samples; without an encoder, the path that was found, or one of the
            calibrated constant speed. If the prism's size is 0, an encoder at rest: the angle then has no effect.

        Raises
        ------
        AmiwarpError
            If the recording has no encoder and the calibration no rpm, or a path that does not cover the events; or if
            it has one and the calibration was made without.
        """
        model = MODELS[self.model_name]
        if all(self.parameters.get(size) == 0.0 for size, _ in model.ORBITS):
            rest = constant_speed(0.0, t_first, t_last, t_first)
            return rest if model.ANGLES == 1 else rest.with_second(1.0)
        if encoder is None:
            return self._path_found(t_first, t_last)
        check_made_with_encoder(self)
        if self.path is not None and replaces(self.path, encoder):
            encoder = replace(self.path, clock_offset_us=encoder.clock_offset_us)
        offset_us = self.parameters.get("clock_offset", encoder.clock_offset_us)
        encoder = encoder.with_clock_offset(offset_us)
        return encoder if self.harmonics is None else encoder.with_harmonics(self.harmonics)

    def _path_found(self, t_first: int, t_last: int) -> Encoder:
        """Return the path or the constant speed that a calibration without an encoder found, for a span of times [us].

        Raises :class:`AmiwarpError` if there is neither, or the path does not cover the span.
        """
        if self.path is not None:
            if not self.path.covers(t_first, t_last):
                first, last = self.path.coverage
                raise AmiwarpError(
                    "the recording has no encoder, and the calibration found the prism's path for one recording only, "
                    f"from {first} to {last} us; calibrate this recording itself",
                    ErrorCode.CONTENT_MISSING,
                )
            return self.path
        if "rpm" not in self.parameters or self.zero_us is None:
            raise AmiwarpError(
                "the recording has no encoder and the calibration has no rpm; calibrate this recording itself",
                ErrorCode.CONTENT_MISSING,
            )
        return constant_speed(self.parameters["rpm"], t_first, t_last, self.zero_us)

    def to_json(self) -> dict[str, Any]:
        """Return the content of the JSON file.

        Returns
        -------
        dict
            Content of the file, in types that JSON knows.
        """
        return {
            "format": FORMAT,
            "version": VERSION,
            "model": self.model_name,
            "camera": camera_to_json(self.camera),
            "prism": prism_to_json(self.prism) if MODELS[self.model_name].PRISM else None,
            "parameters": {name: self._parameter(name) for name in self.parameters},
            "sharpness": {
                "kind": self.sharpness_name,
                "before": self.sharpness_before,
                "after": self.sharpness_after,
            },
            "zero_us": self.zero_us,
            "middle_us": self.middle_us,
            "harmonics": None if self.harmonics is None else list(self.harmonics),
            "path": None if self.path is None else _path_to_json(self.path),
            "photometric": None if self.photometric is None else asdict(self.photometric),
            "ladder": None if self.ladder is None else asdict(self.ladder),
            "events": self.events,
            "seconds": self.seconds,
            "warnings": list(self.warnings),
            "stages": [asdict(stage) for stage in self.stages],
        }

    def _parameter(self, name: str) -> dict[str, Any]:
        """Return the content of the file about one parameter."""
        value = self.parameters[name]
        unit = units()[name]
        entry: dict[str, Any] = {"value": value, "unit": unit, "free": name in self.free}
        if name in self.uncertainty:
            entry["std"] = self.uncertainty[name]
        if unit == "rad":
            entry["degrees"] = math.degrees(value)
        if name == "rpm" and not MODELS[self.model_name].PRISM:
            entry["hz"] = value / 60.0
        return entry

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write the calibration to a JSON file.

        Parameters
        ----------
        path : path
            The file, which ends in ``.json``.
        overwrite : bool
            Whether to replace an existing file.

        Raises
        ------
        AmiwarpError
            If the file has another extension, exists and ``overwrite`` is False, or cannot be written.
        """
        path = Path(path)
        check_ending(path, "calibrations are written", [".json"])
        write_text(
            path, json.dumps(self.to_json(), indent=1, allow_nan=False) + "\n", overwrite=overwrite
        )

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Calibration:
        """Read a calibration from a JSON file that :meth:`save` wrote.

        Parameters
        ----------
        path : path
            The file.

        Returns
        -------
        Calibration
            The calibration.

        Raises
        ------
        AmiwarpError
            If the file cannot be read or is damaged. The message names the file and the field.
        """
        data = read_json(path, "a calibration")
        if data.get("format") != FORMAT or data.get("version") != VERSION:
            raise AmiwarpError(
                f"{path}: not an {FORMAT} file of version {VERSION}; create one with 'amiwarp calibrate'",
                ErrorCode.FORMAT_UNKNOWN,
            )
        with errors_name(Path(path), lambda: "damaged calibration, calibrate again"):
            return cls._from_json(data)

    @classmethod
    def _from_json(cls, data: dict[str, Any]) -> Calibration:
        fields_of(data, "", *NEEDED, optional=OPTIONAL)
        model = one_of(data["model"], MODELS, "field model")
        given = fields_of(
            data["parameters"], "parameters", *MODELS[model].FREE[:2], optional=tuple(units())
        )
        entries = {name: _entry(name, entry) for name, entry in given.items()}
        prism = prism_from_json(data["prism"], "prism") if MODELS[model].PRISM else Prism(0.0)
        sharpness = build(_Sharpness, data["sharpness"], "sharpness")
        path = None if data.get("path") is None else build(_Path, data["path"], "path")
        names = [field.name for field in fields(_PlainFields)]
        rest = build(_PlainFields, {name: data[name] for name in names if name in data}, "")
        result = cls(
            model_name=model,
            camera=camera_from_json(data["camera"], "camera"),
            prism=prism,
            parameters={name: entry.value for name, entry in entries.items()},
            uncertainty={
                name: entry.std for name, entry in entries.items() if entry.std is not None
            },
            free=tuple(name for name, entry in entries.items() if entry.free),
            sharpness_name=one_of(sharpness.kind, SHARPNESS, "field sharpness.kind"),
            sharpness_before=sharpness.before,
            sharpness_after=sharpness.after,
            path=None if path is None else path.encoder(),
            **{name: getattr(rest, name) for name in names},
        )
        # Values that no model can have are a damaged file; the closed form checks them quickly.
        _ = replace(result, model_name=MODELS[model].closed_form().NAME).model
        return result


def check_made_with_encoder(calibration: Calibration) -> None:
    """Raise :class:`AmiwarpError` for a calibration without an encoder: the angle 0 of an encoder is another one."""
    if calibration.zero_us is not None or "rpm" in calibration.parameters:
        raise AmiwarpError(
            "the recording has an encoder, and the calibration was made without one, so its phase holds for its own"
            " recording only; calibrate a recording with the encoder"
        )


def replaces(path: Encoder, encoder: Encoder) -> bool:
    """Return whether a path was found for the samples of this encoder, or for a part of them.

    It then has their times, and angles that differ by less than half a turn. Another recording has other times. With
    two angles, both must have them.
    """
    paths = each_encoder(path)
    encoders = each_encoder(encoder)
    if len(paths) != len(encoders):
        return False
    return all(map(_replaces_one, paths, encoders))


def _replaces_one(path: Encoder, encoder: Encoder) -> bool:
    """Return whether the path of one angle was found for the samples of its encoder, or for a part of them."""
    first, last = np.searchsorted(encoder.t, [path.t[0], path.t[-1] + 1])
    own_turns = slice(int(first), int(last))
    if last - first < 2 or not np.isin(encoder.t[own_turns], path.t).all():
        return False
    sample = np.searchsorted(path.t, encoder.t[own_turns])
    return bool((np.abs(path.angle[sample] - encoder.angle[own_turns]) < math.pi).all())


def prism_to_json(prism: Prism | Plate) -> dict[str, Any]:
    """Return a prism, with the second one of a pair, or a plate, in types that JSON knows."""
    if isinstance(prism, Plate):
        return {"thickness_m": prism.thickness, "tilt_rad": prism.tilt, "index": prism.index}
    fields_of_prism: dict[str, Any] = {
        "apex_rad": prism.apex,
        "index": prism.index,
        "flat_side": prism.flat_side.value,
    }
    if prism.second is not None:
        fields_of_prism["second"] = prism_to_json(prism.second)
    return fields_of_prism


def prism_from_json(data: Any, name: str) -> Prism | Plate:
    """Return the prism or the plate of :func:`prism_to_json`."""
    if isinstance(data, dict) and "thickness_m" in data:
        plate = fields_of(data, name, "thickness_m", "tilt_rad", "index")
        return Plate(plate["thickness_m"], plate["tilt_rad"], plate["index"])
    given = fields_of(data, name, "apex_rad", "index", "flat_side", optional=("second",))
    second = given.get("second")
    behind = None if second is None else as_wedge(prism_from_json(second, f"{name}.second"))
    return Prism(given["apex_rad"], given["index"], given["flat_side"], behind)


@dataclass(frozen=True)
class _Entry:
    """Entry of one parameter in the calibration file."""

    value: float
    free: bool
    unit: str
    std: float | None = None
    degrees: float | None = None
    """The value in degrees, for human readers; ignored on reading."""
    hz: float | None = None
    """The frequency of a vibration [Hz], for human readers; ignored on reading."""


@dataclass(frozen=True)
class _Sharpness:
    """Sharpness values in the calibration file."""

    kind: str
    before: float
    after: float


@dataclass(frozen=True)
class _Path:
    """Path of the prism's angle in the calibration file."""

    t_us: tuple[int, ...]
    angle_rad: tuple[float, ...]
    second: _Path | None = None
    """Path of the second angle; None for one angle."""

    def encoder(self) -> Encoder:
        """Return the path."""
        path = Encoder(np.array(self.t_us, np.int64), np.array(self.angle_rad, np.float64))
        return path if self.second is None else path.with_second(self.second.encoder())


def _path_to_json(path: Encoder) -> dict[str, Any]:
    """Return a path, with the path of a second angle if there is one, in types that JSON knows."""
    found: dict[str, Any] = {"t_us": path.t.tolist(), "angle_rad": path.angle.tolist()}
    return found if path.second is None else {**found, "second": _path_to_json(path.second)}


@dataclass(frozen=True)
class _PlainFields:
    """Fields that the file stores under the same names and in the same form as :class:`Calibration`."""

    events: int
    seconds: float
    warnings: tuple[str, ...]
    stages: tuple[StageSummary, ...]
    zero_us: int | None
    photometric: PhotometricSummary | None
    middle_us: int | None = None
    ladder: ModelChoice | None = None
    harmonics: tuple[float, ...] | None = None


def _entry(name: str, data: Any) -> _Entry:
    """Return the entry of one parameter in the file; raise :class:`AmiwarpError` for any unit but the expected one."""
    unit = units()[name]
    entry = build(_Entry, data, f"parameters.{name}")
    if entry.unit != unit:
        raise AmiwarpError(
            f"field parameters.{name}.unit is {shown(entry.unit)}; expected {unit}", ErrorCode.FIELD
        )
    if entry.std is not None:
        real(entry.std, f"field parameters.{name}.std", 0.0)
    return entry


def constant_speed(rpm: float, t_first: int, t_last: int, zero_us: int) -> Encoder:
    """Return an encoder of constant speed ``rpm`` [1/min] whose angle is 0 at ``zero_us``."""
    encoder = Encoder.constant_speed(rpm, t_first, t_last)
    return replace(
        encoder, angle=encoder.angle + (t_first - zero_us) * (rpm * 2.0 * math.pi / 60e6)
    )


def cost_surface(stages: tuple[StageSummary, ...], size: str) -> NDArray[np.float64]:
    """Return all evaluated points in the plane of size and phase: size, phase, score, stage number, shape (n, 4)."""
    rows = [
        (point[size], point["phase"], point["score"], k)
        for k, stage in enumerate(stages)
        for point in stage.points
        if stage.name != "photometric"  # its score is not a sharpness
        if size in point and "phase" in point
    ]
    return np.array(rows, dtype=np.float64).reshape(-1, 4)
