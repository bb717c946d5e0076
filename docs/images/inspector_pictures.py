"""Pictures of the inspector: its gallery, a figure for print, and a film of a calibration by hand.

``python docs/images/figures.py`` draws them. Each function gets the folder of ``amiwarp demo --size 320x240`` and the
path of the file that it writes.
"""

import io
import math
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

import amiwarp
from amiwarp.plotting.figures import indexed

SIZE = "1080x440"
MOST_BYTES, MOST_FILM_BYTES = 150_000, 1_500_000
FILM_SIZE, FILM_SCALE, FRAME_MS, LAST_MS, FILM_COLOURS = (1280, 800), 0.66, 120, 2500, 48
START, PHASE_STEPS, APEX_STEPS = {"phase": -75.0, "apex": 0.5}, 20, 10
"""Start of the film: distance of the phase from the true one, and of the apex [deg]; numbers of steps to the truth."""


def run(folder: str, *commands: str) -> None:
    """Run commands of amiwarp in a folder."""
    for command in commands:
        subprocess.run([sys.executable, "-m", "amiwarp", *command.split()], cwd=folder, check=True)


def quantised(picture: Path, out: Path) -> None:
    """Write a picture with 256 colours, and with fewer ones if the file is too large."""
    with Image.open(picture) as image:
        rgb = image.convert("RGB")
    indexed(np.asarray(rgb)).save(out, optimize=True)
    colours = 128
    while out.stat().st_size > MOST_BYTES and colours > 8:
        rgb.quantize(colours, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(
            out, optimize=True
        )
        colours //= 2
    print(f"{out.name}: {out.stat().st_size / 1e3:.0f} kB")


def shown(out: Path, *commands: str, view: str) -> None:
    """Write what ``amiwarp view`` shows of a file that the commands make in an empty folder."""
    with tempfile.TemporaryDirectory() as folder:
        run(folder, *commands, f"view {view} --screenshot seen.png --size {SIZE}")
        quantised(Path(folder) / "seen.png", out)


def wedge(demo: Path, out: Path) -> None:
    """A rotating wedge with encoder."""
    shown(
        out,
        view=f"{demo}/recording.h5 --calibration {demo}/calibration.json --region 145,85,225,145",
    )


def without_encoder(demo: Path, out: Path) -> None:
    """The same events without an encoder: the speed was found in them."""
    recording = amiwarp.open_recording(demo / "recording.h5")
    with tempfile.TemporaryDirectory() as folder:
        amiwarp.save_camera(f"{folder}/camera.json", recording.camera)
        run(
            folder, f"convert {demo}/recording.h5 events.npz",
            "convert events.npz plain.h5 --camera camera.json --nominal-apex-deg 1.2", "calibrate plain.h5 plain.json",
            f"view plain.h5 --calibration plain.json --region whole --view x-y --screenshot seen.png --size {SIZE}",
        )  # fmt: skip
        quantised(Path(folder) / "seen.png", out)


def plain(demo: Path, out: Path) -> None:
    """A plain event camera, without a prism."""
    shown(out, view=f"{data()}/text/shapes_rotation/events.txt --colour time --window 0:0.098")


def prophesee(demo: Path, out: Path) -> None:
    """Words of a Prophesee sensor (EVT 3.0)."""
    shown(
        out,
        view=f"{data()}/rosbag/ros2_evt3_640x480_trig10Hz.db3 --window 0.2:1.2 --view x-y --colour density",
    )


def mirror(demo: Path, out: Path) -> None:
    """A mirror that two signals tilt."""
    shown(
        out,
        f"simulate m.h5 --picture {demo}/picture.png --size 240x180 --duration 0.15 --optic mirror --mirror-hz 60,77 "
        "--mirror-deg 0.6,0.4",
        "calibrate m.h5 m.json --stages sharpness",
        view="m.h5 --calibration m.json --region 120,60,200,120",
    )


def vibration(demo: Path, out: Path) -> None:
    """A camera that a motor shakes."""
    shown(
        out,
        f"simulate v.h5 --picture {demo}/picture.png --size 240x180 --duration 0.1 --refractory-us 0 --optic vibration "
        "--hz 100 --amplitude-deg 0.8 --backward-deg 0.3,0.1",
        "calibrate v.h5 v.json --stages sharpness",
        view="v.h5 --calibration v.json --region 120,60,200,120 --colour residual",
    )


def two_prisms(demo: Path, out: Path) -> None:
    """A pair of prisms that turn at different speeds."""
    shown(
        out,
        f"simulate p.h5 --picture {demo}/picture.png --size 240x180 --duration 0.3 --apex-deg 1 --rpm 720 "
        "--second-apex-deg 0.8 --second-rpm -500 --second-phase-deg 20",
        "calibrate p.h5 p.json --stages sharpness",
        view="p.h5 --calibration p.json --region 120,60,200,120 --colour density",
    )


def world(demo: Path, out: Path) -> None:
    """A simulated room, with its ground truth of depth."""
    shown(
        out,
        "simulate room.h5 --world room --duration 0.1 --size 320x240 --apex-deg 1 --rpm 720",
        view="room.h5 --colour depth --view x-y --region whole",
    )


def print_figure(demo: Path, out: Path) -> None:
    """A figure for print."""
    with tempfile.TemporaryDirectory() as folder:
        view = f"view {demo}/recording.h5 --calibration {demo}/calibration.json --region 145,85,225,145"
        run(folder, f"{view} --screenshot seen.png --size 180x130mm --dpi 150")
        quantised(Path(folder) / "seen.png", out)


def calibration_by_hand(demo: Path, out: Path) -> None:
    """Phase and apex move from wrong to right values on the page: edges become columns, and the sharpness grows."""
    width, height = (round(FILM_SCALE * side) for side in FILM_SIZE)
    with tempfile.TemporaryDirectory() as folder:
        run(
            folder,
            f"simulate turned.h5 --picture {demo}/picture.png --size 320x240 --duration 0.25 --apex-deg 2 --rpm 720",
        )
        pictures = [
            image.convert("RGB").resize((width, height), Image.Resampling.LANCZOS)
            for image in page_pictures(Path(folder) / "turned.h5")
        ]
    palette = pictures[len(pictures) // 2].quantize(FILM_COLOURS, Image.Quantize.MAXCOVERAGE)
    frames = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in pictures]
    durations = [FRAME_MS] * (len(frames) - 1) + [LAST_MS]
    frames[0].save(
        out, save_all=True, append_images=frames[1:], duration=durations, loop=0, optimize=True
    )
    print(f"{out.name}: {out.stat().st_size / 1e3:.0f} kB, {len(frames)} pictures")
    assert out.stat().st_size <= MOST_FILM_BYTES


def page_pictures(recording: Path) -> Iterator[Image.Image]:
    """Yield pictures of the page while phase and apex move. Needs Chromium and Playwright."""
    from playwright.sync_api import sync_playwright

    truth = amiwarp.open_recording(recording).truth
    assert truth is not None
    best = {name: math.degrees(truth.parameters[name]) for name in START}
    command = [sys.executable, "-u", "-m", "amiwarp", "view", str(recording), "--web"]
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server,
        sync_playwright() as playwright,
    ):
        assert server.stdout is not None
        url = server.stdout.readline().split(": ")[1].strip()
        size = dict(zip(("width", "height"), FILM_SIZE, strict=True))
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"]
        )
        page = browser.new_page(viewport=size)
        page.goto(url)
        page.wait_for_selector("#field-phase")
        steps = [(name, 0.0) for name in START]
        steps += [("phase", k / PHASE_STEPS) for k in range(PHASE_STEPS + 1)]
        steps += [("apex", k / APEX_STEPS) for k in range(APEX_STEPS + 1)]
        for k, (name, share) in enumerate(steps):
            value = best[name] + START[name] * (0.5 + 0.5 * math.cos(math.pi * share))
            page.locator(f"#field-{name}").fill(f"{value:.3f}")
            page.locator(f"#field-{name}").press("Enter")
            page.wait_for_timeout(150)
            page.wait_for_function("document.querySelector('#updating').style.display === 'none'")
            page.wait_for_timeout(150)
            if k >= len(START):
                yield Image.open(io.BytesIO(page.screenshot()))
        browser.close()
        server.send_signal(signal.SIGINT)


def data() -> Path:
    """Return the folder of real recordings, as the tests find it."""
    return Path(os.environ["AMIWARP_TEST_DATA"])


PICTURES = {
    "gallery_wedge.png": wedge, "gallery_no_encoder.png": without_encoder, "gallery_plain.png": plain,
    "gallery_prophesee.png": prophesee, "gallery_mirror.png": mirror, "gallery_vibration.png": vibration,
    "gallery_two_prisms.png": two_prisms, "gallery_world.png": world, "figure.png": print_figure,
    "by_hand.gif": calibration_by_hand,
}  # fmt: skip
