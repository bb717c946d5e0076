"""Cameras through neuromorphic-drivers: its own Python code runs, above a substitute for its compiled part.

No camera was connected in any of these tests.
"""

from __future__ import annotations

import inspect
import json
import math
import sys
import threading
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from amiwarp import AmiwarpError, Camera, Events, Packet, Prism, open_camera, open_recording
from amiwarp.live.stream import camera_neuromorphic, open_source, reopen_source, returning_source
from reference.calibration_sample import exact_calibration
from reference.camera_stub import (
    DAVIS_TRIGGER,
    POLARITY,
    TRIGGER,
    Part,
    StubCamera,
    StubDevice,
    connected,
)
from tests.command_line import app

drivers = pytest.importorskip("neuromorphic_drivers")
PRISM = Prism(math.radians(2.0))
UNPLUGGED = RuntimeError("Usb(Device(NoDevice))")


def rows(n: int, start_us: int, seed: int = 0, size: tuple[int, int] = (1280, 720)) -> np.ndarray:
    """Events of a camera, on average one per microsecond."""
    rng = np.random.default_rng(seed)
    made = np.zeros(n, POLARITY)
    made["t"] = start_us + np.sort(rng.integers(0, n, n)).astype(np.uint64)
    made["x"], made["y"] = rng.integers(0, size[0], n), rng.integers(0, size[1], n)
    made["on"] = rng.integers(0, 2, n)
    return made


def edges(t: np.ndarray) -> np.ndarray:
    """Rising edges at these times, each with a falling one 10 us later."""
    made = np.zeros(2 * len(t), TRIGGER)
    made["t"][::2], made["t"][1::2] = t, t + 10
    made["rising"][::2] = True
    return made


def stream(
    made: np.ndarray, triggers: np.ndarray, packet_us: int, end: Exception = UNPLUGGED
) -> Iterator[Part | Exception]:
    """The rows in packets of different lengths, some empty; then the camera is unplugged."""
    cuts = np.arange(made["t"][0], made["t"][-1] + packet_us + 1, packet_us)
    for start, stop in pairwise(cuts):
        own, trigger = (
            columns[slice(*np.searchsorted(columns["t"], [start, stop]))]
            for columns in (made, triggers)
        )
        yield Part(own if len(own) else None, trigger if len(trigger) else None)
        yield Part()
    yield end


def received(spec: str, **options: Any) -> tuple[Any, list[Packet]]:
    source = open_source(spec, **options)
    packets = list(source.packets())
    source.close()
    return source, packets


def joined(packets: list[Packet]) -> Events:
    return Events.concatenate([packet.events for packet in packets])


def assert_same(events: Events, made: np.ndarray, shift_us: int = 0) -> None:
    np.testing.assert_array_equal(events.t, made["t"].astype(np.int64) + shift_us)
    for name, field in (("x", "x"), ("y", "y"), ("p", "on")):
        np.testing.assert_array_equal(getattr(events, name), made[field])


@pytest.mark.parametrize("start_us", [0, (1 << 24) - 500_000, (1 << 32) - 500_000, (1 << 53) + 1])
def test_no_event_or_trigger_is_lost_or_altered(start_us: int) -> None:
    """Also where counters of 24 and 32 bits begin anew, and beyond what float64 resolves."""
    made, at = (
        rows(1_000_000, start_us),
        np.arange(start_us + 7, start_us + 1_000_000, 333, np.uint64),
    )
    camera = StubCamera(parts=[stream(made, edges(at), 1234)])
    with connected(camera):
        source, packets = received("camera:")
    assert_same(joined(packets), made)
    np.testing.assert_array_equal(
        np.concatenate([packet.triggers for packet in packets]), at.astype(np.int64)
    )
    assert not any(packet.encoder_t.size for packet in packets)
    assert (source.size, source.encoders, source.lost, source.camera, source.prism) == (
        (1280, 720),
        0,
        0,
        None,
        None,
    )
    assert source.name == "camera:00051497"
    assert "the camera stopped: Usb(Device(NoDevice)); check cable" in source.problem
    (opened,) = camera.opened
    assert (opened["timeout"], opened["maximum"]) == (
        returning_source.IDLE_S,
        camera_neuromorphic.RAW_PACKETS,
    )
    assert opened["ring"] is None
    assert opened["configuration"].serialize() == drivers.prophesee_evk4.Configuration().serialize()
    assert opened["configuration"].enable_external_trigger
    assert camera.closed == 1


def test_the_substitute_has_the_interface_of_the_package() -> None:
    """Its compiled class is called with the same arguments, and the packets have the same fields."""
    from neuromorphic_drivers import neuromorphic_drivers as compiled

    given = [name for name in inspect.signature(StubDevice.__new__).parameters if name != "cls"]
    assert compiled.Device.__text_signature__ == f"({', '.join(given)})"
    for name in ("__next__", "__exit__", "name", "biases_bounds"):
        assert callable(getattr(compiled.Device, name))
    with connected(StubCamera(parts=[[Part(rows(3, 0), dropped=4)]])):
        stubbed = sys.modules["neuromorphic_drivers"]
        assert stubbed.__file__ == drivers.__file__
        device = stubbed.open(
            stubbed.prophesee_evk4.Configuration(), serial="00051497", iterator_timeout=0.0
        )
        status, packet = next(device)
    assert set(vars(packet)) == set(drivers.Evt3Packet.__annotations__)
    assert status.ring.dropped_packets == 4
    assert sys.modules["neuromorphic_drivers"] is drivers


def test_rising_edges_and_pulses_of_a_davis() -> None:
    made = np.array([(5, 0, 0), (6, 0, 1), (7, 0, 2)], DAVIS_TRIGGER)
    camera = StubCamera("DA1", "iniVation DAVIS 346", [[Part(None, made), UNPLUGGED]])
    with connected(camera):
        source, packets = received("camera:davis")
    assert source.size == (346, 260)
    assert [packet.triggers.tolist() for packet in packets] == [[6, 7]]


@pytest.mark.parametrize("counts", [1, -4])
def test_a_recording_with_the_encoder_at_the_trigger_input(tmp_path: Path, counts: int) -> None:
    made, at = rows(300_000, 40), np.arange(60, 300_000, 20_000, np.uint64)
    camera = StubCamera(parts=[stream(made, edges(at), 5000)])
    with connected(camera):
        spec = f"camera:evk4,counts_per_turn={counts},diff_on=20"
        done = CliRunner().invoke(app, ["record", spec, str(tmp_path / "o.h5"), "--json"])
    assert done.exit_code == 1
    name = f"camera:00051497,counts_per_turn={counts},diff_on=20"
    assert f"{name}: the stream broke off: the camera stopped" in done.stderr
    assert (
        "the 300,000 events received until then are kept; --wait-for-source S waits" in done.stderr
    )
    said = json.loads(done.stdout)
    assert (said["events"], said["lost_usb_packets"], said["late"], said["dropped"]) == (
        300_000,
        0,
        0,
        0,
    )
    recording = open_recording(tmp_path / "o.h5")
    assert_same(recording.events.slice(0, len(recording.events)), made)
    assert (recording.events.size, recording.metadata["recorded_from"]) == ((1280, 720), name)
    assert recording.metadata["camera_name"] == "Prophesee EVK4"
    assert recording.encoder is not None
    np.testing.assert_array_equal(recording.encoder.t, at.astype(np.int64))
    expected = 2.0 * math.pi / counts * np.arange(len(at))
    np.testing.assert_allclose(recording.encoder.angle, expected, rtol=0, atol=1e-12)


def test_a_camera_is_compensated_live(tmp_path: Path) -> None:
    made, at = rows(50_000, 40, size=(346, 260)), np.arange(60, 50_000, 2000, np.uint64)
    camera, values = Camera.from_fov(346, 260, math.radians(60)), {"apex": PRISM.apex, "phase": 0.4}
    exact_calibration(camera, PRISM, values).save(tmp_path / "c.json")
    pulses = np.zeros(len(at), DAVIS_TRIGGER)
    pulses["t"], pulses["polarity"] = at, 2
    with connected(StubCamera("DA1", "iniVation DAVIS 346", [stream(made, pulses, 5000)])):
        args = [
            "live",
            "camera:DA1,counts_per_turn=40",
            "--calibration",
            str(tmp_path / "c.json"),
            "--device",
            "cpu",
        ]
        done = CliRunner().invoke(app, [*args, "--out", str(tmp_path / "o.h5"), "--json"])
    said = json.loads(done.stdout)
    assert (done.exit_code, said["events"], said["compensated"], said["late"]) == (
        1,
        50_000,
        50_000,
        0,
    )
    assert "the 50,000 events received until then are kept" in done.stderr
    recording = open_recording(tmp_path / "o.h5")
    np.testing.assert_array_equal(recording.events.slice(0, 50_000).t, made["t"].astype(np.int64))
    assert recording.metadata["camera_name"] == "iniVation DAVIS 346"


def test_lost_usb_packets_are_counted_and_reported(tmp_path: Path) -> None:
    made, trigger = rows(3000, 0), edges(np.array([5, 900], np.uint64))
    parts = [
        Part(made[:1000], trigger),
        Part(made[1000:2000], dropped=3),
        Part(made[2000:], dropped=12),
        UNPLUGGED,
    ]
    camera = StubCamera(parts=[parts])
    with connected(camera):
        done = CliRunner().invoke(
            app, ["record", "camera:,counts_per_turn=1", str(tmp_path / "o.h5"), "--json"]
        )
    said = json.loads(done.stdout)
    assert said["lost_usb_packets"] == 12
    assert said["events"] == 3000
    assert "this computer is too slow" in said["messages"][0]
    assert "12 USB packets with events were lost" in said["messages"][1]


def test_lost_usb_packets_are_counted_in_python(monkeypatch: pytest.MonkeyPatch) -> None:
    """The count goes on when the camera has returned."""
    monkeypatch.setattr(returning_source, "REOPEN_S", 0.05)
    made = rows(3000, 0)
    parts = [[Part(made, dropped=3), UNPLUGGED], [Part(made, dropped=4), UNPLUGGED]]
    camera = StubCamera(parts=parts, most_openings=2)
    lost = []
    with (  # noqa: PT012
        connected(camera),
        open_camera("camera:", wait_for_source_s=0.2, say=lambda _: None) as packets,
        pytest.raises(AmiwarpError, match="was not back"),
    ):
        for packet in packets:
            if len(packet.events):
                lost.append(packets.lost)
    assert lost == [3, 7]


def test_a_camera_that_is_plugged_in_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its clock begins anew: times go on by the host's clock. No event is lost that the camera delivered."""
    monkeypatch.setattr(returning_source, "REOPEN_S", 0.2)
    before, after = rows(100_000, 1_000_000, 1), rows(100_000, 300, 2)
    at = np.arange(0, 100_000, 10_000, np.uint64)
    camera = StubCamera(most_openings=2, parts=[
        stream(before, edges(before["t"][0] + 5 + at), 7000), stream(after, edges(305 + at), 7000)
    ])  # fmt: skip
    said: list[str] = []
    with connected(camera):
        source = open_source("camera:evk4,pr=1", wait_s=0.7, say=said.append)
        packets = list(source.packets())
    assert_same(joined(packets[: (k := [p.returned for p in packets].index(True))]), before)
    later = joined(packets[k:])
    shift = int(later.t[0]) - int(after["t"][0])
    assert_same(later, after, shift)
    assert later.t[0] > before["t"][-1]
    arrived = [
        next(p for p in part if len(p.events)).arrived_us
        for part in (packets[:k][::-1], packets[k:])
    ]
    assert abs((int(later.t[0]) - int(before["t"][-1])) - (arrived[1] - arrived[0])) <= 7000
    triggers = np.concatenate([packet.triggers for packet in packets])
    np.testing.assert_array_equal(triggers[10:], 305 + at.astype(np.int64) + shift)
    assert (np.diff(triggers) > 0).all()
    assert source.returns == 1
    assert "waiting up to 0.7 s for the camera" in said[0]
    assert "the stream is back" in said[1]
    assert "and the camera was not back in" in source.problem
    assert [opened["configuration"].biases.pr for opened in camera.opened[:2]] == [1, 1]
    assert camera.closed >= 2


def test_a_camera_returns_in_a_recording_and_in_a_view(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(returning_source, "REOPEN_S", 0.05)
    at = np.arange(0, 50_000, 5000, np.uint64)
    parts = [stream(rows(50_000, 9), edges(at + 9), 999) for _ in range(2)]
    with connected(StubCamera(parts=list(parts), most_openings=2)):
        args = [
            "record",
            "camera:,counts_per_turn=1",
            str(tmp_path / "o.h5"),
            "--wait-for-source",
            "0.5",
            "--json",
        ]
        done = CliRunner().invoke(app, args)
    said = json.loads(done.stdout)
    assert said["returns"] >= 1
    assert said["events"] == 100_000
    recording = open_recording(tmp_path / "o.h5")
    t = recording.events.slice(0, 100_000).t
    assert (np.diff(t) >= 0).all()
    assert recording.encoder is not None
    shift = int(t[50_000] - t[0])
    assert np.isin(
        np.concatenate([at + 9, at + 9 + shift]).astype(np.int64), recording.encoder.t
    ).all()
    with connected(camera := StubCamera(serial="1")):
        source = reopen_source("camera:1", threading.Event())
        assert source is not None
        source.close()
    assert len(camera.opened) == 1


@pytest.mark.parametrize(
    ("spec", "cameras", "says"),
    [
        ("camera:", [], "camera:: no camera is connected"),
        ("camera:davis", [StubCamera()], r"0 such cameras are connected; .*: camera:00051497 \(Prophesee EVK4\)"),
        ("camera:", [StubCamera(), StubCamera("DA1", "iniVation DAVIS 346")],
         r"2 such cameras are connected; choose one of these: camera:00051497 \(Prophesee EVK4\), "
         r"camera:DA1 \(iniVation DAVIS 346\)"),
        ("camera:evk4", [StubCamera("1"), StubCamera("2"), StubCamera("3", "iniVation DVXplorer")],
         r"2 such cameras are connected; choose one of these: camera:1 .*, camera:2 \(Prophesee EVK4\)$"),
        ("camera:", [StubCamera(None, error="Access denied")],
         r"Prophesee EVK4 cannot be opened: Access denied; on Linux, 'neuromorphic-drivers-install-udev-rules'"),
        ("camera:,diff=20x", [StubCamera()], r"setting 'diff=20x'; write NAME=WHOLE_NUMBER"),
        ("camera:,counts_per_turn=0", [StubCamera()], "'counts_per_turn=0'; write counts_per_turn=WHOLE_NUMBER"),
        ("camera:,onn=1", [StubCamera()], r"Prophesee EVK4 has no bias 'onn'; its .* are pr \(0\), fo \(0\), .*refr"),
        ("camera:,diff_on=40000", [StubCamera()], r"bias diff_on = 40000; expected -32768 .. 32767"),
        ("camera:,diff_on=200", [StubCamera(limits={"diff_on": (-85, 140)})], r"diff_on = 200; expected -85 .. 140"),
        ("camera:,log=2", [StubCamera(name="iniVation DVXplorer")], r"bias log = 2; expected 0 .. 1"),
    ],
    ids=lambda v: v if isinstance(v, str) else "",
)  # fmt: skip
def test_a_camera_that_cannot_be_opened(
    tmp_path: Path, spec: str, cameras: list[StubCamera], says: str
) -> None:
    with connected(*cameras):
        done = CliRunner().invoke(app, ["record", spec, str(tmp_path / "o.h5")])
        with pytest.raises(AmiwarpError, match=says):
            open_source(spec)
    assert done.exit_code == 1
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())
    assert all(len(camera.opened) == camera.closed for camera in cameras)


def test_biases_of_each_model_reach_the_camera() -> None:
    for name, spec, expected in (
        ("Prophesee EVK4", "camera:,diff_on=-20,fo=0x10", {"diff_on": -20, "fo": 16}),
        ("Prophesee EVK3 HD", "camera:evk3,diff_off=1", {"diff_off": 1, "diff_on": 0x73}),
        ("CenturyArks VGA", "camera:vga,pr=1000", {"pr": 1000}),
        ("iniVation DVXplorer", "camera:DVXplorer,on=3,log=1", {"on": 3, "off": 8, "log": True}),
        ("iniVation DAVIS 346", "camera:DAVIS346,onbn=99", {"onbn": 99, "offbn": 583}),
        ("Lucid Triton", "camera:triton,hpf=2", {"hpf": 2}),
    ):
        camera = StubCamera("7", name)
        with connected(camera):
            source = open_source(spec)
            source.close()
        biases = camera.opened[0]["configuration"].biases
        assert {key: getattr(biases, key) for key in expected} == expected
        properties = getattr(drivers, drivers.Name(name).name.lower()).Properties()
        assert source.size == (properties.width, properties.height)
        assert source.name == f"camera:7,{','.join(spec.partition(',')[2].split(','))}"


def test_the_list_of_cameras() -> None:
    with connected(StubCamera(), StubCamera(None, "iniVation DVXplorer", error="Access denied")):
        done = CliRunner().invoke(app, ["info", "camera:"])
        data = json.loads(CliRunner().invoke(app, ["info", "camera:", "--json"]).stdout)
    assert [line.split("  ")[0] for line in done.stdout.splitlines()] == [
        "Prophesee EVK4",
        "iniVation DVXplorer",
    ]
    assert "camera:00051497" in done.stdout
    assert "cannot be opened: Access denied" in done.stdout
    assert [camera["source"] for camera in data["cameras"]] == ["camera:00051497", None]
    with connected():
        assert "no camera is connected" in CliRunner().invoke(app, ["info", "camera:"]).stdout


def test_a_camera_without_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "neuromorphic_drivers", None)
    with pytest.raises(
        AmiwarpError, match=r"camera: needs the library neuromorphic_drivers .*'amiwarp\[camera\]'"
    ):
        open_source("camera:evk4")


def test_a_machine_whose_cameras_cannot_be_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> None:
        raise RuntimeError("Other error")

    monkeypatch.setattr(drivers, "list_devices", refuse)
    with pytest.raises(
        AmiwarpError, match="camera: the cameras cannot be listed: Other error; check cable"
    ):
        open_source("camera:")
