"""Whether this machine can open a window."""

import os
import sys
from ctypes import CDLL, c_void_p
from ctypes.util import find_library

from amiwarp.errors import AmiwarpError


def check_display(remedy: str) -> None:
    """Raise :class:`AmiwarpError`, which ends in ``remedy``, if no window can be opened: VTK would end the process."""
    if not sys.platform.startswith("linux"):
        return
    libraries = find_library("X11"), find_library("GL")
    if None in libraries:
        raise AmiwarpError(
            f"a window needs libX11 and libGL; on Debian run: apt-get install libx11-6 libgl1; or {remedy}"
        )
    x11 = CDLL(libraries[0])
    x11.XOpenDisplay.restype = c_void_p
    x11.XCloseDisplay.argtypes = [c_void_p]
    display = x11.XOpenDisplay(None)
    if display is None:
        given = os.environ.get("DISPLAY")
        found = (
            f"the display {given!r} cannot be opened"
            if given
            else "there is no display to open a window on"
        )
        raise AmiwarpError(f"{found}; {remedy}")
    x11.XCloseDisplay(display)
    os.environ["VTK_DEFAULT_OPENGL_WINDOW"] = "vtkXOpenGLRenderWindow"
