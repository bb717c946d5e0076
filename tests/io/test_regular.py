"""Inputs that are not regular files, or unpack to more than the memory holds, are refused at once."""

import json
import os
import socket
import struct
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest

from amiwarp import AmiwarpError, Format, Trajectory, open_recording
from amiwarp.io import read_calib, read_encoder_csv
from amiwarp.io.finished_work import read_journal
from amiwarp.io.inputs import check_regular
from amiwarp.io.json_files import read_toml
from amiwarp.simulation import open_pictures, read_picture
from amiwarp.studies.chart.charts import Charts
from reference.io_samples import SIZE, make_events, write_text


def fifo(path: Path) -> Path:
    os.mkfifo(path)
    return path


def unix_socket(path: Path) -> Path:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(str(path))
    return path


def folder(path: Path) -> Path:
    path.mkdir()
    return path


def linked_fifo(path: Path) -> Path:
    path.symlink_to(fifo(path.with_name("pipe")))
    return path


def loop(path: Path) -> Path:
    path.symlink_to(path)
    return path


PLACES: list[tuple[Callable[[Path], Path], str]] = [
    (fifo, r"is a named pipe \(FIFO\)"),
    (linked_fifo, r"is a named pipe \(FIFO\)"),
    (unix_socket, "is a socket"),
    (lambda path: Path("/dev/zero"), "is a character device"),
    (folder, "is a folder"),
    (loop, "cannot be opened: .*symbolic links"),
    (lambda path: path, "no such file"),
    (lambda path: Path("a\0b"), "cannot be opened: .*null|without null bytes"),
    (
        lambda path: path.with_name("n" * 256),
        "has 256 bytes; the limit is 255; give a shorter|at most 255 bytes",
    ),
    (
        lambda path: path / ("é" * 128) / "a",
        "has 256 bytes; the limit is 255; give a shorter|at most 255 bytes",
    ),
    (
        lambda path: Path(*["n" * 250] * 20),
        "path has 5019 bytes; the limit is 4095|at most 255 bytes",
    ),
]

READERS: list[Callable[[Path], object]] = [
    check_regular,
    open_recording,
    read_encoder_csv,
    lambda path: read_calib(path, *SIZE),
    Trajectory.from_file,
    lambda path: read_toml(path, "a world"),
    read_picture,
    *(lambda path, chosen=chosen: open_recording(path, format=chosen) for chosen in Format),
]


@pytest.mark.parametrize(("place", "message"), PLACES)
def test_only_regular_files_are_opened(tmp_path, place, message):
    path = place(tmp_path / "input")
    for read in READERS:
        with pytest.raises(AmiwarpError, match=message):
            read(path)


@pytest.mark.parametrize("place", [fifo, unix_socket, lambda path: Path("/dev/zero")])
def test_films_are_regular_files(tmp_path, place):
    with pytest.raises(AmiwarpError, match=r"is a (named pipe|socket|character device)"):
        open_pictures(place(tmp_path / "film.mp4"), fps=25.0)


@pytest.mark.parametrize("read", [Charts.load, lambda path: list(read_journal(path, dict, []))])
def test_results_that_a_run_continues_are_regular_files(tmp_path, read):
    fifo(tmp_path / "a.json")
    with pytest.raises(AmiwarpError, match=r"a\.json: (.*: )?is a named pipe"):
        read(tmp_path / "a.json")


def test_files_next_to_an_input_are_regular(tmp_path):
    write_text(tmp_path / "events.txt", make_events())
    (tmp_path / "calib.txt").unlink()
    fifo(tmp_path / "calib.txt")
    with pytest.raises(AmiwarpError, match=r"calib\.txt: is a named pipe"):
        open_recording(tmp_path / "events.txt")
    (tmp_path / "film").mkdir()
    fifo(tmp_path / "film" / "times.csv")
    with pytest.raises(AmiwarpError, match=r"times\.csv: is a named pipe"):
        open_pictures(tmp_path / "film")


def npz(path: Path, shape: str, data: bytes, compress: int = zipfile.ZIP_DEFLATED) -> Path:
    header = f"{{'descr': '<i8', 'fortran_order': False, 'shape': {shape}, }}".encode()
    header += b" " * (64 - (len(header) + 11) % 64) + b"\n"
    with zipfile.ZipFile(path, "w", compress) as archive:
        for name in "xytp":
            archive.writestr(
                f"{name}.npy", b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header + data
            )
    return path


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        (
            "(1152921504606846976,)",
            r"array x declares shape \(1152921504606846976,\), which the archive does not hold",
        ),
        ("(3,)", r"declares shape \(3,\)"),
        ("(-2,)", "declares shape|shape"),
        ("()", "declares shape"),
    ],
)
def test_npz_headers_that_overstate(tmp_path, shape, message):
    with pytest.raises(AmiwarpError, match=message):
        open_recording(npz(tmp_path / "a.npz", shape, bytes(16)))


def test_npz_of_other_compressions(tmp_path):
    with pytest.raises(
        AmiwarpError, match=r"array x is compressed by method 14; save the array with numpy\.savez"
    ):
        open_recording(npz(tmp_path / "a.npz", "(2,)", bytes(16), zipfile.ZIP_LZMA))


def test_an_archive_that_unpacks_to_much_takes_little_memory(tmp_path, monkeypatch):
    """An archive of a quarter of a megabyte holds four arrays of 64 MiB."""
    monkeypatch.setattr("amiwarp.io.file_scan.KEEP_EVENTS", 0)
    path = npz(tmp_path / "a.npz", f"({1 << 23},)", bytes(1 << 26))
    assert path.stat().st_size < 1 << 20
    tracemalloc.start()
    try:
        assert len(open_recording(path, time_unit="us").events) == 1 << 23
        assert tracemalloc.get_traced_memory()[1] < 3 << 26
    finally:
        tracemalloc.stop()


def bomb(path: Path, width: int, height: int) -> Path:
    """Write a PNG of a few bytes that declares any size."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"IDAT", zlib.compress(b""))
        + chunk(b"IEND", b"")
    )
    return path


@pytest.mark.parametrize("size", [(8193, 8192), (12_000, 12_000), (1 << 30, 1 << 30)])
def test_pictures_of_any_declared_size(tmp_path, size):
    with pytest.raises(AmiwarpError, match=r"a\.png cannot be read as a picture"):
        read_picture(bomb(tmp_path / "a.png", *size))


def test_pictures_that_would_run_a_program(tmp_path):
    """Pillow would pass EPS files to Ghostscript, so they are refused."""
    (tmp_path / "a.eps").write_bytes(
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\nshowpage\n"
    )
    with pytest.raises(AmiwarpError, match=r"a\.eps cannot be read as a picture"):
        read_picture(tmp_path / "a.eps")


def test_messages_hold_nothing_that_a_terminal_obeys(tmp_path):
    (tmp_path / "a.txt").write_bytes(b"0.1 1 1 1\n0.2 \x1b[2J\x1b]0;title\x07 1 1\n")
    with pytest.raises(AmiwarpError) as caught:
        open_recording(tmp_path / "a.txt")
    assert "\x1b" not in str(caught.value)
    assert "line 2 is '0.2 \\x1b[2J" in str(caught.value)
    assert (
        str(AmiwarpError("a\nb\udcff\u202e \u00e9\u00a0"))
        == r"a\nb\udcff\u202e" + " \u00e9" + r"\xa0"
    )
    json.dumps(str(caught.value), ensure_ascii=False).encode()
