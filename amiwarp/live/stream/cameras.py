"""Cameras by the name of their source, through any driver. The drivers' libraries are optional."""

from __future__ import annotations

from collections.abc import Callable

from amiwarp.live.stream.camera_dv import DvSource
from amiwarp.live.stream.camera_neuromorphic import NeuromorphicSource
from amiwarp.live.stream.camera_prophesee import PropheseeSource
from amiwarp.live.stream.camera_settings import parse_camera
from amiwarp.live.stream.camera_source import CameraSource

CAMERAS: dict[str, type[CameraSource]] = {
    "camera": NeuromorphicSource,
    "dv": DvSource,
    "prophesee": PropheseeSource,
}
"""Class of the sources of each driver."""


def open_camera_source(
    spec: str, say: Callable[[str], None] = lambda _: None, *, packet_us: int = 1000
) -> CameraSource:
    """Open the camera with this name, with the settings in the name."""
    request = parse_camera(spec)
    return CAMERAS[request.kind](request, say, packet_us=packet_us)
