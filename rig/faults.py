"""Pictures of what goes wrong on a rig, as the inspector shows it: ``python -m rig.faults OUT.png``."""

import math
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

import amiwarp

APEX, PHASE = math.radians(1.5), 0.6


def recordings() -> dict[str, amiwarp.Recording]:
    """Return simulated recordings of a rig that works and of rigs with one fault each, by their captions."""
    camera = amiwarp.Camera.from_fov(160, 120, math.radians(40))
    prism = amiwarp.Prism(APEX, flat_side="camera")
    picture = np.full((240, 320), 0.8)
    for x, y in ((60, 60), (150, 110), (240, 60), (90, 160), (220, 170)):
        picture[y : y + 26, x : x + 30] = 0.1

    def made(camera_motion: amiwarp.CameraMotion | None = None) -> amiwarp.Recording:
        motion = amiwarp.PrismMotion(720.0, PHASE)
        return amiwarp.simulate(
            picture,
            camera,
            prism,
            duration_s=0.26,
            motion=motion,
            camera_motion=camera_motion,
            seed=2,
        )

    good = made()
    encoder = good.encoder
    slipped = encoder.angle + math.radians(60) * (encoder.t > good.events.t_first + 130_000)
    steps = np.arange(0.0, 0.3, 1e-3)
    turning = 2 * math.pi * 12 * steps
    rate = math.radians(0.4) * 2 * math.pi * 12
    shaken = amiwarp.CameraMotion(
        np.column_stack([steps, rate * np.cos(2 * turning), rate * np.sin(2 * turning), 0 * steps])
    )
    return {
        "all is well": good,
        "encoder reversed (A and B exchanged)": replace(
            good, encoder=replace(encoder, angle=-encoder.angle)
        ),
        "counts lost in the middle, index missed": replace(
            good, encoder=replace(encoder, angle=slipped)
        ),
        "wedge of 1.5° taken for one of 0.75°": good,
        "camera shaken twice a turn by 0.2°": made(shaken),
        "no sync: clocks 8 ms apart": replace(good, encoder=replace(encoder, t=encoder.t + 8000)),
    }


def main(out: Path) -> None:
    """Write the pictures as one."""
    tiles = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        true = amiwarp.calibrate(recordings()["all is well"])
        for k, (caption, recording) in enumerate(recordings().items()):
            file, picture, parameters = (folder / f"{k}.{end}" for end in ("h5", "png", "json"))
            amiwarp.save_recording(file, recording)
            values = {**true.parameters, **({"apex": APEX / 2} if "taken for" in caption else {})}
            replace(true, parameters=values).save(parameters)
            command = [
                "view",
                str(file),
                "--screenshot",
                str(picture),
                "--calibration",
                str(parameters),
                "--view",
                "x-y",
                "--window",
                "0.0:0.25",
                "--size",
                "1000x440",
            ]
            subprocess.run(
                [sys.executable, "-m", "amiwarp", *command], check=True, capture_output=True
            )
            tile = Image.open(picture).convert("RGB")
            framed = Image.new("RGB", (tile.width, tile.height + 34), "white")
            framed.paste(tile, (0, 34))
            ImageDraw.Draw(framed).text((14, 6), caption, "black", ImageFont.load_default(22))
            tiles.append(framed)
    width, height = tiles[0].size
    sheet = Image.new("RGB", (2 * width, 3 * height), "white")
    for k, tile in enumerate(tiles):
        sheet.paste(tile, (k % 2 * width, k // 2 * height))
    sheet.quantize(64).save(out, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
