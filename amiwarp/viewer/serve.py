"""Web server of the inspector: one TCP port that gives each browser tab its own trame server and state."""

from __future__ import annotations

import asyncio
import logging
import secrets
import socket
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from weakref import WeakSet

from amiwarp.errors import AmiwarpError, optional_module
from amiwarp.tasks import release_memory
from amiwarp.viewer.host_names import ALL_INTERFACES, HostNames, address, cannot_serve, normalised
from amiwarp.viewer.page_files import FOLDER, ROUTE
from amiwarp.viewer.page_messages import MOST_BYTES, Check, MessageFilter
from amiwarp.workarounds import first_page, remove_from_trame, trame_globals_restored

if TYPE_CHECKING:
    from aiohttp import web
    from aiohttp.typedefs import Handler


Closing = Callable[[], object] | None
"""Function that is called when a browser tab is closed, or None."""
Session = Callable[[Any], Closing]
"""Function that builds a page on a new ``trame_server.Server`` (vue3), in the event loop."""
MOST_TABS = 16
"""Largest number of open browser tabs. Each tab holds a window of the recording and threads."""
TOO_MANY_TABS = f"{MOST_TABS} tabs of this inspector are open, which is the maximum; close one, then reload this page"
HEARTBEAT_S = 30.0
"""Interval between pings of a page [s]. A page that does not answer within half of it is closed."""
CLEANUP_S = 0.5
"""Delay between closing a tab and releasing its memory [s]; tabs closed within this time are released together."""
LONGEST_CLEANUP_S = 30.0
"""Longest interval between two attempts to release closed tabs whose threads still run [s]."""
FAILURE = '<main role="alert" style="white-space: pre-wrap; padding: 24px; font: 16px system-ui">{{ failure }}</main>'
"""Page that is shown if the inspector's page cannot be built."""
POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; img-src 'self' data: "
    "blob:; font-src 'self' data:; connect-src 'self'; base-uri 'self'; form-action 'none'"
)
"""Content that the page may load: only from this server. Vue compiles the page's template, which needs eval."""
HEADERS = {
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Content-Security-Policy": POLICY,
}
"""Headers of every HTTP answer. The first one keeps the page's address, which contains the token, from other sites."""
SILENT_S = 10.0
IDLE_S = 75.0
"""Time after which a connection is closed that has sent no complete request, and one that sends no further one [s]."""


LIBRARIES = ("aiohttp", "msgpack", "trame_client", "trame_server", "yarl")
"""Modules of the page's libraries, which the extra ``page`` installs."""


def check_libraries() -> None:
    """Raise :class:`AmiwarpError` if a library of the page is missing.

    Call it before a recording is opened, which can take long.
    """
    for name in LIBRARIES:
        need = f"the inspector's page needs {name.partition('_')[0]}"
        optional_module(name, "page", need)


async def serve(
    build: Session,
    *,
    settable: Mapping[str, Check],
    host: str = "127.0.0.1",
    port: int = 0,
    token: str,
    ready: Callable[[str], None] | None = None,
    listening: socket.socket | None = None,
) -> None:
    """Serve until cancelled; then close every tab.

    ``build`` is called each time a page is loaded; if it raises an error, the page shows the error's text. ``settable``
    maps the state variables that a page may set to the checks of their values. ``port`` 0 selects a free port.
    ``ready`` is called with the URL once the server listens. ``listening``: socket that listens on ``host`` already;
    ``port`` is then not used. Raises :class:`AmiwarpError` if the token is empty, or if
    the host or the port cannot be used.
    """
    from aiohttp import web

    if not token:
        raise AmiwarpError(
            "the token is empty: expected a secret, for example secrets.token_urlsafe()"
        )
    if not normalised(host):
        raise AmiwarpError(
            "the host is empty: expected a name or an address of this machine, such as 127.0.0.1"
        )
    heard: set[Any] = set()
    names = await asyncio.to_thread(HostNames, host)
    application = _application(Tabs(build, settable), token, names, heard)
    runner = web.AppRunner(
        application,
        handle_signals=False,
        access_log=None,
        shutdown_timeout=5.0,
        keepalive_timeout=IDLE_S,
        logger=_request_logger(),
    )
    await runner.setup()
    closing = asyncio.create_task(_close_silent(runner.server, heard))
    try:
        try:
            if listening is None:
                await web.TCPSite(runner, normalised(host), port).start()
            else:
                await web.SockSite(runner, listening).start()
        except OSError as error:
            raise cannot_serve(error, host, port) from error
        bound, number = runner.addresses[0][:2]
        if ready is not None:
            ready(address(bound if bound in ALL_INTERFACES else host, number, token))
        await asyncio.Event().wait()
    finally:
        closing.cancel()
        await runner.cleanup()


async def _close_silent(server: Any, heard: set[Any]) -> None:
    """Close connections that have sent no complete request for :data:`SILENT_S` to twice that."""
    before: set[Any] = set()
    while True:
        await asyncio.sleep(SILENT_S)
        heard.intersection_update(server.connections)
        silent = {*server.connections} - heard
        for silent_connection in silent & before:
            if silent_connection.transport is not None:
                silent_connection.transport.abort()
        before = silent


def _request_logger() -> logging.Logger:
    """Return a logger for errors of requests, without those that are the client's: it gets an answer, status 400."""
    from aiohttp.http_exceptions import HttpProcessingError

    logger = logging.getLogger(f"{__name__}.requests")
    logger.filters[:] = [
        lambda record: not (record.exc_info and isinstance(record.exc_info[1], HttpProcessingError))
    ]
    return logger


class Tabs:
    """Open tabs of one server; each tab has a page and a WebSocket."""

    def __init__(self, build: Session, settable: Mapping[str, Check]) -> None:
        from trame_client.module import vue3

        self.folders = {"/": Path(vue3.www).resolve(), f"/{ROUTE}/": FOLDER.resolve()}
        self._build = build
        self._settable = settable
        self._sockets: set[web.WebSocketResponse] = set()
        # Servers of open tabs, and of closed tabs still in use
        self._servers: WeakSet[Any] = WeakSet()
        self._cleanup: asyncio.TimerHandle | None = None

    async def open(self, request: web.Request) -> web.WebSocketResponse:
        """Serve a tab until it is closed. Refuse pages of other sites and clients that send no ``Origin`` header."""
        from aiohttp import WSMsgType, web

        origin = request.headers.get("Origin", "")
        own = f"{request.scheme}://{request.host}"
        if origin.lower() != own.lower():
            raise web.HTTPForbidden(
                text="Not allowed: the WebSocket is for this server's own pages."
            )
        if len(self._sockets) >= 2 * MOST_TABS:  # tabs beyond MOST_TABS only show TOO_MANY_TABS
            raise web.HTTPServiceUnavailable(text=TOO_MANY_TABS)
        socket = web.WebSocketResponse(
            heartbeat=HEARTBEAT_S, timeout=5.0, compress=False, max_msg_size=MOST_BYTES
        )
        build = self._build if len(self._sockets) < MOST_TABS else _refuse_tab
        self._sockets.add(socket)
        try:
            await socket.prepare(request)
            async with _connection(build, self.folders, socket) as (server, connection):
                message_filter = MessageFilter(server, self._settable)
                self._servers.add(server)
                async for message in socket:
                    if message.type is WSMsgType.BINARY and message_filter.passes(message.data):
                        await connection.send(True, message)
        finally:
            self._sockets.discard(socket)
            self._clean_up_later(CLEANUP_S)
        return socket

    async def close(self, _: web.Application) -> None:
        """Close all browser tabs."""
        from aiohttp import WSCloseCode

        if self._cleanup is not None:
            self._cleanup.cancel()
        await asyncio.gather(
            *(socket.close(code=WSCloseCode.GOING_AWAY) for socket in [*self._sockets])
        )

    def _clean_up_later(self, wait_s: float) -> None:
        if self._cleanup is not None:
            self._cleanup.cancel()
        self._cleanup = asyncio.get_running_loop().call_later(wait_s, self._clean_up, wait_s)

    def _clean_up(self, waited_s: float) -> None:
        """Release the memory of closed tabs. Retry at growing intervals while their threads still run."""
        release_memory()
        if len(self._servers) > len(self._sockets):
            self._clean_up_later(min(2.0 * waited_s, LONGEST_CLEANUP_S))


def _refuse_tab(_: Any) -> Closing:
    raise AmiwarpError(TOO_MANY_TABS)


def _application(tabs: Tabs, token: str, names: HostNames, heard: set[Any]) -> web.Application:
    """Return the application. It refuses unknown host names and requests with a body, and sets the headers.

    It adds the connections of complete requests to ``heard``.
    """
    from aiohttp import web

    @web.middleware
    async def guard(request: web.Request, handler: Handler) -> web.StreamResponse:
        heard.add(request.protocol)
        try:
            if not names.accept(request):
                raise web.HTTPForbidden(
                    text="Not allowed: unknown host name; open the URL that was printed."
                )
            if request.body_exists:
                raise web.HTTPRequestEntityTooLarge(
                    0, 0, text="Not allowed: requests with a body are refused."
                )
            response = await handler(request)
        except web.HTTPException as error:
            error.headers.update(HEADERS)
            error.force_close()
            raise
        if not response.prepared:
            response.headers.update(HEADERS)
        return response

    async def answer(request: web.Request) -> web.StreamResponse:
        # The page asks for its files and for its WebSocket below its own path, which begins with the token. A cookie
        # would not do: browsers withhold cookies from a frame inside a page of another site, such as a notebook's.
        given, slash, path = request.path[1:].partition("/")
        known = secrets.compare_digest(given.encode(errors="surrogatepass"), token.encode())
        if not slash or not known:
            raise web.HTTPForbidden(
                text="Not allowed: open the URL that was printed when this server was started."
            )
        if path == "ws":
            return await tabs.open(request)
        return _file(tabs.folders, f"/{path}")

    application = web.Application(middlewares=[guard], client_max_size=MOST_BYTES)
    application.add_routes([web.get("/{path:.*}", answer)])
    application.on_shutdown.append(tabs.close)
    return application


def _file(folders: dict[str, Path], path: str) -> web.StreamResponse:
    """Return the file at a path, from the folder of the longest matching route.

    Raises ``HTTPNotFound`` if the file does not exist or lies outside that folder.
    """
    from aiohttp import web

    if path in ("/", "/index.html"):
        page = first_page(folders["/"] / "index.html", ROUTE)
        return web.Response(
            text=page, content_type="text/html", headers={"Cache-Control": "no-store"}
        )
    route = max(filter(path.startswith, folders), key=len)
    with suppress(OSError, ValueError):
        file = (folders[route] / path.removeprefix(route)).resolve()
        if file.is_relative_to(folders[route]) and file.is_file():
            return web.FileResponse(file)
    raise web.HTTPNotFound


@asynccontextmanager
async def _connection(
    build: Session, folders: dict[str, Path], socket: web.WebSocketResponse
) -> AsyncIterator[tuple[Any, Any]]:
    """Start a new trame server, and yield it with its connection to the tab; its messages go to the socket."""
    async with AsyncExitStack() as stack:
        server, closing = _build(build)
        stack.callback(remove_from_trame, server)
        if closing is not None:
            stack.callback(closing)
        bound: list[Any] = []
        server.controller.on_server_bind.add(bound.append)
        with trame_globals_restored():
            running = server.start(
                backend="generic", exec_mode="task", timeout=0, open_browser=False
            )
        stack.push_async_callback(asyncio.wait, [running])
        stack.push_async_callback(server.stop)
        for route, source in server.serve.items():
            folder = source if isinstance(source, str) else source[0]
            folders[f"/{route.strip('/')}/"] = Path(folder).resolve()
        stack.callback(folders.pop, f"/{server.name}/", None)
        await server.ready
        log = logging.getLogger(__name__)
        # %r escapes control characters
        server.controller.on_error.add(partial(log.error, "the page reports %.1000r"))

        async def send(_: bool, content: bytes) -> None:
            with suppress(ConnectionResetError):
                await socket.send_bytes(content)

        connection = await bound[0]["ws"].connect()
        connection.on_message(send)
        stack.push_async_callback(connection.close)
        yield server, connection


def _build(build: Session) -> tuple[Any, Closing]:
    """Return a new server with its page; if building the page fails, the page shows the reason."""
    server = _server()
    try:
        return server, build(server)
    except Exception as error:
        if not isinstance(error, AmiwarpError):
            logging.getLogger(__name__).exception("the page cannot be built")
        remove_from_trame(server)
        server = _server()
        server.state.failure = str(error) or type(error).__name__
        server.state.trame__template_main = FAILURE
        return server, None


def _server() -> Any:
    from trame_client.widgets.core import VirtualNode
    from trame_server import Server

    with trame_globals_restored():
        server = Server(f"amiwarp_{secrets.token_hex(8)}", VirtualNode)
    server.client_type = "vue3"
    return server
