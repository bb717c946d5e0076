"""Damaged files for tests and long fuzzing runs: small samples of every input, a mutator, and a supervised check.

The rule: a damaged file is read, or refused with one :class:`AmiwarpError`. Nothing else is raised, nothing crashes or
hangs, and memory stays below :data:`MEMORY_KIB`. ``python -m reference.mutation_files COUNT [NAME ...]`` checks COUNT
mutants of each named input, or of all inputs.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import random
import re
import subprocess
import sys
import tempfile
import threading
import tomllib
import unicodedata
from collections.abc import Callable
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin
import numpy as np
from PIL import Image

from amiwarp import (
    AmiwarpError,
    Calibration,
    Camera,
    Events,
    EventTruth,
    Fisheye,
    FrameTruth,
    ImuSamples,
    PixelMap,
    Poses,
    Prism,
    RadialTangential,
    Recording,
    RecordingWriter,
    Trajectory,
    WorldLabels,
    load_world,
    open_recording,
)
from amiwarp.events.recording import check_events
from amiwarp.events.truth import MAPS
from amiwarp.io import read_encoder_csv, reading_process
from amiwarp.io.camera_files import load_camera, read_calib, save_camera
from amiwarp.io.description import describe
from amiwarp.io.finished_work import append_line, sealed
from amiwarp.learning.dataset.files import JOURNAL, Journal
from amiwarp.learning.dataset.items import list_items
from amiwarp.learning.dataset.specification import load_specification
from amiwarp.learning.dataset.worker import Made
from amiwarp.simulation.commands.rig_options import _read_speed
from amiwarp.simulation.picture_light import read_picture
from amiwarp.simulation.picture_opening import _read_times, open_pictures
from amiwarp.simulation.worlds.mesh_reader import load_mesh
from amiwarp.studies.evaluate.conditions import QUICK, Condition
from amiwarp.studies.evaluate.edge_agreement import THRESHOLDS
from amiwarp.studies.evaluate.jobs import Store
from amiwarp.studies.evaluate.report import section
from amiwarp.studies.evaluate.results import CellResult
from amiwarp.studies.evaluate.stored_pictures import encode_picture
from amiwarp.studies.evaluate.streams import Stream
from amiwarp.studies.stability import axes, condition, judging
from amiwarp.studies.stability import cells as stability
from amiwarp.studies.stability.atlas import aggregate
from reference.aedat4_files import whole_file
from reference.calibration_sample import exact_calibration
from reference.io_samples import CALIB, SIZE, WRITERS, make_events, refusal, write_native
from reference.io_samples_extra import MORE_WRITERS, packets, small, write_bin, write_ros2

MEMORY_KIB = 3 << 19
"""Largest memory that a check may take, 1.5 GiB [KiB]."""

LONGEST_S = 300.0
"""Time after which a check counts as hanging, on any machine [s]. Reading itself ends after 3 s of processor time."""

EVENTS = make_events(300)


def write_hdf5(filters: dict[str, Any], libver: str, path: Path) -> None:
    """Write a file in DSEC's layout with the given filters, attributes of every kind, a camera and an encoder."""
    with h5py.File(path, "w", libver=libver) as file:
        file.attrs["width"], file.attrs["height"] = SIZE
        relative = EVENTS.t - 1_000_000
        columns = {"x": EVENTS.x, "y": EVENTS.y, "t": relative.astype("u4"), "p": EVENTS.p}
        for name, values in columns.items():
            file.create_dataset(f"events/{name}", data=values, **filters)
        file["t_offset"] = np.int64(1_000_000)
        file["ms_to_idx"] = np.searchsorted(relative, 1000 * np.arange(relative[-1] // 1000 + 1))
        file["encoder/t"], file["encoder/angle"] = (
            np.arange(0, 50_000, 500),
            np.linspace(0.0, 9.0, 100),
        )
        camera = {"width": 320, "height": 240, "fx": 200.0, "fy": 200.0, "cx": 160.0, "cy": 120.0}
        file.create_group("camera").attrs.update(
            camera, distortion_model="fisheye", distortion=[0.1, 0.0, 0.0, 0.0]
        )
        file.create_group("metadata").attrs.update(
            place="roof", fixed=np.bytes_("abc"), number=3, flag=True
        )
        file.create_group("truth").attrs.update(apex=0.03, phase=-1.0)


def write_truth(path: Path) -> None:
    """Write a native file with the ground truth of events, instants and poses."""
    rng, count, (width, height) = np.random.default_rng(0), len(EVENTS), (8, 6)
    maps = {
        name: rng.random((height, width, *tail)).astype(kind) for name, (kind, tail) in MAPS.items()
    }
    poses = np.tile([1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0], (3, 1))
    truth = EventTruth(
        rng.random((count, 2)).astype(np.float32), rng.integers(0, 4, count).astype(np.uint8),
        rng.integers(0, 3, count).astype(np.uint16), rng.random(count).astype(np.float32),
        rng.random((count, 3)).astype(np.float32),
    )  # fmt: skip
    events = Events.from_arrays(EVENTS.x % width, EVENTS.y % height, EVENTS.t, EVENTS.p)
    labels = WorldLabels("world", ("wall", "ball"), ("building", ""))
    with RecordingWriter(path, width=width, height=height, truth_labels=labels) as writer:
        writer.append(events, truth=truth)
        for t in (0, 1000):
            writer.append_frame(
                FrameTruth(
                    t, **maps, rotation=np.eye(3), position=np.ones(3), joints={"a": np.ones(3)}
                )
            )
            writer.append_known(t, rng.random((height, width)) < 0.5)
        writer.append_poses(Poses(np.arange(3) * 1000, poses, {"ball": poses}, {"a": poses[:, :3]}))


def write_sensors(path: Path) -> None:
    """Write a native file with IMU samples and frames."""
    rng = np.random.default_rng(0)
    with RecordingWriter(path, width=SIZE[0], height=SIZE[1]) as writer:
        writer.append(EVENTS)
        writer.append_imu(ImuSamples(np.arange(5), rng.random((5, 3)), rng.random((5, 3))))
        for t in (0, 1000):
            writer.append_image(t, rng.integers(0, 2**16, (6, 8)).astype(np.uint16))


def write_plain(write: Callable[[Path], None], path: Path) -> None:
    """Write a native file without checksums, so that damage reaches the values and the file's structure."""
    write(path)
    with h5py.File(path) as file:
        found: dict[str, Any] = {}
        about = dict(file.attrs)
        file.visititems(
            lambda name, item: found.update(
                {name: item[()]} if isinstance(item, h5py.Dataset) else {}
            )
        )
    with h5py.File(path, "w", libver="earliest") as file:
        file.attrs.update(about)
        for name, values in found.items():
            file[name] = values


def write_mono(path: Path) -> None:
    """Write a ROS 2 bag of packets with 64 bits for each event."""
    made = write_ros2(path.with_name("bag"), {"/events": packets("mono", EVENTS)})
    path.write_bytes(made.read_bytes())


def write_csv(path: Path) -> None:
    rows = (f"{t},{t // 5 % 4000},{int(t % 20_000 == 0)}\n" for t in range(0, 300_000, 1000))
    path.write_text("t_us,count,index\n" + "".join(rows))


def write_calibration(path: Path) -> None:
    camera = Camera(*SIZE, 200.0, 200.0, 150.0, 110.0, Fisheye(0.1, 0.0, 0.0, 0.0))
    values = {"apex": 0.035, "phase": 0.5, "tilt_x": 0.0, "tilt_y": 0.0, "clock_offset": 0.0}
    exact_calibration(camera, Prism(0.035), values).save(path)


LENS = Camera(320, 240, 200.0, 201.0, 160.0, 120.0, RadialTangential(-0.1, 0.02))


def write_camera(path: Path) -> None:
    path.write_text(
        json.dumps(
            {"width": 320, "height": 240, "fx": 200.0, "fy": 200.0, "cx": 160.0, "cy": 120.0}
        )
    )


def write_picture(kind: str, path: Path) -> None:
    rng = np.random.default_rng(0)
    Image.fromarray(rng.integers(0, 256, (40, 60, 3)).astype(np.uint8)).save(path, kind)


def write_stack(path: Path) -> None:
    np.save(path, np.random.default_rng(0).integers(0, 256, (4, 20, 30)).astype(np.uint8))


def write_video(path: Path) -> None:
    import av

    rng = np.random.default_rng(0)
    with av.open(str(path), "w", format="mp4") as container:
        stream: Any = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for _ in range(10):
            frame = av.VideoFrame.from_ndarray(
                rng.integers(0, 256, (48, 64, 3)).astype(np.uint8), format="rgb24"
            )
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def stored_edges() -> CellResult:
    """Return a cell of the edges with one row, of small pictures."""
    picture = encode_picture(np.zeros((3, 4), np.uint8))
    counts = [1] * len(THRESHOLDS)
    names = (Stream.PLAIN.value, Stream.CALIBRATED.value)
    values: dict[str, Any] = {
        "images": [
            {"stream": name, "found": counts, "entropy": [0.5] * len(counts)} for name in names
        ],
        "rows": [
            {
                "stream": n,
                "truth": "Canny",
                "tolerance": 1.5,
                "matched": counts,
                "chance": counts,
                "true": 9,
            }
            for n in names
        ],
        "sectors": [{"stream": names[0], "angle": 7.5, "recall": 0.5}],
        "pictures": {"Canny": picture, "geometry": picture},
    }
    return CellResult("edges", Condition(), values, "", 1.0)


def stored_fading() -> CellResult:
    """Return a cell of the fading with one part of a turn, two tiles and a film of two frames."""
    tiles = {
        "part_ms": 1.0,
        "columns": 2,
        "rate": [[1.0, 2.0]],
        "speed": [[1.0, 2.0]],
        "camera_speed": [[0.0, 1.0]],
    }
    film = [encode_picture(np.zeros((3, 4, 3), np.uint8))] * 2
    rows = [{"speed": speed, "rate": 1.0, "tiles": 5} for speed in (0.25, 1.0)]
    return CellResult(
        "fading", Condition(), {"rows": rows, "whole": [], "film": film, "tiles": tiles}, "", 1.0
    )


def stored_texture() -> CellResult:
    """Return a cell of the texture with two streams."""
    rows = [
        {"stream": s.value, "h": 1.0, "window": 0.5, "variance": 0.2}
        for s in (Stream.PLAIN, Stream.CALIBRATED)
    ]
    return CellResult(
        "texture", Condition(), {"rows": rows, "rates": [{"stream": "S-EV", "rate": 1.5}]}, "", 1.0
    )


def stored_atlas() -> stability.Stored:
    """Return a cell of the stability study with a success and a refusal."""
    names = [stability.identity(method) for method in judging.METHODS[:2]]
    good = judging.Result(judging.Outcome.SUCCESS, 0.02, 0.1, 1.5, deviations={"apex": 0.5})
    refused = judging.Result(
        judging.Outcome.REFUSAL, None, 0.1, 1.5, "too little light", "two cores"
    )
    cell = condition.Cell(axes.AXES[0].conditions()[0], 0)
    return stability.Stored(cell, 1000, dict(zip(names, (good, refused), strict=True)))


def store_of(
    cell: CellResult | stability.Stored, folder: Path
) -> tuple[Store | stability.Store, Path]:
    """Return a store in a folder that holds one cell, and the cell's file."""
    store: Store | stability.Store
    if isinstance(cell, CellResult):
        store = Store(folder)
        store.save(cell, QUICK)
    else:
        store = stability.Store(folder)
        store.save(cell)
    (file,) = folder.iterdir()
    return store, file


def write_cell(make: Callable[[], CellResult | stability.Stored], path: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path.write_bytes(store_of(make(), Path(folder))[1].read_bytes())


def write_journal(path: Path) -> None:
    """Write a journal of three recordings."""
    for k in range(3):
        key = f"{k:016x}"
        file = f"train/disc-{key}.h5"
        append_line(
            path, asdict(Made(key, file, 9, "0" * 64, 5, 0.1, 64, 48, 1.0, 0.9, "cpu", "0.1.0"))
        )


def write_unsealed(write: Callable[[Path], None], path: Path) -> None:
    """Write a file without its checksums. Its reader adds them, so that damage reaches the values."""
    write(path)
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    path.write_text(
        "".join(
            json.dumps({k: v for k, v in data.items() if k != "checksum"}) + "\n" for data in lines
        )
    )


def resealed(line: bytes) -> bytes:
    """Return an object in JSON without a checksum with one, and anything else as it is."""
    with contextlib.suppress(ValueError, RecursionError):
        data = json.loads(line)
        if isinstance(data, dict) and "checksum" not in data:
            return json.dumps(sealed(data)).encode()
    return line


def read_cell(make: Callable[[], CellResult | stability.Stored], path: Path) -> None:
    """Load a cell as a later run does, and make its part of the report, whose values are finite."""
    cell = make()
    with tempfile.TemporaryDirectory() as folder:
        store, file = store_of(cell, Path(folder))
        file.write_bytes(resealed(path.read_bytes()))
        if isinstance(store, Store) and isinstance(cell, CellResult):
            result = store.load(cell.evaluation, cell.condition, QUICK)
            if result is not None:
                for table in section(cell.evaluation, [result]).tables:
                    assert all(
                        math.isfinite(v)
                        for row in table.rows
                        for v in row
                        if isinstance(v, int | float)
                    )
        elif isinstance(store, stability.Store):
            for known in store.load_all():
                methods = [m for m in judging.METHODS if stability.identity(m) in known.results]
                if methods and known.cell == cell.cell:
                    atlas = aggregate([known], axes.AXES[:1], methods, {})
                    json.dumps(atlas.aims.to_json(), allow_nan=False)
    if store.damaged:
        raise AmiwarpError(store.damaged[0].replace(str(file), str(path)))


def read_made(path: Path) -> None:
    """Read the journal of a data set."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / JOURNAL).write_bytes(
            b"\n".join(map(resealed, path.read_bytes().split(b"\n")))
        )
        journal = Journal(Path(folder))
        json.dumps([asdict(made) for made in journal.made.values()], allow_nan=False)
        assert all(".." not in made.file for made in journal.made.values())
    if journal.damaged:
        raise AmiwarpError(journal.damaged[0].replace(folder, str(path)))


SPECIFICATION = """format = "amiwarp-dataset-specification"
version = 1
name = "shapes"
duration_s = 0.05
prisms = [{apex_deg = 0.5}, {apex_deg = 1.0, index = 1.5168, flat_side = "scene"}]
speeds_rpm = [720.0, 1440.0]
sensors = ["davis346", {name = "fast", preset = "gen4", refractory_us = 20.0}]
seeds = [0, 7]
splits = {train = 0.8, val = 0.1, test = 0.1}
split_seed = 0
truth_hz = 10.0
[camera]
size = [64, 48]
fov_deg = 60.0
[[sources]]
pictures = "pictures/*/*.png"
label_from_folder = "class"
labels = {background = "grey"}
licence = "CC-BY-4.0"
[[sources]]
worlds = ["room"]
trajectories = ["still", "handheld"]
duration_s = 0.02
"""


def read_specification(path: Path) -> None:
    """Read a specification and list its recordings."""
    folder = path.parent / "pictures" / "disc"
    folder.mkdir(parents=True, exist_ok=True)
    write_picture("png", folder / "0.png")
    for item in list_items(load_specification(path)):
        json.dumps([item.recipe, item.labels, item.split, item.licence], allow_nan=False)
        assert len(item.file) < 200


TILE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"
"""Triangle with texture coordinates, as an OBJ file."""

WORLD = """format = "amiwarp-world"
version = 1
name = "tiles"
ambient = 0.3
sun = {direction = [1.0, -1.0, 2.0], intensity = 0.5, shadows = true}
lamps = [{position = [0.0, -1.0, 2.0], intensity = 0.8, flicker_hz = 100.0}]
sky = {luminance = 0.9}
[[bodies]]
name = "still"
mesh = "tile.obj"
position = [0.0, 0.0, 0.5]
rotation = [0.0, 0.0, 0.0, 1.0]
category = "tile"
material = {reflectance = 0.7, emission = 0.0}
[[bodies]]
name = "moving"
mesh = "tile.obj"
scale = 0.01
up = "z"
trajectory = [{t = 0, position = [0, 0, 0]}, {t = 1, position = [1, 0, 0], rotation = [0, 0, 0, 1]}]
[joints]
nose = [{t = 0, position = [0, 0, 1]}]
[camera]
trajectory = [{t = 0, position = [0, -2, 1], look_at = [0, 0, 0]}, {t = 1, position = [0, -2, 2], look_at = [0, 0, 0]}]
"""


def write_mesh(colours: bool, path: Path) -> None:
    """Write a box as the ending of the path says, with vertex colours, or with a material and a texture."""
    import trimesh

    box = trimesh.creation.box((1.0, 2.0, 3.0))
    if colours:
        box.visual.vertex_colors = [90, 120, 200, 255]
    else:
        picture = Image.fromarray(
            np.random.default_rng(0).integers(0, 256, (4, 6, 3)).astype(np.uint8)
        )
        material = trimesh.visual.material.PBRMaterial(
            baseColorTexture=picture, baseColorFactor=[200, 100, 50, 255]
        )
        box.visual = trimesh.visual.TextureVisuals(
            np.random.default_rng(1).random((8, 2)), material
        )
    scene = trimesh.Scene()
    for x in (-2.0, 2.0):
        scene.add_geometry(box, transform=trimesh.transformations.translation_matrix((x, 0, 0)))
    made = (scene if path.suffix in (".glb", ".gltf") else box).export(
        file_type=path.suffix[1:], **({"embed_buffers": True} if path.suffix == ".gltf" else {})
    )
    if isinstance(made, dict):
        made = made["model.gltf"]
    path.write_bytes(made if isinstance(made, bytes) else made.encode())


def write_ascii(kind: str, path: Path) -> None:
    """Write a box as text."""
    import trimesh

    box = trimesh.creation.box((1.0, 2.0, 3.0))
    made = (
        box.export(file_type="stl_ascii")
        if kind == "stl"
        else box.export(file_type="ply", encoding="ascii")
    )
    path.write_bytes(made if isinstance(made, bytes) else made.encode())


def write_poses(separator: str, path: Path) -> None:
    """Write a trajectory of 30 poses."""
    rows = [
        separator.join(f"{v:.6f}" for v in (k / 100, k / 500, 0, 1, 0, 0, 0, 1)) for k in range(30)
    ]
    path.write_text(
        "\n".join(["# t x y z qx qy qz qw" if separator == " " else "t,x,y,z,qx,qy,qz,qw", *rows])
        + "\n"
    )


def read_mesh(path: Path) -> None:
    for part in load_mesh(path):
        for values in (part.mesh.vertices, part.mesh.uv, part.mesh.light, part.material.texture):
            assert values is None or np.isfinite(np.asarray(values)).all()
        assert np.asarray(part.mesh.faces).max() < len(np.asarray(part.mesh.vertices))
        assert np.isfinite(part.material.reflectance)


def read_trajectory(path: Path) -> None:
    trajectory = Trajectory.from_file(path)
    for values in trajectory.poses([0.0, 0.05, 1e3]):
        assert np.isfinite(values).all()


def read_world(path: Path) -> None:
    (path.parent / "tile.obj").write_text(TILE)
    world, camera = load_world(path)
    for trajectory in (camera, *world.joints.values(), *(body.trajectory for body in world.bodies)):
        for values in () if trajectory is None else trajectory.poses([0.0, 0.5, 1e3]):
            assert np.isfinite(values).all()
    for body in world.bodies:
        assert np.isfinite(np.asarray(body.mesh.vertices)).all()
    assert np.isfinite(
        [world.ambient, world.sky.luminance, *(lamp.intensity for lamp in world.lamps)]
    ).all()


def read_times(path: Path) -> None:
    files, times = _read_times(path)
    assert len(files) == len(times)


def read_speed(path: Path) -> None:
    assert np.isfinite(_read_speed(path)).all()


def read_recording(path: Path) -> Recording:
    """Read a recording in every possible way, check the events, and describe it as ``amiwarp info`` does."""
    recording = open_recording(path)
    source = recording.events
    count = 0
    for block in source.blocks(count=150):
        check_events(block, *source.size, where="mutant", allow_nan=True)
        count += len(block)
    assert count == len(source)
    if count:
        assert len(source.between(source.t_first, source.t_last + 1)) == count
        assert len(source.slice(1, 7)) == min(count - 1, 6)
    check_finite(recording)
    if recording.truth is not None:
        recording.truth.of_events(0, count)
        for index in range(0 if recording.truth.frames is None else len(recording.truth.frames.t)):
            assert recording.truth.frames is not None
            assert recording.truth.frames[index].depth.shape == recording.events.size[::-1]
        for index in range(0 if recording.truth.known is None else len(recording.truth.known.t)):
            assert recording.truth.known is not None
            assert recording.truth.known[index].shape == recording.events.size[::-1]
        if recording.truth.poses is not None:
            assert len(recording.truth.poses[:]) == len(recording.truth.poses)
    if recording.frames is not None:
        for index in range(len(recording.frames.t)):
            assert recording.frames[index].shape == recording.frames.size[::-1]
    json.dumps(describe(recording, str(path)), ensure_ascii=False, allow_nan=False).encode()
    return recording


def check_finite(recording: Recording) -> None:
    """Check that the values of a recording are finite, except those to which the format gives a meaning."""
    if recording.encoder is not None:
        assert np.isfinite(recording.encoder.angle).all()
    if recording.imu is not None:
        for values in (recording.imu.angular_velocity, recording.imu.acceleration):
            assert (np.isfinite(values).all(axis=1) | np.isnan(values).all(axis=1)).all()
    truth = recording.truth
    if truth is None:
        return
    assert np.isfinite(list(truth.parameters.values())).all()
    known = truth.of_events(0, len(recording.events))
    assert not any(
        np.isinf(values).any() for values in (known.points, known.place) if values is not None
    )
    assert known.depth is None or (np.isfinite(known.depth) | (known.depth == np.inf)).all()
    for index in range(0 if truth.frames is None else len(truth.frames.t)):
        assert truth.frames is not None
        frame = truth.frames[index]
        for values in (
            frame.normal,
            frame.intensity,
            frame.intensity_with_prism,
            frame.rotation,
            frame.position,
        ):
            assert np.isfinite(values).all()
        assert not np.isinf(frame.flow).any()
        assert not np.isinf(frame.flow_with_prism).any()
        assert (np.isfinite(frame.depth) | (frame.depth == np.inf)).all()
        assert all(np.isfinite(place).all() for place in frame.joints.values())
    if truth.poses is not None:
        poses = truth.poses[:]
        assert np.isfinite(poses.camera).all()
        assert all(
            np.isfinite(rows).all() for rows in (*poses.bodies.values(), *poses.joints.values())
        )


def read_log(path: Path) -> None:
    encoder = read_encoder_csv(path, counts_per_turn=4000)
    encoder.angle_at(encoder.t)


def read_pictures(path: Path) -> None:
    for _, light in open_pictures(path, fps=25.0).read():
        assert np.isfinite(light).all()


Kind = tuple[str, Callable[[Path], None], Callable[[Path], object]]
"""File ending, writer of a sample, and reader."""

PLUGINS: dict[str, dict[str, Any]] = {
    "plain": {},
    "chunked": {"chunks": (70,)},
    "gzip": {"chunks": (70,), "compression": "gzip", "shuffle": True, "fletcher32": True},
    "lzf": {"chunks": (70,), "compression": "lzf"},
    "scaleoffset": {"chunks": (70,), "scaleoffset": 0},
    "blosc": {
        "chunks": (70,),
        **hdf5plugin.Blosc(cname="zstd", clevel=1, shuffle=hdf5plugin.Blosc.SHUFFLE),
    },
    "blosc2": {"chunks": (70,), **hdf5plugin.Blosc2(cname="lz4", clevel=3)},
    "bitshuffle": {"chunks": (70,), **hdf5plugin.Bitshuffle(cname="lz4")},
    "bitshuffle_zstd": {"chunks": (70,), **hdf5plugin.Bitshuffle(cname="zstd")},
    "bzip2": {"chunks": (70,), **hdf5plugin.BZip2()},
    "lz4": {"chunks": (70,), **hdf5plugin.LZ4()},
    "zstd": {"chunks": (70,), **hdf5plugin.Zstd()},
}

CELLS: dict[str, Callable[[], CellResult | stability.Stored]] = {
    "cell_atlas": stored_atlas, "cell_edges": stored_edges, "cell_fading": stored_fading, "cell_texture": stored_texture
}  # fmt: skip
"""Cells of the studies."""

KINDS: dict[str, Kind] = {
    **{
        name: (f".{ending}", partial(lambda write, path: write(path, EVENTS), write), read_recording)
        for name, (_, ending, write) in WRITERS.items()
        if name not in ("native", "dsec")
    },
    **{
        name: (f".{ending}", partial(lambda write, path: write(path, EVENTS), write), read_recording)
        for name, (_, ending, _, write) in MORE_WRITERS.items()
    },
    **{
        f"aedat4_{name}": (
            ".aedat4", lambda path, name=name: path.write_bytes(whole_file(EVENTS, name)), read_recording
        )
        for name in ("none", "lz4", "zstd")
    },
    "ros2_mono": (".db3", write_mono, read_recording),
    "n_mnist": (".bin", lambda path: write_bin(path, small(EVENTS, 34, 34, t_first=0)), read_recording),
    "native": (".h5", lambda path: write_native(path, EVENTS), read_recording),
    **{
        f"hdf5_{name}": (".h5", partial(write_hdf5, given, "earliest"), read_recording)
        for name, given in PLUGINS.items()
    },
    "hdf5_v110": (".h5", partial(write_hdf5, PLUGINS["gzip"], "v110"), read_recording),
    "truth": (".h5", write_truth, read_recording),
    "truth_plain": (".h5", partial(write_plain, write_truth), read_recording),
    "sensors": (".h5", write_sensors, read_recording),
    "sensors_plain": (".h5", partial(write_plain, write_sensors), read_recording),
    "encoder_csv": (".csv", write_csv, read_log),
    "calib_txt": (".txt", lambda path: path.write_text(CALIB), lambda path: read_calib(path, *SIZE)),
    **{
        f"camera_{layout}": (".yaml", lambda path, layout=layout: save_camera(path, LENS, layout=layout), load_camera)
        for layout in ("ros", "kalibr")
    },
    "pixel_map": (".npz", PixelMap(*np.ones((8, 12, 16))).save, PixelMap.load),
    "camera_json": (".json", write_camera, lambda path: load_camera(path, SIZE)),
    "calibration_json": (".json", write_calibration, lambda path: Calibration.load(path).model),
    **{
        f"{name}_{part}": (
            ".json",
            partial(write_unsealed, partial(write_cell, make)) if part == "values" else partial(write_cell, make),
            partial(read_cell, make),
        )
        for name, make in CELLS.items()
        for part in ("sealed", "values")
    },
    "journal_sealed": (".jsonl", write_journal, read_made),
    "journal_values": (".jsonl", partial(write_unsealed, write_journal), read_made),
    "specification": (".toml", lambda path: path.write_text(SPECIFICATION), read_specification),
    **{
        f"picture_{kind}": (f".{kind}", partial(write_picture, kind), read_picture)
        for kind in ("png", "jpeg", "tiff", "bmp", "webp", "ppm", "gif")
    },
    "stack_npy": (".npy", write_stack, read_pictures),
    "video_mp4": (".mp4", write_video, read_pictures),
    **{
        f"mesh_{ending}_{name}": (f".{ending}", partial(write_mesh, name == "colours"), read_mesh)
        for ending in ("glb", "gltf")
        for name in ("colours", "texture")
    },
    "mesh_ply": (".ply", partial(write_mesh, True), read_mesh),
    "mesh_stl": (".stl", partial(write_mesh, True), read_mesh),
    "mesh_obj": (".obj", lambda path: path.write_text(TILE * 3), read_mesh),
    "mesh_ply_ascii": (".ply", partial(write_ascii, "ply"), read_mesh),
    "mesh_stl_ascii": (".stl", partial(write_ascii, "stl"), read_mesh),
    "trajectory_tum": (".txt", partial(write_poses, " "), read_trajectory),
    "trajectory_csv": (".csv", partial(write_poses, ","), read_trajectory),
    "world_toml": (".toml", lambda path: path.write_text(WORLD), read_world),
    "world_json": (".json", lambda path: path.write_text(json.dumps(tomllib.loads(WORLD))), read_world),
    "times_csv": (
        ".csv",
        lambda path: path.write_text("file,t_us\n" + "".join(f"{k}.png,{k * 1000}\n" for k in range(20))),
        read_times,
    ),
    "speed_csv": (
        ".csv",
        lambda path: path.write_text("# s,rpm\n" + "".join(f"{k / 10},{700 + k}\n" for k in range(20))),
        read_speed,
    ),
}  # fmt: skip
"""Every kind of input that is read from a file."""


def content_of(ending: str, write: Callable[[Path], object]) -> bytes:
    """Return the content of a file that a function writes, with a name that ends in ``ending``."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"sample{ending}"
        write(path)
        return path.read_bytes()


@cache
def sample(name: str) -> bytes:
    """Return the content of an undamaged file of one of :data:`KINDS`."""
    ending, write, _ = KINDS[name]
    return content_of(ending, write)


def mutated(data: bytes, rng: random.Random) -> bytes:
    """Change a file in one to five places, half of them near its beginning."""
    mutant = bytearray(data)
    edits = EDITS + (_value,) * len(EDITS) if data.startswith((b"{", b"format =")) else EDITS
    for _ in range(rng.choice([1, 1, 2, 3, 5])):
        if mutant:
            at = rng.randrange(min(len(mutant), 300) if rng.random() < 0.5 else len(mutant))
            length = rng.choice([1, 1, 2, 4, 8, 64, 300])
            mutant = rng.choice(edits)(mutant, at, length, rng)
    return bytes(mutant)


def _flip(data: bytearray, at: int, length: int, rng: random.Random) -> bytearray:
    data[at] ^= 1 << rng.randrange(8)
    return data


def _set(data: bytearray, at: int, length: int, rng: random.Random) -> bytearray:
    data[at : at + length] = bytes([rng.choice([0, 255, rng.randrange(256)])]) * len(
        data[at : at + length]
    )
    return data


def _number(data: bytearray, at: int, length: int, rng: random.Random) -> bytearray:
    """Overwrite bytes with a number: small, huge, negative or near a power of two."""
    size = rng.choice([1, 2, 4, 8])
    value = rng.choice(
        [0, 1, -1, 1 << rng.randrange(64), (1 << rng.randrange(64)) - 1, rng.randrange(1 << 16)]
    )
    patch = (value % (1 << 8 * size)).to_bytes(size, rng.choice(["little", "big"]))
    data[at : at + size] = patch[: len(data[at : at + size])]
    return data


def _digits(data: bytearray, at: int, length: int, rng: random.Random) -> bytearray:
    """Insert characters that have a meaning in text files."""
    return (
        data[:at]
        + rng.choice(
            [b"9" * length, b"-", b"nan", b"1e999", b"\n", b",", b"\0", b"\xff", b"[", b"{"]
        )
        + data[at:]
    )


def _cut(data: bytearray, at: int, length: int, rng: random.Random) -> bytearray:
    return data[:at]


def _remove(data: bytearray, at: int, length: int, rng: random.Random) -> bytearray:
    return data[:at] + data[at + length :]


def _duplicate(data: bytearray, at: int, length: int, rng: random.Random) -> bytearray:
    other = rng.randrange(len(data))
    return data[:at] + data[other : other + length] + data[at:]


def _swap(data: bytearray, at: int, length: int, rng: random.Random) -> bytearray:
    other = rng.randrange(len(data))
    low, high = min(at, other), max(at, other)
    length = min(length, high - low, len(data) - high)
    data[low : low + length], data[high : high + length] = (
        data[high : high + length],
        data[low : low + length],
    )
    return data


def _random(data: bytearray, at: int, length: int, rng: random.Random) -> bytearray:
    data[at : at + length] = rng.randbytes(len(data[at : at + length]))
    return data


def _value(data: bytearray, at: int, length: int, rng: random.Random) -> bytearray:
    """Replace the next number or text of JSON or TOML by another value, so that it stays such a file."""
    values = [
        b"0",
        b"-1",
        b"3.5",
        b"1e6",
        b"1e300",
        b"-1e-300",
        b"1" + b"0" * 30,
        b"NaN",
        b"true",
        b"null",
        b'""',
        b"[]",
    ]
    found = re.compile(rb'(?<=[:,\[=])[ \n]*(?:-?[0-9][0-9.eE+-]*|"[^"]*")(?=[,\]}\n])').search(
        data, at
    )
    return (
        data if found is None else data[: found.start()] + rng.choice(values) + data[found.end() :]
    )


WORDS = (b"-", b"nan", b"1e999", b"\n", b",", b"\0", b"\xff", b"\x1b[2J", b"[", b"{", b'"', b"null")

EDITS = (_flip, _flip, _set, _number, _number, _digits, _cut, _remove, _duplicate, _swap, _random)


def check(path: Path, name: str) -> str | None:
    """Read a file of one of :data:`KINDS` in this process, see :func:`checked`."""
    return checked(path, KINDS[name][2])


def checked(path: Path, read: Callable[[Path], object]) -> str | None:
    """Read a file with a function. Return the refusal, or None if the file was read.

    Any other exception is a defect. So is a refusal of several lines or without the file's name.
    """
    # The peak counts from here: other tests ran in this process before
    Path("/proc/self/clear_refs").write_text("5")
    before = memory_kib("VmRSS")
    said = refusal(read, path)
    if said is not None:
        assert str(path) in said, said
        assert all(
            character.isprintable() or unicodedata.category(character) == "Zs" for character in said
        ), repr(said)
        assert len(said) < 1000 + len(str(path)), said
    used = memory_kib("VmHWM") - before
    assert used < MEMORY_KIB, f"{used} KiB of memory"
    return said


def memory_kib(field: str) -> int:
    """Return this process's memory from a field of Linux's process status [KiB]: ``VmRSS`` now, ``VmHWM`` its peak."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{field}:"))


class Checker:
    """Runs :func:`check` in a supervised process, so that a crash or a hang is a finding too.

    ``cpu_seconds`` is the processor time after which the package's own reading process refuses a file. ``module`` is
    the module whose ``check`` is run.
    """

    def __init__(
        self,
        cpu_seconds: float = reading_process.CPU_SECONDS,
        module: str = "reference.mutation_files",
    ) -> None:
        self._cpu_seconds = cpu_seconds
        self._module = module
        self._start()

    def _start(self) -> None:
        command = [sys.executable, "-P", "-m", self._module, "--serve", str(self._cpu_seconds)]
        # The amiwarp of this process
        modules = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
        self._process = subprocess.Popen(
            command, env=modules, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def check(self, path: Path, name: str) -> str | None:
        """Run :func:`check`. Raise :class:`AssertionError` for a crash, a hang or a wrong exception as well."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps([str(path), name]) + "\n")
        self._process.stdin.flush()
        watchdog = threading.Timer(LONGEST_S, self._process.kill)
        watchdog.start()
        line = self._process.stdout.readline()
        watchdog.cancel()
        if not line:
            code = self._process.wait()
            self._start()
            raise AssertionError(f"{name}: {path}: crashed or hung, exit code {code}")
        outcome = json.loads(line)
        assert "defect" not in outcome, f"{name}: {path}: {outcome['defect']}"
        said: str | None = outcome["said"]
        return said

    def close(self) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()


def serve(cpu_seconds: float, check: Callable[[Path, str], str | None]) -> None:
    """Check the files whose names arrive on standard input."""
    reading_process.CPU_SECONDS = cpu_seconds
    replies = sys.stdout
    sys.stdout = io.StringIO()
    for line in sys.stdin:
        path, name = json.loads(line)
        try:
            outcome = {"said": check(Path(path), name)}
        except BaseException as error:
            outcome = {"defect": f"{type(error).__name__}: {error}"[:1000]}
        print(json.dumps(outcome), file=replies, flush=True)


def main(count: int, names: list[str]) -> None:
    """Check ``count`` mutants of each input. Mutants with findings are kept in the current folder."""
    checker = Checker()
    with tempfile.TemporaryDirectory() as folder:
        for name in names or list(KINDS):
            outcomes = {"read": 0, "refused": 0, "defects": 0}
            for seed in range(count):
                path = Path(folder) / f"{name}-{seed}{KINDS[name][0]}"
                path.write_bytes(mutated(sample(name), random.Random(f"{name} {seed}")))
                try:
                    outcomes["read" if checker.check(path, name) is None else "refused"] += 1
                except AssertionError as error:
                    outcomes["defects"] += 1
                    Path(f"defect-{path.name}").write_bytes(path.read_bytes())
                    print(error, flush=True)
                path.unlink()
            print(name, outcomes, flush=True)
    checker.close()


if __name__ == "__main__":
    if sys.argv[1:2] == ["--serve"]:
        serve(float(sys.argv[2]), check)
    else:
        main(int(sys.argv[1]), sys.argv[2:])
