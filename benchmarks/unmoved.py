"""Jobs that count events at their own pixels, without compensation: the part that dv-processing has too.

Events have integer pixels, so an image of nearest votes is a histogram, and its error must be zero. Before the timing
starts, each method holds the events in its own form: amiwarp the coordinates as float32 and the layer as uint8, NumPy
``x`` and ``y`` as uint16, dv-processing an ``EventStore``, which keeps all events with their times and polarities.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from amiwarp.choices import Vote
from amiwarp.imaging.iwe import Votes
from amiwarp.imaging.votes import CanvasShape, Image
from benchmarks import truth
from benchmarks.job import Job
from benchmarks.libraries import library
from benchmarks.scenes import Array, EventScene

EDGE_MAP_LEVELS = 255
"""Largest number of events that a pixel of dv-processing's edge map can show: its pixels have eight bits."""


def histogram(scene: EventScene) -> Array:
    """Return the number of events of each pixel."""

    def count() -> Array:
        camera, e = scene.camera, scene.events
        at = e.y.astype(np.intp) * camera.width + e.x
        return np.bincount(at, minlength=camera.width * camera.height).reshape(camera.height, camera.width) * 1.0

    return scene.keep("histogram", count)


def job(scene: EventScene, run: Callable[[], Any], image: Callable[[], Any], note: str = "") -> Job:
    """Return the timed job of a method whose events are prepared."""
    return Job(run, lambda: truth.image_errors(histogram(scene), np.asarray(image())), len(scene), note=note)


def amiwarp(scene: EventScene, device: str, model: str, vote: Vote) -> Job:
    """Prepare amiwarp's votes of points, with the image left on the device."""
    canvas = CanvasShape(scene.camera.width, scene.camera.height, vote=vote)
    votes, result = Votes(canvas, device), Image(canvas, 1, device)
    x, y = (wp.array(v.astype(np.float32), dtype=float, device=device) for v in (scene.events.x, scene.events.y))
    layer = wp.zeros(len(scene), dtype=wp.uint8, device=device)

    def run() -> None:
        votes.clear()
        votes.add_points(x, y, layer)
        votes.read(result)

    return job(scene, run, lambda: result.numpy()[0])


def numpy(scene: EventScene, device: str, model: str, vote: Vote) -> Job:
    """Prepare NumPy's ``bincount``."""
    camera, e = scene.camera, scene.events
    found: list[Any] = []

    def run() -> None:
        at = e.y.astype(np.intp) * camera.width + e.x
        found[:] = [np.bincount(at, minlength=camera.width * camera.height)]

    return job(scene, run, lambda: found[0].reshape(camera.height, camera.width))


def _store(scene: EventScene) -> Any:
    """Return the events as dv-processing holds them. It takes them one at a time, which is not timed."""

    def fill() -> Any:
        store, e = library("dv_processing").EventStore(), scene.events
        for event in zip(e.t.tolist(), e.x.tolist(), e.y.tolist(), (e.p != 0).tolist(), strict=True):
            store.push_back(*event)
        return store

    return scene.keep("dv-processing", fill)


def dv_accumulator(scene: EventScene, device: str, model: str, vote: Vote) -> Job:
    """Prepare dv-processing's ``Accumulator`` without decay, which sums floats."""
    dv = library("dv_processing")
    store, size = _store(scene), (scene.camera.width, scene.camera.height)
    accumulator = dv.Accumulator(size, dv.Accumulator.Decay.NONE, 0.0, False, 1.0, 1e9, 0.0, 0.0, True)

    def run() -> None:
        accumulator.clear()
        accumulator.accept(store)

    return job(scene, run, accumulator.getPotentialSurface, "one thread")


def dv_edge_map(scene: EventScene, device: str, model: str, vote: Vote) -> Job:
    """Prepare dv-processing's ``EdgeMapAccumulator``, whose sums have eight bits."""
    dv = library("dv_processing")
    store, size = _store(scene), (scene.camera.width, scene.camera.height)
    accumulator = dv.EdgeMapAccumulator(size, 1.0 / EDGE_MAP_LEVELS, True, 0.0, 0.0)
    found: list[Any] = []

    def run() -> None:
        accumulator.reset()
        accumulator.accept(store)
        found[:] = [accumulator.generateFrame().image]

    return job(scene, run, lambda: found[0], "one thread, at most 255 events per pixel")
