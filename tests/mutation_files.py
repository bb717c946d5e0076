"""Damaged files for tests and long fuzzing runs: small samples of every input, a mutator, and a supervised check.

The rule: a damaged file is read, or refused with one :class:`AmiwarpError`. Nothing else is raised, nothing crashes or
hangs, and memory stays below :data:`MEMORY_KIB`. ``python tests/mutation_files.py COUNT [NAME ...]`` checks COUNT
mutants of each named input, or of all inputs.
"""

from __future__ import annotations

import io
import json
import random
import subprocess
import sys
import tempfile
import threading
import unicodedata
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin
import numpy as np
from calibration_sample import exact_calibration
from io_samples import CALIB, SIZE, WRITERS, make_events, refusal, write_native
from io_samples_extra import MORE_WRITERS, packets, small, write_bin, write_ros2
from PIL import Image

from amiwarp.calib import Calibration
from amiwarp.cli.info import describe
from amiwarp.cli.inputs import read_camera
from amiwarp.events.checks import check_events
from amiwarp.events.events import Events
from amiwarp.events.sensors import ImuSamples
from amiwarp.events.truth import MAPS, EventTruth, FrameTruth, Poses, WorldLabels
from amiwarp.io import RecordingWriter, open_recording, read_encoder_csv
from amiwarp.io.text import read_calib
from amiwarp.optics.camera import Camera
from amiwarp.optics.lens import Fisheye
from amiwarp.optics.prism import Prism
from amiwarp.simulation.pictures import read_picture
from amiwarp.simulation.sequences import open_pictures

MEMORY_KIB = 3 << 19
"""Largest memory that a check may take, 1.5 GiB [KiB]."""

LONGEST_S = 300.0
"""Time after which a check counts as hanging, on any machine [s]. Reading itself ends after 30 s of processor time."""

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
        file["encoder/t"], file["encoder/angle"] = np.arange(0, 50_000, 500), np.linspace(0.0, 9.0, 100)
        camera = {"width": 320, "height": 240, "fx": 200.0, "fy": 200.0, "cx": 160.0, "cy": 120.0}
        file.create_group("camera").attrs.update(camera, distortion_model="fisheye", distortion=[0.1, 0.0, 0.0, 0.0])
        file.create_group("metadata").attrs.update(place="roof", fixed=np.bytes_("abc"), number=3, flag=True)
        file.create_group("truth").attrs.update(apex=0.03, phase=-1.0)


def write_truth(path: Path) -> None:
    """Write a native file with the ground truth of events, instants and poses."""
    rng, count, (width, height) = np.random.default_rng(0), len(EVENTS), (8, 6)
    maps = {name: rng.random((height, width, *tail)).astype(kind) for name, (kind, tail) in MAPS.items()}
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
                FrameTruth(t, **maps, rotation=np.eye(3), position=np.ones(3), joints={"a": np.ones(3)})
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
        file.visititems(lambda name, item: found.update({name: item[()]} if isinstance(item, h5py.Dataset) else {}))
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


def write_camera(path: Path) -> None:
    path.write_text(json.dumps({"width": 320, "height": 240, "fx": 200.0, "fy": 200.0, "cx": 160.0, "cy": 120.0}))


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
            frame = av.VideoFrame.from_ndarray(rng.integers(0, 256, (48, 64, 3)).astype(np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def read_recording(path: Path) -> None:
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
    json.dumps(describe(recording, str(path)), ensure_ascii=False).encode()


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
    "blosc": {"chunks": (70,), **hdf5plugin.Blosc(cname="zstd", clevel=1, shuffle=hdf5plugin.Blosc.SHUFFLE)},
    "blosc2": {"chunks": (70,), **hdf5plugin.Blosc2(cname="lz4", clevel=3)},
    "bitshuffle": {"chunks": (70,), **hdf5plugin.Bitshuffle(cname="lz4")},
    "bitshuffle_zstd": {"chunks": (70,), **hdf5plugin.Bitshuffle(cname="zstd")},
    "bzip2": {"chunks": (70,), **hdf5plugin.BZip2()},
    "lz4": {"chunks": (70,), **hdf5plugin.LZ4()},
    "zstd": {"chunks": (70,), **hdf5plugin.Zstd()},
}

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
    "camera_json": (".json", write_camera, lambda path: read_camera(path, *SIZE)),
    "calibration_json": (".json", write_calibration, lambda path: Calibration.load(path).model),
    **{
        f"picture_{kind}": (f".{kind}", partial(write_picture, kind), read_picture)
        for kind in ("png", "jpeg", "tiff", "bmp", "webp", "ppm", "gif")
    },
    "stack_npy": (".npy", write_stack, read_pictures),
    "video_mp4": (".mp4", write_video, read_pictures),
}  # fmt: skip
"""Every kind of input that is read from a file."""


@cache
def sample(name: str) -> bytes:
    """Return the content of an undamaged file of one of :data:`KINDS`."""
    ending, write, _ = KINDS[name]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"sample{ending}"
        write(path)
        return path.read_bytes()


def mutated(data: bytes, rng: random.Random) -> bytes:
    """Change a file in one to five places, half of them near its beginning."""
    mutant = bytearray(data)
    for _ in range(rng.choice([1, 1, 2, 3, 5])):
        if mutant:
            at = rng.randrange(min(len(mutant), 300) if rng.random() < 0.5 else len(mutant))
            length = rng.choice([1, 1, 2, 4, 8, 64, 300])
            mutant = rng.choice(EDITS)(mutant, at, length, rng)
    return bytes(mutant)


def _flip(data: bytearray, at: int, length: int, rng: random.Random) -> bytearray:
    data[at] ^= 1 << rng.randrange(8)
    return data


def _set(data: bytearray, at: int, length: int, rng: random.Random) -> bytearray:
    data[at : at + length] = bytes([rng.choice([0, 255, rng.randrange(256)])]) * len(data[at : at + length])
    return data


def _number(data: bytearray, at: int, length: int, rng: random.Random) -> bytearray:
    """Overwrite bytes with a number: small, huge, negative or near a power of two."""
    size = rng.choice([1, 2, 4, 8])
    value = rng.choice([0, 1, -1, 1 << rng.randrange(64), (1 << rng.randrange(64)) - 1, rng.randrange(1 << 16)])
    patch = (value % (1 << 8 * size)).to_bytes(size, rng.choice(["little", "big"]))
    data[at : at + size] = patch[: len(data[at : at + size])]
    return data


def _digits(data: bytearray, at: int, length: int, rng: random.Random) -> bytearray:
    """Insert characters that have a meaning in text files."""
    return (
        data[:at]
        + rng.choice([b"9" * length, b"-", b"nan", b"1e999", b"\n", b",", b"\0", b"\xff", b"[", b"{"])
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
    data[low : low + length], data[high : high + length] = data[high : high + length], data[low : low + length]
    return data


def _random(data: bytearray, at: int, length: int, rng: random.Random) -> bytearray:
    data[at : at + length] = rng.randbytes(len(data[at : at + length]))
    return data


WORDS = (b"-", b"nan", b"1e999", b"\n", b",", b"\0", b"\xff", b"\x1b[2J", b"[", b"{", b'"', b"null")

EDITS = (_flip, _flip, _set, _number, _number, _digits, _cut, _remove, _duplicate, _swap, _random)


def check(path: Path, name: str) -> str | None:
    """Read a file of one of :data:`KINDS` in this process. Return the refusal, or None if the file was read.

    Any other exception is a defect. So is a refusal of several lines or without the file's name.
    """
    Path("/proc/self/clear_refs").write_text("5")  # the peak counts from here: other tests ran in this process before
    before = memory_kib("VmRSS")
    said = refusal(KINDS[name][2], path)
    if said is not None:
        assert str(path) in said, said
        assert all(character.isprintable() or unicodedata.category(character) == "Zs" for character in said), repr(said)
        assert len(said) < 1000 + len(str(path)), said
    used = memory_kib("VmHWM") - before
    assert used < MEMORY_KIB, f"{used} KiB of memory"
    return said


def memory_kib(field: str) -> int:
    """Return this process's memory from a field of Linux's process status [KiB]: ``VmRSS`` now, ``VmHWM`` its peak."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{field}:"))


class Checker:
    """Runs :func:`check` in a supervised process, so that a crash or a hang is a finding too."""

    def __init__(self) -> None:
        self._start()

    def _start(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, __file__, "--serve"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
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


def serve() -> None:
    """Check the files whose names arrive on standard input."""
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
    if sys.argv[1:] == ["--serve"]:
        serve()
    else:
        main(int(sys.argv[1]), sys.argv[2:])
