"""Cameras through all drivers: their events and triggers, how they stop, and their return, by stand-ins.

No camera was connected in any of these tests.
"""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from amiwarp import AmiwarpError, ErrorCode, Events, Packet, open_recording
from amiwarp.live.stream import camera_dv, open_source, returning_source
from reference import dv_stub
from reference.camera_stub import DAVIS_TRIGGER, POLARITY, TRIGGER, Part, StubCamera, connected
from reference.dv_stub import DvPart, StubDv, dv_connected
from reference.metavision_stub import MetavisionPart, StubMetavision, metavision_connected
from tests.command_line import app

EDGES = ((70, True), (80, False), (90, True), (101, False))
UNPLUGGED = RuntimeError("gone\nStacktrace:\n 0# 0x0")


def rows(
    n: int, start_us: int = 0, size: tuple[int, int] = (640, 480), seed: int = 0
) -> np.ndarray:
    rng = np.random.default_rng(seed)
    made = np.zeros(n, POLARITY)
    made["t"] = start_us + np.arange(n, dtype=np.uint64)
    made["x"] = rng.integers(0, size[0], n)
    made["y"] = rng.integers(0, size[1], n)
    made["on"] = rng.integers(0, 2, n)
    return made


def trigger_rows(edges: tuple[tuple[int, bool], ...], kind: np.dtype) -> np.ndarray:
    return np.array([(t, 0, rising) for t, rising in edges], kind)


class Rig:
    """One model of a camera through one driver, with a stand-in for the driver's library."""

    def __init__(
        self, spec: str, connect: Callable[..., Any], camera: Any, make: Callable[..., Any]
    ) -> None:
        self.spec = spec
        self.camera = camera
        self._connect = connect
        self._make = make

    def connected(
        self, *openings: list[Any], most: int | None = None
    ) -> contextlib.AbstractContextManager[Any]:
        """Connect the camera; each opening is a list of events with edges, and of exceptions."""
        self.camera.parts = [
            [p if isinstance(p, Exception) else self._make(*p) for p in each] for each in openings
        ]
        self.camera.most_openings = len(openings) if most is None else most
        return self._connect(self.camera)


def rigs() -> dict[str, Rig]:
    return {
        "evk4": Rig(
            "camera:evk4", connected, StubCamera(), lambda e, t: Part(e, trigger_rows(t, TRIGGER))
        ),
        "dvxplorer": Rig("dv:DX0", dv_connected, StubDv(), DvPart),
        "davis": Rig("dv:DA0", dv_connected, StubDv("DA0", "DAVIS346", (346, 260)), DvPart),
        "prophesee": Rig(
            "prophesee:00051497", metavision_connected, StubMetavision(), MetavisionPart
        ),
    }


@pytest.fixture(params=["evk4", "dvxplorer", "davis", "prophesee"])
def rig(request: pytest.FixtureRequest) -> Rig:
    return rigs()[request.param]


def joined(packets: list[Packet]) -> Events:
    return Events.concatenate([packet.events for packet in packets])


def triggers(packets: list[Packet]) -> list[int]:
    return [int(t) for packet in packets for t in packet.triggers]


def test_no_event_is_lost_and_rising_edges_are_triggers(rig: Rig) -> None:
    made = rows(2000, size=(346, 260))
    with rig.connected([(made[:900], EDGES), (made[900:], ()), UNPLUGGED]):
        source = open_source(rig.spec, packet_us=500)
        packets = list(source.packets())
        source.close()
    got = joined(packets)
    np.testing.assert_array_equal(got.t, made["t"].astype(np.int64))
    for name, field in (("x", "x"), ("y", "y"), ("p", "on")):
        np.testing.assert_array_equal(getattr(got, name), made[field])
    assert triggers(packets) == [70, 90]
    assert (source.camera, source.prism, source.encoders) == (None, None, 0)
    assert source.problem == "the camera stopped: gone; check cable, power and access rights"


def test_a_trigger_input_that_is_off_brings_no_edges(rig: Rig) -> None:
    with rig.connected([(rows(9, size=(346, 260)), EDGES)]):
        source = open_source(f"{rig.spec},trigger=off")
        packets = list(zip(range(3), source.packets(), strict=False))
        source.close()
    assert triggers([packet for _, packet in packets]) == []
    assert sum(len(packet.events) for _, packet in packets) == 9


@pytest.mark.parametrize("counts", [4, -2])
def test_rising_edges_count_the_turns_of_the_prism(rig: Rig, counts: int) -> None:
    with rig.connected(
        [
            (rows(9, size=(346, 260)), EDGES[:2]),
            (rows(9, 200, (346, 260)), ((210, True),)),
            UNPLUGGED,
        ]
    ):
        source = open_source(f"{rig.spec},counts_per_turn={counts}")
        packets = list(source.packets())
    assert source.encoders == 1
    assert (
        [int(t) for packet in packets for t in packet.encoder_t] == triggers(packets) == [70, 210]
    )
    angles = [angle for packet in packets for angle in packet.encoder_angle]
    np.testing.assert_allclose(angles, [0.0, 2.0 * np.pi / counts], rtol=1e-15)


@pytest.mark.parametrize(
    ("spec", "triggered"), [("camera:davis", DAVIS_TRIGGER), ("camera:evk3", TRIGGER)]
)
def test_no_edges_where_the_driver_cannot_switch_the_input_off(
    spec: str, triggered: np.dtype
) -> None:
    """A trigger input that the driver leaves off, and which is on nevertheless, brings no triggers with trigger=off."""
    name = "iniVation DAVIS 346" if "davis" in spec else "Prophesee EVK3 HD"
    parts = [[Part(None, trigger_rows(EDGES, triggered)), UNPLUGGED]]
    with connected(StubCamera(name=name, parts=list(parts))):
        assert triggers(list(open_source(f"{spec},trigger=off").packets())) == []
    with connected(StubCamera(name=name, parts=list(parts))):
        assert triggers(list(open_source(spec).packets())) == [70, 90]


def test_a_camera_that_returns_has_its_settings_again(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its clock begins anew, and goes on by the host's."""
    monkeypatch.setattr(returning_source, "REOPEN_S", 0.1)
    size = (346, 260)
    before = rows(500, 7_000_000, size, 1)
    after = rows(400, 30, size, 2)
    said: list[str] = []
    with rig.connected(
        [(before, ((7_000_100, True),)), UNPLUGGED], [(after, ((40, True),)), UNPLUGGED]
    ):
        source = open_source(f"{rig.spec},region=100:50:300:200", wait_s=0.4, say=said.append)
        packets = list(source.packets())
        source.close()
    first = [packet.returned for packet in packets].index(True)
    for part, made in ((packets[:first], before), (packets[first:], after)):
        inside = (made["x"] >= 100) & (made["x"] < 300) & (made["y"] >= 50) & (made["y"] < 200)
        assert 0 < len(joined(part)) == np.count_nonzero(inside)
    times = joined(packets).t
    assert (np.diff(times) > 0).all()
    gap = [
        next(p.arrived_us for p in part if len(p.events))
        for part in (packets[:first][::-1], packets[first:])
    ]
    assert (
        abs(int(joined(packets[first:]).t[-1] - joined(packets[:first]).t[-1]) - (gap[1] - gap[0]))
        < 1000
    )
    edges = triggers(packets)
    assert edges[0] == 7_000_100
    assert edges[1] - 40 == joined(packets[first:]).t[0] - after["t"][inside][0].astype(np.int64)
    assert source.returns == 1
    assert "waiting up to 0.4 s for the camera" in said[0]
    assert said[1].endswith(", the camera with the same settings")
    assert "and the camera was not back in" in str(source.problem)
    assert len(rig.camera.opened) == 2


def test_a_camera_returns_in_a_recording(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(returning_source, "REOPEN_S", 0.05)
    openings = [[(rows(300, 50, (346, 260)), ((60, True),)), UNPLUGGED] for _ in range(3)]
    with rig.connected(*openings):
        args = [
            "record",
            f"{rig.spec},counts_per_turn=1",
            str(tmp_path / "o.h5"),
            "--wait-for-source",
            "0.3",
            "--json",
        ]
        done = CliRunner().invoke(app, args)
    said = json.loads(done.stdout)
    assert (done.exit_code, said["events"], said["returns"]) == (1, 900, 2)
    assert "was not back in" in done.stderr
    events = open_recording(tmp_path / "o.h5").events
    assert (np.diff(events.slice(0, 900).t) >= 0).all()


def test_a_camera_that_stops_says_how_to_wait_for_it(rig: Rig, tmp_path: Path) -> None:
    with rig.connected([(rows(300, 50, (346, 260)), ((60, True),)), UNPLUGGED]):
        done = CliRunner().invoke(
            app, ["record", f"{rig.spec},counts_per_turn=1", str(tmp_path / "o.h5")]
        )
    assert done.exit_code == 1
    assert (
        "the 300 events received until then are kept; --wait-for-source S waits for it to return"
        in done.stderr
    )
    assert len(open_recording(tmp_path / "o.h5").events) == 300


def test_a_camera_that_is_not_there(rig: Rig) -> None:
    with (
        rig.connected(most=0),
        pytest.raises(AmiwarpError, match=r"cannot be opened: (device|Failed)|no such camera"),
    ):
        open_source(rig.spec)


def test_a_camera_without_its_library(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, remedy in (
        ("dv_processing", r"amiwarp\[dv\]"),
        ("metavision_core.event_io", "install OpenEB"),
    ):
        monkeypatch.setitem(sys.modules, name, None)
        spec = "dv:" if name.startswith("dv") else "prophesee:0004"
        with pytest.raises(
            AmiwarpError, match=f"^{spec}: needs the library {name.partition('.')[0]} .*{remedy}"
        ) as caught:
            open_source(spec)
        assert caught.value.code is ErrorCode.PACKAGE_MISSING


class Host:
    """A clock that only sleeping moves on."""

    def __init__(self) -> None:
        self.now_s = 70.0

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


def test_a_quiet_camera_brings_empty_packets(monkeypatch: pytest.MonkeyPatch) -> None:
    host = Host()
    with dv_connected(StubDv(parts=[[DvPart() for _ in range(1000)]])):
        packets = open_source("dv").packets()
        monkeypatch.setattr(
            camera_dv, "time", SimpleNamespace(monotonic=host.monotonic, sleep=host.sleep)
        )
        for _ in range(2):
            began = host.now_s
            assert next(packets).empty
            assert 0.05 <= host.now_s - began < 0.051


def test_cameras_of_dv_processing_are_chosen_by_their_serial_number() -> None:
    camera = StubDv(parts=[[DvPart(rows(3))]])
    with dv_connected(camera, StubDv("DX1")):
        source = open_source("dv", packet_us=500)
        assert (source.name, source.size) == ("dv:DX0", (640, 480))
        assert camera.opened[0].interval.microseconds == 500
        assert open_source("dv:DX1").name == "dv:DX1"
        with pytest.raises(AmiwarpError, match=r"dv:DX9: no such camera \(found: DX0, DX1\)"):
            open_source("dv:DX9")
        packets = list(source.packets())
    assert sum(len(packet.events) for packet in packets) == 3
    assert source.problem == "the camera stopped; was it unplugged?"


def test_the_substitute_for_dv_processing_has_the_interface_of_the_library() -> None:
    """Its methods are those of the library's classes, with the same names of arguments."""
    dv = pytest.importorskip("dv_processing")
    pairs = (
        (dv_stub.CameraInputBase, dv.io.camera.CameraInputBase),
        (dv_stub.DVXplorer, dv.io.camera.DVXplorer),
        (dv_stub.DAVIS, dv.io.camera.DAVIS),
        (dv_stub.DVXplorerM, dv.io.camera.DVXplorerM),
    )
    checked = 0
    for stub, real in pairs:
        for name in (each for each in dir(stub) if not each.startswith("_") and each[0].islower()):
            method = getattr(stub, name)
            given = method.__code__.co_varnames[1 : method.__code__.co_argcount]
            text = getattr(real, name).__doc__
            assert all(f" {argument}: " in text for argument in given), (name, text)
            checked += 1
    assert checked > 40
    assert set(dv_stub.DAVIS.Davis346BiasCF.__members__) <= set(
        dv.io.camera.DAVIS.Davis346BiasCF.__members__
    )
    assert set(dv_stub.DAVIS.SensorModel.__members__) <= set(
        dv.io.camera.DAVIS.SensorModel.__members__
    )
    assert set(dv_stub.TriggerType.__members__) <= set(dv.TriggerType.__members__)
    assert not hasattr(dv.io.camera.DVXplorerM, "setDetectorRunning")
    store = dv.EventStore()
    store.push_back(5, 3, 4, True)
    assert store.numpy().dtype == dv_stub.ROWS
    # The type of setCropArea's argument: x, y, width, height
    region = dv.EventRegionFilter((3, 4, 1, 1))
    region.accept(store)
    assert len(region.generateEvents()) == 1


def test_the_methods_for_biases_of_a_davis_exist() -> None:
    dv = pytest.importorskip("dv_processing")
    for model, kind in camera_dv.DAVIS_KINDS.items():
        assert model in dv.io.camera.DAVIS.SensorModel.__members__
        assert "coarse: " in getattr(dv.io.camera.DAVIS, f"set{kind}BiasCoarseFine").__doc__
        assert "tuple[int, int]" in getattr(dv.io.camera.DAVIS, f"get{kind}BiasCoarseFine").__doc__
        assert getattr(dv.io.camera.DAVIS, f"{kind}BiasCF").__members__
    for name in camera_dv.THRESHOLDS:
        for camera in (dv.io.camera.DVXplorer, dv.io.camera.DVXplorerM):
            assert hasattr(camera, f"set{name}")
            assert hasattr(camera, f"get{name}")
