"""Demo: a recording is simulated from a picture, calibrated, compensated and reconstructed."""

import importlib.util
import math
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.brightness.sensor_timing import SensorTiming
from amiwarp.calib.calibration import calibrate
from amiwarp.calib.settings import PhotometricSettings
from amiwarp.calib.thinning import thin
from amiwarp.compensation.in_memory import compensate_events
from amiwarp.compensation.recordings import compensate
from amiwarp.events.recording import Recording
from amiwarp.imaging import metrics
from amiwarp.io import open_recording
from amiwarp.io.output_formats import make_folder
from amiwarp.io.outputs import check_output
from amiwarp.kernels.loading import load_ahead
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.prism import Prism, as_wedge
from amiwarp.plotting.demo_figure import EventViews, Grid, Reconstructed, draw_demo
from amiwarp.reconstruction.picture import Picture
from amiwarp.reconstruction.picture_files import save_picture
from amiwarp.reconstruction.reconstruct import Reconstruction
from amiwarp.results.calibration import Calibration
from amiwarp.simulation.description import Scene
from amiwarp.simulation.motion import PrismMotion
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.simulation.simulator import Simulation
from amiwarp.studies.demo_kernels import EXACT_KERNELS, SIMULATION_KERNELS
from amiwarp.tasks import Progress, silent

APEX = math.radians(1.0)
"""True apex angle of the simulated prism [rad]."""
PHASE = math.radians(126.0)
"""True phase of the simulated prism [rad]. The calibration starts without a guess of it."""
NOMINAL_APEX = math.radians(1.2)
"""Nominal apex angle of the recording [rad]. It differs from the truth, so that no search box is centred on the truth.
"""
KNOWN_SENSOR = SensorTiming(SensorModel().latency_us, SensorModel().refractory_us)
"""Latency and refractory period of the sensor, as a data sheet would state them."""
BRIEF = PhotometricSettings(pairs=100_000, sensor=KNOWN_SENSOR)
"""Settings of the photometric stage: a third of the pairs of the defaults, in about half their time."""
MEASURED = 300_000
"""Largest number of events on which blur is measured; larger numbers are thinned evenly."""


@dataclass(frozen=True, slots=True)
class Demo:
    """Settings of the demo."""

    out: Path
    """Folder to which the demo's files are written."""
    picture: Path | None = None
    """Picture file that the scene shows; None for the map of the earth that comes with PyVista."""
    width: int = 480
    """Width of the image [px]."""
    height: int = 360
    """Height of the image [px]."""
    duration_s: float = 0.25
    """Duration of the recording [s]."""
    seed: int = 0
    """Seed of the simulator and of the search."""
    device: str = "cpu"
    """Device that computes, such as ``cpu`` or ``cuda:0``."""


@dataclass(frozen=True, slots=True)
class DemoResult:
    """Results of the demo."""

    events: int
    """Number of events of the recording."""
    apex_deg: float
    """Calibrated apex angle [deg]."""
    apex_true_deg: float
    """True apex angle [deg]."""
    sharpness_model_error_px: float
    """Model error after the first stage, by sharpness [px rms over image and turn]; the constant lag is removed."""
    model_error_px: float
    """Model error after both stages [px rms over image and turn]; the constant lag is removed."""
    phase_error_deg: float
    """Phase error [deg], the lag that is removed from the model errors, beyond the sensor's known lag."""
    blur_before_px: float
    """Standard deviation of the events across edges before compensation [px]."""
    blur_after_px: float
    """Standard deviation of the events across edges after compensation with the calibrated model [px]."""
    blur_with_truth_px: float
    """Standard deviation of the events across edges after compensation with the true model [px]."""
    picture_correlation: float
    """Correlation of the picture reconstructed from one turn with the view without the prism: log intensity, whole
    image."""
    picture_psnr_db: float
    """Peak signal-to-noise ratio of the picture reconstructed from one turn [dB]; see
    :func:`amiwarp.imaging.metrics.picture_quality`."""
    simulate_s: float
    """Time to simulate and write the recording [s]."""
    calibrate_s: float
    """Time of the calibration [s]."""
    reconstruct_s: float
    """Time of the reconstruction [s]. Parts of the figure are drawn at the same time."""
    compensate_mev_per_s: float
    """Speed of the motion compensation [million events/s], files included."""
    files: dict[str, str]
    """Paths of the written files by name."""
    notes: tuple[str, ...]
    """Warnings of the calibration."""


def run_demo(demo: Demo, progress: Progress | None = None) -> DemoResult:
    """Run the demo into the folder ``demo.out``.

    Raises :class:`AmiwarpError` if a file cannot be used.
    """
    files = _files(demo.out)
    for path in files.values():
        check_output(path)
    if demo.device == "cpu":
        load_ahead((*SIMULATION_KERNELS, *EXACT_KERNELS), demo.device)
    with ThreadPoolExecutor(2, thread_name_prefix="amiwarp-demo") as aside:
        return _run(demo, files, aside, progress or silent)


def _run(
    demo: Demo, files: dict[str, Path], aside: ThreadPoolExecutor, report: Progress
) -> DemoResult:
    """Run the demo. What only the figure and the comparison with the truth need is computed ``aside``."""
    began = time.perf_counter()
    # Loads Matplotlib, too.
    grid = aside.submit(Grid.make, demo.width, demo.height)
    simulated = simulation(demo)
    simulated.write(files["recording"], progress=report)
    simulated_s = time.perf_counter() - began

    recording = open_recording(files["recording"])
    calibration = calibrate(
        recording,
        model=ExactModel.NAME,
        seed=demo.seed,
        device=demo.device,
        photometric=BRIEF,
        progress=report,
    )
    calibration.save(files["calibration"])

    compensated = compensate(
        recording, calibration, files["compensated"], device=demo.device, progress=report
    )
    views = aside.submit(EventViews.of, recording, calibration, demo.device)
    accuracy = aside.submit(_accuracy, recording, calibration, demo.device)

    report("reconstructing", 0.0)
    picture = middle_turn(recording, calibration, demo.device)
    save_picture(picture, files["picture"], contrast=simulated.sensor.contrast_on)

    report("measuring and drawing", 0.0)
    original = simulated.log_view()
    quality = metrics.picture_quality(picture.log, original)
    values = {"events": compensated.events, **accuracy.result()}
    report("measuring and drawing", 0.5)
    assert recording.truth is not None
    draw_demo(
        files["figure"],
        grid.result(),
        calibration,
        views.result(),
        Reconstructed(picture, original, quality),
        headline=headline(values),
        truth=(recording.truth.parameters["apex"], recording.truth.parameters["phase"]),
    )
    return DemoResult(
        **values,
        picture_correlation=quality.correlation,
        picture_psnr_db=quality.psnr_db,
        simulate_s=simulated_s,
        calibrate_s=calibration.seconds,
        reconstruct_s=picture.seconds,
        compensate_mev_per_s=compensated.mev_per_s,
        files={name: str(path) for name, path in files.items()},
        notes=calibration.warnings,
    )


def _accuracy(recording: Recording, calibration: Calibration, device: Any) -> dict[str, Any]:
    """Return the fields of :class:`DemoResult` that compare the calibration with the ground truth."""
    assert recording.camera is not None
    assert recording.truth is not None
    truth = metrics.truth_model(
        recording.camera, recording.truth, as_wedge(calibration.prism).flat_side
    )
    before, after, with_truth = blurs(recording, calibration, truth, device)
    phase_error = math.remainder(calibration.parameters["phase"] - truth.phase, 2.0 * math.pi)
    return {
        "apex_deg": math.degrees(calibration.exact.parameters["apex"]),
        "apex_true_deg": math.degrees(truth.prism.apex),
        "sharpness_model_error_px": metrics.model_error(sharpest(calibration).model, truth).rms,
        "model_error_px": metrics.model_error(calibration.model, truth).rms,
        "phase_error_deg": math.degrees(phase_error),
        "blur_before_px": before,
        "blur_after_px": after,
        "blur_with_truth_px": with_truth,
    }


def middle_turn(recording: Recording, calibration: Calibration, device: Any) -> Picture:
    """Return the picture reconstructed from the turn in the middle of the recording.

    By then the pixels have forgotten their initial reference levels.
    """
    work = Reconstruction(recording, calibration, device=device)
    _, turn_us = work.span()
    first_us = recording.events.t_first
    last_us = recording.events.t_last
    start_us = max(first_us, (first_us + last_us - turn_us) // 2)
    return work.window(start_us, turn_us)


def sharpest(calibration: Calibration) -> Calibration:
    """Return the calibration after the first stage, which uses sharpness alone."""
    exact = calibration.exact
    if exact.photometric is None:
        return exact
    return replace(exact, parameters=exact.photometric.sharpness_parameters)


def _files(out: Path) -> dict[str, Path]:
    """Create the folder, and return the paths of the files by name."""
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
    """Return the simulation of the demo's recording, noise included."""
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
    """Return the path of the map of the earth that comes with PyVista, without loading PyVista.

    Raises :class:`ModuleNotFoundError` if it is not installed.
    """
    package = importlib.util.find_spec("pyvista")
    if package is None or package.origin is None:
        raise ModuleNotFoundError("PyVista is not installed", name="pyvista")
    return Path(package.origin).parent / "examples" / "2k_earth_daymap.jpg"


def blurs(
    recording: Recording, calibration: Calibration, truth: ExactModel, device: Any
) -> tuple[float, float, float]:
    """Return three standard deviations of events across edges [px].

    They are measured before compensation, after compensation as calibrated, and after compensation with the true model.
    """
    events = thin(recording, MEASURED)
    encoder = calibration.encoder_for(
        recording.encoder, recording.events.t_first, recording.events.t_last
    )
    after: NDArray[np.float32] = compensate_events(
        events, calibration.model, encoder, device=device
    )
    ideal = compensate_events(events, truth, encoder, device=device)
    raw = np.stack([events.x, events.y], axis=1).astype(np.float32)

    size = recording.events.size
    before, compensated = metrics.edge_blurs(after, *size, [raw, after])
    return before, compensated, metrics.edge_blur(ideal, *size)


def headline(values: dict[str, Any]) -> str:
    """Return the title of the demo's figure."""
    return (
        f"{values['events'] / 1e6:.1f} million events: apex found {values['apex_deg']:.3f}°, "
        f"true {values['apex_true_deg']:.3f}°, nominal {math.degrees(NOMINAL_APEX):.3f}°; "
        f"blur {values['blur_before_px']:.2f} px before, {values['blur_after_px']:.2f} px after"
    )
