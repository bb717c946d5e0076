"""Shared fixtures: devices, a headless browser, the folder of real recordings, a picture and a simulated recording."""

import contextlib
import gc
import importlib
import math
import os
import pkgutil
import shutil
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp
from hypothesis import HealthCheck, settings

from amiwarp import (
    Calibration,
    Camera,
    PhotometricSettings,
    Prism,
    PrismMotion,
    Recording,
    calibrate,
    kernels,
    simulate,
)
from amiwarp.__main__ import MOST_NEW
from amiwarp.kernels.loading import load_all
from amiwarp.tasks import cores, limited_cpu_threads
from tests import ROOT, SHARE, durations

with contextlib.suppress(ImportError):
    # PyTorch's CUDA build imports Triton, which ends a process in which VTK has drawn with Mesa before.
    importlib.import_module("triton")
# The same examples each time, however fast the machine is. A fixture's folder may serve all examples of a test.
settings.register_profile(
    "amiwarp", deadline=None, derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)  # fmt: skip
settings.load_profile("amiwarp")
wp.init()
gc.set_threshold(MOST_NEW)  # as the command line does
# The many processes that tests start would otherwise compile the package each time, and each of xdist's all the tests.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

SLOW_LEFT_OUT = pytest.StashKey[int]()
"""Number of slow tests that ``-m`` left out."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """With ``-n auto``, start one process more than there are cores: tests also wait, for clocks and browsers."""
    return cores() + 1


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that records how long the tests take."""
    parser.addoption(
        "--record-durations", action="store_true", help="update tests/durations.json by this run"
    )


def pytest_configure(config: pytest.Config) -> None:
    """Let xdist keep the order of the files. By itself it begins with the files that have most tests.

    Kernels are compiled before its processes start, or each of them would compile them.
    """
    if config.getoption("record_durations"):
        config.pluginmanager.register(durations.Recorder())
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False
    if (getattr(config.option, "numprocesses", None) or 0) > 1 and not hasattr(
        config, "workerinput"
    ):
        for module in pkgutil.iter_modules(kernels.__path__, f"{kernels.__name__}."):
            importlib.import_module(module.name)
        for device in wp.get_devices():
            load_all(device)


def pytest_collection(session: pytest.Session) -> None:
    """Let each of xdist's processes compile a part of the files before it collects all, or each would compile all."""
    worker = getattr(session.config, "workerinput", None)
    if worker is not None and session.config.args == session.config.getini("testpaths"):
        number = int(worker["workerid"].removeprefix("gw"))
        files = sorted((ROOT / "tests").rglob("test_*.py"))
        for path in files[number :: worker["workercount"]]:
            module = path.relative_to(ROOT).with_suffix("")
            with contextlib.suppress(
                Exception, pytest.skip.Exception
            ):  # collection imports it again, and reports that
                importlib.import_module(".".join(module.parts))


@pytest.hookimpl(wrapper=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> Iterator[None]:
    """Mark the slow tests by their recorded durations. Begin with the files that take longest, so that no process works
    alone at the end; the order within a file stays."""
    seconds = durations.recorded()
    for item in items:
        if seconds.get(durations.name_of(item.nodeid), 0.0) >= durations.SLOW_S:
            item.add_marker("slow")
    yield
    of_file: Counter[Path] = Counter()
    for item in items:
        of_file[item.path] += seconds.get(durations.name_of(item.nodeid), 0.0)
    items.sort(key=lambda item: -of_file[item.path])


def pytest_deselected(items: list[pytest.Item]) -> None:
    """Count the slow tests that are left out."""
    stash = items[0].config.stash
    slow = sum(item.get_closest_marker("slow") is not None for item in items)
    stash[SLOW_LEFT_OUT] = stash.get(SLOW_LEFT_OUT, 0) + slow


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Tell xdist's main process how many slow tests are left out."""
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["slow_left_out"] = session.config.stash.get(SLOW_LEFT_OUT, 0)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Take the number from one of xdist's processes: each of them collects all tests."""
    number = getattr(node, "workeroutput", {}).get("slow_left_out", 0)  # none from one that crashed
    node.config.stash[SLOW_LEFT_OUT] = max(number, node.config.stash.get(SLOW_LEFT_OUT, 0))


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    """Say how many slow tests were left out."""
    number = config.stash.get(SLOW_LEFT_OUT, 0)
    if number and config.option.markexpr:
        terminalreporter.write_line(
            f"{number:,} slow tests were left out ({durations.SLOW_S:g} s or more each); pytest -m slow runs them"
        )


def pytest_collection_finish() -> None:
    """Leave all modules and tests out of later garbage collections, which would take half a second each."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def own_cores() -> Iterator[None]:
    """Give each of xdist's processes its share of the cores."""
    with limited_cpu_threads(SHARE):
        yield


@pytest.fixture
def every_core() -> Iterator[None]:
    """Use all cores nevertheless: for tests of what several threads make."""
    with limited_cpu_threads(None):
        yield


@pytest.fixture(params=["cpu", "cuda:0"])
def device(request: pytest.FixtureRequest) -> str:
    """Each device that Warp runs on. Without a CUDA GPU, its tests are reported as skipped."""
    if request.param.startswith("cuda") and not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    return str(request.param)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A headless Chromium. Without Chromium, its tests are reported as skipped."""
    sync_api = pytest.importorskip("playwright.sync_api")
    chromium = next(
        filter(None, map(shutil.which, ("chromium", "google-chrome", "chromium-browser"))), None
    )
    if chromium is None:
        pytest.skip("no Chromium on PATH")
    arguments = ["--no-sandbox", "--disable-gpu", "--disable-background-networking"]
    with sync_api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=chromium, args=arguments)
        yield started
        started.close()


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of the real recordings and pictures: AMIWARP_TEST_DATA, or ../shared/data next to the checkout."""
    default = ROOT.parent / "shared" / "data"
    folder = Path(os.environ.get("AMIWARP_TEST_DATA", default))
    if not (folder / "README.md").is_file():
        pytest.skip(f"no real recordings at {folder}; set AMIWARP_TEST_DATA")
    return folder


@pytest.fixture(scope="session")
def texture() -> np.ndarray:
    """A seeded picture with edges of every orientation: overlapping discs, shape (240, 320), 8 bit."""
    rng = np.random.default_rng(7)
    rows, columns = np.mgrid[:240, :320]
    picture = np.full((240, 320), 90, dtype=np.uint8)
    for _ in range(120):
        x, y, radius = rng.uniform(0, 320), rng.uniform(0, 240), rng.uniform(6, 30)
        picture[(columns - x) ** 2 + (rows - y) ** 2 < radius**2] = rng.integers(20, 250)
    return picture


COARSE = PhotometricSettings(pairs=100_000, density=1.0)
"""A third of the default's pairs and a quarter of the brightness map's nodes, which is enough for small images."""
TRUE_PRISM = Prism(math.radians(2.2), 1.52)
NOMINAL_PRISM = Prism(math.radians(2.6), 1.52)
TRUE_PHASE = 2.0


@pytest.fixture(scope="session")
def recording(texture: np.ndarray) -> Recording:
    """Three turns of the prism in front of the texture, 200 × 150, with noise. The nominal apex is not the true one."""
    camera = Camera.from_fov(200, 150, math.radians(50.0))
    return simulate(
        texture, camera, TRUE_PRISM, duration_s=0.25, motion=PrismMotion(720.0, phase=TRUE_PHASE),
        nominal_prism=NOMINAL_PRISM, seed=3,
    )  # fmt: skip


@pytest.fixture(scope="session")
def calibration(recording: Recording) -> Calibration:
    """The recording calibrated by both stages, with fewer events and a coarser brightness map than by default."""
    return calibrate(recording, events=100_000, photometric=COARSE)
