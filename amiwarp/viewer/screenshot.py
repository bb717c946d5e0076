"""Picture of both event clouds, drawn off screen."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import View
from amiwarp.imaging.export import save_png
from amiwarp.io.outputs import check_output
from amiwarp.tasks import interrupts_later
from amiwarp.viewer.captions import caption, cloud_titles
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.knobs import Knobs
from amiwarp.viewer.look import Look
from amiwarp.viewer.scene import Scene


def save_screenshot(
    inspector: Inspector,
    path: Path,
    *,
    view: View = View.FREE,
    look: Look | None = None,
    size: tuple[int, int],
    against: Knobs | None = None,
) -> None:
    """Write a picture of both event clouds as PNG, as :func:`draw_picture` returns it."""
    check_output(path)
    with interrupts_later():  # VTK crashes if an exception leaves it half-drawn
        save_png(path, draw_picture(inspector, view, look or Look(), size, against))


def draw_picture(
    inspector: Inspector,
    view: View,
    look: Look,
    size: tuple[int, int],
    against: Knobs | None = None,
) -> NDArray[np.uint8]:
    """Return a picture of both event clouds, shape ``(height, width, 3)``; ``size`` is its width and height [px].

    ``against``: parameters of the first cloud; None for the recorded events.
    """
    clouds = inspector.show(against=against)
    with interrupts_later(), closing(Scene(size)) as scene:
        look = look.for_clouds(cloud_titles(inspector, "recorded" if against is None else "B"))
        scene.show(clouds, look, caption=caption(inspector, clouds))
        scene.look_from(view, look)
        return scene.picture()
