"""Fast pictures from events alone: a brightness map for each time window, moved as the camera turns."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.optics.exact_model import ExactModel
from amiwarp.optics.prism import Prism
from amiwarp.reconstruction.choices import CONTRAST
from amiwarp.reconstruction.picture import Reconstruction
from amiwarp.translation.camera_motion import LEAST_PX, Window, still_encoder
from amiwarp.translation.interpolation import light_of
from amiwarp.translation.optical_flow import warped
from amiwarp.translation.rectified import centred, looking, pixel_grid

if TYPE_CHECKING:
    from amiwarp.events.recording import Recording
    from amiwarp.optics.camera import Camera
    from amiwarp.simulation.motion import CameraMotion

MEDIAN_LIGHT = 0.2
"""Luminance of the median of each picture, relative to white: events say nothing about it."""
STEP_PX = 0.5
"""Largest motion between two fast pictures [px]."""
INTERVAL_US = (100.0, 5000.0)
"""Shortest and longest time between two fast pictures [us]."""

View = tuple[int, NDArray[np.float32], NDArray[np.bool_]]
"""Time [us], log intensity and mask of known pixels of a picture."""


class ReconstructedPictures:
    """Pictures of a recording of a plain event camera that rotates in front of a still scene (:class:`amiwarp.Frames`).

    Each window gives one picture at its middle by linear least squares (:class:`amiwarp.Reconstruction`). In between,
    the pictures before and after are turned with the camera and blended. The pictures are those of a camera without
    distortion, of the same size and field of view.
    """

    def __init__(
        self, recording: Recording, camera: Camera, windows: list[Window], motion: CameraMotion, *, device: Any = "cpu"
    ) -> None:
        """``motion``: rotation of the camera, from the start of the first window on."""
        self._windows, self._source = windows, camera
        self._start_us = windows[0].start_us
        self.duration_us = float(recording.events.t_last - self._start_us)
        """Time from the start of the first window to the last event [us]."""
        self._view = centred(camera)
        self._orientation = motion.orientation(self.duration_us * 1e-6 + 1.0)
        x, y, z = motion.largest_rates
        self._speed = float(np.hypot(camera.fy * x, camera.fx * y)) + 0.5 * camera.width * z
        encoder = still_encoder(recording.events.t_first, recording.events.t_last)
        model = ExactModel(camera, Prism(0.0))
        self._work = Reconstruction(recording, model=model, encoder=encoder, device=device)
        self._known: list[tuple[int, NDArray[np.bool_]]] = []
        self._rays = np.asarray(self._view.pixels_to_rays(pixel_grid(camera)))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of each picture [px]."""
        return self._view.width, self._view.height

    @property
    def interval_us(self) -> float:
        """Time between two pictures [us]."""
        return float(np.clip(STEP_PX / max(self._speed, 1e-6) * 1e6, *INTERVAL_US))

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Yield time since the start of the first window [us], and linear luminance, shape (height, width)."""
        self._known.clear()
        interval, k = self.interval_us, 0
        for first, second in pairwise(self._views()):
            self._known.append((round(k * interval), first[2] & self._turned(second, first[0])[2]))
            while k * interval < second[0]:
                t = round(k * interval)
                before, after = self._turned(first, t)[1], self._turned(second, t)[1]
                part = np.float32(np.clip((t - first[0]) / (second[0] - first[0]), 0.0, 1.0))
                yield t, light_of((np.float32(1.0) - part) * before + part * after)
                k += 1

    def take_known(self) -> list[tuple[int, NDArray[np.bool_]]]:
        """Return, and forget, where the events determine the pictures read so far, with the times."""
        taken, self._known = self._known, []
        return taken

    def _views(self) -> Iterator[View]:
        """Yield the pictures of all windows, and the last one again at the end."""
        last: View | None = None
        for window in self._windows:
            view = self._reconstruct(window)
            if last is not None:
                view = self._levelled(view, last)
            last = view
            yield last
        assert last is not None
        yield self._turned(last, max(round(self.duration_us), last[0]) + 1)

    def _reconstruct(self, window: Window) -> View:
        """Return the picture of a window; an even grey without known pixels if its events determine nothing."""
        t = window.middle_us - self._start_us
        nothing = t, np.full(self.size[::-1], np.log(MEDIAN_LIGHT), np.float32), np.zeros(self.size[::-1], np.bool_)
        if window.moves_px(self._source) < LEAST_PX:
            return nothing
        self._work.camera_rotation = window.rotation
        try:
            picture = self._work.window(window.start_us, window.length_us).to_host()
        except AmiwarpError:  # no pixel fires twice
            return nothing
        log = np.float32(CONTRAST) * picture.log + np.float32(np.log(MEDIAN_LIGHT))
        return self._seen((t, log, picture.known), self._source, self._rays)

    def _turned(self, view: View, t: int) -> View:
        """Return a picture as the camera sees it at another time [us]."""
        at = self._orientation(np.array([view[0], t], np.float64) * 1e-6)
        return t, *self._seen(view, self._view, self._rays @ (at[0].T @ at[1]).T)[1:]

    def _seen(self, view: View, camera: Camera, rays: NDArray[np.float64]) -> View:
        """Return the picture of a camera along other rays, one for each pixel, shape (n, 3)."""
        t, log, known = view
        offset, inside = looking(camera, rays, log.shape)
        return t, warped(log, offset), (warped(known.astype(np.float32), offset) > 0.5) & inside

    def _levelled(self, view: View, last: View) -> View:
        """Return the picture with the mean brightness of the one before, which events do not determine."""
        _, before, known = self._turned(last, view[0])
        common = known & view[2]
        if not common.any():
            return view
        return view[0], view[1] + np.float32(np.median((before - view[1])[common])), view[2]
