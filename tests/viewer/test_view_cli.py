"""Command ``view``: pictures without a window, and errors for bad input."""

import asyncio
import json
import math
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import types
import urllib.request
from collections.abc import Callable
from ctypes.util import find_library
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

import amiwarp
from amiwarp import Camera, MemoryEvents, Prism, open_recording, save_recording, simulate
from amiwarp.viewer import Inspector, Library, screenshot
from amiwarp.viewer import serve_panel as page_server
from amiwarp.viewer.scene import Scene
from amiwarp.viewer.serve import LIBRARIES
from reference.calibration_sample import exact_calibration
from tests.command_line import app


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory, texture: np.ndarray) -> Path:
    """Folder with a recording, and a calibration made from its ground truth."""
    folder = tmp_path_factory.mktemp("view")
    camera, prism = Camera.from_fov(120, 90, math.radians(50)), Prism(math.radians(1.0))
    recording = simulate(
        texture, camera, prism, duration_s=0.2, seed=1, nominal_prism=Prism(math.radians(1.3))
    )
    save_recording(folder / "recording.h5", recording)
    assert recording.truth is not None
    found = {"apex": prism.apex, "phase": recording.truth.parameters["phase"]}
    exact_calibration(camera, prism, found).save(folder / "c.json")
    return folder


def view(*args: str | Path) -> tuple[int, str, str]:
    done = CliRunner().invoke(app, ["view", *map(str, args)])
    return done.exit_code, done.stdout, done.stderr


def test_a_picture_without_a_window(files: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.png"
    options = [
        "--view",
        "x-y",
        "--colour",
        "density",
        "--dark",
        "--size",
        "400x200",
        "--region",
        "whole",
        "--json",
    ]
    code, said, _ = view(
        files / "recording.h5", "--calibration", files / "c.json", "--screenshot", out, *options
    )
    assert code == 0
    data = json.loads(said)
    assert data["sharpness_after"] > 1.1 * data["sharpness_before"]
    assert data["events"] == data["drawn"] > 10_000
    picture = np.asarray(Image.open(out).convert("RGB"))
    assert picture.shape == (200, 400, 3)
    assert np.median(picture) < 60  # dark
    assert picture.std() > 10


def test_an_interrupt_waits_until_vtk_has_drawn(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """VTK crashes if an exception leaves it half-drawn."""
    look_from, closed = Scene.look_from, []

    def interrupted(scene: Scene, *given: Any) -> None:
        signal.raise_signal(signal.SIGINT)
        look_from(scene, *given)

    monkeypatch.setattr(Scene, "look_from", interrupted)
    close = Scene.close
    monkeypatch.setattr(Scene, "close", lambda scene: closed.append(close(scene)))
    inspector = Inspector(open_recording(files / "recording.h5"))
    # A shell's background jobs ignore the signal
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            screenshot.save_screenshot(inspector, tmp_path / "out.png", size=(400, 200))
    finally:
        signal.signal(signal.SIGINT, before)
    assert closed == [None]
    assert np.asarray(Image.open(tmp_path / "out.png")).shape[:2] == (200, 400)


def test_window_model_and_axis(files: Path, tmp_path: Path) -> None:
    one, two = tmp_path / "1.png", tmp_path / "2.png"
    wide = json.loads(view(files / "recording.h5", "--screenshot", one, "--json")[1])
    options = [
        "--window",
        "0.05:0.07",
        "--axis",
        "time",
        "--model",
        "circle",
        "--overlaid",
        "--json",
    ]
    cut = json.loads(view(files / "recording.h5", "--screenshot", two, *options)[1])
    assert 0 < cut["events"] < 0.5 * wide["events"]
    assert one.read_bytes() != two.read_bytes()


@pytest.mark.parametrize(
    ("given", "region"), [("whole", [0, 0, 120, 90]), ("20,30,70,60", [20, 30, 70, 60])]
)
def test_a_picture_shows_the_wanted_region(
    files: Path, tmp_path: Path, given: str, region: list[int]
) -> None:
    data = json.loads(
        view(
            files / "recording.h5", "--screenshot", tmp_path / "o.png", "--region", given, "--json"
        )[1]
    )
    left, top, right, bottom = data["region"]
    assert data["region"] == region
    start, length = Inspector(open_recording(files / "recording.h5")).first_window()
    e = open_recording(files / "recording.h5").events.between(start, start + length)
    inside = (e.x >= left) & (e.x < right) & (e.y >= top) & (e.y < bottom)
    assert data["drawn"] == np.count_nonzero(inside)


def test_a_picture_in_which_the_motion_is_too_small_shows_the_suggested_region(
    files: Path, tmp_path: Path
) -> None:
    """An apex of 1° moves the image of 120 px by 1.2 px to each side, one of 3° by 3.5 px."""
    calibration = json.loads((files / "c.json").read_text())
    calibration["parameters"]["apex"]["value"] *= 3.0
    (tmp_path / "strong.json").write_text(json.dumps(calibration))
    shown = {}
    for name, calibrated in (("weak", files / "c.json"), ("strong", tmp_path / "strong.json")):
        options = ["--calibration", calibrated, "--screenshot", tmp_path / f"{name}.png", "--json"]
        shown[name] = json.loads(view(files / "recording.h5", *options)[1])
        asked = [
            "--calibration",
            calibrated,
            "--screenshot",
            tmp_path / f"{name}2.png",
            "--region",
            "suggested",
        ]
        shown[f"{name} asked"] = json.loads(view(files / "recording.h5", *asked, "--json")[1])
    assert shown["weak"]["region"] == shown["weak asked"]["region"] != [0, 0, 120, 90]
    assert "--region whole" in " ".join(shown["weak"]["notes"])
    assert "--region whole" not in " ".join(shown["weak asked"]["notes"])
    assert shown["strong"]["region"] == [0, 0, 120, 90] != shown["strong asked"]["region"]
    assert "--region whole" not in " ".join(shown["strong"]["notes"])


def test_a_picture_without_a_rotating_prism_shows_one_cloud(files: Path, tmp_path: Path) -> None:
    recording, out = open_recording(files / "recording.h5"), tmp_path / "out.png"
    events = MemoryEvents(recording.events.slice(0, 5_000), *recording.events.size)
    save_recording(
        tmp_path / "plain.h5", replace(recording, events=events, encoder=None, truth=None)
    )
    code, said, _ = view(tmp_path / "plain.h5", "--screenshot", out, "--size", "400x200")
    assert code == 0
    assert "compensated" not in said.splitlines()[-1]
    seen = np.asarray(Image.open(out).convert("RGB"))[:, 190:210].astype(int)
    assert (
        seen.max(axis=2) - seen.min(axis=2) > 100
    ).any()  # its points are in the middle of the picture


def test_undistorted_events_are_shown_beside_the_recording(files: Path, tmp_path: Path) -> None:
    """Each recording has its own numbers, in the printed lines as in the picture."""
    recording, out = open_recording(files / "recording.h5"), tmp_path / "out.png"
    events = recording.events.slice(0, 5_000)
    plain = replace(recording, encoder=None, truth=None, prism=None)
    save_recording(tmp_path / "raw.h5", replace(plain, events=MemoryEvents(events, 120, 90)))
    moved = events[::4]
    moved = replace(moved, x=moved.x.astype(np.float32), y=moved.y.astype(np.float32))
    save_recording(tmp_path / "moved.h5", replace(plain, events=MemoryEvents(moved, 120, 90)))
    code, _, said = view(tmp_path / "moved.h5", "--screenshot", out)
    assert code == 1
    assert "already compensated or undistorted; show them beside" in said
    beside = ("--beside", tmp_path / "moved.h5", "--screenshot", out, "--size", "400x200")
    code, said, _ = view(tmp_path / "raw.h5", *beside, "--json")
    assert code == 0
    data = json.loads(said)
    out.unlink()
    code, said, _ = view(tmp_path / "raw.h5", *beside)
    *_, first, second, file = said.splitlines()
    assert file == str(out)
    assert first.startswith("moved: ")
    assert second.startswith(f"raw: {data['events']:,} events")
    assert first.endswith(f"sharpness {data['sharpness_before']:.3f}")
    assert f"{data['events']:,} events" not in first


def test_a_picture_of_a_plain_recording_asks_for_no_encoder(files: Path, tmp_path: Path) -> None:
    recording = open_recording(files / "recording.h5")
    events = MemoryEvents(recording.events.slice(0, 5_000), *recording.events.size)
    plain = replace(recording, events=events, encoder=None, truth=None, prism=None, camera=None)
    save_recording(tmp_path / "plain.h5", plain)
    save_recording(tmp_path / "prism.h5", replace(plain, prism=recording.prism))
    for name, asks in (("plain", False), ("prism", True)):
        code, said, _ = view(
            tmp_path / f"{name}.h5", "--screenshot", tmp_path / f"{name}.png", "--size", "400x200"
        )
        assert code == 0
        assert ("no encoder" in said) == asks
        assert ("camera unknown" in said) == asks


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["--screenshot", "out.jpg"], "written as .png"),
        (["--screenshot", "nowhere/out.png"], "nowhere"),
        (["--screenshot", "out.png", "--window", "5:2"], "--window '5:2' is not a time span"),
        (["--screenshot", "out.png", "--window", "50:60"], "take another window"),
        (
            ["--screenshot", "out.png", "--model", "sphere"],
            "choose among circle, exact, radial, ellipse",
        ),
        (["--screenshot", "out.png", "--size", "9x9"], "--size"),
        (
            ["--screenshot", "out.png", "--region", "0,0,121,90"],
            "--region 0,0,121,90: is no part of the image of 120x90",
        ),
        (["--screenshot", "out.png", "--region", "9,0,9,90"], "is no part of the image"),
        (["--screenshot", "out.png", "--region", "all"], "--region"),
        (["--region", "whole"], "give --screenshot too"),
        (["--calibration", "none.json"], "none.json"),
        (["--screenshot", "out.png", "--web"], "give one of them"),
        (["--screenshot", "out.png", "--host", "0.0.0.0"], "give --web too"),
        (["--screenshot", "out.png", "--port", "80"], "give --web too"),
        (["--screenshot", "out.png", "--controller", "find"], "give --live too"),
    ],
    ids=lambda v: str(v)[:40],
)
def test_bad_input_is_reported_in_one_line(files: Path, args: list[str], says: str, tmp_path: Path,
                                     monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    code, said, error = view(files / "recording.h5", *args)
    assert (code, said) == (1, "")
    assert error.count("\n") == 1
    assert says in error
    assert list(tmp_path.iterdir()) == []


def test_events_behind_a_plate_are_shown_at_the_depths_of_a_map(
    files: Path, tmp_path: Path
) -> None:
    recording = replace(
        open_recording(files / "recording.h5"), prism=amiwarp.Plate(0.03, 0.8), truth=None
    )
    save_recording(tmp_path / "plate.h5", recording)
    inverse = np.full((90, 120), 0.5, np.float32)
    inverse[:, 60:] = 3.0
    amiwarp.DepthMap(inverse, 0.05 * inverse, np.zeros((90, 120, 3), np.float32)).save(
        tmp_path / "d.npz"
    )
    found = []
    for k, options in enumerate(([], ["--depth", tmp_path / "d.npz"])):
        code, said, _ = view(
            tmp_path / "plate.h5", "--screenshot", tmp_path / f"{k}.png", "--json", *options
        )
        assert code == 0
        found.append(json.loads(said)["sharpness_after"])
    assert found[0] != found[1]
    assert (tmp_path / "0.png").read_bytes() != (tmp_path / "1.png").read_bytes()
    code, _, error = view(
        files / "recording.h5", "--screenshot", tmp_path / "x.png", "--depth", tmp_path / "d.npz"
    )
    assert code == 1
    assert "a depth map is for a rotating tilted plate" in error
    assert not (tmp_path / "x.png").exists()


def test_an_unreadable_and_an_empty_file(tmp_path: Path) -> None:
    (tmp_path / "noise.h5").write_bytes(b"not at all")
    assert view(tmp_path / "noise.h5")[0] == 1
    code, _, error = view(tmp_path / "missing.h5", "--screenshot", tmp_path / "o.png")
    assert code == 1
    assert "missing.h5" in error


@pytest.mark.parametrize("library", LIBRARIES)
def test_the_page_names_its_extra_before_the_recording_is_opened(
    library: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    code, _, error = view(tmp_path / "missing.h5", "--web")
    assert code == 1
    name = library.partition("_")[0]
    wanted = f"the inspector's page needs {name}; run: pip install 'amiwarp[page]'"
    assert error == f"amiwarp: {wanted}\n"


def test_pictures_need_no_library_of_the_page(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for library in LIBRARIES:
        monkeypatch.setitem(sys.modules, library, None)
    code, _, error = view(
        files / "recording.h5", "--size", "400x200", "--screenshot", tmp_path / "out.png"
    )
    assert (code, error) == (0, "")


def test_another_camera_s_calibration(files: Path, tmp_path: Path) -> None:
    data = json.loads((files / "c.json").read_text())
    data["camera"] |= {"width": 60, "height": 40}
    (tmp_path / "other.json").write_text(json.dumps(data))
    code, _, error = view(files / "recording.h5", "--calibration", tmp_path / "other.json")
    assert code == 1
    assert "60x40 pixels, the events are of 120x90" in error


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have a display")
@pytest.mark.parametrize(
    ("display", "says"), [("", "no display"), (":987", "':987' cannot be opened")]
)
def test_without_a_display_one_line_names_what_to_do(
    files: Path, monkeypatch: pytest.MonkeyPatch, display: str, says: str
) -> None:
    monkeypatch.setenv("DISPLAY", display)
    code, said, error = view(files / "recording.h5")
    assert (code, said) == (1, "")
    assert says in error
    assert "run with --web" in error
    assert error.count("\n") == 1


@pytest.mark.skipif(
    find_library("X11") is None or shutil.which("Xvfb") is None, reason="needs Xvfb, an X server"
)
def test_a_window_opens_and_a_signal_closes_it(files: Path, tmp_path: Path) -> None:
    """A real window on a virtual display, whose picture is that of the X server."""
    read, write = os.pipe()
    server = subprocess.Popen(["Xvfb", "-displayfd", str(write), "-screen", "0", "640x480x24", "-fbdir", tmp_path],
                              pass_fds=[write], stderr=subprocess.DEVNULL)  # fmt: skip
    os.close(write)
    with server, os.fdopen(read) as number:
        display = f":{number.readline().strip()}"
        screen = tmp_path / "Xvfb_screen0"
        command = [
            sys.executable,
            "-m",
            "amiwarp",
            "view",
            files / "recording.h5",
            "--size",
            "640x480",
        ]
        shown = subprocess.Popen(
            command, env={**os.environ, "DISPLAY": display}, stderr=subprocess.PIPE, text=True
        )
        until, colours = time.monotonic() + 60.0, 0
        while colours < 20 and shown.poll() is None and time.monotonic() < until:
            time.sleep(0.2)
            colours = len(np.unique(np.frombuffer(screen.read_bytes(), "<u4")[-640 * 480 :]))
        shown.terminate()
        _, error = shown.communicate(timeout=60.0)
        server.terminate()
    assert colours >= 20, error
    assert "Traceback" not in error


def test_a_page_in_the_network_prints_a_warning(
    files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A warning names who can reach the page. The page may open the other files of the recording's folder."""
    folders: list[Path] = []

    def serve_panel(
        make: object, library: Library, *, host: str, port: int, ready: Callable[[str], None]
    ) -> None:
        folders.append(library.folder)
        ready(f"http://{host}:{port}/")

    monkeypatch.setattr(page_server, "serve_panel", serve_panel)
    code, said, error = view(files / "recording.h5", "--web", "--host", "0.0.0.0")
    assert code == 0
    assert "everybody on the network" in error
    assert "control the inspector" in error
    assert said.startswith("recording.h5: http://")
    assert view(files / "recording.h5", "--web")[2] == ""
    assert folders == [files.resolve()] * 2


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["--host", "192.0.2.1"], "is not an address of this machine"),
        (["--port", "{port}"], "is in use"),
    ],
)
def test_a_page_that_cannot_be_served_is_reported_in_one_line(
    files: Path, args: list[str], says: str
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        given = [a.format(port=other.getsockname()[1]) for a in args]
        code, said, error = view(files / "recording.h5", "--web", *given)
    assert (code, said) == (1, "")
    assert says in error.splitlines()[-1]
    assert error.count("\n") == 1


def test_a_notebook_shows_the_page_below_its_cell(
    files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fake IPython display collects the page's address, which is there when the call returns."""
    pages: list[str] = []
    fake = types.ModuleType("IPython.display")
    vars(fake).update(IFrame=lambda url, width, height: url, display=pages.append)
    monkeypatch.setitem(sys.modules, "IPython", types.ModuleType("IPython"))
    monkeypatch.setitem(sys.modules, "IPython.display", fake)

    async def cell() -> bytes:
        shown = amiwarp.view(open_recording(files / "recording.h5"))
        [url] = (
            pages  # nothing has waited: programs that run notebooks keep only what a cell shows before it ends
        )
        page = await asyncio.to_thread(lambda: urllib.request.urlopen(url, timeout=30.0).read())
        assert shown._ipython_display_() is None  # the cell shows the page and nothing else
        shown.close()
        await asyncio.wait([shown._serving])
        with pytest.raises(OSError, match="refused"):
            urllib.request.urlopen(url)
        return bytes(page)

    async def closed_at_once() -> None:
        """A page that is closed before the server starts frees its port."""
        shown = amiwarp.view(open_recording(files / "recording.h5"))
        shown.close()
        await asyncio.wait([shown._serving])
        await asyncio.sleep(0.0)
        with pytest.raises(OSError, match="refused"):
            urllib.request.urlopen(pages[-1])

    assert b"<html" in asyncio.run(cell()).lower()
    asyncio.run(closed_at_once())
