"""A trame application for each tab of a browser, on one TCP port: every tab has a server and a state of its own."""

from __future__ import annotations

import asyncio
import hashlib
import logging
import os
import secrets
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from weakref import WeakSet

from amiwarp.errors import AmiwarpError

if TYPE_CHECKING:
    from aiohttp import web
    from aiohttp.typedefs import Handler

Closing = Callable[[], object] | None
Session = Callable[[Any], Closing]
"""Builds the page on a fresh ``trame_server.Server`` (vue3), in the event loop; gives what to run at the end."""


async def serve(
    build: Session, *, host: str = "127.0.0.1", port: int = 0, token: str, ready: Callable[[str], None] | None = None
) -> None:
    """Serves until it is cancelled; then every tab is closed.

    ``build`` is called each time that a page is loaded; if it raises, the page shows the text. ``port`` 0 takes a free
    one. ``ready`` gets the URL once it is open. Raises OSError where it cannot be, AmiwarpError for an empty token.
    """
    from aiohttp import web
    from yarl import URL

    if not token:
        raise AmiwarpError("the token is empty: expected a secret, for example secrets.token_urlsafe()")
    runner = web.AppRunner(_application(build, token), handle_signals=False, access_log=None, shutdown_timeout=5.0)
    await runner.setup()
    try:
        await web.TCPSite(runner, host, port).start()
        if ready is not None:
            ready(str(URL.build(scheme="http", host=host, port=runner.addresses[0][1], path="/") % {"token": token}))
        await asyncio.Event().wait()
    finally:
        await runner.cleanup()


def _application(build: Session, token: str) -> web.Application:
    from aiohttp import WSCloseCode, WSMsgType, web
    from trame_client.module import vue3
    from wslink.protocol import MAX_MSG_SIZE

    folders = {"/": Path(vue3.www).resolve()}
    sockets: WeakSet[web.WebSocketResponse] = WeakSet()

    async def tab(request: web.Request) -> web.WebSocketResponse:
        if request.headers.get("Origin", "").partition("://")[2] != request.host:
            raise web.HTTPForbidden(text="Not allowed: the WebSocket is for this server's own pages.")
        socket = web.WebSocketResponse(heartbeat=30.0, timeout=5.0, compress=False, max_msg_size=2 * MAX_MSG_SIZE)
        await socket.prepare(request)
        sockets.add(socket)
        async with _connection(build, folders, socket) as connection:
            async for message in socket:
                if message.type is WSMsgType.BINARY:
                    await connection.send(True, message)
        return socket

    async def close_tabs(_: web.Application) -> None:
        await asyncio.gather(*(socket.close(code=WSCloseCode.GOING_AWAY) for socket in sockets))

    application = web.Application(middlewares=[_guard(token)])
    application.add_routes([web.get("/ws", tab), web.get("/{path:.*}", partial(_file, folders))])
    application.on_shutdown.append(close_tabs)
    return application


def _guard(token: str) -> Any:
    """Middleware that lets pass who has the token, in the URL or in the cookie of this server, which that sets."""
    from aiohttp import web

    cookie = "amiwarp_" + hashlib.sha256(token.encode()).hexdigest()[:16]

    def knows(given: str) -> bool:
        return secrets.compare_digest(given.encode(errors="surrogatepass"), token.encode())

    @web.middleware
    async def guard(request: web.Request, handler: Handler) -> web.StreamResponse:
        fresh = knows(request.query.get("token", ""))
        if not fresh and not knows(request.cookies.get(cookie, "")):
            raise web.HTTPForbidden(text="Not allowed: open the URL that was printed when this server was started.")
        response = await handler(request)
        if fresh and not response.prepared:
            response.set_cookie(cookie, token, httponly=True, samesite="Strict")
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
async def _connection(build: Session, folders: dict[str, Path], socket: web.WebSocketResponse) -> AsyncIterator[Any]:
    """A new server's end of the tab's connection; what it sends goes to the socket."""
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

        async def send(_: bool, content: bytes) -> None:
            with suppress(ConnectionResetError):
                await socket.send_bytes(content)

        connection = await bound[0]["ws"].connect()
        connection.on_message(send)
        stack.push_async_callback(connection.close)
        yield connection


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
    """Ends the server's animations, and removes it from the globals of trame that would keep it."""
    from trame_client.widgets.core import HTML_CTX

    for protocol in server.protocol.getLinkProtocols() if server.protocol else ():
        getattr(protocol, "views_in_animations", []).clear()
    getattr(sys.modules.get("trame_vtk.modules.vtk"), "HELPERS_PER_SERVER", {}).pop(server.name, None)
    if HTML_CTX._server is server:
        HTML_CTX._server = None
