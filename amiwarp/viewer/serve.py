"""Web server of the inspector: one TCP port that gives each browser tab its own trame server and state."""

from __future__ import annotations

import asyncio
import errno
import inspect
import ipaddress
import logging
import math
import os
import re
import secrets
import socket
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from weakref import WeakSet

import msgpack  # type: ignore[import-untyped]
from yarl import URL

from amiwarp.errors import AmiwarpError
from amiwarp.tasks import release_memory

if TYPE_CHECKING:
    from aiohttp import web
    from aiohttp.typedefs import Handler


# Host names and addresses of the server: the URL to open, and the ``Host`` headers that it accepts.

ALL_INTERFACES = {"0.0.0.0": (socket.AF_INET, "192.0.2.1"), "::": (socket.AF_INET6, "2001:db8::1")}
"""Hosts that mean every address of this machine, each with its address family and a remote address reserved for
documentation."""


def normalised(host: str) -> str:
    """Return a host in lower case, without the brackets of IPv6 and with IP addresses in standard notation."""
    host = host.strip().strip("[]").rstrip(".").lower()
    try:
        return str(ipaddress.ip_address(host))
    except ValueError:
        return host


def is_local(host: str) -> bool:
    """Return whether only this machine can connect to a server on ``host``."""
    try:
        return ipaddress.ip_address(normalised(host)).is_loopback
    except ValueError:
        return normalised(host) == "localhost"


def reachable(host: str) -> str:
    """Return a host that a browser can open: ``host``, or one address of this machine if ``host`` means all of them."""
    host = normalised(host)
    if host not in ALL_INTERFACES:
        return host
    family, remote = ALL_INTERFACES[host]
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as probe:  # connecting UDP sends nothing; it selects a route
            probe.connect((remote, 9))
            return str(probe.getsockname()[0])
    except OSError:
        return socket.gethostname()


def address(host: str, port: int, token: str) -> str:
    """Return the URL to open in a browser. Its path is the token."""
    return str(URL.build(scheme="http", host=reachable(host), port=port) / token / "")


class HostNames:
    """Host names under which the server may be called.

    A request with any other name in its ``Host`` header may come from a foreign page whose host name resolves to this
    machine (DNS rebinding).
    """

    def __init__(self, host: str) -> None:
        names = {"localhost", "127.0.0.1", "::1", normalised(host), reachable(host)}
        if not is_local(host):
            own = socket.gethostname().lower()
            names |= {own, f"{own}.local", own.partition(".")[0]}
        self.known = names - ALL_INTERFACES.keys()

    def accept(self, request: web.Request) -> bool:
        """Return whether the request's ``Host`` is a known name or the address at which the request arrived."""
        try:
            requested = normalised(URL(f"http://{request.host}").host or "")
        except ValueError:
            return False
        arrived = request.transport.get_extra_info("sockname") if request.transport is not None else None
        return requested in self.known or (arrived is not None and requested == normalised(str(arrived[0])))


def cannot_serve(error: OSError, host: str, port: int) -> AmiwarpError:
    """Return the error to raise if the server cannot listen at ``host`` and ``port``."""
    denied = f"--port {port}: permission denied; give a port above 1023, or 0 for a free one"
    known = {
        errno.EADDRINUSE: f"--port {port}: is in use on {host}; give another port, or 0 for a free one",
        errno.EADDRNOTAVAIL: f"--host {host!r} is not an address of this machine; give one, such as 127.0.0.1",
        errno.EACCES: denied, errno.EPERM: denied,
    }  # fmt: skip
    if isinstance(error, socket.gaierror):
        return AmiwarpError(f"--host {host!r}: unknown name or address; give one of this machine, such as 127.0.0.1")
    usual = f"--host {host!r} --port {port}: cannot listen: {error.strerror or error}; give another host or port"
    # newer asyncio gives no number if no address of the host is one of this machine
    return AmiwarpError(known.get(error.errno or errno.EADDRNOTAVAIL, usual))


# Filter for messages from a page: known calls whose arguments have the expected type and size. Drops all others.

MOST_BYTES = 64 * 1024
"""Largest accepted size of a message from a page [bytes]. The page's own messages have a few hundred bytes, and it
never splits them into parts."""
HEADER_BYTES = 12
"""Size of the header of each message part [bytes]: message number, start of the part and length of the message, 32 bits
each."""
MOST_CHARACTERS, MOST_ID = 2000, 120
"""Largest accepted length of a text that the page gives to a function of the server, such as the state in its address,
and of the number of a call."""
LARGEST = 1e12
"""Largest accepted number in a message; in ms it is 30 years."""

Check = Callable[[Any], bool]
"""Function that returns whether a value is allowed."""


def number(low: float = -LARGEST, high: float = LARGEST) -> Check:
    """Return a check that accepts numbers from ``low`` to ``high``; it rejects NaN and booleans."""
    return lambda value: type(value) in (int, float) and low <= value <= high  # comparisons with NaN are false


def one_of(*known: Any) -> Check:
    """Return a check that accepts the ``known`` values, types included."""
    return lambda value: any(type(value) is type(each) and value == each for each in known)


flag = one_of(True, False)
ARGUMENTS: Mapping[type, Check] = {
    str: lambda value: isinstance(value, str) and len(value) <= MOST_CHARACTERS, float: number(),
    int: lambda value: type(value) is int and abs(value) <= LARGEST, bool: flag,
}  # fmt: skip
"""Checks of the arguments of functions that the page calls, by their annotation."""


class MessageFilter:
    """Filter for the messages that one page sends."""

    def __init__(self, server: Any, settable: Mapping[str, Check]) -> None:
        """Allow the messages of a page on ``server``.

        ``settable`` maps each state variable that the page may set to the check of its values.
        """
        self._server, self._settable, self._warned = server, settable, False

    def passes(self, message: bytes) -> bool:
        """Return whether the message is allowed. Log the first message that is not."""
        try:
            start, length = (int.from_bytes(message[k : k + 4], "little") for k in (4, 8))
            whole = (start, length) == (0, len(message) - HEADER_BYTES)
            allowed = whole and self._is_call(msgpack.unpackb(message[HEADER_BYTES:]))
        except Exception:  # invalid bytes make the decoder raise errors of many types
            allowed = False
        if not allowed and not self._warned:
            self._warned = True
            logging.getLogger(__name__).warning("dropped a message of %d bytes that no page sends", len(message))
        return allowed

    def _is_call(self, call: Any) -> bool:
        """Return whether a decoded message is a call that a page makes, and nothing more."""
        match call:
            case {"id": str(number), "method": method, "args": list(args), **more} if len(number) <= MOST_ID:
                plain = more.get("kwargs", {}) == {} and isinstance(more.get("wslink", ""), str)
                return plain and more.keys() <= {"wslink", "kwargs"} and self._takes(method, args)
        return False

    def _takes(self, method: Any, args: list[Any]) -> bool:
        """Return whether a page may call a method with these arguments."""
        match method, args:
            case "wslink.hello", [{"secret": str(), **more}]:
                return not more
            case "trame.state.get", []:
                return True
            case "trame.lifecycle.update", [event]:
                return event in ("client_connected", "client_exited", "client_unmounted")
            case "trame.error.client", [str(report)]:
                return len(report) <= 2 * MOST_CHARACTERS
            case "trame.state.update", [list(changes)]:
                return all(map(self._is_change, changes))
            case "trame.trigger", [str(name), list(given), {**more}]:
                return not more and self._is_trigger(name, given)
        return False

    def _is_change(self, change: Any) -> bool:
        """Return whether the page may give a state variable this value."""
        match change:
            case {"key": str(key), "value": value, **more} if key in self._settable and not more:
                return self._settable[key](value)
        return False

    def _is_trigger(self, name: str, given: list[Any]) -> bool:
        """Return whether a function that the page may call exists and takes arguments of these types."""
        called = self._server.controller.trigger_fn(name)
        if called is None:
            return False
        signature = inspect.signature(called, eval_str=True)
        arguments = signature.bind(*given).arguments  # raises TypeError for another number of arguments
        return all(ARGUMENTS[signature.parameters[k].annotation](value) for k, value in arguments.items())


def finite(given: str) -> float:
    """Return the typed text as a number, clipped to ±:data:`LARGEST`. Raises :class:`ValueError` for other text."""
    value = float(given or 0.0)
    if math.isnan(value):
        raise ValueError(given)
    return min(max(value, -LARGEST), LARGEST)


# Files of the inspector's page: its template, and trame's first page with small changes.

FOLDER = Path(__file__).with_name("page")
"""Folder with the page's template, style and scripts."""
ROUTE = "__amiwarp"
"""Path below which the page finds these files."""


def first_page(path: Path) -> str:
    """Return trame's first page with the page's own socket. The reader can enlarge the page.

    It shows a plain text until the page is ready.
    """
    page = path.read_text(encoding="utf-8")
    page = re.sub(r'<meta\s+name="viewport"[^>]*>', '<meta name="viewport" content="width=device-width">', page)
    head = f'<script src="{ROUTE}/socket.js"></script><title>amiwarp inspector</title>'
    page = re.sub(r"<title>.*?</title>", head, page)
    return re.sub(r'<div id="app"></div>\s*<script>.*?</script>', '<div id="app">opening the inspector …</div>', page,
                  flags=re.DOTALL)  # fmt: skip


def use_page(server: Any, downloads: str) -> None:
    """Give a trame server the page's style and scripts, its template, and the folder ``downloads`` below its name."""
    template = (FOLDER / "page.html").read_text(encoding="utf-8")
    server.enable_module({
        "serve": {ROUTE: str(FOLDER), server.name: downloads}, "styles": [f"{ROUTE}/page.css"],
        "module_scripts": [f"{ROUTE}/page.js"], "vue_use": ["amiwarp_page"],
    })  # fmt: skip
    # when the connection ends, trame shows the second template: the same page, which then says so
    server.state.update({f"trame__template_{name}": template for name in ("main", "error")})


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
    "Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff", "Content-Security-Policy": POLICY,
}  # fmt: skip
"""Headers of every HTTP answer. The first one keeps the page's address, which contains the token, from other sites."""
SILENT_S, IDLE_S = 10.0, 75.0
"""Time after which a connection is closed that has sent no complete request, and one that sends no further one [s]."""


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
        raise AmiwarpError("the token is empty: expected a secret, for example secrets.token_urlsafe()")
    if not normalised(host):
        raise AmiwarpError("the host is empty: expected a name or an address of this machine, such as 127.0.0.1")
    heard: set[Any] = set()
    application = _application(Tabs(build, settable), token, await asyncio.to_thread(HostNames, host), heard)
    runner = web.AppRunner(application, handle_signals=False, access_log=None, shutdown_timeout=5.0,
                           keepalive_timeout=IDLE_S, logger=_request_logger())  # fmt: skip
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
        for each in silent & before:
            if each.transport is not None:
                each.transport.abort()
        before = silent


def _request_logger() -> logging.Logger:
    """Return a logger for errors of requests, without those that are the client's: it gets an answer, status 400."""
    from aiohttp.http_exceptions import HttpProcessingError

    logger = logging.getLogger(f"{__name__}.requests")
    logger.filters[:] = [lambda record: not (record.exc_info and isinstance(record.exc_info[1], HttpProcessingError))]
    return logger


class Tabs:
    """Open tabs of one server; each tab has a page and a WebSocket."""

    def __init__(self, build: Session, settable: Mapping[str, Check]) -> None:
        from trame_client.module import vue3

        self.folders = {"/": Path(vue3.www).resolve(), f"/{ROUTE}/": FOLDER.resolve()}
        self._build, self._settable = build, settable
        self._sockets: set[web.WebSocketResponse] = set()
        self._servers: WeakSet[Any] = WeakSet()  # servers of open tabs, and of closed tabs still in use
        self._cleanup: asyncio.TimerHandle | None = None

    async def open(self, request: web.Request) -> web.WebSocketResponse:
        """Serve a tab until it is closed. Refuse pages of other sites and clients that send no ``Origin`` header."""
        from aiohttp import WSMsgType, web

        if request.headers.get("Origin", "").lower() != f"{request.scheme}://{request.host}".lower():
            raise web.HTTPForbidden(text="Not allowed: the WebSocket is for this server's own pages.")
        if len(self._sockets) >= 2 * MOST_TABS:  # tabs beyond MOST_TABS only show TOO_MANY_TABS
            raise web.HTTPServiceUnavailable(text=TOO_MANY_TABS)
        socket = web.WebSocketResponse(heartbeat=HEARTBEAT_S, timeout=5.0, compress=False, max_msg_size=MOST_BYTES)
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
        await asyncio.gather(*(socket.close(code=WSCloseCode.GOING_AWAY) for socket in [*self._sockets]))

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
                raise web.HTTPForbidden(text="Not allowed: unknown host name; open the URL that was printed.")
            if request.body_exists:
                raise web.HTTPRequestEntityTooLarge(0, 0, text="Not allowed: requests with a body are refused.")
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
        if not slash or not secrets.compare_digest(given.encode(errors="surrogatepass"), token.encode()):
            raise web.HTTPForbidden(text="Not allowed: open the URL that was printed when this server was started.")
        return await tabs.open(request) if path == "ws" else _file(tabs.folders, f"/{path}")

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
        page = first_page(folders["/"] / "index.html")
        return web.Response(text=page, content_type="text/html", headers={"Cache-Control": "no-store"})
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
        stack.callback(_remove_from_trame, server)
        if closing is not None:
            stack.callback(closing)
        bound: list[Any] = []
        server.controller.on_server_bind.add(bound.append)
        with _trame_globals_restored():
            running = server.start(backend="generic", exec_mode="task", timeout=0, open_browser=False)
        stack.push_async_callback(asyncio.wait, [running])
        stack.push_async_callback(server.stop)
        for route, source in server.serve.items():
            folders[f"/{route.strip('/')}/"] = Path(source if isinstance(source, str) else source[0]).resolve()
        stack.callback(folders.pop, f"/{server.name}/", None)
        await server.ready
        # %r escapes control characters
        server.controller.on_error.add(partial(logging.getLogger(__name__).error, "the page reports %.1000r"))

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
        _remove_from_trame(server)
        server = _server()
        server.state.failure = str(error) or type(error).__name__
        server.state.trame__template_main = FAILURE
        return server, None


def _server() -> Any:
    from trame_client.widgets.core import VirtualNode
    from trame_server import Server

    with _trame_globals_restored():
        server = Server(f"amiwarp_{secrets.token_hex(8)}", VirtualNode)
    server.client_type = "vue3"
    return server


@contextmanager
def _trame_globals_restored() -> Iterator[None]:
    """Hide the command line from trame, and restore the environment and trame's globals afterwards."""
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


def _remove_from_trame(server: Any) -> None:
    """Remove the server from trame's global variables, which would keep it alive."""
    from trame_client.widgets.core import HTML_CTX

    if HTML_CTX._server is server:
        HTML_CTX._server = None
