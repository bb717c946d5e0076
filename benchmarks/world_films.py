"""Draw films of events in named worlds, in three panels: without the prism, through it, and coloured by depth.

    python -m benchmarks.world_films [room ball street] [--frames 30] [--motion-px 0.5] [--device cuda:0]

A film shows moments that are SPACING_S apart, and at each the events of WINDOW_S. It plays more slowly than the
simulated time passes. Depth is the distance of the surface that an event saw, from the ground truth.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray
from PIL import Image, ImageColor, ImageDraw, ImageFont

from amiwarp.events.events import Events
from amiwarp.imaging.palette import OFF_COLOUR, ON_COLOUR
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import Prism
from amiwarp.simulation.simulator import Simulation
from amiwarp.simulation.worlds.named import named_world
from amiwarp.simulation.worlds.world import WorldScene

CAMERA, PRISM = Camera.from_fov(320, 240, math.radians(60.0)), Prism(math.radians(1.0))
SPACING_S = 1.0 / 60.0
"""Time between frames [s]: a fifth of a turn at 720 rpm."""
WINDOW_S = 0.002
"""Time over which a frame of the film collects events [s]."""
FRAMES_PER_S = 10
WIDTH, HEIGHT, GAP, TOP, BOTTOM = 240, 180, 6, 22, 26
"""Width and height of a panel, space between panels, space above and space below the panels [px]."""
SHADES, GREYS = 48, 8
"""Number of colours of depth, and number of greys from white to black, in the palette."""
TITLES = ("without the prism", "through the prism", "through the prism, by depth")
WHITE, BLACK, OF_SKY = 0, GREYS - 1, 3
"""Indices of white, black and the grey of the sky in the palette: greys, then OFF, ON, and the colours of depth."""


@dataclass(frozen=True, slots=True)
class DepthScale:
    """Logarithmic scale that converts depth [m] to colours."""

    low: float
    high: float

    @classmethod
    def of_events(cls, depth: NDArray[np.float32]) -> DepthScale:
        """Return a scale from the 2nd to the 98th percentile of the depths of events [m]."""
        low, high = np.percentile(depth[np.isfinite(depth)], (2.0, 98.0))
        return cls(float(low), max(float(high), 1.2 * float(low)))

    def colours(self, depth: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Return the palette index of each depth. The sky is grey."""
        seen = np.isfinite(depth)
        share = np.log(np.where(seen, depth, self.low) / self.low) / math.log(self.high / self.low)
        shade = GREYS + 2 + np.clip(share * SHADES, 0, SHADES - 1).astype(int)
        return np.where(seen, shade, OF_SKY).astype(np.uint8)


def palette() -> list[int]:
    """Return the colours of the films: red, green and blue of each, 0 to 255."""
    greys = [(round(255 - 255 * k / (GREYS - 1)),) * 3 for k in range(GREYS)]
    polarities = [ImageColor.getrgb(colour) for colour in (OFF_COLOUR, ON_COLOUR)]
    shades = np.rint(255 * colormaps["viridis_r"](np.linspace(0.0, 1.0, SHADES))[:, :3]).astype(int).tolist()
    return [int(value) for colour in (*greys, *polarities, *shades) for value in colour]


def simulate(name: str, frames: int, motion_px: float, device: str) -> list[tuple[Events, NDArray[np.float32]]]:
    """Simulate a world; return its events and their depths [m] without the prism and through it."""
    seconds = frames * SPACING_S
    world, trajectory = named_world(name, "handheld", duration_s=seconds)
    simulation = Simulation(WorldScene(world, trajectory, motion_px=motion_px), CAMERA, PRISM, seconds, device=device)
    runs = []
    for each in (simulation.without_prism(), simulation):
        events, truth = zip(*each.blocks_with_truth(), strict=True)
        depth = np.concatenate([block.depth for block in truth])
        runs.append((Events.concatenate(list(events)), depth))
    return runs


def panel(events: Events, colour: NDArray[np.uint8], window: slice) -> NDArray[np.uint8]:
    """Return a panel of colour indices; the latest event of a pixel is on top."""
    out = np.full((HEIGHT, WIDTH), WHITE, np.uint8)
    x = events.x[window].astype(int) * WIDTH // CAMERA.width
    out[events.y[window].astype(int) * HEIGHT // CAMERA.height, x] = colour[window]
    return out


def write_text(image: NDArray[np.uint8], text: str, x: int, y: int, *, anchor: str = "la") -> None:
    """Write text into an image of colour indices."""
    page = Image.new("L", image.shape[::-1])
    ImageDraw.Draw(page).text((x, y), text, fill=255, font=ImageFont.load_default(size=12), anchor=anchor)
    ink = np.rint(np.asarray(page) / 255.0 * BLACK).astype(np.uint8)
    image[ink > 0] = ink[ink > 0]


def background(scale: DepthScale) -> NDArray[np.uint8]:
    """Return the still part of a film: titles, the colours of depth, and the borders of the panels."""
    image = np.full((TOP + HEIGHT + BOTTOM, 3 * WIDTH + 4 * GAP), WHITE, np.uint8)
    for k, title in enumerate(TITLES):
        left = GAP + k * (WIDTH + GAP)
        write_text(image, title, left, 4)
        image[TOP - 1 : TOP + HEIGHT + 1, left - 1 : left + WIDTH + 1] = 2
    y, left, right = TOP + HEIGHT + 9, 3 * GAP + 2 * WIDTH + 50, 3 * GAP + 3 * WIDTH - 52
    image[y : y + 10, left:right] = GREYS + 2 + np.arange(right - left) * SHADES // (right - left)
    write_text(image, f"{scale.low:.1f} m", left - 5, y - 2, anchor="ra")
    write_text(image, f"{scale.high:.1f} m", right + 5, y - 2)
    write_text(image, "ON", GAP, y - 2)
    write_text(image, "OFF", GAP + 42, y - 2)
    image[y : y + 10, GAP + 22 : GAP + 32], image[y : y + 10, GAP + 70 : GAP + 80] = GREYS + 1, GREYS
    return image


def draw(runs: list[tuple[Events, NDArray[np.float32]]], count: int) -> list[Image.Image]:
    """Return the frames of a film."""
    (bare, _), (events, depth) = runs
    scale = DepthScale.of_events(depth)
    layers = [(each, np.where(each.p == 1, GREYS + 1, GREYS).astype(np.uint8)) for each in (bare, events)]
    layers.append((events, scale.colours(depth)))
    still, colours = background(scale), palette()
    frames = []
    for number in range(count):
        begin = number * SPACING_S * 1e6 + 1000.0
        image = still.copy()
        for k, (each, colour) in enumerate(layers):
            window = slice(*np.searchsorted(each.t, (begin, begin + WINDOW_S * 1e6)).tolist())
            left = GAP + k * (WIDTH + GAP)
            image[TOP : TOP + HEIGHT, left : left + WIDTH] = panel(each, colour, window)
        write_text(
            image,
            f"at {begin * 1e-3:.0f} ms, {WINDOW_S * 1e3:g} ms of events",
            GAP + WIDTH,
            TOP + HEIGHT + 7,
            anchor="ra",
        )
        frame = Image.fromarray(image).convert("P")
        frame.putpalette(colours)
        frames.append(frame)
    return frames


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("worlds", nargs="*", default=["room", "ball", "street"])
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--motion-px", type=float, default=0.5, help="largest motion between two maps [px]")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    args = parser.parse_args()
    for name in args.worlds:
        first, *others = draw(simulate(name, args.frames, args.motion_px, args.device), args.frames)
        path = args.out / f"world_{name}.gif"
        first.save(path, save_all=True, append_images=others, duration=1000 // FRAMES_PER_S, loop=0, optimize=False,
                   disposal=1)  # fmt: skip
        print(f"{path}: {path.stat().st_size / 1e3:.0f} kB", flush=True)


if __name__ == "__main__":
    main()
