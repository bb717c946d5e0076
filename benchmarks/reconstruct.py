"""Pictures from events beside the truth of simulated recordings, and beside peers that need no trained weights; JSON.

    python -m benchmarks.reconstruct FOLDER --out FILE.json [--figure FILE.png] [--turns 0.25 1 4] [--noise 1 10] …

Every picture of FOLDER is seen by a 346 × 260 camera (60°) through a prism (apex 1°, 720 rpm). ``--noise`` is the rate
of shot noise of a pixel [1/s]; the share of noise among the events is in each row. The peers get the true optics too:
``integration`` adds up ±threshold at each event's place without the prism; ``leaky`` does so with a high-pass filter of
100 ms, as a complementary filter without frames (Scheerlinck, Barnes and Mahony, ACCV 2018).
"""

from __future__ import annotations

import argparse
import io
import json
import math
import platform
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from amiwarp.camera import Camera
from amiwarp.compensate import compensate_events
from amiwarp.encoder import Encoder
from amiwarp.events import Recording
from amiwarp.io import open_recording
from amiwarp.io.text import read_calib
from amiwarp.iwe_files import save_png
from amiwarp.motion import PrismMotion
from amiwarp.optics import ExactModel, Prism
from amiwarp.reconstruct import Reconstruction, reconstruct
from amiwarp.simulate import Scene, SensorModel, Simulation

CAMERA = Camera.from_fov(346, 260, math.radians(60.0))
PRISM, PHASE = Prism(math.radians(1.0)), 1.0
START_US, TURN_US = 30_000, 250_000.0 / 3.0
TEXTURED = 0.05
"""Areas where log intensity varies by more (standard deviation over 9 × 9 px) are textured."""
DECAY_S = 0.1


def simulated(picture: Path, noise: float, contrast: float, seconds: float, device: str) -> tuple[Recording, Any]:
    sensor = SensorModel(contrast_on=contrast, contrast_off=contrast, shot_noise_hz=noise)
    simulation = Simulation(
        Scene.from_picture(picture), CAMERA, PRISM, seconds, PrismMotion(720.0, PHASE), sensor=sensor, device=device
    )
    return simulation.run(), simulation.log_view()


def integrate(recording: Recording, model: ExactModel, length_us: int, *, decay_s: float | None) -> NDArray[np.float32]:
    """Sum of polarities at the events' places without the prism, a vote spread over four pixels."""
    events = recording.events.between(START_US, START_US + length_us)
    assert recording.encoder is not None
    xy = compensate_events(events, model, recording.encoder)
    weight = np.where(events.p == 1, 1.0, -1.0)
    if decay_s is not None:
        weight *= np.exp((events.t - (START_US + length_us)) * 1e-6 / decay_s)
    image = np.zeros((CAMERA.height + 2, CAMERA.width + 2))
    base = np.floor(xy).astype(np.int64)
    part = xy - base
    for dx in (0, 1):
        for dy in (0, 1):
            share = np.abs(1 - dx - part[:, 0]) * np.abs(1 - dy - part[:, 1]) * weight
            x, y = base[:, 0] + dx, base[:, 1] + dy
            inside = (x >= 0) & (x < CAMERA.width) & (y >= 0) & (y < CAMERA.height)
            np.add.at(image, (y[inside], x[inside]), share[inside])
    return image[: CAMERA.height, : CAMERA.width].astype(np.float32)


def judged(log: NDArray[np.float32], truth: NDArray[np.float32], where: NDArray[np.bool_]) -> dict[str, float]:
    """Correlation, PSNR and SSIM of log intensity; gain and offset fitted first, as neither is told by events."""
    a, b = log[where].astype(np.float64), truth[where].astype(np.float64)
    gain, offset = np.polyfit(a, b, 1)
    span = float(np.ptp(np.percentile(truth, [0.5, 99.5])))
    fitted = (gain * log + offset).astype(np.float64)
    _, similar = structural_similarity(truth.astype(np.float64), fitted, data_range=span, full=True)
    return {
        "correlation": float(np.corrcoef(a, b)[0, 1]),
        "psnr_db": float(peak_signal_noise_ratio(b, gain * a + offset, data_range=span)),
        "ssim": float(similar[where].mean()),
        "gain": float(gain),
    }


def rows(args: argparse.Namespace) -> Iterator[tuple[dict[str, Any], tuple[Any, dict[str, Any]]]]:
    model = ExactModel(CAMERA, PRISM, PHASE)
    seconds = START_US * 1e-6 + max(args.turns) * TURN_US * 1e-6 + 0.02
    for picture in args.pictures or sorted(p.name for p in args.folder.iterdir() if p.suffix in (".jpg", ".png")):
        for noise in args.noise:
            for contrast in args.contrast:
                recording, truth = simulated(args.folder / picture, noise, contrast, seconds, args.device)
                spread = ndimage.uniform_filter(truth**2, 9) - ndimage.uniform_filter(truth, 9) ** 2
                areas = {"textured": spread > TEXTURED**2, "all": np.ones(truth.shape, np.bool_)}
                work = Reconstruction(recording, model=model, device=args.device)
                events = len(recording.events) / seconds
                share = noise * CAMERA.width * CAMERA.height / events
                for turns in args.turns:
                    length = round(turns * TURN_US)
                    found = work.window(START_US, length)
                    pictures = {
                        "amiwarp": found.log,
                        "integration": integrate(recording, model, length, decay_s=None),
                        "leaky": integrate(recording, model, length, decay_s=DECAY_S),
                    }
                    row = {
                        "picture": picture, "noise_hz": noise, "noise_share": share, "contrast": contrast,
                        "turns": turns, "pairs": found.pairs, "known": float(found.known.mean()),
                        "smoothness": found.smoothness, "off_excess": found.off_excess, "seconds": found.seconds,
                        "known_area": judged(found.log, truth, found.known),
                    }  # fmt: skip
                    for name, log in pictures.items():
                        row[name] = {area: judged(log, truth, where) for area, where in areas.items()}
                    yield row, (truth, pictures)


def grid(shown: dict[str, dict[str, NDArray[np.float32]]], path: Path) -> None:
    """A row a picture: the truth, windows of rising length, and the peers."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = max(len(row) for row in shown.values())
    figure = Figure(figsize=(2.2 * columns, 1.75 * len(shown)), dpi=110, layout="compressed")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(shown), columns, squeeze=False)
    for k, (name, row) in enumerate(shown.items()):
        for ax, (title, image) in zip(axes[k], row.items(), strict=True):
            low, high = np.percentile(image, [0.5, 99.5])
            ax.imshow(image, cmap="gray", vmin=low, vmax=high, interpolation="nearest")
            ax.set(xticks=[], yticks=[])
            if k == 0:
                ax.set_title(title, fontsize=8)
        axes[k][0].set_ylabel(name, fontsize=8)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", bbox_inches="tight", pad_inches=0.08)
    save_png(path, Image.open(buffer).convert("L"))


def real(folder: Path, device: str) -> dict[str, dict[str, NDArray[np.float32]]]:
    """Recordings of a turning camera without a prism: the camera's own frame, and the map with either sign."""
    out = {}
    for name in ("shapes_rotation", "dynamic_rotation"):
        recording = open_recording(folder / name / "events.txt")
        width, height = recording.events.size
        first, last = recording.events.t_first, recording.events.t_last
        model = ExactModel(read_calib(folder / name / "calib.txt", width, height), Prism(0.0))
        sheet = np.asarray(Image.open(folder / name / "000000000.png").convert("L"), np.float32)
        row = {"camera's frame": sheet[height + 1 : 2 * height - 1, 1 : width - 1]}
        omega = np.loadtxt(folder / name / "motion.txt").ravel()[-3:]
        for title, sign in (("motion.txt", 1.0), ("the wrong sign", -1.0)):
            x, y, z = (sign * omega).tolist()
            found = reconstruct(
                recording, model=model, encoder=Encoder.constant_speed(0.0, first, last), omega=(x, y, z),
                length_us=last - first + 1, device=device,
            )  # fmt: skip
            print(json.dumps({"recording": name, "omega": title, "pairs": found.pairs, "residual": found.residual}))
            row[f"map, {title}"] = found.log
            if sign > 0.0:
                row["known"] = found.known.astype(np.float32)
        out[name] = row
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--figure", type=Path)
    parser.add_argument("--pictures", nargs="+", help="names in FOLDER; all where left out")
    parser.add_argument("--turns", type=float, nargs="+", default=[0.25, 0.5, 1.0, 2.0, 4.0])
    parser.add_argument("--noise", type=float, nargs="+", default=[0.0, 1.0, 10.0])
    parser.add_argument("--contrast", type=float, nargs="+", default=[0.25])
    parser.add_argument("--real", type=Path, help="folder of shapes_rotation and dynamic_rotation")
    parser.add_argument("--real-figure", type=Path)
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args()
    wp.config.log_level = wp.LOG_ERROR
    if args.real is not None:
        grid(real(args.real, args.device), args.real_figure)
    found, shown, peers = [], {}, {}
    for row, (truth, pictures) in rows(args):
        found.append(row)
        print(json.dumps({k: v for k, v in row.items() if not isinstance(v, dict)}), flush=True)
        if row["noise_hz"] == args.noise[0] and row["contrast"] == args.contrast[0]:
            line = shown.setdefault(row["picture"].split(".")[0], {"truth": truth})
            line[f"{row['turns']:g} turn{'s' * (row['turns'] > 1)}"] = pictures["amiwarp"]
            if row["turns"] == max(t for t in args.turns if t <= 1.0):
                titles = {"integration": "integrated events", "leaky": "high-pass filter"}
                peers[row["picture"].split(".")[0]] = {text: pictures[name] for name, text in titles.items()}
    machine = {"device": args.device, "machine": platform.processor(), "python": platform.python_version()}
    args.out.write_text(json.dumps({"settings": machine, "rows": found}, indent=1) + "\n")
    if args.figure is not None:
        grid({name: line | peers[name] for name, line in shown.items()}, args.figure)


if __name__ == "__main__":
    main()
