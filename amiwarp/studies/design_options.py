"""Options of the command ``design``."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated

import typer

from amiwarp.cli import common as cli
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.optics.prism import FlatSide

if TYPE_CHECKING:
    from amiwarp.studies.design import Limits, Timing


_in_limits = partial(typer.Option, rich_help_panel="Limits")
_in_faults = partial(typer.Option, rich_help_panel="Faults")
_in_optics = partial(typer.Option, rich_help_panel="Other optics")

DEPTHS_M = "0.5,1,2"
"""Depths of the scene for a plate, unless others are given [m]."""


@dataclass(frozen=True)
class GridOptions:
    """Options for the prisms and speeds to compare."""

    apex_deg: Annotated[
        str, cli.in_prism(help="Apex angles to compare (deg).", metavar="A,B,...")
    ] = "0.25,0.5,1,2,4"
    rpm: Annotated[str, cli.in_prism(help="Speeds to compare (turns/min).", metavar="A,B,...")] = (
        "180,360,720,1440,2880"
    )
    index: Annotated[float, cli.in_prism(help="Refractive index of the prism.")] = 1.5168
    flat_side: Annotated[
        FlatSide, cli.in_prism(help="Direction that the prism's flat face points to.")
    ] = FlatSide.SCENE

    @property
    def apexes(self) -> list[float]:
        """Apex angles to compare [rad]."""
        return [math.radians(v) for v in _list(self.apex_deg, "--apex-deg")]

    @property
    def rpms(self) -> list[float]:
        """Speeds to compare [turns/min]."""
        return list(_list(self.rpm, "--rpm"))


@dataclass(frozen=True)
class LimitOptions:
    """Options for the limits that prism and speed must meet."""

    tolerance_px: Annotated[
        float, _in_limits(help="Largest standard deviation across an edge after compensation (px).")
    ] = 0.5
    window_ms: Annotated[
        float, _in_limits(help="Time within which edges of every direction must be seen (ms).")
    ] = 33.4
    bandwidth_mev_s: Annotated[
        float | None,
        _in_limits(help="Largest event rate of sensor and cable (million events/s). Default: any."),
    ] = None
    budget_px: Annotated[
        float | None,
        _in_limits(
            help="Largest error of the prism model (px rms). Default: a tenth of the blur from pixels, clock and "
            "encoder."
        ),
    ] = None

    def build(self) -> Limits:
        """Return the limits that the options set for the study."""
        from amiwarp.studies.design import Limits

        most = None if self.bandwidth_mev_s is None else self.bandwidth_mev_s * 1e6
        return Limits(self.tolerance_px, self.window_ms, most, self.budget_px)


@dataclass(frozen=True)
class FaultOptions:
    """Options for the errors of event times and encoder angles."""

    clock_us: Annotated[
        float,
        _in_faults(help="Standard deviation of the event times, from readout and jitter (us)."),
    ] = 60.0
    encoder_deg: Annotated[
        float, _in_faults(help="Standard deviation of the encoder's angle (deg).")
    ] = 0.1
    contrast: Annotated[float, _in_faults(help="Contrast threshold (log intensity).")] = 0.25

    def timing(self) -> Timing:
        """Return the errors of event times and encoder angles."""
        from amiwarp.studies.design import Timing

        return Timing(self.clock_us, math.radians(self.encoder_deg))


@dataclass(frozen=True)
class OpticsOptions:
    """Options for the comparison with other optics."""

    compare: Annotated[
        bool,
        _in_optics(
            "--compare",
            help="Compare the recommended wedge with a pair of wedges, a mirror with two tilts, a vibrating camera "
            "and a rotating tilted plate that move the image as far.",
        ),
    ] = False
    depth_m: Annotated[
        str | None,
        _in_optics(
            help=f"Depths of the scene for the plate (m). Default: {DEPTHS_M}.", metavar="A,B,..."
        ),
    ] = None

    optic: Annotated[
        str | None,
        _in_optics(
            help="Say where this optic can be calibrated, as it was measured in simulations, and draw it: wedge, pair, "
            "mirror, vibration or plate.",
            metavar="NAME",
        ),
    ] = None
    trouble: Annotated[
        list[str] | None,
        _in_optics(
            help="Trouble of your rig, such as eccentric_deg=2: what was measured nearest to it is said. Can be "
            "repeated. View and threshold are as with the other options.",
            metavar="NAME=VALUE",
        ),
    ] = None

    @property
    def troubles(self) -> dict[str, float]:
        """Troubles of the rig by name."""
        given = {}
        for text in self.trouble or ():
            name, equals, value = text.partition("=")
            try:
                number = float(value)
            except ValueError:
                number = math.nan
            if not equals or not math.isfinite(number):
                raise AmiwarpError(
                    f"--trouble {text}: give a name and a number, such as eccentric_deg=2"
                )
            given[name.strip()] = number
        return given

    @property
    def depths(self) -> list[float]:
        """Depths of the scene for the plate [m]."""
        return list(_list(self.depth_m or DEPTHS_M, "--depth-m"))

    def check(self) -> None:
        """Raise :class:`AmiwarpError` if the options contradict each other."""
        if self.depth_m is not None and not self.compare:
            raise AmiwarpError(
                "--depth-m applies to the comparison of optics; give --compare, or remove --depth-m",
                ErrorCode.OPTIONS,
            )
        if self.trouble and self.optic is None:
            raise AmiwarpError(
                "--trouble applies to the optic of your rig; give --optic, or remove --trouble",
                ErrorCode.OPTIONS,
            )


def _list(text: str, name: str) -> tuple[float, ...]:
    return cli.numbers(text, text.count(",") + 1, name)
