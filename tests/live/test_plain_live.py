"""Live streams of a plain camera, without a calibration: the command and the iterator for programs."""

from __future__ import annotations

import io
import json
import socket
import struct
import threading
import time
import zlib
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

from amiwarp import (
    AmiwarpError,
    Camera,
    Encoder,
    EventFilter,
    Events,
    MemoryEvents,
    Prism,
    RadialTangential,
    Recording,
    TensorStream,
    ToTensor,
    compensate_events,
    compensate_live,
    find_hot_pixels,
    open_recording,
    save_camera,
    save_recording,
    stream_live,
    voxel_grid,
)
from amiwarp.compensation import OUTSIDE
from reference.calibration_sample import exact_calibration
from tests.command_line import app
from tests.io.test_io_readers import assert_equal
from tests.rig_world import LONG_S

SIZE = 64, 48
LENS = Camera(64, 48, 50.0, 52.0, 30.5, 24.0, RadialTangential(-0.3, 0.05))
PRISM = Prism(0.035)
KNOWN = exact_calibration(LENS, PRISM, {"apex": PRISM.apex, "phase": 0.4})
N = 30_000


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a plain recording, one with an encoder, the camera, and a calibration."""
    path = tmp_path_factory.mktemp("plain")
    rng = np.random.default_rng(2)
    t = np.sort(rng.integers(0, 200_000, N))
    x, y = rng.integers(0, 64, N), rng.integers(0, 48, N)
    is_hot = rng.random(N) < 0.02
    x[is_hot], y[is_hot] = 7, 9
    events = MemoryEvents(Events.from_arrays(x, y, t, rng.integers(0, 2, N)), *SIZE)
    save_recording(path / "plain.h5", Recording(events, LENS))
    encoder = Encoder.constant_speed(720.0, -5000, 205_000)
    save_recording(path / "turned.h5", Recording(events, LENS, encoder, PRISM))
    save_camera(path / "camera.json", LENS)
    KNOWN.save(path / "calibration.json")
    return path


def live(*args: object) -> dict[str, Any]:
    done = CliRunner().invoke(app, ["live", *map(str, args), "--fast", "--json"])
    assert done.exit_code == 0, done.stderr
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def test_a_plain_stream_is_filtered_undistorted_and_recorded(folder: Path, tmp_path: Path) -> None:
    source = folder / "plain.h5"
    out, raw = tmp_path / "out.h5", tmp_path / "raw.h5"
    result = live(
        source, "--out", out, "--record", raw, "--hot-pixels", source, "--region", "3,2,60,48",
        "--refractory-us", 700, "--background-ms", 3, "--max-rate", 0.02, "--only", "on",
        "--undistort", folder / "camera.json",
    )  # fmt: skip
    events = open_recording(source).events[:]
    hot = find_hot_pixels(events, SIZE)
    assert np.argwhere(hot).tolist() == [[9, 7]]
    chosen = EventFilter(
        region=(3, 2, 60, 48), polarity=1, hot_pixels=hot, refractory_us=700, background_us=3000,
        most_per_s=20_000.0,
    )  # fmt: skip
    wanted = chosen.apply(events, SIZE)
    found = open_recording(out)
    assert_equal(found.events[:], LENS.undistort(wanted))
    assert found.camera == Camera(64, 48, 50.0, 52.0, 30.5, 24.0)
    assert "refractory_us 700" in str(found.metadata["filter"])
    assert_equal(open_recording(raw).events[:], events)
    assert open_recording(raw).camera == LENS
    assert result["events"] == N
    assert result["compensated"] == 0
    assert result["model"] is None
    assert "events are not compensated" in result["messages"][0]
    read, filtered, undistorted = result["stages"]
    assert read["received"] == read["passed"] == filtered["received"] == N
    assert filtered["passed"] == len(wanted) == undistorted["received"] == undistorted["passed"]
    assert sum(filtered["removed"].values()) == N - len(wanted)
    assert min(filtered["removed"].values()) > 0
    assert undistorted["marked"]["outside"] == result["outside"] > 0


def test_without_stages_the_output_is_the_sensors_events(folder: Path, tmp_path: Path) -> None:
    live(folder / "plain.h5", "--out", tmp_path / "out.h5")
    found = open_recording(tmp_path / "out.h5")
    assert_equal(found.events[:], open_recording(folder / "plain.h5").events[:])
    assert found.events[:].whole_pixels
    assert found.encoder is None
    assert "filter" not in found.metadata


def test_a_source_with_an_encoder_keeps_it_without_a_calibration(
    folder: Path, tmp_path: Path
) -> None:
    live(folder / "turned.h5", "--record", tmp_path / "raw.h5", "--out", tmp_path / "out.h5")
    for name in ("raw.h5", "out.h5"):
        found = open_recording(tmp_path / name)
        assert found.encoder is not None
        assert found.prism == PRISM


@pytest.mark.parametrize("undistort", [True, False])
def test_plain_packets_are_served(folder: Path, undistort: bool) -> None:
    """A receiver of --to gets the events after the last stage, and of --raw-to all of them."""
    args = ["--undistort", folder / "camera.json"] if undistort else []
    found: list[Events] = []
    with stream_live(folder / "plain.h5", fast=True, filter=EventFilter(polarity=1)) as packets:
        wanted = Events.concatenate([packet.events for packet in packets])
    done = CliRunner().invoke(
        app,
        ["live", str(folder / "plain.h5"), "--fast", "--only", "on", "--to", "-", *map(str, args)],
    )
    assert done.exit_code == 0, done.stderr
    from amiwarp import Compensated
    from amiwarp.live.stream import Hello, PacketDecoder

    hello = None
    for message in PacketDecoder("test").feed(done.stdout_bytes):
        if isinstance(message, Hello):
            hello = message
        elif isinstance(message, Compensated):
            assert undistort
            found.append(message.events)
        elif isinstance(message, Events):
            assert not undistort
            found.append(message)
    assert hello is not None
    assert hello.camera == (Camera(64, 48, 50.0, 52.0, 30.5, 24.0) if undistort else LENS)
    assert_equal(Events.concatenate(found), LENS.undistort(wanted) if undistort else wanted)


def test_compensated_events_are_filtered_before_and_undistorted_after(
    folder: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out.h5"
    result = live(
        folder / "turned.h5", "--calibration", folder / "calibration.json", "--out", out,
        "--refractory-us", 900, "--undistort", folder / "calibration.json",
    )  # fmt: skip
    recording = open_recording(folder / "turned.h5")
    chosen = EventFilter(refractory_us=900)
    kept = chosen.apply(recording.events[:], SIZE)
    assert recording.encoder is not None
    xy = compensate_events(kept, KNOWN.model, recording.encoder)
    columns = np.ascontiguousarray(xy.T)
    wanted = LENS.undistort(Events(*columns, kept.t, kept.p))
    names = [stage["name"] for stage in result["stages"]]
    assert names == ["read", "filter", "compensate", "undistort"]
    # Each of both counts the events that lie outside after it.
    inside = (xy >= -0.5) & (xy < np.array(SIZE) - 0.5)
    marked = [stage["marked"].get("outside") for stage in result["stages"]]
    assert marked[2] == pytest.approx(np.count_nonzero(~inside.all(axis=1)), abs=2)
    assert marked[2] != marked[3]
    found = open_recording(out).events[:]
    assert np.array_equal(found.t, kept.t)
    np.testing.assert_allclose(found.x, wanted.x, rtol=0, atol=1e-3)  # px
    with compensate_live(
        folder / "turned.h5", KNOWN, filter=chosen, undistort=True, fast=True
    ) as packets:
        in_program = Events.concatenate([packet.events for packet in packets])
    assert_equal(in_program, found)
    assert [stage.name for stage in packets.stages] == names


def test_programs_iterate_over_a_plain_stream(folder: Path) -> None:
    chosen = EventFilter(refractory_us=400, background_us=2000)
    with stream_live(folder / "plain.h5", filter=chosen, undistort=LENS, fast=True) as packets:
        assert packets.size == SIZE
        found = list(packets)
    events = open_recording(folder / "plain.h5").events[:]
    wanted = LENS.undistort(chosen.apply(events, SIZE))
    assert_equal(Events.concatenate([packet.events for packet in found]), wanted)
    marked = sum(int(np.count_nonzero(packet.flags & OUTSIDE)) for packet in found)
    assert packets.stages[-1].marked == {"outside": marked}
    assert [stage.name for stage in packets.stages] == ["read", "filter", "undistort"]


def test_leaving_a_plain_stream_ends_its_threads(folder: Path) -> None:
    with stream_live(folder / "plain.h5") as packets:
        next(packets)
    assert "amiwarp-live" not in [thread.name for thread in threading.enumerate()]


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["--picture", "p.mp4"], "--picture needs a calibration"),
        (["--adaptive"], "--adaptive needs a calibration"),
        (["--watch-s", "3"], "--watch-s needs a calibration"),
        (["--region", "0,0,65,48"], "expected a part of the image of 64x48 px"),
        (["--undistort", "small.json"], "is a camera of 32x24 pixels, the source has 64x48"),
        (["--undistort", "none.json"], "none.json"),
        (["--hot-pixels", "small.h5"], "give a recording of the same camera"),
        (
            ["--calibration", "calibration.json", "--undistort", "other.json"],
            "is another camera than the calibration's",
        ),
    ],
)
def test_stages_that_do_not_fit_are_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, args: list[str], says: str
) -> None:
    monkeypatch.chdir(folder)
    save_camera("small.json", Camera.from_fov(32, 24, 1.0), overwrite=True)
    save_camera("other.json", Camera.from_fov(64, 48, 1.0), overwrite=True)
    one = Events.from_arrays([1], [1], [0], [1])
    save_recording("small.h5", Recording(MemoryEvents(one, 32, 24)), overwrite=True)
    before = set(folder.iterdir())
    done = CliRunner().invoke(app, ["live", "turned.h5", "--out", "o.h5", *args])
    assert done.exit_code == 1
    assert says in done.stderr
    assert done.stderr.count("\n") == 1
    assert set(folder.iterdir()) == before


def test_a_foreign_camera_is_refused_and_the_source_is_closed(folder: Path) -> None:
    with (
        pytest.raises(AmiwarpError, match="give the camera of this source"),
        stream_live(folder / "plain.h5", undistort=Camera.from_fov(32, 24, 1.0)),
    ):
        pass


def read_tensors(data: bytes) -> list[tuple[int, int, int, np.ndarray]]:
    """Return start, end, number of events and array of the tensors of a stream, as the page's receiver reads them."""
    found = []
    start = 0
    while start < len(data):
        magic, version, kind, _, rows, length, check = struct.unpack_from("<4sBBHIII", data, start)
        payload = data[start + 20 : start + 20 + length]
        assert (magic, version, check) == (b"AMIS", 1, zlib.crc32(payload))
        if kind == 8:
            assert rows == 1
            array = np.load(io.BytesIO(payload[24:]), allow_pickle=False)
            found.append((*struct.unpack_from("<qqQ", payload), array))
        start += 20 + length
    assert kind == 6
    return found


def test_tensors_are_written_and_served(folder: Path, tmp_path: Path) -> None:
    events = open_recording(folder / "plain.h5").events[:]
    to_tensor = ToTensor(voxel_grid, width=64, height=48, bins=3)
    stream = TensorStream(to_tensor, 100.0)
    wanted = [*stream.put(LENS.undistort(events)), stream.finish()]
    address = f"unix:{tmp_path}/tensors"
    received: list[bytes] = []

    def receive() -> None:
        while not (tmp_path / "tensors").exists():
            time.sleep(0.002)
        with socket.socket(socket.AF_UNIX) as connection:
            connection.connect(str(tmp_path / "tensors"))
            while data := connection.recv(1 << 16):
                received.append(data)

    thread = threading.Thread(target=receive)
    thread.start()
    done = CliRunner().invoke(
        app,
        ["live", str(folder / "plain.h5"), "--json", "--undistort", str(folder / "camera.json"),
         "--tensor", "voxel", "--tensor-bins", "3", "--tensor-hz", "100", "--tensor-to", address,
         "--tensor-out", str(tmp_path / "t.h5")],
    )  # fmt: skip
    thread.join(LONG_S)
    assert done.exit_code == 0, done.stderr
    counts = json.loads(done.stdout)["tensors"]
    assert counts == {"made": len(wanted), "events": N, "dropped_events": 0, "not_sent": 0}
    with h5py.File(tmp_path / "t.h5") as file:
        assert file["tensor"].shape == (len(wanted), 3, 48, 64)
        for k, each in enumerate(wanted):
            assert each is not None
            assert np.array_equal(file["tensor"][k], each.tensor)
            times = tuple(int(file[name][k]) for name in ("t_start", "t_end", "events"))
            assert times == (each.t_start, each.t_end, each.events)
    served = read_tensors(b"".join(received))
    assert 0 < len(served) <= len(wanted)  # from the moment on in which the receiver connected
    by_start = {each.t_start: each for each in wanted if each is not None}
    for t_start, t_end, count, array in served:
        same = by_start[t_start]
        assert (t_end, count) == (same.t_end, same.events)
        assert np.array_equal(array, same.tensor)


def test_a_receiver_that_dies_or_sleeps_stops_nothing(folder: Path, tmp_path: Path) -> None:
    """A receiver that takes nothing misses whole tensors, which are counted; one that leaves is forgotten."""
    sleeping = socket.socket(socket.AF_UNIX)
    leaving = socket.socket(socket.AF_UNIX)

    def connect() -> None:
        while not (tmp_path / "s").exists():
            time.sleep(0.002)
        sleeping.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        sleeping.connect(str(tmp_path / "s"))
        leaving.connect(str(tmp_path / "s"))
        leaving.close()

    thread = threading.Thread(target=connect)
    thread.start()
    done = CliRunner().invoke(
        app,
        ["live", str(folder / "plain.h5"), "--json", "--tensor", "voxel", "--tensor-bins", "200",
         "--tensor-hz", "200", "--tensor-to", f"unix:{tmp_path}/s"],
    )  # fmt: skip
    thread.join(LONG_S)
    sleeping.close()
    assert done.exit_code == 0, done.stderr
    counts = json.loads(done.stdout)["tensors"]
    assert counts["made"] == 40
    assert counts["events"] == N
    # It gets a part of the first one at most, and those that wait for it at the end are lost, too
    assert 30 < counts["not_sent"] <= 40


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["--tensor", "voxel"], "--tensor has no output"),
        (["--tensor-hz", "9"], "apply to --tensor"),
        (["--tensor-out", "t.h5"], "apply to --tensor"),
        (["--tensor", "voxel", "--tensor-out", "t.npz"], "give a name that ends in .h5"),
        (["--tensor", "count", "--tensor-bins", "3", "--tensor-out", "t.h5"], "--tensor is count"),
        (["--tensor", "voxel", "--tensor-to", "-"], "give tcp:HOST:PORT"),
        (["--tensor", "voxel", "--tensor-to", "shm:x"], "give tcp:HOST:PORT"),
        (["--tensor", "voxel", "--tensor-out", "plain.h5"], "plain.h5"),
    ],
)
def test_tensor_options_that_do_not_fit_are_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, args: list[str], says: str
) -> None:
    monkeypatch.chdir(folder)
    before = set(folder.iterdir())
    done = CliRunner().invoke(app, ["live", "plain.h5", "--fast", *args])
    assert done.exit_code == 1
    assert says in done.stderr
    assert done.stderr.count("\n") == 1
    assert set(folder.iterdir()) == before
