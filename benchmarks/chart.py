"""Charts of speed against error, on a machine without the packages of amiwarp's command line.

python -m benchmarks.chart PICTURE --out FOLDER [--device cuda:0] [--budget-px 0.3] [--quick]
python -m benchmarks.chart --from chart.json --out FOLDER      draws the results of an earlier run
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from amiwarp import AmiwarpError
from amiwarp.io.outputs import own_folder
from amiwarp.studies.chart.charts import Charts, make, simulated
from amiwarp.studies.chart.rows import beaten_by, fronts
from benchmarks.chart_libraries import library_tasks


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("picture", type=Path, nargs="?")
    source.add_argument("--from", type=Path, dest="data", metavar="chart.json")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--seed", type=int, default=0)
    budget = parser.add_mutually_exclusive_group()
    budget.add_argument("--budget-px", type=float)
    budget.add_argument("--budget-ms", type=float)
    parser.add_argument("--quick", action="store_true")
    args = parser.parse_args()
    try:
        charts = _redrawn(args.data, args.out) if args.data else _measured(args)
        _print(charts)
        answers = charts.answer(args.out, budget_px=args.budget_px, budget_ms=args.budget_ms)
        for kind, row in answers.items():
            print(f"{kind} within the budget: {row.label if row else 'nothing'}")
    except AmiwarpError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


def _redrawn(data: Path, out: Path) -> Charts:
    out.mkdir(parents=True, exist_ok=True)
    with own_folder(out):
        return Charts.load(data).draw(out)


def _measured(args: argparse.Namespace) -> Charts:
    said: set[str] = set()
    began = time.perf_counter()

    def show_progress(what: str, share: float) -> None:
        step = f"{what}: {10 * int(10 * share)} %"
        if step not in said:
            said.add(step)
            print(f"{time.perf_counter() - began:6.0f} s  {step}", file=sys.stderr, flush=True)

    show_progress("simulating", 0.0)
    recording = simulated(args.picture, seed=args.seed, device=args.device, quick=args.quick)
    args.out.mkdir(parents=True, exist_ok=True)
    with own_folder(args.out):
        charts = make(
            recording,
            args.out,
            device=args.device,
            seed=args.seed,
            quick=args.quick,
            libraries=library_tasks,
            progress=show_progress,
        )
    show_progress("done", 1.0)
    return charts


def _print(charts: Charts) -> None:
    for rows in (charts.compensation, charts.calibration):
        for r in sorted(rows, key=lambda r: r.cost):
            spread = f"± {100 * r.spread:.0f} %"
            print(
                f"{r.label:44s} {r.mev_per_s:10.1f} Mev/s {r.seconds * 1e3:10.2f} ms {spread:8s} {r.error_px:.5f} px"
            )
        for job, chosen in fronts(rows):
            print(f"front, {job}: {'; '.join(r.label for r in chosen)}")
        for r in rows:
            if r.default:
                better = ", ".join(b.label for b in beaten_by(r, rows))
                print(
                    f"default, {r.label}: " + (f"beaten by {better}" if better else "on the front")
                )
    print("\n".join(charts.notes))
    for label, error in charts.failed.items():
        print(f"failed: {label}: {error}")


if __name__ == "__main__":
    sys.exit(main())
