"""What a file of the native layout begins with: format, size of the sensor, camera, prism and metadata."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import MetadataValue
from amiwarp.io.native.attributes import camera_attributes, prism_attributes
from amiwarp.io.native.layout import ATTRIBUTE_BYTES, FORMAT, FORMAT_VERSION
from amiwarp.optics.camera import Camera, check_size
from amiwarp.optics.prism import NominalPrism


def check_sensor_size(path: Path, width: int, height: int, camera: Camera | None) -> None:
    """Raise :class:`AmiwarpError` for an impossible sensor size, or a size that differs from the camera's."""
    check_size(width, height, path)
    if camera is not None and (camera.width, camera.height) != (width, height):
        given = f"camera is {camera.width}x{camera.height}, the recording {width}x{height}"
        raise AmiwarpError(f"{path}: {given}; give both the same size")


def write_header(
    file: Any,
    size: tuple[int, int],
    camera: Camera | None,
    prism: NominalPrism | None,
    metadata: Mapping[str, MetadataValue],
) -> None:
    """Write the parts of a file that are known before the first event: format, size, camera, prism and metadata."""
    file.attrs["format"] = FORMAT
    file.attrs["format_version"] = FORMAT_VERSION
    file.attrs["width"], file.attrs["height"] = size
    if camera is not None:
        file.create_group("camera").attrs.update(camera_attributes(camera))
    if prism is not None:
        file.create_group("prism").attrs.update(prism_attributes(prism))
    group = file.create_group("metadata")
    for name, item in metadata.items():
        if isinstance(item, str) and len(item.encode()) > ATTRIBUTE_BYTES:
            raise AmiwarpError(
                f"metadata '{name}' has {len(item.encode()):,} bytes; give at most {ATTRIBUTE_BYTES:,}"
            )
        group.attrs[name] = item
