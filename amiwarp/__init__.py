"""amiwarp: taking the motion of a rotating wedge prism out of the events of the camera behind it."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from amiwarp.camera import Camera, Fisheye, RadialTangential
    from amiwarp.encoder import Encoder
    from amiwarp.errors import AmiwarpError
    from amiwarp.events import Events, MemoryEvents, Recording, Truth
    from amiwarp.io import RecordingWriter, convert, open_recording, save_recording
    from amiwarp.optics import CircleModel, EllipseModel, ExactModel, FlatSide, Prism, RadialCircleModel

_PUBLIC = {
    "camera": ("Camera", "Fisheye", "RadialTangential"),
    "encoder": ("Encoder",),
    "errors": ("AmiwarpError",),
    "events": ("Events", "MemoryEvents", "Recording", "Truth"),
    "io": ("RecordingWriter", "convert", "open_recording", "save_recording"),
    "optics": ("CircleModel", "EllipseModel", "ExactModel", "FlatSide", "Prism", "RadialCircleModel"),
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
