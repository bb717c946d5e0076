"""Speed of the inspector's window with a million events: response to a slider, and frames while the mouse turns.

    python -m benchmarks.inspector_window [--device cuda:0] [--out FILE.json]

The window is drawn off screen, in software or on a graphics card, whichever VTK finds; the result names it. The mouse
presses, moves and releases as in a window, and each frame counts when the renderer has finished it. All answers are
checked: positions are those of ``compensate_events``, each frame shows the camera of its move, and at rest all points
are drawn.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp import compensate_events
from amiwarp.studies.machine import machine
from amiwarp.viewer import window as inspector_window
from amiwarp.viewer.inspector import WINDOW_POINTS, Inspector
from amiwarp.viewer.window import Window
from benchmarks.inspector import made, recorded

EVENTS, LENGTH_US = 1_000_000, 200_000
"""Number of events, and length of their time window [us]."""
MOVES = 40
"""Number of moves of the mouse in each measurement."""
MOST_MS, LEAST_FPS, LEAST_CARD_FPS = 100.0, 20.0, 60.0
"""Longest time until VTK has the points of a moved slider [ms], and fewest frames per second while the mouse turns the
clouds, in software and on a graphics card."""
SOFTWARE = ("llvmpipe", "softpipe", "swrast", "SwiftShader")
"""Names of renderers that draw in software."""
MOST_ERROR_PX = 0.01
"""Largest difference of a drawn position from that of ``compensate_events`` [px]."""


def renderer_name(window: Window) -> str:
    """Return the name of the renderer that OpenGL gives."""
    lines = window.plotter.render_window.ReportCapabilities().splitlines()
    return next(
        (line.partition(":")[2].strip() for line in lines if "renderer string" in line), "unknown"
    )


def mouse(window: Window, event: str, place: tuple[float, float]) -> None:
    """Send a mouse event at a place, in pixels from left and bottom. The window draws it in its next turn."""
    interactor = window.plotter.iren.interactor
    interactor.EnableRenderOff()  # as while the window handles the events of a display
    interactor.SetEventInformation(round(place[0]), round(place[1]), 0, 0, "\0", 0, None)
    interactor.InvokeEvent(f"{event}Event")


def drawn(window: Window) -> None:
    """Let the window draw what has changed, and wait until the renderer has finished."""
    if not window.run_once():
        raise RuntimeError("the window had nothing to draw")
    window.plotter.render_window.WaitForCompletion()


def timed(work: Callable[[int], None]) -> dict[str, float]:
    """Return the median, the slowest and the mean time of a function of the number of the move [ms]."""
    work(0)
    times, cpu = [], time.process_time()
    for k in range(1, MOVES + 1):
        began = time.perf_counter()
        work(k)
        times.append(1e3 * (time.perf_counter() - began))
    return {
        "ms": float(np.median(times)),
        "ms_mean": float(np.mean(times)),
        "ms_slowest": max(times),
        "cpu_ms": 1e3 * (time.process_time() - cpu) / MOVES,
    }


def error_px(window: Window) -> float:
    """Return the largest difference of the drawn positions from those of ``compensate_events`` [px]."""
    inspector, stride = window.inspector, window.scene.stride
    expected = compensate_events(window.shown.events[::stride], inspector.model, inspector.encoder)
    places = np.asarray(window.scene._clouds[1].mapper.dataset.points)
    if len(places) != len(expected):
        return math.inf
    return float(np.nanmax(np.abs(expected - places[:, :2] * (1.0, -1.0))))


def rewarping(window: Window) -> dict[str, Any]:
    """Measure a slider that the mouse drags: until VTK has the points, and until they are drawn."""
    slider = window.sliders["apex"]
    y, left = 0.5 * (slider.track.low + slider.track.top), slider.track.left
    mouse(window, "LeftButtonPress", (left + 0.2 * slider.track.width, y))
    drawn(window)
    errors = []

    def computed(k: int) -> None:
        mouse(window, "MouseMove", (left + (0.2 + 0.01 * k) * slider.track.width, y))
        window.update()

    def shown(k: int) -> None:
        mouse(window, "MouseMove", (left + (0.6 - 0.01 * k) * slider.track.width, y))
        drawn(window)

    moved = timed(computed)
    errors.append(error_px(window))
    until_drawn = timed(shown)
    errors.append(error_px(window))
    mouse(window, "LeftButtonRelease", (left + 0.2 * slider.track.width, y))
    drawn_points = len(window.scene._meshes[1].points)
    return {
        "points_in_vtk": moved,
        "until_drawn": until_drawn,
        "points_drawn": drawn_points,
        "error_px": max(errors),
        "ok": max(errors) < MOST_ERROR_PX and moved["ms"] <= MOST_MS,
    }


def turning(window: Window, least_fps: float) -> dict[str, Any]:
    """Measure the frames while the mouse turns the clouds."""
    view, camera = window.scene.views[0], window.scene.views[0].camera
    (left, low), (width, height) = view.GetOrigin(), view.GetSize()
    x, y = left + 0.3 * width, low + 0.5 * height
    mouse(window, "LeftButtonPress", (x, y))
    positions, pixels = [], []

    def turn(k: int) -> None:
        mouse(window, "MouseMove", (x + 4 * k, y + k))
        drawn(window)
        positions.append(camera.position)

    found = timed(turn)
    for k in (1, 2):  # what is drawn follows, outside of the measurement
        turn(MOVES + k)
        pixels.append(window.scene.picture())
    steps = np.linalg.norm(np.diff(np.array(positions), axis=0), axis=1)
    follows = bool((steps > 0.0).all()) and bool((pixels[0] != pixels[1]).any())
    mouse(window, "LeftButtonRelease", (x, y))
    drawn_points, fps = len(window.scene._meshes[1].points), 1e3 / found["ms_mean"]
    return {
        **found,
        "frames_per_s": fps,
        "points_drawn": drawn_points,
        "ok": follows and fps >= least_fps,
    }


def resting(window: Window) -> dict[str, Any]:
    """Measure the drawing of all points when nothing moves."""
    inspector_window.REST_S = 0.0
    began = time.perf_counter()
    while window.scene.stride > 1:
        drawn(window)
    points = len(window.scene._meshes[1].points)
    return {
        "ms": 1e3 * (time.perf_counter() - began),
        "points_drawn": points,
        "error_px": error_px(window),
        "ok": points == EVENTS and error_px(window) < MOST_ERROR_PX,
    }


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    inspector = Inspector(
        recorded(made(EVENTS, 1e-6 * LENGTH_US)), device=args.device, most_points=WINDOW_POINTS
    )
    inspector.window = 0, LENGTH_US
    began = time.perf_counter()
    window = Window(inspector, off_screen=True)
    opened_s = time.perf_counter() - began
    window.whole()
    drawn(window)  # which measures how many points can be drawn while something moves
    name = renderer_name(window)
    software = any(each in name for each in SOFTWARE)
    found: dict[str, Any] = {
        "machine": machine(args.device),
        "device": args.device,
        "renderer": name,
        "software": software,
        "size": list(window.places.size),
        "events": len(window.shown.events),
        "opened_s": opened_s,
        "rewarp": rewarping(window),
        "turn": turning(window, LEAST_FPS if software else LEAST_CARD_FPS),
        "rest": resting(window),
    }
    window.scene.close()
    print(json.dumps(found, indent=1))
    if args.out:
        args.out.write_text(json.dumps(found, indent=1) + "\n")
    return int(not all(found[name]["ok"] for name in ("rewarp", "turn", "rest")))


if __name__ == "__main__":
    sys.exit(main())
