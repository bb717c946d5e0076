"""A trame application for each tab of a browser, on one TCP port: every tab has a server and a state of its own."""

from __future__ import annotations

import asyncio
import ctypes
import gc
import hashlib
import logging
import os
import secrets
import sys
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from weakref import WeakSet

from amiwarp.errors import AmiwarpError
from amiwarp.viewer.frames import Frames
from amiwarp.viewer.message_filter import MOST_BYTES, Check, Gate
from amiwarp.viewer.hosts import ANYWHERE, Names, address, cannot_serve, plain

if TYPE_CHECKING:
    from aiohttp import web
    from aiohttp.typedefs import Handler

Closing = Callable[[], object] | None
Session = Callable[[Any], Closing]
"""Builds the page on a fresh ``trame_server.Server`` (vue3), in the event loop; gives what to run at the end."""
MOST_TABS = 16
"""Open at a time: each holds a scene, a window of the recording and threads."""
FULL = f"{MOST_TABS} tabs of this inspector are open, and it takes no more; close one, then reload this page"
HEARTBEAT_S = 30.0
"""After which a page is asked whether it is there; it has half that time to answer, then it is closed."""
TIDY_S = 0.5
"""From a tab's end to when its memory is given back: of several that are closed together once."""
LONGEST_S = 30.0
"""Between two looks whether what a closed tab had begun has ended."""
HEADERS = {"Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff"}
"""The first keeps the token, which is in the page's address, from every other page."""


async def serve(
    build: Session,
    *,
    settable: Mapping[str, Check],
    host: str = "127.0.0.1",
    port: int = 0,
    token: str,
    ready: Callable[[str], None] | None = None,
) -> None:
    """Serve until it is cancelled; then every tab is closed.

    ``build`` is called each time that a page is loaded; if it raises, the page shows the text. ``settable``: what of
    its state a page may set, and to which values. ``port`` 0 takes a free one. ``ready`` gets the URL once it is open.
    Raises AmiwarpError for an empty token, and for a host or a port that cannot be served.
    """
    from aiohttp import web

    if not token:
        raise AmiwarpError("the token is empty: expected a secret, for example secrets.token_urlsafe()")
    if not plain(host):
        raise AmiwarpError("the host is empty: expected a name or an address of this machine, as 127.0.0.1")
    application = _application(Tabs(build, settable), token, await asyncio.to_thread(Names, host))
    runner = web.AppRunner(application, handle_signals=False, access_log=None, shutdown_timeout=5.0)
    await runner.setup()
    try:
        try:
            await web.TCPSite(runner, plain(host), port).start()
        except OSError as error:
            raise cannot_serve(error, host, port) from error
        bound, number = runner.addresses[0][:2]
        if ready is not None:
            ready(address(bound if bound in ANYWHERE else host, number, token))
        await asyncio.Event().wait()
    finally:
        await runner.cleanup()


class Tabs:
    """The tabs that are open, of one server: each has a page and a WebSocket."""

    def __init__(self, build: Session, settable: Mapping[str, Check]) -> None:
        from trame_client.module import vue3

        self.folders = {"/": Path(vue3.www).resolve()}
        self._build, self._settable = build, settable
        self._sockets: set[web.WebSocketResponse] = set()
        self._servers: WeakSet[Any] = WeakSet()  # of the open ones, and of closed ones that something still holds
        self._tidying: asyncio.TimerHandle | None = None

    async def open(self, request: web.Request) -> web.WebSocketResponse:
        """Serve a tab until it is closed. Other sites' pages are refused, and clients that do not say where from."""
        from aiohttp import web

        if request.headers.get("Origin", "").lower() != f"{request.scheme}://{request.host}".lower():
            raise web.HTTPForbidden(text="Not allowed: the WebSocket is for this server's own pages.")
        if len(self._sockets) >= 2 * MOST_TABS:  # from MOST_TABS on they only show why there is nothing
            raise web.HTTPServiceUnavailable(text=FULL)
        socket = web.WebSocketResponse(heartbeat=HEARTBEAT_S, timeout=5.0, compress=False, max_msg_size=MOST_BYTES)
        build = self._build if len(self._sockets) < MOST_TABS else _full
        self._sockets.add(socket)
        try:
            await socket.prepare(request)
            await self._converse(socket, build)
        finally:
            self._sockets.discard(socket)
            self._tidy_later(TIDY_S)
        return socket

    async def close(self, _: web.Application) -> None:
        """Close all of them."""
        from aiohttp import WSCloseCode

        if self._tidying is not None:
            self._tidying.cancel()
        await asyncio.gather(*(socket.close(code=WSCloseCode.GOING_AWAY) for socket in [*self._sockets]))

    async def _converse(self, socket: web.WebSocketResponse, build: Session) -> None:
        from aiohttp import WSMsgType

        async with _connection(build, self.folders, socket) as (server, connection):
            gate = Gate(server, self._settable)
            self._servers.add(server)
            async for message in socket:
                if message.type is WSMsgType.BINARY and gate.passes(message.data):
                    await connection.send(True, message)

    def _tidy_later(self, wait_s: float) -> None:
        if self._tidying is not None:
            self._tidying.cancel()
        self._tidying = asyncio.get_running_loop().call_later(wait_s, self._tidy, wait_s)

    def _tidy(self, waited_s: float) -> None:
        """Give back what closed tabs held; again, ever less often, while work of theirs still runs in a thread."""
        self._tidying = None
        _give_back()
        if len(self._servers) > len(self._sockets):
            self._tidy_later(min(2.0 * waited_s, LONGEST_S))


def _full(_: Any) -> Closing:
    raise AmiwarpError(FULL)


def _give_back() -> None:
    """Give back the memory of closed tabs.

    A page is a web of references that the collector alone takes apart, and glibc keeps what was freed: it holds free
    memory in the arena of each thread, below whatever is still in use there.
    """
    gc.collect()
    if sys.platform.startswith("linux"):
        with suppress(AttributeError):  # musl has none
            ctypes.CDLL(None).malloc_trim(0)


def _application(tabs: Tabs, token: str, names: Names) -> web.Application:
    from aiohttp import web

    application = web.Application(middlewares=[_guard(token, names)], client_max_size=MOST_BYTES)
    application.add_routes([web.get("/ws", tabs.open), web.get("/{path:.*}", partial(_file, tabs.folders))])
    application.on_shutdown.append(tabs.close)
    return application


def _guard(token: str, names: Names) -> Any:
    """Middleware that lets pass who has the token, in the URL or in the cookie of this server, which that sets."""
    from aiohttp import web

    cookie = "amiwarp_" + hashlib.sha256(token.encode()).hexdigest()[:16]

    def knows(given: str) -> bool:
        return secrets.compare_digest(given.encode(errors="surrogatepass"), token.encode())

    async def answer(request: web.Request, handler: Handler) -> web.StreamResponse:
        if not names.are_of(request):
            raise web.HTTPForbidden(text="Not allowed: this server has another name; open the URL that was printed.")
        if request.body_exists:
            raise web.HTTPRequestEntityTooLarge(0, 0, text="Not allowed: this server takes no data but by its pages.")
        fresh = knows(request.query.get("token", ""))
        if not fresh and not knows(request.cookies.get(cookie, "")):
            raise web.HTTPForbidden(text="Not allowed: open the URL that was printed when this server was started.")
        response = await handler(request)
        if fresh and not response.prepared:
            response.set_cookie(cookie, token, httponly=True, samesite="Strict")
        return response

    @web.middleware
    async def guard(request: web.Request, handler: Handler) -> web.StreamResponse:
        try:
            response = await answer(request, handler)
        except web.HTTPException as error:
            error.headers.update(HEADERS)
            error.force_close()
            raise
        if not response.prepared:
            response.headers.update(HEADERS)
        return response

    return guard


async def _file(folders: dict[str, Path], request: web.Request) -> web.FileResponse:
    """The file in the folder of the longest route that the path begins with; raises HTTPNotFound for one outside."""
    from aiohttp import web

    path = "/index.html" if request.path == "/" else request.path
    route = max(filter(path.startswith, folders), key=len)
    with suppress(OSError, ValueError):
        file = (folders[route] / path.removeprefix(route)).resolve()
        if file.is_relative_to(folders[route]) and file.is_file():
            return web.FileResponse(file, headers={"Cache-Control": "no-store"} if file.suffix == ".html" else None)
    raise web.HTTPNotFound


@asynccontextmanager
async def _connection(
    build: Session, folders: dict[str, Path], socket: web.WebSocketResponse
) -> AsyncIterator[tuple[Any, Any]]:
    """A new server, and its end of the tab's connection; what it sends goes to the socket."""
    async with AsyncExitStack() as stack:
        server, closing = _build(build)
        stack.callback(_forget, server)
        if closing is not None:
            stack.callback(closing)
        bound: list[Any] = []
        server.controller.on_server_bind.add(bound.append)
        with _shielded():
            running = server.start(backend="generic", exec_mode="task", timeout=0, open_browser=False)
        stack.push_async_callback(asyncio.wait, [running])
        stack.push_async_callback(server.stop)
        for route, source in server.serve.items():
            folders[f"/{route.strip('/')}/"] = Path(source if isinstance(source, str) else source[0]).resolve()
        await server.ready
        server.controller.on_error.add(_log_report)
        for delivery in server.protocol.getLinkProtocols():
            if hasattr(delivery, "push_render"):
                stack.callback(Frames(server, delivery).close)

        async def send(_: bool, content: bytes) -> None:
            with suppress(ConnectionResetError):
                await socket.send_bytes(content)

        connection = await bound[0]["ws"].connect()
        connection.on_message(send)
        stack.push_async_callback(connection.close)
        yield server, connection


def _log_report(message: str) -> None:
    logging.getLogger(__name__).error("the page reports %.1000r", message)  # terminals obey what is not escaped


def _build(build: Session) -> tuple[Any, Closing]:
    """A server with its page or, where that cannot be built, with the reason."""
    from trame.ui.vuetify3 import VAppLayout
    from trame.widgets import vuetify3

    server = _server()
    try:
        return server, build(server)
    except Exception as error:
        if not isinstance(error, AmiwarpError):
            logging.getLogger(__name__).exception("the page cannot be built")
        _forget(server)
        server = _server()
        server.state.failure = str(error) or type(error).__name__
        with VAppLayout(server):
            vuetify3.VAlert(text=("failure",), type="error", classes="ma-4", style="white-space: pre-wrap")
        return server, None


def _server() -> Any:
    from trame_client.widgets.core import VirtualNode
    from trame_server import Server

    with _shielded():
        server = Server(f"amiwarp_{secrets.token_hex(8)}", VirtualNode)
    server.client_type = "vue3"
    return server


@contextmanager
def _shielded() -> Iterator[None]:
    """Hides the command line from trame, and undoes what it does to the environment and to its globals."""
    from trame_server import protocol

    names = ("TRAME_ARGS", "WSLINK_HEART_BEAT", "WSLINK_MAX_MSG_SIZE", "WSLINK_READY_MSG")
    before = {name: os.environ[name] for name in names if name in os.environ}
    os.environ["TRAME_ARGS"] = ""
    try:
        yield
    finally:
        protocol.CoreServer.server = protocol.server.ws_server = None
        for name in names:
            os.environ.pop(name, None)
        os.environ.update(before)


def _forget(server: Any) -> None:
    """Removes the server from the globals of trame that would keep it."""
    from trame_client.widgets.core import HTML_CTX

    getattr(sys.modules.get("trame_vtk.modules.vtk"), "HELPERS_PER_SERVER", {}).pop(server.name, None)
    if HTML_CTX._server is server:
        HTML_CTX._server = None
