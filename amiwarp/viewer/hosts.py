"""Under which names a server is reached: the address to open, and which ``Host`` headers are its own."""

from __future__ import annotations

import errno
import ipaddress
import socket
from typing import TYPE_CHECKING

from yarl import URL

from amiwarp.errors import AmiwarpError

if TYPE_CHECKING:
    from aiohttp import web

ANYWHERE = {"0.0.0.0": (socket.AF_INET, "192.0.2.1"), "::": (socket.AF_INET6, "2001:db8::1")}
"""Hosts that stand for every address of the machine: their family, and an address (of documentation) far away."""
LOCAL = frozenset({"localhost", "127.0.0.1", "::1"})


def plain(host: str) -> str:
    """Return a host without the brackets of IPv6 and in one spelling."""
    host = host.strip().strip("[]").rstrip(".").lower()
    try:
        return str(ipaddress.ip_address(host))
    except ValueError:
        return host


def is_local(host: str) -> bool:
    """Return whether only this machine reaches what is served on ``host``."""
    try:
        return ipaddress.ip_address(plain(host)).is_loopback
    except ValueError:
        return plain(host) == "localhost"


def reachable(host: str) -> str:
    """Return a host that other machines can open: ``host`` itself or, if it is every address, one of this machine."""
    host = plain(host)
    if host not in ANYWHERE:
        return host
    family, far = ANYWHERE[host]
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as probe:  # connecting sends nothing, it chooses the way there
            probe.connect((far, 9))
            return str(probe.getsockname()[0])
    except OSError:
        return socket.gethostname()


def address(host: str, port: int, token: str) -> str:
    """Return what to open in a browser."""
    return str(URL.build(scheme="http", host=reachable(host), port=port, path="/") % {"token": token})


def warning(host: str) -> str | None:
    """Return what to say before others can reach the server; None if only this machine can."""
    if is_local(host):
        return None
    return (
        f"warning: served on {host}, without encryption: everybody in the network who has the address can see the "
        "recording, control the inspector and write files by its exports; for one person prefer an SSH tunnel"
    )


class Names:
    """What a server is called: a page under any other name reached it by a name that leads here by a trick."""

    def __init__(self, host: str) -> None:
        names = {plain(host), reachable(host)}
        if not is_local(host):
            own = socket.gethostname().lower()
            names |= {own, f"{own}.local", own.partition(".")[0]}
        self.known = LOCAL | (names - ANYWHERE.keys())

    def are_of(self, request: web.Request) -> bool:
        """Return whether the request is for this server, under a name it has or the address at which it arrived."""
        try:
            asked = plain(URL(f"http://{request.host}").host or "")
        except ValueError:
            return False
        arrived = request.transport.get_extra_info("sockname") if request.transport is not None else None
        return asked in self.known or (arrived is not None and asked == plain(str(arrived[0])))


def cannot_serve(error: OSError, host: str, port: int) -> AmiwarpError:
    """Return an error that says why nothing can be served there."""
    if isinstance(error, socket.gaierror):
        return AmiwarpError(f"--host {host!r}: is no known name or address; give one of this machine, as 127.0.0.1")
    if error.errno == errno.EADDRINUSE:
        return AmiwarpError(f"--port {port}: is in use on {host}; give another port, or 0 for a free one")
    if error.errno == errno.EADDRNOTAVAIL:
        return AmiwarpError(f"--host {host!r}: is no address of this machine; give one of its own, as 127.0.0.1")
    if error.errno in (errno.EACCES, errno.EPERM):
        return AmiwarpError(f"--port {port}: may not be used by you; give one above 1023, or 0 for a free one")
    return AmiwarpError(f"--host {host!r} --port {port}: cannot be served: {error.strerror or error}; give others")
