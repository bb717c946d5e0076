"""Connections over TCP and Unix sockets: connecting, listening, accepting."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import stat
import time
from collections.abc import Generator
from typing import Any

from amiwarp.errors import AmiwarpError, ErrorCode

CONNECT_S = 10.0
"""Longest wait for a connection to a sender of events [s]."""
RETRY_S = 1.0
"""Longest single attempt to reach a sender of events that was lost [s]."""
IDLE_S = 0.05
"""Longest single wait for an incoming connection [s]."""


class Unreachable(AmiwarpError):
    """Raised if no sender or client is reachable now; a later attempt may succeed."""

    _KIND = ErrorCode.UNREACHABLE


def ready(file: Any, timeout_s: float, *, to_write: bool = False) -> bool:
    """Wait until a file or socket can be read (or written) without blocking, or is broken; return False on time-out.

    Unlike ``select.select``, this supports file descriptors above 1023. Windows can wait for sockets only: there a pipe
    counts as ready, and its reader or writer waits.
    """
    if not hasattr(select, "poll"):
        try:
            return any(
                select.select([] if to_write else [file], [file] if to_write else [], [], timeout_s)
            )
        except OSError:
            return True
    poll = select.poll()
    poll.register(file, select.POLLOUT if to_write else select.POLLIN)
    return bool(poll.poll(round(1e3 * timeout_s)))


def _parse(address: str) -> str | tuple[str, int]:
    """Return the path of a Unix socket, or the host and the port of a TCP address."""
    kind, _, rest = address.partition(":")
    if kind == "unix" and rest:
        return rest
    if kind != "tcp":
        raise AmiwarpError(f"{address}: is not an address; give tcp:HOST:PORT or unix:PATH")
    return host_and_port(address, "tcp:HOST:PORT or unix:PATH")


def host_and_port(address: str, forms: str) -> tuple[str, int]:
    """Return host and port of ``KIND:HOST:PORT``, 127.0.0.1 without a host. ``forms``: what a message suggests."""
    host, _, port = address.partition(":")[2].rpartition(":")
    if not port.isdecimal():
        raise AmiwarpError(f"{address}: is not an address; give {forms}")
    if int(port) > 65535:
        raise AmiwarpError(f"{address}: is not an address; give {forms}, with a port up to 65535")
    return host.strip("[]") or "127.0.0.1", int(port)


def _family(target: str | tuple[str, int]) -> socket.AddressFamily:
    if isinstance(target, str):
        if not hasattr(socket, "AF_UNIX"):
            raise AmiwarpError(
                f"unix:{target}: this system has no Unix sockets; give tcp:HOST:PORT"
            )
        return socket.AF_UNIX
    return socket.AF_INET6 if ":" in target[0] else socket.AF_INET


def connect(address: str, timeout_s: float = CONNECT_S) -> socket.socket:
    """Connect to the sender that listens at ``address``. Raises :class:`Unreachable` if there is none."""
    target = _parse(address)
    try:
        if not isinstance(target, str):
            return socket.create_connection(target, timeout_s)
        connection = socket.socket(_family(target))
        try:
            connection.settimeout(timeout_s)
            connection.connect(target)
        except BaseException:
            connection.close()
            raise
        return connection
    except OSError as error:
        raise Unreachable(
            f"{address}: {error.strerror or error}; start its sender first"
        ) from error


def listen(address: str) -> tuple[socket.socket, str]:
    """Return a listening socket and its address, with the actual port if the port given was 0.

    Replaces a Unix socket without a listener. Raises :class:`AmiwarpError` if it cannot listen at ``address``.
    """
    target = _parse(address)
    family = _family(target)
    try:
        if isinstance(target, str):
            _remove_stale(target)
        server = socket.create_server(target, family=family)
    except OSError as error:
        why = error.strerror or error
        raise AmiwarpError(
            f"{address}: cannot listen at this address: {why}; choose another address",
            ErrorCode.UNREACHABLE,
        ) from error
    if isinstance(target, str):
        return server, address
    host = f"[{target[0]}]" if ":" in target[0] else target[0]
    return server, f"tcp:{host}:{server.getsockname()[1]}"


def _remove_stale(path: str) -> None:
    """Remove the socket file of a process that no longer exists."""
    with contextlib.suppress(FileNotFoundError):
        if stat.S_ISSOCK(os.stat(path).st_mode):
            with socket.socket(socket.AF_UNIX) as probe:
                try:
                    probe.connect(path)
                except ConnectionRefusedError:
                    os.unlink(path)


def accept(address: str) -> socket.socket:
    """Wait without limit for a sender that connects to ``address``, and return the connection."""
    return next(connection for connection in iter_accepted(address) if connection is not None)


def iter_accepted(address: str) -> Generator[socket.socket | None, None, None]:
    """Listen at ``address`` and yield connections.

    While nobody connects, None is yielded at least every :data:`IDLE_S`.
    """
    server, _ = listen(address)
    try:
        server.setblocking(False)
        while True:
            connection = None
            if ready(server, IDLE_S):
                with contextlib.suppress(
                    OSError
                ):  # the client left, or no file descriptor is free: try again
                    connection = server.accept()[0]
                if connection is None:
                    time.sleep(IDLE_S)
            yield connection
    finally:
        close_listener(server)


def iter_connected(address: str) -> Generator[socket.socket | None, None, None]:
    """Connect to ``address`` repeatedly and yield each connection.

    While no connection is possible, None is yielded at least every second.
    """
    while True:
        try:
            yield connect(address, RETRY_S)
        except Unreachable:
            for _ in range(4):
                yield None
                time.sleep(IDLE_S)


def close_listener(server: socket.socket) -> None:
    """Close a listening socket and remove the file of a Unix socket."""
    name = server.getsockname()
    server.close()
    if isinstance(name, str) and name:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(name)
