"""Ground truth of simulated worlds: in memory, in the native file, in other data sets' files, on the command line."""

import dataclasses
import itertools
import json
import re
import signal
import struct
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from typer.testing import CliRunner

import amiwarp
from amiwarp import AmiwarpError, ErrorCode
from amiwarp.events.truth import MAPS
from amiwarp.io.commands import pose_files_of
from amiwarp.io.hdf5.chunks import CHUNK
from amiwarp.simulation.recorded_truth import chosen_instants
from amiwarp.simulation.worlds import world_choice
from tests import ROOT
from tests.command_line import app
from tests.errors import refused

SIZE = (64, 48)
DURATION_S = 0.04
PER_EVENT = ("points", "cause", "instance", "depth", "place")


def square(side: float, y: float) -> amiwarp.Mesh:
    """A square across the y axis, seen from the origin."""
    corners = [[-side, y, -side], [side, y, -side], [side, y, side], [-side, y, side]]
    return amiwarp.Mesh(corners, [[0, 1, 2], [0, 2, 3]], uv=[[0, 0], [1, 0], [1, 1], [0, 1]])


def stub_world(seed: int = 0, name: str = "stub") -> tuple[amiwarp.World, amiwarp.Trajectory]:
    """A textured wall 3 m away that leaves some sky, and a square that moves in front of it."""
    rng = np.random.default_rng(seed)
    noise = amiwarp.Material(1.0, rng.random((128, 128)))
    moves = amiwarp.Trajectory(
        [0, 0.02, 0.04], [[-0.1, 1.5, 0], [0, 1.5, 0], [0.1, 1.5, 0]], [[0, 0, 0, 1]] * 3
    )
    bodies = (
        amiwarp.Body("wall", square(1.2, 3.0), noise, category="building"),
        amiwarp.Body("ñ square", square(0.2, 0.0), noise, moves, category="thing"),
    )
    world = amiwarp.World(name, bodies, joints={"hand": moves})
    still = amiwarp.Trajectory.still([0, 0, 0], look_at=[0, 1, 0])
    way = amiwarp.Trajectory(
        [0, 0.02, 0.04], [[0, 0, 0], [0.002, 0, 0], [0.004, 0, 0]], [still.rotation[0]] * 3
    )
    return world, way


def simulation() -> amiwarp.Simulation:
    scene = amiwarp.WorldScene(*stub_world())
    return amiwarp.Simulation(
        scene, amiwarp.Camera.from_fov(*SIZE, 1.0), amiwarp.Prism(0.02), DURATION_S, seed=3
    )


@pytest.fixture(scope="module")
def recording() -> amiwarp.Recording:
    return simulation().run(truth_hz=100.0)


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same recording, simulated to a file. Not to be written to."""
    path = tmp_path_factory.mktemp("world") / "world.h5"
    simulation().write(path, truth_hz=100.0)
    return path


@pytest.fixture
def named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Named worlds and world files that give the stub world, in a working folder."""

    def named_world(
        name: str, trajectory: str = "handheld", *, seed: int = 0, duration_s: float = 1.0
    ) -> Any:
        if name != "room" or trajectory not in ("still", "handheld"):
            raise AmiwarpError(f"world {name!r} or trajectory {trajectory!r} is unknown")
        return stub_world(seed, name)

    monkeypatch.setattr(world_choice, "named_world", named_world)
    monkeypatch.setattr(
        world_choice, "load_world", lambda path: (stub_world(name=Path(path).stem)[0], None)
    )
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("name", "trajectory", "says"),
    [
        (
            "nope.yaml",
            None,
            r"world is 'nope\.yaml'; give a file of the kind \.toml or \.json, or one of room, desk",
        ),
        (
            "room",
            "poses.npz",
            r"trajectory is 'poses\.npz'; .*\.txt or \.csv or \.tum, or one of still, handheld",
        ),
    ],
)
def test_a_file_of_another_kind_is_not_taken_for_a_name(
    name: str, trajectory: str | None, says: str
) -> None:
    with pytest.raises(AmiwarpError, match=says):
        world_choice.open_world(name, trajectory, seed=0, duration_s=1.0)


def truth_of(recording: amiwarp.Recording) -> amiwarp.Truth:
    assert recording.truth is not None
    return recording.truth


def frames_of(recording: amiwarp.Recording) -> Any:
    frames = truth_of(recording).frames
    assert frames is not None
    return frames


def same_truth(a: amiwarp.Recording, b: amiwarp.Recording) -> None:
    """Assert that two recordings hold the same ground truth of a world."""
    count = len(a.events)
    assert count == len(b.events)
    of_a, of_b = truth_of(a).of_events(0, count), truth_of(b).of_events(0, count)
    for name in PER_EVENT:
        np.testing.assert_array_equal(getattr(of_a, name), getattr(of_b, name), strict=True)
    assert truth_of(a).labels == truth_of(b).labels
    np.testing.assert_array_equal(frames_of(a).t, frames_of(b).t)
    for one, other in zip(frames_of(a), frames_of(b), strict=True):
        for name in MAPS:
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), strict=True)
        np.testing.assert_allclose(one.rotation, other.rotation, rtol=0, atol=1e-14)
        np.testing.assert_array_equal(one.position, other.position)
        assert one.joints.keys() == other.joints.keys()
        for name in one.joints:
            np.testing.assert_array_equal(one.joints[name], other.joints[name])
    assert truth_of(a).poses is not None
    assert truth_of(b).poses is not None
    same_poses(truth_of(a).poses[:], truth_of(b).poses[:])  # type: ignore[index]


def same_poses(a: amiwarp.Poses, b: amiwarp.Poses) -> None:
    np.testing.assert_array_equal(a.t, b.t, strict=True)
    np.testing.assert_array_equal(a.camera, b.camera, strict=True)
    assert list(a.bodies) == list(b.bodies)
    assert list(a.joints) == list(b.joints)
    for name, rows in {**a.bodies, **a.joints}.items():
        np.testing.assert_array_equal(rows, {**b.bodies, **b.joints}[name], strict=True)


def test_codes_of_causes_are_those_of_the_kernels() -> None:
    from amiwarp.kernels import pixels as kernels

    assert [cause.code for cause in amiwarp.Cause] == [
        int(getattr(kernels, cause.name)) for cause in amiwarp.Cause
    ]


def test_every_event_has_its_truth(recording: amiwarp.Recording) -> None:
    truth = truth_of(recording).of_events(0, len(recording.events))
    assert set(np.unique(truth.cause)) <= {cause.code for cause in amiwarp.Cause}
    assert np.count_nonzero(truth.cause == amiwarp.Cause.SIGNAL.code) > 500
    assert set(np.unique(truth.instance)) == {0, 1, 2}
    labels = truth_of(recording).labels
    assert labels == amiwarp.WorldLabels("stub", ("wall", "ñ square"), ("building", "thing"))
    np.testing.assert_allclose(truth.depth[truth.instance == 1], 3.0, rtol=0, atol=1e-4)
    np.testing.assert_allclose(truth.depth[truth.instance == 2], 1.5, rtol=0, atol=1e-4)
    assert np.isinf(truth.depth[truth.instance == 0]).all()
    assert np.isnan(truth.place[truth.instance == 0]).all()


def test_places_project_to_the_points_without_the_prism(recording: amiwarp.Recording) -> None:
    """The places of events at their own depth; the camera moves by 4 mm, 0.08 px at the wall."""
    truth = truth_of(recording).of_events(0, len(recording.events))
    poses = truth_of(recording).poses
    assert recording.camera is not None
    assert poses is not None
    x, y, z = truth.place[truth.instance > 0].T.astype(np.float64)
    seen = recording.camera.rays_to_pixels(np.column_stack([x - 0.002, -z, y]))
    off = np.linalg.norm(seen - truth.points[truth.instance > 0], axis=1)
    assert np.median(off) < 0.05
    assert off.max() < 0.12 * 1.5


def test_the_file_holds_what_the_memory_holds(
    recording: amiwarp.Recording, stored: Path, tmp_path: Path
) -> None:
    same_truth(recording, amiwarp.open_recording(stored))
    amiwarp.save_recording(tmp_path / "saved.h5", recording)
    same_truth(recording, amiwarp.open_recording(tmp_path / "saved.h5"))
    amiwarp.convert(stored, tmp_path / "converted.h5")
    same_truth(recording, amiwarp.open_recording(tmp_path / "converted.h5"))


@pytest.mark.parametrize(("start", "stop"), [(0, 5), (100, 140), (10, 10), (20, 10), (900, 10**6)])
def test_slices_of_events_and_truth_stay_aligned(
    recording: amiwarp.Recording, stored: Path, start: int, stop: int
) -> None:
    back = amiwarp.open_recording(stored)
    whole = truth_of(recording).of_events(0, len(recording.events))
    for each in (recording, back):
        events, truth = each.events.slice(start, stop), truth_of(each).of_events(start, stop)
        np.testing.assert_array_equal(events.t, recording.events.slice(start, stop).t)
        for name in PER_EVENT:
            assert len(getattr(truth, name)) == len(events)
            np.testing.assert_array_equal(getattr(truth, name), getattr(whole, name)[start:stop])


@pytest.mark.parametrize("read", ["of_events", "points"])
def test_truth_has_no_negative_indices(recording: amiwarp.Recording, read: str) -> None:
    with pytest.raises(AmiwarpError, match=r"slice\(-3, 4\) has a negative index"):
        getattr(truth_of(recording), read)(-3, 4)


def test_truth_of_a_file_is_sliced_without_steps(stored: Path) -> None:
    truth = truth_of(amiwarp.open_recording(stored))
    for name, rows in {
        "truth": truth.stored_points, "truth/events/cause": truth.stored_causes, "truth/poses": truth.poses,
    }.items():  # fmt: skip
        for which, message in (
            (
                slice(None, None, 5),
                "rows are sliced in steps of 5; slice without steps, then NumPy arrays",
            ),
            (slice(None, None, -1), "rows are sliced in steps of -1"),
            (3, "rows are indexed by the number 3; give a slice, such as [3:4] for one"),
        ):
            with pytest.raises(AmiwarpError, match=re.escape(f"world.h5: {name}: {message}")):
                rows[which]  # type: ignore[index]


def test_truth_across_chunks_of_the_file(tmp_path: Path) -> None:
    """Places, whose rows have three numbers, in a file of more than one chunk, appended in odd pieces."""
    rng, count = np.random.default_rng(0), CHUNK + 1000
    place = rng.random((count, 3), np.float32)
    instance = rng.integers(0, 65536, count).astype(np.uint16)
    events = amiwarp.Events.from_arrays(
        np.zeros(count), np.zeros(count), np.arange(count), np.ones(count)
    )
    with amiwarp.RecordingWriter(tmp_path / "long.h5", width=4, height=4) as writer:
        for start, stop in ((0, 7), (7, CHUNK - 5), (CHUNK - 5, count)):
            truth = amiwarp.EventTruth(instance=instance[start:stop], place=place[start:stop])
            writer.append(events[start:stop], truth=truth)
    back = truth_of(amiwarp.open_recording(tmp_path / "long.h5"))
    for start, stop in ((0, count), (CHUNK - 3, CHUNK + 3), (5, 9), (CHUNK + 10, CHUNK + 20)):
        np.testing.assert_array_equal(
            back.of_events(start, stop).place, place[start:stop], strict=True
        )
        np.testing.assert_array_equal(
            back.of_events(start, stop).instance, instance[start:stop], strict=True
        )
    with h5py.File(
        tmp_path / "long.h5"
    ) as file:  # HDF5 itself reads the chunks that amiwarp encoded
        np.testing.assert_array_equal(file["truth/events/place"][:], place)


def test_a_writer_refuses_truth_that_does_not_fit(
    tmp_path: Path, recording: amiwarp.Recording
) -> None:
    events = amiwarp.Events.from_arrays([0, 1], [0, 0], [0, 1], [1, 1])
    bad = amiwarp.EventTruth(place=np.zeros((2, 2), np.float32))
    with (
        pytest.raises(AmiwarpError, match=re.escape("place has shape (2, 2); expected (2, 3)")),
        amiwarp.RecordingWriter(tmp_path / "bad.h5", width=4, height=4) as writer,
    ):
        writer.append(events, truth=bad)
    frame = frames_of(recording)[0]
    endless = np.array([1.0, -np.inf], np.float32)
    with (
        pytest.raises(AmiwarpError, match="'truth/events/depth' holds -inf"),
        amiwarp.RecordingWriter(tmp_path / "bad.h5", width=4, height=4) as writer,
    ):
        writer.append(events, truth=amiwarp.EventTruth(depth=endless))
    with (
        pytest.raises(AmiwarpError, match="'truth/frames/intensity' holds nan"),
        amiwarp.RecordingWriter(tmp_path / "bad.h5", width=SIZE[0], height=SIZE[1]) as writer,
    ):
        writer.append_frame(
            dataclasses.replace(frame, intensity=np.full_like(frame.intensity, np.nan))
        )
    with (
        pytest.raises(AmiwarpError, match="expected \\(4, 4\\)"),
        amiwarp.RecordingWriter(tmp_path / "bad.h5", width=4, height=4) as writer,
    ):
        writer.append_frame(frame)
    with amiwarp.RecordingWriter(tmp_path / "good.h5", width=SIZE[0], height=SIZE[1]) as writer:
        writer.append_frame(frame)
        with pytest.raises(AmiwarpError, match="does not follow"):
            writer.append_frame(frame)
    assert [path.name for path in tmp_path.iterdir()] == ["good.h5"]


def test_refused_truth_leaves_a_file_that_can_be_read(
    tmp_path: Path, recording: amiwarp.Recording
) -> None:
    """All datasets of a kind of records keep the same length."""
    frame, later = frames_of(recording)[:2]
    endless = np.full_like(frame.intensity, np.inf)
    pose, joint = np.tile([0.0, 0, 0, 0, 0, 0, 1], (1, 1)), np.zeros((1, 3))
    assert frame.joints

    def poses(
        t: int, *bodies: str, joints: tuple[str, ...] = ("hand",), camera: Any = pose
    ) -> amiwarp.Poses:
        return amiwarp.Poses(
            np.array([t]), camera, dict.fromkeys(bodies, pose), dict.fromkeys(joints, joint)
        )

    path = tmp_path / "a.h5"
    with amiwarp.RecordingWriter(
        path, width=SIZE[0], height=SIZE[1], truth_parameters={}
    ) as writer:
        with pytest.raises(AmiwarpError, match="'truth/frames/intensity' holds inf"):
            writer.append_frame(
                dataclasses.replace(frame, joints={"other": np.zeros(3)}, intensity=endless)
            )
        writer.append_frame(frame)
        for change, message in (
            ({"intensity": endless}, "'truth/frames/intensity' holds inf"),
            (
                {"joints": {"other": np.zeros(3)}},
                r"truth/joints/names comes with \('other',\), before with \(",
            ),
            ({"joints": {}}, "truth/frames/t comes with"),
        ):
            with pytest.raises(AmiwarpError, match=message):
                writer.append_frame(dataclasses.replace(later, **change))  # type: ignore[arg-type]
        writer.append_frame(later)
    assert len(frames_of(amiwarp.open_recording(path)).t) == 2
    with amiwarp.RecordingWriter(
        path, width=4, height=4, truth_parameters={}, overwrite=True
    ) as writer:
        writer.append_poses(poses(0, "ball"))
        with pytest.raises(AmiwarpError, match=r"poses of 'camera' hold nan \(number 0\)"):
            poses(1, "ball", camera=pose * np.nan)
        for refused, message in (
            (
                poses(1, "car"),
                r"truth/poses/body_names comes with \('car',\), before with \('ball',\); append the same",
            ),
            (poses(1), "truth/poses/t comes with"),
            (poses(1, "ball", joints=()), "truth/poses/t comes with"),
            (poses(0, "ball"), "does not follow 0 us"),
        ):
            with pytest.raises(AmiwarpError, match=message):
                writer.append_poses(refused)
        writer.append_poses(poses(1, "ball"))
    found = truth_of(amiwarp.open_recording(path)).poses
    assert found is not None
    same_poses(found[:], amiwarp.Poses.concatenate([poses(0, "ball"), poses(1, "ball")]))


@pytest.mark.parametrize(
    ("rotation", "message"),
    [
        (np.full((3, 3), np.inf), "'rotation' hold inf .*; give finite numbers"),
        (np.diag([np.inf, 1.0, 1.0]), "'rotation' hold inf .*; give finite numbers"),
        (np.diag([np.nan, 1.0, 1.0]), "'rotation' hold nan .*; give finite numbers"),
        (np.diag([1e200, 1.0, 1.0]), "rotation holds a value that is not within -1 .. 1"),
        (np.zeros((3, 3)), "rotation is no rotation matrix"),
        (np.diag([1.0, 1.0, -1.0]), "right-handed"),
        (np.eye(4), r"rotation has shape \(4, 4\); expected \(3, 3\)"),
        (np.stack([np.eye(3)] * 2), "the instant"),
    ],
)
def test_matrices_that_are_no_rotations_are_refused(
    tmp_path: Path, recording: amiwarp.Recording, rotation: NDArray[np.float64], message: str
) -> None:
    """SciPy never returns for infinite values, and cannot be interrupted."""
    frame = frames_of(recording)[0]
    with amiwarp.RecordingWriter(tmp_path / "a.h5", width=SIZE[0], height=SIZE[1]) as writer:
        with pytest.raises(AmiwarpError, match=message):
            writer.append_frame(dataclasses.replace(frame, rotation=rotation))
        writer.append_frame(dataclasses.replace(frame, rotation=frame.rotation + 1e-4))
    (stored,) = frames_of(amiwarp.open_recording(tmp_path / "a.h5"))
    np.testing.assert_allclose(stored.rotation, frame.rotation, rtol=0, atol=1e-3)


def test_the_file_is_read_with_h5py_as_the_page_shows(stored: Path, tmp_path: Path) -> None:
    page = (ROOT / "docs" / "reference" / "recording-format.md").read_text()
    (program,) = (
        code
        for code in re.findall(r"```python\n(.*?)```", page, re.S)
        if "truth/" in code or '"truth"' in code
    )
    (tmp_path / "world.h5").symlink_to(stored)
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert "'ñ square': " in done.stdout
    assert "5 instants; at 0 us the nearest pixel is 1.500 m away" in done.stdout
    assert done.stderr == ""


def test_the_page_names_every_dataset(stored: Path) -> None:
    page = (ROOT / "docs" / "reference" / "recording-format.md").read_text()
    named: list[str] = []
    with h5py.File(stored) as file:
        file["truth"].visititems(
            lambda name, found: named.append(name) if isinstance(found, h5py.Dataset) else None
        )
    assert len(named) == 32
    assert [
        name
        for name in named
        if f"`/truth/{name}`" not in page.replace("`/truth/x`, ", "`/truth/x` ")
    ] == []


def test_pictures_have_causes_and_no_world(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).random((64, 64)).astype(np.float32)
    made = amiwarp.Simulation(amiwarp.Scene.from_picture(picture), amiwarp.Camera.from_fov(32, 24, 1.0),
                              amiwarp.Prism(0.03), 0.02)  # fmt: skip
    made.write(tmp_path / "picture.h5")
    for recording in (made.run(), amiwarp.open_recording(tmp_path / "picture.h5")):
        truth = truth_of(recording).of_events(0, len(recording.events))
        assert truth.cause is not None
        assert len(truth.cause) == len(recording.events) > 0
        assert (truth.instance, truth.depth, truth.place) == (None, None, None)
        assert (
            truth_of(recording).labels,
            truth_of(recording).frames,
            truth_of(recording).poses,
        ) == (None, None, None)
    with pytest.raises(AmiwarpError, match="picture at infinity"):
        made.run(truth_hz=10.0)


def test_a_file_without_truth_has_no_new_groups(tmp_path: Path) -> None:
    events = amiwarp.Events.from_arrays([0, 1], [0, 0], [0, 1], [1, 1])
    source = amiwarp.MemoryEvents(events, 4, 4)
    amiwarp.save_recording(tmp_path / "a.h5", amiwarp.Recording(source))
    amiwarp.save_recording(
        tmp_path / "b.h5",
        amiwarp.Recording(
            source, truth=amiwarp.Truth({"apex": 0.01}, np.zeros((2, 2), np.float32))
        ),
    )
    with h5py.File(tmp_path / "a.h5") as file:
        assert set(file) == {"events", "metadata", "ms_to_idx", "t_offset"}
    with h5py.File(tmp_path / "b.h5") as file:
        assert set(file["truth"]) == {"x", "y"}
    assert truth_of(amiwarp.open_recording(tmp_path / "b.h5")).of_events(0, 2).cause is None


DAMAGE: list[tuple[str, Any, str]] = [
    ("truth/events/cause", lambda old: old[:-1], "dataset 'truth/events/cause' has shape"),
    ("truth/events/place", lambda old: old[:, :2], "dataset 'truth/events/place' has shape"),
    ("truth/events/place", lambda old: old[:, 0], "); expected a 2-dimensional one"),
    (
        "truth/events/cause",
        lambda old: old.astype(np.float32),
        "dataset 'truth/events/cause' is float32",
    ),
    ("truth/frames/t", lambda old: old[::-1], "truth/frames/t does not increase"),
    ("truth/frames/depth", lambda old: old[:, :-1], "dataset 'truth/frames/depth' has shape"),
    ("truth/frames/flow", lambda old: old[..., 0], "); expected a 4-dimensional one"),
    ("truth/poses/camera", lambda old: old[:, :6], "dataset 'truth/poses/camera' has shape"),
    ("truth/poses/bodies", lambda old: old[1:], "dataset 'truth/poses/bodies' has shape"),
    ("truth/world/categories", lambda old: old[1:], "2 instances and 1 categories"),
]


@pytest.mark.parametrize(("name", "edit", "message"), DAMAGE)
def test_damaged_truth_is_refused_by_name(
    stored: Path, tmp_path: Path, name: str, edit: Any, message: str
) -> None:
    path = tmp_path / "damaged.h5"
    path.write_bytes(stored.read_bytes())
    with h5py.File(path, "r+") as file:
        values = edit(file[name][:])
        del file[name]
        file[name] = values
    with pytest.raises(AmiwarpError, match=re.escape(message)) as caught:
        amiwarp.open_recording(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    "name", ["truth/frames/depth", "truth/events/place", "truth/world", "truth/poses/t"]
)
def test_truth_in_other_files_is_refused(stored: Path, tmp_path: Path, name: str) -> None:
    path = tmp_path / "linked.h5"
    path.write_bytes(stored.read_bytes())
    with h5py.File(path, "r+") as file:
        del file[name]
        file[name] = h5py.ExternalLink(str(stored), f"/{name}")
    with pytest.raises(AmiwarpError, match="is a soft or external link"):
        amiwarp.open_recording(path)


def test_maps_in_chunks_of_parts_are_refused(stored: Path, tmp_path: Path) -> None:
    path = tmp_path / "parts.h5"
    path.write_bytes(stored.read_bytes())
    with h5py.File(path, "r+") as file:
        values = file["truth/frames/depth"][:]
        del file["truth/frames/depth"]
        file.create_dataset("truth/frames/depth", data=values, chunks=(1, 10, 10))
    with pytest.raises(AmiwarpError, match="chunks of partial rows"):
        amiwarp.open_recording(path)


def test_variable_strings_are_refused(stored: Path, tmp_path: Path) -> None:
    """Their values lie in a heap whose size cannot be checked."""
    path = tmp_path / "heap.h5"
    path.write_bytes(stored.read_bytes())
    with h5py.File(path, "r+") as file:
        del file["truth/world/instances"]
        file["truth/world/instances"] = ["wall", "square"]
    with pytest.raises(AmiwarpError, match="dataset 'truth/world/instances' is object"):
        amiwarp.open_recording(path)


@pytest.mark.parametrize(
    ("values", "says"),
    [
        (
            {"instance": [0, 70_000]},
            "truth of instance holds 70000; give whole numbers from 0 to 65535",
        ),
        ({"cause": [-1, 0]}, "truth of cause holds -1; give whole numbers from 0 to 255"),
        ({"instance": [0.0, 1.5]}, "truth of instance holds 1.5"),
    ],
)
def test_labels_that_the_file_cannot_hold_are_not_written(
    tmp_path: Path, values: dict[str, Any], says: str
) -> None:
    events = amiwarp.Events.from_arrays([0, 1], [0, 1], [5, 6], [0, 1])
    truth = amiwarp.EventTruth(**{name: np.array(labels) for name, labels in values.items()})
    with (
        pytest.raises(AmiwarpError, match=says),
        amiwarp.RecordingWriter(tmp_path / "a.h5", width=8, height=8) as writer,
    ):
        writer.append(events, truth=truth)
    assert list(tmp_path.iterdir()) == []


def test_numbers_that_the_type_cannot_hold_are_refused(stored: Path, tmp_path: Path) -> None:
    path = tmp_path / "wide.h5"
    path.write_bytes(stored.read_bytes())
    with h5py.File(path, "r+") as file:
        values = file["truth/events/instance"][:].astype(np.int64)
        del file["truth/events/instance"]
        file["truth/events/instance"] = values
    truth = truth_of(amiwarp.open_recording(path))
    assert truth.of_events(0, 10).instance.dtype == np.uint16  # type: ignore[union-attr]
    del truth  # closes the file
    with h5py.File(path, "r+") as file:
        file["truth/events/instance"][5] = -1
    with pytest.raises(
        AmiwarpError,
        match=r"truth/events/instance 0 \.\. 10: holds numbers outside of 0 \.\. 65535",
    ):
        truth_of(amiwarp.open_recording(path)).of_events(0, 10)


def test_instants() -> None:
    np.testing.assert_array_equal(chosen_instants(10_000, 300.0), [0, 3333, 6667, 10_000])
    for duration, rate, count in (
        (290_000, 100.0, 30),
        (1_100_000, 30.0, 34),
        (300_000, 1.0 / 0.03, 11),
        (9999, 100.0, 1),
    ):
        assert len(chosen_instants(duration, rate)) == count
    np.testing.assert_array_equal(chosen_instants(10_000, None, [5, 7000]), [5, 7000])
    assert chosen_instants(10_000).size == 0
    for given in ([-1], [10_001], [5, 5], [[1]]):
        with pytest.raises(AmiwarpError, match="must increase and lie within"):
            chosen_instants(10_000, None, given)
    with pytest.raises(AmiwarpError, match="give one of them"):
        chosen_instants(10_000, 10.0, [0])
    with pytest.raises(AmiwarpError, match="give a lower rate"):
        chosen_instants(10_000_000, 1e6)


def test_instants_as_a_list() -> None:
    found = simulation().run(truth_times_us=[1234, 39_999])
    np.testing.assert_array_equal(frames_of(found).t, [1234, 39_999])
    direct = amiwarp.TruthRenderer(simulation()).at(1234)
    np.testing.assert_array_equal(frames_of(found)[0].flow, direct.flow)


def test_without_prism_is_a_plain_event_camera(tmp_path: Path) -> None:
    plain = simulation().without_prism()
    plain.write(tmp_path / "plain.h5")
    back = amiwarp.open_recording(tmp_path / "plain.h5")
    assert (back.encoder, back.prism) == (None, None)
    assert truth_of(back).parameters["apex"] == 0.0
    assert 0 < len(back.events) < len(simulation().run().events)
    truth = truth_of(back).of_events(0, len(back.events))
    events = back.events.slice(0, len(back.events))
    assert truth.points is not None
    np.testing.assert_allclose(
        truth.points, np.column_stack([events.x, events.y]), rtol=0, atol=1e-3
    )


def png16(path: Path) -> NDArray[np.uint16]:
    """Decode a PNG of 16 bits and three channels without filters."""
    data, at, packed, size = path.read_bytes(), 8, b"", (0, 0)
    while at < len(data):
        (length,), kind = struct.unpack(">I", data[at : at + 4]), data[at + 4 : at + 8]
        body = data[at + 8 : at + 8 + length]
        assert struct.unpack(">I", data[at + 8 + length : at + 12 + length]) == (
            zlib.crc32(kind + body),
        )
        if kind == b"IHDR":
            assert body[8:] == bytes([16, 2, 0, 0, 0])
            size = struct.unpack(">II", body[:8])
        packed += body if kind == b"IDAT" else b""
        at += 12 + length
    lines = np.frombuffer(zlib.decompress(packed), np.uint8).reshape(size[1], 1 + 6 * size[0])
    assert (lines[:, 0] == 0).all()
    return (
        np.ascontiguousarray(lines[:, 1:])
        .view(">u2")
        .reshape(size[1], size[0], 3)
        .astype(np.uint16)
    )


def test_flow_as_dsec_stores_it(recording: amiwarp.Recording, tmp_path: Path) -> None:
    frames = frames_of(recording)
    assert amiwarp.save_flow_dsec(tmp_path / "flow", frames) == 4
    times = np.loadtxt(tmp_path / "flow" / "forward_timestamps.txt", delimiter=",", dtype=np.int64)
    np.testing.assert_array_equal(times, np.column_stack([frames.t[:-1], frames.t[1:]]))
    assert (
        (tmp_path / "flow" / "forward_timestamps.txt")
        .read_text()
        .startswith("# from_timestamp_us, to_timestamp_us")
    )
    pictures = sorted((tmp_path / "flow" / "forward").iterdir())
    assert [path.name for path in pictures] == [f"{k:06d}.png" for k in range(4)]
    stored = png16(pictures[1])
    with Image.open(pictures[1]) as found:  # an independent reader accepts the file
        assert found.size == SIZE
    moved = (stored[..., :2].astype(np.float64) - 2**15) / 128.0
    expected = frames[1].displacement
    known = np.isfinite(expected).all(axis=2)
    assert np.abs(expected[known]).max() > 1.0
    with Image.open(tmp_path / "flow" / "occlusion" / "000001.png") as occluded:
        np.testing.assert_array_equal(np.asarray(occluded), frames[1].occlusion)
    assert set(np.unique(frames[1].occlusion)) == {0, 1}
    np.testing.assert_array_equal(stored[..., 2], known)
    np.testing.assert_allclose(moved[known], expected[known], rtol=0, atol=0.5 / 128 + 1e-6)
    times = np.loadtxt(tmp_path / "flow" / "backward_timestamps.txt", delimiter=",", dtype=np.int64)
    np.testing.assert_array_equal(times, np.column_stack([frames.t[1:], frames.t[:-1]]))
    pictures = sorted((tmp_path / "flow" / "backward").iterdir())
    assert [path.name for path in pictures] == [f"{k:06d}.png" for k in range(1, 5)]
    moved = (png16(pictures[1])[..., :2].astype(np.float64) - 2**15) / 128.0
    known = np.isfinite(frames[2].backward).all(axis=2)
    np.testing.assert_allclose(
        moved[known], frames[2].backward[known], rtol=0, atol=0.5 / 128 + 1e-6
    )
    assert np.abs(moved + frames[2].displacement)[known].max() < 0.2  # which moves on as before
    assert np.abs(moved[known]).max() > 1.0
    with Image.open(tmp_path / "flow" / "backward_occlusion" / "000002.png") as occluded:
        np.testing.assert_array_equal(np.asarray(occluded), frames[2].backward_occlusion)
    with refused(ErrorCode.OUTPUT_EXISTS):
        amiwarp.save_flow_dsec(tmp_path / "flow", frames)


def test_backward_flow_leads_to_the_instant_before(recording: amiwarp.Recording) -> None:
    frames = frames_of(recording)
    assert np.isnan(frames[0].backward).all()
    assert (frames[0].backward_occlusion_with_prism == 2).all()
    for k, frame in enumerate(frames[1:], 1):
        moved, occlusion = simulation().displacement(
            frame.t_us, frames[k - 1].t_us, with_prism=True
        )
        np.testing.assert_array_equal(frame.backward_with_prism, moved)
        np.testing.assert_array_equal(frame.backward_occlusion_with_prism, occlusion)


def test_files_without_backward_flow_are_read(stored: Path, tmp_path: Path) -> None:
    path = tmp_path / "first.h5"
    path.write_bytes(stored.read_bytes())
    with h5py.File(path, "r+") as file:
        for name in [name for name in file["truth/frames"] if name.startswith("backward")]:
            del file[f"truth/frames/{name}"]
    frame = frames_of(amiwarp.open_recording(path))[1]
    assert np.isnan(frame.backward).all()
    assert (frame.backward_occlusion == 2).all()
    np.testing.assert_array_equal(
        frame.displacement, frames_of(amiwarp.open_recording(stored))[1].displacement
    )


def test_unknown_and_large_flow_is_marked() -> None:
    from amiwarp.io.truth_files import dsec_picture

    moved = np.array([[[np.nan, 0.0], [256.0, 0.0], [255.99, -256.0], [0.0, 0.0]]])
    picture = dsec_picture(moved)
    assert picture[0, :, 2].tolist() == [0, 0, 1, 1]
    assert picture[0, 2, :2].tolist() == [65535, 0]
    assert picture[0, 3, :2].tolist() == [32768, 32768]


def test_flow_as_mvsec_stores_it(recording: amiwarp.Recording, tmp_path: Path) -> None:
    frames = frames_of(recording)
    shares: list[float] = []
    path = tmp_path / "gt_flow_dist.npz"
    assert (
        amiwarp.save_flow_mvsec(
            path, frames, with_prism=True, progress=lambda _, share: shares.append(share)
        )
        == 5
    )
    np.testing.assert_allclose(shares, np.arange(1, 11) / 10)
    with np.load(tmp_path / "gt_flow_dist.npz") as found:
        assert sorted(found) == ["occlusion", "timestamps", "x_flow_dist", "y_flow_dist"]
        np.testing.assert_array_equal(
            found["occlusion"], [frames[k].occlusion_with_prism for k in range(5)]
        )
        np.testing.assert_array_equal(found["timestamps"], frames.t * 1e-6)
        for axis, name in enumerate(("x_flow_dist", "y_flow_dist")):
            assert found[name].shape == (5, SIZE[1], SIZE[0])
            expected = np.nan_to_num(frames[2].displacement_with_prism[..., axis], nan=0.0)
            np.testing.assert_array_equal(found[name][2], expected)
            assert not found[name][4].any()
    one = simulation().run(truth_times_us=[0])
    with pytest.raises(AmiwarpError, match="needs ground truth of two instants, but there are 1"):
        amiwarp.save_flow_mvsec(tmp_path / "one.npz", frames_of(one))


def test_poses_as_tum_stores_them(recording: amiwarp.Recording, tmp_path: Path) -> None:
    poses = truth_of(recording).poses
    assert poses is not None
    amiwarp.save_poses_tum(tmp_path / "camera.txt", poses)
    rows = np.loadtxt(tmp_path / "camera.txt")
    np.testing.assert_allclose(
        rows, np.column_stack([poses[:].t * 1e-6, poses[:].camera]), rtol=0, atol=1e-8
    )
    amiwarp.save_poses_tum(tmp_path / "body.txt", poses, body="ñ square")
    way = amiwarp.Trajectory.from_file(tmp_path / "body.txt")
    np.testing.assert_allclose(way.poses([0.02])[1], [[0.0, 1.5, 0.0]], rtol=0, atol=1e-8)
    with pytest.raises(AmiwarpError, match="choose among ñ square"):
        amiwarp.save_poses_tum(tmp_path / "none.txt", poses, body="wall")


def run(*args: str | Path) -> Any:
    return CliRunner().invoke(app, [str(arg) for arg in args])


def ok(*args: str | Path) -> dict[str, Any]:
    result = run(*args, "--json")
    assert result.exit_code == 0, result.stderr
    return dict(json.loads(result.stdout))


SHORT = ("--size", "64x48", "--duration", "0.04", "--device", "cpu")


def test_simulate_a_named_world(named: Path) -> None:
    data = ok(
        "simulate", "w.h5", "--world", "room", "--truth-hz", "50", "--preview", "seen.png", *SHORT
    )
    assert data["events"] > 500
    about = ok("info", "w.h5")["world"]
    assert about["name"] == "room"
    assert (about["instances"], about["categories"]) == (
        ["wall", "ñ square"],
        ["building", "thing"],
    )
    assert about["per_event"] == ["cause", "instance", "depth", "place"]
    assert list(about["causes"]) == ["signal", "shot_noise", "leak", "hot_pixel"]
    assert sum(about["causes"].values()) == data["events"]
    assert (about["instants"], about["poses"]) == (3, 41)
    assert (about["moving_bodies"], about["joints"]) == (["ñ square"], ["hand"])
    text = re.sub(" +", " ", run("info", "w.h5").stdout)
    for line in ("signal", "room: 2 instances of the classes building, thing", "instances wall, ñ square",
                 "3 with depth", "41 of the camera, 1 moving bodies, 1 joints", "joints hand"):  # fmt: skip
        assert line in text
    picture = np.asarray(Image.open("seen.png").convert("RGB"))
    assert picture.shape[1] > 1000
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 1000


def test_simulate_chosen_instants(named: Path) -> None:
    ok("simulate", "t.h5", "--world", "room", "--truth-us", "0,12000,35000", *SHORT)
    np.testing.assert_array_equal(frames_of(amiwarp.open_recording("t.h5")).t, [0, 12_000, 35_000])
    for options, words in (
        (("--truth-us", "0,x"), "'0,x' is not 2 numbers separated by commas"),
        (("--truth-us", "5,1"), "must increase and lie within 0 .. 40000 us"),
        (("--truth-us", "5", "--truth-hz", "10"), "give one of them"),
    ):
        result = run("simulate", "u.h5", "--world", "room", *options, *SHORT)
        assert (result.exit_code, words in result.stderr) == (1, True), result.stderr
        assert not Path("u.h5").exists()


def test_simulate_an_imu(named: Path) -> None:
    ok("simulate", "i.h5", "--world", "room", "--imu", "mpu6500", "--imu-hz", "500", *SHORT)
    imu = amiwarp.open_recording("i.h5").imu
    assert imu is not None
    assert (len(imu), imu.rate_hz) == (21, 500.0)
    for options, words in (
        (("--imu-hz", "500"), "give --imu"),
        (("--imu", "mpu9"), "bmi160"),
    ):
        result = run("simulate", "j.h5", "--world", "room", *options, *SHORT)
        assert result.exit_code != 0
        assert words in result.stderr


def test_info_of_a_recording_without_truth_of_a_world(named: Path) -> None:
    source = amiwarp.MemoryEvents(amiwarp.Events.from_arrays([0, 1], [0, 0], [0, 1], [1, 1]), 4, 4)
    amiwarp.save_recording("old.h5", amiwarp.Recording(source, truth=amiwarp.Truth({"apex": 0.01})))
    assert ok("info", "old.h5")["world"] is None


def test_info_of_many_instances_names_the_first(named: Path) -> None:
    source = amiwarp.MemoryEvents(amiwarp.Events.from_arrays([0, 1], [0, 0], [0, 1], [1, 1]), 4, 4)
    names = tuple(f"box {k}" for k in range(20))
    labels = amiwarp.WorldLabels("boxes", names, ("",) * 20)
    amiwarp.save_recording("many.h5", amiwarp.Recording(source, truth=amiwarp.Truth(labels=labels)))
    assert ok("info", "many.h5")["world"]["instances"] == list(names)
    text = run("info", "many.h5").stdout
    assert "box 14, box 15 and 4 more" in text
    assert "box 16" not in text


def test_no_prism_and_the_same_seed(named: Path) -> None:
    ok("simulate", "plain.h5", "--world", "room", "--no-prism", "--seed", "5", *SHORT)
    back = amiwarp.open_recording("plain.h5")
    assert (back.encoder, back.prism) == (None, None)
    scene = amiwarp.WorldScene(*stub_world(5, "room"))
    camera, prism = amiwarp.Camera.from_fov(*SIZE, np.radians(60.0)), amiwarp.Prism(np.radians(1.0))
    same = amiwarp.Simulation(scene, camera, prism, DURATION_S, seed=5).without_prism().run()
    np.testing.assert_array_equal(back.events.slice(0, 10**6).t, same.events.slice(0, 10**6).t)


def test_truth_of_events_that_stay_on_the_device(device: str) -> None:
    at = dataclasses.replace(simulation(), device=device)
    expected, found = at.run(truth_hz=100.0), at.run(truth_hz=100.0, on_device=True)
    assert isinstance(found.events, amiwarp.DeviceMemoryEvents)
    assert len(found.events) == len(expected.events)
    same_truth(found, expected)
    with pytest.raises(AmiwarpError, match="values are sliced in steps of 5"):
        truth_of(found).stored_causes[::5]  # type: ignore[index]


def test_how_pixels_see_the_world(named: Path) -> None:
    camera, prism = amiwarp.Camera.from_fov(*SIZE, np.radians(60.0)), amiwarp.Prism(np.radians(1.0))
    half = [*SHORT, "--duration", str(DURATION_S / 2)]
    times = []
    for option, given in (
        ("--seeing", {"seeing": "rays"}),
        ("--motion-px", {"motion_px": 0.1}),
        ("--seed", {}),
    ):
        (value,) = given.values() or (5,)
        ok(
            "simulate",
            "w.h5",
            "--world",
            "room",
            "--force",
            "--seed",
            "5",
            option,
            str(value),
            *half,
        )
        scene = amiwarp.WorldScene(*stub_world(5, "room"), **given)
        same = amiwarp.Simulation(scene, camera, prism, DURATION_S / 2, seed=5).run()
        times.append(amiwarp.open_recording("w.h5").events.slice(0, 10**6).t)
        np.testing.assert_array_equal(times[-1], same.events.slice(0, 10**6).t)
    assert not any(np.array_equal(a, b) for a, b in itertools.combinations(times, 2))


def test_world_files_and_files_of_poses(named: Path) -> None:
    stub_world()[1].save_tum("way.txt")
    ok("simulate", "w.h5", "--world", "mine.toml", "--trajectory", "way.txt", *SHORT)
    assert ok("info", "w.h5")["world"]["name"] == "mine"
    ok("simulate", "r.h5", "--world", "room", "--trajectory", "way.txt", *SHORT)
    for args, message in (
        (("--world", "mine.toml"), "has no camera trajectory"),
        (("--world", "mine.toml", "--trajectory", "fast"), "applies only to named worlds"),
        (("--world", "cellar"), "cellar"),
        (("--world", "room", "--rotate-deg-s", "0,5,0"), "--rotate-deg-s"),
        (("--world", "room", "--preview", "seen.jpg"), "ends in .png"),
        (("--picture", "none.jpg", "--trajectory", "still"), "--trajectory applies to a world"),
        (
            ("--picture", "none.jpg", "--seeing", "maps"),
            "--seeing applies to a world; give --world, or remove --seeing",
        ),
        (("--picture", "none.jpg", "--motion-px", "1"), "--motion-px applies to a world"),
        (("--world", "room", "--motion-px", "3"), "motion_px = 3.0"),
        (
            ("--world", "room", "--motion-px", "1", "--seeing", "rays"),
            "--motion-px applies to maps",
        ),
    ):
        result = run("simulate", "bad.h5", *args, *SHORT)
        assert (result.exit_code, message in result.stderr) == (1, True), result.stderr
    assert run("simulate", "bad.h5", "--world", "room", "--picture", "none.jpg").exit_code == 2
    assert not Path("bad.h5").exists()


def test_the_truth_command_exports(named: Path, stored: Path) -> None:
    data = ok("truth", stored, "out", "--flow", "dsec", "--poses", "tum")
    assert (data["flow_maps"], data["pose_files"]) == (4, 2)
    names = sorted(
        path.relative_to("out").as_posix() for path in Path("out").rglob("*") if path.is_file()
    )
    folders = {"forward": 0, "occlusion": 0, "backward": 1, "backward_occlusion": 1}
    expected = ["flow/forward_timestamps.txt", "flow/backward_timestamps.txt"]
    for folder, first in folders.items():
        expected += [f"flow/{folder}/{k:06d}.png" for k in range(first, first + 4)]
    assert names == sorted([*expected, "poses/body___square.txt", "poses/camera.txt"])
    assert ok("truth", stored, "out", "--flow", "mvsec", "--with-prism")["flow_maps"] == 5
    assert Path("out/world_gt_flow_dist.npz").exists()
    assert "exists" in run("truth", stored, "out", "--poses", "tum").stderr
    assert ok("truth", stored, "out", "--poses", "tum", "--force")["pose_files"] == 2
    simulation().write("unobserved.h5")
    source = amiwarp.MemoryEvents(amiwarp.Events.from_arrays([0, 1], [0, 0], [0, 1], [1, 1]), 4, 4)
    amiwarp.save_recording("old.h5", amiwarp.Recording(source))
    for args, message in (
        ((stored, "out"), "nothing is chosen"),
        (("unobserved.h5", "out", "--flow", "dsec"), "--truth-hz"),
        (("old.h5", "out", "--poses", "tum"), "no ground truth of a world"),
    ):
        result = run("truth", *args)
        assert (result.exit_code, message in result.stderr) == (1, True), result.stderr


def test_each_body_has_a_file_of_its_own() -> None:
    bodies = ("a b", "a_b_2", "a/b", "a b c")
    names = pose_files_of(bodies)
    assert tuple(names.values()) == bodies
    assert len(names) == 4


INTERRUPTED = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from tests.simulation import test_world_truth as made
from amiwarp.simulation.simulator import Simulation
long = made.simulation()
kept = made.amiwarp.TruthRenderer.at
def at(self, t_us, *later):
    if t_us:
        os.kill(os.getpid(), signal.SIGINT)
    return kept(self, t_us, *later)
made.amiwarp.TruthRenderer.at = at
try:
    long.write({path!r}, truth_hz=100.0)
except KeyboardInterrupt:
    print("interrupted")
"""


def test_ctrl_c_while_an_instant_is_rendered_leaves_nothing(tmp_path: Path) -> None:
    script = INTERRUPTED.format(path=str(tmp_path / "cut.h5"))
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.stdout.splitlines()[-1:] == ["interrupted"], done.stderr
    assert done.returncode in (0, 128 + signal.SIGINT)
    assert list(tmp_path.iterdir()) == []


def test_labels_of_another_type_are_refused() -> None:
    with pytest.raises(AmiwarpError, match="world labels' name is 1"):
        amiwarp.WorldLabels(1, ("wall",), ("building",))  # type: ignore[arg-type]
