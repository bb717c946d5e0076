"""Writing of encoded chunks by several threads, and what remains of it on a full disk."""

import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin
import numpy as np
import pytest

from amiwarp import AmiwarpError, Encoder, Events, Poses, RecordingWriter
from amiwarp.io.hdf5.chunk_file import ChunkFile, EncodedChunk
from amiwarp.io.hdf5.chunks import CHUNK, decode, encode, encode_parts
from amiwarp.io.hdf5.datasets import make_dataset
from amiwarp.io.hdf5.fletcher32 import checksum

assert hdf5plugin.FILTERS  # its import registers the filter


def stored(path, columns):
    """Write columns by four threads, of which the later ones are faster."""
    file = ChunkFile(path)
    datasets = {
        name: make_dataset(file.hdf5, name, c.dtype, c.shape[1:]) for name, c in columns.items()
    }

    def write(turn, job):
        name, start = job
        part = columns[name][start : start + CHUNK]
        (parts,) = encode_parts(part)
        time.sleep(0.01 * (3 - turn % 4))
        file.write(
            turn, [EncodedChunk(name, start, part, parts)], lambda chunk: datasets[chunk.name]
        )

    jobs = [(name, start) for start in reversed(range(0, 3 * CHUNK, CHUNK)) for name in columns]
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(write, range(len(jobs)), jobs))
    file.hdf5["after"] = np.arange(9)
    file.close()


def in_two_pieces(output, data):
    """Write data as :class:`amiwarp.io.hdf5.chunk_file._Output` does, but not at once."""
    output.write_at([data[:7]], output.tell())
    output.write_at([data[7:]], output.tell() + 7)
    output.seek(output.tell() + len(data))
    return len(data)


def make():
    rng = np.random.default_rng(7)
    n = 2 * CHUNK + 99
    columns = {"x": rng.normal(size=n).astype(np.float32), "t": np.sort(rng.integers(0, 10**6, n))}
    return columns | {
        "place": rng.normal(size=(n, 3)).astype(np.float32),
        "p": rng.integers(0, 2, n).astype(np.uint8),
    }


@pytest.mark.parametrize("in_one_piece", [True, False])
def test_threads_write_chunks_in_any_order(tmp_path, monkeypatch, in_one_piece):
    """Also if HDF5 wrote the bytes of a chunk in an unknown way, so that their place is not found."""
    if not in_one_piece:
        monkeypatch.setattr("amiwarp.io.hdf5.chunk_file._Output.write", in_two_pieces)
    columns = make()
    stored(tmp_path / "a.h5", columns)
    with h5py.File(tmp_path / "a.h5") as file:
        for name, column in columns.items():
            np.testing.assert_array_equal(file[name][()], column, strict=True)
        np.testing.assert_array_equal(file["after"][()], np.arange(9))


def test_the_speed_of_threads_does_not_change_a_file(tmp_path, monkeypatch):
    """Neither if pieces are filled in, nor if events are appended, and also with an index of several chunks."""
    rng, n = np.random.default_rng(5), 4 * CHUNK
    t = np.sort(rng.integers(0, 10**9, n))
    events = Events(
        *(rng.integers(0, 99, n).astype(np.uint16) for _ in "xy"),
        t,
        rng.integers(0, 2, n).astype(np.uint8),
    )
    flags = np.ones(n, np.uint8)

    def write(path, delays):
        monkeypatch.setattr(
            "amiwarp.io.native.event_writer.encode_parts",
            lambda *a: (time.sleep(next(delays)), encode_parts(*a))[1],
        )
        monkeypatch.setattr("amiwarp.tasks.cpu_threads", lambda: 4)
        with RecordingWriter(path.with_suffix(".filled.h5"), width=99, height=99) as writer:
            pieces = [
                lambda s=slice(k, k + CHUNK): (events[s], flags[s], {}) for k in range(0, n, CHUNK)
            ]
            list(writer.fill(pieces, count=CHUNK, t_first=int(t[0])))
        with RecordingWriter(path, width=99, height=99) as writer:
            writer.append(events)
        return path.read_bytes(), path.with_suffix(".filled.h5").read_bytes()

    slow = iter(np.linspace(0.05, 0.0, 60).tolist())
    assert write(tmp_path / "a.h5", slow) == write(tmp_path / "b.h5", iter(np.zeros(60).tolist()))
    with h5py.File(tmp_path / "a.filled.h5") as file:
        np.testing.assert_array_equal(file["events/t"][()], t - t[0])
        assert len(file["ms_to_idx"]) > 2 * CHUNK


@pytest.mark.parametrize("held", ["ms_to_idx", "encoder/angle", "encoder/t", "truth/poses/t"])
def test_who_refers_to_a_dataset_does_not_change_a_file(tmp_path, monkeypatch, held):
    """As h5py does in a thread that closes another file."""
    references: list[Any] = []

    def kept(file, name, *options):
        dataset = make_dataset(file, name, *options)
        if name == held:
            references.append(dataset)
        return dataset

    def write(path):
        t = np.arange(2000, dtype=np.int64)
        x = (t % 9).astype(np.uint16)
        with RecordingWriter(path, width=9, height=9) as writer:
            writer.append(Events(x, x, t, np.ones(len(t), np.uint8)))
            writer.append_poses(Poses(t[:5], np.tile([0.0, 0, 0, 0, 0, 0, 1], (5, 1)), {}))
            writer.set_encoder(Encoder(t, 0.01 * t, index_t=t[::700]))
        return path.read_bytes()

    alone = write(tmp_path / "a.h5")
    monkeypatch.setattr("amiwarp.io.native.records.make_dataset", kept)
    assert write(tmp_path / "b.h5") == alone
    assert len(references) == 1


def test_a_thread_that_fails_stops_the_others(tmp_path):
    def fail():
        time.sleep(0.2)
        raise ValueError("no events")

    flags = np.ones(CHUNK, np.uint8)
    zeros = np.zeros(CHUNK, np.uint16)
    events = Events(zeros, zeros, zeros.astype(np.int64), flags)
    pieces = [fail, *[lambda: (events, flags, {})] * 8]
    with (
        pytest.raises(ValueError, match="no events"),
        RecordingWriter(tmp_path / "a.h5", width=9, height=9) as writer,
    ):
        list(writer.fill(pieces, count=CHUNK, t_first=0))
    assert list(tmp_path.iterdir()) == []


def test_the_error_of_a_later_thread_is_raised_in_its_turn(tmp_path, monkeypatch):
    """Not one of the threads before it, which it does not stop."""
    failed = threading.Event()

    def fail():
        failed.set()
        raise ValueError("no events")

    def wait():
        failed.wait(60)
        return events, flags, {}

    monkeypatch.setattr("amiwarp.tasks.cpu_threads", lambda: 4)
    flags, zeros = np.ones(CHUNK, np.uint8), np.zeros(CHUNK, np.uint16)
    events = Events(zeros, zeros, zeros.astype(np.int64), flags)
    written = []
    writer = RecordingWriter(tmp_path / "a.h5", width=9, height=9)
    with pytest.raises(AmiwarpError, match="after it failed"), writer:  # noqa: PT012
        with pytest.raises(ValueError, match="no events"):
            written.extend(writer.fill([wait, wait, fail], count=CHUNK, t_first=0))
        assert len(writer) == len(written) * CHUNK == 2 * CHUNK
    assert list(tmp_path.iterdir()) == []


def test_the_parts_of_a_chunk_are_its_bytes():
    values = np.arange(CHUNK, dtype=np.uint8)
    ((frame, checksum),) = encode_parts(values)
    assert len(frame) + len(checksum) == len(encode(values))
    assert len(checksum) == 4


def test_an_existing_file_is_kept(tmp_path):
    (tmp_path / "a.h5").write_bytes(b"kept")
    with pytest.raises(FileExistsError):
        ChunkFile(tmp_path / "a.h5")
    assert (tmp_path / "a.h5").read_bytes() == b"kept"


FULL = """
import resource, sys
import numpy as np
from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events
from amiwarp.events.truth import MAPS, FrameTruth
from amiwarp.io import RecordingWriter
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), int(sys.argv[2])))
rng, n = np.random.default_rng(0), 1 << 19
x, y = (rng.integers(0, 240, n).astype(np.uint16) for _ in range(2))
events = Events(x, y, np.sort(rng.integers(0, 10**6, n)), rng.integers(0, 2, n).astype(np.uint8))
flags = np.ones(n, np.uint8)
try:
    with RecordingWriter(sys.argv[1], width=320, height=240) as writer:
        if sys.argv[3] == "fill":
            list(writer.fill([lambda: (events, flags, {})], count=n, t_first=0))
        elif sys.argv[3] == "truth":
            for k in range(20):
                maps = {m: rng.integers(0, 250, (240, 320, *row)).astype(kind) for m, (kind, row) in MAPS.items()}
                writer.append_frame(FrameTruth(k, **maps, rotation=np.eye(3), position=np.zeros(3), joints={}))
        elif sys.argv[3] == "images":
            for k in range(20):
                writer.append_image(k, rng.integers(0, 65535, (240, 320)).astype(np.uint16))
        else:
            writer.append(events)
except AmiwarpError as error:
    print(error)
"""


@pytest.mark.parametrize("way", ["append", "fill", "truth", "images"])
@pytest.mark.parametrize("limit", [2000, 1_100_000, 1_400_000])
def test_a_full_disk_leaves_nothing(tmp_path, way, limit):
    path = tmp_path / "a.h5"
    arguments = [sys.executable, "-X", "dev", "-c", FULL, path, str(limit), way]
    done = subprocess.run(arguments, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    assert done.stdout.startswith(f"{path}: ")
    assert "File too large" in done.stdout
    assert list(tmp_path.iterdir()) == []


FAILING = """
import errno, os, sys
import numpy as np
from amiwarp.io.hdf5.chunk_file import ChunkFile
from amiwarp.io.hdf5.datasets import make_dataset
written = os.pwritev
calls = 0
def failing(*arguments):
    global calls
    calls += 1
    if calls >= failed:
        raise OSError(errno.ENOSPC, "No space left on device")
    return written(*arguments)
os.pwritev = failing
numbers = np.random.default_rng(0).integers(0, 1 << 60, (40, 1000))
for failed in range(1, 10_000):
    calls = 0
    try:
        file = ChunkFile(sys.argv[1])
        try:
            data = make_dataset(file.hdf5, "data", np.int64, (1000,), 1)
            for k in range(len(numbers)):
                data.resize(k + 1, axis=0)
                data[k] = numbers[k]
                file.hdf5.create_group(f"group {k}").attrs["number"] = k
            data.id.refresh()  # reads everything again
            assert (data[()] == numbers).all()
        finally:
            file.close()
    except OSError as error:
        assert error.errno == errno.ENOSPC, error
        os.unlink(sys.argv[1])
        continue
    break
print(failed)
"""


def test_no_write_that_fails_crashes_hdf5(tmp_path: Path) -> None:
    """Each write in turn is the first that fails. HDF5 goes on with what it could not write, until it is closed."""
    words = [sys.executable, "-X", "dev", "-c", FAILING, tmp_path / "a.h5"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert int(done.stdout) > 50
    with h5py.File(tmp_path / "a.h5") as file:
        assert file["data"].shape == (40, 1000)


def test_an_interrupt_waits_until_the_file_is_created(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """HDF5 cannot close a file that it is creating when an interrupt is raised in the functions that it calls."""
    created = h5py.File

    def interrupted(*args: Any, **kwargs: Any) -> Any:
        signal.raise_signal(signal.SIGINT)
        files.append(created(*args, **kwargs))
        return files[-1]

    files: list[Any] = []
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        monkeypatch.setattr(h5py, "File", interrupted)
        with pytest.raises(KeyboardInterrupt):
            ChunkFile(tmp_path / "new.h5")
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, handler)
    assert len(files) == 1
    assert not files[0]  # closed


def test_a_chunk_too_short_for_its_header_is_damaged():
    values, out = np.arange(CHUNK), np.empty(CHUNK, np.int64)
    assert decode([encode(values)], out)
    for length in range(20):
        frame = bytes(length)
        stored_sum = checksum(memoryview(frame))
        assert not decode([frame + stored_sum.to_bytes(4, "little")], out)


def test_a_new_file_has_the_usual_permissions(tmp_path):
    ChunkFile(tmp_path / "a.h5").close()
    (tmp_path / "b").touch()
    assert (tmp_path / "a.h5").stat().st_mode == (tmp_path / "b").stat().st_mode
