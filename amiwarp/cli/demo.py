"""``amiwarp demo``: simulation, calibration, compensation and reconstruction of one picture."""

import contextlib
import time
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from amiwarp.cli.console import choose_device, progress, report, table
from amiwarp.cli.options import OUTPUT_FOLDER, Common

EXAMPLE = "amiwarp demo --out amiwarp-demo"

OWN_FOLDER = Path("amiwarp-demo")
"""Default folder for the demo's files. Files of an earlier demo in it are replaced."""


def run(
    *,
    out: Annotated[
        Path, typer.Option(help="Folder for the recording, calibration, picture and figure."), OUTPUT_FOLDER
    ] = OWN_FOLDER,
    picture: Annotated[
        Path | None, typer.Option(help="Picture to use as the scene. Default: a map of the earth.")
    ] = None,
    size: Annotated[str, typer.Option(help="Size of the camera's image (px).", metavar="WIDTHxHEIGHT")] = "640x480",
    duration: Annotated[float, typer.Option(help="Length of the recording (s).")] = 0.5,
    common: Common,
) -> None:
    """Simulate a recording, calibrate it without an initial guess, compensate it and reconstruct the picture.

    Takes about 15 s on two idle CPU cores, longer the first time, when kernels are compiled, and on a busy machine.
    """
    began = time.perf_counter()
    device = choose_device(common.device)
    with progress("starting") as advance:
        from amiwarp.cli.options import parse_size
        from amiwarp.io.files import own_folder
        from amiwarp.studies.demo import Demo, run_demo

        width, height = parse_size(size)
        demo = Demo(out, picture, width, height, duration, common.seed, device)
        with own_folder(out) if out == OWN_FOLDER else contextlib.nullcontext():
            outcome = run_demo(demo, advance)
    data = asdict(outcome) | {"seconds": time.perf_counter() - began, "device": device}
    report(common, data, lines(data))


def lines(d: dict[str, Any]) -> list[Any]:
    """Return the results of the demo as lines of text."""
    rows = [
        ("apex", f"{d['apex_deg']:.4f} deg found, {d['apex_true_deg']:.4f} deg true"),
        ("model error", f"{d['model_error_px']:.4f} px rms over image and turn, "
                        f"{d['sharpness_model_error_px']:.4f} px by sharpness alone"),
        ("phase error", f"{d['phase_error_deg']:+.3f} deg"),
        ("blur", f"{d['blur_before_px']:.2f} px before, {d['blur_after_px']:.2f} px after, "
                 f"{d['blur_with_truth_px']:.2f} px with the true prism"),
        ("picture", f"correlation {d['picture_correlation']:.3f} with the original, "
                    f"PSNR {d['picture_psnr_db']:.1f} dB, from one turn"),
        ("speed", f"simulated in {d['simulate_s']:.1f} s, calibrated in {d['calibrate_s']:.1f} s, "
                  f"reconstructed in {d['reconstruct_s']:.1f} s, compensated at {d['compensate_mev_per_s']:.1f} Mev/s"),
        *((f"{name} file", path) for name, path in d["files"].items()),
    ]  # fmt: skip
    notes = [f"note: {note}" for note in d["notes"]]
    return [table(rows), *notes, f"{d['events']:,} events, {d['seconds']:.1f} s in all on {d['device']}"]
