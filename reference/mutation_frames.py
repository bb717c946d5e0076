"""Damaged and hostile bytes for the packet stream and the serial port, made from a seed, and readers for them.

``mutated_stream(seed)`` makes bytes of a packet stream, ``mutated_serial(seed)`` bytes of the controller's serial port.
Rule for each seed: :func:`read_stream` and :func:`read_serial` return or raise :class:`AmiwarpError`, nothing else.
"""

from __future__ import annotations

import json
import math
import random
import struct
import tempfile
import zlib
from collections.abc import Callable

import numpy as np

from amiwarp.events.encoder import LARGEST_ANGLE
from amiwarp.live.link.follower import Follower
from amiwarp.live.link.protocol import (
    LONGEST,
    Answer,
    ControllerStatus,
    FrameDecoder,
    Index,
    Message,
    Ping,
    Pong,
    Samples,
    SetSpeed,
    Sync,
    encode,
)
from amiwarp.live.stream.stream_format import (
    COLUMNS,
    END,
    EVENTS,
    HEADER,
    HELLO,
    MAGIC,
    SECOND_ENCODER,
    PacketDecoder,
)
from amiwarp.live.stream.stream_source import StreamSource

WIDTH, HEIGHT = 64, 48
WHOLE = [0, 1, 2, 255, 256, 65535, 65536, (1 << 31) - 1, 1 << 31, (1 << 32) - 1]
TIMES = [
    0,
    -1,
    1,
    1 << 31,
    1 << 40,
    1 << 60,
    (1 << 60) + 1,
    1 << 62,
    (1 << 63) - 1,
    -(1 << 63),
    -(1 << 60),
]
ANGLES = [
    0.0,
    -1e3,
    LARGEST_ANGLE,
    1.1 * LARGEST_ANGLE,
    1e308,
    -1e308,
    math.inf,
    -math.inf,
    math.nan,
    5e-324,
]
NUMBERS = [
    "1e999",
    "-1e999",
    "NaN",
    "Infinity",
    "true",
    "1.5",
    "-3",
    "0",
    "1e400",
    "9" * 400,
    '"64"',
    "null",
    "[]",
    "{}",
]
CAMERA = {"width": WIDTH, "height": HEIGHT, "fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5}


def packed(kind: int, count: int, payload: bytes, **wrong: int) -> bytes:
    """Return one packet. Its header is right, except for the fields in ``wrong``."""
    fields = {
        "version": 1,
        "zero": 0,
        "length": len(payload),
        "check": zlib.crc32(payload),
        **wrong,
    }
    return (
        HEADER.pack(
            MAGIC, fields["version"], kind, fields["zero"], count, fields["length"], fields["check"]
        )
        + payload
    )


def hello(rng: random.Random, encoders: int) -> bytes:
    """Return a hello packet, invalid in a quarter of the cases."""
    camera = {**CAMERA, "distortion_model": "none"}
    fields = {
        "width": WIDTH,
        "height": HEIGHT,
        "camera": camera,
        "prism": {"apex": 0.03, "index": 1.5},
    }
    if encoders == 2 or rng.random() < 0.5:
        fields["encoders"] = encoders
    text = json.dumps(fields)
    what = rng.randrange(20)
    if what == 0:
        name = rng.choice(
            ["width", "height", "fx", "cy", "apex", "index", *["encoders"] * ("encoders" in fields)]
        )
        start = text.index(f'"{name}": ') + len(name) + 4
        stop = start + next(k for k, c in enumerate(text[start:]) if c in ",}")
        text = text[:start] + rng.choice(NUMBERS) + text[stop:]
    elif what == 1:
        depth = rng.choice([10, 500, 3000, 30_000])
        text = rng.choice(
            [
                '{"a":' * (depth // 3),
                "[" * depth,
                "[" * depth + "]" * depth,
                '{"width":' + "[" * depth,
            ]
        )
    elif what == 2:
        part = rng.choice(
            ["camera", "prism", "encoders", "distortion", "distortion_model", "flat_side"]
        )
        value = rng.choice(
            [
                5,
                [],
                [1, "a"],
                [math.inf] * 9,
                "x" * 5000,
                "a\nb",
                True,
                {"width": {}},
                [[]] * 4,
                None,
            ]
        )
        place = (
            fields
            if part in (*fields, "encoders")
            else camera
            if part.startswith("dist")
            else fields["prism"]
        )
        place[part] = value  # type: ignore[index]
        text = json.dumps(fields)
    elif what == 3:
        text = rng.choice(
            [
                "",
                "null",
                "[]",
                "3",
                "{",
                '{"width":64}',
                '"' * 9,
                "\ud800".encode("utf-8", "surrogatepass").decode("latin1"),
            ]
        )
    elif what == 4:
        return packed(HELLO, 0, rng.randbytes(rng.randrange(200)))
    return packed(HELLO, rng.choice([0, 0, 7]), text.encode())


def rows(kind: int, rng: random.Random, at: int) -> bytes:
    """Return a packet of columns, sometimes with values beyond their limits."""
    n = rng.choice([0, 1, 3, 100])
    columns = []
    for k, dtype in enumerate(COLUMNS[kind]):
        if k == 0:
            column = (
                at + np.sort(np.array([rng.randrange(3000) for _ in range(n)], np.int64))
            ).astype(dtype)
        elif dtype in ("<f8", "<f4"):
            column = np.array([at * 7e-6 + 0.1 * i for i in range(n)]).astype(dtype)
        else:
            column = np.array(
                [rng.randrange(2 if dtype == "u1" else HEIGHT) for _ in range(n)]
            ).astype(dtype)
        if n and rng.random() < 0.01:
            wild = {"<i8": TIMES, "<f8": ANGLES, "<f4": ANGLES[:4]}.get(dtype, [255])
            column[rng.randrange(n)] = rng.choice(wild)
        columns.append(column.tobytes())
    return packed(kind, n, b"".join(columns))


def wild_header(rng: random.Random) -> bytes:
    """Return a header with wrong sizes."""
    payload = rng.randbytes(rng.choice([0, 8, 64]))
    name = rng.choice(["length", "check", "version", "zero"])
    value = rng.choice(WHOLE) & {"version": 0xFF, "zero": 0xFFFF}.get(name, 0xFFFFFFFF)
    return packed(rng.randrange(256), rng.choice(WHOLE), payload, **{name: value})


def mutated_stream(seed: int) -> bytes:
    """Return a mostly valid packet stream, then changed in its packets, in its bytes, or not at all."""
    rng = random.Random(f"stream {seed}")
    encoders, at = rng.choice([1, 2]), rng.choice([0, 5_000_000, 1 << 50])
    parts = [hello(rng, encoders)]
    for _ in range(rng.choice([1, 5, 20])):
        if rng.random() < 0.01:
            parts.append(wild_header(rng))
        second = SECOND_ENCODER if encoders == 2 or rng.random() < 0.02 else 5
        parts.append(
            rows(
                rng.choice([EVENTS, EVENTS, 4, 5, second, 3 if rng.random() < 0.05 else 5]), rng, at
            )
        )
        at += rng.choice([3000, 3000, 3000, -20_000, 10_000_000])
    if rng.random() < 0.7:
        parts.append(packed(END, 0, b""))
    for change in (
        rng.shuffle,
        lambda p: p.append(p[0]),
        lambda p: p.insert(rng.randrange(len(p)), rng.choice(p)),
    ):
        if rng.random() < 0.1:
            change(parts)
    stream = b"".join(parts)
    return damaged(stream, rng) if rng.random() < 0.4 else stream


def frames(rng: random.Random) -> list[bytes]:
    """Return frames of a controller. Some hold extreme numbers, some are lost, some date from before a reset."""
    out, sequence, t = [], rng.randrange(1 << 16), rng.choice([0, (1 << 32) - 50_000])
    count = 0
    number = lambda: rng.choice(WHOLE)  # noqa: E731
    for _ in range(rng.choice([5, 40, 200])):
        t, count = (t + 1000) % (1 << 32), count + 49
        if rng.random() < 0.03:
            t, count = number(), rng.choice([0, (1 << 31) - 1, -(1 << 31), 12345])
        signed = (count + (1 << 31)) % (1 << 32) - (1 << 31)
        speed = rng.choice([720.0, 0.0, math.nan, math.inf, -math.inf, 1e-45, 3e38])
        message: Message = rng.choice(
            [Samples((t,), (signed,)), Samples((t,) * 3, (signed,) * 3), Index(t, signed), Sync(t, number()),
             ControllerStatus(t, rng.randrange(256), rng.randrange(1 << 16), speed, 720.0,
                              rng.choice([4096, 4096, 0, number()])),
             Pong(rng.choice([1, 2, 3, 4, number()]), t), Answer(rng.randrange(1 << 16), rng.randrange(256)),
             Ping(number()), SetSpeed(speed, speed)]
        )  # fmt: skip
        sequence = rng.choice([sequence + 1] * 20 + [sequence + 9, 0, sequence - 1])
        out.append(encode(message, sequence & 0xFFFF))
    return out


def lines(rng: random.Random) -> list[bytes]:
    """Return text lines of a controller, with invalid lines among them."""
    out, t = [b"rest of a line\n"], rng.choice([0, (1 << 32) - 9000])
    for k in range(rng.choice([5, 60])):
        t += 1000
        wild = [
            b"time,count\n",
            b",\n",
            b"9" * 4000 + b",1\n",
            b"-1,5\n",
            b"4294967295,-2147483648\r\n",
            b"1,2,3\n",
            b"\n",
            b"\0",
        ]
        out.append(
            rng.choice([*wild, b"%d,%d\n" % (rng.choice(WHOLE), 1)])
            if rng.random() < 0.1
            else b"%d,%d\n" % (t, 9 * k)
        )
    return out


def mutated_serial(seed: int) -> bytes:
    """Return bytes of a serial port: frames, lines or noise, then damaged."""
    rng = random.Random(f"serial {seed}")
    made: Callable[[random.Random], list[bytes]] = rng.choice([frames, frames, lines])
    parts = made(rng)
    if rng.random() < 0.2:
        parts.insert(
            rng.randrange(len(parts)),
            rng.choice([rng.randbytes(3000), b"\1" * 5000, b"\0" * 3000, b"\n" * 2000]),
        )
    if rng.random() < 0.1:
        rng.shuffle(parts)
    return damaged(b"".join(parts), rng)


def damaged(data: bytes, rng: random.Random) -> bytes:
    """Return the bytes with up to three changes."""
    out = bytearray(data)
    for _ in range(rng.choice([0, 0, 1, 3])):
        if not out:
            break
        at = rng.randrange(len(out))
        what = rng.randrange(6)
        if what == 0:
            del out[at:]
        elif what == 1:
            out[at] ^= 1 << rng.randrange(8)
        elif what == 2:
            out[at:at] = rng.randbytes(rng.randrange(1, 40))
        elif what == 3:
            del out[at : at + rng.randrange(1, 40)]
        elif what == 4:
            out[at : at + 4] = struct.pack("<I", rng.choice(WHOLE))[: len(out) - at]
        else:
            other = rng.randrange(len(out))
            out[at:at] = out[other : other + rng.choice([1, 20, 300])]
    return bytes(out)


def read_stream(data: bytes) -> int:
    """Read a stream as ``amiwarp record`` does. Return the number of packets. Raises :class:`AmiwarpError`."""
    decoder = PacketDecoder("the stream")
    with tempfile.TemporaryFile(buffering=0) as file:
        file.write(data)
        file.seek(0)
        source = StreamSource("the stream", file)
        count = sum(1 for _ in source.packets())
    for _ in decoder.feed(data):
        assert len(decoder.free_buffer()) < 1 << 23
    return count


def read_serial(data: bytes) -> int:
    """Read bytes of a serial port as :class:`Link` does. Return the number of samples."""
    decoder, follower, count = FrameDecoder(), Follower("the port", 4096), 0
    follower.opened(0)
    for n, start in enumerate(range(0, len(data), 61)):
        part = data[start : start + 61]
        decoder.feed(part)
        assert len(decoder._held) <= LONGEST
        if follower.speaks:
            follower.pinged(n, 1000 * n)
        follower.feed(part, 1000 * n)
        follower.clock()
        if n % 7 == 0:
            count += len(follower.take().t_us)
    while len(news := follower.take().t_us):
        count += len(news)
    return count


def frames_in(data: bytes, wire: str) -> int:
    """Return the approximate number of packets or messages in some bytes."""
    if wire == "stream":
        return max(data.count(MAGIC), 1)
    return max(data.count(b"\0"), data.count(b"\n"), 1)
