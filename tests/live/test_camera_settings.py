"""Settings of cameras through all drivers, by stand-ins that apply them as the drivers write them to the sensors.

No camera was connected in any of these tests.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from amiwarp import (
    AmiwarpError,
    Camera,
    CameraSettings,
    Encoder,
    ErrorCode,
    Events,
    MemoryEvents,
    Prism,
    Recording,
    open_camera,
    open_recording,
    save_recording,
)
from amiwarp.live.stream import open_source, returning_source
from amiwarp.live.stream.camera_settings import parse_camera
from reference.calibration_sample import exact_calibration
from reference.camera_stub import POLARITY, TRIGGER, Part, StubCamera, connected
from reference.dv_stub import DvPart, StubDv, dv_connected
from reference.metavision_stub import (
    AntiFlicker,
    MetavisionPart,
    StubMetavision,
    TriggerIn,
    metavision_connected,
)
from tests.command_line import app

UNPLUGGED = RuntimeError("gone")
DAVIS_SIZE = (346, 260)
EVK_SIZE = (1280, 720)


def every_pixel(size: tuple[int, int]) -> np.ndarray:
    """One event of each pixel."""
    made = np.zeros(size[0] * size[1], POLARITY)
    made["t"] = np.arange(len(made))
    made["y"], made["x"] = np.divmod(np.arange(len(made)), size[0])
    return made


def stand_in(spec: str) -> tuple[Any, Any, tuple[int, int]]:
    """Return the camera of a source's name, the function that connects it, and its size, ready to send."""
    models = {
        "camera:evk4": "Prophesee EVK4",
        "camera:evk3": "Prophesee EVK3 HD",
        "camera:davis": "iniVation DAVIS 346",
    }
    if spec in models:
        size = DAVIS_SIZE if "davis" in spec else EVK_SIZE
        return (
            StubCamera(name=models[spec], parts=[[Part(every_pixel(size)), UNPLUGGED]]),
            connected,
            size,
        )
    if spec == "prophesee:":
        parts = [[MetavisionPart(every_pixel(EVK_SIZE)), UNPLUGGED]]
        return StubMetavision(parts=parts), metavision_connected, EVK_SIZE
    model, size = ("DAVIS346", DAVIS_SIZE) if "DA" in spec else ("DVXplorer", (640, 480))
    return (
        StubDv(spec[3:], model, size, [[DvPart(every_pixel(size)), UNPLUGGED]]),
        dv_connected,
        size,
    )


def seen(spec: str, settings: str) -> np.ndarray:
    """Return which pixels send events with these settings, shape (height, width)."""
    camera, connect, (width, height) = stand_in(spec)
    with connect(camera):
        source = open_source(f"{spec},{settings}")
        events = Events.concatenate([packet.events for packet in source.packets()])
        source.close()
    image = np.zeros((height, width), int)
    np.add.at(image, (events.y, events.x), 1)
    assert image.max() == 1
    return image == 1


ALL_WITH_REGION = ("camera:evk4", "camera:evk3", "camera:davis", "dv:DX0", "dv:DA0", "prophesee:")


@pytest.mark.parametrize("spec", ALL_WITH_REGION)
@pytest.mark.parametrize(
    "region", [(3, 5, 7, 20), (0, 0, 1, 1), (200, 100, 346, 260), (64, 63, 128, 65)]
)
def test_a_region_is_exact(spec: str, region: tuple[int, int, int, int]) -> None:
    """No row or column more or less, and not mirrored."""
    left, top, right, bottom = region
    image = seen(spec, f"region={left}:{top}:{right}:{bottom}")
    assert image[top:bottom, left:right].all()
    assert np.count_nonzero(image) == (right - left) * (bottom - top)


@pytest.mark.parametrize("spec", ["camera:evk4", "camera:davis", "prophesee:"])
@pytest.mark.parametrize("count", [1, 8, 64])
def test_masked_pixels_are_silent_and_no_others(spec: str, count: int) -> None:
    width, height = DAVIS_SIZE if "davis" in spec else EVK_SIZE
    if "davis" in spec and count > 8:
        with pytest.raises(
            AmiwarpError, match="9 masked pixels are more than the 8 that the camera can mask"
        ):
            seen(spec, "masked=" + "+".join(f"{x}:1" for x in range(9)))
        return
    rng = np.random.default_rng(count)
    places = rng.choice(width * height, 200, replace=False)
    pixels = sorted(
        {(0, height - 1), *((int(place) % width, int(place) // width) for place in places)}
    )[:count]
    image = seen(spec, "masked=" + "+".join(f"{x}:{y}" for x, y in pixels))
    y, x = np.nonzero(~image)
    assert sorted(zip(x.tolist(), y.tolist(), strict=True)) == pixels


def test_a_davis_without_the_filters_has_a_region_and_masked_pixels_nevertheless() -> None:
    parts = [[Part(every_pixel(DAVIS_SIZE)), UNPLUGGED]]
    with connected(StubCamera(name="iniVation DAVIS 346", parts=parts, filters=False)):
        source = open_source("camera:,region=10:20:30:40,masked=12:21+29:39+30:40")
        events = Events.concatenate([packet.events for packet in source.packets()])
    pixels = {(int(x), int(y)) for x, y in zip(events.x, events.y, strict=True)}
    assert pixels == {(x, y) for x in range(10, 30) for y in range(20, 40)} - {(12, 21), (29, 39)}
    assert len(events) == len(pixels)


def test_region_and_mask_together() -> None:
    image = seen("camera:evk4", "region=10:20:30:40,masked=12:21")
    assert np.count_nonzero(image) == 20 * 20 - 1
    assert not image[21, 12]


@pytest.mark.parametrize(
    ("given", "limited"), [("10", 10_000_000), ("1.0049", 1_000_000), ("0.005", 5000)]
)
def test_the_event_rate_is_limited_to_at_most_what_is_given(given: str, limited: int) -> None:
    for spec in ("camera:evk4", "camera:evk3", "prophesee:"):
        camera, connect, _ = stand_in(spec)
        said: list[str] = []
        with connect(camera):
            source = open_source(f"{spec},most_mev_s={given}", say=said.append)
        if spec == "prophesee:":
            limiter = camera.opened[0].facilities["get_i_erc_module"]
            assert limiter.is_enabled()
            assert limiter.get_cd_event_rate() == limited
        else:
            limiter = camera.opened[0]["configuration"].rate_limiter
            assert 1_000_000 * int(limiter.maximum_events_per_period) == limited * int(
                limiter.reference_period_us
            )
            assert limiter.reference_period_us == 200
        assert f"most_mev_s={limited / 1e6:.16g}" in str(source.metadata["camera_settings"])  # type: ignore[attr-defined]
        changed = float(given) * 1e6 != limited
        assert said == (
            [f"{source.name}: the camera has most_mev_s={limited / 1e6:g}"] if changed else []
        )


def test_flicker_is_removed_by_the_camera() -> None:
    camera, connect, _ = stand_in("prophesee:")
    with connect(camera):
        source = open_source("prophesee:,flicker_hz=90:130")
    module = camera.opened[0].facilities["get_i_antiflicker_module"]
    assert (module.get_band_low_frequency(), module.get_band_high_frequency()) == (90, 130)
    assert module.is_enabled()
    assert module.mode is AntiFlicker.AntiFlickerMode.BandStop
    assert "flicker_hz=90:130" in str(source.metadata["camera_settings"])  # type: ignore[attr-defined]


def test_biases_have_the_drivers_names() -> None:
    camera, connect, _ = stand_in("dv:DA0")
    with connect(camera):
        source = open_source("dv:DA0,On=0x57f,Off=3")
    device = camera.opened[0]
    assert device.getDavis346BiasCoarseFine(device.Davis346BiasCF.On) == (5, 0x7F)
    assert device.getDavis346BiasCoarseFine(device.Davis346BiasCF.Off) == (0, 3)
    assert (
        source.metadata["camera_settings"]
        == f"Diff={4 << 8 | 39},On=1407,Off=3,Refractory=1063,trigger=on"
    )  # type: ignore[attr-defined]
    camera, connect, _ = stand_in("dv:DX0")
    with connect(camera):
        open_source("dv:DX0,ContrastThresholdOn=12")
    assert (
        camera.opened[0].getContrastThresholdOn(),
        camera.opened[0].getContrastThresholdOff(),
    ) == (12, 10)
    for name in ("diff_on", "bias_diff_on"):  # with OpenEB's prefix or without
        camera, connect, _ = stand_in("prophesee:")
        with connect(camera):
            open_source(f"prophesee:,{name}=20")
        assert camera.opened[0].facilities["get_i_ll_biases"].values == {
            "bias_diff": 0,
            "bias_diff_on": 20,
            "bias_fo": 0,
        }


def test_a_value_that_the_camera_changes_is_said() -> None:
    camera, connect, _ = stand_in("dv:DX0")
    said: list[str] = []
    with connect(camera):
        open_source("dv:DX0,ContrastThresholdOn=18,ContrastThresholdOff=17", say=said.append)
    name = "dv:DX0,ContrastThresholdOn=18,ContrastThresholdOff=17"
    assert said == [f"{name}: the camera has ContrastThresholdOn=17"]


@pytest.mark.parametrize(
    ("spec", "says"),
    [
        (
            "camera:evk4,flicker_hz=90:130",
            "EVK4 has no flicker_hz through this driver; open it as prophesee:",
        ),
        (
            "camera:evk3,masked=1:2",
            "Prophesee EVK3 HD has no masked through this driver; open it as prophesee:",
        ),
        (
            "camera:evk3,trigger=on",
            "Prophesee EVK3 HD has no trigger through this driver; open it as prophesee:",
        ),
        (
            "camera:davis,most_mev_s=1",
            "DAVIS 346 has no most_mev_s .*; thin the recording with 'amiwarp",
        ),
        (
            "camera:davis,trigger=on",
            "iniVation DAVIS 346 has no trigger through this driver; open it as dv: through",
        ),
        (
            "camera:vga,region=1:2:3:4",
            "VGA has no region .*open it as prophesee: .*'amiwarp filter --reg",
        ),
        ("camera:vga,most_mev_s=1", "CenturyArks VGA has no most_mev_s through this driver"),
        (
            "camera:dvx,region=1:2:3:4",
            "iniVation DVXplorer has no region .*; open it as dv: through dv-processing",
        ),
        (
            "camera:triton,masked=1:2",
            "Lucid Triton has no masked .*; remove pixels from the recording",
        ),
        (
            "dv:DX0,most_mev_s=1",
            "DVXplorer has no most_mev_s through this driver; thin the recording",
        ),
        (
            "dv:DX0,flicker_hz=90:130",
            "DVXplorer has no flicker_hz through this driver; light the scene",
        ),
        (
            "dv:DA0,masked=1:2",
            "DAVIS346 has no masked through this driver; open a DAVIS346 as camera: through",
        ),
        ("dv:DM0,trigger=on", "DVXplorerM has no trigger through this driver"),
        ("dv:DM0,counts_per_turn=1", "DVXplorerM has no trigger input; leave counts_per_turn out"),
        ("dv:DM0,On=1", "DVXplorerM has no biases through this driver; leave them out"),
        ("prophesee:1,most_mev_s=1", "IMX636 has no most_mev_s through this driver"),
        ("prophesee:1,counts_per_turn=1", "IMX636 has no trigger input"),
        ("prophesee:1,diff_on=1", "IMX636 has no biases through this driver"),
        (
            "camera:evk4,region=0:0:1281:720",
            "region 0:0:1281:720 is not within the sensor of 1280x720 px",
        ),
        ("camera:evk4,masked=1280:0", "masked pixel 1280:0 is outside the sensor of 1280x720 px"),
        ("dv:DA0,region=0:0:346:261", "region 0:0:346:261 is not within the sensor of 346x260 px"),
        ("prophesee:,masked=0:720", "masked pixel 0:720 is outside the sensor"),
        (
            "camera:evk4,most_mev_s=0.004",
            r"most_mev_s = 0.004; the camera limits to 0.005 .. 20971.5 million",
        ),
        ("camera:evk4,most_mev_s=30000", "most_mev_s = 30000; the camera limits to"),
        ("prophesee:,most_mev_s=3201", "most_mev_s = 3201; the camera limits to 0 .. 3200 million"),
        (
            "prophesee:,flicker_hz=90:521",
            "flicker_hz = 90:521; the camera removes flicker of 50 .. 520 Hz",
        ),
        (
            "prophesee:,flicker_hz=49:100",
            "flicker_hz = 49:100; the camera removes flicker of 50 .. 520 Hz",
        ),
        ("prophesee:,diff_on=141", "bias bias_diff_on = 141; expected -85 .. 140"),
        ("prophesee:,diff=1", "bias bias_diff cannot be set, it is 0; leave it out"),
        (
            "prophesee:,diff_on=1,bias_diff_on=2",
            "bias bias_diff_on is given as 1 and as 2; give it once",
        ),
        (
            "prophesee:,onn=1",
            r"IMX636 has no bias 'bias_onn'; its biases, .*, are bias_diff \(0\), bias_",
        ),
        ("dv:DA0,On=2048", "bias On = 2048; expected 0 .. 2047"),
        (
            "dv:DA0,Onn=1",
            r"DAVIS346 has no bias 'Onn'; its biases, with their values, are Diff \(1063\), On",
        ),
        ("camera:evk4,region=1:2:3", "region is .*; expected 4 numbers"),
        (
            "camera:evk4,region=1:2:3:x",
            "setting 'region=1:2:3:x'; write region=LEFT:TOP:RIGHT:BOTTOM, in pixels",
        ),
        ("camera:evk4,region=5:2:5:9", "give left, top, right and bottom"),
        ("camera:evk4,masked=1", "masked is .*; expected 2 numbers"),
        ("camera:evk4,masked=1:2+-3:4", "masked = -3 is not a whole number in 0"),
        ("camera:evk4,most_mev_s=0", "setting 'most_mev_s=0'; write most_mev_s=NUMBER"),
        ("camera:evk4,most_mev_s=inf", "setting 'most_mev_s=inf'; write most_mev_s=NUMBER"),
        ("camera:evk4,flicker_hz=130:90", "give the lowest and the highest frequency"),
        ("camera:evk4,trigger=1", "setting 'trigger=1'; write trigger=on or trigger=off"),
        (
            "camera:evk4,trigger=off,counts_per_turn=1",
            "counts_per_turn counts edges at the trigger input",
        ),
        ("camera:evk4,settings=none.h5", "none.h5: no such file"),
    ],
)
def test_what_a_camera_cannot_do_is_refused_in_one_line(
    tmp_path: Path, spec: str, says: str
) -> None:
    cameras = [
        StubCamera("1"),
        StubCamera("2", "Prophesee EVK3 HD"),
        StubCamera("3", "iniVation DAVIS 346"),
        StubCamera("4", "CenturyArks VGA"),
        StubCamera("5", "iniVation DVXplorer"),
        StubCamera("6", "Lucid Triton"),
    ]
    others = StubDv(), StubDv("DA0", "DAVIS346", DAVIS_SIZE), StubDv("DM0", "DVXplorerM")
    bare = StubMetavision("1", lacks=("get_i_ll_biases", "get_i_erc_module", "get_i_trigger_in"))
    with connected(*cameras), dv_connected(*others), metavision_connected(StubMetavision(), bare):
        with pytest.raises(AmiwarpError, match=says) as caught:
            open_source(spec)
        done = CliRunner().invoke(app, ["record", spec, str(tmp_path / "o.h5")])
    assert (done.exit_code, done.stderr) == (1, f"amiwarp: {caught.value}\n")
    assert spec.partition(",")[0].rstrip(":").partition(":")[0] in str(caught.value)
    assert not list(tmp_path.iterdir())
    assert sum(len(camera.opened) for camera in cameras) == 0  # refused before the camera is opened


def test_a_davis_that_exchanges_rows_and_columns() -> None:
    camera = StubCamera(name="iniVation DAVIS 346", exchanges_axes=True)
    with connected(camera):
        for setting in ("region=1:2:3:4", "masked=1:2"):
            with pytest.raises(AmiwarpError, match=r"exchanges rows and columns, .*open it as dv:"):
                open_source(f"camera:,{setting}")
        open_source("camera:").close()
    assert camera.closed == len(camera.opened) == 3


def test_a_trigger_input_that_may_be_off_is_said() -> None:
    for name in ("iniVation DAVIS 346", "iniVation DVXplorer"):
        said: list[str] = []
        with connected(StubCamera(name=name)):
            open_source("camera:,counts_per_turn=1", say=said.append)
        assert len(said) == 1
        assert "leaves the trigger input off; open it as dv:" in said[0]


SETTINGS = CameraSettings(
    biases={"diff_on": -20, "fo": 3},
    region=(1, 2, 30, 40),
    masked=((5, 6), (7, 8)),
    most_per_s=1_005_000,
    flicker_hz=(90, 130),
    trigger=True,
    counts_per_turn=-4,
)


def test_the_text_of_settings_can_be_read_again() -> None:
    for settings in (
        SETTINGS,
        CameraSettings(),
        CameraSettings(trigger=False),
        CameraSettings(most_per_s=1),
    ):
        text = str(settings)
        assert parse_camera(f"camera:evk4,{text}" if text else "camera:evk4").settings == settings
    assert str(SETTINGS) == (
        "diff_on=-20,fo=3,region=1:2:30:40,masked=5:6+7:8,most_mev_s=1.005,flicker_hz=90:130,trigger=on,counts_per_turn=-4"
    )
    assert CameraSettings(masked=np.array([[3, 4], [3, 4], [5, 6]])).masked == ((3, 4), (5, 6))  # type: ignore[arg-type]


def edges(*times: int) -> np.ndarray:
    return np.array([(t, 0, True) for t in times], TRIGGER)


def test_settings_are_saved_with_a_recording_and_used_again(tmp_path: Path) -> None:
    spec = "camera:evk4,diff_on=20,region=100:50:300:200,masked=101:60,most_mev_s=1.0049,counts_per_turn=1"
    parts = [[Part(every_pixel(EVK_SIZE), edges(5, 900)), UNPLUGGED] for _ in range(2)]
    camera = StubCamera(parts=list(parts))
    with connected(camera):
        first = CliRunner().invoke(app, ["record", spec, str(tmp_path / "a.h5")])
        again = f"camera:evk4,settings={tmp_path / 'a.h5'},diff_on=25"
        second = CliRunner().invoke(app, ["record", again, str(tmp_path / "b.h5")])
    assert "the stream broke off" in first.stderr
    assert "the camera has most_mev_s=1\n" in first.stderr
    assert "the stream broke off" in second.stderr
    assert "the camera has" not in second.stderr
    one, two = (
        json.loads(json.dumps(vars(each["configuration"]), default=str)) for each in camera.opened
    )
    assert one.pop("biases") == str(vars(camera.opened[0]["configuration"])["biases"])
    assert two.pop("biases") == str(vars(camera.opened[1]["configuration"])["biases"])
    assert one == two
    assert [each["configuration"].biases.diff_on for each in camera.opened] == [20, 25]
    for name, on in (("a.h5", 20), ("b.h5", 25)):
        recording = open_recording(tmp_path / name)
        assert len(recording.events) == 200 * 150 - 1
        biases = f"pr=0,fo=0,hpf=0,diff_on={on},diff=0,diff_off=0,inv=0,refr=0"
        saved = str(recording.metadata["camera_settings"])
        assert saved.startswith(biases)
        assert saved.endswith(
            ",region=100:50:300:200,masked=101:60,most_mev_s=1,trigger=on,counts_per_turn=1"
        )
        assert recording.metadata["camera_settings_from"] == "as sent: the driver reports none"
    shown = CliRunner().invoke(app, ["info", str(tmp_path / "a.h5")]).stdout
    assert "camera_settings" in shown
    assert "region=100:50:300:200" in shown


def test_settings_of_a_recording_without_any(tmp_path: Path) -> None:
    events = Events.from_arrays([1], [1], [5], [1])
    save_recording(
        tmp_path / "a.h5",
        Recording(MemoryEvents(events, 4, 3), None, Encoder.constant_speed(60.0, 0, 100)),
    )
    with (
        connected(StubCamera()),
        pytest.raises(AmiwarpError, match=r"a\.h5: stores no settings of a camera; give a"),
    ):
        open_source(f"camera:,settings={tmp_path / 'a.h5'}")


def test_settings_that_the_camera_reports_are_saved(tmp_path: Path) -> None:
    camera, connect, _ = stand_in("prophesee:")
    given = "diff_on=20,region=100:50:300:200,masked=101:60,most_mev_s=1.0049,flicker_hz=90:130,counts_per_turn=1"
    with connect(camera):
        CliRunner().invoke(app, ["record", f"prophesee:,{given}", str(tmp_path / "a.h5")])
    metadata = open_recording(tmp_path / "a.h5").metadata
    assert metadata["camera_settings"] == (
        "bias_diff_on=20,bias_fo=0,region=100:50:300:200,masked=101:60,most_mev_s=1,flicker_hz=90:130,trigger=on,"
        "counts_per_turn=1"
    )
    assert metadata["camera_settings_from"] == "reported by the camera; the region as sent"
    assert (metadata["camera_name"], metadata["recorded_from"]) == (
        "IMX636",
        f"prophesee:00051497,{given}",
    )
    camera, connect, _ = stand_in("dv:DX0")
    with connect(camera):
        CliRunner().invoke(
            app, ["record", "dv:DX0,region=1:2:30:40,counts_per_turn=1", str(tmp_path / "b.h5")]
        )
    metadata = open_recording(tmp_path / "b.h5").metadata
    assert metadata["camera_settings"] == (
        "ContrastThresholdOn=9,ContrastThresholdOff=10,region=1:2:30:40,trigger=on,counts_per_turn=1"
    )
    assert (metadata["camera_settings_from"], metadata["camera_name"]) == (
        "reported by the camera",
        "DVXplorer",
    )


@pytest.mark.parametrize("spec", ["camera:evk4", "dv", "prophesee:"])
def test_a_camera_in_python(spec: str) -> None:
    """The same settings as in the name of a source; the camera is closed after the block."""
    camera, connect, size = stand_in("dv:DX0" if spec == "dv" else spec)
    settings = CameraSettings(region=(5, 6, 50, 60), trigger=True)
    said = []
    events = 0
    with connect(camera):
        with open_camera(spec, settings, say=said.append) as packets:
            assert packets.size == size
            assert str(packets.metadata["camera_settings"]).endswith("region=5:6:50:60,trigger=on")
            gone = "the stream broke off: the camera stopped: gone.*; open the camera again"
            with pytest.raises(AmiwarpError, match=gone) as caught:  # noqa: PT012
                for packet in packets:
                    events += len(packet.events)
            assert caught.value.code is ErrorCode.UNREACHABLE
            assert packets.lost == (0 if spec == "camera:evk4" else None)
        with pytest.raises(AmiwarpError, match=r"has no masked|masked pixel 9999:1"):
            open_camera(spec, CameraSettings(masked=((9999, 1),))).__enter__()
    assert events == 45 * 54
    assert said == []
    assert spec != "camera:evk4" or camera.closed == len(camera.opened) == 1


def test_a_camera_in_python_returns_with_its_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(returning_source, "REOPEN_S", 0.05)
    camera = StubCamera(
        parts=[[Part(every_pixel(EVK_SIZE)), UNPLUGGED] for _ in range(2)], most_openings=2
    )
    said: list[str] = []
    settings = CameraSettings(region=(5, 6, 50, 60))
    counts = []
    with (  # noqa: PT012
        connected(camera),
        open_camera("camera:", settings, wait_for_source_s=0.2, say=said.append) as packets,
        pytest.raises(AmiwarpError, match="and the camera was not back in"),
    ):
        for packet in packets:
            counts.append(len(packet.events))
    assert [count for count in counts if count] == [45 * 54] * 2
    assert "the camera with the same settings" in said[1]


def test_only_cameras_are_opened_as_cameras() -> None:
    with pytest.raises(
        AmiwarpError, match=r"name is 'a\.h5'; give a camera: camera:, dv:, prophesee:"
    ):
        open_camera("a.h5").__enter__()


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"biases": {"region": 1}}, "bias 'region' is no name of a bias"),
        ({"biases": {"a,b": 1}}, "bias 'a,b' is no name of a bias"),
        ({"biases": {"on": 1.0}}, "bias on = 1.0 is not a whole number"),
        ({"region": (0, 0, 0, 5)}, "region is .*; give left, top, right and bottom"),
        ({"masked": (1, 2)}, "masked is 1; expected 2 numbers"),
        ({"most_per_s": -1}, "most_per_s = -1 is not a whole number in 0"),
        ({"flicker_hz": (100, 100)}, "flicker_hz is .*; give the lowest and the highest frequency"),
        (
            {"trigger": False, "counts_per_turn": 2},
            "counts_per_turn counts edges at the trigger input",
        ),
    ],
)
def test_settings_that_make_no_sense(values: dict[str, Any], says: str) -> None:
    with pytest.raises(AmiwarpError, match=says):
        CameraSettings(**values)


@pytest.mark.parametrize(
    ("setting", "on"), [("trigger=off", False), ("trigger=on", True), ("", True)]
)
def test_the_trigger_input_itself_is_switched(setting: str, on: bool) -> None:
    for spec in ("camera:evk4", "dv:DX0", "dv:DA0", "prophesee:"):
        camera, connect, _ = stand_in(spec)
        with connect(camera):
            source = open_source(f"{spec},{setting}" if setting else spec)
            source.close()
        opened = camera.opened[0]
        if spec == "camera:evk4":
            assert opened["configuration"].enable_external_trigger is on
        elif spec == "prophesee:":
            assert opened.facilities["get_i_trigger_in"].is_enabled(TriggerIn.Channel.MAIN) is on
        else:
            assert opened.isDetectorRunning() is on
        saved = str(source.metadata["camera_settings"])  # type: ignore[attr-defined]
        assert saved.endswith(f"trigger={'on' if on else 'off'}")


def test_settings_in_a_live_compensation(tmp_path: Path) -> None:
    """Both files have only the events of the region, and the settings."""
    camera = Camera.from_fov(*DAVIS_SIZE, math.radians(60))
    prism = Prism(math.radians(2.0))
    exact_calibration(camera, prism, {"apex": prism.apex, "phase": 0.4}).save(tmp_path / "c.json")
    stub, connect, _ = stand_in("dv:DA0")
    stub.parts[0][0].edges = tuple((t, True) for t in range(5, 90_000, 2000))
    args = [
        "live",
        "dv:DA0,region=100:50:300:200,counts_per_turn=40",
        "--calibration",
        str(tmp_path / "c.json"),
    ]
    files = tmp_path / "out.h5", tmp_path / "raw.h5"
    with connect(stub):
        done = CliRunner().invoke(
            app, [*args, "--device", "cpu", "--out", str(files[0]), "--record", str(files[1])]
        )
    assert "the stream broke off: the camera stopped: gone" in done.stderr
    for path in files:
        recording = open_recording(path)
        assert len(recording.events) == 200 * 150
        assert ",region=100:50:300:200,trigger=on,counts_per_turn=40" in str(
            recording.metadata["camera_settings"]
        )
    raw = open_recording(files[1]).events.slice(0, 200 * 150)
    assert (raw.x.min(), raw.y.min(), raw.x.max(), raw.y.max()) == (100, 50, 299, 199)


def test_a_davis_is_given_the_region_and_the_masked_pixels() -> None:
    """Not only are their events left out: the camera does not send them."""
    camera, connect, _ = stand_in("camera:davis")
    with connect(camera):
        open_source("camera:davis,region=10:20:30:60,masked=0:0+12:21").close()
    configuration = camera.opened[0]["configuration"]
    region = configuration.region_of_interest
    assert (region.left, region.top, region.width, region.height) == (10, 20, 20, 40)
    assert [int(code) for code in configuration.pixel_mask] == [
        1,
        1 + 12 + 21 * 346,
        0,
        0,
        0,
        0,
        0,
        0,
    ]
