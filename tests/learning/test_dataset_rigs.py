"""Data sets of recorded rigs: what is made, drawn, kept and repaired, read, and refused."""

import dataclasses
import errno
import hashlib
import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

import amiwarp
from amiwarp import AmiwarpError, DatasetSummary, make_dataset
from tests.learning.specifications import items_of

WALL = """
v -2 2 -2
v 2 2 -2
v 2 2 2
v -2 2 2
vt 0 0
vt 1 0
vt 1 1
vt 0 1
f 1/1 2/2 3/3 4/4
"""
WORLD = """
format = "amiwarp-world"
version = 1
ambient = 0.5
bodies = [{name = "wall", mesh = "wall.obj", material = {texture = "noise.png"}}]
[camera]
trajectory = [
    {t = 0.0, position = [0.0, 0.0, 0.0], look_at = [0.0, 2.0, 0.0]},
    {t = 0.01, position = [0.02, 0.0, 0.0], look_at = [0.02, 2.0, 0.0]},
]
"""
CAMERAS = """
[[SENSORS]]
name = "ami"
kind = "events"
camera = {size = [24, 18], fov_deg = 40}
optic = {kind = "wedge", apex_deg = 1.0, rpm = 1800, nominal_apex_deg = 1.1, phase_deg = 15}
sensor = "ideal"
truth_hz = 200

[[SENSORS]]
name = "plain"
kind = "events"
position = [0.05, 0.0, 0.0]
camera = "lens.json"
sensor = "ideal"

[[SENSORS]]
name = "grey"
kind = "frames"
position = [0.0, 0.05, 0.0]
camera = {size = [24, 18], fov_deg = 40}
exposure_us = 1000
encoding = "linear"
bits = 16

[[SENSORS]]
name = "depth"
kind = "depth"
camera = {size = [24, 18], fov_deg = 40}
"""
SENSORS = CAMERAS.replace("SENSORS", "sensors")
RIG_HEAD = 'format = "amiwarp-rig-specification"\nversion = 1\nworld = "room"\nduration_s = 5.0\n'
RIG = RIG_HEAD + SENSORS
FRAMES_ONLY = RIG_HEAD + SENSORS[SENSORS.index('[[sensors]]\nname = "grey"') :]
"""Rig without event cameras, which takes less time."""
HEAD = 'format = "amiwarp-dataset-specification"\nversion = 1\nduration_s = 0.01\n'
SOURCE = (
    '\n[[sources]]\nworld_files = "wall*.toml"\nlabels = {class = "wall"}\nlicence = "CC0-1.0"\n'
)
NAMES = ["ami", "plain", "grey", "depth"]


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """Folder with a rig's file, a world, and a specification of two recorded rigs."""
    rng = np.random.default_rng(5)
    Image.fromarray(rng.integers(20, 256, (64, 64)).astype(np.uint8)).save(tmp_path / "noise.png")
    (tmp_path / "wall.obj").write_text(WALL)
    (tmp_path / "wall.toml").write_text(WORLD)
    (tmp_path / "rigs").mkdir()
    (tmp_path / "rigs" / "rig.toml").write_text(RIG)
    lens = {"width": 24, "height": 18, "fx": 30.0, "fy": 30.0, "cx": 11.5, "cy": 8.5}
    (tmp_path / "rigs" / "lens.json").write_text(json.dumps(lens))
    specify(tmp_path, "seeds = 2\n")
    return tmp_path


def specify(
    place: Path, more: str = "", *, rig: str = 'rig = "rigs/rig.toml"', end: str = ""
) -> None:
    """Write the specification of a data set."""
    (place / "spec.toml").write_text(f"{HEAD}{more}{rig}\n{SOURCE}{end}")


@pytest.fixture
def fast_place(place: Path) -> Path:
    """The same folder, with a rig that takes frames and depth only."""
    (place / "rigs" / "rig.toml").write_text(FRAMES_ONLY)
    return place


def make(place: Path, **options: Any) -> DatasetSummary:
    done = make_dataset(place / "spec.toml", place / "out", workers=1, **options)
    assert done.failed == {}
    return done


def manifest(place: Path) -> dict[str, Any]:
    found = json.loads((place / "out" / "manifest.json").read_text())
    assert isinstance(found, dict)
    return found


def contents(place: Path) -> dict[str, bytes]:
    """Return the content of the files of all rigs by their path."""
    out = place / "out"
    return {p.relative_to(out).as_posix(): p.read_bytes() for p in out.glob("*/*/*")}


RANGES = """
[randomise]
light = {log_uniform = [0.1, 0.5]}
apex_deg = {uniform = [1.5, 2.0]}
rpm = {choice = [3000.0]}
start_deg = {uniform = [90.0, 180.0]}
blur_px = {uniform = [0.3, 0.6]}
contrast_on = {uniform = [0.02, 0.04]}
"""


def by_hand(place: Path, item: Any) -> amiwarp.Rig:
    """The rig that the values of a recording describe, made of public classes."""
    v = item.drawn
    world, way = amiwarp.load_world(place / "wall.toml")
    assert way is not None
    lit = amiwarp.World(world.name, world.bodies, ambient=0.5 * v["light"])
    camera = amiwarp.Camera.from_fov(24, 18, math.radians(40.0))
    ideal = amiwarp.SensorModel.ideal()
    shared: dict[str, Any] = {
        "sensor": dataclasses.replace(ideal, contrast_on=v["contrast_on"]),
        "blur": v["blur_px"],
    }
    sensors: dict[str, Any] = {
        "ami": amiwarp.RigEventCamera(
            camera,
            amiwarp.Prism(math.radians(v["apex_deg"])),
            motion=amiwarp.PrismMotion(v["rpm"], math.radians(v["start_deg"])),
            nominal_prism=amiwarp.Prism(math.radians(1.1)),
            truth_hz=200.0,
            **shared,
        ),
        "plain": amiwarp.RigEventCamera(
            amiwarp.Camera(24, 18, 30.0, 30.0, 11.5, 8.5),
            to_rig=np.column_stack([np.eye(3), (0.05, 0.0, 0.0)]),
            **shared,
        ),
        "grey": amiwarp.RigFrameCamera(
            camera,
            to_rig=np.column_stack([np.eye(3), (0.0, 0.05, 0.0)]),
            exposure_us=1000,
            encoding="linear",
            bits=16,
            blur=v["blur_px"],
        ),
        "depth": amiwarp.RigDepthCamera(camera),
    }
    return amiwarp.Rig(lit, way, sensors, 0.01, item.seed)


def test_a_rig_can_be_made_again_from_its_labels(place: Path) -> None:
    specify(place, end=RANGES)
    path = place / "spec.toml"
    text = path.read_text().replace("duration_s = 0.01", "duration_s = 0.5")
    path.write_text(text.replace("licence", "duration_s = 0.01\nlicence"))
    (item,) = items_of(path)
    make(place)
    (row,) = manifest(place)["items"]
    assert row["labels"] == {"class": "wall", **item.drawn}
    assert row["file"] == item.file
    assert row["rig"] == NAMES
    assert (row["apex_deg"], row["rpm"]) == (item.drawn["apex_deg"], 3000.0)
    assert (row["width"], row["height"], row["sensor"], row["duration_s"]) == (
        None,
        None,
        None,
        0.01,
    )
    files = {p.name: p.read_bytes() for p in (place / "out" / item.file).iterdir()}
    assert row["bytes"] == sum(map(len, files.values()))
    sums = {name: hashlib.sha256(files[name]).hexdigest() for name in sorted(files)}
    listed = "".join(f"{name}\0{digest}\n" for name, digest in sums.items())
    assert row["sha256"] == hashlib.sha256(listed.encode()).hexdigest()
    found = amiwarp.open_rig(place / "out" / item.file)
    assert {name: found.metadata[f"drawn_{name}"] for name in item.drawn} == dict(item.drawn)
    assert found.metadata["seed"] == row["seed"] == item.seed
    expected = by_hand(place, item).run()
    assert list(found.sensors) == NAMES
    counts = {}
    for name in NAMES:
        np.testing.assert_array_equal(found[name].to_rig, expected[name].to_rig)
        one, other = found[name].recording, expected[name].recording
        counts[name] = len(one.events)
        for column in ("x", "y", "t", "p"):
            given = getattr(one.events[:], column)
            np.testing.assert_array_equal(given, getattr(other.events[:], column))
    assert counts["ami"] > 50
    assert counts["plain"] > 30
    assert row["events"] == counts["ami"] + counts["plain"]
    ami = found["ami"].recording
    assert ami.truth is not None
    assert ami.truth.frames is not None
    assert len(ami.truth.frames) == 3
    assert ami.truth.parameters["apex"] == math.radians(item.drawn["apex_deg"])
    assert ami.prism is not None
    assert ami.prism.apex == math.radians(1.1)  # the nominal one is not drawn
    frames = found["grey"].recording.frames
    other_frames = expected["grey"].recording.frames
    assert frames is not None
    assert other_frames is not None
    np.testing.assert_array_equal(frames[0], other_frames[0])
    assert np.ptp(frames[0]) > 1000


def test_the_shake_turns_the_whole_rig(fast_place: Path) -> None:
    """Cameras keep their places: one away from the origin moves on an arc."""
    place = fast_place
    shake = "[randomise]\nshake_deg = {choice = [3.0]}\nshake_hz = {choice = [50.0]}\n"
    specify(place, end=shake + "shake_direction_deg = {choice = [90.0]}\n")
    (item,) = items_of(place / "spec.toml")
    make(place)
    rig = amiwarp.open_rig(place / "out" / item.file)
    truth = rig["grey"].recording.truth
    assert truth is not None
    assert truth.poses is not None
    poses = truth.poses[:]
    _, way = amiwarp.load_world(place / "wall.toml")
    assert way is not None
    t = 1e-6 * poses.t
    at_rest, position = way.poses(t)
    angle = math.radians(3.0) * np.sin(2.0 * math.pi * 50.0 * t)
    turned = Rotation.from_matrix(at_rest) * Rotation.from_rotvec(np.outer(angle, [-1.0, 0.0, 0.0]))
    expected = position + turned.apply([0.0, 0.05, 0.0])
    np.testing.assert_allclose(poses.camera[:, :3], expected, rtol=0, atol=1e-5)  # m
    assert (
        np.abs(expected - position - Rotation.from_matrix(at_rest).apply([0, 0.05, 0])).max() > 1e-4
    )


def test_what_is_there_is_kept_and_damage_is_repaired(fast_place: Path) -> None:
    place = fast_place
    done = make(place)
    assert (done.recordings, done.made) == (2, 2)
    before = contents(place)
    assert len(before) == 2 * 3
    written = {name: (place / "out" / name).stat().st_mtime_ns for name in before}
    again = make(place)
    assert (again.made, again.kept) == (0, 2)
    first, second = sorted({Path(name).parent for name in before})
    own = place / "out" / first / "notes.txt"
    own.write_text("mine")
    (place / "out" / first / "grey.h5").unlink()
    assert amiwarp.plan_dataset(place / "spec.toml", place / "out", workers=1).missing == 1
    repaired = make(place)
    assert (repaired.made, repaired.kept) == (1, 1)
    assert own.read_text() == "mine"
    own.unlink()
    assert contents(place) == before
    damaged = bytearray(before[f"{second}/rig.json"])
    damaged[len(damaged) // 2] ^= 1
    (place / "out" / second / "rig.json").write_bytes(damaged)
    repaired = make(place)
    assert (repaired.made, repaired.kept, len(repaired.damaged)) == (1, 1, 1)
    assert contents(place) == before
    kept = place / "out" / first / "depth.h5"
    assert kept.stat().st_mtime_ns > written[f"{first}/depth.h5"]
    assert (make(place).made, manifest(place)["complete"]) == (0, True)


def test_an_interrupted_run_continues_and_makes_the_same_files(fast_place: Path) -> None:
    place = fast_place

    def stop_at_first(step: str, _share: float) -> None:
        if step.startswith("1 of 2"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make(place, progress=stop_at_first)
    (finished,) = manifest(place)["items"]
    # A run that is killed while files are put in place leaves a rig without its file.
    for item in items_of(place / "spec.toml"):
        if item.file != finished["file"]:
            folder = place / "out" / item.file
            folder.mkdir(exist_ok=True)
            (folder / "rig.json").unlink(missing_ok=True)
            (folder / "depth.h5").write_bytes(b"half")
    done = make(place)
    assert (done.made, done.kept) == (1, 1)
    together = contents(place)
    (place / "out").rename(place / "first")
    specify(place, "seeds = [1]\n")
    make(place)
    alone = contents(place)
    assert len(alone) == 3
    assert alone.items() <= together.items()


def test_a_rig_of_old_and_new_files_never_looks_complete(
    fast_place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make(fast_place)
    (first, *_) = sorted({Path(name).parent for name in contents(fast_place)})
    folder = fast_place / "out" / first
    (folder / "grey.h5").write_bytes(b"damaged")

    replace = os.replace

    def planted(part: Path, path: Path) -> None:
        if path == folder / "depth.h5":
            raise OSError(errno.ENOSPC, "no space is left")
        replace(part, path)

    monkeypatch.setattr(os, "replace", planted)
    done = make_dataset(fast_place / "spec.toml", fast_place / "out", workers=1)
    assert len(done.failed) == 1
    with pytest.raises(AmiwarpError, match=r"rig\.json"):
        amiwarp.open_rig(folder)
    monkeypatch.undo()
    assert make(fast_place).made == 1
    assert amiwarp.open_rig(folder)["grey"].recording.frames is not None


def test_a_rig_moves_to_the_folder_of_its_split(fast_place: Path) -> None:
    place = fast_place
    specify(place, "splits = {train = 1.0}\n")
    make(place)
    before = contents(place)
    specify(place, "splits = {test = 1.0}\n")
    again = make(place)
    assert (again.made, again.kept, again.not_in_specification) == (0, 1, ())
    after = contents(place)
    assert {name.replace("test/", "train/"): content for name, content in after.items()} == before
    assert not list((place / "out" / "train").iterdir())
    # A damaged rig in the folder of its old split is made again, and removed there.
    specify(place, "splits = {val = 1.0}\n")
    (name, *_) = after
    (place / "out" / name).write_bytes(after[name][:-1] + bytes([after[name][-1] ^ 1]))
    assert make(place).made == 1
    assert not list((place / "out" / "test").iterdir())
    assert list(contents(place).values()) == list(before.values())


def test_a_loader_gets_rigs(place: Path) -> None:
    specify(place)
    make(place)
    dataset = amiwarp.RecordedDataset(place / "out")
    assert len(dataset) == 1
    rig, labels = dataset[0]
    assert (list(rig.sensors), labels) == (NAMES, {"class": "wall"})
    counted = amiwarp.RecordedDataset(
        place / "out",
        transform=lambda rig, labels: (len(rig["plain"].recording.events), labels["class"]),
    )
    assert counted[0] == (len(rig["plain"].recording.events), "wall")
    with pytest.raises(
        AmiwarpError, match="holds rigs of the cameras ami, plain, grey, depth, but"
    ):
        amiwarp.RecordedDataset(place / "out", structured=True)
    with pytest.raises(
        AmiwarpError, match="holds recorded rigs, and the layouts are for one camera"
    ):
        amiwarp.export_dataset(place / "out", place / "tars", "webdataset")
    path = place / "out" / "manifest.json"
    path.write_text(path.read_text().replace('"ami", "plain"', '"plain", "ami"'))
    changed = amiwarp.RecordedDataset(place / "out")
    with pytest.raises(AmiwarpError, match=r"the manifest says .* of plain, ami, grey, depth"):
        changed[0]
    path.write_text(path.read_text().replace('["plain", "ami"', '[7, "ami"'))
    with pytest.raises(AmiwarpError, match=r"items\[0\]\.rig\[0\]"):
        amiwarp.RecordedDataset(place / "out")


def key(place: Path) -> str:
    specify(place)
    (item,) = items_of(place / "spec.toml")
    return str(item.key)


def test_what_determines_the_cameras_determines_the_recording(place: Path) -> None:
    first = key(place)
    file = place / "rigs" / "rig.toml"
    file.write_text(RIG.replace('"room"', '"desk"').replace("duration_s = 5.0", "duration_s = 3.0"))
    assert key(place) == first
    file.write_text(RIG.replace("rpm = 1800", "rpm = 900"))
    assert key(place) != first
    file.write_text(RIG)
    lens = place / "rigs" / "lens.json"
    lens.write_text(lens.read_text().replace("8.5", "8.25"))
    assert key(place) != first


def test_a_table_names_the_cameras_too(place: Path) -> None:
    (place / "lens.json").write_bytes((place / "rigs" / "lens.json").read_bytes())
    tables = CAMERAS.replace("SENSORS", "rig.sensors")
    specify(place, rig="", end=RANGES + tables)
    (item,) = items_of(place / "spec.toml")
    assert item.cameras == NAMES
    made = make(place)
    specify(place, end=RANGES)
    (same,) = items_of(place / "spec.toml")
    assert dict(same.drawn) == dict(item.drawn)
    assert made.events > 0
    specify(place, rig="", end='[rig]\nrig = "paper-platform"\n')
    (item,) = [i for i in items_of_long(place) if i.kind == "world_files"]
    assert item.cameras == ["ami", "plain", "colour", "grey", "depth"]


def items_of_long(place: Path) -> list[Any]:
    """Return the recordings of a specification with a longer duration."""
    path = place / "spec.toml"
    path.write_text(path.read_text().replace("duration_s = 0.01", "duration_s = 0.1"))
    return items_of(path)


def test_the_estimate_samples_long_enough_for_a_frame(fast_place: Path) -> None:
    place = fast_place
    slow = FRAMES_ONLY.replace("exposure_us = 1000", "exposure_us = 70000\nrate_hz = 10")
    (place / "rigs" / "rig.toml").write_text(slow)
    specify(place)
    path = place / "spec.toml"
    path.write_text(path.read_text().replace("duration_s = 0.01", "duration_s = 0.3"))
    plan = amiwarp.plan_dataset(path, place / "out", workers=1)
    assert (plan.recordings, plan.samples, plan.failed) == (1, 1, {})
    done = make(place)
    assert plan.size_bytes == pytest.approx(done.size_bytes, rel=0.3)
    assert not list((place / "out").glob(".*"))


ONE = "of one camera, but rig is given"
WRONG: dict[str, tuple[dict[str, str], str]] = {
    "prisms": ({"more": "prisms = [{apex_deg = 1}]\n"}, f"field prisms is {ONE}"),
    "speeds": ({"more": "speeds_rpm = [720]\n"}, f"field speeds_rpm is {ONE}"),
    "plain": ({"more": "no_prism = true\n"}, f"field no_prism is {ONE}"),
    "sensors": ({"more": 'sensors = ["ideal"]\n'}, f"field sensors is {ONE}"),
    "camera": ({"more": "camera = {size = [8, 8]}\n"}, f"field camera is {ONE}"),
    "truth": ({"more": "truth_hz = 10\n"}, f"field truth_hz is {ONE}"),
    "output": ({"end": '[output]\nrepresentation = "event_count"\n'}, f"field output makes tensors {ONE}"),
    "number": ({"rig": "rig = 7"}, r"field rig is 7; expected an object"),
    "world": ({"rig": 'rig = {world = "room"}'}, r"field rig\.world is unknown; expected rig, sensors"),
    "empty": ({"rig": "rig = {}"}, r"field rig\.sensors is missing; add \[\[rig\.sensors\]\]"),
    "missing": ({"rig": 'rig = "other.toml"'}, r"other\.toml"),
    "field": ({"rig": 'rig = {sensors = [{name = "a", kind = "depth", rate = 3}]}'}, r"rig\.sensors\[0\]\.rate"),
    "name": ({"rig": 'rig = {sensors = [{name = "a/b", kind = "depth"}]}'}, "a/b"),
    "case": (
        {"rig": 'rig = {sensors = [{name = "a", kind = "depth"}, {name = "A", kind = "depth"}]}'},
        "names that differ in more than case",
    ),
    "source": (
        {"end": '[[sources]]\npictures = "noise.png"\n'},
        r"sources\[1\]\.pictures does not apply to a rig",
    ),
    "gamma": ({"end": "[randomise]\ngamma = {choice = [1]}\n"}, r"randomise\.gamma does not apply to sources\[0\]"),
    "apex": ({"end": "[randomise]\napex_deg = {choice = [1, 80]}\n"}, r"randomise\.apex_deg: "),
    "optics": (
        {
            "rig": 'rig = {sensors = [{name = "a", kind = "events", optic = "mirror"}]}',
            "end": "[randomise]\nrpm = {choice = [60]}\n",
        },
        r"randomise\.rpm is of the one camera behind a single rotating wedge; the rig has none",
    ),
    "wedges": (
        {
            "rig": 'rig = {sensors = [{name = "a", kind = "events", optic = "wedge"}, '
            '{name = "b", kind = "events", optic = "wedge"}]}',
            "end": "[randomise]\nstart_deg = {choice = [60]}\n",
        },
        r"the rig has a, b; remove the field",
    ),
    "no-events": (
        {
            "rig": 'rig = {sensors = [{name = "a", kind = "frames"}]}',
            "end": "[randomise]\ncontrast_on = {choice = [0.2]}\n",
        },
        r"randomise\.contrast_on is of event cameras, and the rig has none",
    ),
    "no-blur": (
        {
            "rig": 'rig = {sensors = [{name = "a", kind = "depth"}]}',
            "end": "[randomise]\nblur_px = {choice = [0.2]}\n",
        },
        r"randomise\.blur_px is of cameras with events or frames",
    ),
    "short": (
        {"rig": 'rig = {sensors = [{name = "a", kind = "frames", exposure_us = 10001}]}'},
        r"field duration_s is 0\.01 s, but the rig's camera 'a' needs 0\.010001 s for a frame",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_what_does_not_fit_a_rig_is_named(place: Path, case: str) -> None:
    fields, message = WRONG[case]
    specify(place, **fields)  # type: ignore[arg-type]
    with pytest.raises(AmiwarpError, match=message) as caught:
        items_of(place / "spec.toml")
    assert "spec.toml" in str(caught.value) or "rig.toml" in str(caught.value) or case == "missing"


def test_a_wrong_rig_file_is_named_with_its_field(place: Path) -> None:
    (place / "rigs" / "rig.toml").write_text(RIG.replace("exposure_us", "exposure"))
    with pytest.raises(
        AmiwarpError, match=r"rig\.toml: .*: field sensors\[2\]\.exposure is unknown"
    ):
        items_of(place / "spec.toml")
    (place / "rigs" / "rig.toml").write_text(RIG)
    source = SOURCE.replace("licence", "duration_s = 0.001\nlicence")
    frames = 'rig = {sensors = [{name = "a", kind = "frames", readout_us = 2000}]}'
    (place / "spec.toml").write_text(f"{HEAD}{frames}\n{source}")
    with pytest.raises(
        AmiwarpError, match=r"sources\[0\]\.duration_s is 0\.001 s.* needs 0\.007 s"
    ):
        items_of(place / "spec.toml")
