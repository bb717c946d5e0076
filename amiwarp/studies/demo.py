"""The demo: a real picture becomes a recording, is calibrated without a guess, compensated, and a picture again."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.brightness.event_pairs import SensorTiming
from amiwarp.calib import Calibration, calibrate
from amiwarp.calib.photometric.stage import PhotometricSettings
from amiwarp.calib.thinning import thin
from amiwarp.compensation.recordings import compensate, compensate_events
from amiwarp.imaging import metrics
from amiwarp.io import open_recording
from amiwarp.io.output import check_output, make_folder
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import Prism
from amiwarp.plotting.figures import Reconstructed, draw_demo
from amiwarp.progress import Progress, silent
from amiwarp.reconstruction.export import save_picture
from amiwarp.reconstruction.picture import Picture, Reconstruction
from amiwarp.simulation.motion import PrismMotion
from amiwarp.simulation.simulator import Scene, SensorModel, Simulation

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.events.recording import Recording
    from amiwarp.optics.models import ExactModel

APEX, PHASE = math.radians(1.0), math.radians(126.0)
"""The truth."""
NOMINAL_APEX = math.radians(1.2)
"""What the calibration is told, so that no box it searches is centred on the truth."""
KNOWN_SENSOR = SensorTiming(SensorModel().latency_us, SensorModel().refractory_us)
"""What a data sheet would tell of the sensor."""
MEASURED = 1_000_000
"""At most so many events, thinned evenly, measure blur."""

"""Called with what is being done and the share of it that is."""


@dataclass(frozen=True, slots=True)
class Demo:
    """What the demo does it with."""

    out: Path
    picture: Path | None = None
    """None for the map of the earth that PyVista carries."""
    width: int = 640
    height: int = 480
    duration_s: float = 0.5
    seed: int = 0
    device: str = "cpu"


@dataclass(frozen=True, slots=True)
class Outcome:
    """What the demo found."""

    events: int
    apex_deg: float
    apex_true_deg: float
    sharpness_model_error_px: float
    """Of the first stage alone: rms over image and turn, the constant lag removed."""
    model_error_px: float
    """Of both stages, likewise."""
    phase_error_deg: float
    """The lag that was removed, beyond the sensor's known one."""
    blur_before_px: float
    blur_after_px: float
    blur_with_truth_px: float
    picture_correlation: float
    """Of the picture from one turn with what the camera sees without the prism, log intensity, the whole image."""
    picture_psnr_db: float
    """Likewise; see :func:`amiwarp.imaging.metrics.picture_quality`."""
    simulate_s: float
    calibrate_s: float
    reconstruct_s: float
    compensate_mev_per_s: float
    files: dict[str, str]
    notes: tuple[str, ...]


def run_demo(demo: Demo, progress: Progress | None = None) -> Outcome:
    """Runs the whole main job into the folder ``demo.out``. Raises :class:`AmiwarpError` for an unusable file."""
    tell = progress or silent
    files = _files(demo.out)
    for path in files.values():
        check_output(path)
    began = time.perf_counter()
    made = simulation(demo)
    made.write(files["recording"], progress=tell)
    simulated_s = time.perf_counter() - began
    recording = open_recording(files["recording"])
    found = calibrate(
        recording, seed=demo.seed, device=demo.device, photometric=PhotometricSettings(sensor=KNOWN_SENSOR),
        progress=tell,
    )  # fmt: skip
    found.save(files["calibration"])
    done = compensate(
        recording, found, files["compensated"], device=demo.device,
        progress=tell,
    )  # fmt: skip
    tell("reconstructing", 0.0)
    picture = middle_turn(recording, found, demo.device)
    save_picture(picture, files["picture"], contrast=made.sensor.contrast_on)
    tell("measuring and drawing", 0.0)
    original = made.log_view()
    quality = metrics.picture_quality(picture.log, original)
    assert recording.camera is not None
    assert recording.truth is not None
    truth = metrics.truth_model(recording.camera, recording.truth, found.prism.flat_side)
    before, after, with_truth = blurs(recording, found, truth, demo.device)
    values: dict[str, Any] = {
        "events": done.events,
        "apex_deg": math.degrees(found.exact.parameters["apex"]),
        "apex_true_deg": math.degrees(truth.prism.apex),
        "sharpness_model_error_px": metrics.model_error(sharpest(found).model, truth).rms,
        "model_error_px": metrics.model_error(found.model, truth).rms,
        "phase_error_deg": math.degrees(math.remainder(found.parameters["phase"] - truth.phase, 2.0 * math.pi)),
        "blur_before_px": before,
        "blur_after_px": after,
        "blur_with_truth_px": with_truth,
        "picture_correlation": quality.correlation,
        "picture_psnr_db": quality.psnr_db,
    }
    tell("measuring and drawing", 0.5)
    notes = draw_demo(
        files["figure"], recording, found, Reconstructed(picture, original, quality),
        headline=headline(values), truth=(truth.prism.apex, truth.phase), device=demo.device,
    )  # fmt: skip
    return Outcome(
        **values,
        simulate_s=simulated_s,
        calibrate_s=found.seconds,
        reconstruct_s=picture.seconds,
        compensate_mev_per_s=done.mev_per_s,
        files={name: str(path) for name, path in files.items()},
        notes=found.warnings + notes,
    )


def middle_turn(recording: Recording, found: Calibration, device: Any) -> Picture:
    """The picture from the turn in the middle, where the pixels' first references are long gone."""
    work = Reconstruction(recording, found, device=device)
    _, turn_us = work.span()
    first, last = recording.events.t_first, recording.events.t_last
    return work.window(max(first, (first + last - turn_us) // 2), turn_us)


def sharpest(found: Calibration) -> Calibration:
    """The answer of the first stage alone."""
    exact = found.exact
    return exact if exact.photometric is None else replace(exact, parameters=exact.photometric.sharpness_parameters)


def _files(out: Path) -> dict[str, Path]:
    make_folder(out)
    names = {
        "recording": "recording.h5",
        "calibration": "calibration.json",
        "compensated": "compensated.h5",
        "picture": "picture.png",
        "figure": "demo.png",
    }
    return {name: out / file for name, file in names.items()}


def simulation(demo: Demo) -> Simulation:
    """The demo's recording, noise included."""
    return Simulation(
        Scene.from_picture(demo.picture or earth()),
        Camera.from_fov(demo.width, demo.height, math.radians(60.0)),
        Prism(APEX),
        demo.duration_s,
        motion=PrismMotion(720.0, PHASE),
        nominal_prism=Prism(NOMINAL_APEX),
        seed=demo.seed,
        device=demo.device,
    )


def earth() -> Path:
    """The map of the earth that comes with PyVista."""
    import pyvista.examples

    return Path(pyvista.examples.mapfile)


def blurs(recording: Recording, found: Calibration, truth: ExactModel, device: Any) -> tuple[float, float, float]:
    """Standard deviation of events across edges [px]: raw, compensated as found, compensated with the truth."""
    events = thin(recording, MEASURED)
    encoder = found.encoder_for(recording.encoder, recording.events.t_first, recording.events.t_last)
    after: NDArray[np.float32] = compensate_events(events, found.model, encoder, device=device)
    ideal = compensate_events(events, truth, encoder, device=device)
    raw = np.stack([events.x, events.y], axis=1).astype(np.float32)
    size = recording.events.size
    return (
        metrics.edge_blur(after, *size, of=raw),
        metrics.edge_blur(after, *size),
        metrics.edge_blur(ideal, *size),
    )


def headline(values: dict[str, Any]) -> str:
    """The figure's title."""
    return (
        f"{values['events'] / 1e6:.1f} million events: apex found {values['apex_deg']:.3f}°, "
        f"true {values['apex_true_deg']:.3f}°, told {math.degrees(NOMINAL_APEX):.3f}°; "
        f"blur {values['blur_before_px']:.2f} px before, {values['blur_after_px']:.2f} px after"
    )
