"""Event cameras behind a rotating wedge prism (AMI-EV): calibration, motion compensation and simulation.

All public names are listed in ``__init__.pyi``, and in groups: ``amiwarp.optics.Camera`` is ``amiwarp.Camera``.
``__all__`` has the names of the main path. Modules are loaded on first use, so that ``import amiwarp`` takes
milliseconds only.
"""

import gc
import sys
import typing
from typing import Any

import lazy_loader

from amiwarp._version import __version__ as __version__

GROUPS = (
    "brightness",
    "calib",
    "compensation",
    "events",
    "imaging",
    "io",
    "learning",
    "lens",
    "live",
    "optics",
    "plotting",
    "reconstruction",
    "results",
    "sensors",
    "simulation",
    "studies",
    "viewer",
)
"""Packages with the public names of a subject."""

_load, _, _names = lazy_loader.attach_stub(__name__, __file__)

PUBLIC_NAMES = [name for name in _names if name not in GROUPS]
"""Every public name; ``__all__`` has the names of the main path."""

__all__ = [
    "AmiwarpError",
    "Board",
    "Calibration",
    "CalibrationOptions",
    "Camera",
    "CameraRotation",
    "CameraSettings",
    "Compensated",
    "CompensationSummary",
    "Compensator",
    "DepthMap",
    "DeviceEvents",
    "Encoder",
    "EncoderStream",
    "EventFilter",
    "EventSensor",
    "Events",
    "ExactModel",
    "ImuSamples",
    "LensCalibration",
    "MemoryEvents",
    "Model",
    "Network",
    "NominalPrism",
    "Picture",
    "Plate",
    "Prism",
    "PrismMotion",
    "Progress",
    "Reconstruction",
    "RecordedDataset",
    "Recording",
    "RecordingWriter",
    "Scene",
    "SensorModel",
    "SensorTiming",
    "Settings",
    "Simulation",
    "ToTensor",
    "Trajectory",
    "Truth",
    "Windows",
    "World",
    "WorldScene",
    "__version__",
    "calibrate",
    "calibrate_lens",
    "compensate",
    "compensate_events",
    "compensate_live",
    "convert",
    "depth",
    "evaluate",
    "filter_recording",
    "iwe",
    "load_camera",
    "load_world",
    "make_dataset",
    "named_world",
    "open_camera",
    "open_recording",
    "reconstruct",
    "render",
    "save_recording",
    "sharpness",
    "simulate",
    "translate",
    "view",
    "voxel_grid",
    "windows",
]


def __dir__() -> list[str]:
    """Return the names of the main path; the groups have the others."""
    return sorted(__all__)


def __getattr__(name: str) -> Any:
    """Load a public name, without garbage collections, which would take a quarter of the time of the imports.

    Another name is refused as by any module, so that Python suggests the nearest one. A type that is no class, such as
    a union, gets a name that can be called, to say what to call instead.
    """
    if name not in _names:
        raise AttributeError(
            f"module {__name__!r} has no attribute {name!r}", name=name, obj=sys.modules[__name__]
        )
    collects = gc.isenabled()
    gc.disable()
    try:
        found = _load(name)
        if typing.get_args(found):
            from amiwarp.schema.type_names import NamedType

            found = globals()[name] = NamedType(name, found)
        return found
    finally:
        if collects:
            gc.enable()
