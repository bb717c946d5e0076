"""Events as point clouds in x, y and prism angle, drawn off screen.

VTK ends its whole process if it finds no OpenGL, so it runs in a separate process. If that fails, Matplotlib draws the
same points.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from ctypes.util import find_library
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.imaging.palette import OFF_COLOUR, ON_COLOUR

MISSING = "VTK found no OpenGL, so Matplotlib drew the point clouds; on Debian install libegl1 and libgl1-mesa-dri"
"""Note in a figure whose clouds Matplotlib drew because VTK cannot draw here."""
SECONDS = 60.0
"""Time limit of the process that draws the point clouds with VTK [s]."""
HALF = (0.4, 0.5, 0.5)
"""Half width of the box about the origin in which the points lie: along x, y and angle."""
_SIZE = (1100, 1000)
"""Width and height of the picture of a point cloud [px]."""
_CAMERA = ((2.75, -2.75, 1.55), (0.0, 0.0, -0.03), (0.0, 0.0, 1.0))
"""Position, focal point and upward direction of the camera."""


__all__ = ["HALF", "MISSING", "Cloud", "Renderer", "check_opengl", "draw_plain"]


@dataclass(frozen=True, slots=True)
class Cloud:
    """Points of one event cloud."""

    xyz: NDArray[np.float32]
    """Coordinates of the points: x, y (up) and prism angle, within :data:`HALF` of the origin for points in the region,
    shape ``(n, 3)``."""
    on: NDArray[np.bool_]
    """Whether each point is an ON event, shape ``(n,)``."""


class Renderer:
    """Process that draws clouds with VTK. It loads VTK when it starts, while the caller does something else."""

    def __init__(self) -> None:
        """Start the process. If it fails, :meth:`render` returns None."""
        quiet = {"stdin": subprocess.PIPE, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        command = [sys.executable, "-m", "amiwarp.plotting.clouds"]
        self._process: subprocess.Popen[bytes] | None = None
        with contextlib.suppress(OSError):
            self._process = subprocess.Popen(command, **quiet)  # type: ignore[call-overload]

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *error: object) -> None:
        """End the process."""
        if self._process is not None:
            with self._process:  # closes its input, and waits
                self._process.kill()

    def render(self, clouds: Sequence[Cloud]) -> list[NDArray[np.uint8]] | None:
        """Draw each cloud and return its picture, shape ``(height, width, 3)``; None if VTK cannot draw here.

        The process then ends.
        """
        if self._process is None:
            return None
        with tempfile.TemporaryDirectory() as folder:
            for k, cloud in enumerate(clouds):
                np.savez(Path(folder) / f"{k}.npz", xyz=cloud.xyz, on=cloud.on)
            try:
                self._process.communicate(folder.encode(), timeout=SECONDS)
            except (OSError, subprocess.TimeoutExpired):
                return None
            pictures = [Path(folder) / f"{k}.npy" for k in range(len(clouds))]
            if self._process.returncode != 0 or not all(picture.is_file() for picture in pictures):
                return None
            return [np.asarray(np.load(picture), np.uint8) for picture in pictures]


def draw_plain(axes: Any, cloud: Cloud) -> None:
    """Draw a cloud on three-dimensional Matplotlib axes."""
    colours = np.where(cloud.on, ON_COLOUR, OFF_COLOUR)
    axes.scatter(*cloud.xyz.T, s=1.6, c=colours, linewidths=0, alpha=0.7, depthshade=False)
    axes.set_box_aspect(HALF, zoom=1.1)
    axes.set(xlim=(-HALF[0], HALF[0]), ylim=(-HALF[1], HALF[1]), zlim=(-HALF[2], HALF[2]))
    axes.view_init(elev=22, azim=-45)
    axes.set(xlabel="x", ylabel="y", xticks=(), yticks=(), zticks=())
    axes.text2D(0.03, 0.9, "angle", transform=axes.transAxes)


def check_opengl() -> None:
    """Select EGL for VTK on Linux. Raises :class:`AmiwarpError` without EGL, where VTK would end the process."""
    if not sys.platform.startswith("linux"):
        return
    if find_library("EGL") is None:
        raise AmiwarpError("VTK needs OpenGL (EGL) to draw; on Debian run: apt-get install libegl1 libgl1-mesa-dri")
    # by default VTK tries X first, and crashes if libX11 is missing; EGL needs no display
    os.environ["VTK_DEFAULT_OPENGL_WINDOW"] = "vtkEGLRenderWindow"


def _render_here(points: Path, picture: Path) -> None:
    """Draw one stored cloud with VTK in this process, and store the picture."""
    import pyvista

    data = np.load(points)
    plotter = pyvista.Plotter(off_screen=True, window_size=list(_SIZE))
    plotter.set_background("white")
    for which, colour in ((~data["on"], OFF_COLOUR), (data["on"], ON_COLOUR)):
        if which.any():
            plotter.add_points(data["xyz"][which], color=colour, point_size=2.6, opacity=0.85, lighting=False)
    x, y, z = HALF
    plotter.add_mesh(pyvista.Box((-x, x, -y, y, -z, z)).outline(), color="#555555", line_width=1.5)
    ends = np.array([[0.0, -y - 0.1, -z - 0.04], [x + 0.1, 0.0, -z - 0.04], [-x - 0.02, -y - 0.02, z + 0.07]])
    plotter.add_point_labels(
        ends, ["x", "y", "angle"], font_size=36, text_color="black", shape=None, show_points=False, always_visible=True
    )
    plotter.camera_position = list(_CAMERA)
    plotter.camera.view_angle = 25.0
    np.save(picture, _cropped(plotter.screenshot(None, return_img=True)))


def _cropped(picture: NDArray[np.uint8], border: int = 8) -> NDArray[np.uint8]:
    """Return the picture without its empty margins."""
    rows, columns = (np.flatnonzero((picture < 255).any(axis=(2, axis))) for axis in (1, 0))
    top, left = max(0, rows[0] - border), max(0, columns[0] - border)
    return picture[top : rows[-1] + border, left : columns[-1] + border]


def _main() -> None:
    """Load VTK, then draw all clouds in the folder whose name comes from the standard input."""
    check_opengl()
    with tempfile.TemporaryDirectory() as folder:  # a first picture loads all that VTK needs
        points = Path(folder) / "points.npz"
        np.savez(points, xyz=np.zeros((2, 3), np.float32), on=np.array([False, True]))
        _render_here(points, points.with_suffix(".npy"))
    given = sys.stdin.read()
    for file in sorted(Path(given).glob("*.npz")) if given else ():
        _render_here(file, file.with_suffix(".npy"))


if __name__ == "__main__":
    _main()
