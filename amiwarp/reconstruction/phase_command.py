"""Command ``phase``: what whole turns tell of each pixel, from sums of its events in phase with the optic."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from amiwarp.cli import common as cli
from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Recording
from amiwarp.io import open_recording
from amiwarp.io.output_formats import check_ending

MOVED = 0.5
"""Misfit over which something has probably moved at a pixel."""


def run_phase(
    recording: Annotated[Path, typer.Argument(help="Recording in any supported format.")],
    calibration: Annotated[
        Path, typer.Argument(help="Calibration file from 'amiwarp calibrate' (.json).")
    ],
    out: Annotated[Path, typer.Argument(help="Image in phase to write (.npz)."), cli.OUTPUT],
    *,
    start: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            help="Start of the used turns (s from the first event). Default: one turn, less in short recordings.",
        ),
    ] = None,
    turns: Annotated[
        int, typer.Option(min=1, max=1000, help="Number of whole turns of the optic.")
    ] = 1,
    flicker_hz: Annotated[
        float | None,
        typer.Option(
            min=0.1,
            max=10_000.0,
            help="Frequency of a lamp (Hz), such as 100 or 120: writes how much each pixel flickers with it.",
        ),
    ] = None,
    figure: Annotated[
        Path | None,
        typer.Option(help="Picture, edges, thresholds and misfit to write (.png)."),
        cli.OUTPUT,
    ] = None,
    layout: cli.FileOptions,
    common: cli.Common,
) -> None:
    """Write what whole turns tell of each pixel: the scene, its edges, its thresholds, and what moved.

    No event is moved: each pixel's events are summed in phase with the optic. Scene and camera must be still.
    """
    from amiwarp.reconstruction.image_in_phase import phase_image
    from amiwarp.reconstruction.phase_figure import save_phase_figure
    from amiwarp.reconstruction.phase_window import PhaseReconstruction
    from amiwarp.results.calibration import Calibration

    check_ending(out, "images in phase are written", [".npz"])
    if figure is not None:
        check_ending(figure, "figures are written", [".png"])
    device = cli.choose_device(common.device)
    source = open_recording(recording, **layout.given())
    work = PhaseReconstruction(source, Calibration.load(calibration), device=device)
    start_us = None
    if start is not None:
        start_us = source.events.t_first + cli.microseconds(start, "s", "--start")
    span = work.span(start_us, None, float(turns))

    began = time.perf_counter()
    with cli.progress("summing in phase") as advance:
        sums = work.sums(*span)
        advance("summing in phase", 0.5)
        found = phase_image(sums, work.model)
        if flicker_hz is not None:
            found = replace(found, flicker=_flicker(source, span, flicker_hz, device))
    found.save(out)
    if figure is not None:
        save_phase_figure(found, figure)
    known = np.isfinite(found.misfit)
    moved = float((found.misfit[known] > MOVED).mean()) if known.any() else 0.0
    ratio = found.threshold_ratio[np.isfinite(found.threshold_ratio) & (found.threshold_ratio > 0)]
    data: dict[str, Any] = {
        "file": str(out),
        "start_us": span[0],
        "turns": found.turns,
        "harmonics": sums.harmonics,
        "events": sums.events,
        "known": float(known.mean()),
        "moved": moved,
        "off_ratio": float(np.median(ratio)) if len(ratio) else None,
        "lag_deg": math.degrees(found.lag),
        "seconds": time.perf_counter() - began,
        "device": device,
    }
    line = (
        f"{out}: {sums.events:,} events of {turns} {'turn' if turns == 1 else 'turns'} in {data['seconds']:.2f} s on "
        f"{device}; {100 * data['known']:.0f} % of the pixels known, {100 * moved:.1f} % of these not explained by a "
        f"still scene; events lag by {data['lag_deg']:.1f} deg"
    )
    cli.report(common, data, [line])


def _flicker(source: Recording, span: tuple[int, int], frequency_hz: float, device: str) -> Any:
    """Return the amplitude of each pixel's brightness at a frequency [ON thresholds]."""
    from amiwarp.events.device_events import DeviceEvents, read_between
    from amiwarp.imaging.phase import phase_sums

    start_us, length_us = span
    periods = math.floor(length_us * 1e-6 * frequency_hz)
    if periods < 1:
        raise AmiwarpError(
            f"--flicker-hz {frequency_hz:g}: the used turns take {length_us * 1e-6:.3g} s, less than one period; give "
            "more --turns"
        )
    stop_us = start_us + round(periods * 1e6 / frequency_hz)
    events = read_between(source.events, start_us, stop_us)
    times = events.t.numpy() if isinstance(events, DeviceEvents) else events.t
    angles = (times - start_us).astype(np.float64) * (math.tau * frequency_hz * 1e-6)
    width, height = source.events.size
    sums = phase_sums(
        events, angles, width, height, turns=float(periods), harmonics=1, device=device
    )
    return 2.0 * np.abs(sums.values[0])
