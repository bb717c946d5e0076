"""amiwarp: taking the motion of a rotating wedge prism out of the events of the camera behind it."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from amiwarp.calib import Calibration, Settings, calibrate
    from amiwarp.compensation.recordings import compensate, compensate_events
    from amiwarp.compensation.streams import Compensated, Compensator
    from amiwarp.errors import AmiwarpError
    from amiwarp.events.encoder import Encoder, EncoderStream
    from amiwarp.events.events import Events, MemoryEvents
    from amiwarp.events.recording import Recording, Truth
    from amiwarp.imaging.choices import Sharpness
    from amiwarp.imaging.metrics import edge_blur, model_error, truth_model
    from amiwarp.imaging.sharpness_costs import sharpness
    from amiwarp.imaging.warped_image import iwe
    from amiwarp.io import RecordingWriter, convert, open_recording, save_recording
    from amiwarp.optics.camera import Camera
    from amiwarp.optics.lens import Fisheye, RadialTangential
    from amiwarp.optics.models import CircleModel, EllipseModel, ExactModel, RadialCircleModel
    from amiwarp.optics.prism import FlatSide, Prism
    from amiwarp.reconstruction.choices import Fill
    from amiwarp.reconstruction.picture import Picture, Reconstruction, reconstruct
    from amiwarp.simulation.motion import CameraMotion, EncoderModel, PrismMotion
    from amiwarp.simulation.simulator import Scene, SensorModel, Simulation, simulate
    from amiwarp.simulation.translator import translate
    from amiwarp.viewer.app import view

_PUBLIC = {
    "calib": ("Calibration", "Settings", "calibrate"),
    "camera": ("Camera", "Fisheye", "RadialTangential"),
    "compensate": ("compensate", "compensate_events"),
    "compensator": ("Compensated", "Compensator"),
    "encoder": ("Encoder", "EncoderStream"),
    "errors": ("AmiwarpError",),
    "events": ("Events", "MemoryEvents", "Recording", "Truth"),
    "io": ("RecordingWriter", "convert", "open_recording", "save_recording"),
    "iwe": ("iwe",),
    "metrics": ("edge_blur", "model_error", "truth_model"),
    "motion": ("CameraMotion", "EncoderModel", "PrismMotion"),
    "optics": ("CircleModel", "EllipseModel", "ExactModel", "FlatSide", "Prism", "RadialCircleModel"),
    "reconstruct": ("Fill", "Picture", "Reconstruction", "reconstruct"),
    "sharpness": ("Sharpness", "sharpness"),
    "simulate": ("Scene", "SensorModel", "Simulation", "simulate"),
    "translate": ("translate",),
    "viewer.app": ("view",),
}
_HOME = {name: module for module, names in _PUBLIC.items() for name in names}
__all__ = ["__version__", *_HOME]


def __getattr__(name: str) -> Any:
    """Public names are loaded on first use, so that ``import amiwarp`` costs nothing."""
    if name not in _HOME:
        raise AttributeError(f"module 'amiwarp' has no attribute {name!r}")
    return getattr(importlib.import_module(f"amiwarp.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return __all__


class _FrontDoor(ModuleType):
    """Where a function has its module's name, ``amiwarp.name`` is the function, whatever was imported before."""

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _HOME and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _FrontDoor
