"""Recording of a stream that one looks at, from a moment on."""

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from amiwarp import AmiwarpError, Camera, Events, Prism, open_recording
from amiwarp.live.stream import LiveSource, RecentEvents

SPEED = 720.0 * math.tau / 60e6
"""Speed of the prism [rad/us]."""


def source(encoders: int = 1) -> Any:
    """Return what a ring needs to know of a source."""
    camera = Camera.from_fov(120, 90, 1.0)
    return SimpleNamespace(size=(120, 90), camera=camera, prism=Prism(0.02), name="made", encoders=encoders,
                           metadata={"serial": "7"})  # fmt: skip


def put_events(ring: RecentEvents, start: int, stop: int) -> None:
    t = np.arange(start, stop, 500)
    ring.append(Events.from_arrays(np.full(t.size, 5), np.full(t.size, 6), t, np.zeros(t.size)))


def put_samples(ring: RecentEvents, start: int, stop: int, *, second: bool = False) -> None:
    t = np.arange(start, stop, 1000)
    turns = t[(t % 83_000) == 0]
    ring.append_encoder(t, t * SPEED, turns, second=second)


def followed_until(ring: RecentEvents, stop: int, lag_us: int = 0, begin: int = 0) -> None:
    for start in range(begin, stop, 50_000):
        put_samples(ring, start, start + 50_000)
        if start >= lag_us:
            put_events(ring, start - lag_us, start - lag_us + 50_000)


@pytest.mark.parametrize("lag_us", [0, 3_000_000])
def test_a_recording_holds_what_comes_from_its_start_on(tmp_path: Path, lag_us: int) -> None:
    ring = RecentEvents(source())
    followed_until(ring, 4_000_000, lag_us)
    live = LiveSource(ring, [])
    assert not live.is_recording
    path = tmp_path / "live.h5"
    live.record(path)
    assert live.is_recording
    followed_until(ring, 5_000_000, lag_us, begin=4_000_000)
    rows, _ = live.figures()
    assert ["recording", "live.h5: 2,000 events", ""] in rows
    with pytest.raises(AmiwarpError, match="is being recorded"):
        live.record(tmp_path / "other.h5")
    assert live.stop_recording() == f"{path}: 2,000 events"
    assert not live.is_recording
    assert live.stop_recording() == ""
    followed_until(ring, 5_200_000, lag_us, begin=5_000_000)
    found = open_recording(path)
    assert found.events.t_first == 4_000_000 - lag_us
    assert found.events.t_last == 4_999_500 - lag_us
    assert found.encoder is not None
    first, last = found.encoder.coverage
    # Late events have the angles that came before them
    assert first <= found.events.t_first - 10_000 or lag_us == 0
    assert first <= found.events.t_first + 1000
    assert last >= min(4_999_000, found.events.t_last)
    t = np.arange(found.events.t_first + 1000, found.events.t_last - 1000, 777)
    np.testing.assert_allclose(found.encoder.angle_at(t), t * SPEED, atol=1e-6)
    assert (found.camera, found.prism) == (source().camera, source().prism)
    assert found.metadata["recorded_from"] == "made"
    assert found.metadata["serial"] == "7"


def test_a_pair_of_prisms_is_recorded_with_both_encoders(tmp_path: Path) -> None:
    ring = RecentEvents(source(encoders=2))
    ring.record(tmp_path / "pair.h5")
    for start in range(0, 400_000, 50_000):
        put_samples(ring, start, start + 50_000)
        put_samples(ring, start, start + 50_000, second=True)
        put_events(ring, start, start + 50_000)
    ring.recorder.stop()
    found = open_recording(tmp_path / "pair.h5")
    assert found.encoder is not None
    assert found.encoder.second is not None


def test_an_existing_file_is_not_replaced_and_the_next_name_works(tmp_path: Path) -> None:
    ring = RecentEvents(source())
    followed_until(ring, 300_000)
    (tmp_path / "a.h5").write_bytes(b"mine")
    with pytest.raises(AmiwarpError, match=r"a\.h5"):
        ring.record(tmp_path / "a.h5")
    assert (tmp_path / "a.h5").read_bytes() == b"mine"
    ring.record(tmp_path / "b.h5")
    followed_until(ring, 600_000, begin=300_000)
    assert ring.recorder.stop().endswith("600 events")


def test_a_source_that_comes_back_ends_the_recording_and_says_why(tmp_path: Path) -> None:
    ring = RecentEvents(source())
    followed_until(ring, 300_000)
    live = LiveSource(ring, [])
    live.record(tmp_path / "a.h5")
    followed_until(ring, 400_000, begin=300_000)
    ring.restart()
    followed_until(ring, 200_000)  # another clock
    assert not live.is_recording
    row = next(row for row in live.figures()[0] if row[0] == "recording")
    assert row[1].startswith("ended: the source was opened again")
    assert row[2] == "bad"
    assert open_recording(tmp_path / "a.h5").events.t_last == 399_500


def test_an_error_of_the_disk_ends_the_recording_and_not_the_stream(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from amiwarp.io import LiveWriter

    ring = RecentEvents(source())
    followed_until(ring, 300_000)
    ring.record(tmp_path / "a.h5")
    followed_until(ring, 400_000, begin=300_000)

    def full(*_: object, **__: object) -> None:
        raise AmiwarpError("no space left")

    monkeypatch.setattr(LiveWriter, "append", full)
    followed_until(ring, 600_000, begin=400_000)
    assert ring.recorder.problem == "no space left"
    assert ring.recorder.text == ""
    found = ring.recording()
    assert found is not None
    assert found.events.t_last == pytest.approx(599_000, abs=1000)
    assert open_recording(tmp_path / "a.h5").events.t_last == 399_500
