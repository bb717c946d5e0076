"""Serial ports, opened by name, by USB id, or by detection of the controller."""

from __future__ import annotations

import errno
import re
import time
from typing import Any

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.live.link import protocol

BAUD = 460_800
"""Baud rate of the serial port [bit/s]. USB CDC ports ignore it."""
READ_S = 0.05
WRITE_S = 0.5
"""Time-outs of a read and of a write on the port [s]."""
LISTEN_S = 1.0
"""Time for which each port is read when the controller is searched for [s]."""
_USB = re.compile(r"([0-9a-fA-F]{4}):([0-9a-fA-F]{4})")


def open_port(where: str | None) -> Any:
    """Open a port and return its ``serial.Serial``.

    ``where``: name, pySerial URL, USB id ``VID:PID`` (hexadecimal), or None to detect the controller. Raises
    :class:`AmiwarpError`, with the available ports, if there is no such port or it cannot be opened.
    """
    if where is None:
        return _find()
    match = _USB.fullmatch(where)
    if match is None:
        return _open(where)
    wanted = int(match[1], 16), int(match[2], 16)
    names = [port.device for port in _ports() if (port.vid, port.pid) == wanted]
    if len(names) != 1:
        remedy = ", give a port by name" if names else ""
        raise AmiwarpError(
            f"USB id {where}: {len(names)} ports have this id{remedy}; {_available()}",
            ErrorCode.UNREACHABLE,
        )
    return _open(names[0])


def usb_id(name: str) -> str | None:
    """Return ``VID:PID`` of a port, or None if it has none or shares it with another port."""
    ports = _ports()
    ids = [(port.vid, port.pid) for port in ports if port.device == name and port.vid is not None]
    if len(ids) != 1:
        return None
    own_id = ids[0]
    if sum((port.vid, port.pid) == own_id for port in ports) != 1:
        return None
    vendor, product = own_id
    return f"{vendor:04x}:{product:04x}"


def _ports() -> list[Any]:
    """Return the serial ports of this machine, sorted by name; ``vid`` and ``pid`` are None without a USB id."""
    from serial.tools import list_ports

    return sorted(list_ports.comports(), key=lambda port: port.device)


def _available() -> str:
    """Return which ports there are, for messages."""
    listed = []
    for port in _ports():
        known = []
        if port.vid is not None:
            known.append(f"{port.vid:04x}:{port.pid:04x}")
        if port.product:
            known.append(port.product)
        listed.append(f"{port.device} ({' '.join(known)})" if known else port.device)
    if not listed:
        return "there is no serial port; is the controller plugged in?"
    return f"there are {', '.join(listed)}"


def _open(name: str) -> Any:
    """Open a port by its name; raise :class:`AmiwarpError` with the reason and the available ports."""
    import serial

    try:
        return serial.serial_for_url(
            name, BAUD, timeout=READ_S, write_timeout=WRITE_S, exclusive=True
        )
    except Exception as error:  # includes termios.error, which is not an OSError
        number = getattr(error, "errno", None)
        if number in (errno.EAGAIN, errno.EBUSY):
            raise AmiwarpError(
                f"{name}: another program has this port open; close that program first",
                ErrorCode.UNREACHABLE,
            ) from error
        if number == errno.EACCES:
            raise AmiwarpError(
                f"{name}: no permission to open this port; on Linux join the port's group (see ls -l {name})",
                ErrorCode.UNREACHABLE,
            ) from error
        why = "no such port" if number == errno.ENOENT else f"cannot be opened ({error})"
        raise AmiwarpError(f"{name}: {why}; {_available()}", ErrorCode.UNREACHABLE) from error


def _find() -> Any:
    """Open the first port on which controller frames or lines arrive, and return it."""
    errors = []
    for candidate in _ports():
        try:
            port = _open(candidate.device)
        except AmiwarpError as error:
            errors.append(str(error))
            continue
        if _is_controller(port):
            return port
        port.close()
    detail = "".join(f" ({line})" for line in errors)
    raise AmiwarpError(
        f"no port sends controller data; {_available()}{detail}; give a port by name",
        ErrorCode.UNREACHABLE,
    )


def _is_controller(port: Any) -> bool:
    """Return whether controller frames or lines arrive within :data:`LISTEN_S`."""
    decoder = protocol.FrameDecoder()
    end = time.monotonic() + LISTEN_S
    while time.monotonic() < end:
        try:
            decoder.feed(port.read(max(1, port.in_waiting)))
        except OSError:
            return False
        if decoder.received.frames or decoder.received.lines > 1:
            return True
    return False
