"""Hostile and damaged bytes on both wires: each decodes or is one line of an error; and what a hello must be."""

from __future__ import annotations

import contextlib
import itertools
import json
import tracemalloc
from pathlib import Path

import pytest

from amiwarp import AmiwarpError
from amiwarp.live.link import ControllerStatus, Follower, FrameDecoder, Samples, Sync, encode
from amiwarp.live.link.protocol import LONGEST
from amiwarp.live.link.updates import MOST_UPDATES
from amiwarp.live.stream import HEADER, HELLO, MAGIC, Hello, PacketDecoder, StreamSource
from amiwarp.live.stream.stream_format import LONGEST_HELLO
from reference.mutation_frames import (
    CAMERA,
    mutated_serial,
    mutated_stream,
    packed,
    read_serial,
    read_stream,
)

SEEDS = 300


def refusal(data: bytes) -> str:
    """The error with which a stream is refused; empty for one that is read."""
    try:
        read_stream(data)
    except AmiwarpError as error:
        return str(error)
    return ""


def test_streams_are_read_or_refused_in_one_line() -> None:
    refusals = [refusal(mutated_stream(seed)) for seed in range(SEEDS)]
    assert SEEDS // 5 < refusals.count("") < SEEDS - SEEDS // 5
    assert all("\n" not in line and len(line) < 400 for line in refusals)


def test_some_mutated_streams_bring_samples_of_two_encoders(tmp_path: Path) -> None:
    """Read as they are, they would otherwise test nothing of the second encoder."""
    seconds = 0
    for seed in range(SEEDS // 3):
        (tmp_path / "s").write_bytes(mutated_stream(seed))
        with open(tmp_path / "s", "rb", buffering=0) as file, contextlib.suppress(AmiwarpError):
            source = StreamSource("the stream", file)
            for packet in source.packets():
                assert source.encoders == 2 or not packet.second_t.size
                seconds += len(packet.second_t) > 0
    assert seconds > SEEDS // 10


def test_any_bytes_of_a_serial_port_are_taken() -> None:
    assert sum(read_serial(mutated_serial(seed)) > 0 for seed in range(SEEDS)) > SEEDS // 3


def hello(text: str) -> Hello:
    (message,) = PacketDecoder("tcp:there").feed(packed(HELLO, 0, text.encode()))
    assert isinstance(message, Hello)
    return message


def test_a_whole_hello_is_understood() -> None:
    text = json.dumps(
        {"width": 64, "height": 48, "camera": CAMERA, "prism": None, "driver": {"any": [1, 2]}}
    )
    assert hello(text).width == 64
    assert hello('{"width": 64, "height": 48, "camera": null}').camera is None
    for encoders, count in ((1, 1), (2, 2), (None, 1)):
        assert (
            hello(json.dumps({"width": 64, "height": 48, "encoders": encoders})).encoders == count
        )


@pytest.mark.parametrize("value", ["0", "3", "2.0", "true", '"2"', "[2]", "-1", "9" * 400, "{}"])
def test_a_number_of_encoders_is_one_or_two(value: str) -> None:
    with pytest.raises(
        AmiwarpError, match=r"its hello attribute 'encoders' is .*; expected 1 or 2"
    ):
        hello(f'{{"width":64,"height":48,"encoders":{value}}}')


@pytest.mark.parametrize(
    "value", ["1e999", "1.5", "true", "-3", "0", "1e3", "65537", "9" * 3000, "null", '"64"', "[64]"]
)
def test_a_size_is_a_whole_number_in_range(value: str) -> None:
    for text in (f'{{"width":{value},"height":48}}', f'{{"width":64,"height":{value}}}'):
        with pytest.raises(
            AmiwarpError,
            match=r"tcp:there: packet at byte 0: its hello .*expected .*1 \.\. 65536|add this attribute",
        ):
            hello(text)


@pytest.mark.parametrize("value", ["NaN", "Infinity", "-Infinity", "9" * 5000])
def test_what_is_no_json_is_refused(value: str) -> None:
    with pytest.raises(AmiwarpError, match="its hello message is not JSON"):
        hello(f'{{"width":{value},"height":48}}')


@pytest.mark.parametrize(
    "text", ["[" * 60_000, '{"a":' * 12_000, '{"width":64,"height":48,"x":' + "[" * 50_000]
)
def test_deep_nesting_is_refused(text: str) -> None:
    assert len(text) <= LONGEST_HELLO
    with pytest.raises(AmiwarpError, match="nested too deeply"):
        hello(text)


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        ("fx", 1e999, "attribute 'fx' is Infinity"),
        ("cy", True, "attribute 'cy' is true"),
        ("fy", None, "no attribute 'fy'"),
        ("width", 64.0, "attribute 'width' is 64.0"),
        ("distortion", [0.1] * 9, "attribute 'distortion' is"),
        ("distortion", [0.1, "a"], "attribute 'distortion' is"),
        ("distortion_model", "a\nb", "attribute 'distortion_model' is"),
        ("distortion_model", 5, "attribute 'distortion_model' is 5"),
    ],
)
def test_a_camera_has_numbers_in_range(field: str, value: object, says: str) -> None:
    fields = {"width": 64, "height": 48, "camera": {**CAMERA, field: value}}
    text = json.dumps(fields).replace("Infinity", "1e999")
    with pytest.raises(AmiwarpError, match=f"its hello's camera.*{says}"):
        hello(text)


@pytest.mark.parametrize("part", ["camera", "prism"])
@pytest.mark.parametrize("value", ["5", "[]", '"x"', "false"])
def test_a_part_of_a_hello_is_an_object(part: str, value: str) -> None:
    with pytest.raises(AmiwarpError, match=f"its hello's {part} is .*; expected an object"):
        hello(f'{{"width":64,"height":48,"{part}":{value}}}')


@pytest.mark.parametrize(
    ("kind", "length"),
    [
        *itertools.product([*range(1, 8), 0, 9, 255], [(1 << 32) - 1, 1 << 31, 5_000_000]),
        *((8, length) for length in ((1 << 32) - 1, 1 << 31, (1 << 28) + 1)),  # a tensor
    ],
)
def test_a_length_is_bounded_before_anything_is_held(kind: int, length: int) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(AmiwarpError, match="expected up to"):
            list(PacketDecoder("it").feed(HEADER.pack(MAGIC, 1, kind, 0, (1 << 32) - 1, length, 0)))
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


def test_a_serial_decoder_holds_one_frame() -> None:
    for byte in (b"\1", b"5", b"\n"):
        decoder = FrameDecoder()
        for _ in range(200):
            assert decoder.feed(byte * 997) == []
            assert len(decoder._held) <= LONGEST


def test_a_controller_that_always_begins_anew_is_bounded() -> None:
    """Nobody takes the news: so many parts are kept, the oldest are dropped, and that is said."""
    follower = Follower("the port")
    sequence = 0
    for k in range(1000):
        messages = [
            ControllerStatus(k, 1, 0, 720.0, 720.0, 4096), Samples((k + 10,), (0,)), Sync(k + 11, k),
            Samples((k + 20,), (9000,)),
        ]  # fmt: skip
        for message in messages:
            follower.feed(encode(message, sequence), 1000 * k)
            sequence += 1
        sequence = (sequence - 40_000) & 0xFFFF  # backwards: it was reset
    assert len(follower.updates) <= MOST_UPDATES
    taken, said = 0, []
    for _ in range(MOST_UPDATES):
        news = follower.take()
        taken += len(news.t_us)
        said += news.messages
    assert 0 < taken <= 2 * MOST_UPDATES
    assert any("samples were dropped, the oldest" in message for message in said)
