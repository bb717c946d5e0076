"""What the files and addresses of ``amiwarp live`` say about their stream: camera, prism, and what was done to it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from amiwarp.io.native.live_writer import LiveWriter
from amiwarp.live.commands.session import recorded_from

if TYPE_CHECKING:
    from amiwarp.imaging.filters import EventFilter
    from amiwarp.live.stream.packets import Source
    from amiwarp.optics.camera import Camera
    from amiwarp.optics.prism import NominalPrism
    from amiwarp.results.calibration import Calibration


@dataclass(frozen=True)
class StreamDescription:
    """A stream and its stages."""

    source: Source
    """Source of the events."""
    calibration: Calibration | None
    """Calibration by which they are compensated; None for a plain camera."""
    chosen: EventFilter | None
    """Filter of the events."""
    lens: Camera | None
    """Camera whose distortion is removed."""
    encoders: int
    """Number of encoders whose samples come: 0 for a plain camera."""

    @property
    def is_plain(self) -> bool:
        """Whether the events are not compensated."""
        return self.calibration is None

    @property
    def raw_hello(self) -> bytes:
        """First message of a stream of the events as they came."""
        return self._hello(self._camera, self.encoders)

    @property
    def hello(self) -> bytes:
        """First message of a stream of the events after the last stage."""
        camera = self._camera if self.lens is None else replace(self.lens, distortion=None)
        return self._hello(camera, 1)

    def raw_writer(self, path: Path, offset_us: float) -> LiveWriter:
        """Return the writer of a recording of the events as they came.

        ``offset_us``: clock offset of the encoders [us].
        """
        return self._writer(path, self._metadata(), self._camera, offset_us=offset_us)

    def writer(self, path: Path) -> LiveWriter:
        """Return the writer of a recording of the events after the last stage."""
        from amiwarp.imaging.filters import described

        metadata = self._metadata()
        camera = self._camera
        if self.chosen is not None:
            metadata["filter"] = described(self.chosen)
        if self.calibration is not None:
            metadata["compensated_with"] = self.calibration.model_name
        if self.lens is not None:
            metadata["undistorted"] = "to a pinhole camera"
            camera = replace(self.lens, distortion=None)
        moves = self.calibration is not None or self.lens is not None
        return self._writer(path, metadata, camera, compensated=moves)

    @property
    def _camera(self) -> Camera | None:
        """Camera of the sensor's events, if it is known."""
        if self.calibration is not None:
            return self.calibration.model.camera
        return self.source.camera or self.lens

    @property
    def _prism(self) -> NominalPrism | None:
        """Nominal prism; None if the calibrated optic has no prism, as a mirror, and for a camera without one."""
        if self.calibration is None:
            return self.source.prism
        return self.calibration.prism if self.calibration.model.PRISM else None

    def _hello(self, camera: Camera | None, encoders: int) -> bytes:
        from amiwarp.live.stream.stream_format import encode_hello

        width, height = self.source.size
        return encode_hello(width, height, camera, self._prism, encoders)

    def _metadata(self) -> dict[str, Any]:
        metadata = recorded_from(self.source)
        if self.calibration is not None and not self.calibration.model.PRISM:
            metadata["optic"] = self.calibration.model_name
        return metadata

    def _writer(
        self,
        path: Path,
        metadata: dict[str, Any],
        camera: Camera | None,
        *,
        compensated: bool = False,
        offset_us: float = 0.0,
    ) -> LiveWriter:
        width, height = self.source.size
        return LiveWriter(
            path,
            width=width,
            height=height,
            camera=camera,
            prism=self.source.prism or self._prism,
            metadata=metadata,
            compensated=compensated,
            encoders=max(self.encoders, 1),
            clock_offset_us=offset_us,
        )
