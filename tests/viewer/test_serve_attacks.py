"""Hostile, slow and absent clients cannot harm the inspector's server. The tests speak the page's own protocol."""

import asyncio
import base64
import contextlib
import gc
import itertools
import math
import os
import random
import socket as sockets
import struct
import threading
import weakref
from collections.abc import AsyncIterator, Awaitable, Callable
from http.client import HTTPConnection
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import aiohttp
import msgpack
import numpy as np
import pytest

from amiwarp import AmiwarpError, Camera, Prism, Recording, simulate
from amiwarp.viewer import Inspector
from amiwarp.viewer import serve as server_module
from amiwarp.viewer.commands import exposure_warning
from amiwarp.viewer.host_names import HostNames, address, is_local, reachable
from amiwarp.viewer.layout import CALLS, SETTABLE
from amiwarp.viewer.page_messages import MOST_BYTES, MessageFilter
from amiwarp.viewer.page_work import MOST_IN_FLIGHT
from amiwarp.viewer.serve import serve
from tests.viewer.test_serve import COUNT, TOKEN, WAIT_S, Counters, get, origin_of, served, until

pytest.importorskip("trame_client")


@pytest.fixture(scope="module")
def recording(texture: np.ndarray) -> Recording:
    camera = Camera.from_fov(64, 48, math.radians(50))
    return simulate(texture, camera, Prism(math.radians(1.0)), duration_s=0.2, seed=1)


class Panels:
    """Builds a panel for each page, and keeps weak references to its objects; ``keep`` also keeps the panels."""

    def __init__(self, recording: Recording, *, keep: bool = True) -> None:
        self.recording, self.keep = recording, keep
        self.panels: list[Any] = []
        self.parts: list[weakref.ref[Any]] = []

    def __call__(self, server: Any) -> Callable[[], None]:
        from amiwarp.viewer import Panel

        panel = Panel(server, Inspector(self.recording))
        parts = (server, panel, panel.inspector)
        self.parts += map(weakref.ref, parts)
        if self.keep:
            self.panels.append(panel)
        return panel.close


def packed(call: Any) -> bytes:
    """Return a call as a message in one part."""
    body = msgpack.packb(call)
    return b"abcd" + struct.pack("<II", 0, len(body)) + body


class Client:
    """WebSocket client that uses the page's protocol."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.socket, self.calls = socket, itertools.count()

    async def send(self, method: Any, *args: Any, **more: Any) -> str:
        call = {
            "wslink": "1.0",
            "id": f"rpc:{next(self.calls)}",
            "method": method,
            "args": list(args),
            "kwargs": {},
        }
        await self.socket.send_bytes(packed({**call, **more}))
        return str(call["id"])

    async def call(self, method: str, *args: Any, **more: Any) -> Any:
        """Send a call and return the answer."""
        wanted = await self.send(method, *args, **more)
        async with asyncio.timeout(WAIT_S):
            async for message in self.socket:
                answer = msgpack.unpackb(message.data[12:])
                if answer["id"] in (wanted, more.get("id")):
                    return answer.get("result", answer.get("error"))
        raise AssertionError(f"closed with {self.socket.close_code}")

    async def state(self) -> dict[str, Any]:
        return dict((await self.call("trame.state.get"))["state"])

    async def settled(self) -> dict[str, Any]:
        """Return the state once no part of the page waits for an update."""
        while (state := await self.state())["updating"] or not state["sharpness"]:
            await asyncio.sleep(0.02)
        return state


@contextlib.asynccontextmanager
async def client(url: str) -> AsyncIterator[Client]:
    """Open a connection like a page's, including the initial greeting."""
    origin = origin_of(url)
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(url + "ws", headers={"Origin": origin}, max_msg_size=0) as socket,
    ):
        made = Client(socket)
        await made.call("wslink.hello", {"secret": "wslink-secret"}, id="system:0")
        yield made


def run(work: Callable[[], Awaitable[None]]) -> None:
    asyncio.run(asyncio.wait_for(work(), 2 * WAIT_S))


async def until_async(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(WAIT_S):
        while not condition():
            await asyncio.sleep(0.02)


# what a page may call

JUNK: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2**63, -(2**63), 1e308, -1e308, math.nan, math.inf, -math.inf, "", "1", "nan", "1e999",
    "x" * 5000, "../../x", "/etc/passwd", "__class__", "\x00", "\x1b[2J", b"\xff" * 100, [], [[]], [[[1]]], {},
    {"a": {"b": []}}, {"key": "out"}, [math.nan, 1], [1, 2, 3], ["a", "b"], [-5, 1e300], "trigger__1", "viewport",
)  # fmt: skip
METHODS = (
    "trame.state.update", "trame.trigger", "trame.force.push", "trame.state.get", "trame.lifecycle.update",
    "trame.error.client", "application.exit", "application.exit.later", "viewport.image.push",
    "viewport.image.push.original.size", "viewport.image.push.quality", "viewport.image.push.observer.add",
    "viewport.image.push.observer.remove", "viewport.image.push.invalidate.cache", "viewport.image.animation.start",
    "viewport.image.animation.stop", "viewport.image.animation.fps.max", "viewport.mouse.interaction",
    "viewport.mouse.zoom.wheel", "viewport.camera.reset", "viewport.camera.update", "viewport.geometry.array.get",
    "viewport.geometry.view.get.state", "viewport.geometry.view.get.export", "wslink.hello", "nothing",
)  # fmt: skip


def nested(depth: int) -> Any:
    value: Any = 1
    for _ in range(depth):
        value = [value]
    return value


def test_junk_changes_nothing_and_the_page_goes_on(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture,
    capfd: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """Send junk to each method, state variable and trigger, and bytes that are not messages."""
    monkeypatch.chdir(tmp_path)
    build, rng = Panels(recording), random.Random(7)

    async def attack(url: str) -> None:
        async with client(url) as page:
            first = await page.settled()
            view = "1"
            for method in METHODS:
                for junk in JUNK:
                    await page.send(method, junk)
                    await page.send(method, view, junk, rng.choice(JUNK))
                    await page.send(
                        method,
                        {"view": view, "action": junk, "x": junk, "type": junk, "spinY": junk},
                    )
                await page.send(method, nested(400))
                await page.send(method, kwargs={"self": 1})
            for name in (*first, "trame__scripts", "_x", "__dict__", ""):
                for junk in JUNK:
                    if name not in SETTABLE or not SETTABLE[name](junk):
                        await page.send("trame.state.update", [{"key": name, "value": junk}])
            for name in (*CALLS, "close", "trigger__1"):
                for junk in JUNK:
                    if not isinstance(junk, str | int | float):
                        await page.send("trame.trigger", name, [junk], {})
                        await page.send("trame.trigger", name, junk or None, {})
                    await page.send("trame.trigger", name, [junk, junk, junk], {})
                    await page.send("trame.trigger", name, ["apex", junk], {"x": junk})
            for _ in range(300):
                await page.socket.send_bytes(rng.randbytes(rng.randrange(200)))
                await page.socket.send_bytes(packed(rng.choice(JUNK)))
                await page.socket.send_str("text")
            for call in (
                {"id": []},
                {"id": "a", "method": []},
                {"method": "trame.state.get"},
                {"id": 5, "method": 5},
            ):
                await page.socket.send_bytes(packed(call))
            await page.socket.send_bytes(b"abcd" + struct.pack("<II", 0, 2**32 - 1) + b"huge")
            await page.socket.send_bytes(b"abcd" + struct.pack("<II", 2**31, 10) + b"x")
            after = await page.settled()
            assert after.keys() == first.keys()
            changed = {name for name in first if first[name] != after[name]}
            # "a is no number"
            assert changed <= {
                "curve",
                "curve_mark",
                "updating",
                "knob",
                "message",
                "severity",
            }
            await page.send("trame.trigger", "slide", ["apex", 0.5], {})
            sharpness = after["sharpness"]
            while sharpness == after["sharpness"]:
                sharpness = (await page.state())["sharpness"]

    with served(build, SETTABLE) as (url, _):
        run(lambda: attack(url))
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []
    said = [record.getMessage() for record in caplog.records]
    assert [text for text in said if not text.startswith("the page reports ")] == [
        text for text in said if "no page sends" in text
    ]
    assert sum("no page sends" in text for text in said) == 1
    assert all(text.isprintable() for text in said)
    assert "Traceback" not in capfd.readouterr().err


def test_all_that_the_page_may_set_leaves_it_alive(
    recording: Recording, caplog: pytest.LogCaptureFixture
) -> None:
    """Send the extreme values that the filter allows, to every variable and trigger."""
    build = Panels(recording)

    async def attack(url: str) -> None:
        async with client(url) as page:
            first = await page.settled()
            allowed = [
                *JUNK,
                *range(9),
                *itertools.chain(*(check_values(first, name) for name in SETTABLE)),
            ]
            for name, check in SETTABLE.items():
                for value in (each for each in allowed if check(each)):
                    await page.call("trame.state.update", [{"key": name, "value": value}])
                await page.call("trame.state.update", [{"key": name, "value": first[name]}])
            for name in (
                "apex",
                "start_ms",
                "length_ms",
                "turns",
                "rpm",
                "message",
                "trame__title",
                "__class__",
            ):
                for text in (
                    "",
                    "nan",
                    "inf",
                    "-inf",
                    "1e308",
                    "-1e308",
                    "1e-308",
                    "x",
                    "0x10",
                    "1_0",
                    "٣",
                ):
                    await page.call("trame.trigger", "typed", [name, text], {})
            for name in CALLS:
                for plain in ("", "c", "?", "__class__", "apex", 0, -1, 1e12, True):
                    for args in ([], [plain], [plain] * 2, [plain] * 4):
                        await page.send("trame.trigger", name, args, {})
            for _ in range(7):  # plays and stops at once
                await page.call("trame.trigger", "key", [" "], {})
            await page.call("trame.trigger", "key", [" "], {})
            await until_async(lambda: not build.panels[0].plays)
            for name, value in first.items():
                if name in SETTABLE and SETTABLE[name](value):
                    await page.call("trame.state.update", [{"key": name, "value": value}])
            await page.call("trame.trigger", "reset", [], {})
            while (await page.settled())["sharpness"] != first["sharpness"]:
                await page.call("trame.trigger", "reset", [], {})

    with served(build, SETTABLE) as (url, _):
        run(lambda: attack(url))
    assert [
        text
        for text in (record.getMessage() for record in caplog.records)
        if "no page sends" not in text
    ] == []


def check_values(state: dict[str, Any], name: str) -> list[Any]:
    """Return values to try for a state variable, its current value included."""
    value = state[name]
    return [
        value,
        1e12,
        -1e12,
        [65536, 0],
        [0, 0],
        0.01,
        "OFF",
        "circle",
        "residual",
        "time",
        "x-θ",
        "a" * 200,
    ]


def test_numbers_that_are_none_do_not_pass() -> None:
    for name, check in SETTABLE.items():
        assert not any(
            check(value) for value in (math.nan, math.inf, None, b"x", {}, "\ud800" * 300)
        ), name
        assert SETTABLE["point_size"](1) and not SETTABLE["point_size"](True)  # noqa: PT018


# sizes


def upgraded(url: str) -> sockets.socket:
    """Open a WebSocket as a raw TCP socket."""
    parts = urlsplit(url)
    raw = sockets.create_connection((parts.hostname, parts.port), timeout=WAIT_S)
    key = base64.b64encode(os.urandom(16)).decode()
    raw.sendall(
        f"GET {parts.path}ws HTTP/1.1\r\nHost: {parts.netloc}\r\nOrigin: http://{parts.netloc}\r\n"
        f"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {key}\r\n\r\n"
        .encode()
    )  # fmt: skip
    head = b""
    while not head.endswith(b"\r\n\r\n"):
        head += raw.recv(1)
    assert head.startswith(b"HTTP/1.1 101")
    return raw


def closing_code(raw: sockets.socket) -> int:
    """Read WebSocket frames until the closing one, and return its code."""
    with raw, raw.makefile("rb") as stream:
        while True:
            first, second = stream.read(2)
            length = second & 127
            if length > 125:
                length = int.from_bytes(stream.read(2 if length == 126 else 8), "big")
            body = stream.read(length)
            if first & 15 == 8:
                return int.from_bytes(body[:2], "big")


def test_a_large_message_is_refused_before_it_has_come() -> None:
    """The test sends only the header with the length; the server must not wait for the rest."""
    with served(Counters()) as (url, _):
        raw = upgraded(url)
        raw.sendall(bytes([0x82, 0x80 | 127]) + struct.pack(">Q", MOST_BYTES + 1) + b"mask")
        assert closing_code(raw) == 1009


def test_a_large_message_in_pieces_is_refused() -> None:
    with served(Counters()) as (url, _):
        raw = upgraded(url)
        for k in range(5):
            raw.sendall(
                bytes([0x02 if k == 0 else 0x00, 0x80 | 126])
                + struct.pack(">H", MOST_BYTES // 4)
                + b"\0" * 4
            )
            with contextlib.suppress(ConnectionError):  # closed meanwhile
                raw.sendall(b"x" * (MOST_BYTES // 4))
            if k == 3:
                break
        raw.sendall(bytes([0x00, 0x80 | 126]) + struct.pack(">H", 100) + b"mask")
        assert closing_code(raw) == 1009


def test_bodies_are_refused_before_they_have_come() -> None:
    with served(Counters()) as (url, _):
        parts = urlsplit(url)
        for method, status in (("GET", 413), ("POST", 413), ("PUT", 413)):
            connection = HTTPConnection(parts.netloc, timeout=WAIT_S)
            connection.putrequest(method, parts.path)
            connection.putheader("Content-Length", str(2**40))
            connection.endheaders()
            answer = connection.getresponse()
            assert (answer.status, answer.getheader("Connection")) == (status, "close")
            connection.close()


# who may speak


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1.evil.example", "192.0.2.7", "0.0.0.0", "a b", ""]
)
def test_other_names_are_not_served(host: str) -> None:
    """A foreign page whose name resolves to this machine (DNS rebinding) sends its own name in ``Host``."""
    build = Counters()
    with served(build) as (url, _):
        parts = urlsplit(url)
        for path in (parts.path, parts.path + "ws"):
            for name in (host, f"{host}:{parts.port}"):
                connection = HTTPConnection(parts.netloc, timeout=WAIT_S)
                connection.putrequest("GET", path, skip_host=True)
                connection.putheader("Host", name)
                connection.putheader("Origin", f"http://{name}")
                connection.endheaders()
                assert connection.getresponse().status in (400, 403)
                connection.close()
    assert build.servers == []


@pytest.mark.parametrize("name", ["localhost", "LOCALHOST", "127.0.0.1", "[::1]"])
def test_its_own_names_are_served(name: str) -> None:
    """Each name is also accepted with another port, as through an SSH tunnel."""
    with served(Counters()) as (url, _):
        parts = urlsplit(url)
        for port in (parts.port, 4321):
            connection = HTTPConnection(parts.netloc, timeout=WAIT_S)
            connection.putrequest("GET", parts.path, skip_host=True)
            connection.putheader("Host", f"{name}:{port}")
            connection.endheaders()
            assert connection.getresponse().status == 200
            connection.close()


@pytest.mark.parametrize(
    "origin",
    ["https://127.0.0.1:{port}", "http://127.0.0.1", "http://localhost:{port}", "127.0.0.1:{port}"],
)
def test_an_origin_has_scheme_and_port(origin: str) -> None:
    async def connect(url: str) -> int:
        headers = {"Origin": origin.format(port=urlsplit(url).port)}
        async with aiohttp.ClientSession() as session:
            try:
                async with session.ws_connect(url + "ws", headers=headers):
                    return 101
            except aiohttp.WSServerHandshakeError as error:
                return error.status

    build = Counters()
    with served(build) as (url, _):
        assert asyncio.run(connect(url)) == 403
    assert build.servers == []


def test_the_token_goes_to_no_other_page() -> None:
    with served(Counters()) as (url, _):
        parts = urlsplit(url)
        for path, status in (("/", 403), (parts.path, 200), (f"{parts.path}none", 404)):
            connection = HTTPConnection(parts.netloc, timeout=WAIT_S)
            connection.request("GET", path)
            answer = connection.getresponse()
            assert (answer.status, answer.getheader("Referrer-Policy")) == (status, "no-referrer")
            assert TOKEN not in answer.read().decode()
            connection.close()


# where it is served


def test_an_address_that_can_be_opened_is_given() -> None:
    assert address("0.0.0.0", 80, TOKEN).startswith(f"http://{reachable('0.0.0.0')}")
    assert reachable("0.0.0.0") not in ("0.0.0.0", "")
    assert reachable("::") not in ("::", "")
    assert address("::1", 8080, "t") == address("[::1]", 8080, "t") == "http://[::1]:8080/t/"
    assert address("localhost", 8080, "t") == "http://localhost:8080/t/"
    with served(Counters(), host="0.0.0.0") as (url, _):
        assert urlsplit(url).hostname == reachable("0.0.0.0")
        parts = urlsplit(url)
        assert get(f"http://127.0.0.1:{parts.port}", parts.path)[0] == 200
        assert get(url, parts.path)[0] == 200


@pytest.mark.parametrize(
    "host", ["0.0.0.0", "::", "[::]", "0", "192.168.1.5", "example.org", "fe80::1"]
)
def test_others_can_reach_it_and_that_is_said(host: str) -> None:
    text = exposure_warning(host)
    assert text is not None
    assert host in text
    assert "everybody on the network" in text
    assert not is_local(host)


@pytest.mark.parametrize(
    "host", ["127.0.0.1", "localhost", "::1", "[::1]", "127.0.0.2", "LocalHost"]
)
def test_this_machine_alone_needs_no_warning(host: str) -> None:
    assert exposure_warning(host) is None


@pytest.mark.parametrize(
    ("host", "says"),
    [
        ("192.0.2.1", "not an address of this machine"),
        ("no.such.host.invalid", "unknown name"),
        ("  ", "host is empty"),
    ],
)
def test_a_host_that_is_not_here_is_one_error(host: str, says: str) -> None:
    with pytest.raises(AmiwarpError, match=says) as error:
        asyncio.run(serve(Counters(), settable=COUNT, token=TOKEN, host=host))
    assert "\n" not in str(error.value)


def test_an_occupied_port_is_one_error() -> None:
    with sockets.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(AmiwarpError, match=f"--port {port}: is in use") as error:
            asyncio.run(serve(Counters(), settable=COUNT, token=TOKEN, port=port))
    assert "\n" not in str(error.value)


def test_names_of_a_host_that_others_reach() -> None:
    names = HostNames("0.0.0.0")
    assert sockets.gethostname().lower() in names.known
    assert "0.0.0.0" not in names.known
    assert sockets.gethostname().lower() not in HostNames("127.0.0.1").known - {"localhost"}


# slow and absent pages, many of them


class Unread:
    """WebSocket whose other end takes three messages, then nothing until it disconnects."""

    def __init__(self) -> None:
        self.taken, self.gone = 0, asyncio.Event()

    async def send_bytes(self, content: bytes) -> None:
        self.taken += 1
        if self.taken > 3:
            await self.gone.wait()
            raise ConnectionResetError


def test_for_a_page_that_takes_nothing_nothing_more_is_computed(
    recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Meanwhile everything that causes updates goes on: parameters, looks, playback."""
    build = Panels(recording)

    async def work() -> None:
        unread = Unread()
        async with server_module._connection(build, {}, unread) as (server, connection):  # type: ignore[arg-type]
            panel, monitor, waiting, computed = (
                build.panels[0],
                server.protocol.network_monitor,
                [0],
                [0],
            )
            show = panel.inspector.show
            monkeypatch.setattr(
                panel.inspector, "show", lambda **given: (computed.append(1), show(**given))[1]
            )
            message = packed(
                {"id": "system:0", "method": "wslink.hello", "args": [{"secret": "wslink-secret"}]}
            )
            assert MessageFilter(server, SETTABLE).passes(message)
            await connection.send(True, aiohttp.WSMessage(aiohttp.WSMsgType.BINARY, message, None))
            panel.state.update({"playing": False, "loop": True, "speed": 10})
            panel.play()
            await until_async(lambda: monitor.pending > MOST_IN_FLIGHT)
            computed.clear()
            for number in range(200):
                panel.state.dark = bool(number % 2)
                panel.request("look")
                await asyncio.sleep(0.01)
                waiting.append(monitor.pending)
            assert len(computed) <= 1  # an update that had already started
            assert max(waiting) < 3 * MOST_IN_FLIGHT
            unread.gone.set()

    run(work)


def test_tabs_are_bounded_and_the_next_one_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module, "MOST_TABS", 2)
    build = Counters()

    async def attack(url: str) -> None:
        async with client(url) as one, client(url) as two:
            assert [(await each.state())["count"] for each in (one, two)] == [0, 0]
            async with client(url) as three, client(url):
                assert "tabs of this inspector are open" in (await three.state())["failure"]
                with pytest.raises(aiohttp.WSServerHandshakeError, match="503"):
                    async with client(url):
                        pass
            await two.socket.close()
            await until_async(lambda: build.closed == 1)
            async with client(url) as four:
                assert (await four.state())["count"] == 0

    with served(build) as (url, _):
        run(lambda: attack(url))
    assert len(build.servers) == build.closed == 3


def native_threads() -> int:
    """Return the number of threads that Python does not manage."""
    tasks = Path("/proc/self/task")
    return len(list(tasks.iterdir())) - threading.active_count() if tasks.is_dir() else 0


def test_closed_tabs_give_back_threads_and_memory(recording: Recording) -> None:
    build = Panels(recording, keep=False)
    gc.collect()

    async def visit(url: str, count: int) -> None:
        async with contextlib.AsyncExitStack() as stack:
            pages = [await stack.enter_async_context(client(url)) for _ in range(count)]
            for page in pages:
                await page.call("trame.trigger", "key", ["c"], {})
                while not ((state := await page.state())["curve"]["x"] and state["after"]):
                    await asyncio.sleep(0.02)
                await page.call("trame.trigger", "key", ["c"], {})

    def ours() -> list[str]:
        return [
            thread.name for thread in threading.enumerate() if thread.name.startswith("amiwarp-tab")
        ]

    with served(build, SETTABLE) as (url, _):
        run(lambda: visit(url, 1))
        until(lambda: all(part() is None for part in build.parts) and not ours())
        before = native_threads()
        for _ in range(2):
            run(lambda: visit(url, 2))
            until(lambda: all(part() is None for part in build.parts) and not ours())
            until(lambda: native_threads() <= before)
    assert len(build.parts) == 5 * 3
    assert ours() == []
