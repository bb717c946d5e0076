"""A new optical model is one class and its device functions: a wedge with cylinder power is added, then removed."""

import ast
import importlib
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import amiwarp
from amiwarp.choices import OPTICAL_MODELS
from amiwarp.kernels.refraction import compensate_direction, deflect
from amiwarp.optics import MODELS, rungs
from amiwarp.results.parameters import units
from reference import optics as reference
from tests import ROOT
from tests.command_line import app
from tests.conftest import TRUE_PHASE, TRUE_PRISM

CYLINDER = 0.03
"""True cylinder power: 3 px at the image's border."""
VALUES = {"apex": TRUE_PRISM.apex, "phase": TRUE_PHASE, "power": CYLINDER}
MOST_FILES = 6
"""Largest number of files of the package that know a model by name."""
LOADED = """
import dataclasses
import numpy as np
import amiwarp
import tests.cylinder_model
from amiwarp.viewer.sliders import sliders
from amiwarp.viewer.inspector import Inspector
camera = amiwarp.Camera.from_fov(32, 24, 0.6)
recording = amiwarp.simulate(np.eye(32, dtype=np.float32), camera, amiwarp.Prism(0.02), duration_s=0.1)
inspector = Inspector(recording)
names = [slider["name"] for slider in sliders(inspector)]
inspector.set(dataclasses.replace(inspector.knobs, model="cylinder"))
slider = sliders(inspector)[-1]
print("power" in names, slider["name"], slider["label"], slider["least"], slider["most"], slider["step"])
"""


@pytest.fixture
def cylinder() -> Iterator[Any]:
    """The module of the new model, which registers the model; afterwards it is removed."""
    overloads = [function.user_overloads for function in (compensate_direction, deflect)]
    before = [set(each) for each in overloads]
    module = importlib.import_module("tests.cylinder_model")
    yield module
    del MODELS["cylinder"], sys.modules["tests.cylinder_model"]
    for each, known in zip(overloads, before, strict=True):
        added = set(each) - known
        assert len(added) == 1
        del each[added.pop()]


def oracle(
    camera: amiwarp.Camera, xy: np.ndarray, theta: np.ndarray, *, to_scene: bool
) -> np.ndarray:
    """Return compensated or deflected pixels in float64: Snell's law at both faces, and the scale along the azimuth."""
    phi = theta + TRUE_PHASE
    along = np.stack([np.cos(phi), np.sin(phi), 0.0 * phi], axis=1)

    def scaled(rays: np.ndarray, gain: float) -> np.ndarray:
        rays = rays + (gain - 1.0) * np.sum(rays * along, axis=1, keepdims=True) * along
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    rays = reference.pixels_to_rays(camera, xy)
    if to_scene:
        rays = scaled(rays, 1.0 / (1.0 + CYLINDER))
    rays = reference.through_prism(TRUE_PRISM, rays, phi, to_scene=to_scene)
    return reference.rays_to_pixels(camera, rays if to_scene else scaled(rays, 1.0 + CYLINDER))


def seen_through_cylinder(recording: amiwarp.Recording) -> amiwarp.Recording:
    """Return a simulated recording as if its prism had cylinder power: events move to the pixel that would see them."""
    assert recording.camera is not None
    assert recording.encoder is not None
    events = recording.events.slice(0, len(recording.events))
    theta = recording.encoder.angle_at(events.t)
    xy = np.stack([events.x, events.y], axis=1).astype(np.float64)
    scene = reference.move(recording.camera, TRUE_PRISM, xy, theta, to_scene=True, phase=TRUE_PHASE)
    moved = oracle(recording.camera, scene, theta, to_scene=False)
    width, height = recording.events.size
    inside = np.isfinite(moved).all(axis=1)
    x, y = np.rint(np.where(inside[:, None], moved, -1.0)).astype(int).T
    inside &= (x >= 0) & (y >= 0) & (x < width) & (y < height)
    kept = amiwarp.Events(
        x[inside].astype(np.uint16), y[inside].astype(np.uint16), events.t[inside], events.p[inside]
    )
    return replace(recording, events=amiwarp.MemoryEvents(kept, width, height), truth=None)


def test_device_functions_agree_with_float64(cylinder: Any) -> None:
    camera = amiwarp.Camera.from_fov(320, 240, 1.0)
    rng = np.random.default_rng(1)
    xy, theta = rng.uniform((0, 0), (319, 239), (2000, 2)), rng.uniform(-9, 9, 2000)
    model = cylinder.CylinderModel.from_values(camera, TRUE_PRISM, VALUES)
    np.testing.assert_allclose(
        model.compensate_points(xy, theta), oracle(camera, xy, theta, to_scene=True), atol=1e-3
    )
    np.testing.assert_allclose(
        model.deflect_points(xy, theta), oracle(camera, xy, theta, to_scene=False), atol=1e-3
    )


def test_it_is_calibrated_stored_and_compensated(
    cylinder: Any, recording: amiwarp.Recording, tmp_path: Path, device: str
) -> None:
    given = seen_through_cylinder(recording)
    settings = amiwarp.Settings(
        model="cylinder", free=("apex", "phase", "power"), events=100_000, stages=("sharpness",)
    )
    found = amiwarp.calibrate(given, settings, device=device)
    assert found.parameters["power"] == pytest.approx(CYLINDER, abs=0.004)
    assert found.parameters["apex"] == pytest.approx(TRUE_PRISM.apex, rel=0.03)
    plain = amiwarp.calibrate(given, replace(settings, model="exact", free=None), device=device)
    assert found.sharpness_after > 1.05 * plain.sharpness_after
    found.save(tmp_path / "c.json")
    loaded = amiwarp.Calibration.load(tmp_path / "c.json")
    assert (loaded.model, loaded.uncertainty.keys()) == (found.model, set(settings.free or ()))
    assert given.encoder is not None
    events = given.events.slice(0, 1000)
    out = amiwarp.compensate_events(events, loaded.model, given.encoder, device=device)
    xy = np.stack([events.x, events.y], axis=1).astype(np.float64)
    expected = loaded.model.compensate_points(xy, given.encoder.angle_at(events.t))
    np.testing.assert_allclose(out, expected, atol=2e-3)


@pytest.mark.slow
def test_programs_list_its_parameter(cylinder: Any, tmp_path: Path) -> None:
    assert units()["power"] == "1"
    assert "cylinder" not in rungs()
    said = (
        CliRunner()
        .invoke(app, ["calibrate", str(tmp_path / "no.h5"), "--start", "nothing=1"])
        .stderr
    )
    assert ", power, " in said
    printed = subprocess.run(
        [sys.executable, "-c", LOADED],
        cwd=ROOT, capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    assert "False power cylinder power -0.1 0.1 0.001" in printed


def test_nothing_is_left_of_it() -> None:
    assert "cylinder" not in MODELS
    assert "power" not in units()
    with pytest.raises(
        amiwarp.AmiwarpError, match="model is 'cylinder'; choose among auto, circle, exact"
    ):
        amiwarp.Settings(model="cylinder").check()


def test_the_guide_shows_a_short_file() -> None:
    root = ROOT
    assert (
        "literalinclude} ../../tests/cylinder_model.py"
        in (root / "docs/how-to/add-an-optic.md").read_text()
    )
    assert len((root / "tests/cylinder_model.py").read_text().splitlines()) <= 150


def knows(path: Path, model: type[amiwarp.Model]) -> bool:
    """Whether a source file names a model, its struct or its text in files; documentation does not count."""
    names, found, source = {model.__name__, model.STRUCT.key}, False, path.read_text()
    if not any(name in source for name in (*names, model.NAME)):
        return False
    for node in ast.walk(ast.parse(source)):
        match node:
            case (
                ast.Name(id=name)
                | ast.Attribute(attr=name)
                | ast.alias(name=name)
                | ast.ClassDef(name=name)
            ):
                found |= name in names
            case ast.Constant(value=str(text)):
                found |= text == model.NAME
    return found


def test_few_files_know_a_model() -> None:
    package = Path(amiwarp.__file__).parent
    files = [*package.rglob("*.py"), *package.rglob("*.pyi")]
    known = sorted(
        str(path.relative_to(package)) for path in files if knows(path, amiwarp.RadialCircleModel)
    )
    assert "optics/models/circle.py" in known
    assert len(known) <= MOST_FILES, known


def test_names_for_programs_that_do_not_load_models() -> None:
    assert tuple(MODELS) == OPTICAL_MODELS
