"""Web page that shows the pictures of a live stream, as MJPEG: JPEG pictures in one answer that goes on."""

from __future__ import annotations

import io
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import numpy as np

from amiwarp.choices import Tone
from amiwarp.errors import AmiwarpError
from amiwarp.live.stream.sockets import listen
from amiwarp.reconstruction.phase_camera import LivePicture
from amiwarp.reconstruction.picture_files import SteadyLevels, limits, tones

PAGE = b"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>amiwarp live</title>
<style>body{margin:0;background:#111;display:grid;place-items:center;min-height:100vh}
img{max-width:100vw;max-height:100vh;min-width:50vw}</style></head>
<body><img src="/pictures.mjpg" alt="Picture of the scene"></body></html>
"""
BOUNDARY = "amiwarp-picture"
"""Text between two pictures of an answer."""
QUALITY = 85
"""Quality of the JPEG pictures, 1 to 95."""
MOST_CLIENTS = 8
"""Largest number of clients that see pictures at a time."""
SEND_S = 2.0
"""Longest wait for a client that does not read or ask [s]. It is then disconnected."""
STEP_S = 0.5
"""Longest wait for a picture between two checks whether the page has ended [s]."""


class PicturePage:
    """Server of the page, at ``HOST:PORT``. A client gets the newest picture each time, and may miss some.

    The server listens at 127.0.0.1 unless the address names a host. Raises :class:`AmiwarpError` if it cannot listen
    there.
    """

    def __init__(self, address: str) -> None:
        if not address.rpartition(":")[2].isdecimal():
            raise AmiwarpError(
                f"{address}: is not an address; give HOST:PORT, for example 127.0.0.1:8000"
            )
        listening, actual = listen(f"tcp:{address}")
        self.address = f"http://{actual.removeprefix('tcp:')}/"
        """Address of the page, with the port that the system chose if 0 was given."""
        self._levels = SteadyLevels()
        self._picture = b""
        self._number = 0
        self._clients = 0
        self._closed = False
        self._changed = threading.Condition()
        self._server = _Server(listening.getsockname(), _Answer, bind_and_activate=False)
        self._server.socket.close()
        self._server.socket = listening
        self._server.page = self
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.1,), name="amiwarp-page", daemon=True
        )
        self._thread.start()

    def __enter__(self) -> PicturePage:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __call__(self, picture: LivePicture) -> None:
        """Show a picture."""
        scene = picture.picture
        between = self._levels.follow(*limits(scene))
        with self._changed:
            if not self._clients:
                self._picture = b""
                return
        grey = np.rint(255.0 * tones(scene, Tone.MAPPED, between=between)).astype(np.uint8)
        data = _jpeg(grey)
        with self._changed:
            self._picture = data
            self._number += 1
            self._changed.notify_all()

    def close(self) -> None:
        """Disconnect the clients and close the server. May be called twice."""
        if self._closed:
            return
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()  # waits for the answers

    def add_client(self) -> bool:
        """Count a client that wants pictures; return False if there are too many."""
        with self._changed:
            free = self._clients < MOST_CLIENTS and not self._closed
            self._clients += free
            return free

    def remove_client(self) -> None:
        """Count a client that left."""
        with self._changed:
            self._clients -= 1

    def next_picture(self, number: int) -> tuple[int, bytes] | None:
        """Wait for a picture after the one of a number; return its number and JPEG data, or None at the end."""
        with self._changed:
            while not self._closed:
                if self._number > number and self._picture:
                    return self._number, self._picture
                self._changed.wait(STEP_S)
        return None


class _Server(ThreadingHTTPServer):
    daemon_threads = False
    page: PicturePage

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing about clients that disconnect."""


class _Answer(BaseHTTPRequestHandler):
    timeout = SEND_S
    server: _Server

    def do_GET(self) -> None:
        if self.path == "/":
            self._send(HTTPStatus.OK, "text/html; charset=utf-8", PAGE)
        elif self.path == "/pictures.mjpg":
            self._send_pictures()
        else:
            self._send(HTTPStatus.NOT_FOUND, "text/plain", b"not found\n")

    def log_message(self, format: str, *args: Any) -> None:
        """Print nothing."""

    def _send(self, status: HTTPStatus, kind: str, data: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(data)

    def _send_pictures(self) -> None:
        page = self.server.page
        if not page.add_client():
            self._send(HTTPStatus.SERVICE_UNAVAILABLE, "text/plain", b"too many clients\n")
            return
        try:
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={BOUNDARY}")
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            number = 0
            while (newer := page.next_picture(number)) is not None:
                number, data = newer
                head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                self.wfile.write(head.encode() + data + b"\r\n")
            self.wfile.write(f"--{BOUNDARY}--\r\n".encode())
        finally:
            page.remove_client()


def _jpeg(grey: Any) -> bytes:
    """Return the bytes of a JPEG picture."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(grey).save(buffer, format="JPEG", quality=QUALITY)
    return buffer.getvalue()
