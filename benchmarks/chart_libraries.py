"""Other libraries in the charts: tasks that make the same image of warped events with the circle model."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp import Vote
from amiwarp.studies.chart.compensation_rows import IMAGE, ErrorSample, LibraryTask, Uploads, circle
from amiwarp.studies.chart.timing import Task
from benchmarks import libraries


def library_tasks(
    sample: ErrorSample, uploads: Uploads, device: str
) -> tuple[list[LibraryTask], list[str]]:
    """Make a task for every installed library, with the circle that fits the events best.

    Notes name the libraries that are not installed.
    """
    known = sample.known
    camera, radius, turned = known.camera, *circle(sample)

    def peer_events(events: Any, theta: NDArray[np.float64]) -> libraries.PeerEvents:
        turns = theta + turned
        angle = np.remainder(turns, 2.0 * math.pi, out=turns).astype(np.float32)
        margin = math.ceil(radius) + 2
        return libraries.PeerEvents(
            events.x, events.y, angle, radius, camera.width, camera.height, margin
        )

    once = peer_events(known.events, uploads.theta[: len(known.events)])
    repeated = once if uploads.copies == 1 else peer_events(uploads.events, uploads.theta)

    def run(peer: libraries.Peer) -> libraries.Peer:
        peer.run()
        wp.synchronize_device(device)
        return peer

    tasks: list[LibraryTask] = []
    notes = []
    for name, make in libraries.PEERS.items():
        on = "cpu" if name in libraries.ON_CPU else device
        try:
            peer = make(once if name in libraries.ON_CPU else repeated, on)
        except libraries.Missing as missing:
            notes.append(f"{name}: left out, {missing}")
            continue
        settings = {"model": "circle", "vote": Vote.BILINEAR.value, "library": name, "device": on}
        label = f"{name} (circle)" if on == device else f"{name} on the CPU (circle)"
        fields = {"chart": "compensation", "job": IMAGE, "label": label, "family": "other libraries",
                  "mark": name.partition(",")[0], "settings": settings}  # fmt: skip
        task = Task(partial(run, peer), len(peer.events.x), fields, lambda ran: ran.image())
        tasks.append(LibraryTask(task, peer.events.places))
    return tasks, notes
