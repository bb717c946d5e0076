"""Pseudo-terminal that offers an emulated controller as a serial port."""

from __future__ import annotations

import contextlib
import os
import select
from collections.abc import Callable
from pathlib import Path

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.live.link.clocks import monotonic_us
from amiwarp.live.link.emulator import Controller
from amiwarp.tasks import BackgroundLoop

STEP_S = 1e-3
"""Interval between updates of the emulated controller [s]."""
RETRY_S = 0.2
"""Interval between attempts to open a pseudo-terminal after a failure [s]."""


class PseudoTerminal(BackgroundLoop):
    """Pseudo-terminal that runs an emulated controller in real time, in a background thread, until closed.

    ``path``: symbolic link to the port. It exists while the emulated cable is plugged in, and points to the new port
    after a reconnection, so that programs find it under the same name. ``now_us``: emulation time [us]; default: time
    since the creation of this object. Raises :class:`AmiwarpError` if ``path`` exists or its folder does not,
    or if the system has no pseudo-terminals.
    """

    def __init__(
        self,
        controller: Controller,
        path: str | os.PathLike[str] | None = None,
        *,
        now_us: Callable[[], int] | None = None,
    ) -> None:
        if not hasattr(os, "openpty"):
            raise AmiwarpError(
                "this system has no pseudo-terminals; the emulator needs Linux or macOS"
            )
        self._path = None if path is None else Path(path)
        # A dangling link is the remnant of a killed process and may be replaced.
        if self._path is not None and self._path.exists():
            raise AmiwarpError(
                f"{path}: this file already exists; give another path for the link to the port, or remove the file",
                ErrorCode.OUTPUT_EXISTS,
            )
        if self._path is not None and not self._path.parent.is_dir():
            raise AmiwarpError(
                f"{path}: there is no folder {self._path.parent}; make it, or give another path for the port's link",
                ErrorCode.FILE_MISSING,
            )
        origin = monotonic_us()
        self._now_us = now_us or (lambda: monotonic_us() - origin)
        self._controller = controller
        self._master: int | None = None
        self._open()
        self._start_thread("amiwarp-emulator")

    @property
    def name(self) -> str:
        """Name under which programs open the port: the symbolic link if there is one, else the pseudo-terminal."""
        return self._port if self._path is None else str(self._path)

    def close(self) -> None:
        """Stop the background thread, and remove the port and the symbolic link."""
        try:
            super().close()
        finally:
            self._close()

    def _run(self) -> None:
        while not self._ended.is_set():
            data = self._read(self._master)
            now = self._now_us()
            self._controller.feed(data, now)
            out = self._controller.advance(now)
            if self._controller.plugged and self._master is None:
                try:
                    self._open()
                except OSError:  # no free file descriptor: try again later
                    self._ended.wait(RETRY_S)
            elif not self._controller.plugged and self._master is not None:
                self._close()
            # Without a reader, or with a slow one, bytes are lost, as on any serial line without flow control.
            if out and self._master is not None and not self._without_peer(self._master):
                with contextlib.suppress(OSError):
                    os.write(self._master, out)

    def _read(self, master: int | None) -> bytes:
        """Return the bytes that the program at the other end sent, after waiting for at most :data:`STEP_S`."""
        if master is None or self._without_peer(master):
            self._ended.wait(STEP_S)
            return b""
        poll = select.poll()
        poll.register(master, select.POLLIN)
        if not poll.poll(round(1e3 * STEP_S)):
            return b""
        with contextlib.suppress(OSError):
            return os.read(master, 4096)
        return b""

    def _without_peer(self, master: int) -> bool:
        poll = select.poll()
        poll.register(master, 0)
        return any(event & select.POLLHUP for _, event in poll.poll(0))

    def _open(self) -> None:
        import tty

        master, port = os.openpty()
        try:
            self._port = os.ttyname(port)
            tty.setraw(port)
            os.set_blocking(master, False)
        except BaseException:
            os.close(master)
            raise
        finally:
            os.close(port)
        self._master = master
        if self._path is not None:
            self._remove_link()
            self._path.symlink_to(self._port)

    def _remove_link(self) -> None:
        # Leave a file that replaced the link.
        if self._path is not None and self._path.is_symlink():
            self._path.unlink()

    def _close(self) -> None:
        self._remove_link()
        if self._master is not None:
            os.close(self._master)
            self._master = None
