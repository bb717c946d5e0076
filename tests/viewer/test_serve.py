"""The viewer's server in a real browser: independent tabs, closed tabs, errors shown, foreign clients refused."""

import asyncio
import gc
import os
import socket
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from http.client import HTTPConnection
from typing import Any
from urllib.parse import urlsplit

import pytest

from amiwarp import AmiwarpError
from amiwarp.viewer import serve as serve_module
from amiwarp.viewer.page_messages import Check, number
from amiwarp.viewer.serve import Session, serve

pytest.importorskip("trame_client")
TOKEN = "s3cret & more"
WAIT_S = 120.0
"""Timeout of every wait [s]; on an idle machine each takes less than a second."""
COUNT = {"count": number()}


@contextmanager
def served(
    build: Session, settable: Mapping[str, Check] = COUNT, **more: Any
) -> Iterator[tuple[str, asyncio.AbstractEventLoop]]:
    """Serve in a thread; yield the URL and the event loop."""
    urls: list[str] = []
    started: list[tuple[asyncio.AbstractEventLoop, asyncio.Task[None]]] = []
    listening = threading.Event()

    async def main() -> None:
        serving = serve(
            build,
            settable=settable,
            token=TOKEN,
            ready=lambda url: (urls.append(url), listening.set()),
            **more,
        )
        task = asyncio.ensure_future(serving)
        started.append((asyncio.get_running_loop(), task))
        await asyncio.wait([task])

    thread = threading.Thread(target=asyncio.run, args=(main(),))
    thread.start()
    try:
        assert listening.wait(WAIT_S)
        yield urls[0], started[0][0]
    finally:
        started[0][0].call_soon_threadsafe(started[0][1].cancel)
        thread.join()


def origin_of(url: str) -> str:
    """Return scheme, host and port of a URL, as browsers send them in ``Origin``."""
    return "{0.scheme}://{0.netloc}".format(urlsplit(url))


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def get(url: str, path: str) -> tuple[int, str, str | None]:
    """Return status, text and cookie of a request for ``path`` at the server of ``url``; the path is sent unchanged."""
    connection = HTTPConnection(urlsplit(url).netloc, timeout=WAIT_S)
    try:
        connection.request("GET", path)
        answer = connection.getresponse()
        return answer.status, answer.read().decode(), answer.getheader("Set-Cookie")
    finally:
        connection.close()


def opened(context: Any) -> Any:
    """Return a new page with a timeout long enough for a busy machine."""
    page = context.new_page()
    page.set_default_timeout(1e3 * WAIT_S)
    return page


class Counters:
    """Page with a button that counts in the browser, and a text from the server with twice the count."""

    def __init__(self) -> None:
        self.servers: list[weakref.ref[Any]] = []
        self.closed = 0

    def __call__(self, server: Any) -> Callable[[], None]:
        from trame.ui.html import DivLayout
        from trame.widgets import html

        self.servers.append(weakref.ref(server))
        server.state.count = 0

        @server.state.change("count")
        def _(count: int, **_: Any) -> None:
            server.state.double = 2 * count

        with DivLayout(server):
            html.Button("{{ count }}", click="count += 1")
            html.Div("{{ double }}", id="double")
        return self.close

    def close(self) -> None:
        self.closed += 1

    def forgotten(self) -> bool:
        gc.collect()
        return all(server() is None for server in self.servers)


def test_without_the_token_nothing_is_given(capfd: pytest.CaptureFixture[str]) -> None:
    environment = dict(os.environ)
    with served(Counters()) as (url, _):
        secret = urlsplit(url).path
        others = (
            "/",
            "/index.html",
            "/vue.global.js",
            "/ws",
            "//",
            "/s3cret/",
            "/%ff/",
            secret[:-1],
            f"/x{secret}",
        )
        for path in (*others, f"/?token={secret[1:-1]}"):
            status, text, cookie = get(url, path)
            assert (status, cookie) == (403, None)
            assert "open the URL" in text
        status, text, cookie = get(url, secret)
        # A frame in a page of another site would not send a cookie
        assert (status, cookie) == (
            200,
            None,
        )
        assert 'id="app"' in text
    assert dict(os.environ) == environment
    assert capfd.readouterr().out == ""


@pytest.mark.parametrize(
    "path", ["../vue3.py", "%2e%2e/vue3.py", "..%2fvue3.py", "/etc/passwd", "assets", "%00"]
)
def test_files_outside_are_not_found(path: str) -> None:
    with served(Counters()) as (url, _):
        assert get(url, urlsplit(url).path + path)[0] == 404


def test_an_empty_token_is_refused() -> None:
    with pytest.raises(AmiwarpError, match="token is empty"):
        asyncio.run(serve(Counters(), settable=COUNT, token=""))


def test_tabs_have_states_of_their_own_and_are_forgotten(
    browser: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    from playwright.sync_api import expect

    expect.set_options(timeout=1e3 * WAIT_S)
    build = Counters()
    environment = dict(os.environ)
    with served(build) as (url, _), browser.new_context() as context:
        first, second = opened(context), opened(context)
        for page, clicks in ((first, 1), (second, 3)):
            page.goto(url)
            for _ in range(clicks):
                page.get_by_role("button").click()
        for page, clicks in ((first, 1), (second, 3)):
            expect(page.get_by_role("button")).to_have_text(str(clicks))
            expect(page.locator("#double")).to_have_text(str(2 * clicks))
        assert len(build.servers) == 2

        first.reload()
        expect(first.get_by_role("button")).to_have_text("0")
        until(lambda: build.closed == 1)
        first.close()
        until(lambda: build.closed == 2)
        expect(second.get_by_role("button")).to_have_text("3")
        second.get_by_role("button").click()
        expect(second.locator("#double")).to_have_text("8")
    assert build.closed == len(build.servers) == 3
    until(build.forgotten)
    assert dict(os.environ) == environment
    assert capfd.readouterr().out == ""


def test_ending_closes_open_tabs(browser: Any) -> None:
    build = Counters()
    with browser.new_context() as context:
        page = opened(context)
        sockets: list[Any] = []
        page.on("websocket", lambda socket: sockets.append(socket))
        with served(build) as (url, _):
            page.goto(url)
            page.get_by_role("button").wait_for()
            assert [socket.is_closed() for socket in sockets] == [False]
        assert build.closed == 1
        page.wait_for_function("true")  # lets the browser's events in
        until(lambda: page.evaluate("1") == 1 and sockets[0].is_closed())


@pytest.mark.parametrize("error", [AmiwarpError("no events in <b>x.raw</b>"), RuntimeError()])
def test_failures_are_shown(
    browser: Any, error: Exception, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(server: Any) -> None:
        raise error

    with served(fail) as (url, _), browser.new_context() as context:
        page = opened(context)
        page.goto(url)
        page.get_by_text(str(error) or "RuntimeError").wait_for()
    # Only an unexpected error logs a traceback
    assert bool(caplog.records) == isinstance(error, RuntimeError)


@pytest.mark.parametrize("origin", ["http://example.org", "null", None])
def test_sockets_of_other_sites_are_refused(origin: str | None) -> None:
    import aiohttp

    async def connect(url: str, origin: str | None) -> int:
        headers = {} if origin is None else {"Origin": origin}
        async with aiohttp.ClientSession() as client:
            try:
                async with client.ws_connect(url + "ws", headers=headers):
                    return 101
            except aiohttp.WSServerHandshakeError as error:
                return error.status

    build = Counters()
    with served(build) as (url, loop):
        for given, status in ((origin, 403), (origin_of(url), 101)):
            assert (
                asyncio.run_coroutine_threadsafe(connect(url, given), loop).result(WAIT_S) == status
            )
    assert len(build.servers) == build.closed == 1


def received(url: str, sent: bytes) -> bytes:
    """Return what the server answers to bytes on a new connection, until it closes the connection."""
    address = urlsplit(url)
    with socket.create_connection((address.hostname, address.port), WAIT_S) as connection:
        connection.sendall(sent)
        return b"".join(iter(lambda: connection.recv(4096), b""))


@pytest.mark.parametrize("hosts", [b"Host: localhost\r\nHost: evil.example\r\n", b""])
def test_a_request_with_two_hosts_or_none_is_refused_without_a_traceback(
    hosts: bytes, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    with served(Counters()) as (url, _):
        assert b"400 Bad Request" in received(url, b"GET / HTTP/1.1\r\n" + hosts + b"\r\n")
    assert caplog.records == []
    assert "Traceback" not in capfd.readouterr().err


def test_connections_without_a_complete_request_are_closed(
    monkeypatch: pytest.MonkeyPatch, browser: Any
) -> None:
    monkeypatch.setattr(serve_module, "SILENT_S", 0.2)
    with served(Counters()) as (url, _), browser.new_context() as context:
        page = opened(context)
        page.goto(url)
        for sent in (b"", b"GET / HTTP/1.1\r\nHost: loc"):
            assert received(url, sent) == b""
        page.get_by_role("button").click()  # an open tab stays open
        page.locator("#double").filter(has_text="2").wait_for()


def test_a_page_may_load_only_from_its_server() -> None:
    with served(Counters()) as (url, _):
        connection = HTTPConnection(urlsplit(url).netloc, timeout=WAIT_S)
        connection.request("GET", urlsplit(url).path)
        policy = connection.getresponse().getheader("Content-Security-Policy")
        connection.close()
    assert policy is not None
    assert "default-src 'none'" in policy
    assert "http" not in policy
