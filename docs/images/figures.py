"""Draw pictures of the optics page and of the guides, from the programs and commands on these pages.

    python docs/images/figures.py DEMO [NAME ...]

``DEMO`` is the folder of ``amiwarp demo --size 160x120 --duration 0.5``; for the pictures of the inspector, of
``amiwarp demo --size 320x240``. Without names, all pictures are drawn, except the inspector's.
"""

import math
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib

matplotlib.use("agg")

import inspector_pictures
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from pyvista.examples import mapfile

import amiwarp
from amiwarp.plotting.calibration_figure import draw_calibration

ON, OFF = "#e0761b", "#3c8fd0"


def panels(titles: list[str], height: float = 2.4) -> tuple[Figure, list[plt.Axes]]:
    """Return a figure with a row of images and their titles."""
    figure, axes = plt.subplots(1, len(titles), figsize=(8.0, height), layout="constrained")
    for ax, title in zip(axes, titles, strict=True):
        ax.set_title(title, fontsize=10)
        ax.set_axis_off()
    return figure, list(axes)


def optics(demo: Path) -> Figure:
    """Draw the orbits of points over the image, and the error of one circle for all."""
    camera, prism = (
        amiwarp.Camera.from_fov(640, 480, math.radians(60)),
        amiwarp.Prism(math.radians(1.82), index=1.55),
    )
    exact, circle = amiwarp.ExactModel(camera, prism), amiwarp.CircleModel.from_prism(camera, prism)
    figure, (left, right) = plt.subplots(1, 2, figsize=(8.0, 3.1), layout="constrained")
    theta = np.linspace(0, 2 * np.pi, 65)
    middle = np.repeat([[319.5, 239.5]], 65, axis=0)
    shift = exact.deflect_points(middle, theta) - middle
    for x in np.linspace(40, 600, 6):
        for y in np.linspace(40, 440, 5):
            point = np.repeat([[x, y]], 65, axis=0)
            moved = exact.deflect_points(point, theta) - point
            left.plot(*(point + 2 * shift).T, color="#999999", linewidth=1)
            left.plot(*(point + 2 * moved).T, color=ON, linewidth=1.3)
    left.set(xlim=(-40, 680), ylim=(520, -40), aspect="equal", xlabel="x [px]", ylabel="y [px]")
    left.set_title("orbits, twice as large; grey: the middle's", fontsize=10)
    grid = np.stack(np.meshgrid(np.linspace(0, 639, 65), np.linspace(0, 479, 49)), axis=-1).reshape(
        -1, 2
    )
    turns = [np.full(len(grid), angle) for angle in theta[:-1:4]]
    error = [circle.compensate_points(grid, t) - exact.compensate_points(grid, t) for t in turns]
    rms = np.sqrt(np.mean(np.sum(np.square(error), axis=-1), axis=0)).reshape(49, 65)
    shown = right.imshow(rms, extent=(0, 639, 479, 0), cmap="cividis")
    right.set(xlabel="x [px]")
    right.set_title("rms error of one circle for the whole image", fontsize=10)
    figure.colorbar(shown, label="[px]", shrink=0.8)
    return figure


def before_and_after(demo: Path) -> Figure:
    """Draw the events of one turn before and after compensation, as in a notebook."""
    recording = amiwarp.open_recording(demo / "recording.h5")
    calibration = amiwarp.Calibration.load(demo / "calibration.json")
    events = recording.events.between(100_000, 183_333)
    width, height = recording.events.size
    figure, axes = panels(["as recorded", "compensated"], 3.2)
    axes[0].imshow(amiwarp.iwe(events, width, height), cmap="gray")
    after = amiwarp.iwe(events, width, height, model=calibration.model, encoder=recording.encoder)
    axes[1].imshow(after, cmap="gray")
    return figure


def noise(demo: Path) -> Figure:
    """Draw events, those that the noise filter keeps and those that it marks."""
    recording = amiwarp.open_recording(demo / "recording.h5")
    events = recording.events.between(100_000, 150_000)
    marked = amiwarp.find_background_activity(events, recording.events.size, window_us=5000)
    figure, axes = panels(["events of 50 ms", "kept", "marked as noise"])
    for ax, some, most in zip(
        axes, (events, events[~marked], events[marked]), (12, 12, 2), strict=True
    ):
        ax.imshow(amiwarp.iwe(some, *recording.events.size), cmap="gray", vmin=0, vmax=most)
    return figure


def pixels(demo: Path) -> Figure:
    """Draw the ON threshold of every pixel, as the guide's commands find it."""
    camera, prism = (
        amiwarp.Camera.from_fov(160, 120, math.radians(60)),
        amiwarp.Prism(math.radians(1)),
    )
    sensor = amiwarp.SensorModel(mismatch=0.1)
    recording = amiwarp.simulate(
        demo / "picture.png", camera, prism, duration_s=1.0, motion=720.0, sensor=sensor
    )
    found = amiwarp.pixel_thresholds(recording, amiwarp.calibrate(recording))
    figure, axes = panels(["picture", "ON threshold", "its standard deviation"])
    axes[0].imshow(plt.imread(demo / "picture.png"), cmap="gray")
    for ax, values, span in ((axes[1], found.on, (0.7, 1.3)), (axes[2], found.on_std, (0, 0.1))):
        ax.set_facecolor("#dddddd")
        shown = ax.imshow(values, cmap="cividis", vmin=span[0], vmax=span[1])
        figure.colorbar(shown, ax=ax, shrink=0.8)
    return figure


def no_encoder(demo: Path) -> Figure:
    """Draw what the guide's commands make of events without an encoder."""
    whole = amiwarp.open_recording(demo / "recording.h5")
    with tempfile.TemporaryDirectory() as folder:
        amiwarp.save_camera(f"{folder}/camera.json", whole.camera)
        for command in (
            f"convert {demo.resolve()}/recording.h5 events.npz",
            "convert events.npz plain.h5 --camera camera.json --nominal-apex-deg 1.2",
            "calibrate plain.h5 plain.json",
            "compensate plain.h5 plain_compensated.h5 --calibration plain.json --iwe plain.png",
            "reconstruct plain.h5 plain_picture.png --calibration plain.json --turns 1",
        ):
            subprocess.run(
                [sys.executable, "-m", "amiwarp", *command.split()], cwd=folder, check=True
            )
        figure, axes = panels(["as recorded", "compensated", "reconstructed"])
        axes[0].imshow(amiwarp.iwe(whole.events.between(100_000, 183_333), 160, 120), cmap="gray")
        axes[1].imshow(plt.imread(f"{folder}/plain.png"), cmap="gray")
        axes[2].imshow(plt.imread(f"{folder}/plain_picture.png"), cmap="gray")
    return figure


def calibration(demo: Path, out: Path) -> None:
    """Draw the figure of ``amiwarp calibrate --figure``, for the recording that the page describes."""
    camera = amiwarp.Camera.from_fov(640, 480, math.radians(60))
    recording = amiwarp.simulate(
        mapfile, camera, amiwarp.Prism(math.radians(1.5)), duration_s=0.5, motion=720.0,
        nominal_prism=amiwarp.Prism(math.radians(1.7)), seed=1,
    )  # fmt: skip
    found = amiwarp.calibrate(recording)
    print(f"{len(recording.events):,} events", found)
    out.unlink(missing_ok=True)
    draw_calibration(out, recording, found, device="cpu")
    inspector_pictures.quantised(out, out)


FILES = {"calibration.png": calibration, **inspector_pictures.PICTURES}
"""Pictures that are files: their name, and the function that writes it."""
PICTURES = {
    "orbits": optics, "notebook": before_and_after, "noise": noise, "pixels": pixels, "no_encoder": no_encoder,
}  # fmt: skip


def main(demo: str, *names: str) -> None:
    """Draw the pictures that are named, or all."""
    matplotlib.rcParams.update({"font.size": 9})
    for name in names or PICTURES:
        if name in FILES:
            FILES[name](Path(demo).resolve(), Path(__file__).with_name(name))
            continue
        PICTURES[name](Path(demo)).savefig(
            Path(__file__).with_name(f"{name}.png"), dpi=110, bbox_inches="tight", pad_inches=0.05
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
