"""Draw the three pictures of the front page. The site shows them inline, in the colours of its light or dark theme.

    python docs/images/prism.py

The first is a sketch, not to scale. The others show simulated events: one turn of a prism in front of a still camera,
as recorded and as ``amiwarp.compensate_events`` returns them.
"""

import math
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

import amiwarp

HERE = Path(__file__).parent
WIDTH, HEIGHT, SCALE = 75, 52, 4
ON, OFF = "#e0761b", "#3c8fd0"
CORNERS = [(0.27, 0.35), (0.54, 0.24), (0.66, 0.60), (0.40, 0.76)]
"""The white area of the scene, in parts of width and height."""

SKETCH = f"""\
<g fill="none" stroke="currentColor" stroke-width="1.5">
<path d="M8 105H292" stroke-dasharray="7 4 2 4" opacity="0.45"/>
<path d="M118 48H126L142 162H118Z" fill="{OFF}" fill-opacity="0.25"/>
<path d="M101 40A29 9 0 1 1 157 40M157 40l-1 -10M157 40l-9 -4" stroke-width="2"/>
<path d="M200 68Q212 105 200 142Q188 105 200 68Z" fill="{OFF}" fill-opacity="0.25"/>
<path d="M266 62V148" stroke-width="4"/>
<g stroke="{ON}" stroke-width="2"><path d="M14 105L118 90L131 89L266 120"/>
<path d="M14 105L118 120L131 121L266 90" stroke-dasharray="5 4"/>
<ellipse cx="266" cy="105" rx="5" ry="15"/></g></g>
<circle cx="14" cy="105" r="4" fill="{ON}"/>
<g fill="currentColor" font-size="15" text-anchor="middle"><text x="46" y="134">scene point</text>
<text x="129" y="22">wedge turns</text><text x="200" y="166">lens</text><text x="266" y="172">sensor</text></g>"""


def svg(title: str, content: str) -> str:
    """Return a picture of 300 x 208 units."""
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH * SCALE} {HEIGHT * SCALE}" role="img" '
        f'aria-label="{title}" font-family="sans-serif">\n{content}\n</svg>\n'
    )


def dots(x: np.ndarray, y: np.ndarray, p: np.ndarray) -> str:
    """Return events as dots, ON orange and OFF blue."""
    out = ""
    for polarity, colour in ((1, ON), (0, OFF)):
        points = "".join(
            f"M{a:.0f} {b:.0f}h0" for a, b in zip(x[p == polarity], y[p == polarity], strict=True)
        )
        out += f'<path d="{points}" stroke="{colour}" stroke-width="2.2" stroke-linecap="round" fill="none"/>\n'
    return out


def main() -> None:
    """Simulate the events and write the three files."""
    picture = Image.new("L", (8 * WIDTH, 8 * HEIGHT), 60)
    ImageDraw.Draw(picture).polygon([(8 * WIDTH * a, 8 * HEIGHT * b) for a, b in CORNERS], fill=200)
    camera, prism = (
        amiwarp.Camera.from_fov(WIDTH, HEIGHT, math.radians(20)),
        amiwarp.Prism(math.radians(1.6)),
    )
    with tempfile.TemporaryDirectory() as folder:
        picture.save(f"{folder}/scene.png")
        recording = amiwarp.simulate(
            f"{folder}/scene.png", camera, prism, duration_s=0.2, motion=720.0, seed=1
        )
    events = recording.events.between(80_000, 80_000 + 83_333)
    model = amiwarp.ExactModel(camera, prism)
    rest = amiwarp.compensate_events(events, model, recording.encoder)
    corner = [camera.width * CORNERS[1][0] - 0.5, camera.height * CORNERS[1][1] - 0.5]
    orbit = (model.deflect_points([corner] * 33, np.linspace(0, 2 * np.pi, 33)) + 0.5) * SCALE
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in orbit)
    path = f'<polyline points="{points}" fill="none" stroke="currentColor" stroke-width="2"/>\n'
    rng = np.random.default_rng(1)
    spread = rng.uniform(-0.5, 0.5, (2, len(events)))  # an event comes from anywhere in its pixel
    keep = rng.permutation(len(events))[:1200]
    panels = {
        "recorded": (
            "As recorded: the edges of a still shape are bands as wide as a corner's circle",
            events.x,
            events.y,
        ),
        "compensated": (
            "The same events after compensation: the edges are thin",
            rest[:, 0],
            rest[:, 1],
        ),
    }
    for name, (title, x, y) in panels.items():
        places = [
            ((values + 0.5 + shift) * SCALE)[keep]
            for values, shift in zip((x, y), spread, strict=True)
        ]
        (HERE / f"prism_{name}.svg").write_text(
            svg(title, dots(*places, events.p[keep]) + (path if name == "recorded" else ""))
        )
    title = "A ray from a scene point through the wedge and the lens to the sensor, now and half a turn later"
    (HERE / "prism_sketch.svg").write_text(svg(title, SKETCH))
    print(f"{len(events)} events in the turn, {len(keep)} drawn")


if __name__ == "__main__":
    main()
