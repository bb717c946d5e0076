"""Results of the command ``design`` as JSON data, tables and lines of text."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from amiwarp.cli import common as cli

if TYPE_CHECKING:
    from amiwarp.studies.design import Choice, Design
    from amiwarp.studies.optics_comparison import Compared, Comparison
    from amiwarp.studies.stability.optic_map import RigOnMap


def calibration_lines(rig: RigOnMap) -> list[Any]:
    """Return where an optic can be calibrated as a table and a line of text."""
    note = (
        f"numbers of simulated recordings at 320x240: answered within {rig.known.limit_px:g} px, named (larger error, "
        "and a warning names the cause), refused, or silent (larger error, no warning of it); median error of answers"
    )
    return [cli.table(rig.rows(), f"{rig.optic}: trouble", "your rig", "measured"), note]


def design_summary(design: Design) -> dict[str, Any]:
    """Return all results of the study for JSON, with angles in degrees."""
    from amiwarp.studies.design_words import headline, reasons

    camera = design.camera
    volume = design.volume
    bandwidth = design.limits.bandwidth
    return {
        "format": "amiwarp-design",
        "version": 1,
        "camera": {
            name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")
        },
        "prism": {"index": design.glass.index, "flat_side": design.glass.flat_side.value},
        "limits": {
            "tolerance_px": design.limits.tolerance_px,
            "window_ms": design.limits.window_ms,
            "bandwidth_mev_s": None if bandwidth is None else bandwidth / 1e6,
            "budget_px": design.limits.budget_px,
        },
        "faults": {
            "clock_us": design.timing.clock_us,
            "encoder_deg": math.degrees(design.timing.encoder),
        },
        "volume": {
            "apex_deg": [math.degrees(apex) for apex in volume.apexes],
            "rpm": volume.rpms.tolist(),
            "yields": volume.yields.tolist(),
            "uncertainty": volume.uncertainty,
            "texture_per_px": volume.texture,
            "contrast": volume.contrast,
            "noise_hz": volume.noise_hz,
            "simulated_pixels": volume.simulated,
        },
        "choices": [_fields(c) for c in design.choices],
        "recommended": None if design.chosen is None else _fields(design.chosen),
        "headline": headline(design),
        "reasons": reasons(design),
        "failed": design.failed,
    }


def _fields(choice: Choice) -> dict[str, Any]:
    orbit = choice.orbit
    return {
        "apex_deg": math.degrees(orbit.apex),
        "rpm": choice.rpm,
        "deflection_deg": math.degrees(orbit.deflection),
        "radius_px": orbit.radius,
        "smallest_radius_px": orbit.smallest,
        "swing_px": orbit.swing,
        "events_per_s": choice.events_per_s,
        "window_ms": choice.window_ms,
        "clock_px": choice.clock_px,
        "encoder_px": choice.encoder_px,
        "blur_px": choice.blur_px,
        "budget_px": choice.budget_px,
        "model": choice.model,
        "error_px": choice.error_px,
        **{f"{name}_error_px": error for name, error in orbit.errors.items()},
        "misses": list(choice.misses),
    }


def design_lines(design: Design, files: dict[str, str]) -> list[Any]:
    """Return the results as tables and lines of text."""
    from amiwarp.studies.design_words import headline, reasons
    from amiwarp.studies.quantities import degrees, rate

    rows = []
    for choice in design.choices:
        row = (
            degrees(choice.orbit.apex),
            f"{choice.rpm:g}",
            rate(choice.events_per_s),
            f"{choice.orbit.radius:.1f} px",
            f"{choice.error_px:.3f} px",
            choice.model,
            f"{choice.window_ms:.1f} ms",
            "recommended" if choice is design.chosen else ", ".join(choice.misses),
        )
        rows.append(row)
    shown = cli.table(rows, "apex", "rpm", "events", "orbit", "error", "model", "window", "misses")
    reason_rows = [tuple(line.split(": ", 1)) for line in reasons(design)]
    return [
        shown,
        "",
        headline(design),
        cli.table(reason_rows),
        "",
        *files.values(),
        *failed_names(design.failed),
    ]


def failed_names(failed: Mapping[str, str]) -> list[str]:
    """Return a line of text with the names of what failed in a study; none if nothing did."""
    if not failed:
        return []
    return [f"failed, and left out: {'; '.join(failed)}"]


def comparison_summary(comparison: Comparison) -> dict[str, Any]:
    """Return all results of the comparison of optics for JSON, with angles in degrees."""
    from amiwarp.studies.optics_comparison_words import reasons

    return {
        "format": "amiwarp-optics",
        "version": 1,
        "reference": {
            "apex_deg": math.degrees(comparison.reference.orbit.apex),
            "rpm": comparison.reference.rpm,
            "misses": list(comparison.reference.misses),
        },
        "window_ms": comparison.design.limits.window_ms,
        "optics": [_optic_fields(r) for r in comparison.results],
        "recommended": {
            a.task: None if a.chosen is None else a.chosen.setting.name for a in comparison.advice
        },
        "reasons": reasons(comparison),
        "failed": dict(comparison.failed),
    }


def _optic_fields(compared: Compared) -> dict[str, Any]:
    glass, drive, state = compared.setting.NEEDS[compared.setting.kind]
    covered = compared.coverage
    return {
        "optic": compared.setting.name,
        "size": compared.setting.size,
        "turns_per_s": compared.setting.hz,
        "radius_px": compared.radius,
        "smallest_radius_px": compared.smallest,
        "swing_px": covered.swing,
        "complete_ms": compared.complete_ms,
        "left_out_share": covered.left_out,
        "least_moved_edges_deg": math.degrees(covered.blind),
        "clock_px": compared.clock_px,
        "angle_px": compared.encoder_px,
        "blur_px": compared.blur_px,
        "events_per_s": compared.events_per_s,
        "simulated_events_per_s": compared.simulated_per_s,
        "simulation_uncertainty": compared.uncertainty,
        "law_deviation": compared.deviation,
        "events_per_s_px": compared.events_per_s_px,
        "depth_m": 1.0 / compared.setting.inverse_depth if compared.setting.inverse_depth else None,
        "depth_determined": compared.depth_deviation is not None,
        "depth_deviation": compared.depth_deviation,
        "glass": glass,
        "drive": drive,
        "state_from": state,
        "misses": list(compared.misses),
    }


def comparison_lines(comparison: Comparison) -> list[Any]:
    """Return the comparison of optics as tables of text."""
    from amiwarp.studies.optics_comparison_words import reasons
    from amiwarp.studies.quantities import rate

    rows = []
    for result in comparison.results:
        complete = "never"
        if math.isfinite(result.complete_ms):
            complete = f"{result.complete_ms:.1f} ms"
        depth = "not determined"
        if result.depth_deviation is not None:
            depth = f"± {100 * result.depth_deviation:.2g} %"
        row = (
            result.setting.name,
            result.setting.size,
            f"{result.setting.hz:g}/s",
            f"{result.radius:.2f} px",
            f"{result.coverage.swing:.2f} px",
            complete,
            f"{result.blur_px:.3f} px",
            rate(result.events_per_s),
            f"{100 * result.deviation:+.0f} ± {100 * result.uncertainty:.1g} %",
            depth,
            ", ".join(result.misses),
        )
        rows.append(row)
    heads = (
        "optic",
        "size",
        "turns",
        "motion",
        "edges",
        "all edges",
        "blur",
        "events",
        "to simulation",
        "depth",
        "misses",
    )
    reason_rows = [tuple(line.split(": ", 1)) for line in reasons(comparison)]
    return [cli.table(rows, *heads), "", cli.table(reason_rows)]
