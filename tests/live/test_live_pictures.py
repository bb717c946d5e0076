"""Pictures of a live stream: as an iterator, on a web page, and as a film."""

from __future__ import annotations

import contextlib
import http.client
import io
import json
import math
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from amiwarp import (
    AmiwarpError,
    Camera,
    Encoder,
    EncoderStream,
    Events,
    LivePicture,
    MemoryEvents,
    PhaseCamera,
    Prism,
    Recording,
    pictures_live,
    save_recording,
)
from amiwarp.live.link import monotonic_us
from amiwarp.live.stream import PictureFilm, PicturePage, PictureStream
from reference.calibration_sample import exact_calibration
from tests import ROOT
from tests.command_line import app
from tests.rig_world import LONG_S

CAMERA = Camera.from_fov(64, 48, math.radians(60))
PRISM = Prism(math.radians(2.0))
KNOWN = exact_calibration(CAMERA, PRISM, {"apex": PRISM.apex, "phase": 0.4})
TURN_US = 83_333


def random_recording(seconds: float, count: int) -> Recording:
    rng = np.random.default_rng(1)
    t = np.sort(rng.integers(0, round(seconds * 1e6), count))
    x = rng.integers(0, 64, count)
    y = rng.integers(0, 48, count)
    events = Events.from_arrays(x, y, t, rng.integers(0, 2, count))
    encoder = Encoder.constant_speed(720.0, -5000, round(seconds * 1e6) + 5000)
    return Recording(MemoryEvents(events, 64, 48), CAMERA, encoder, PRISM)


@pytest.fixture(scope="module")
def recording() -> Recording:
    return random_recording(0.5, 50_000)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, recording: Recording) -> Path:
    path = tmp_path_factory.mktemp("pictures")
    save_recording(path / "a.h5", recording)
    save_recording(path / "short.h5", random_recording(0.05, 1000))
    KNOWN.save(path / "c.json")
    return path


def camera_of(recording: Recording, **options: float) -> PhaseCamera:
    assert recording.encoder is not None
    encoder = EncoderStream()
    encoder.append(recording.encoder.t, recording.encoder.angle)
    return PhaseCamera(KNOWN.model, encoder, **options)


@pytest.fixture(scope="module")
def expected(recording: Recording) -> list[LivePicture]:
    camera = camera_of(recording)
    camera.put(recording.events[:], 0)
    return camera.flush()


def threads() -> list[str]:
    """Return the threads that a stream of pictures starts; those that share kernels stay."""
    names = "amiwarp-(live|pictures|film|page|source|worker)"
    return [one.name for one in threading.enumerate() if re.fullmatch(names, one.name)]


def test_pictures_of_a_file_are_those_of_the_camera(
    folder: Path, expected: list[LivePicture]
) -> None:
    with pictures_live(folder / "a.h5", KNOWN, fast=True) as pictures:
        found = list(pictures)
    assert len(found) == len(expected) == 20
    for one, other in zip(found, expected, strict=True):
        assert one.end_us == other.end_us
        np.testing.assert_array_equal(one.picture.log, other.picture.log)
    assert threads() == []


def test_the_calibrated_clock_offset_and_correction_are_used(
    folder: Path, expected: list[LivePicture]
) -> None:
    """An encoder that is 10 ms late: the angles of the events are others."""
    late = exact_calibration(
        CAMERA, PRISM, {"apex": PRISM.apex, "phase": 0.4, "clock_offset": 10_000.0}
    )
    with pictures_live(folder / "a.h5", late, fast=True) as pictures:
        found = list(pictures)
    assert found[0].end_us != expected[0].end_us


def test_leaving_the_block_ends_the_stream(folder: Path) -> None:
    began = time.monotonic()
    with pictures_live(folder / "a.h5", KNOWN, rate_hz=100.0) as pictures:
        first = next(pictures)
    assert first.turns == 1.0
    assert threads() == []
    assert next(pictures, None) is None
    assert time.monotonic() - began < LONG_S


def test_what_cannot_be_is_refused(folder: Path, recording: Recording, tmp_path: Path) -> None:
    save_recording(tmp_path / "none.h5", Recording(recording.events))
    for path, options, message in (
        (tmp_path / "none.h5", {}, "contains no encoder samples"),
        (folder / "a.h5", {"turns": 2.0}, "turns"),
        (folder / "a.h5", {"rate_hz": -1.0}, "rate_hz"),
        (folder / "a.h5", {"wait_ms": -1.0}, "wait_ms"),
    ):
        with pytest.raises(AmiwarpError, match=message), pictures_live(path, KNOWN, **options):
            pass
    assert threads() == []


def test_an_error_of_an_output_reaches_the_stream(recording: Recording) -> None:
    def fail(picture: LivePicture) -> None:
        raise AmiwarpError("the disk is full")

    stream = PictureStream(camera_of(recording), fail, newest=False)
    stream.append(recording.events[:])
    with pytest.raises(AmiwarpError, match="disk is full"):
        stream.close()
    stream.close()  # says it once


def test_after_an_error_nothing_is_added_in_vain(
    recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, fails = threading.Event(), threading.Event()

    def fail(picture: LivePicture) -> None:
        begun.set()
        fails.wait(LONG_S)
        raise AmiwarpError("the disk is full")

    stream = PictureStream(camera_of(recording), fail, newest=False)
    stream.append(recording.events[:])
    assert begun.wait(LONG_S)
    leave = threading.Condition.__exit__

    def leave_slowly(self: threading.Condition, *error: Any) -> None:
        leave(self, *error)
        if self is stream._changed and threading.current_thread() is stream._thread:
            time.sleep(0.05)  # a thread that waits goes on first

    monkeypatch.setattr(threading.Condition, "__exit__", leave_slowly)
    many = np.zeros(1 << 23, np.int64)
    stream.append(Events.from_arrays(many, many, many, many))
    with ThreadPoolExecutor() as pool:
        waiting = pool.submit(stream.append, recording.events[:])
        time.sleep(0.05)
        assert not waiting.done()
        fails.set()
        with pytest.raises(AmiwarpError, match="disk is full"):
            waiting.result(LONG_S)
    sample = np.zeros(1, np.int64), np.zeros(1)
    for add in (lambda: stream.append(recording.events[:]), lambda: stream.append_encoder(*sample)):
        with pytest.raises(AmiwarpError, match="the pictures have ended"):
            add()
    stream.close()


def test_latency_counts_from_the_arrival_of_the_last_event(recording: Recording) -> None:
    begin = threading.Event()

    def wait(picture: LivePicture) -> None:
        begin.wait(LONG_S)

    stream = PictureStream(camera_of(recording), wait, newest=False)
    events = recording.events[:]
    half = len(events) // 2
    stream.append(events[:half])
    time.sleep(0.2)
    before = monotonic_us()
    stream.append(events[half:])
    begin.set()
    stream.close()
    longest = monotonic_us() - before
    assert stream.made == 20
    assert stream.skipped == 0
    latencies = np.array(stream.latencies_us)
    assert len(latencies) == 20
    # The later pictures of the first half wait for the output of the first one.
    assert (latencies[1:7] > 190_000).all()
    assert (latencies[10:] <= longest).all()
    assert (latencies > 0).all()


def test_a_slow_output_gets_the_newest_pictures(recording: Recording) -> None:
    begin = threading.Event()
    found: list[LivePicture] = []

    def slow(picture: LivePicture) -> None:
        found.append(picture)
        begin.wait(LONG_S)

    stream = PictureStream(camera_of(recording), slow, newest=True)
    events = recording.events[:]
    first = int(np.searchsorted(events.t, 100_000))
    stream.append(events[:first])
    while not found:
        time.sleep(0.01)
    for block in (events[first : first + 10_000], events[first + 10_000 :]):
        stream.append(block)
    begin.set()
    stream.close()
    assert len(found) == stream.made == 2
    assert found[1].end_us > 0.5e6 - TURN_US / 4
    assert stream.skipped == 18


@pytest.fixture
def page() -> Iterator[PicturePage]:
    with PicturePage("127.0.0.1:0") as page:
        yield page
    assert threads() == []


@contextlib.contextmanager
def answer(address: str, path: str) -> Iterator[http.client.HTTPResponse]:
    where = urlsplit(address)
    assert where.hostname is not None
    with contextlib.closing(
        http.client.HTTPConnection(where.hostname, where.port, timeout=LONG_S)
    ) as connection:
        connection.request("GET", path)
        with connection.getresponse() as response:
            yield response


def next_jpeg(response: http.client.HTTPResponse) -> Image.Image:
    """Return the next picture of an MJPEG answer."""
    line = response.readline()
    while line.strip() == b"":
        line = response.readline()
    assert line == b"--amiwarp-picture\r\n"
    assert response.readline() == b"Content-Type: image/jpeg\r\n"
    length = int(response.readline().split(b":")[1])
    assert response.readline() == b"\r\n"
    return Image.open(io.BytesIO(response.read(length)))


def test_the_page_shows_the_newest_picture(page: PicturePage, expected: list[LivePicture]) -> None:
    with answer(page.address, "/") as response:
        assert response.status == 200
        assert b'src="/pictures.mjpg"' in response.read()
    with answer(page.address, "/other") as response:
        assert response.status == 404
    ended = threading.Event()

    def show() -> None:
        while not ended.wait(0.02):
            page(expected[3])

    shown = threading.Thread(target=show)
    shown.start()
    try:
        with answer(page.address, "/pictures.mjpg") as response:
            assert response.status == 200
            picture = next_jpeg(response)
            assert np.asarray(next_jpeg(response)).shape == (48, 64)
    finally:
        ended.set()
        shown.join()
    log = expected[3].picture.log
    order = np.corrcoef(np.asarray(picture).ravel().astype(float), np.exp(0.25 * log).ravel())
    assert order[0, 1] > 0.8


def test_the_page_serves_some_clients_and_lets_them_go(
    page: PicturePage, expected: list[LivePicture]
) -> None:
    with contextlib.ExitStack() as clients:
        for _ in range(8):
            assert page.add_client()
        with answer(page.address, "/pictures.mjpg") as response:
            assert response.status == 503
        page.remove_client()
        response = clients.enter_context(answer(page.address, "/pictures.mjpg"))
        page(expected[0])
        next_jpeg(response)
        page.close()
        assert b"--amiwarp-picture--" in response.read()


def test_addresses_of_pages(page: PicturePage) -> None:
    taken = page.address.removeprefix("http://").rstrip("/")
    with pytest.raises(AmiwarpError, match="cannot listen at this address"):
        PicturePage(taken)
    with pytest.raises(AmiwarpError, match="give HOST:PORT"):
        PicturePage("somewhere")


def frames_of(path: Path) -> list[np.ndarray]:
    av = pytest.importorskip("av")
    with av.open(str(path)) as film:
        return [frame.to_ndarray(format="gray") for frame in film.decode(video=0)]


def test_a_film_has_the_speed_of_the_stream(
    recording: Recording, expected: list[LivePicture], tmp_path: Path
) -> None:
    """Pictures that were left out are replaced by the one before."""
    pytest.importorskip("av")
    camera = camera_of(recording, rate_hz=40.0)
    camera.put(recording.events[:], 0)
    found = camera.flush()
    assert len(found) == 17
    with PictureFilm(tmp_path / "f.mp4", 40.0) as film:
        for one in (*found[:5], *found[8:]):
            film(one)
    frames = frames_of(tmp_path / "f.mp4")
    assert len(frames) == 17
    assert frames[0].shape == (48, 64)
    same = [np.abs(frames[k].astype(float) - frames[4]).mean() for k in (3, 5, 7, 8)]
    assert max(same[1:3]) < 0.5 * min(same[0], same[3])


def test_a_film_needs_a_picture_and_a_free_name(tmp_path: Path) -> None:
    pytest.importorskip("av")
    with (
        pytest.raises(AmiwarpError, match="there is no picture: the stream ended before"),
        PictureFilm(tmp_path / "f.mp4", 25.0),
    ):
        pass
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "g.mp4").touch()
    with pytest.raises(AmiwarpError, match="exists"):
        PictureFilm(tmp_path / "g.mp4", 25.0)
    with pytest.raises(AmiwarpError, match=r"\.mp4"):
        PictureFilm(tmp_path / "g.h5", 25.0)


def live(folder: Path, *options: str, recording: str = "a.h5") -> list[str]:
    given = ["live", str(folder / recording), "--calibration", str(folder / "c.json")]
    return [*given, "--device", "cpu", *options]


def test_live_makes_a_film_and_a_page(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("av")
    film = tmp_path / "f.mp4"
    out = tmp_path / "o.h5"
    options = ["--fast", "--picture", str(film), "--picture-to", "127.0.0.1:0", "--out", str(out)]
    done = CliRunner().invoke(app, live(folder, *options, "--picture-hz", "40", "--json"))
    assert done.exit_code == 0, done.stderr
    said = json.loads(done.stdout)
    assert said["pictures"]["made"] == 17
    assert said["pictures"]["left_out"] == 0
    assert said["files"] == [str(out), str(film)]
    assert len(frames_of(film)) == 17
    assert re.search(r"pictures are shown at http://127\.0\.0\.1:\d+/", done.stderr)
    again = CliRunner().invoke(app, live(folder, *options))
    assert again.exit_code == 1
    assert "exists" in again.stderr
    text = CliRunner().invoke(app, live(folder, "--fast", "--picture", str(film), "--force"))
    assert text.exit_code == 0, text.stderr
    assert re.search(
        r"^7 pictures of the scene, \d+\.\d per second, \d+ ms after", text.stdout, re.M
    )
    assert threads() == []


def test_live_without_a_whole_turn_keeps_its_other_files(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("av")
    film = tmp_path / "f.mp4"
    options = ["--fast", "--picture", str(film), "--out", str(tmp_path / "o.h5")]
    done = CliRunner().invoke(app, live(folder, *options, recording="short.h5"))
    assert done.exit_code == 1
    assert "there is no picture: the stream ended before" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["o.h5"]


def test_a_gif_with_too_many_frames_is_refused_before_the_stream_begins(
    folder: Path, tmp_path: Path
) -> None:
    pytest.importorskip("av")
    options = ("--fast", "--picture", str(tmp_path / "f.gif"), "--picture-hz", "100")
    done = CliRunner().invoke(app, live(folder, *options, "--out", str(tmp_path / "o.h5")))
    assert done.exit_code == 1
    assert "a GIF has at most 50 frames/s" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_film_without_pictures_does_not_hide_why(tmp_path: Path) -> None:
    pytest.importorskip("av")
    with pytest.raises(RuntimeError, match="the cable"), PictureFilm(tmp_path / "f.mp4", 10.0):
        raise RuntimeError("the cable")
    assert threads() == []


def test_a_rate_without_pictures_is_refused(folder: Path) -> None:
    done = CliRunner().invoke(app, live(folder, "--fast", "--picture-hz", "40"))
    assert done.exit_code == 1
    assert "--picture-hz applies to --picture and --picture-to" in done.stderr


@pytest.mark.slow
def test_ctrl_c_finishes_the_film(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("av")
    save_recording(tmp_path / "long.h5", random_recording(20.0, 400_000))
    given = live(folder, "--picture", str(tmp_path / "f.mp4"), "--picture-to", "127.0.0.1:0")
    given[1] = str(tmp_path / "long.h5")
    code = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); import sys; "
    code += "sys.argv[0] = 'amiwarp'; from amiwarp.__main__ import main; main()"
    with subprocess.Popen(
        [sys.executable, "-c", code, *given],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stderr is not None
        _, _, address = process.stderr.readline().strip().partition("pictures are shown at ")
        with answer(address, "/pictures.mjpg") as response:
            for _ in range(3):
                next_jpeg(response)
            process.send_signal(signal.SIGINT)
            response.read()
        out, error = process.communicate(timeout=LONG_S)
    assert process.returncode == 0, error
    assert "pictures of the scene" in out
    assert 3 <= len(frames_of(tmp_path / "f.mp4")) < 300
    assert sorted(path.name for path in tmp_path.iterdir()) == ["f.mp4", "long.h5"]
