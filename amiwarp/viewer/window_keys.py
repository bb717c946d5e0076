"""Keys of the window, with the actions that they run and their help."""

from __future__ import annotations

from amiwarp.viewer import layout

X_KEYS = {
    "Right": "ArrowRight",
    "Left": "ArrowLeft",
    "space": " ",
    "question": "?",
    "h": "?",
    "plus": "+",
    "equal": "+",
    "minus": "-",
    "comma": ",",
    "period": ".",
    "bracketleft": "[",
    "bracketright": "]",
}
"""Keys by their names in VTK, where these differ."""
MORE_KEYS = (
    ("Up", ("nudge", 1), "the parameter moved last: up by a step"),
    ("Down", ("nudge", -1), "the parameter moved last: down by a step"),
    ("Tab", ("choose_next", "knob"), "choose the next parameter for these keys and the curve"),
    ("m", ("choose_next", "model"), "next optical model"),
    ("v", ("take_truth",), "take the known true parameters of a simulation"),
    (
        "5",
        ("toggle", "depth_shown"),
        "the depth map (--depth) as an image and as points, or the clouds",
    ),
    ("6", ("choose_next", "image"), "next kind of images"),
    ("k", ("choose_next", "colour"), "next quantity shown by colour"),
    ("n", ("choose_next", "polarity"), "ON, OFF or both"),
    ("7", ("filter", "hide_hot"), "hide or show hot pixels"),
    ("8", ("filter", "noise_us"), "hide or show background activity (no neighbour within 2 ms)"),
    (",", ("scale_count", 0.5), "a time window with half as many events, which it keeps"),
    (".", ("scale_count", 2.0), "a time window with twice as many events, which it keeps"),
    ("[", ("scale_decay", 0.5), "half the decay time of the decaying time surface"),
    ("]", ("scale_decay", 2.0), "twice the decay time of the decaying time surface"),
    ("i", ("toggle", "statistics_shown"), "statistics of the selected events: show or hide"),
    ("x", ("toggle", "optic_shown"), "controls of a prism, for a recording without one"),
    ("+", ("resize_points", 1.0), "larger points"),
    ("-", ("resize_points", -1.0), "smaller points"),
    ("g", ("choose_next_beside",), "next of several recordings given with --beside"),
    ("u", ("save_next_view",), "save what is shown as a bookmark, beside the recording"),
    ("j", ("open_next_view",), "show the next bookmark"),
    ("f", ("film",), "film from here on, at a tenth of real time; f ends it, c cancels it"),
    ("q", ("close",), "close the window"),
)
"""Keys that only the window has, as :data:`amiwarp.viewer.layout.KEYS`."""
WINDOW_WORDS = {"p": "save a picture of the window"}
"""Help of keys that do something else in the window than on the page."""
KEYS = (
    tuple((key, action, WINDOW_WORDS.get(key, words)) for key, action, words in layout.KEYS)
    + MORE_KEYS
)
"""All keys of the window."""
OF_OPTICS = {"t", "o", "b", "c", "a", "s", "Up", "Down", "Tab", "m", "v", "e"}
"""Keys that act on a prism or on compensated events."""
OF_PLAIN = {"x"}
"""Keys that only a recording without a prism needs."""
PLAIN_WORDS = {
    "ArrowRight": "forward by the window's length",
    "ArrowLeft": "back by the window's length",
    "3": "view along y: x-t",
    "4": "view along x: y-t",
}
"""Help of keys in a recording without a prism, where it differs."""
MOUSE = (
    ("drag", "turn the clouds; with shift move, with the right button or the wheel zoom"),
    ("click", "an event: its values and its orbit"),
    ("images", "drag a region; the mouse reads the values"),
    ("time", "drag the window or its ends; wheel zooms, with shift move"),
)
"""What the mouse does, and where."""


def help_rows(*, optic: bool, depth: bool) -> list[tuple[str, str]]:
    """Return the keys that a recording needs and what they do, and what the mouse does.

    ``optic``: whether there are controls of a prism; ``depth``: whether there is a depth map.
    """
    left_out = (OF_PLAIN if optic else OF_OPTICS) | (set() if depth else {"5"})
    rows = [
        (key, words if optic else PLAIN_WORDS.get(key, words))
        for key, _, words in KEYS
        if key not in left_out
    ]
    return [*rows, *MOUSE]
