"""Options for simulated worlds: world, camera trajectory, and ground truth to record and draw."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from amiwarp.cli import common as cli
from amiwarp.cli import say
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.output_formats import check_ending
from amiwarp.simulation.choices import Seeing
from amiwarp.simulation.worlds.world_scene import WorldScene

if TYPE_CHECKING:
    from amiwarp.simulation.simulator import Simulation


_in_world = partial(typer.Option, rich_help_panel="World")


@dataclass(frozen=True)
class WorldOptions:
    """Options of a simulation in a three-dimensional world instead of a picture."""

    world: Annotated[
        str | None,
        _in_world(
            help="Simulate a 3-D world instead of a picture: room, desk, corridor, street, ball, person, or a world "
            "file (.toml, .json).",
            metavar="NAME|FILE",
        ),
    ] = None
    trajectory: Annotated[
        str | None,
        _in_world(
            help="Camera motion in the world: still, handheld, fast, or a file of poses (.txt in TUM format, .csv). "
            "Default: the trajectory in the world file, or handheld for a named world.",
            metavar="NAME|FILE",
        ),
    ] = None
    no_prism: Annotated[
        bool,
        _in_world(
            "--no-prism",
            help="Simulate the same scene, sensor and seed with a plain event camera without a prism. The recording "
            "then has no encoder.",
        ),
    ] = False
    seeing: Annotated[
        Seeing | None,
        _in_world(
            help="How the light of each pixel is computed: maps (look-up in pre-rendered pictures of the world) or "
            "rays (ray casting through the prism: exact, but slow on a CPU). Default: maps."
        ),
    ] = None
    motion_px: Annotated[
        float | None,
        _in_world(
            help="Largest motion of the image between two renderings of the world, 0.01 to 2 (px). A smaller value is "
            "more accurate and slower. Default: 0.5."
        ),
    ] = None
    truth_hz: Annotated[
        float | None,
        _in_world(
            help="Rate at which depth, normals, instances, optical flow and intensity of all pixels are recorded "
            "(1/s). Default: not recorded."
        ),
    ] = None
    truth_us: Annotated[
        str | None,
        _in_world(
            help="Instants of this truth instead of a rate (us), such as 0,12000,35000. Displacements lead from each "
            "to the next one, and back.",
            metavar="T,T,...",
        ),
    ] = None
    preview: Annotated[
        Path | None,
        _in_world(
            help="Figure to write (.png): the view of the camera in the middle of the recording, with and without the "
            "prism, with depth and optical flow.",
            metavar="<path>",
        ),
        cli.OUTPUT,
    ] = None

    def check(self) -> None:
        """Raise :class:`AmiwarpError` if a given option does not apply, or two options are incompatible."""
        given = {
            "--trajectory": self.trajectory,
            "--seeing": self.seeing,
            "--motion-px": self.motion_px,
            "--truth-hz": self.truth_hz,
            "--truth-us": self.truth_us,
            "--preview": self.preview,
        }
        if self.world is None:
            for name, value in given.items():
                if value is not None:
                    raise AmiwarpError(
                        f"{name} applies to a world; give --world, or remove {name}",
                        ErrorCode.OPTIONS,
                    )
        if self.motion_px is not None and self.seeing is Seeing.RAYS:
            raise AmiwarpError(
                "--motion-px applies to maps; give --seeing maps, or remove --motion-px",
                ErrorCode.OPTIONS,
            )
        if self.truth_hz is not None and self.truth_us is not None:
            raise AmiwarpError(
                "--truth-hz and --truth-us are both given; give one of them", ErrorCode.OPTIONS
            )
        if self.preview is not None:
            check_ending(self.preview, "previews are written", [".png"])

    @property
    def truth_times_us(self) -> tuple[float, ...] | None:
        """Instants whose ground truth is recorded [us], or None if they are not given one by one."""
        if self.truth_us is None:
            return None
        return cli.numbers(self.truth_us, self.truth_us.count(",") + 1, "--truth-us")

    def build_scene(self, duration_s: float, *, seed: int, blur: float) -> WorldScene:
        """Return the world and the camera's trajectory. ``blur``: standard deviation of the optical blur [px]."""
        from amiwarp.simulation.worlds.world_choice import animation_notes, open_world

        world, trajectory = open_world(
            self.world or "", self.trajectory, seed=seed, duration_s=duration_s
        )
        for note in animation_notes(world):
            say(note)
        given = {
            name: value
            for name in ("seeing", "motion_px")
            if (value := getattr(self, name)) is not None
        }
        return WorldScene(world, trajectory, blur=blur, **given)

    def draw_preview(self, simulation: Simulation) -> None:
        """Write the preview figure if ``--preview`` is given."""
        if self.preview is None:
            return
        from amiwarp.plotting.world_figure import draw_preview
        from amiwarp.simulation.truth_renderer import TruthRenderer

        draw_preview(self.preview, TruthRenderer(simulation).at(simulation.duration_us // 2))
