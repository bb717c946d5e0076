"""Speed of images of warped events, of whole tasks and of streams, each with the error of the same run."""

from __future__ import annotations

from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from paper.drawing import COLOURS, new_figure
from paper.sources import Row, Table, Values, fixed, one, percent, results, significant, table_after

FILES = {"cpu": "speed_cpu.json", "cuda": "speed_cuda.json"}
HEADINGS = {"cpu": "### AMD EPYC, 2 cores", "cuda": "### NVIDIA H200"}
"""Heading of each device on the page of the results, above the table of aims."""
IMAGE = "image of warped events"
BOTH = "calibration without a guess, both stages"
PICTURE = "picture of one turn, from given parameters"
MOVED = "compensation of a file"
SCENE = "random pixels"
METHODS = {
    "cpu": ("amiwarp exact bilinear", "amiwarp circle bilinear", "Numba, angle table", "Numba",
            "NumPy, blocks of 65,536", "PyTorch, blocks of 65,536"),
    "cuda": ("amiwarp exact bilinear", "amiwarp circle bilinear", "CuPy, four float atomics",
             "Warp, four float atomics", "PyTorch"),
}  # fmt: skip


def rows(kind: str, what: str) -> list[Row]:
    """Return the rows of a task on a device."""
    return [row for row in results(FILES[kind])["rows"] if row["what"] == what]


def image_row(kind: str, name: str, scene: str = SCENE) -> Row:
    """Return the row of a method that makes images."""
    return one(rows(kind, IMAGE), scene=scene, name=name)


def exact_rates(kind: str) -> list[float]:
    """Return the rates of the exact model over the scenes, in events per second."""
    found = rows(kind, IMAGE)
    return sorted(row["rate_per_s"] for row in found if row["name"] == "amiwarp exact bilinear")


def aims(kind: str) -> list[bool]:
    """Return whether each aim of a device is met."""
    return [row["met"] == "yes" for row in table_after("speed.md", HEADINGS[kind])]


def stream_row(kind: str, what: str) -> Row:
    """Return the row of a live stream with the exact model on the edges of a picture, of the fastest setting."""
    found = [row for row in results(f"stream_{kind}.json")["rows"] if row["what"] == what]
    wanted = [
        row for row in found if (row["scene"], row["model"]) == ("edges of a picture", "exact")
    ]
    return max(wanted, key=lambda row: row["mev_s"])


def whole(kind: str, what: str, name: str) -> Row:
    """Return the row of a whole task."""
    return one(rows(kind, what), name=name)


def values() -> Values:
    """Return the values of the subject."""
    exact = image_row("cpu", "amiwarp exact bilinear")["errors"]
    plane = image_row("cuda", "PyTorch")["errors"]
    calibrated = whole("cpu", BOTH, "amiwarp both stages")
    texts = {
        "speed.cuda_host": results(FILES["cuda"])["host"].replace("(R)", ""),
        "speed.exact_px": significant(exact["exact_px"], 1),
        "speed.plane_px": significant(plane["exact_px"]),
        "speed.misplaced": percent(exact["misplaced"], 2),
        "speed.calibrated_events": significant(1e-6 * calibrated["events"]),
        "speed.over_peer_cpu": ratio("cpu", "Numba, angle table"),
        "speed.over_peer_cuda": ratio("cuda", "CuPy, four float atomics"),
    }
    return texts | device_values("cpu", 1e6) | device_values("cuda", 1e9)


def device_values(kind: str, scale: float) -> Values:
    """Return the values of a device; rates of images are divided by ``scale``."""
    rates = exact_rates(kind)
    both = whole(kind, BOTH, "amiwarp both stages")
    picture = whole(kind, PICTURE, "amiwarp picture")
    file = whole(kind, MOVED, "amiwarp exact, file to file")
    texts = {
        "slowest": fixed(rates[0] / scale, 0),
        "fastest": fixed(rates[-1] / scale, 0),
        "calibration_s": significant(both["median_s"]),
        "calibration_px": significant(both["errors"]["model_px"], 1),
        "picture_s": significant(picture["median_s"]),
        "file_mev": fixed(1e-6 * file["rate_per_s"], 0),
        "aims": str(len(aims(kind))),
        "met": str(sum(aims(kind))),
        "stream_mev": fixed(stream_row(kind, "rate")["mev_s"], 0),
        "latency_ms": fixed(stream_row(kind, "latency")["ms_p99"], 1),
    }
    return {f"speed.{kind}_{name}": text for name, text in texts.items()}


def ratio(kind: str, peer: str) -> str:
    """Return the rate of the exact model relative to another program, over random pixels."""
    ours = image_row(kind, "amiwarp exact bilinear")["rate_per_s"]
    return fixed(ours / image_row(kind, peer)["rate_per_s"], 1)


def image_line(kind: str, name: str) -> list[str]:
    """Return the line of a method in the table of images."""
    row = image_row(kind, name)
    errors = row["errors"]
    return [
        results(FILES[kind])["machine"],
        name.replace(" bilinear", ""),
        fixed(1e-6 * row["rate_per_s"], 0),
        significant(errors["exact_px"], 2),
        f"{significant(100 * errors['misplaced'], 1)} %",
    ]


def tables() -> dict[str, Table]:
    """Return the tables of the subject."""
    columns = [
        "machine",
        "method",
        "million events/s",
        "off the exact place [px rms]",
        "misplaced votes",
    ]
    lines = [image_line(kind, name) for kind in FILES for name in METHODS[kind]]
    return {"speed": Table(columns, lines)}  # fmt: skip


def draw_rates(panel: Any, kind: str, title: str) -> None:
    """Draw the rates of all methods on a device, the fastest at the top."""
    found = [image_row(kind, name) for name in METHODS[kind]]
    found.sort(key=lambda row: row["rate_per_s"])
    names = [row["name"].replace(" bilinear", "") for row in found]
    colours = [COLOURS[0] if "amiwarp" in name else "#bbbbbb" for name in names]
    panel.barh(range(len(found)), [1e-6 * row["rate_per_s"] for row in found], color=colours)
    panel.set_yticks(range(len(found)), names)
    panel.set_title(title)
    panel.set_xlabel("million events/s")
    panel.xaxis.set_major_locator(MaxNLocator(4))
    panel.xaxis.set_major_formatter(lambda rate, _: f"{rate:,.0f}")


def draw_speed() -> Figure:
    """Draw the rates of both devices."""
    figure, axes = new_figure(2, 1.8)
    draw_rates(axes[0], "cpu", results(FILES["cpu"])["machine"])
    draw_rates(axes[1], "cuda", results(FILES["cuda"])["machine"])
    return figure


def figures() -> dict[str, Figure]:
    """Return the figures of the subject."""
    return {"speed": draw_speed()}
