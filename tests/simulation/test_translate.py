"""Sequences of pictures: times of the events between pictures, and inputs that can be read."""

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from typer.testing import CliRunner

from amiwarp import (
    AmiwarpError,
    Camera,
    Events,
    ExactModel,
    PictureStack,
    Prism,
    Recording,
    SensorModel,
    open_recording,
    translate,
)
from amiwarp.simulation import DARK, open_pictures, picture_opening
from amiwarp.simulation.translation.translator import translation
from tests.command_line import app

CLEAR = Prism(0.0, 1.5)  # no deflection
WEDGE = Prism(math.radians(2.0), 1.55)
IDEAL = SensorModel.ideal(0.25)


def encode(light: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert linear light to sRGB, 0 .. 1."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def events_of(recording: Recording) -> Events:
    return recording.events.slice(0, len(recording.events))


def fading(folder: Path) -> Path:
    """Five pictures at 100 per second with log intensities 0, 1, 0.5, 0.5 and 1.5 above the lowest."""
    levels = np.array([0.0, 1.0, 0.5, 0.5, 1.5]) + math.log(0.2)
    path = folder / "fade.npy"
    np.save(
        path, np.tile(encode(np.exp(levels) - DARK)[:, None, None], (1, 12, 16)).astype(np.float32)
    )
    return path


def test_events_fire_where_log_intensity_crosses_between_pictures(
    tmp_path: Path, device: str
) -> None:
    recording = translate(
        fading(tmp_path), CLEAR, fps=100.0, sensor=SensorModel.ideal(0.24), device=device
    )
    events = events_of(recording)
    assert len(events) % (12 * 16) == 0
    # crossings from reference 0: up at 0.24, 0.48, 0.72, 0.96; down at 0.72; up at 0.96, 1.2, 1.44
    expected = [
        (2400, 1),
        (4800, 1),
        (7200, 1),
        (9600, 1),
        (15600, 0),
        (34600, 1),
        (37000, 1),
        (39400, 1),
    ]
    for x, y in ((0, 0), (7, 5), (15, 11)):
        chosen = (events.x == x) & (events.y == y)
        assert events.p[chosen].tolist() == [p for _, p in expected]
        # Us
        np.testing.assert_allclose(events.t[chosen], [t for t, _ in expected], rtol=0, atol=3.0)
    assert recording.camera == Camera.from_fov(16, 12, math.radians(60.0))


@pytest.mark.parametrize("blur", [None, 0.0, 1.0])
def test_a_still_picture_gives_the_events_of_simulate(blur: float | None, tmp_path: Path) -> None:
    """The optical blur is the same, also by default, and so are the options of the commands."""
    picture = np.kron(
        np.random.default_rng(0).integers(20, 255, (15, 20), np.uint8), np.ones((8, 8), np.uint8)
    )
    Image.fromarray(picture).save(tmp_path / "picture.png")
    np.save(tmp_path / "stack.npy", np.stack([picture] * 3))
    made = []
    for command, source in (
        ("simulate", ["--picture", "picture.png"]),
        ("translate", ["stack.npy", "--fps", "40"]),
    ):
        out = tmp_path / f"{command}.h5"
        given = [str(tmp_path / word) if "." in word else word for word in source]
        given = [*given, str(out)] if command == "translate" else [str(out), *given]
        more = [
            "--size",
            "40x30",
            "--fov-deg",
            "50",
            "--duration",
            "0.05",
            "--apex-deg",
            "1",
            "--seed",
            "3",
        ]
        more += [] if blur is None else ["--blur-px", str(blur)]
        done = CliRunner().invoke(app, [command, *given, *more, "--device", "cpu"])
        assert done.exit_code == 0, done.output
        events = open_recording(out).events[:]
        made.append(events[np.lexsort((events.t, events.x, events.y))])
    assert len(made[0]) > 500
    for name in ("x", "y", "p"):
        np.testing.assert_array_equal(getattr(made[0], name), getattr(made[1], name))
    # Us; the pictures are interpolated
    np.testing.assert_allclose(made[0].t, made[1].t, rtol=0, atol=1.0)
    scene = {} if blur is None else {"blur": blur}
    stack = PictureStack(np.stack([picture] * 3), 40.0, "stack")
    camera = Camera.from_fov(40, 30, math.radians(50.0))
    by_function = translate(
        stack, Prism(math.radians(1.0)), camera=camera, duration_s=0.05, seed=3, **scene
    )
    assert len(by_function.events) == len(made[0])


def test_events_are_fewer_with_more_blur() -> None:
    picture = np.kron(
        np.random.default_rng(0).integers(20, 255, (15, 20), np.uint8), np.ones((8, 8), np.uint8)
    )
    stack = PictureStack(np.stack([picture] * 3), 40.0, "stack")
    camera = Camera.from_fov(40, 30, math.radians(50.0))
    counts = [
        len(
            translate(
                stack, Prism(math.radians(1.0)), camera=camera, duration_s=0.05, blur=blur
            ).events
        )
        for blur in (0.0, 0.5, 1.0)
    ]
    assert counts[0] > 1.2 * counts[1] > 1.4 * counts[2]
    with pytest.raises(AmiwarpError, match=r"scene blur = -1\.0"):
        translate(stack, Prism(0.01), blur=-1.0)


def test_folder_takes_its_times_from_the_table(tmp_path: Path) -> None:
    stack = np.load(fading(tmp_path))
    for i, picture in enumerate(stack):
        Image.fromarray(np.round(picture * 255).astype(np.uint8)).save(tmp_path / f"p{i + 8}.png")
    times = [1000, 11000, 41000, 42000, 52000]
    rows = "".join(f"p{i + 8}.png,{t}\n" for i, t in enumerate(times))
    # As Excel's "CSV UTF-8"
    (tmp_path / "times.csv").write_text("file,t_us\n" + rows, encoding="utf-8-sig")
    events = events_of(translate(tmp_path, CLEAR, sensor=SensorModel.ideal(0.24)))
    first = (events.x == 3) & (events.y == 3)
    expected = [2400, 4800, 7200, 9600, 26800, 45600, 48000, 50400]
    # Us: eight bits round by 0.01, 0.6 ms
    np.testing.assert_allclose(events.t[first], expected, rtol=0, atol=600.0)
    even = open_pictures(tmp_path, fps=50.0)
    assert [t for t, _ in even.read()] == [0, 20000, 40000, 60000, 80000]
    assert [f.name for f in even.files] == ["p8.png", "p9.png", "p10.png", "p11.png", "p12.png"]  # type: ignore[union-attr]


def test_long_sequences_are_read_as_they_are_needed(tmp_path: Path) -> None:
    """The first events arrive while most pictures are unread. The events do not depend on the size of blocks."""
    stack = np.random.default_rng(0).integers(0, 255, (60, 24, 32), np.uint8)
    np.save(tmp_path / "s.npy", stack)
    simulation = translation(tmp_path / "s.npy", WEDGE, fps=200.0, sensor=IDEAL)
    blocks = [events for events, _ in simulation.blocks()]
    assert len(blocks) >= 7
    cut = Events.concatenate([events for events, _ in simulation.blocks(chunk_us=7000)])
    whole = Events.concatenate(blocks)
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(getattr(cut, name), getattr(whole, name))


def write_video(path: Path, pictures: NDArray[np.uint8], fps: int) -> None:
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=fps)
        stream.height, stream.width = pictures.shape[1:3]
        stream.pix_fmt = "yuv420p"
        for picture in pictures:
            container.mux(
                stream.encode(
                    av.VideoFrame.from_ndarray(np.stack([picture] * 3, -1), format="rgb24")
                )
            )
        container.mux(stream.encode(None))


def test_video_times_and_length(tmp_path: Path) -> None:
    write_video(
        tmp_path / "v.mp4",
        np.tile(np.arange(40, 200, 16, dtype=np.uint8)[:, None, None], (1, 32, 48)),
        20,
    )
    video = open_pictures(tmp_path / "v.mp4")
    assert video.size == (48, 32)
    assert [t for t, _ in video.read()] == [50_000 * i for i in range(10)]
    assert video.duration_us == pytest.approx(500_000)
    slow = open_pictures(tmp_path / "v.mp4", fps=5.0)
    assert [t for t, _ in slow.read()] == [200_000 * i for i in range(10)]
    assert slow.duration_us == pytest.approx(2_000_000)
    events = events_of(translate(tmp_path / "v.mp4", CLEAR, sensor=IDEAL))
    assert events.p.min() == 1  # brightness only increases
    assert events.t.max() < 450_000  # the last picture does not change


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "fps"),
    [("nfs240fps_basketball_20x200x200.npy", 240.0), ("bikes_640x272_25fps.mp4", None)],
)
def test_real_sequences(data_dir: Path, name: str, fps: float | None) -> None:
    camera = Camera.from_fov(80, 60, math.radians(60.0))
    simulation = translation(
        data_dir / "video" / name, WEDGE, fps=fps, camera=camera, duration_s=0.08, sensor=IDEAL
    )
    recording = simulation.run()
    events = events_of(recording)
    assert len(events) > 5000
    assert recording.truth is not None
    points = recording.truth.points(0, len(events))
    assert points is not None
    assert recording.encoder is not None
    xy = np.stack([events.x, events.y], 1).astype(np.float64)
    found = ExactModel(camera, WEDGE).compensate_points(xy, recording.encoder.angle_at(events.t))
    # Px: encoder counts, no latency
    assert np.sqrt(np.mean(np.sum((found - points) ** 2, axis=1))) < 0.03
    # Measures no motion
    default = translation(data_dir / "video" / name, WEDGE, fps=fps, interpolation="blend")
    assert default.duration_s == pytest.approx(20 / 240 if fps else 10.0, rel=0.01)


def test_bad_sequences_are_told(tmp_path: Path) -> None:
    (tmp_path / "junk.mp4").write_bytes(b"no video at all" * 100)
    (tmp_path / "junk.npy").write_bytes(b"no array")
    np.save(tmp_path / "one.npy", np.zeros((1, 4, 4), np.float32))
    np.save(tmp_path / "loud.npy", np.full((2, 4, 4), 3.0, np.float32))
    (tmp_path / "empty").mkdir()
    bad = tmp_path / "bad"
    bad.mkdir()
    (bad / "times.csv").write_text("file,time\na.png,0\n")
    cases = [
        ("nowhere.mp4", None, "does not exist"),
        ("junk.mp4", None, "cannot be read as a video"),
        ("junk.npy", 10.0, "cannot be read as an array"),
        ("one.npy", 10.0, "shape"),
        ("loud.npy", None, "give the pictures per second"),
        ("loud.npy", -1.0, "fps = -1"),
        ("empty", 10.0, "0 pictures"),
        ("empty", None, "times.csv"),
        ("bad", None, "columns file, t_us"),
    ]
    for name, fps, message in cases:
        with pytest.raises(AmiwarpError, match=message):
            open_pictures(tmp_path / name, fps=fps)
    with pytest.raises(AmiwarpError, match=r"outside 0 \.\. 1"):
        translate(tmp_path / "loud.npy", WEDGE, fps=10.0)


def test_tables_of_pictures_have_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(picture_opening, "MOST_PICTURES", 1000)
    (tmp_path / "times.csv").write_text("file,t_us\n" + "".join(f"a,{k}\n" for k in range(1001)))
    with pytest.raises(
        AmiwarpError, match=r"times\.csv: .*it lists over 1000 pictures; split the folder"
    ):
        open_pictures(tmp_path)


def test_a_video_that_breaks_off_is_told(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (40, 64, 64), np.uint8)
    write_video(tmp_path / "whole.avi", noise, 20)
    data = (tmp_path / "whole.avi").read_bytes()
    header = data.index(b"movi") + 4
    (tmp_path / "broken.avi").write_bytes(data[:header])
    with pytest.raises(AmiwarpError, match=r"broken\.avi"):
        translate(tmp_path / "broken.avi", WEDGE, duration_s=0.2)


def test_pictures_of_other_sizes_are_told(tmp_path: Path) -> None:
    for i, size in enumerate([(8, 8), (9, 8)]):
        Image.new("L", size, 100).save(tmp_path / f"{i}.png")
    with pytest.raises(AmiwarpError, match=r"1\.png has 9x8 pixels, the first picture 8x8"):
        translate(tmp_path, WEDGE, fps=10.0)
