"""Presets: JSON files of settings for ``calibrate`` or ``compensate`` that ``amiwarp chart`` chose for a budget."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp.calib.settings import Settings
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.inputs import errors_name
from amiwarp.io.json_files import read_json
from amiwarp.io.output_formats import check_ending
from amiwarp.io.outputs import write_text
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.registry import MODELS, rungs
from amiwarp.optics.prism import as_wedge
from amiwarp.results.calibration import Calibration
from amiwarp.results.parameters import values_of
from amiwarp.schema.records import fields_of, with_fields
from amiwarp.validation import check_names, one_of, shown

FORMAT = "amiwarp-preset"
VERSION = 1
KINDS = ("calibration", "compensation")
CALIBRATION = (
    "model",
    "global_algorithm",
    "local_algorithm",
    "global_evaluations",
    "events",
    "fold",
    "stages",
)
"""Fields of :class:`amiwarp.Settings` that a preset may contain."""
PHOTOMETRIC = ("pairs", "algorithm")
"""Fields of :class:`amiwarp.PhotometricSettings` that a preset may contain under ``photometric``."""


@dataclass(frozen=True)
class Preset:
    """Content of a preset file."""

    kind: str
    """Command for which the preset holds settings: ``calibration`` or ``compensation``."""
    settings: Mapping[str, Any]
    """Settings by name; the values have types that JSON can store."""
    measured: Mapping[str, Any]
    """Error and time that the chart measured with these settings, by name."""

    def save(self, path: Path) -> None:
        """Write the JSON file. Raises :class:`AmiwarpError` if it exists or cannot be written."""
        check_ending(path, "presets are written", [".json"])
        data = {
            "format": FORMAT,
            "version": VERSION,
            "kind": self.kind,
            "settings": dict(self.settings),
            "measured": dict(self.measured),
        }
        write_text(path, json.dumps(data, indent=1, allow_nan=False) + "\n")

    @classmethod
    def load(cls, path: Path, kind: str) -> Preset:
        """Read a preset of one ``kind``. Raises :class:`AmiwarpError` naming file and field."""
        data = read_json(path, "a preset")
        if data.get("format") != FORMAT or data.get("version") != VERSION:
            raise AmiwarpError(
                f"{path}: not an {FORMAT} file of version {VERSION}; create one with 'amiwarp chart'",
                ErrorCode.FORMAT_UNKNOWN,
            )
        if data.get("kind") != kind:
            given = shown(data.get("kind"))
            raise AmiwarpError(
                f"{path}: kind is {given}; give a preset for {kind}", ErrorCode.FIELD
            )
        with errors_name(path, lambda: "damaged preset, create it again with 'amiwarp chart'"):
            fields_of(data, "", "format", "version", "kind", "settings", optional=("measured",))
            settings = data["settings"]
            measured = data.get("measured") or {}
            for name, value in (("settings", settings), ("measured", measured)):
                if not isinstance(value, dict):
                    fields_of(value, name)
            check(kind, settings)
        return cls(kind, settings, measured)

    def calibration_settings(self) -> Settings:
        """Return the preset as calibration settings; fields that the preset does not contain have their defaults."""
        return settings_from(self.settings)


def settings_from(values: Mapping[str, Any]) -> Settings:
    """Return the calibration settings for a preset's values, which have types that JSON can store.

    Raises :class:`AmiwarpError` naming the field.
    """
    plain = dict(fields_of(values, "settings", optional=(*CALIBRATION, "photometric")))
    photometric = plain.pop("photometric", {})
    settings = with_fields(Settings(), plain, "settings", CALIBRATION)
    inner = with_fields(settings.photometric, photometric, "settings.photometric", PHOTOMETRIC)
    return replace(settings, photometric=inner)


def settings_to(settings: Settings) -> dict[str, Any]:
    """Return all settings that a preset may contain, in types that JSON can store."""
    out = {n: getattr(settings, n) for n in CALIBRATION}
    out["stages"] = list(settings.stages)
    out["photometric"] = {n: getattr(settings.photometric, n) for n in PHOTOMETRIC}
    return out


def check(kind: str, settings: Mapping[str, Any]) -> None:
    """Check a preset's settings; raise :class:`AmiwarpError` naming an unknown field or an invalid value."""
    if kind == "compensation":
        check_names(settings, ("model",), "preset field ")
        one_of(settings.get("model"), MODELS, "model")
        return
    settings_from(settings).check()


def simplified(calibration: Calibration, model: str) -> Calibration:
    """Express a calibration by a simpler model of the same prism, with the size that fits best over image and turn.

    Raises :class:`AmiwarpError` if ``model`` needs parameters that the calibration does not have.
    """
    if one_of(model, MODELS, "model") == calibration.model_name:
        return calibration
    calibration = calibration.exact
    found = calibration.parameters
    known = MODELS[calibration.model_name].closed_form()
    wanted = MODELS[model]
    if wanted.closed_form() is known:
        return replace(calibration, model_name=model)
    if model not in rungs(known.NAME):
        raise AmiwarpError(
            f"the model {model} needs parameters that a calibration of the model {calibration.model_name} does not "
            "have; calibrate with exact"
        )
    prism = replace(
        as_wedge(calibration.prism),
        apex=found.get("apex", as_wedge(calibration.prism).apex),
        index=found.get("index", calibration.prism.index),
    )
    values = values_of(model, found)
    start = found.get(wanted.SIZE, wanted.size_from_apex(prism.apex, prism))
    simple = replace(
        calibration, model_name=model, prism=prism, parameters={**values, wanted.SIZE: start}
    )
    size = start * _gain(simple.model, replace(calibration, model_name=known.NAME).model)
    return replace(simple, parameters={**values, wanted.SIZE: size}, uncertainty={})


def _gain(model: Model, other: Model) -> float:
    """Return the factor by which ``model``'s displacement must grow to fit ``other``'s, by least squares."""
    x, y, theta = np.meshgrid(
        np.linspace(0, other.camera.width - 1, 24),
        np.linspace(0, other.camera.height - 1, 18),
        np.arange(16) * (np.pi / 8),
        indexing="ij",
    )
    xy = np.stack([x.ravel(), y.ravel()], axis=1)
    ours, theirs = (
        moving_model.compensate_points(xy, theta.ravel()) - xy for moving_model in (model, other)
    )
    finite = np.isfinite(ours).all(axis=1) & np.isfinite(theirs).all(axis=1)
    return float(np.sum(ours[finite] * theirs[finite]) / np.sum(ours[finite] ** 2))
