"""The default calibration, which starts from sums in phase, against the start from sharpness: times and errors.

    python -m benchmarks.phase_start [--only NAME …] [--repeats 3] [--out FILE.json]

Each recording of the stability study's conditions is calibrated by both searches in turn. A row has the processor time
of all threads [s], the least of the repeats, the error [px rms] or the refusal, and whether sums in phase told the
motion. The last row sums up. The exit status is 1 if the default is worse on a recording: refused where the other
search is not, or wrong by more than 0.01 px and a tenth beyond it.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import warp as wp

from amiwarp import AmiwarpError, Settings, calibrate
from amiwarp.studies.machine import machine
from amiwarp.studies.stability.condition import Condition
from amiwarp.studies.stability.judging import compare
from amiwarp.studies.stability.recordings import SimulatedSample, make
from amiwarp.studies.stability.scenes import SceneKind

CASES = {
    "harmless": Condition(),
    "apex 0.25 deg": Condition(apex_deg=0.25),
    "apex 0.5 deg": Condition(apex_deg=0.5),
    "apex 2 deg": Condition(apex_deg=2.0),
    "apex 4 deg": Condition(apex_deg=4.0),
    "640x480": Condition(width=640, height=480),
    "90 deg, apex 2 deg": Condition(fov_deg=90.0, apex_deg=2.0),
    "one turn": Condition(turns=1.0),
    "half a turn": Condition(turns=0.5),
    "24 turns": Condition(turns=24.0),
    "20,000 events": Condition(window_events=20_000),
    "5,000 events": Condition(window_events=5_000),
    "sparse edges": Condition(scene=SceneKind.EDGES.value),
    "few thin lines": Condition(scene=SceneKind.LINES.value),
    "print": Condition(scene="print"),
    "one edge direction": Condition(scene="one edge direction"),
    "repeating texture": Condition(scene="repeating texture"),
    "noise 25 %": Condition(noise=0.25),
    "noise 65 %": Condition(noise=0.65),
    "noise 80 %": Condition(noise=0.8),
    "hot pixels 2 %": Condition(hot=0.02),
    "threshold 0.6": Condition(contrast=0.6),
    "bandwidth 100 Hz": Condition(cutoff_hz=100.0),
    "bus full": Condition(bus_rate_mev_s=1.0),
    "refractory time 3 ms": Condition(refractory_us=3000.0),
    "lamp of 100 Hz, 5 %": Condition(lamp=0.05),
    "lamp of 100 Hz, 20 %": Condition(lamp=0.2),
    "camera turns 3 deg/s": Condition(camera_deg_s=3.0),
    "camera turns 10 deg/s": Condition(camera_deg_s=10.0),
    "camera turns 30 deg/s": Condition(camera_deg_s=30.0),
    "object on 10 %": Condition(passing=0.1),
    "object on 60 %": Condition(passing=0.6),
    "encoder reversed": Condition(backwards=True),
    "index pulses only": Condition(index_only=True),
    "index pulses, ripple 3 %": Condition(index_only=True, turn_ripple=0.03),
    "jitter 2 deg": Condition(jitter_deg=2.0),
    "clock off by 5 ms, ripple": Condition(clock_offset_us=5000.0, ripple=0.05),
    "encoder off centre": Condition(eccentric_deg=3.0),
    "focal length 10 % off": Condition(focal_error=0.1),
    "wrong flat side": Condition(flat_side_wrong=True),
    "start 90 deg off": Condition(start="wrong"),
    "no encoder": Condition(no_encoder=True),
}
"""Conditions by name."""
BEFORE = Settings(global_algorithm="GN_DIRECT_L")
AFTER = Settings()
"""Settings of the search over events from the start, and of the default."""
ALLOWED_PX = 0.01
ALLOWED_SHARE = 1.1
"""Difference of the errors that counts as none: the photometric stage ends anywhere within it."""


@dataclass(frozen=True)
class Found:
    """Result of one search."""

    seconds: float
    """Processor time of all threads, the least of the repeats [s]."""
    error_px: float | None
    """Error of the model [px rms]; None if the recording was refused."""
    refusal: str = ""
    """Why it was refused."""
    algorithms: tuple[str, ...] = ()
    """Algorithms of the stages."""


def found_by(settings: Settings, sample: SimulatedSample, repeats: int) -> Found:
    """Return the result of a search, and its time."""
    seconds = []
    for _ in range(repeats):
        began = time.process_time()
        try:
            calibration = calibrate(sample.recording, settings)
        except AmiwarpError as error:
            return Found(time.process_time() - began, None, str(error))
        seconds.append(time.process_time() - began)
    algorithms = tuple(stage.algorithm for stage in calibration.stages)
    return Found(min(seconds), float(compare(calibration, sample).rms), "", algorithms)


def is_worse(after: Found, before: Found) -> bool:
    """Return whether a result is worse than another one."""
    if before.error_px is None:
        return False
    if after.error_px is None:
        return True
    return after.error_px > ALLOWED_SHARE * before.error_px + ALLOWED_PX


def rows(names: list[str], repeats: int, seed: int) -> Iterator[dict[str, object]]:
    """Calibrate each recording by both searches, and print what came out."""
    for settings in (BEFORE, AFTER):  # kernels are compiled before they are timed
        found_by(settings, make(CASES[names[0]], seed), 1)
    for name in names:
        sample = make(CASES[name], seed)
        before = found_by(BEFORE, sample, repeats)
        after = found_by(AFTER, sample, repeats)
        row = {
            "case": name,
            "before": asdict(before),
            "after": asdict(after),
            "in_phase": "phase" in after.algorithms,
            "worse": is_worse(after, before),
        }
        shown = [
            "refused" if each.error_px is None else f"{each.error_px:.4f} px"
            for each in (before, after)
        ]
        print(
            f"{name:26} {before.seconds:6.2f} s {shown[0]:>11}   {after.seconds:6.2f} s {shown[1]:>11}"
            f"{'   in phase' if row['in_phase'] else ''}{'   WORSE' if row['worse'] else ''}",
            flush=True,
        )
        yield row


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", default=list(CASES))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    wp.config.quiet = True
    found = list(rows(args.only, args.repeats, args.seed))
    ratios = [row["after"]["seconds"] / row["before"]["seconds"] for row in found]  # type: ignore[index]
    print(f"median ratio of the times {statistics.median(ratios):.2f}, of {len(ratios)} recordings")
    if args.out:
        args.out.write_text(json.dumps({"machine": machine("cpu"), "rows": found}, indent=1) + "\n")
    return int(any(row["worse"] for row in found))


if __name__ == "__main__":
    raise SystemExit(main())
