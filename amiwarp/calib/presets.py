"""Presets: JSON files of settings for ``calibrate`` or ``compensate`` that ``amiwarp chart`` chose for a budget."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp.calib.parameters import values_of
from amiwarp.calib.result import Calibration
from amiwarp.calib.settings import PhotometricSettings, Settings
from amiwarp.errors import AmiwarpError
from amiwarp.io.files import errors_name, write_text
from amiwarp.io.formats import check_ending
from amiwarp.io.json_files import fields_of, read_json
from amiwarp.optics.models import MODELS, Model, rungs
from amiwarp.optics.prism import as_wedge
from amiwarp.validation import check_names, one_of, shown

FORMAT, VERSION = "amiwarp-preset", 1
KINDS = ("calibration", "compensation")
CALIBRATION = ("model", "global_algorithm", "local_algorithm", "global_evaluations", "events", "fold", "stages")
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
        data = {"format": FORMAT, "version": VERSION, "kind": self.kind, "settings": dict(self.settings),
                "measured": dict(self.measured)}  # fmt: skip
        write_text(path, json.dumps(data, indent=1, allow_nan=False) + "\n")

    @classmethod
    def load(cls, path: Path, kind: str) -> Preset:
        """Read a preset of one ``kind``. Raises :class:`AmiwarpError` naming file and field."""
        data = read_json(path, "a preset")
        if data.get("format") != FORMAT or data.get("version") != VERSION:
            raise AmiwarpError(f"{path}: not an {FORMAT} file of version {VERSION}; create one with 'amiwarp chart'")
        if data.get("kind") != kind:
            given = shown(data.get("kind"))
            raise AmiwarpError(f"{path}: kind is {given}; give a preset for {kind}")
        with errors_name(path, lambda: "damaged preset, create it again with 'amiwarp chart'"):
            fields_of(data, "", "format", "version", "kind", "settings", optional=("measured",))
            settings, measured = data["settings"], data.get("measured") or {}
            for name, value in (("settings", settings), ("measured", measured)):
                if not isinstance(value, dict):
                    fields_of(value, name)
            check(kind, settings)
        return cls(kind, settings, measured)

    def calibration_settings(self) -> Settings:
        """Return the preset as calibration settings; fields that the preset does not contain have their defaults."""
        return settings_from(self.settings)


def settings_from(values: Mapping[str, Any]) -> Settings:
    """Return the calibration settings for a preset's values, which have types that JSON can store."""
    plain: dict[str, Any] = {n: values[n] for n in CALIBRATION if n in values}
    return Settings(**plain, photometric=PhotometricSettings(**values.get("photometric", {})))


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
    check_names(settings, (*CALIBRATION, "photometric"), "preset field ")
    photometric = settings.get("photometric", {})
    if not isinstance(photometric, dict):
        raise AmiwarpError(f"field photometric is {shown(photometric)}; expected an object with settings by name")
    check_names(photometric, PHOTOMETRIC, "preset field photometric.")
    plain = {n: v for n, v in settings.items() if n != "photometric"}
    for name, value in plain.items():
        _check_type(name, value, getattr(Settings(), name))
    for name, value in photometric.items():
        _check_type(f"photometric.{name}", value, getattr(PhotometricSettings(), name))
    settings_from(settings).check()


def _check_type(name: str, value: Any, default: Any) -> None:
    wanted = (list, tuple) if isinstance(default, tuple) else type(default)
    good = isinstance(value, wanted) and not isinstance(value, bool)
    if not (good or (name == "global_algorithm" and value is None)):
        raise AmiwarpError(f"{name} is {shown(value)}; expected a value like {default!r}")


def simplified(calibration: Calibration, model: str) -> Calibration:
    """Express a calibration by a simpler model of the same prism, with the size that fits best over image and turn.

    Raises :class:`AmiwarpError` if ``model`` needs parameters that the calibration does not have.
    """
    if one_of(model, MODELS, "model") == calibration.model_name:
        return calibration
    calibration = calibration.exact
    found, known, wanted = calibration.parameters, MODELS[calibration.model_name].closed_form(), MODELS[model]
    if wanted.closed_form() is known:
        return replace(calibration, model_name=model)
    if model not in rungs(known.NAME):
        raise AmiwarpError(
            f"the model {model} needs parameters that a calibration of the model {calibration.model_name} does not "
            "have; calibrate with exact"
        )
    prism = replace(as_wedge(calibration.prism), apex=found.get("apex", as_wedge(calibration.prism).apex),
                    index=found.get("index", calibration.prism.index))  # fmt: skip
    values, start = values_of(model, found), found.get(wanted.SIZE, wanted.size_from_apex(prism.apex, prism))
    simple = replace(calibration, model_name=model, prism=prism, parameters={**values, wanted.SIZE: start})
    size = start * _gain(simple.model, replace(calibration, model_name=known.NAME).model)
    return replace(simple, parameters={**values, wanted.SIZE: size}, uncertainty={})


def _gain(model: Model, other: Model) -> float:
    """Return the factor by which ``model``'s displacement must grow to fit ``other``'s, by least squares."""
    x, y, theta = np.meshgrid(
        np.linspace(0, other.camera.width - 1, 24), np.linspace(0, other.camera.height - 1, 18),
        np.arange(16) * (np.pi / 8), indexing="ij",
    )  # fmt: skip
    xy = np.stack([x.ravel(), y.ravel()], axis=1)
    ours, theirs = (each.compensate_points(xy, theta.ravel()) - xy for each in (model, other))
    finite = np.isfinite(ours).all(axis=1) & np.isfinite(theirs).all(axis=1)
    return float(np.sum(ours[finite] * theirs[finite]) / np.sum(ours[finite] ** 2))
