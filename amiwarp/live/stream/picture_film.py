"""Film of the pictures of a live stream."""

from __future__ import annotations

import contextlib
import queue
from collections.abc import Iterator
from pathlib import Path

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.reconstruction.film_files import check_film
from amiwarp.reconstruction.phase_camera import LivePicture
from amiwarp.reconstruction.picture import Picture
from amiwarp.reconstruction.picture_files import save_video
from amiwarp.tasks import BackgroundLoop

MOST_WAITING = 16
"""Largest number of pictures that wait to be written. With more, pictures are made later."""
STEP_S = 0.1
"""Time between two checks whether the thread has ended [s]."""


class PictureFilm(BackgroundLoop):
    """Writes pictures as a film, in a background thread. The film has the speed of the stream.

    Raises :class:`AmiwarpError` for a name that is not a film's, a rate that it cannot have, a file that exists, or
    without PyAV.
    """

    def __init__(self, path: Path, fps: float) -> None:
        check_film(path, fps=fps)
        self._path = path
        self._fps = fps
        self._waiting: queue.Queue[LivePicture] = queue.Queue(MOST_WAITING)
        self._start_thread("amiwarp-film")

    def __call__(self, picture: LivePicture) -> None:
        """Add a picture. Raises the error of the thread."""
        while self._thread.is_alive():
            with contextlib.suppress(queue.Full):
                self._waiting.put(picture, timeout=STEP_S)
                return
        self.close()

    def _run(self) -> None:
        save_video(self._frames(), self._path, fps=self._fps)

    def _frames(self) -> Iterator[Picture]:
        """Yield a picture for each frame of the film: a picture that was left out is replaced by the one before."""
        first_us: int | None = None
        last: Picture | None = None
        frames = 0
        while not (self._ended.is_set() and self._waiting.empty()):
            with contextlib.suppress(queue.Empty):
                live = self._waiting.get(timeout=STEP_S)
                if first_us is None:
                    first_us = live.end_us
                frame = round((live.end_us - first_us) * 1e-6 * self._fps)  # of this picture
                for _ in range(frame - frames):
                    assert last is not None
                    yield last
                if frame >= frames:
                    yield live.picture
                frames = max(frames, frame + 1)
                last = live.picture
        if last is None:
            raise AmiwarpError(
                f"{self._path}: there is no picture: the stream ended before the prism had made a whole turn",
                ErrorCode.CONTENT_MISSING,
            )
