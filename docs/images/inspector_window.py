"""Draw the picture of the inspector's window on its page.

    python docs/images/inspector_window.py DEMO

``DEMO`` is the folder of ``amiwarp demo --size 320x240``.
"""

import sys
from pathlib import Path

from PIL import Image

import amiwarp
from amiwarp.viewer import window
from amiwarp.viewer.inspector import WINDOW_POINTS, Inspector

SIZE = (1400, 890)
"""Width and height of the picture [px]."""


def main(demo: str) -> None:
    """Draw the window as it is when nothing moves, with all curves."""
    recording = amiwarp.open_recording(f"{demo}/recording.h5")
    calibration = amiwarp.Calibration.load(f"{demo}/calibration.json")
    window.REST_S = 0.0
    shown = window.Window(
        Inspector(recording, calibration, most_points=WINDOW_POINTS), size=SIZE, off_screen=True
    )
    while shown.run_once():
        pass
    picture = Image.fromarray(shown.scene.picture()).quantize(128, dither=Image.Dither.NONE)
    picture.save(Path(__file__).with_name("window.png"), optimize=True)
    shown.scene.close()


if __name__ == "__main__":
    main(sys.argv[1])
