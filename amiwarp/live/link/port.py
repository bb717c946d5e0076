"""Serial ports: opened by name, by USB id, or found by what they send."""

from __future__ import annotations

import errno
import re
import time
from typing import Any

from amiwarp.errors import AmiwarpError
from amiwarp.live.link.protocol import Decoder

BAUD = 460_800
"""Of a UART; a port over USB alone takes any."""
READ_S, WRITE_S = 0.05, 0.5
"""Longest wait for a byte, and for a port to take some."""
LISTEN_S = 1.0
"""Before a port that sends nothing that is understood is left."""
_USB = re.compile(r"([0-9a-fA-F]{4}):([0-9a-fA-F]{4})")


def open_port(where: str | None) -> Any:
    """The opened ``serial.Serial``: by name or URL of pySerial, by USB id ``VID:PID`` (hexadecimal), or None: found.

    Raises :class:`AmiwarpError` where it is not there or cannot be opened, naming the ports that there are.
    """
    if where is None:
        return _find()
    match = _USB.fullmatch(where)
    if match is None:
        return _open(where)
    wanted = int(match[1], 16), int(match[2], 16)
    names = [p.device for p in _ports() if (p.vid, p.pid) == wanted]
    if len(names) != 1:
        raise AmiwarpError(f"USB id {where}: {len(names)} ports have it; {_there_are()}")
    return _open(names[0])


def usb_id(name: str) -> str | None:
    """``VID:PID`` of a port, where it is the only one with it."""
    ports = _ports()
    ids = [(p.vid, p.pid) for p in ports if p.device == name and p.vid is not None]
    if len(ids) != 1 or sum((p.vid, p.pid) == ids[0] for p in ports) != 1:
        return None
    return f"{ids[0][0]:04x}:{ids[0][1]:04x}"


def _ports() -> list[Any]:
    from serial.tools import list_ports

    return sorted(list_ports.comports(), key=lambda p: p.device)


def _there_are() -> str:
    told = [p.device if p.vid is None else f"{p.device} ({p.vid:04x}:{p.pid:04x} {p.product})" for p in _ports()]
    return f"there are {', '.join(told)}" if told else "there is no serial port; is the controller plugged in?"


def _open(name: str) -> Any:
    import serial

    try:
        return serial.serial_for_url(name, BAUD, timeout=READ_S, write_timeout=WRITE_S, exclusive=True)
    except Exception as error:  # termios.error too, which is no OSError
        number = getattr(error, "errno", None)
        if number in (errno.EAGAIN, errno.EBUSY):
            raise AmiwarpError(f"{name}: another program has this port open; end that first") from error
        if number == errno.EACCES:
            raise AmiwarpError(f"{name}: no permission; on Linux join the group of the port (ls -l {name})") from error
        why = "no such port" if number == errno.ENOENT else f"cannot be opened ({error})"
        raise AmiwarpError(f"{name}: {why}; {_there_are()}") from error


def _find() -> Any:
    """The first port on which frames or lines come."""
    said = []
    for candidate in _ports():
        try:
            port = _open(candidate.device)
        except AmiwarpError as error:
            said.append(str(error))
            continue
        if _sends(port):
            return port
        port.close()
    detail = "".join(f" ({line})" for line in said)
    raise AmiwarpError(f"no port sends what a controller sends; {_there_are()}{detail}; give one by name")


def _sends(port: Any) -> bool:
    decoder, end = Decoder(), time.monotonic() + LISTEN_S
    while time.monotonic() < end:
        try:
            decoder.feed(port.read(max(1, port.in_waiting)))
        except OSError:
            return False
        if decoder.received.frames or decoder.received.lines > 1:
            return True
    return False
