"""Command-line options for simulated worlds: world, camera trajectory, and ground truth to record and draw."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from amiwarp.cli.options import OUTPUT
from amiwarp.errors import AmiwarpError
from amiwarp.io.output_formats import check_ending
from amiwarp.simulation.worlds.choices import Seeing

if TYPE_CHECKING:
    from amiwarp.simulation.simulator import Simulation
    from amiwarp.simulation.worlds.world_scene import WorldScene

_WORLD = "World"


@dataclass(frozen=True)
class WorldOptions:
    """Options of a simulation in a three-dimensional world instead of a picture."""

    world: Annotated[
        str | None,
        typer.Option(
            help="Simulate a 3-D world instead of a picture: room, desk, corridor, street, ball, person, or a world "
            "file (.toml, .json).",
            metavar="NAME|FILE",
            rich_help_panel=_WORLD,
        ),
    ] = None
    trajectory: Annotated[
        str | None,
        typer.Option(
            help="Camera motion in the world: still, handheld, fast, or a file of poses (.txt in TUM format, .csv). "
            "Default: the trajectory in the world file, or handheld for a named world.",
            metavar="NAME|FILE",
            rich_help_panel=_WORLD,
        ),
    ] = None
    no_prism: Annotated[
        bool,
        typer.Option(
            "--no-prism",
            help="Simulate the same scene, sensor and seed with a plain event camera without a prism. The recording "
            "then has no encoder.",
            rich_help_panel=_WORLD,
        ),
    ] = False
    seeing: Annotated[
        Seeing | None,
        typer.Option(
            help="How the light of each pixel is computed: maps (look-up in pre-rendered pictures of the world) or "
            "rays (ray casting through the prism: exact, but slow on a CPU). Default: maps.",
            rich_help_panel=_WORLD,
        ),
    ] = None
    motion_px: Annotated[
        float | None,
        typer.Option(
            help="Largest motion of the image between two renderings of the world, 0.01 to 2 (px). A smaller value is "
            "more accurate and slower. Default: 0.5.",
            rich_help_panel=_WORLD,
        ),
    ] = None
    truth_hz: Annotated[
        float | None,
        typer.Option(
            help="Rate at which depth, normals, instances, optical flow and intensity of all pixels are recorded "
            "(1/s). Default: not recorded.",
            rich_help_panel=_WORLD,
        ),
    ] = None
    preview: Annotated[
        Path | None,
        typer.Option(
            help="Figure to write (.png): the view of the camera in the middle of the recording, with and without the "
            "prism, with depth and optical flow.",
            metavar="<path>",
            rich_help_panel=_WORLD,
        ),
        OUTPUT,
    ] = None

    def check(self) -> None:
        """Raise :class:`AmiwarpError` if a given option does not apply, or two options are incompatible."""
        given = {"--trajectory": self.trajectory, "--seeing": self.seeing, "--motion-px": self.motion_px,
                 "--truth-hz": self.truth_hz, "--preview": self.preview}  # fmt: skip
        if self.world is None:
            for name, value in given.items():
                if value is not None:
                    raise AmiwarpError(f"{name} applies to a world; give --world, or remove {name}")
        if self.motion_px is not None and self.seeing is Seeing.RAYS:
            raise AmiwarpError("--motion-px applies to maps; give --seeing maps, or remove --motion-px")
        if self.preview is not None:
            check_ending(self.preview, "previews are written", [".png"])

    def build_scene(self, duration_s: float, *, seed: int, blur: float) -> WorldScene:
        """Return the world and the camera's trajectory. ``blur``: standard deviation of the optical blur [px]."""
        from amiwarp.simulation.worlds.open_world import open_world
        from amiwarp.simulation.worlds.world_scene import WorldScene

        world, trajectory = open_world(self.world or "", self.trajectory, seed=seed, duration_s=duration_s)
        given = {name: value for name in ("seeing", "motion_px") if (value := getattr(self, name)) is not None}
        return WorldScene(world, trajectory, blur=blur, **given)

    def draw_preview(self, simulation: Simulation) -> None:
        """Write the preview figure if ``--preview`` is given."""
        if self.preview is None:
            return
        from amiwarp.plotting.world_preview import draw_preview
        from amiwarp.simulation.worlds.frame_truth import TruthRenderer

        draw_preview(self.preview, TruthRenderer(simulation).at(simulation.duration_us // 2))
