"""Reconstructed pictures compared with the truth of simulated recordings, and with other methods without training.

    python -m benchmarks.reconstruct FOLDER --out FILE.json [--figure FILE.png] [--pictures china.jpg] …

A 346 × 260 camera (60°) sees every picture of FOLDER through a prism (apex angle 1°, 720 rpm), with noise of about 0,
10, 25 and 50 % of all events. Windows start after a whole turn, because before that a simulated pixel still has the
reference level of its start. The other methods also get the true optics:

``integration`` adds ±threshold at the compensated position of each event.
``leaky`` does the same with a high-pass filter of 100 ms, like a complementary filter without frames (Scheerlinck,
Barnes and Mahony, ACCV 2018).
``panning`` uses amiwarp's solver on the same camera without a prism, which rotates about a diagonal axis as fast as the
prism moves the image.

The results are written as JSON. Rows of other pictures that FILE already contains are kept.
"""

from __future__ import annotations

import argparse
import io
import json
import math
import os
import platform
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage
from scipy.spatial.transform import Rotation
from skimage.metrics import structural_similarity

from amiwarp import (
    Camera,
    CameraMotion,
    CameraRotation,
    Encoder,
    ExactModel,
    Prism,
    PrismMotion,
    Reconstruction,
    Recording,
    Scene,
    SensorModel,
    Simulation,
    compensate_events,
    open_recording,
    reconstruct,
)
from amiwarp.imaging.export import save_png
from amiwarp.imaging.metrics import TRUTH_PERCENTILES, picture_quality
from amiwarp.io.camera_files import read_calib
from amiwarp.simulation.picture_maps import place_scene

CAMERA = Camera.from_fov(346, 260, math.radians(60.0))
PRISM, PHASE = Prism(math.radians(1.0)), 1.0
START_US, TURN_US = 100_000, 250_000.0 / 3.0
ALL, SOME, ONE = (0.25, 0.5, 1.0, 2.0, 4.0), (0.25, 1.0), (1.0,)
SETTINGS = (
    (0.25, 0.0, ALL), (0.25, 0.25, ALL), (0.25, 0.1, SOME), (0.25, 0.5, SOME),
    (0.1, 0.0, ONE), (0.1, 0.25, ONE), (0.5, 0.0, ONE), (0.5, 0.25, ONE),
)  # fmt: skip
"""Contrast threshold, share of shot noise among the events, and lengths of the windows [turns], of each measured
setting."""
TEXTURED = 0.05
"""Standard deviation of log intensity over 9 × 9 px above which an area counts as textured."""
DECAY_S = 0.1
"""Time constant of the high-pass filter of the method ``leaky`` [s]."""
SHOWN = 0.25
"""Share of noise among the events of the pictures in the figure, which have a threshold of 0.25."""
PEERS = {
    "panning": "panning, no prism",
    "integration": "integrated events",
    "leaky": "high-pass filter",
}
"""Other methods and their titles in the figure, for windows of one turn."""
METHODS = ("amiwarp", *PEERS)
PROBE_S = 0.06
"""Length of the noise-free recording that measures the scene's event rate [s]."""
MARGIN = 64
"""Margin of the wider view from which the view of a rotated camera is cut out [px]."""


def simulation(
    picture: Path, contrast: float, seconds: float, noise: float, device: str
) -> Simulation:
    sensor = SensorModel(contrast_on=contrast, contrast_off=contrast, shot_noise_hz=noise)
    return Simulation(
        Scene.from_picture(picture),
        CAMERA,
        PRISM,
        seconds,
        PrismMotion(720.0, PHASE),
        sensor=sensor,
        device=device,
    )


def noise_rate(picture: Path, contrast: float, share: float, device: str) -> float:
    """Return the rate of shot noise per pixel [1/s] that makes up about ``share`` of all events."""
    quiet = simulation(picture, contrast, PROBE_S, 0.0, device).run()
    return share / (1.0 - share) * len(quiet.events) / PROBE_S / (CAMERA.width * CAMERA.height)


def speed() -> float:
    """Return the mean speed at which the prism moves the middle of the image [px/s]."""
    theta = np.linspace(0.0, 2.0 * np.pi, 65)
    xy = np.tile(np.array([[CAMERA.cx, CAMERA.cy]], np.float32), (65, 1))
    path = np.asarray(ExactModel(CAMERA, PRISM).compensate_points(xy, theta))
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum() / (TURN_US * 1e-6))


def scene_fov(through: Simulation) -> float:
    """Return the horizontal field of view that the whole picture fills in the scene behind the prism [rad]."""
    place = place_scene(through)
    left, _, right, _ = place.box
    plane = place.width / place.pitch[0] / (right - left)  # per pixel of the picture
    return 2.0 * math.atan(0.5 * plane * through.scene.frames.size[0])


def panning(through: Simulation, fov: float) -> tuple[Recording, CameraRotation]:
    """Simulate the same scene with a rotating camera without prism; return also the camera's rotation."""
    rate = speed() / CAMERA.fx / math.sqrt(2.0)
    turn = CameraRotation((rate, rate, 0.0))
    still = replace(
        through, prism=Prism(0.0), motion=PrismMotion(0.0), camera_motion=CameraMotion(turn.angular_velocity),
        scene=replace(through.scene, fov=fov),
    )  # fmt: skip
    return still.run(), turn


def seen_at(through: Simulation, rotation: NDArray[np.float64], fov: float) -> NDArray[np.float32]:
    """Return the true log intensity for a camera rotated by ``rotation`` [rad] from the direction of the picture."""
    wide = Camera(
        CAMERA.width + 2 * MARGIN, CAMERA.height + 2 * MARGIN, CAMERA.fx, CAMERA.fy, CAMERA.cx + MARGIN,
        CAMERA.cy + MARGIN,
    )  # fmt: skip
    view = replace(
        through, camera=wide, prism=Prism(0.0), scene=replace(through.scene, fov=fov)
    ).log_view()
    rows, columns = np.indices((CAMERA.height, CAMERA.width), np.float32)
    rays = np.asarray(CAMERA.pixels_to_rays(np.stack([columns.ravel(), rows.ravel()], axis=1)))
    xy = np.asarray(
        wide.rays_to_pixels(Rotation.from_rotvec(rotation).apply(rays).astype(np.float32))
    )
    seen = ndimage.map_coordinates(view, xy[:, ::-1].T, order=1, mode="nearest")
    return np.asarray(seen, np.float32).reshape(CAMERA.height, CAMERA.width)


def integrate(
    recording: Recording, model: ExactModel, length_us: int, *, decay_s: float | None
) -> NDArray[np.float32]:
    """Return the sum of polarities at the compensated positions, with bilinear votes."""
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


def textured(truth: NDArray[Any]) -> NDArray[np.bool_]:
    """Return where a picture has texture, see :data:`TEXTURED`."""
    spread = ndimage.uniform_filter(truth**2, 9) - ndimage.uniform_filter(truth, 9) ** 2
    return np.asarray(spread > TEXTURED**2)


def judged(log: NDArray[np.float32], truth: NDArray[np.float32]) -> dict[str, dict[str, float]]:
    """Return the quality of a picture in textured areas and in the whole image; SSIM after fitting gain and offset."""
    out = {}
    for area, where in (("textured", textured(truth)), ("all", np.ones(truth.shape, np.bool_))):
        quality = picture_quality(log, truth, where)
        fitted = (quality.gain * log + quality.offset).astype(np.float64)
        span = float(np.ptp(np.percentile(truth, TRUTH_PERCENTILES)))
        _, similar = structural_similarity(
            truth.astype(np.float64), fitted, data_range=span, full=True
        )
        out[area] = {
            "correlation": quality.correlation, "psnr_db": quality.psnr_db, "ssim": float(similar[where].mean()),
            "gain": quality.gain,
        }  # fmt: skip
    return out


@dataclass(frozen=True, eq=False)
class Seen:
    """Simulated scene, seen through the prism and by a rotating camera without prism."""

    through: Simulation
    fov: float
    recording: Recording
    truth: NDArray[np.float32]
    turning: Recording
    turn: CameraRotation
    noise: float

    @classmethod
    def make(
        cls, picture: Path, contrast: float, share: float, turns: tuple[float, ...], device: str
    ) -> Seen:
        seconds = (START_US + max(turns) * TURN_US) * 1e-6 + 0.02
        noise = noise_rate(picture, contrast, share, device)
        through = simulation(picture, contrast, seconds, noise, device)
        fov = scene_fov(through)
        return cls(through, fov, through.run(), through.log_view(), *panning(through, fov), noise)

    def row(self, turns: float) -> tuple[dict[str, Any], dict[str, NDArray[np.float32]]]:
        """Return the measurements of one window, and the pictures."""
        length = round(turns * TURN_US)
        model = ExactModel(CAMERA, PRISM, PHASE)
        found = Reconstruction(self.recording, model=model, device=self.through.device).window(
            START_US, length
        )
        pictures = {
            "amiwarp": found.log,
            "integration": integrate(self.recording, model, length, decay_s=None),
            "leaky": integrate(self.recording, model, length, decay_s=DECAY_S),
        }
        row = {
            "turns": turns, "pairs": found.pairs, "hot": found.hot,
            "smoothness": found.smoothness, "off_excess": found.off_excess, "residual": found.residual,
            "seconds": found.seconds,
        } | {name: judged(log, self.truth) for name, log in pictures.items()}  # fmt: skip
        if turns in SOME and self.through.sensor.contrast_on == 0.25:
            pictures["panning"], row["panning_pairs"], row["panning"] = self.panned(length)
        return row, {"truth": self.truth} | pictures

    def panned(self, length: int) -> tuple[NDArray[np.float32], int, dict[str, dict[str, float]]]:
        """Return the picture of the rotating camera, its number of equations, and its quality."""
        found = Reconstruction(
            self.turning, model=ExactModel(CAMERA, Prism(0.0)), camera_rotation=self.turn, device=self.through.device,
            encoder=Encoder.constant_speed(0.0, 0, self.turning.events.t_last),
        ).window(START_US, length)  # fmt: skip
        middle = (START_US + length / 2.0) * 1e-6
        truth = seen_at(self.through, np.array(self.turn.angular_velocity) * middle, self.fov)
        return found.log, found.pairs, judged(found.log, truth)


def rows(
    picture: Path, device: str, shown: dict[str, dict[str, NDArray[np.float32]]]
) -> Iterator[dict[str, Any]]:
    """Yield the results of all windows of a picture as rows.

    Reconstructions with noise :data:`SHOWN` are added to ``shown``.
    """
    for contrast, share, windows in SETTINGS:
        seen = Seen.make(picture, contrast, share, windows, device)
        rate = len(seen.recording.events) / seen.through.duration_s
        noise_share = seen.noise * CAMERA.width * CAMERA.height / rate
        what = {"picture": picture.name, "contrast": contrast, "share": share, "noise_hz": seen.noise,
                "noise_share": noise_share}  # fmt: skip
        for turns in windows:
            row, pictures = seen.row(turns)
            if contrast == 0.25 and share == SHOWN:
                line = shown.setdefault(picture.stem, {})
                line[f"{turns:g} turn{'s' * (turns > 1)}"] = pictures["amiwarp"]
                if turns == 1.0:
                    line |= {title: pictures[name] for name, title in PEERS.items()}
            yield what | row


def grid(shown: dict[str, dict[str, NDArray[np.float32]]], path: Path) -> None:
    """Draw one row per picture: the truth, windows of increasing length, and the other methods."""
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
    save_png(path, Image.open(buffer).convert("L"), overwrite=True)


def real(folder: Path, device: str) -> dict[str, dict[str, NDArray[np.float32]]]:
    """Reconstruct recordings of a rotating camera without prism, with either sign of its rotation.

    Returns the pictures, and the mask of known pixels.
    """
    out = {}
    for name in ("shapes_rotation", "dynamic_rotation"):
        recording = open_recording(folder / name / "events.txt")
        width, height = recording.events.size
        first, last = recording.events.t_first, recording.events.t_last
        model = ExactModel(read_calib(folder / name / "calib.txt", width, height), Prism(0.0))
        row = {}
        omega = np.loadtxt(folder / name / "motion.txt").ravel()[-3:]
        for title, sign in (("motion.txt", 1.0), ("the wrong sign", -1.0)):
            x, y, z = (sign * omega).tolist()
            found = reconstruct(
                recording, model=model, encoder=Encoder.constant_speed(0.0, first, last),
                camera_rotation=CameraRotation((x, y, z), middle_us=(first + last) // 2),
                length_us=last - first + 1, device=device,
            )  # fmt: skip
            print(
                json.dumps(
                    {
                        "recording": name,
                        "omega": title,
                        "pairs": found.pairs,
                        "residual": found.residual,
                    }
                )
            )
            row[f"map, {title}"] = found.log
            if sign > 0.0:
                row["known"] = found.known.astype(np.float32)
        out[name] = row
    return out


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--figure", type=Path)
    parser.add_argument("--pictures", nargs="+", help="file names in FOLDER (default: all)")
    parser.add_argument(
        "--real", type=Path, help="folder that contains shapes_rotation and dynamic_rotation"
    )
    parser.add_argument("--real-figure", type=Path)
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args()
    if args.real is not None:
        grid(real(args.real, args.device), args.real_figure)
    shown: dict[str, dict[str, NDArray[np.float32]]] = {}
    names = args.pictures or sorted(
        p.name for p in args.folder.iterdir() if p.suffix in (".jpg", ".png")
    )
    for name in names:
        found = []
        for row in rows(args.folder / name, args.device, shown):
            found.append(row)
            print(json.dumps({k: v for k, v in row.items() if not isinstance(v, dict)}), flush=True)
        merge(args.out, name, found, args.device)
    every = json.loads(args.out.read_text())["rows"]
    print(
        "\n".join(line for contrast in (0.25, 0.1, 0.5) for line in table(every, contrast, METHODS))
    )
    if args.figure is not None:
        grid({name: ordered(line) for name, line in shown.items()}, args.figure)


def table(found: list[dict[str, Any]], contrast: float, methods: tuple[str, ...]) -> Iterator[str]:
    """Yield lines of a Markdown table: means over the pictures, and the worst correlation with its picture's name."""
    chosen = [row for row in found if row["contrast"] == contrast]
    for turns, share in sorted(
        {(row["turns"], row["share"]) for row in chosen}, key=lambda key: (key[1], key[0])
    ):
        group = [row for row in chosen if (row["turns"], row["share"]) == (turns, share)]
        cells = [
            f"{turns:g}",
            f"{min(r['noise_share'] for r in group):.0%} to {max(r['noise_share'] for r in group):.0%}",
        ]
        for method in methods:
            for area in ("textured", "all") if method == "amiwarp" else ("textured",):
                values = [row[method][area] for row in group if method in row]
                mean = [
                    sum(v[key] for v in values) / max(len(values), 1)
                    for key in ("correlation", "psnr_db", "ssim")
                ]
                cells.append(f"{mean[0]:.3f} / {mean[1]:.1f} / {mean[2]:.2f}" if values else "–")
        worst = min(group, key=lambda row: float(row["amiwarp"]["all"]["correlation"]))
        cells.append(
            f"{worst['amiwarp']['all']['correlation']:.3f} ({worst['picture'].split('.')[0]})"
        )
        yield f"| {contrast:g} | " + " | ".join(cells) + f" | {len(group)} |"


def ordered(line: dict[str, NDArray[np.float32]]) -> dict[str, NDArray[np.float32]]:
    """Return the pictures of one row of the figure: selected windows, then the other methods."""
    last = list(PEERS.values())
    kept = [name for name in line if name not in (*last, "0.5 turn", "2 turns")]
    return {name: line[name] for name in (*kept, *last)}


def merge(path: Path, picture: str, found: list[dict[str, Any]], device: str) -> None:
    """Write the results of a picture into the file, where they replace older results of this picture."""
    old = json.loads(path.read_text())["rows"] if path.exists() else []
    kept = [row for row in old if row["picture"] != picture] + found
    machine = {
        "device": device,
        "machine": platform.processor(),
        "python": platform.python_version(),
    }
    text = json.dumps(
        {"settings": machine, "rows": sorted(kept, key=lambda row: str(row["picture"]))}, indent=1
    )
    temporary = path.with_suffix(".tmp")
    temporary.write_text(text + "\n")
    os.replace(temporary, path)


if __name__ == "__main__":
    main()
