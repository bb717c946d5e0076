"""Jobs for the implementations of other libraries in :mod:`benchmarks.libraries`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from amiwarp import Vote
from benchmarks import truth
from benchmarks.job import Job
from benchmarks.libraries import Peer, PeerEvents
from benchmarks.scenes import MARGIN, EventScene


def peer_events(scene: EventScene) -> PeerEvents:
    """Return the scene's events in the form that all libraries use."""

    def make() -> PeerEvents:
        angle = np.remainder(scene.theta, 2.0 * np.pi).astype(np.float32)
        e, c = scene.events, scene.camera
        return PeerEvents(e.x, e.y, angle, scene.radius, c.width, c.height, MARGIN)

    return scene.keep("peers", make)


def job(scene: EventScene, vote: Vote, peer: Peer, model: str = "plane circle") -> Job:
    """Return the timed job of a library whose data is prepared."""

    def errors() -> dict[str, float]:
        return truth.iwe_errors(scene, model, vote, peer.image(), peer.events.places(scene.some))

    return Job(peer.run, errors, len(scene))


def image(
    way: Callable[[PeerEvents, str], Peer], scene: EventScene, device: str, model: str, vote: Vote
) -> Job:
    """Prepare the timed job of one of the functions of :mod:`benchmarks.libraries`."""
    return job(scene, vote, way(peer_events(scene), device), model)
