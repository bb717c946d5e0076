"""Options for simulated worlds: the world, the camera's trajectory in it, and the ground truth to record and draw."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from amiwarp.cli.options import OUTPUT
from amiwarp.errors import AmiwarpError
from amiwarp.simulation.worlds.choices import Seeing

if TYPE_CHECKING:
    from amiwarp.simulation.simulator import Simulation
    from amiwarp.simulation.worlds.world_scene import WorldScene

_WORLD = "World"


@dataclass(frozen=True)
class WorldOptions:
    """Options for a three-dimensional world instead of a picture."""

    world: Annotated[
        str | None,
        typer.Option(
            help="World instead of a picture: room, desk, corridor, street, ball, person, or a world file (.toml, "
            ".json).",
            metavar="NAME|FILE",
            rich_help_panel=_WORLD,
        ),
    ] = None
    trajectory: Annotated[
        str | None,
        typer.Option(
            help="Camera's way through the world: still, handheld or fast, or a file of poses (.txt as TUM, .csv). "
            "Default: that of the world file, or handheld.",
            metavar="NAME|FILE",
            rich_help_panel=_WORLD,
        ),
    ] = None
    no_prism: Annotated[
        bool,
        typer.Option(
            "--no-prism",
            help="Take the prism out: the same scene, sensor and seed with a plain event camera. The recording then "
            "has no encoder.",
            rich_help_panel=_WORLD,
        ),
    ] = False
    seeing: Annotated[
        Seeing | None,
        typer.Option(
            help="How pixels see the world: maps (pictures of the world, blended between) or rays (through the prism "
            "into the world, exact, and slow on a CPU). Default: maps.",
            rich_help_panel=_WORLD,
        ),
    ] = None
    motion_px: Annotated[
        float | None,
        typer.Option(
            help="Largest motion between two maps, 0.01 to 2 (px). Smaller is more accurate and slower. Default: 0.5.",
            rich_help_panel=_WORLD,
        ),
    ] = None
    truth_hz: Annotated[
        float | None,
        typer.Option(
            help="Rate at which depth, normals, instances, optical flow and intensity are recorded (1/s). Default: "
            "never.",
            rich_help_panel=_WORLD,
        ),
    ] = None
    preview: Annotated[
        Path | None,
        typer.Option(
            help="Figure to write (.png): what the camera sees in the middle of the recording, with and without the "
            "prism, and the depth and optical flow.",
            metavar="<path>",
            rich_help_panel=_WORLD,
        ),
        OUTPUT,
    ] = None

    def check(self) -> None:
        """Raise :class:`AmiwarpError` for options that do not apply."""
        given = {"--trajectory": self.trajectory, "--seeing": self.seeing, "--motion-px": self.motion_px,
                 "--truth-hz": self.truth_hz, "--preview": self.preview}  # fmt: skip
        if self.world is None:
            for name, value in given.items():
                if value is not None:
                    raise AmiwarpError(f"{name} applies to a world; give --world, or remove {name}")
        if self.motion_px is not None and self.seeing is Seeing.RAYS:
            raise AmiwarpError("--motion-px applies to maps; give --seeing maps, or remove --motion-px")
        if self.preview is not None and self.preview.suffix.lower() != ".png":
            raise AmiwarpError(f"{self.preview}: a preview is a PNG file; give a name that ends in .png")

    def build_scene(self, duration_s: float, *, seed: int, blur: float) -> WorldScene:
        """Return the world and the camera's trajectory. ``blur``: standard deviation of the optical blur [px]."""
        from amiwarp.simulation.worlds.open_world import open_world
        from amiwarp.simulation.worlds.world_scene import WorldScene

        world, trajectory = open_world(self.world or "", self.trajectory, seed=seed, duration_s=duration_s)
        given = {name: value for name in ("seeing", "motion_px") if (value := getattr(self, name)) is not None}
        return WorldScene(world, trajectory, blur=blur, **given)

    def draw_preview(self, simulation: Simulation) -> None:
        """Write the preview figure if an option asks for it."""
        if self.preview is None:
            return
        from amiwarp.plotting.world_preview import draw_preview
        from amiwarp.simulation.worlds.frame_truth import TruthRenderer

        draw_preview(self.preview, TruthRenderer(simulation).at(simulation.duration_us // 2))
