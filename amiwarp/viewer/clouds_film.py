"""Films of the event clouds."""

import contextlib
import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import View
from amiwarp.errors import AmiwarpError
from amiwarp.reconstruction.film_files import save_film
from amiwarp.tasks import Progress
from amiwarp.viewer.captions import caption
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.knobs import Knobs
from amiwarp.viewer.layout import EXPORTS
from amiwarp.viewer.look import Look
from amiwarp.viewer.orbit_lines import shown_lines
from amiwarp.viewer.scene import Scene

FRAMES = 90
FPS = 25.0
"""Number of pictures of a turning film, and pictures per second."""
FILM_SIZE = (1280, 560)
"""Width and height of a film [px]."""


def write_film(
    path: Path,
    inspector: Inspector,
    look: Look,
    view: View,
    progress: Progress,
    *,
    what: str,
    against: Knobs | None = None,
    with_orbit: bool = True,
    speed: float,
    ended: Callable[[], bool] = lambda: False,
) -> int:
    """Write a film of the clouds to a new file, picture by picture, and return their number.

    ``what``: "turntable" for a camera that moves once around the clouds of the inspector's window, or "film" for a time
    window that moves on from there with ``speed`` times real time, to the end of the recording or until ``ended``
    returns True. A time without events keeps the picture before it. ``against``: parameters of the left cloud; None for
    the recorded events. ``progress`` may raise an error to stop the film; no file is left then.
    """
    inspector = inspector.copy()
    turns = what == "turntable"
    span = inspector.loaded.span
    step_us = 1e6 / FPS * speed
    last_us = inspector.recording.events.t_last + 1 - span.length_us
    frames = FRAMES if turns else 1 + max(0, math.floor((last_us - span.start_us) / step_us))

    def draw(scene: Scene) -> None:
        shown = inspector.show(against=against)
        lines = shown_lines(inspector, shown, look.axis, against) if with_orbit else ()
        scene.show(shown, look, lines, caption(inspector, shown))

    def pictures() -> Iterator[NDArray[np.uint8]]:
        with contextlib.closing(Scene(FILM_SIZE)) as scene:
            draw(scene)
            scene.look_from(view, look)
            turning = scene.turntable(frames)
            for k in range(frames):
                if k and ended():
                    return
                made = f"{k / FPS:.0f} of {frames / FPS:.0f} s"
                progress(f"making the {EXPORTS[what][0]}, {made}", k / frames)
                if k and not turns:
                    with contextlib.suppress(AmiwarpError):  # there are no events at this time
                        inspector.open(span.start_us + round(k * step_us), span.length_us)
                        draw(scene)
                yield next(turning) if turns else scene.picture()

    return save_film(pictures(), path, fps=FPS)
