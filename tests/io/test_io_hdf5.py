"""HDF5 files that refer to other files, declare more data than they hold, or crash or block HDF5: one error each."""

import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import h5py
import hdf5plugin
import numpy as np
import pytest

from amiwarp import (
    AmiwarpError,
    Encoder,
    Events,
    MemoryEvents,
    Recording,
    open_recording,
    save_recording,
)
from amiwarp.io import reading_process, reading_server
from amiwarp.io.hdf5 import chunks
from amiwarp.io.hdf5 import file as hdf5_file
from amiwarp.io.hdf5.chunks import CHUNK, decode
from amiwarp.io.hdf5.fletcher32 import checksum
from amiwarp.io.reading_process import borrow, give_back, run
from amiwarp.io.reading_server import Reply
from reference.io_samples import make_events, refusal, to_faery, write_dsec, write_native
from tests import ROOT

EVENTS = make_events(600)
SERVED = __name__
"""This module, as the reading process imports it."""


@pytest.fixture
def dsec(tmp_path: Path) -> Path:
    write_dsec(tmp_path / "a.h5", EVENTS)
    return tmp_path / "a.h5"


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    """A file that must not be read: numbers as raw bytes and as HDF5."""
    (tmp_path / "secret").write_bytes(bytes(range(256)) * 10)
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = np.arange(600, dtype=np.uint16)
        file.create_group("metadata").attrs["word"] = "secret"
    return tmp_path / "secret"


def external_storage(file: h5py.File) -> None:
    del file["events/x"]
    file.create_dataset("events/x", (600,), "u1", external=[("secret", 0, 600)])


def virtual(file: h5py.File) -> None:
    del file["events/x"]
    layout = h5py.VirtualLayout((600,), "u2")
    layout[:] = h5py.VirtualSource("other.h5", "x", (600,))
    file.create_virtual_dataset("events/x", layout)


def link(name: str, to: object) -> object:
    def edit(file: h5py.File) -> None:
        if name in file:
            del file[name]
        file[name] = to

    return edit


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (external_storage, "dataset 'events/x' takes its values from other files"),
        (virtual, "dataset 'events/x' takes its values from other files"),
        (
            link("events/x", h5py.ExternalLink("other.h5", "/x")),
            "'events/x' is a soft or external link",
        ),
        (link("events/x", h5py.SoftLink("/events/y")), "'events/x' is a soft or external link"),
        (
            link("metadata", h5py.ExternalLink("other.h5", "/metadata")),
            "'metadata' is a soft or external link",
        ),
        (link("truth", h5py.SoftLink("/events")), "'truth' is a soft or external link"),
        (
            link("encoder", h5py.ExternalLink("none.h5", "/x")),
            "'encoder' is a soft or external link",
        ),
    ],
)
def test_nothing_outside_the_file_is_read(monkeypatch, dsec, secret, edit, message):
    monkeypatch.chdir(secret.parent)
    with h5py.File(dsec, "r+") as file:
        edit(file)
    with pytest.raises(AmiwarpError, match=message) as caught:
        open_recording(dsec)
    assert str(caught.value).startswith(str(dsec))


def reference(file: h5py.File) -> None:
    file.create_group("metadata").attrs["x"] = file["events"].ref


def region(file: h5py.File) -> None:
    file.create_group("metadata").attrs["x"] = file["events/x"].regionref[:10]


def varying(file: h5py.File) -> None:
    values = np.empty(2, object)
    values[:] = [np.arange(3), np.arange(2)]
    file.create_group("metadata").attrs.create("x", values, dtype=h5py.vlen_dtype(np.int64))


def large(file: h5py.File) -> None:
    file.create_group("metadata", track_order=True).attrs["x"] = np.zeros(1 << 16)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (reference, "metadata attribute 'x' is neither a number nor a string"),
        (region, "metadata attribute 'x' is neither"),
        (varying, "metadata attribute 'x' is neither"),
        (
            lambda f: f.create_group("metadata").attrs.create("x", h5py.Empty("f8")),
            "metadata attribute 'x' is neither",
        ),
        (lambda f: f.attrs.create("width", [1, 2]), r"attribute 'width' = \[1, 2\] is not a whole"),
        (
            lambda f: f.create_group("truth").attrs.create("apex", "wide"),
            "attribute 'apex' = 'wide' is not",
        ),
    ],
)
def test_attributes_are_numbers_or_strings(dsec, edit, message):
    with h5py.File(dsec, "r+") as file:
        edit(file)
    with pytest.raises(AmiwarpError, match=message):
        open_recording(dsec)


def test_large_attributes_are_refused(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w", libver="latest") as file:
        for name in "xytp":
            file[f"events/{name}"] = np.zeros(3, np.uint16 if name != "p" else np.uint8)
        large(file)
    with pytest.raises(AmiwarpError, match="attribute 'x' has 524,288 bytes, over 65,536"):
        open_recording(tmp_path / "a.h5")


@pytest.mark.parametrize("value", ["y" * 65_537, ["y" * 40_000, "z" * 30_000]])
def test_long_texts_of_variable_length_are_refused(dsec, value):
    with h5py.File(dsec, "r+") as file:
        group = file.create_group("metadata")
        group.attrs.create("x", value, dtype=h5py.string_dtype())
    with pytest.raises(AmiwarpError, match=r"attribute 'x' has [\d,]+ bytes, over 65,536; remove"):
        open_recording(dsec)


def test_the_longest_text_is_written_and_read(tmp_path):
    events = MemoryEvents(Events.from_arrays([1], [1], [1], [1]), 4, 4)
    save_recording(tmp_path / "a.h5", Recording(events, metadata={"x": "y" * 65_536}))
    assert open_recording(tmp_path / "a.h5").metadata["x"] == "y" * 65_536
    with pytest.raises(AmiwarpError, match="metadata 'x' has 65,537 bytes; give at most 65,536"):
        save_recording(tmp_path / "b.h5", Recording(events, metadata={"x": "y" * 65_537}))


def test_text_that_is_no_utf_8_can_be_printed(dsec):
    with h5py.File(dsec, "r+") as file:
        file.create_group("metadata").attrs["place"] = np.bytes_(b"caf\xe9")
    assert open_recording(dsec).metadata["place"] == "caf\N{REPLACEMENT CHARACTER}"


def declare(name: str, count: int, **options: object) -> object:
    def edit(file: h5py.File) -> None:
        if name in file:
            del file[name]
        kind = "f8" if name.endswith("angle") else "i8"
        file.create_dataset(name, (count,), kind, **options)

    return edit


def all_huge(file: h5py.File) -> None:
    for name, kind in (("x", "u2"), ("y", "u2"), ("t", "i8"), ("p", "u1")):
        del file[f"events/{name}"]
        file.create_dataset(f"events/{name}", (1 << 60,), kind, chunks=(CHUNK,))


def zeros_encoder(file: h5py.File) -> None:
    """Write some kilobytes that unpack to 256 MiB."""
    for name, kind in (("t", "i8"), ("angle", "f8")):
        blosc = hdf5plugin.Zstd()
        stored = file.create_dataset(
            f"encoder/{name}", (1 << 24,), kind, chunks=(1 << 22,), **blosc
        )
        for at in range(0, 1 << 24, 1 << 22):
            stored[at : at + (1 << 22)] = 0


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (
            all_huge,
            r"dataset 'events/t' declares 1152921504606846976 elements, the file holds 0 chunks",
        ),
        (
            declare("ms_to_idx", 1 << 60, chunks=(CHUNK,)),
            r"'ms_to_idx' declares \d+ elements, the file holds 0 chunks",
        ),
        (
            declare("ms_to_idx", 1 << 40),
            "'ms_to_idx' declares 1099511627776 elements, which the file does not hold",
        ),
        (
            declare("encoder/t", 5000),
            "'encoder/t' declares 5000 elements, which the file does not hold",
        ),
        (
            declare("encoder/t", 1 << 30, chunks=(1 << 26,)),
            "'encoder/t' has chunks of over 256 MiB",
        ),
        (zeros_encoder, "'encoder/t' declares 16777216 elements, too many for its size"),
    ],
)
def test_a_length_that_the_file_cannot_hold_is_refused_at_opening(dsec, edit, message):
    with h5py.File(dsec, "r+") as file:
        edit(file)
    with pytest.raises(AmiwarpError, match=message):
        open_recording(dsec)


def test_an_unallocated_chunk_is_refused(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, kind in (("x", "u2"), ("y", "u2"), ("t", "u4"), ("p", "u1")):
            stored = file.create_dataset(f"events/{name}", (300,), kind, chunks=(100,))
            stored[:100] = 0
            stored[200:] = 0
    with pytest.raises(
        AmiwarpError, match="'events/t' declares 300 elements, the file holds 2 chunks of 100"
    ):
        open_recording(tmp_path / "a.h5")


def test_a_replaced_file_is_noticed(dsec, tmp_path):
    """After Ctrl-C the file is opened again by its name, which may belong to another file by then."""
    source = open_recording(dsec).events
    source._file._process[0].close()
    assert len(source.slice(0, 600)) == 600
    source._file._process[0].close()
    write_dsec(tmp_path / "b.h5", EVENTS)
    os.replace(tmp_path / "b.h5", dsec)
    with pytest.raises(AmiwarpError, match=r"a\.h5: .*was replaced by another file"):
        source.slice(0, 600)


# Faulty functions for the reading process.


def crash(number: int) -> Reply:
    os.kill(os.getpid(), number)
    return None, []


def hang() -> Reply:
    while True:
        pass


def swallow() -> Reply:
    return len(np.ones(1 << 28)), []


def panic() -> Reply:
    class PanicError(BaseException):
        pass

    raise PanicError("index out\nof bounds")


def chatter() -> Reply:
    print("noise on standard output", flush=True)
    os.write(1, b"more noise")
    return "sound", [np.arange(3)]


def echo(value: object) -> Reply:
    return value, []


def count_down(notes: dict[str, int], n: int):
    for k in range(n, 0, -1):
        notes["seen"] = notes.get("seen", 0) + 1
        if k == 13:
            raise AmiwarpError("thirteen")
        packet = to_faery(EVENTS)
        yield packet["x"], packet["y"], packet["t"], packet["p"]


@pytest.mark.parametrize(
    ("function", "arguments", "message"),
    [
        ("crash", (signal.SIGSEGV,), r"crashed its process \(SIGSEGV\); the file is damaged"),
        (
            "crash",
            (signal.SIGKILL,),
            r"process was ended by SIGKILL; check that enough memory is free, and retry$",
        ),
        ("hang", (), "over 1 s of processor time, the limit for its size; the file is damaged"),
        ("swallow", (), "needs over 1024 MiB of memory at once"),
        ("panic", (), "index out of bounds$"),
    ],
)
def test_what_misbehaves_costs_one_error(monkeypatch, function, arguments, message):
    monkeypatch.setattr(reading_process, "CPU_SECONDS", 1)
    with pytest.raises(AmiwarpError, match=message):
        run(f"{SERVED}:{function}", *arguments)
    assert run(f"{SERVED}:echo", "next") == "next"


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals_that_end_a_command_do_not_end_its_reading_process(ending):
    """A container or a service may send them to all processes. The file was then called damaged."""
    process = reading_process.ReadingProcess()
    os.kill(process._child.pid, ending)  # while it loads
    assert process.call(f"{SERVED}:echo", "loaded")[0] == "loaded"
    os.kill(process._child.pid, ending)
    assert process.call(f"{SERVED}:echo", "later")[0] == "later"
    process.close()


def test_a_file_is_not_blamed_for_a_library_that_cannot_be_loaded(tmp_path, monkeypatch):
    with pytest.raises(
        AmiwarpError, match=r"amiwarp cannot be loaded: No module named 'amiwarp\.none'; install"
    ):
        run("amiwarp.none:read")
    write_native(tmp_path / "a.h5", EVENTS)
    monkeypatch.setitem(sys.modules, "blosc", None)
    chunks._blosc.cache_clear()
    with pytest.raises(
        AmiwarpError, match=r"a\.h5: is not read, because a library cannot be loaded: .*blosc"
    ):
        open_recording(tmp_path / "a.h5").events.slice(0, 600)


def trickle(notes: dict[str, int], seconds: float):
    """Yield one event for some processor time, and send each by itself."""
    reading_server.PACKET_S = 0.0
    while True:
        until = time.process_time() + seconds
        while time.process_time() < until:
            pass
        yield (np.zeros(1, np.uint8),)


def test_a_file_that_gives_little_for_its_time_is_refused(monkeypatch):
    """Each of its requests is short."""
    monkeypatch.setattr(reading_process, "CPU_SECONDS", 0.5)
    given = reading_process.packets(f"{SERVED}:trickle", 0.05, {})
    with pytest.raises(AmiwarpError, match=r"over 0\.5 s of processor time"):
        list(itertools.islice(given, 40))


def test_the_processor_time_grows_with_the_size(tmp_path):
    for name, size in (("a", 5_000_000), ("b", 10_000_000), ("c", 25_000_000)):
        with open(tmp_path / name, "wb") as file:
            file.truncate(size)
    whole = reading_process.CPU_SECONDS
    allowed = [reading_process.Allowance(tmp_path / name).seconds for name in "abc"]
    assert allowed == [whole, whole, 2.5 * whole]
    assert reading_process.Allowance(tmp_path, 3, "c").seconds == 4.0 * whole
    assert reading_process.Allowance(tmp_path / "none").seconds == whole
    allowance = reading_process.Allowance()
    allowance.left = 0.25 * whole
    allowance.renew(0.5)
    assert allowance.left == 0.75 * whole
    allowance.renew(0.5)
    assert allowance.left == whole


def test_what_a_library_prints_is_not_taken_for_a_reply():
    assert run(f"{SERVED}:chatter") == "sound"


@pytest.mark.parametrize("module", [SERVED, "amiwarp.no_such_module"])
def test_a_process_that_was_started_ahead_serves_the_first_reader(module):
    idle = borrow()  # so that none waits
    reading_process.start_ahead(module)
    ahead = borrow()
    assert ahead is not idle
    assert ahead.call(f"{SERVED}:echo", "first")[0] == "first"
    assert ahead.call(f"{SERVED}:echo", "second")[0] == "second"
    give_back(ahead)
    give_back(idle)
    assert ahead.usable
    assert not idle.usable


def test_one_idle_process_is_kept():
    first, second = borrow(), borrow()
    give_back(first)
    give_back(second)
    assert first.usable
    assert not second.usable
    assert borrow() is first
    give_back(first)


def test_packets_come_in_order_and_may_be_left():
    notes: dict[str, int] = {}
    found = list(reading_process.packets(f"{SERVED}:count_down", 12, notes))
    assert sum(len(packet[0]) for packet in found) == 12 * 600
    assert notes == {"seen": 12}
    with pytest.raises(AmiwarpError, match="thirteen"):
        list(reading_process.packets(f"{SERVED}:count_down", 14, {}))
    left = reading_process.packets(f"{SERVED}:count_down", 100_000, {})
    next(left)
    left.close()
    assert run(f"{SERVED}:echo", [1, "ä"]) == [1, "ä"]


def test_interrupted_reading_goes_on_afterwards(monkeypatch, dsec):
    source = open_recording(dsec).events
    process = source._file._process[0]

    def interrupt(buffer: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(process, "_fill", interrupt)
    with pytest.raises(KeyboardInterrupt):
        source.slice(0, 10)
    assert not process.usable
    assert len(source.slice(0, 600)) == 600


def alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


SCRIPT = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background inherits an ignored SIGINT
from amiwarp.io import open_recording, reading_process
reading_process.CPU_SECONDS = 1
source = open_recording(sys.argv[1]).events
print(source._file._process[0]._child.pid, flush=True)
if sys.argv[2] == "hang":
    source._file._process[0].send("tests.io.test_io_hdf5:hang")
print("ready", flush=True)
time.sleep(600)
"""


@pytest.mark.parametrize("ending", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("state", ["idle", "hang"])
def test_the_process_ends_with_its_owner(dsec, ending, state):
    environment = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
    }
    with subprocess.Popen(
        [sys.executable, "-c", SCRIPT, dsec, state],
        stdout=subprocess.PIPE,
        env=environment,
        stderr=subprocess.PIPE,
    ) as owner:
        pid = int(owner.stdout.readline())
        assert owner.stdout.readline() == b"ready\n"
        assert alive(pid)
        owner.send_signal(ending)
    limit = time.monotonic() + 300.0
    while alive(pid) and time.monotonic() < limit:
        time.sleep(0.05)
    assert not alive(pid)


def test_a_script_without_a_guard_is_not_run_again(dsec, tmp_path):
    """Processes of ``multiprocessing`` import the user's script; this one must not."""
    script = tmp_path / "script.py"
    script.write_text(
        "import sys\nprint('once')\n"
        "from amiwarp.io import open_recording\nprint(len(open_recording(sys.argv[1]).events))\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, script, dsec]
    out = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    assert out.stdout.split() == ["once", "600"]
    assert out.stderr == ""


@pytest.mark.usefixtures("every_core")
def test_threads_share_the_process(dsec):
    source = open_recording(dsec).events
    found: list[int] = []
    threads = [
        threading.Thread(target=lambda k=k: found.append(len(source.slice(k, k + 50))))
        for k in range(0, 500, 10)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [50] * 50


def test_native_recordings_need_no_process_once_opened(tmp_path):
    write_native(tmp_path / "a.h5", EVENTS)
    source = open_recording(tmp_path / "a.h5").events
    assert source._file._process == []
    assert len(source.between(source.t_first, source.t_last + 1)) == 600


@pytest.fixture
def requests(monkeypatch) -> list[str]:
    """Names of the functions that are called in reading processes."""
    sent: list[str] = []
    send = reading_process.ReadingProcess.send
    monkeypatch.setattr(
        reading_process.ReadingProcess,
        "send",
        lambda self, function, *arguments, **how: (
            sent.append(str(function)) or send(self, function, *arguments, **how)
        ),
    )
    return sent


def test_a_native_recording_takes_one_request(tmp_path, requests):
    encoder = Encoder(np.arange(0, 1000, 10), np.arange(100.0))
    recording = Recording(MemoryEvents(EVENTS, 346, 260), encoder=encoder)
    save_recording(tmp_path / "a.h5", recording)
    found = open_recording(tmp_path / "a.h5")
    assert len(found.events.slice(0, 600)) == 600
    np.testing.assert_array_equal(found.encoder.angle, encoder.angle)
    assert requests == ["amiwarp.io.hdf5.server:open_file"]


def test_what_was_found_in_a_file_is_remembered_until_it_changes(monkeypatch, tmp_path, requests):
    path = tmp_path / "a.h5"
    save_recording(path, Recording(MemoryEvents(EVENTS, 346, 260), metadata={"place": "near"}))
    assert open_recording(path).metadata["place"] == "near"
    assert len(requests) == 1
    assert open_recording(path).metadata["place"] == "near"
    assert len(requests) == 2  # it has been written just now
    monkeypatch.setattr(hdf5_file, "UNCHANGED_NS", 0)
    time.sleep(0.05)  # clocks of file systems have steps of some milliseconds
    for _ in range(3):
        found = open_recording(path)
        np.testing.assert_array_equal(found.events.slice(0, 600).t, EVENTS.t)
    assert len(requests) == 3
    with h5py.File(path, "r+") as file:
        file["metadata"].attrs["place"] = "afar"
    assert open_recording(path).metadata["place"] == "afar"
    assert len(requests) == 4


def test_only_so_many_files_are_remembered(monkeypatch, tmp_path, requests):
    monkeypatch.setattr(hdf5_file, "UNCHANGED_NS", 0)
    monkeypatch.setattr(hdf5_file, "REMEMBERED", len(hdf5_file._remembered) + 2)
    for name in "abc":
        write_native(tmp_path / f"{name}.h5", EVENTS)
    time.sleep(0.05)
    for name in "abc":
        open_recording(tmp_path / f"{name}.h5")
    assert len(hdf5_file._remembered) == hdf5_file.REMEMBERED
    open_recording(tmp_path / "c.h5")
    assert len(requests) == 3


@pytest.mark.parametrize("name", ["bitshuffle", "bzip2"])
def test_damaged_chunks_of_any_filter(dsec, name):
    """Bitshuffle crashed on such chunks and bzip2 hung, and the process with it."""
    filters = {"bitshuffle": hdf5plugin.Bitshuffle(cname="lz4"), "bzip2": hdf5plugin.BZip2()}
    with h5py.File(dsec, "r+") as file:
        for column, values in (("x", EVENTS.x), ("y", EVENTS.y), ("t", EVENTS.t), ("p", EVENTS.p)):
            del file[f"events/{column}"]
            file.create_dataset(f"events/{column}", data=values, chunks=(600,), **filters[name])
        chunk = file["events/x"].id.get_chunk_info(0)
    whole = dsec.read_bytes()
    outcomes = set()
    rng = np.random.default_rng(0)
    for _ in range(60):
        raw = bytearray(whole)
        at = chunk.byte_offset + int(rng.integers(16 if rng.random() < 0.5 else chunk.size))
        raw[at : at + 4] = rng.bytes(4)
        dsec.write_bytes(raw)
        said = refusal(lambda: open_recording(dsec).events.slice(0, 600))
        assert said is None or ("a.h5: " in said and "\n" not in said)
        outcomes.add(said is None)
    assert False in outcomes


@pytest.mark.parametrize(
    ("name", "found"), [("events/x", r"0 \.\. 1"), ("encoder/t", r"0 \.\. 600")]
)
def test_a_filter_that_hangs(monkeypatch, dsec, name, found):
    """The bzip2 filter loops for ever on a truncated stream."""
    monkeypatch.setattr(reading_process, "CPU_SECONDS", 2)
    with h5py.File(dsec, "r+") as file:
        if name in file:
            del file[name]
        file.create_dataset(name, data=EVENTS.x, chunks=(600,), **hdf5plugin.BZip2())
        _, stored = file[name].id.read_direct_chunk((0,))
        file[name].id.write_direct_chunk((0,), stored[: len(stored) // 2])
        if name == "encoder/t":
            file["encoder/angle"] = np.arange(600.0)
    ended: list[float] = []
    end = reading_process.ReadingProcess._ended
    monkeypatch.setattr(
        reading_process.ReadingProcess,
        "_ended",
        lambda self: ended.append(self._cpu_s) or end(self),
    )
    message = rf"a\.h5: .*dataset '{name}' \(bzip2\), elements {found}: reading took over 2 s"
    with pytest.raises(AmiwarpError, match=message):
        open_recording(dsec).events.slice(0, 600)
    assert len(ended) == (2 if name == "encoder/t" else 1)  # processes that were ended
    assert sum(ended) <= 2.0  # s, all of the opening together


def test_a_forged_chunk_of_the_native_layout(tmp_path):
    """Damage with a valid checksum is decoded in this process, so Blosc itself must refuse or read it."""
    write_native(tmp_path / "a.h5", EVENTS)
    source = open_recording(tmp_path / "a.h5").events
    offset, size = source._columns["t"]._stored._places[0]
    whole = (tmp_path / "a.h5").read_bytes()
    frame = whole[offset : offset + size - 4]
    rng, out = np.random.default_rng(0), np.empty(CHUNK, np.int64)
    outcomes = set()
    for _ in range(300):
        forged = bytearray(frame)
        at = int(rng.integers(16, 100) if rng.random() < 0.5 else rng.integers(16, len(frame)))
        forged[at : at + 4] = rng.bytes(len(forged[at : at + 4]))
        outcomes.add(decode([bytes(forged) + checksum(forged).to_bytes(4, "little")], out))
    assert outcomes <= {True, False}
