"""Host names and addresses of the server: the URL to open, and the ``Host`` headers that it accepts."""

from __future__ import annotations

import errno
import ipaddress
import socket
from typing import TYPE_CHECKING

from amiwarp.errors import AmiwarpError

if TYPE_CHECKING:
    from aiohttp import web


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
        with socket.socket(
            family, socket.SOCK_DGRAM
        ) as probe:  # connecting UDP sends nothing; it selects a route
            probe.connect((remote, 9))
            return str(probe.getsockname()[0])
    except OSError:
        return socket.gethostname()


def address(host: str, port: int, token: str) -> str:
    """Return the URL to open in a browser. Its path is the token."""
    from yarl import URL

    return str(URL.build(scheme="http", host=reachable(host), port=port) / token / "")


class HostNames:
    """Host names under which the server may be called.

    A request with any other name in its ``Host`` header may come from a foreign page whose host name resolves to this
    machine (DNS rebinding).
    """

    def __init__(self, host: str) -> None:
        names = {"localhost", "127.0.0.1", "::1", normalised(host), reachable(host)}
        if not is_local(host):
            own_name = socket.gethostname().lower()
            names |= {own_name, f"{own_name}.local", own_name.partition(".")[0]}
        self.known = names - ALL_INTERFACES.keys()

    def accept(self, request: web.Request) -> bool:
        """Return whether the request's ``Host`` is a known name or the address at which the request arrived."""
        from yarl import URL

        try:
            requested = normalised(URL(f"http://{request.host}").host or "")
        except ValueError:
            return False
        arrived = (
            request.transport.get_extra_info("sockname") if request.transport is not None else None
        )
        return requested in self.known or (
            arrived is not None and requested == normalised(str(arrived[0]))
        )


def cannot_serve(error: OSError, host: str, port: int) -> AmiwarpError:
    """Return the error to raise if the server cannot listen at ``host`` and ``port``."""
    denied = f"--port {port}: permission denied; give a port above 1023, or 0 for a free one"
    known = {
        errno.EADDRINUSE: f"--port {port}: is in use on {host}; give another port, or 0 for a free one",
        errno.EADDRNOTAVAIL: f"--host {host!r} is not an address of this machine; give one, such as 127.0.0.1",
        errno.EACCES: denied,
        errno.EPERM: denied,
    }
    if isinstance(error, socket.gaierror):
        return AmiwarpError(
            f"--host {host!r}: unknown name or address; give one of this machine, such as 127.0.0.1"
        )
    usual = f"--host {host!r} --port {port}: cannot listen: {error.strerror or error}; give another host or port"
    # newer asyncio gives no number if no address of the host is one of this machine
    return AmiwarpError(known.get(error.errno or errno.EADDRNOTAVAIL, usual))
