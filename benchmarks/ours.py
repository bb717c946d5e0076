"""Jobs that call amiwarp, and a plain Warp kernel for comparison."""

import json
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from amiwarp import Calibration, Model, Picture, Reconstruction, Vote, calibrate, model_error
from amiwarp.imaging.canvas import CanvasShape, Image
from amiwarp.imaging.metrics import PictureQuality, picture_quality
from amiwarp.imaging.tile_votes import TileVotes
from amiwarp.imaging.uploaded_events import TURNS, upload_events
from amiwarp.imaging.votes import Votes
from amiwarp.optics.models.registry import MODELS
from benchmarks import peers, truth
from benchmarks.job import Job
from benchmarks.libraries import Peer
from benchmarks.scenes import PHASE, EventScene, FileScene, RecordingScene

wp.set_module_options({"enable_backward": False, "fast_math": True})

CANDIDATES = 12
"""Number of deflections whose images are voted in one pass."""
FILE_PASSES = 3
"""Number of timed passes over a file, after a first pass that brings the file into the page cache."""


def model_of(scene: EventScene, name: str) -> Model:
    return scene.keep(
        ("model", name), lambda: MODELS[name].from_prism(scene.camera, scene.prism, PHASE)
    )


def uploaded(scene: EventScene, device: str) -> Any:
    return scene.keep(
        ("uploaded", device), lambda: upload_events(scene.events, scene.theta, device)
    )


def image(scene: EventScene, device: str, model: str, vote: Vote) -> Job:
    """Prepare a job that clears the image, votes, and converts to a float image on the device.

    The events are uploaded beforehand.
    """
    moves, events = model_of(scene, model), uploaded(scene, device)
    canvas = CanvasShape(scene.camera.width, scene.camera.height, vote=vote)
    votes, result = Votes(canvas, device), Image(canvas, 1, device)

    def run() -> None:
        votes.clear()
        votes.add_events(moves, events)
        votes.read(result)

    return Job(run, lambda: errors(scene, model, vote, result), len(scene))


def errors(scene: EventScene, model: str, vote: Vote, result: Image) -> dict[str, float]:
    """Return the errors of an image of events.

    The compared positions come from the functions that the votes use, at the 16-bit angles of the uploaded events.
    """
    xy, theta = scene.sample()
    angle = np.rint(theta * (TURNS / (2.0 * np.pi))) * (2.0 * np.pi / TURNS)
    return truth.iwe_errors(
        scene, model, vote, result.numpy()[0], model_of(scene, model).compensate_points(xy, angle)
    )


def prepared(scene: EventScene, device: str, model: str, vote: Vote) -> Job:
    """Prepare a job that votes the images of several deflections per pass, with events sorted by image tile beforehand.

    The work is the number of events times candidates. The last candidate has the true deflection; its image is checked.
    """
    true = model_of(scene, model)
    canvas = CanvasShape(scene.camera.width, scene.camera.height, vote=vote)
    result = Image(canvas, 1, device)
    votes = TileVotes(result, canvas, uploaded(scene, device), true, candidates=CANDIDATES)
    for k in range(CANDIDATES):
        votes.set(
            k, replace(true, deflection=true.deflection * (1.0 - 0.02 * (CANDIDATES - 1 - k)))
        )

    def found() -> dict[str, float]:
        votes.read(CANDIDATES - 1, result)
        return errors(scene, model, vote, result)

    return Job(votes.launch, found, len(scene) * CANDIDATES)


@wp.kernel
def four_atomics(
    x: wp.array(dtype=wp.uint16),
    y: wp.array(dtype=wp.uint16),
    theta: wp.array(dtype=float),
    radius: float,
    margin: float,
    image: wp.array2d(dtype=float),
):
    k = wp.tid()
    u = float(x[k]) - radius * wp.cos(theta[k]) + margin
    v = float(y[k]) - radius * wp.sin(theta[k]) + margin
    i = int(u)
    j = int(v)
    fx = u - float(i)
    fy = v - float(j)
    wp.atomic_add(image, j, i, (1.0 - fx) * (1.0 - fy))
    wp.atomic_add(image, j, i + 1, fx * (1.0 - fy))
    wp.atomic_add(image, j + 1, i, (1.0 - fx) * fy)
    wp.atomic_add(image, j + 1, i + 1, fx * fy)


def warp_atomics(scene: EventScene, device: str, model: str, vote: Vote) -> Job:
    """Prepare a plain Warp kernel with four float atomics per event."""
    events = peers.peer_events(scene)
    inputs = [
        wp.array(events.x, dtype=wp.uint16, device=device),
        wp.array(events.y, dtype=wp.uint16, device=device),
        wp.array(events.angle, dtype=float, device=device),
        events.radius,
        float(events.margin),
    ]
    result = wp.zeros(events.shape, dtype=float, device=device)

    def run() -> None:
        result.zero_()
        wp.launch(four_atomics, len(scene), inputs, [result], device=device)

    return peers.job(scene, vote, Peer(run, result.numpy, events))


def calibration(
    scene: RecordingScene, device: str, model: str, vote: Vote, *, stages: tuple[str, ...]
) -> Job:
    """Prepare a calibration of a recording in host memory, with default settings and no initial guess."""
    found: list[Calibration] = []

    def run() -> None:
        found[:] = [calibrate(scene.recording, model=model, stages=stages, device=device)]

    def away() -> dict[str, float]:
        return {"model_px": model_error(found[0].model, scene.model).rms}

    def also() -> dict[str, float]:
        apex = math.degrees(found[0].parameters["apex"] - scene.model.prism.apex)
        took = {f"{stage.name}_s": stage.seconds for stage in found[0].stages}
        return {"contrast": scene.made.sensor.contrast_on, "apex_error_deg": apex} | took

    return Job(run, away, also=also)


def picture(scene: RecordingScene, device: str, model: str, vote: Vote) -> Job:
    """Prepare the reconstruction of a picture of one turn in the middle of the recording, with the true parameters."""
    found: list[Picture] = []
    events = scene.recording.events

    def run() -> None:
        work = Reconstruction(scene.recording, model=scene.model, device=device)
        _, turn = work.span()
        found[:] = [
            work.window(max(events.t_first, (events.t_first + events.t_last - turn) // 2), turn)
        ]

    def quality() -> PictureQuality:
        return picture_quality(found[0].log, scene.view)

    return Job(
        run,
        lambda: {"decorrelation": 1.0 - quality().correlation},
        also=lambda: {
            "contrast": scene.made.sensor.contrast_on,
            "psnr_db": quality().psnr_db,
            "pairs": float(found[0].pairs),
        },
    )


def file(scene: FileScene, device: str, model: str, vote: Vote) -> Job:
    """Prepare the compensation of a file into a file, in a separate process so that its peak memory can be measured."""
    command = [
        sys.executable,
        "-m",
        "benchmarks.compensate",
        "--row",
        str(scene.source),
        "--models",
        model,
    ]
    command += [
        "--device",
        device,
        "--repeats",
        str(FILE_PASSES + 1),
        *["--columns"] * bool(scene.missing),
    ]
    ran = subprocess.run(command, stdout=subprocess.PIPE, cwd=Path(__file__).parents[1], check=True)
    row = json.loads(ran.stdout.splitlines()[-1])
    also = {"peak_mib": row["peak_mib"], "of_copy": row["of_copy"]}
    also |= {
        f"{name}_alone_mev_per_s": rate for name, rate in row.get("alone_mev_per_s", {}).items()
    }
    note = f"bare columns, without {' and '.join(scene.missing)}" if scene.missing else ""
    places = {"places_px": row["error_px"]}
    return Job(lambda: None, lambda: places, len(scene), lambda: also, iter(row["seconds"]), note)
