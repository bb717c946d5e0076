"""Randomised values of data sets: how they are drawn, what they do to a recording, and what is refused."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from scipy.stats import kstest, uniform
from typer.testing import CliRunner

import amiwarp
from amiwarp import AmiwarpError
from amiwarp.io.recorded_dataset import MANIFEST
from tests.command_line import app
from tests.learning import specifications

HEAD = """
format = "amiwarp-dataset-specification"
version = 1
duration_s = 0.02
prisms = [{apex_deg = 1.0}]
speeds_rpm = [720.0]
sensors = ["ideal"]
camera = {size = [24, 18], fov_deg = 40.0}
"""
PICTURES = '[[sources]]\npictures = "*.png"\nlabels = {class = "noise"}\n'
WORLDS = '[[sources]]\nworlds = ["room"]\ntrajectories = ["still"]\n'
RANGES = """
[randomise]
light = {log_uniform = [0.1, 1.0]}
gamma = {uniform = [0.5, 1.5]}
apex_deg = {uniform = [0.5, 2.0]}
rpm = {choice = [600.0, 900.0, 1200.0]}
start_deg = {uniform = [0.0, 360.0]}
blur_px = {uniform = [0.3, 1.0]}
contrast_on = {uniform = [0.03, 0.08]}
shot_noise_hz = {log_uniform = [1.0, 100.0]}
shake_deg = {uniform = [0.2, 1.0]}
shake_hz = {uniform = [20.0, 60.0]}
shake_direction_deg = {uniform = [0.0, 180.0]}
"""


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """Folder with a picture."""
    light = np.random.default_rng(5).integers(40, 256, (6, 8))
    picture = np.kron(light, np.ones((8, 8))).astype(np.uint8)
    Image.fromarray(picture).save(tmp_path / "noise.png")
    return tmp_path


def items_of(place: Path, text: str) -> list[Any]:
    (place / "spec.toml").write_text(text)
    return specifications.items_of(place / "spec.toml")


def drawn(items: list[Any], name: str) -> np.ndarray:
    return np.array([item.drawn[name] for item in items])


def test_values_follow_their_laws(place: Path) -> None:
    items = items_of(place, "seeds = 2000\n" + HEAD + PICTURES + RANGES)
    light, apex, rpm = (drawn(items, name) for name in ("light", "apex_deg", "rpm"))
    assert light.min() >= 0.1
    assert light.max() <= 1.0
    assert kstest(np.log10(light), uniform(-1.0, 1.0).cdf).pvalue > 0.1
    assert kstest(apex, uniform(0.5, 1.5).cdf).pvalue > 0.1
    values, counts = np.unique(rpm, return_counts=True)
    assert values.tolist() == [600.0, 900.0, 1200.0]
    assert counts.min() > 600
    # The values of one recording are independent of each other
    assert abs(np.corrcoef(np.log10(light), apex)[0, 1]) < 0.06
    assert len({item.key for item in items}) == 2000
    assert len({item.seed for item in items}) == 2000


def test_values_depend_on_nothing_but_source_seed_and_name(place: Path) -> None:
    """Not on other entries, seeds, sensors and prisms: recordings of one seed see the same scene."""
    text = HEAD.replace('"ideal"', '"ideal", "davis346"') + PICTURES
    entry = "[randomise]\nlight = {log_uniform = [0.1, 1.0]}\n"
    alone = items_of(place, "seeds = [7]\nno_prism = true\n" + text + entry + SHAKE)
    assert len(alone) == 4
    (light,) = set(drawn(alone, "light"))
    assert {item.recipe["prism"] is None for item in alone} == {True, False}
    among = items_of(place, "seeds = 9\n" + HEAD + PICTURES + RANGES)
    seventh = next(item for item in among if item.recipe["seed"] == 7)
    assert seventh.drawn["light"] == light
    plain = items_of(place, "seeds = [7]\nno_prism = true\n" + HEAD + PICTURES + RANGES)
    assert [sorted({"apex_deg", "rpm", "start_deg"} & set(item.drawn)) for item in plain] == [
        ["apex_deg", "rpm", "start_deg"],
        [],
    ]


SHAKE = "shake_deg = {choice = [0.5]}\nshake_hz = {choice = [30.0]}\n"


def by_hand(item: Any, picture: Path) -> amiwarp.Simulation:
    """The simulation that the values of a recording describe, made of public classes."""
    v = item.drawn
    light = amiwarp.Scene.from_picture(picture).frames.light ** v["gamma"]  # type: ignore[attr-defined]
    scene = amiwarp.Scene.from_picture((v["light"] * light).astype(np.float32), blur=v["blur_px"])
    t = np.linspace(0.0, 0.02, 2000)
    omega = 2.0 * math.pi * v["shake_hz"]
    speed = math.radians(v["shake_deg"]) * omega * np.cos(omega * t)
    direction = math.radians(v["shake_direction_deg"])
    rates = np.column_stack([t, speed * -math.sin(direction), speed * math.cos(direction), 0.0 * t])
    ideal = amiwarp.SensorModel.ideal()
    return amiwarp.Simulation(
        scene,
        amiwarp.Camera.from_fov(24, 18, math.radians(40.0)),
        amiwarp.Prism(math.radians(v["apex_deg"])),
        0.02,
        motion=amiwarp.PrismMotion(v["rpm"], math.radians(v["start_deg"])),
        camera_motion=amiwarp.CameraMotion(rates),
        sensor=amiwarp.SensorModel(
            v["contrast_on"],
            ideal.contrast_off,
            mismatch=0.0,
            refractory_us=0.0,
            latency_us=0.0,
            latency_jitter_us=0.0,
            leak_hz=0.0,
            shot_noise_hz=v["shot_noise_hz"],
            hot_fraction=0.0,
        ),
        seed=item.seed,
    )


def test_a_recording_can_be_made_again_from_its_labels(place: Path) -> None:
    text = "seeds = 2\n" + HEAD + PICTURES + RANGES
    items = {item.file: item for item in items_of(place, text)}
    done = amiwarp.make_dataset(place / "spec.toml", place / "out", workers=1)
    assert done.failed == {}
    manifest = json.loads((place / "out" / MANIFEST).read_text())
    assert len(manifest["items"]) == 2
    for row in manifest["items"]:
        item = items[row["file"]]
        assert row["labels"] == {"class": "noise", **item.drawn}
        assert (row["apex_deg"], row["rpm"]) == (item.drawn["apex_deg"], item.drawn["rpm"])
        recording = amiwarp.open_recording(place / "out" / row["file"])
        stored = {name: recording.metadata[f"drawn_{name}"] for name in item.drawn}
        assert stored == dict(item.drawn)
        assert recording.truth is not None
        assert recording.truth.parameters["apex"] == pytest.approx(
            math.radians(item.drawn["apex_deg"]), abs=1e-12
        )
        found = recording.events.slice(0, len(recording.events))
        expected = by_hand(item, place / "noise.png").run().events
        assert len(found) == pytest.approx(len(expected), rel=0.01)
        assert len(found) > 200
        # The shakes of both are sampled at other times, so a few events differ by a little
        counts = [
            np.bincount(e.y.astype(int) * 24 + e.x, minlength=432) for e in (found, expected[:])
        ]
        assert (counts[0] == counts[1]).mean() > 0.9
    names = {row["file"] for row in manifest["items"]}
    dataset = amiwarp.RecordedDataset(place / "out")
    assert {labels["light"] for _, labels in (dataset[k] for k in range(len(dataset)))} == {
        items[name].drawn["light"] for name in names
    }


def test_the_same_files_come_from_any_run(place: Path) -> None:
    """In other company, in another order, and made again."""
    text = HEAD + PICTURES + RANGES
    (place / "spec.toml").write_text("seeds = 3\n" + text)
    amiwarp.make_dataset(place / "spec.toml", place / "out", workers=1)
    together = {p.name: p.read_bytes() for p in (place / "out").rglob("*.h5")}
    (place / "spec.toml").write_text("seeds = [2]\n" + text)
    amiwarp.make_dataset(place / "spec.toml", place / "other", workers=1)
    ((name, content),) = {p.name: p.read_bytes() for p in (place / "other").rglob("*.h5")}.items()
    assert together[name] == content


def test_ranges_are_printed(place: Path) -> None:
    light = drawn(items_of(place, "seeds = 3\n" + HEAD + PICTURES + RANGES), "light")
    words = ["dataset", str(place / "spec.toml"), str(place / "out"), "--device", "cpu"]
    for more in (["--dry-run"], ["--workers", "1"]):
        result = CliRunner().invoke(app, words + more)
        assert result.exit_code == 0, result.output
        said = f"drawn: light {light.min():.4g} .. {light.max():.4g}, median {np.median(light):.4g}; gamma "
        assert said in result.stdout
    data = json.loads(CliRunner().invoke(app, [*words, "--json"]).stdout)
    assert data["drawn"]["light"]["least"] == light.min()


def test_a_world_is_lit_and_shaken_as_drawn(place: Path) -> None:
    ranges = """
[randomise]
light = {uniform = [0.2, 0.5]}
blur_px = {choice = [0.7]}
shake_deg = {choice = [0.8]}
shake_hz = {choice = [40.0]}
shake_direction_deg = {choice = [30.0]}
"""
    text = "truth_hz = 100.0\n" + HEAD + WORLDS + ranges
    (item,) = items_of(place, text)
    assert amiwarp.make_dataset(place / "spec.toml", place / "out", workers=1).failed == {}
    recording = amiwarp.open_recording(place / "out" / item.file)
    assert recording.truth is not None
    assert recording.truth.poses is not None
    assert recording.truth.frames is not None
    camera = amiwarp.Camera.from_fov(24, 18, math.radians(40.0))
    world, way = amiwarp.named_world("room", "still", seed=0, duration_s=0.02)

    # A sinusoidal rotation about an axis of the camera, and no other motion
    poses = recording.truth.poses[:]
    axis = np.array([-math.sin(math.radians(30.0)), math.cos(math.radians(30.0)), 0.0])
    angle = math.radians(0.8) * np.sin(2.0 * math.pi * 40.0 * poses.t * 1e-6)
    assert np.abs(angle).max() > math.radians(0.79)
    at_rest, position = way.poses(poses.t * 1e-6)
    expected = Rotation.from_matrix(at_rest) * Rotation.from_rotvec(np.outer(angle, axis))
    error = (expected.inv() * Rotation.from_quat(poses.camera[:, 3:])).magnitude()
    assert error.max() < math.radians(0.8) * 0.001
    np.testing.assert_allclose(poses.camera[:, :3], position, rtol=0, atol=1e-9)

    # The same picture, darker; lamps that shine themselves stay as they are
    scene = amiwarp.WorldScene(world, way, blur=0.7)
    bright = amiwarp.TruthRenderer(
        amiwarp.Simulation(scene, camera, amiwarp.Prism(0.01), 0.02)
    ).luminance(0)
    ratio = recording.truth.frames[0].intensity / bright
    assert np.median(ratio) == pytest.approx(item.drawn["light"], rel=1e-3)
    assert np.isclose(ratio, item.drawn["light"], rtol=5e-3).mean() > 0.8


def test_a_shake_moves_the_image_along_its_direction(place: Path) -> None:
    """0 degrees moves it along x: events come from the edges of vertical stripes, and not of horizontal ones."""
    stripes = np.tile(np.repeat([40, 250], 4), (64, 8)).astype(np.uint8)
    Image.fromarray(stripes).save(place / "noise.png")
    head = "no_prism = true\n" + HEAD.replace("prisms = [{apex_deg = 1.0}]\n", "").replace(
        "speeds_rpm = [720.0]\n", ""
    )
    counts = []
    for k, degrees in enumerate((0.0, 90.0, 45.0, 135.0)):
        if degrees == 45.0:
            y, x = np.mgrid[:64, :64]  # edges along which x and y grow alike
            Image.fromarray(np.where((x - y) // 6 % 2, 40, 250).astype(np.uint8)).save(
                place / "noise.png"
            )
        ranges = f"[randomise]\nshake_direction_deg = {{choice = [{degrees}]}}\n" + SHAKE
        items_of(place, head + PICTURES + ranges)
        done = amiwarp.make_dataset(place / "spec.toml", place / f"out{k}", workers=1)
        assert done.failed == {}
        counts.append(done.events)
    assert counts[0] > 100
    assert counts[1] == 0
    # y points down: at 45 degrees the image moves along the edges, at 135 degrees across them.
    assert counts[3] > 100
    assert counts[2] < 0.2 * counts[3]


WRONG: dict[str, tuple[str, str]] = {
    "unknown": ("lihgt = {uniform = [1, 2]}", "field randomise has the value is 'lihgt'"),
    "none": ("light = {}", r"field randomise\.light: has no range; give one of uniform, log_uniform and choice"),
    "two": ("light = {uniform = [0.5, 1], choice = [1]}", "has uniform and choice; give one of"),
    "empty": ("light = {choice = []}", "choice is empty; give at least one value"),
    "falls": ("light = {uniform = [1, 0.5]}", "uniform is .* give the lowest and a higher value"),
    "log": ("light = {log_uniform = [0, 1]}", "log_uniform begins at 0; give a value above 0"),
    "range": ("contrast_on = {uniform = [0.001, 0.2]}", r"randomise\.contrast_on: .*contrast_on = 0\.001"),
    "apex": ("apex_deg = {choice = [1, 800]}", r"randomise\.apex_deg: "),
    "shake": ("shake_deg = {choice = [1]}", "one of shake_deg and shake_hz; give both"),
    "direction": ("shake_direction_deg = {choice = [1]}", "needs shake_deg and shake_hz"),
    "label": ("light = {choice = [1]}\n#label", "has the label 'light', which randomise draws; rename"),
    "kind": ("gamma = {choice = [1]}\n#world", r"randomise\.gamma does not apply to sources\[0\], worlds"),
    "prisms": ("apex_deg = {choice = [1]}\n#prisms", r"replaces the value of prisms, which has 2 entries; give one"),
    "plain": ("start_deg = {choice = [1]}\n#plain", "is the angle of a prism, but there are no prisms"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_wrong_ranges_are_named(place: Path, case: str) -> None:
    entry, message = WRONG[case]
    sources = WORLDS if "#world" in entry else PICTURES
    if "#label" in entry:
        sources = sources.replace("class", "light")
    head = HEAD
    if "#prisms" in entry:
        head = head.replace("{apex_deg = 1.0}", "{apex_deg = 1.0}, {apex_deg = 2.0}")
    if "#plain" in entry:
        head = "no_prism = true\n" + head.replace("prisms = [{apex_deg = 1.0}]\n", "").replace(
            "speeds_rpm = [720.0]\n", ""
        )
        sources += "rotate_deg_s = [0.0, 90.0, 0.0]\n"
    with pytest.raises(AmiwarpError, match=message) as caught:
        items_of(place, head + sources + "[randomise]\n" + entry + "\n")
    assert "spec.toml" in str(caught.value)
