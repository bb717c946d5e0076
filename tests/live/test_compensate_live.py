"""Iteration over the compensated packets of a stream from a socket or a file."""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from amiwarp import (
    AmiwarpError,
    Camera,
    Encoder,
    Events,
    MemoryEvents,
    Prism,
    Recording,
    compensate_events,
    compensate_live,
    save_recording,
)
from amiwarp.live.stream import encode_encoder, encode_end, encode_events, encode_hello
from amiwarp.live.stream.sockets import close_listener, listen
from reference.calibration_sample import exact_calibration
from tests.rig_world import LONG_S

CAMERA, PRISM = Camera.from_fov(64, 48, math.radians(60)), Prism(math.radians(2.0))
KNOWN = exact_calibration(CAMERA, PRISM, {"apex": PRISM.apex, "phase": 0.4})
N = 20_000


@pytest.fixture(scope="module")
def recording() -> Recording:
    rng = np.random.default_rng(1)
    t = np.sort(rng.integers(0, 300_000, N))
    events = Events.from_arrays(
        rng.integers(0, 64, N), rng.integers(0, 48, N), t, rng.integers(0, 2, N)
    )
    return Recording(
        MemoryEvents(events, 64, 48), CAMERA, Encoder.constant_speed(720.0, -5000, 305_000), PRISM
    )


def stream(recording: Recording, end: bytes) -> bytes:
    """Return the bytes of a stream: encoder samples, then the events in packets."""
    encoder = recording.encoder
    assert encoder is not None
    packets = [encode_events(block) for block in recording.events.blocks(count=1000)]
    return (
        encode_hello(64, 48, CAMERA, PRISM)
        + encode_encoder(encoder.t, encoder.angle)
        + b"".join(packets)
        + end
    )


@contextmanager
def served(path: Path, data: bytes, *, keep_open: bool = False) -> Iterator[str]:
    """Send bytes to the first client at a local socket, and leave the connection open on request."""
    server, address = listen(f"unix:{path}")
    left = threading.Event()

    def run() -> None:
        connection, _ = server.accept()
        with connection, contextlib.suppress(OSError):  # the client may leave early
            connection.sendall(data)
            if keep_open:
                left.wait(LONG_S)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield address
    finally:
        left.set()
        thread.join(LONG_S)
        close_listener(server)


def threads() -> list[str]:
    names = ("amiwarp-live", "amiwarp-source")
    return [thread.name for thread in threading.enumerate() if thread.name in names]


@pytest.mark.parametrize("kind", ["socket", "file"])
def test_packets_are_those_of_offline_compensation(
    kind: str, recording: Recording, tmp_path: Path, device: str
) -> None:
    if kind == "file":
        save_recording(tmp_path / "a.h5", recording)
        with compensate_live(tmp_path / "a.h5", KNOWN, fast=True, device=device) as packets:
            found = list(packets)
    else:
        with (
            served(tmp_path / "s", stream(recording, encode_end())) as address,
            compensate_live(address, KNOWN, device=device) as packets,
        ):
            found = list(packets)
            assert list(packets) == []
    events = Events.concatenate([packet.events for packet in found])
    assert np.array_equal(events.t, recording.events[:].t)
    assert np.array_equal(events.p, recording.events[:].p)
    inside = np.concatenate([packet.flags for packet in found]) == 0
    assert inside.mean() > 0.5
    assert recording.encoder is not None
    wanted = compensate_events(recording.events[:], KNOWN.model, recording.encoder, device=device)
    # Px
    np.testing.assert_allclose(
        np.stack([events.x, events.y], 1)[inside], wanted[inside], rtol=0, atol=1e-3
    )
    assert threads() == []


@pytest.mark.parametrize("raised", [None, ZeroDivisionError, KeyboardInterrupt])
def test_leaving_the_block_ends_the_stream(
    raised: type[BaseException] | None, recording: Recording, tmp_path: Path
) -> None:
    with served(tmp_path / "s", stream(recording, b""), keep_open=True) as address:
        leaving = contextlib.nullcontext() if raised is None else pytest.raises(raised)
        with leaving, compensate_live(address, KNOWN) as packets:
            for packet in packets:
                got = len(packet.events)
                if raised is not None:
                    raise raised
                break
        assert got > 0
        assert "amiwarp-live" not in threads()
        assert next(packets, None) is None


def test_a_stream_that_breaks_off_raises_after_its_last_packet(
    recording: Recording, tmp_path: Path
) -> None:
    got: list[int] = []
    with (
        served(tmp_path / "s", stream(recording, b"")) as address,
        compensate_live(address, KNOWN) as packets,
        pytest.raises(AmiwarpError, match=f"the stream broke off: ended .* gave the {N:,} events"),
    ):
        got.extend(len(packet.events) for packet in packets)
    assert sum(got) == N


def test_a_slow_program_gets_every_event(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two packets at most wait for the program, and the source waits too."""
    monkeypatch.setattr("amiwarp.live.items.MOST_ITEMS", 2)
    save_recording(tmp_path / "a.h5", recording)
    wait, got = threading.Event(), 0
    with compensate_live(str(tmp_path / "a.h5"), KNOWN, fast=True) as packets:
        for packet in packets:
            wait.wait(0.01)
            got += len(packet.events)
    assert got == N


def test_what_cannot_be_compensated_is_refused(recording: Recording, tmp_path: Path) -> None:
    save_recording(tmp_path / "none.h5", Recording(recording.events))
    few = Events.from_arrays([1], [2], [3], [1])
    save_recording(
        tmp_path / "small.h5", Recording(MemoryEvents(few, 32, 24), encoder=recording.encoder)
    )
    for name, options, message in (
        ("none", {}, "contains no encoder samples"),
        ("small", {}, "its sensor is 32x24"),
        ("none", {"wait_ms": -1.0}, "wait_ms"),
        ("none", {"counts_per_turn": 4096}, "counts_per_turn is given without port"),
        ("small", {"policy": "newest"}, "32x24"),
    ):
        opened = compensate_live(str(tmp_path / f"{name}.h5"), KNOWN, **options)  # type: ignore[arg-type]
        with pytest.raises(AmiwarpError, match=message):
            opened.__enter__()
    assert threads() == []
