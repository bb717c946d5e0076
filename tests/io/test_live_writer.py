"""Growing recordings: complete at the end, and readable whatever ends the writer."""

import itertools
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import hdf5plugin  # noqa: F401
import numpy as np
import pytest

from amiwarp import (
    AmiwarpError,
    Camera,
    Encoder,
    ErrorCode,
    Events,
    FlatSide,
    Prism,
    RadialTangential,
    RecordingWriter,
    open_recording,
)
from amiwarp.io import LiveWriter
from amiwarp.io.hdf5.chunks import CHUNK
from amiwarp.io.native.live_writer import MAX_WASTE_BYTES
from reference.io_samples import refusal
from tests import ROOT
from tests.errors import refused

SIZE = (320, 240)
CAMERA = Camera(*SIZE, 200.0, 201.0, 159.5, 119.5, RadialTangential(-0.3, 0.1, 1e-4, -2e-4, 0.01))
PRISM = Prism(0.04, 1.5, FlatSide.CAMERA)


def make(count: int, *, start: int = 5_000_000, seed: int = 0, mean_us: float = 3.0) -> Events:
    rng = np.random.default_rng(seed)
    t = start + np.cumsum(rng.poisson(mean_us, count))
    x, y = (rng.integers(0, side, count) for side in SIZE)
    return Events.from_arrays(x, y, t, rng.integers(0, 2, count))


def cut(events: Events, least: int, most: int) -> list[Events]:
    """Cut the events into packets of random size."""
    rng = np.random.default_rng(1)
    edges = [0]
    while edges[-1] < len(events):
        edges.append(min(edges[-1] + int(rng.integers(least, most)), len(events)))
    return [events[a:b] for a, b in itertools.pairwise(edges)]


def live(path: Path, **options: object) -> LiveWriter:
    return LiveWriter(path, width=SIZE[0], height=SIZE[1], **options)  # type: ignore[arg-type]


def read(path: Path) -> Events:
    return Events.concatenate(list(open_recording(path).events.blocks()))


def assert_equal(got: Events, expected: Events) -> None:
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(getattr(got, name), getattr(expected, name), strict=True)


@pytest.mark.parametrize("flush_s", [0.0, 1e9])
def test_everything_comes_back(tmp_path, flush_s):
    events = make(2 * CHUNK + 12_345)
    t, angle = np.arange(4_990_000, 7_000_000, 1000), np.linspace(-1.0, 700.0, 2010)
    path = tmp_path / "a.h5"
    with live(
        path, camera=CAMERA, prism=PRISM, metadata={"place": "roof"}, flush_s=flush_s
    ) as writer:
        for k, packet in enumerate(cut(events, 15_000, 40_000)):
            writer.append(packet)
            writer.append_encoder(
                t[100 * k : 100 * k + 100], angle[100 * k : 100 * k + 100], t[100 * k : 100 * k + 1]
            )
        writer.append_encoder(t[100 * k + 100 :], angle[100 * k + 100 :])
        assert len(writer) == len(events)
        assert not path.exists()
    assert os.listdir(tmp_path) == ["a.h5"]
    recording = open_recording(path)
    assert_equal(read(path), events)
    assert (recording.camera, recording.prism) == (CAMERA, PRISM)
    assert recording.metadata == {"place": "roof", "format": "native"}
    np.testing.assert_array_equal(recording.encoder.t, t)
    np.testing.assert_array_equal(recording.encoder.angle, angle)
    np.testing.assert_array_equal(recording.encoder.index_t, t[: 100 * k + 1 : 100])
    with RecordingWriter(tmp_path / "b.h5", width=SIZE[0], height=SIZE[1]) as whole:
        whole.append(events)
    with h5py.File(path) as got, h5py.File(tmp_path / "b.h5") as expected:
        for name in ("events/x", "events/t", "ms_to_idx", "t_offset"):
            np.testing.assert_array_equal(got[name][()], expected[name][()], strict=True)
            assert got[name].dtype == expected[name].dtype
    wasted = os.path.getsize(path) - os.path.getsize(tmp_path / "b.h5")
    assert wasted < (MAX_WASTE_BYTES if flush_s == 0.0 else 500_000)


def test_index_pulses_may_come_before_the_samples_about_them(tmp_path):
    with live(tmp_path / "a.h5") as writer:
        writer.append(make(1000))
        writer.append_encoder([], [], [4_000_000])
        writer.append_encoder([5_000_000, 5_001_000], [0.0, 0.1], [4_999_000, 5_000_500, 5_001_500])
        writer.append_encoder([5_002_000, 5_003_000], [0.2, 0.3], [5_003_500])
    np.testing.assert_array_equal(
        open_recording(tmp_path / "a.h5").encoder.index_t, [5_000_500, 5_001_500]
    )


def test_an_unfinished_recording_has_its_index_pulses(tmp_path):
    t = np.arange(0, 500_000, 1000)
    with live(tmp_path / "a.h5", flush_s=0.0) as writer:
        writer.append(Events.from_arrays([1, 2], [1, 2], [0, 400_000], [0, 1]))
        writer.append_encoder(t, t * 1e-4, t[::60])
        writer.append(Events.from_arrays([3], [3], [450_000], [0]))
        shutil.copy(writer.part, tmp_path / "copy.h5")
    encoder = open_recording(tmp_path / "copy.h5").encoder
    np.testing.assert_array_equal(encoder.index_t, t[::60][t[::60] <= encoder.t[-1]])
    assert len(encoder.index_t) > 3


def test_an_unfinished_recording_may_lack_its_last_angles(tmp_path):
    with live(tmp_path / "a.h5", flush_s=0.0) as writer:
        writer.append_encoder([1, 2, 3], [0.0, 0.1, 0.2], [2])
        writer._small["encoder/t"].add(np.array([4, 5]))  # whose angles were not written yet
        writer._small["encoder/index_t"].add(np.array([5]))
        writer.append(make(10))
        encoder = open_recording(writer.part).encoder
        writer.set_encoder(encoder)
    assert (encoder.t.tolist(), encoder.angle.tolist(), encoder.index_t.tolist()) == (
        [1, 2, 3],
        [0.0, 0.1, 0.2],
        [2],
    )


def test_compensated_events_keep_fractions_flags_and_nan(tmp_path):
    sensor = make(CHUNK + 99)
    x = sensor.x.astype(np.float32) - 20.25
    x[::1000] = np.nan
    events = Events(x, sensor.y.astype(np.float32), sensor.t, sensor.p)
    inside, extrapolated = x >= -0.5, sensor.p > 0
    with live(tmp_path / "a.h5", compensated=True) as writer:
        for start in range(0, len(events), 50_000):
            which = slice(start, start + 50_000)
            writer.append(events[which], inside=inside[which], extrapolated=extrapolated[which])
        with pytest.raises(AmiwarpError, match=r"a\.h5: compensated events need the flags inside"):
            writer.append(events)
    source = open_recording(tmp_path / "a.h5").events
    assert_equal(read(tmp_path / "a.h5"), events)
    np.testing.assert_array_equal(source.inside(0, len(events)), inside)
    np.testing.assert_array_equal(source.extrapolated(7, len(events)), extrapolated[7:])
    with (
        live(tmp_path / "b.h5") as writer,
        pytest.raises(AmiwarpError, match=r"b\.h5: events come with float32"),
    ):
        writer.append(events)


@pytest.mark.parametrize("seed", range(3))
def test_a_copy_at_any_moment_is_a_recording(tmp_path, seed):
    """A copy of the file at any moment is what a crash would leave."""
    rng = random.Random(seed)
    events, given = make(CHUNK + 60_000, seed=seed), 0
    with live(tmp_path / "a.h5", flush_s=0.0 if seed else 1e9) as writer:
        for k, packet in enumerate(cut(events, 1, 30_000)):
            writer.append(packet)
            writer.append_encoder([4_000_000 + 1000 * k, 4_000_500 + 1000 * k], [k, k + 0.5])
            given += len(packet)
            if rng.random() < 0.2:
                shutil.copy(writer.part, tmp_path / "copy.h5")
                recording = open_recording(tmp_path / "copy.h5")
                assert len(recording.events) == (given if seed else given - given % CHUNK)
                assert_equal(recording.events.slice(0, given), events[: len(recording.events)])
                if seed:
                    assert recording.encoder.t[-1] == 4_000_500 + 1000 * k
                    middle = int(events.t[given // 2])
                    assert recording.events.find(middle) == np.searchsorted(
                        events.t[:given], middle
                    )
                del recording
                (tmp_path / "copy.h5").unlink()


KILLED = """
import sys, time
import numpy as np
from amiwarp.events.recording import Events
from amiwarp.io.native.live_writer import LiveWriter
n, zeros = int(sys.argv[2]), np.zeros(int(sys.argv[2]), np.uint16)
with LiveWriter(sys.argv[1], width=320, height=240, flush_s=0.05) as writer:
    while True:
        began = time.monotonic_ns()
        writer.append(Events(zeros, zeros, np.arange(len(writer), len(writer) + n), zeros.astype(np.uint8)))
        writer.append_encoder(len(writer), len(writer) * 1e-3, [len(writer)])
        print(began, time.monotonic_ns(), len(writer), flush=True)
        time.sleep(0.0003)
"""


def logged(path):
    """Return begin and end of each append [ns] and the number of events after it; complete lines only."""
    return [tuple(map(int, line.split())) for line in path.read_text().split("\n")[:-1]]


@pytest.mark.parametrize("seed", range(5))
def test_a_killed_recording_lacks_its_last_moment(tmp_path, seed):
    rng = random.Random(seed)
    path = tmp_path / "a.h5"
    with (
        open(tmp_path / "log", "wb") as log,
        subprocess.Popen(
            [sys.executable, "-c", KILLED, path, str(10 ** (seed % 4 + 1))], stdout=log
        ) as process,
    ):
        lasts = rng.uniform(0.25e9, 0.5e9)
        while not (lines := logged(tmp_path / "log")) or lines[-1][0] - lines[0][1] < lasts:
            assert process.poll() is None
            time.sleep(0.002)
        process.send_signal(signal.SIGKILL)
    assert os.listdir(tmp_path).count("a.part.h5") == 1
    lines = logged(tmp_path / "log")
    recording = open_recording(tmp_path / "a.part.h5")
    count = len(recording.events)
    # an append more than a flush interval after others has written their events to the disk
    early = [number for _, ended, number in lines if ended < lines[-1][0] - 50_000_000]
    assert count >= early[-1] > 0
    np.testing.assert_array_equal(
        np.concatenate([block.t for block in recording.events.blocks()]), np.arange(count)
    )
    assert recording.encoder.t[-1] >= early[-1]
    np.testing.assert_allclose(recording.encoder.angle, recording.encoder.t * 1e-3)
    left = r"a\.part\.h5: is being written, or was left.*rename or delete"
    with pytest.raises(AmiwarpError, match=left):  # noqa: SIM117
        with live(path):
            pass
    assert not path.exists()


KILLED_AT_THE_START = """
import os, signal, sys
from pathlib import Path
import h5py, hdf5plugin
from amiwarp.io import open_recording
from amiwarp.io.outputs import NewFile
from amiwarp.io.unfinished import remove_abandoned
from amiwarp.io.native.live_writer import LiveWriter
here, part = Path.cwd(), Path("a.part.h5")
opened = absent = 0
LiveWriter("a.h5", width=320, height=240).__enter__()  # imports all that is needed
part.unlink()
for last in range(1, 10_000):
    child = os.fork()
    if not child:
        lines = 0
        def trace(frame, event, _):
            global lines
            if Path(frame.f_code.co_filename).parent.name != "io":
                return None
            if event == "line":
                lines += 1
                if lines == last:
                    os.kill(os.getpid(), signal.SIGKILL)
            return trace
        writer = LiveWriter("a.h5", width=320, height=240)
        sys.settrace(trace)
        writer.__enter__()
        sys.settrace(None)
        os.kill(os.getpid(), signal.SIGTERM)
    ended = os.WTERMSIG(os.waitpid(child, 0)[1])
    if part.exists():
        assert len(open_recording(part).events) == 0
        part.unlink()
        opened += 1
    else:
        absent += 1
    remove_abandoned.cache_clear()
    NewFile("next").discard()
    assert os.listdir() == [], os.listdir()
    if ended == signal.SIGTERM:
        break
print(opened, absent)
"""


@pytest.mark.slow
def test_a_recording_that_is_killed_while_it_is_created_is_absent_or_opens(tmp_path):
    """The process kills itself at each line of the code that creates the file."""
    done = subprocess.run(
        [sys.executable, "-c", KILLED_AT_THE_START], cwd=tmp_path, capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    opened, absent = map(int, done.stdout.split())
    assert absent > 50  # lines before the file gets its name, and after
    assert opened > 3


FULL = """
import resource, sys
import numpy as np
from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events
from amiwarp.io.native.live_writer import LiveWriter
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), int(sys.argv[2])))
rng, n = np.random.default_rng(0), 10_000
writer = LiveWriter(sys.argv[1], width=320, height=240, flush_s=float(sys.argv[3]))
try:
    with writer:
        for k in range(1000):
            t = 1000 * k + np.sort(rng.integers(0, 1000, n))
            x, y = (rng.integers(0, 240, n).astype(np.uint16) for _ in range(2))
            writer.append(Events(x, y, t, rng.integers(0, 2, n).astype(np.uint8)))
            writer.append_encoder([1000 * k, 1000 * k + 500], [k, k + 0.5])
except AmiwarpError as error:
    print(len(writer), error)
"""


@pytest.mark.parametrize(
    ("limit", "flush_s"), [(1000, 1.0), (4_500_000, 0.0), (7_000_000, 1e9), (9_000_000, 0.01)]
)
def test_a_full_disk_keeps_all_that_came_before(tmp_path, limit, flush_s):
    path = tmp_path / "a.h5"
    arguments = [sys.executable, "-X", "dev", "-c", FULL, path, str(limit), str(flush_s)]
    done = subprocess.run(arguments, capture_output=True, text=True, check=True)
    count, _, said = done.stdout.partition(" ")
    assert done.stderr == ""
    if limit < 10_000:
        assert said.strip() == f"{path}: cannot be created: File too large; choose another place"
        assert os.listdir(tmp_path) == []
        return
    assert said.strip() == (
        f"{path}: File too large after {count} events, which the file holds; make room, or write to another disk"
    )
    assert os.listdir(tmp_path) == ["a.h5"]
    recording = open_recording(path)
    assert len(read(path)) == len(recording.events) == int(count) > 0
    assert 2 * (int(count) // 10_000) - len(recording.encoder.t) in (0, 2)
    h5py.File(path).close()  # the file was closed properly


@pytest.mark.parametrize("moment", ["allocate", "write_header"])
def test_an_interrupt_during_the_start_leaves_no_file(tmp_path, monkeypatch, moment):
    def interrupt(*_: object) -> None:
        assert list(tmp_path.glob(".a.part.h5.*.part"))
        raise KeyboardInterrupt

    monkeypatch.setattr(f"amiwarp.io.native.live_writer.{moment}", interrupt)
    with pytest.raises(KeyboardInterrupt), live(tmp_path / "a.h5"):
        pass
    assert os.listdir(tmp_path) == []


def test_the_space_to_finish_is_reserved_before_events_are_accepted(tmp_path):
    """A whole chunk fits on the disk beyond what HDF5 has written. Half a chunk waits in memory."""
    rng = np.random.default_rng(4)
    n = CHUNK // 2
    with live(tmp_path / "a.h5", flush_s=1e9) as writer:
        for k in range(5):
            t = np.sort(rng.integers(0, 10**6, n)) + 10**6 * k
            x, y = (rng.integers(0, size, n) for size in SIZE)
            writer.append(Events.from_arrays(x, y, t, rng.integers(0, 2, n)))
            if k % 2 == 0:
                assert (
                    os.stat(writer.part).st_blocks * 512
                    >= writer._file.id.get_filesize() + 13 * CHUNK
                )


def test_an_empty_recording(tmp_path):
    with live(tmp_path / "a.h5") as writer:
        writer.tick()
        writer.append(Events.empty())
        shutil.copy(writer.part, tmp_path / "copy.h5")
    for name in ("a.h5", "copy.h5"):
        recording = open_recording(tmp_path / name)
        assert (len(recording.events), recording.encoder, recording.events.size) == (0, None, SIZE)


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_an_exception_keeps_what_was_appended(tmp_path, error):
    events = make(1000)
    with pytest.raises(error) as caught:  # noqa: PT012, SIM117
        with live(tmp_path / "a.h5") as writer:
            writer.append(events)
            raise error
    assert caught.value.__notes__ == [
        f"{tmp_path / 'a.h5'}: holds the 1000 events before the error"
    ]
    assert_equal(read(tmp_path / "a.h5"), events)
    assert os.listdir(tmp_path) == ["a.h5"]


@pytest.mark.parametrize("error", [KeyboardInterrupt, AmiwarpError])
def test_an_exception_before_anything_came_leaves_nothing(tmp_path, error):
    """For example, a second output cannot be created."""
    with pytest.raises(error), live(tmp_path / "a.h5"), live(tmp_path / "b.h5") as second:  # noqa: PT012
        second.append_encoder([0, 1000], [0.0, 0.1])
        raise error("refused")
    assert os.listdir(tmp_path) == ["b.h5"]
    assert open_recording(tmp_path / "b.h5").encoder is not None


def test_the_file_that_was_there_is_replaced_at_the_end(tmp_path):
    path = tmp_path / "a.h5"
    path.write_bytes(b"old")
    with pytest.raises(AmiwarpError, match=r"a\.h5: exists"), live(path):
        pass
    with live(path, overwrite=True) as writer:
        writer.append(make(10))
        writer.tick()
        assert path.read_bytes() == b"old"
    assert len(read(path)) == 10


@pytest.mark.parametrize(
    ("append", "message"),
    [
        (lambda w: w.append(make(5)[::-1]), "event 11 .* earlier"),
        (lambda w: w.append(make(5, start=1000)), "event 10 .* earlier than the one before"),
        (
            lambda w: w.append(Events.from_arrays([320], [0], [9_000_000], [0])),
            "event 10 .* outside the 320x240 frame",
        ),
        (lambda w: w.append(make(5), inside=np.ones(5)), "events from a sensor take no flags"),
        (lambda w: w.append(make(1, start=2**61)), "timestamp is damaged"),
        (lambda w: w.append_encoder([7, 6], [0.0, 0.0]), "encoder samples 7 .. 6 us do not follow"),
        (
            lambda w: w.append_encoder([5, 6], [0.0, 0.0]),
            "encoder samples 5 .. 6 us do not follow 5 us",
        ),
        (lambda w: w.append_encoder([6], [np.nan]), "finite angles"),
        (lambda w: w.append_encoder([6], [0.0, 1.0]), "one length"),
    ],
)
def test_what_is_refused_does_not_end_the_recording(tmp_path, append, message):
    with live(tmp_path / "a.h5") as writer:
        writer.append(make(10))
        writer.append_encoder([4, 5], [0.0, 0.1])
        with pytest.raises(AmiwarpError, match=message) as caught:
            append(writer)
        assert "a.h5: " in str(caught.value)
        writer.append(make(3, start=6_000_000))
        writer.append_encoder([6], [0.2])
    recording = open_recording(tmp_path / "a.h5")
    assert len(recording.events) == 13
    assert recording.encoder.t.tolist() == [4, 5, 6]


def test_arrays_may_be_used_again_after_append(tmp_path):
    events = make(CHUNK + 50)
    with live(tmp_path / "a.h5") as writer:
        for start, stop in itertools.pairwise([0, 9, 20, CHUNK - 1, CHUNK + 50]):
            given = Events(*(getattr(events, name)[start:stop].copy() for name in "xytp"))
            writer.append(given)
            for array in (given.x, given.y, given.t, given.p):
                array[:] = 0
        angles = np.zeros(2)
        for k in range(3):
            angles[:] = 2 * k, 2 * k + 1
            writer.append_encoder([20 * k, 20 * k + 10], angles)
    recording = open_recording(tmp_path / "a.h5")
    assert_equal(recording.events[:], events)
    assert recording.encoder.angle.tolist() == [0, 1, 2, 3, 4, 5]


def test_writer_refuses_its_path_and_options(tmp_path):
    with refused(ErrorCode.OUTPUT_FAILED), live(tmp_path / "no" / "a.h5"):
        pass
    with pytest.raises(AmiwarpError, match="give both the same size"):
        LiveWriter(tmp_path / "a.h5", width=10, height=10, camera=CAMERA)
    with (
        pytest.raises(AmiwarpError, match=r"a\.h5: making the file"),
        live(tmp_path / "a.h5", metadata={"n": "a\0b"}),
    ):
        pass
    with pytest.raises(AmiwarpError, match="outside the writer's 'with' block"):
        live(tmp_path / "a.h5").append(make(1))
    assert os.listdir(tmp_path) == []
    with live(tmp_path / "a.h5") as writer:
        writer.append(make(1))
    recording = open_recording(tmp_path / "a.h5")
    with (
        pytest.raises(AmiwarpError, match="is read in this run"),
        live(tmp_path / "a.h5", overwrite=True),
    ):
        pass
    assert len(recording.events) == 1


def test_a_second_encoder_is_written_beside_the_first(tmp_path):
    t, second_t = np.arange(0, 500_000, 1000), np.arange(300, 500_000, 1300)
    with live(tmp_path / "a.h5", encoders=2, clock_offset_us=12.0) as writer:
        writer.append(make(10))
        for k in range(5):
            part, second = t[100 * k : 100 * k + 100], second_t[80 * k : 80 * k + 80]
            writer.append_encoder(part, part * 1e-4, part[:1])
            writer.append_encoder(second, second * -3e-5, second[1:2], second=True)
    encoder = open_recording(tmp_path / "a.h5").encoder
    expected = Encoder(
        t + 12,
        t * 1e-4,
        12.0,
        t[::100] + 12,
        Encoder(second_t + 12, second_t * -3e-5, 12.0, second_t[1::80] + 12),
    )
    for got, given in ((encoder, expected), (encoder.second, expected.second)):
        for name in ("t", "angle", "clock_offset_us", "index_t"):
            np.testing.assert_array_equal(getattr(got, name), getattr(given, name))


def test_an_unfinished_recording_may_lack_the_last_angles_of_the_second_encoder(tmp_path):
    with live(tmp_path / "a.h5", encoders=2, flush_s=0.0) as writer:
        writer.append_encoder([1, 2, 3], [0.0, 0.1, 0.2])
        writer.append(make(10))
        assert open_recording(writer.part).encoder.second is None
        writer.append_encoder([2, 4, 9], [0.0, 0.1, 0.2], second=True)
        # Whose angles were not written yet
        writer._small["encoder/second_t"].add(np.array([11, 12]))
        writer.append(make(10, start=6_000_000))
        second = open_recording(writer.part).encoder.second
        writer._small["encoder/second_angle"].add(np.array([0.3, 0.4]))
    assert (second.t.tolist(), second.angle.tolist()) == ([2, 4, 9], [0.0, 0.1, 0.2])


def test_a_single_sample_is_no_encoder(tmp_path):
    for name, first, second in (("a.h5", 1, 3), ("b.h5", 3, 1), ("c.h5", 0, 3), ("d.h5", 3, 0)):
        with live(tmp_path / name, encoders=2) as writer:
            writer.append(make(10))
            writer.append_encoder(np.arange(first), np.arange(first) * 0.1)
            writer.append_encoder(np.arange(second), np.arange(second) * 0.1, second=True)
        encoder = open_recording(tmp_path / name).encoder
        if first < 2:
            assert encoder is None
        else:
            assert (encoder.t.tolist(), encoder.second) == ([0, 1, 2], None)


def test_an_encoder_with_another_number_of_prisms_is_not_set(tmp_path):
    encoder = Encoder.constant_speed(720.0, 0, 5000)
    for encoders, given, said in (
        (1, encoder.with_second(-0.5), "encoders=2"),
        (2, encoder, "encoders=1"),
    ):
        with live(tmp_path / f"{encoders}.h5", encoders=encoders) as writer:
            writer.append(make(10))
            with pytest.raises(AmiwarpError, match=f"make the writer with {said}"):
                writer.set_encoder(given)
    with live(tmp_path / "pair.h5", encoders=2) as writer:
        writer.append(make(10))
        writer.set_encoder(encoder.with_second(-0.5))
    with pytest.raises(
        AmiwarpError, match=r"set_encoder\(\) was called outside the writer's 'with' block"
    ):
        writer.set_encoder(encoder.with_second(-0.5))
    got = open_recording(tmp_path / "pair.h5").encoder
    np.testing.assert_array_equal(
        got.angles_at([0, 700]), encoder.with_second(-0.5).angles_at([0, 700])
    )


def test_the_index_pulses_of_both_encoders_of_a_set_encoder_are_kept(tmp_path):
    t = np.arange(5) * 1000
    second = Encoder(t, -t * 1e-3, index_t=t[3:4])
    with live(tmp_path / "a.h5", encoders=2) as writer:
        writer.append(make(10))
        writer.append_encoder(t, t * 1e-3, t[:1])
        writer.append_encoder(t, -t * 1e-3, t[1:3], second=True)
        writer.set_encoder(Encoder(t, t * 1e-3, second=second))
    encoder = open_recording(tmp_path / "a.h5").encoder
    assert encoder.index_t is None
    assert encoder.second.index_t.tolist() == [3000]


@pytest.mark.parametrize("samples", [2, 20_000])
def test_an_encoder_set_takes_the_place_of_samples(tmp_path, samples):
    t = np.arange(samples) * 1000
    encoder = Encoder(t, t * 1e-3, 12.5, t[1:2])
    with live(tmp_path / "a.h5", flush_s=0.0) as writer:
        writer.append_encoder(np.arange(9000), np.arange(9000.0), [17, 18])
        writer.append(make(10))
        writer.set_encoder(encoder)
    got = open_recording(tmp_path / "a.h5").encoder
    assert got.clock_offset_us == 12.5
    for name in ("t", "angle", "index_t"):
        np.testing.assert_array_equal(getattr(got, name), getattr(encoder, name))


def test_what_was_written_anew_is_left_out_of_the_finished_file(tmp_path):
    events = make(200_000)
    with live(tmp_path / "a.h5", camera=CAMERA, metadata={"place": "roof"}, flush_s=0.0) as writer:
        writer.append_encoder([1, 2, 3], [0.0, 0.1, 0.2])
        for packet in cut(events, 1000, 2000):
            writer.append(packet)
        grown = os.path.getsize(writer.part)
    assert grown > 20_000_000 > 20 * os.path.getsize(tmp_path / "a.h5")
    recording = open_recording(tmp_path / "a.h5")
    assert recording.metadata == {"place": "roof", "format": "native"}
    assert (recording.camera, recording.encoder.t.tolist()) == (CAMERA, [1, 2, 3])
    assert_equal(read(tmp_path / "a.h5"), events)
    assert os.listdir(tmp_path) == ["a.h5"]


def test_a_damaged_part_is_refused_at_once(tmp_path):
    with live(tmp_path / "a.h5", flush_s=0.0) as writer:
        writer.append(make(3000))
        writer.append_encoder([1, 2, 3], [0.0, 0.1, 0.2])
        data = writer.part.read_bytes()
    data = data[: len(data.rstrip(b"\0")) + 100]
    rng, outcomes = random.Random(0), {"read": 0, "refused": 0}
    for k in range(60):
        mutant = bytearray(data)
        if k % 3:
            for _ in range(k % 3):
                mutant[rng.randrange(48, 12_000)] ^= 1 << rng.randrange(8)
        else:
            del mutant[rng.randrange(len(mutant)) :]
        path = tmp_path / f"{k}.h5"
        path.write_bytes(mutant)
        began = time.monotonic()
        said = refusal(read, path)
        assert said is None or str(path) in said
        outcomes["read" if said is None else "refused"] += 1
        assert time.monotonic() - began < 60.0
    assert min(outcomes.values()) > 5


@pytest.mark.parametrize("flags", [[0, 256], [1, -1], [0.5, 1.0], [0.0, np.nan], ["a", "b"]])
def test_flags_are_zero_or_one(tmp_path, flags):
    x = np.array([1.5, 2.5], np.float32)
    events = Events.from_arrays(x, x, [1, 2], [0, 1])
    with live(tmp_path / "a.h5", compensated=True) as writer:
        with pytest.raises(AmiwarpError, match=r"flag inside is .*; give booleans, or numbers 0"):
            writer.append(events, inside=flags)
        writer.append(events, inside=[True, False])
    assert len(open_recording(tmp_path / "a.h5").events) == 2
