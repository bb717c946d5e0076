"""What a calibration found: parameters with units and uncertainty, how it got there, and its JSON file."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.calib.parameters import MOTION, UNITS, build_model, size_name, turning_of
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.imaging.choices import Sharpness
from amiwarp.io.files import errors_name
from amiwarp.io.json_files import build, fields_of, read_json
from amiwarp.io.output import write_text
from amiwarp.optics.camera import Camera
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.optics.lens import Distortion, Fisheye, RadialTangential
from amiwarp.optics.models import MODELS
from amiwarp.optics.prism import Prism
from amiwarp.validation import one_of, real, shown

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.calib.parameters import ParameterSpace
    from amiwarp.calib.solve import SearchStage
    from amiwarp.optics.models import Model

FORMAT = "amiwarp-calibration"
VERSION = 1
NEEDED = ("format", "version", "model", "camera", "prism", "parameters", "sharpness", "zero_us", "photometric",
          "events", "seconds", "warnings", "stages")  # fmt: skip
OPTIONAL = ("middle_us", "ladder")
"""Fields that calibrations of the first days lack."""
CAMERA = ("width", "height", "fx", "fy", "cx", "cy")
LENSES: dict[str, type[Distortion]] = {"radial_tangential": RadialTangential, "fisheye": Fisheye}
SHARPNESS = [kind.value for kind in Sharpness]


@dataclass(frozen=True)
class StageSummary:
    """One stage of the search, as it is kept in the file."""

    name: str
    algorithm: str
    evaluations: int
    seconds: float
    sharpness: float
    """The stage's own score: its image may be coarser than the last stage's."""
    ended: str
    points: list[dict[str, float]] = field(default_factory=list, repr=False)
    """Parameters of every evaluation, each with its ``score``, in order."""

    @classmethod
    def of(cls, name: str, stage: SearchStage, space: ParameterSpace) -> StageSummary:
        points = []
        for x, score in zip(stage.points, stage.scores, strict=True):
            values = space.to_values(x)
            points.append({**{n: values[n] for n in space.names}, "score": float(score)})
        return cls(name, stage.algorithm, stage.evaluations, stage.seconds, stage.score, stage.ended, points)


@dataclass(frozen=True)
class PhotometricSummary:
    """What the second stage found, and whether to believe it."""

    accepted: bool
    verdict: str
    parameters: Mapping[str, float]
    """Its answer, even where it is not accepted."""
    uncertainty: Mapping[str, float]
    sharpness_parameters: Mapping[str, float]
    """The first stage's answer."""
    moved_px: float
    """Distance between the two answers [px rms]."""
    cost: float
    """Mean robust residual, as a share of that with no map at all."""
    cost_at_sharpness: float
    residual: float
    """Median of the residuals' magnitudes [ON thresholds]."""
    pairs: int
    off_over_on: float
    """Ratio of the OFF threshold to the ON threshold, counted, or solved for if it was freed."""
    leak: float = 0.0
    """Thresholds a second by which a pixel's reference drifts, where it was freed."""
    held: tuple[str, ...] = ()
    """Freed in vain: the events do not determine them, and they kept their start."""


@dataclass(frozen=True)
class ModelCandidate:
    """One model of the ladder and what was found of it; see :mod:`amiwarp.calib.selection.model_choice`."""

    model: str
    numbers: str
    """How many it has, and which are given."""
    predicted_px: float
    """Distance of its best fit from the exact answer, over the events [px rms]."""
    sharpness: float
    """On held-out turns."""
    loss: float
    """The exact model's sharpness on held-out turns less this one's."""
    loss_std: float
    """From its scatter over disjoint parts of these events."""
    seen_px: tuple[float, float]
    """What the loss amounts to: the rms displacement that would cost as much, of the loss 2 deviations either way."""
    cost_ns: float
    """Angle, displacement and vote of one event, as measured here [ns]."""
    chosen: bool
    verdict: str


@dataclass(frozen=True)
class FreedParameter:
    """One parameter, or a pair, that was held at first: whether it was freed, and why (not)."""

    name: str
    freed: bool
    determined: bool
    std_px: float | None
    """By how much it is uncertain, in motion of events [px]; None where it hardly moves them."""
    gain_px: tuple[float, float] | None
    """What held-out turns gain by it, as :attr:`Rung.seen_px`; None where it is not determined."""
    verdict: str


@dataclass(frozen=True)
class ModelChoice:
    """How ``auto`` came to its model."""

    budget_px: float
    timing_px: float
    """Blur that encoder, clock and latency leave, by estimate [px]."""
    agreed: bool
    """Whether neither judge contradicts the other about the model chosen and those below it."""
    exact: Mapping[str, float]
    """Parameters of the exact model, from which those of the chosen one were fitted."""
    exact_uncertainty: Mapping[str, float]
    rungs: tuple[ModelCandidate, ...]
    parameters: tuple[FreedParameter, ...]
    seconds: float
    """Beside the exact model's first calibration."""


@dataclass(frozen=True)
class Calibration:
    """Parameters of one model of one camera and prism. Angles in rad; the JSON file gives degrees beside them."""

    model_name: str
    camera: Camera
    prism: Prism
    """The nominal prism: index and flat side where they were not free."""
    parameters: Mapping[str, float]
    """By name (see ``amiwarp.calib.parameters.UNITS``); ``clock_offset`` [us] and ``rpm`` where they were free."""
    uncertainty: Mapping[str, float]
    """Standard deviation of the free ones, in the same units."""
    free: tuple[str, ...]
    sharpness_name: str
    sharpness_before: float
    """Of the events as recorded."""
    sharpness_after: float
    stages: tuple[StageSummary, ...]
    events: int
    """How many events the last stage used."""
    seconds: float
    """Whole time, reading included."""
    warnings: tuple[str, ...] = ()
    zero_us: int | None = None
    """Where there was no encoder: the time on the events' clock at which the prism's angle is taken as 0."""
    photometric: PhotometricSummary | None = None
    """What the second stage found; None where it did not run."""
    middle_us: int | None = None
    """Where the camera's motion was free: the time for which its rates hold, on the events' clock."""
    ladder: ModelChoice | None = None
    """How the model was chosen, where that was left to ``auto``."""

    @property
    def model(self) -> Model:
        """The calibrated model."""
        return build_model(self.model_name, self.camera, self.prism, self.parameters)

    @property
    def exact(self) -> Calibration:
        """The exact model's answer, from which a smaller rung was fitted; itself where there is no ladder."""
        if self.ladder is None:
            return self
        free = tuple("apex" if n == "deflection" else n for n in self.free)
        found, std = self.ladder.exact, self.ladder.exact_uncertainty
        return replace(self, model_name="exact", parameters=found, uncertainty=std, free=free, ladder=None)

    @property
    def camera_rotation(self) -> CameraRotation | None:
        """The camera's own motion, about ``middle_us``; None where it was neither free nor given."""
        if not any(n in self.parameters for n in MOTION):
            return None
        return turning_of(self.parameters, self.middle_us or 0)

    def encoder_for(self, encoder: Encoder | None, t_first: int, t_last: int) -> Encoder:
        """The recording's encoder with the clock offset that was found, or a constant speed where it has none.

        Without a prism any angle will do. Raises :class:`AmiwarpError` where there is neither an encoder nor a
        calibrated rpm.
        """
        if self.parameters.get("apex", self.parameters.get("deflection")) == 0.0:
            return constant_speed(0.0, t_first, t_last, t_first)
        if encoder is not None:
            return encoder.with_clock_offset(self.parameters.get("clock_offset", encoder.clock_offset_us))
        if "rpm" not in self.parameters or self.zero_us is None:
            raise AmiwarpError("the recording has no encoder and the calibration no rpm; calibrate this recording")
        return constant_speed(self.parameters["rpm"], t_first, t_last, self.zero_us)

    def to_json(self) -> dict[str, Any]:
        """The file's content as plain objects."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "model": self.model_name,
            "camera": camera_to_json(self.camera),
            "prism": {"apex_rad": self.prism.apex, "index": self.prism.index, "flat_side": self.prism.flat_side.value},
            "parameters": {name: self._parameter(name) for name in self.parameters},
            "sharpness": {
                "kind": self.sharpness_name,
                "before": self.sharpness_before,
                "after": self.sharpness_after,
            },
            "zero_us": self.zero_us,
            "middle_us": self.middle_us,
            "photometric": None if self.photometric is None else asdict(self.photometric),
            "ladder": None if self.ladder is None else asdict(self.ladder),
            "events": self.events,
            "seconds": self.seconds,
            "warnings": list(self.warnings),
            "stages": [asdict(stage) for stage in self.stages],
        }

    def _parameter(self, name: str) -> dict[str, Any]:
        value = self.parameters[name]
        out: dict[str, Any] = {"value": value, "unit": UNITS[name], "free": name in self.free}
        if name in self.uncertainty:
            out["std"] = self.uncertainty[name]
        if UNITS[name] == "rad":
            out["degrees"] = math.degrees(value)
        return out

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write the JSON file. Raises :class:`AmiwarpError` if it exists (unless ``overwrite``) or cannot be made."""
        write_text(Path(path), json.dumps(self.to_json(), indent=1, allow_nan=False) + "\n", overwrite=overwrite)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Calibration:
        """Reads a file that :meth:`save` wrote. Raises :class:`AmiwarpError` naming file and field."""
        data = read_json(path, "a calibration")
        if data.get("format") != FORMAT or data.get("version") != VERSION:
            raise AmiwarpError(
                f"{path}: is not an {FORMAT} file of version {VERSION}; make one with 'amiwarp calibrate'"
            )
        with errors_name(Path(path), lambda: "damaged calibration, calibrate again"):
            return cls._from_json(data)

    @classmethod
    def _from_json(cls, data: dict[str, Any]) -> Calibration:
        fields_of(data, "", *NEEDED, optional=OPTIONAL)
        model = one_of(data["model"], MODELS, "field model")
        given = fields_of(data["parameters"], "parameters", size_name(model), "phase", optional=tuple(UNITS))
        entries = {name: _entry(name, entry) for name, entry in given.items()}
        prism = fields_of(data["prism"], "prism", "apex_rad", "index", "flat_side")
        sharpness = build(_Sharpness, data["sharpness"], "sharpness")
        names = [f.name for f in fields(_Rest)]
        rest = build(_Rest, {name: data[name] for name in names if name in data}, "")
        result = cls(
            model_name=model,
            camera=camera_from_json(data["camera"], "camera"),
            prism=Prism(prism["apex_rad"], prism["index"], prism["flat_side"]),
            parameters={name: entry.value for name, entry in entries.items()},
            uncertainty={name: entry.std for name, entry in entries.items() if entry.std is not None},
            free=tuple(name for name, entry in entries.items() if entry.free),
            sharpness_name=one_of(sharpness.kind, SHARPNESS, "field sharpness.kind"),
            sharpness_before=sharpness.before,
            sharpness_after=sharpness.after,
            **{name: getattr(rest, name) for name in names},
        )
        _ = replace(result, model_name="exact" if result.model_name == "ellipse" else result.model_name).model
        return result


@dataclass(frozen=True)
class _Entry:
    """A parameter as the file has it."""

    value: float
    free: bool
    unit: str
    std: float | None = None
    degrees: float | None = None
    """For who reads the file; ``value`` counts."""


@dataclass(frozen=True)
class _Sharpness:
    """The sharpness as the file has it."""

    kind: str
    before: float
    after: float


@dataclass(frozen=True)
class _Rest:
    """Fields that are in the file as in :class:`Calibration`."""

    events: int
    seconds: float
    warnings: tuple[str, ...]
    stages: tuple[StageSummary, ...]
    zero_us: int | None
    photometric: PhotometricSummary | None
    middle_us: int | None = None
    ladder: ModelChoice | None = None


def _entry(name: str, data: Any) -> _Entry:
    """One parameter; its unit must be the one that amiwarp uses, for nothing is converted."""
    unit, entry = UNITS[name], build(_Entry, data, f"parameters.{name}")
    if entry.unit != unit:
        raise AmiwarpError(f"field parameters.{name}.unit is {shown(entry.unit)}; expected {unit}")
    if entry.std is not None:
        real(entry.std, f"field parameters.{name}.std", 0.0)
    return entry


def constant_speed(rpm: float, t_first: int, t_last: int, zero_us: int) -> Encoder:
    """A prism without an encoder, turning at ``rpm`` and at angle 0 at ``zero_us``."""
    encoder = Encoder.constant_speed(rpm, t_first, t_last)
    return replace(encoder, angle=encoder.angle + (t_first - zero_us) * (rpm * 2.0 * math.pi / 60e6))


def camera_to_json(camera: Camera) -> dict[str, Any]:
    out = {name: getattr(camera, name) for name in CAMERA}
    if camera.distortion is not None:
        kind = "fisheye" if isinstance(camera.distortion, Fisheye) else "radial_tangential"
        out["distortion"] = {"kind": kind, **asdict(camera.distortion)}
    return out


def camera_from_json(data: Any, where: str = "") -> Camera:
    """A camera from a JSON object, which messages call ``where``. Raises :class:`AmiwarpError` naming the field."""
    given = fields_of(data, where, *CAMERA, optional=("distortion",))
    prefix, lens = f"{where}." if where else "", given.get("distortion")
    distortion: Distortion | None = None
    if lens is not None:
        numbers = dict(lens) if isinstance(lens, dict) else fields_of(lens, f"{prefix}distortion")
        kind = one_of(numbers.pop("kind", None), LENSES, f"field {prefix}distortion.kind")
        distortion = build(LENSES[kind], numbers, f"{prefix}distortion")
    return Camera(**{name: given[name] for name in CAMERA}, distortion=distortion)


def cost_surface(stages: tuple[StageSummary, ...], size: str) -> NDArray[np.float64]:
    """Samples of all stages that carry a size and a phase, shape (n, 4): size, phase, score, stage number."""
    rows = [
        (point[size], point["phase"], point["score"], k)
        for k, stage in enumerate(stages)
        for point in stage.points
        if stage.name != "photometric"  # its score is another
        if size in point and "phase" in point
    ]
    return np.array(rows, dtype=np.float64).reshape(-1, 4)
