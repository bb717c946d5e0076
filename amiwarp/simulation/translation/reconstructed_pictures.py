"""Fast pictures from events alone: a brightness map for each time window, moved as the camera turns."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import CONTRAST
from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Recording
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.prism import Prism
from amiwarp.reconstruction.reconstruct import Reconstruction
from amiwarp.simulation.motion import CameraMotion
from amiwarp.simulation.translation.camera_motion import LEAST_PX, Window, still_encoder
from amiwarp.simulation.translation.centred_camera import centred, looking, pixel_grid
from amiwarp.simulation.translation.known_pictures import KnownPictures
from amiwarp.simulation.translation.picture_flow import warped
from amiwarp.simulation.translation.picture_pair import light_of

MEDIAN_LIGHT = 0.2
"""Luminance of the median of the first picture, relative to white: events say nothing about it."""
STEP_PX = 0.5
"""Largest motion between two fast pictures [px]."""
INTERVAL_US = (100.0, 5000.0)
"""Shortest and longest time between two fast pictures [us]."""

View = tuple[int, NDArray[np.float32], NDArray[np.bool_]]
"""Time [us], log intensity and mask of known pixels of a picture."""


class ReconstructedPictures(KnownPictures):
    """Pictures of a recording of a plain event camera that rotates in front of a still scene (:class:`amiwarp.Frames`).

    Each window gives one picture at its middle by linear least squares (:class:`amiwarp.Reconstruction`). In between,
    the pictures before and after are turned with the camera and blended. The pictures are seen by a camera without
    distortion, of the same size and field of view.
    """

    def __init__(
        self,
        recording: Recording,
        camera: Camera,
        windows: list[Window],
        motion: CameraMotion,
        *,
        device: Any = "cpu",
    ) -> None:
        """``motion``: rotation of the camera, from the start of the first window on."""
        self._windows = windows
        self._source = camera
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
        super().__init__()
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
        interval = self.interval_us
        k = 0
        for first, second in pairwise(self._views()):
            first_t, _, first_known = first
            second_t, _, _ = second
            _, _, known_in_second = self._turned(second, first_t)
            self._known.append((round(k * interval), first_known & known_in_second))
            while k * interval < second_t:
                t = round(k * interval)
                _, before, _ = self._turned(first, t)
                _, after, _ = self._turned(second, t)
                share = (t - first_t) / (second_t - first_t)
                weight = np.float32(np.clip(share, 0.0, 1.0))
                yield t, light_of((np.float32(1.0) - weight) * before + weight * after)
                k += 1

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
        width, height = self.size
        grey = np.full((height, width), np.log(MEDIAN_LIGHT), np.float32)
        nothing = (t, grey, np.zeros((height, width), np.bool_))
        if window.motion_px(self._source) < LEAST_PX:
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
        of_view, *_ = view
        before, after = self._orientation(np.array([of_view, t], np.float64) * 1e-6)
        rotation = before.T @ after
        _, log, known = self._seen(view, self._view, self._rays @ rotation.T)
        return t, log, known

    def _seen(self, view: View, camera: Camera, rays: NDArray[np.float64]) -> View:
        """Return the picture of a camera along other rays, one for each pixel, shape (n, 3)."""
        t, log, known = view
        offset, inside = looking(camera, rays, log.shape)
        still_known = warped(known.astype(np.float32), offset) > 0.5
        return t, warped(log, offset), still_known & inside

    def _levelled(self, view: View, last: View) -> View:
        """Return the picture at the level of the one before, by the median difference: events do not determine it."""
        t, log, known = view
        _, last_log, last_known = self._turned(last, t)
        common = known & last_known
        if not common.any():
            return view
        step = np.float32(np.median((last_log - log)[common]))
        return t, log + step, known
