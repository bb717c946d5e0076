"""Other platforms, as far as Linux can imitate them: packages that are missing there, and systems without POSIX."""

import contextlib
import importlib
import os
import select
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from amiwarp import (
    AmiwarpError,
    compensate,
    open_recording,
    save_recording,
)
from amiwarp.io import LiveWriter, file_access, unfinished
from amiwarp.live.stream import PipeSink
from amiwarp.reconstruction import save_film
from amiwarp.simulation import open_pictures
from reference.io_samples import make_events
from tests.io.test_io_readers import assert_equal

EVENTS = make_events()


def test_videos_name_the_package_that_they_need(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    (tmp_path / "in.mp4").write_bytes(bytes(100))
    with pytest.raises(AmiwarpError, match=r"in\.mp4: videos need PyAV; .*'amiwarp\[video\]'"):
        open_pictures(tmp_path / "in.mp4")
    with pytest.raises(AmiwarpError, match=r"out\.mp4: videos need PyAV; "):
        save_film([np.zeros((4, 4), np.uint8)], tmp_path / "out.mp4", fps=1.0)
    assert [path.name for path in tmp_path.iterdir()] == ["in.mp4"]


@pytest.fixture
def no_posix(monkeypatch: pytest.MonkeyPatch) -> None:
    """Remove what Windows lacks, and let open files keep their names, as there."""
    # Which imports psutil, if installed, whose module for Windows is not here
    importlib.import_module("blosc")
    for name in ("fcntl", "resource", "termios", "tty", "pty"):
        monkeypatch.setitem(sys.modules, name, None)
    for module, names in (
        (
            os,
            (
                "preadv",
                "pwritev",
                "posix_fallocate",
                "sched_getaffinity",
                "openpty",
                "fork",
                "getuid",
                "set_blocking",
            ),
        ),
        (select, ("poll",)),
        (signal, ("SIGHUP", "SIGKILL", "pthread_kill", "pthread_sigmask")),
        (socket, ("AF_UNIX",)),
    ):
        for name in names:
            monkeypatch.delattr(module, name)
    unlink = Path.unlink

    def refuse_open_files(path: Path, missing_ok: bool = False) -> None:
        is_open = (
            os.path.samefile(f"/proc/self/fd/{n}", path)
            for n in os.listdir("/proc/self/fd")
            if path.exists()
        )
        with contextlib.suppress(FileNotFoundError):
            if any(is_open):
                raise PermissionError(13, "is used by this process", str(path))
        unlink(path, missing_ok)

    monkeypatch.setattr(Path, "unlink", refuse_open_files)
    monkeypatch.setattr(sys, "platform", "win32")


def test_files_without_posix(tmp_path, request, recording, calibration):
    request.getfixturevalue("no_posix")
    save_recording(tmp_path / "copy.h5", recording)
    size, events = recording.events.size, recording.events.slice(0, len(recording.events))
    assert_equal(open_recording(tmp_path / "copy.h5").events.slice(0, len(events)), events)
    compensate(open_recording(tmp_path / "copy.h5"), calibration, tmp_path / "compensated.h5")
    assert len(open_recording(tmp_path / "compensated.h5").events) == len(events)
    with LiveWriter(tmp_path / "live.h5", width=size[0], height=size[1]) as writer:
        writer.append(events)
    assert_equal(open_recording(tmp_path / "live.h5").events.slice(0, len(events)), events)
    unfinished.discard_all_unfinished()  # as at the exit
    assert {path.name for path in tmp_path.iterdir()} == {"copy.h5", "compensated.h5", "live.h5"}


@pytest.mark.usefixtures("no_posix")
def test_a_pipe_that_cannot_be_waited_for_is_written(tmp_path, monkeypatch):
    def only_sockets(*_: object) -> None:
        raise OSError(10038, "An operation was attempted on something that is not a socket")

    monkeypatch.setattr(select, "select", only_sockets)
    reading, writing = os.pipe()
    with os.fdopen(reading, "rb") as reader, os.fdopen(writing, "wb", 0) as writer:
        PipeSink(b"hello", writer)
        assert reader.read(5) == b"hello"


def test_reading_and_writing_at_a_place_without_preadv(tmp_path, request):
    request.getfixturevalue("no_posix")
    with open(tmp_path / "a", "w+b") as file:
        assert file_access.write_at(file.fileno(), [b"0123", b"4567"], 0) == 4
        assert file_access.write_at(file.fileno(), [b"45"], 2) == 2
        buffer = bytearray(8)
        assert (file_access.read_at(file.fileno(), buffer, 1), bytes(buffer)) == (
            3,
            b"145" + bytes(5),
        )


def test_a_name_that_the_console_cannot_show_is_escaped(tmp_path, recording):
    name = tmp_path / "a\u03b8.h5"
    save_recording(name, recording)
    command = [sys.executable, "-m", "amiwarp", "info", str(name)]
    ended = subprocess.run(
        command, capture_output=True, env={**os.environ, "PYTHONIOENCODING": "ascii"}, check=True
    )
    assert rb"a\u03b8.h5" in ended.stdout
