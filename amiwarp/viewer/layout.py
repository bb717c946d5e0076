"""Names, units and keys of the inspector's page, and the page's template."""

from __future__ import annotations

import math

from amiwarp.choices import View
from amiwarp.viewer.serve import read_template

UNITS = {
    "apex": math.radians(1.0), "phase": math.radians(1.0), "clock_offset": 1.0, "tilt_x": math.radians(1.0),
    "tilt_y": math.radians(1.0), "rpm": 1.0,
}  # fmt: skip
"""Conversion from the page's units (angles in degrees) to the parameters' units (radians): factor per parameter."""
NAMES = tuple(UNITS)
"""Names of the prism parameters that have a slider."""
_TILTED = "model === 'exact' || model === 'ellipse'"
SLIDERS = {
    "apex": ("apex angle", "°", ("0", "apex_most", "0.005"), "true"),
    "phase": ("phase", "°", ("-180", "180", "0.25"), "true"),
    "clock_offset": ("clock offset", "µs", ("-20000", "20000", "10"), "has_encoder"),
    "rpm": ("speed of the prism", "rpm", ("-3000", "3000", "0.5"), "!has_encoder"),
    "tilt_x": ("tilt in x", "°", ("-5", "5", "0.05"), _TILTED),
    "tilt_y": ("tilt in y", "°", ("-5", "5", "0.05"), _TILTED),
}
"""Sliders of the page by parameter: label, unit, (minimum, maximum, step), and the condition for showing the slider."""
SPEEDS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1, 3, 10)
"""Choices of the playback speed, relative to real time."""
VIEWS = ((View.FREE.value, "corner"), (View.XY.value, "x-y"), (View.X_AXIS.value, "x-θ"), (View.Y_AXIS.value, "y-θ"))
"""Viewpoints of the clouds, with the texts of their buttons."""
SCOPES = ("selection", "whole recording")
"""Choices of the events that a calibration uses."""
TOOLS = (("region", "draw region"), ("move", "move"), ("measure", "measure"))
"""What a drag of the mouse does on the images: name and text."""
KEYS = (
    ("ArrowRight", ("step", 1), "forward by one turn, or by the window's length"),
    ("ArrowLeft", ("step", -1), "back by one turn, or by the window's length"),
    (" ", ("play",), "play (or follow a live stream), or stop"),
    ("1", ("look_from", View.FREE.value), "view from the corner"),
    ("2", ("look_from", View.XY.value), "view along the third axis: x-y, the image"),
    ("3", ("look_from", View.X_AXIS.value), "view along y: x-θ"),
    ("4", ("look_from", View.Y_AXIS.value), "view along x: y-θ"),
    ("e", ("suggest",), "show the suggested region"),
    ("w", ("whole",), "show the whole image"),
    ("t", ("toggle_axis",), "third axis: prism angle or time"),
    ("o", ("toggle", "overlaid"), "side by side or overlaid"),
    ("d", ("toggle", "dark"), "light or dark"),
    ("l", ("toggle", "loop"), "play in a loop, or once"),
    ("z", ("undo",), "undo"),
    ("y", ("redo",), "redo"),
    ("r", ("reset",), "back to the first state"),
    ("b", ("keep_b",), "keep the parameters as B, to compare with"),
    ("c", ("calibrate",), "calibrate, or cancel"),
    ("a", ("accept",), "accept the result of the calibration"),
    ("s", ("export", "calibration"), "download the calibration"),
    ("p", ("export", "picture"), "download a picture of the clouds"),
    ("?", ("toggle", "help_shown"), "show or hide this help"),
)
"""Keys of the page: name of the key, method of the panel with its arguments, and help text."""


def template() -> str:
    """Return the page's template with its sliders."""
    return read_template().replace("@KNOBS@", "\n".join(map(_knob, SLIDERS)))


def _knob(name: str) -> str:
    label, unit, (least, most, step), where = SLIDERS[name]
    return (
        f'<KnobField v-if="{where}" name="{name}" label="{label}" unit="{unit}" :value="{name}" :least="{least}" '
        f':most="{most}" :step="{step}" :truth="truths.{name}" :note="sources.{name}" @drag="{name} = $event" '
        f"@typed=\"trigger('typed', ['{name}', $event])\" "
        f"@chosen=\"trigger('choose', ['{name}'])\"></KnobField>"
    )
