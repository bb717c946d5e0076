"""The demo keeps its error limits, from the picture to the figure."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from typer.testing import CliRunner

from amiwarp import Calibration, open_recording
from amiwarp.kernels import checksum, loading
from amiwarp.plotting.clouds import Cloud, draw_cloud
from amiwarp.studies import warm_up
from tests.command_line import app

FILES = {"recording.h5", "calibration.json", "compensated.h5", "picture.png", "demo.png"}


def check(data: dict[str, float], out: Path) -> None:
    """Check the error limits of the demo."""
    assert data["blur_after_px"] <= 1.05 * data["blur_with_truth_px"]
    assert data["blur_after_px"] <= data["blur_before_px"] / 3.0
    assert data["model_error_px"] <= 0.5
    assert data["apex_deg"] == pytest.approx(data["apex_true_deg"], abs=0.1)
    assert {file.name for file in out.iterdir()} == FILES
    assert len(open_recording(out / "recording.h5").events) == data["events"]
    assert len(open_recording(out / "compensated.h5").events) == data["events"]
    assert np.degrees(
        Calibration.load(out / "calibration.json").parameters["apex"]
    ) == pytest.approx(data["apex_deg"])


def test_demo_at_its_default_size(tmp_path: Path) -> None:
    out = tmp_path / "made" / "demo"
    result = CliRunner().invoke(app, ["demo", "--out", str(out), "--json", "--device", "cpu"])
    assert result.exit_code == 0, result.stderr
    data = json.loads(result.stdout)
    check(data, out)
    assert data["seconds"] > 0.0
    assert data["picture_correlation"] >= 0.9
    assert data["picture_psnr_db"] >= 20.0
    assert np.asarray(Image.open(out / "picture.png")).shape == (360, 480)
    assert data["events"] > 1_000_000
    assert np.asarray(Image.open(out / "demo.png")).shape[1] > 1000
    assert (out / "demo.png").stat().st_size < 1_000_000


def test_clouds_are_drawn() -> None:
    rng = np.random.default_rng(0)
    cloud = Cloud(rng.uniform(-0.4, 0.4, (2000, 3)).astype(np.float32), rng.random(2000) < 0.5)
    figure = Figure(figsize=(4, 4))
    canvas = FigureCanvasAgg(figure)
    draw_cloud(figure.add_subplot(projection="3d"), cloud)
    canvas.draw()
    picture = np.asarray(canvas.buffer_rgba())[..., :3]
    assert (picture.reshape(-1, 3) < 200).any(axis=1).mean() > 0.02


def test_a_second_warm_up_compiles_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, device: str
) -> None:
    """One module stands for all of them, which take a minute to compile."""
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setattr(warm_up, "run_demo", lambda settings, progress: progress("simulating", 1.0))
    monkeypatch.setattr(warm_up, "CHOICE_KERNELS", ())
    modules = {"amiwarp.kernels.checksum": checksum, "json": json}
    monkeypatch.setattr(loading, "sys", SimpleNamespace(modules=modules, stderr=sys.stderr))
    module = checksum.compute_checksums.module
    compiled = []
    for _ in range(2):
        module.unload()
        loading._loaded.clear()
        result = CliRunner().invoke(app, ["warm-up", "--json", "--device", device])
        assert result.exit_code == 0, result.stderr
        data = json.loads(result.stdout)
        assert (data["cached"], data["cache"], data["devices"]) == (1, str(tmp_path), [device])
        compiled.append(data["compiled"])
    assert compiled == [1, 0]


def test_threads_share_the_compiled_header(tmp_path: Path) -> None:
    """Warp compiles its header for three seconds, once per thread."""
    program = (
        "import threading\n"
        "from amiwarp.kernels import checksum, loading\n"
        "from amiwarp.kernels.known_nodes import mark_known\n"
        "from amiwarp.kernels.events_with_angles import store_turns\n"
        "loading.load_ahead([(checksum.compute_checksums,), (mark_known,), (store_turns,)], 'cpu')\n"
        "[one.join() for one in threading.enumerate() if one.name.startswith('amiwarp-compiler')]\n"
        f"import pathlib; print(len(list(pathlib.Path({str(tmp_path)!r}).rglob('*.pch'))))\n"
    )
    environment = {
        **os.environ,
        "WARP_CACHE_PATH": str(tmp_path / "cache"),
        "TMPDIR": str(tmp_path),
    }
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=environment, capture_output=True, text=True, check=True, timeout=300,
    )  # fmt: skip
    assert len(list((tmp_path / "cache").rglob("*.o"))) == 3
    assert done.stdout.split()[-1] == "1", done.stdout


def test_compiling_while_the_command_loads_is_quiet() -> None:
    command = [sys.executable, "-m", "amiwarp", "demo", "--unknown"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert (done.returncode, done.stdout) == (2, "")
    assert "--unknown" in done.stderr
    assert "Warp" not in done.stderr
