"""Claims of the original paper, judged by the evaluation, and the prism of two degrees."""

from __future__ import annotations

import re
from typing import Any

from matplotlib.figure import Figure

from paper.drawing import COLOURS, new_figure
from paper.sources import (
    Row,
    Table,
    Values,
    claims,
    evaluation_rows,
    fixed,
    one,
    results,
    significant,
)

VERDICTS = ("reproduced", "undecided", "not reproduced", "not testable")
STREAMS = {"S-EV": "S-EV", "AMI-EV, calibrated": "AMI-EV", "camera, 60/s": "standard camera"}
CAMERAS = ("still", "handheld", "fast")
WANDER = "slow wander of 1 ms"
CLEAN = "no timing error"


def numbered(report: str = "gpu") -> list[Row]:
    """Return the claims of the paper, without our own checks."""
    return [claim for claim in claims(report) if claim["number"] is not None]


def counted(verdict: str) -> int:
    """Return the number of parts of the paper's claims with a verdict."""
    return sum(claim["verdict"] == verdict for claim in numbered())


def checks(verdict: str) -> int:
    """Return the number of our own checks with a verdict."""
    return sum(claim["number"] is None and claim["verdict"] == verdict for claim in claims("gpu"))


def differing_verdicts() -> list[str]:
    """Return the claims and checks whose verdict on CPUs differs from the verdict on the GPU."""
    others = {claim["text"]: claim["verdict"] for claim in claims("cpu")}
    return [
        claim["text"]
        for claim in claims("gpu")
        if others.get(claim["text"], claim["verdict"]) != claim["verdict"]
    ]


def picture(stream: str, camera: str, field: str = "SSIM") -> float:
    """Return a measure of the pictures of a stream in the room."""
    rows = [row for row in evaluation_rows("gpu", "pictures") if row["scene"] == "room"]
    return float(one(rows, stream=stream, camera=camera)[field])


def edge(stream: str, camera: str, field: str) -> float:
    """Return a measure of the edges of a stream in the room, at the paper's tolerance."""
    rows = [row for row in evaluation_rows("gpu", "edges") if row["scene"] == "room"]
    wanted = {"true edges": "Canny", "tolerance [px]": 6.0}
    return float(one(rows, stream=stream, camera=camera, **wanted)[field])


def evenness(stream: str, camera: str) -> float:
    """Return the variance of the density of events in the room."""
    rows = [row for row in evaluation_rows("gpu", "texture") if row["scene"] == "room"]
    return float(one(rows, stream=stream, camera=camera)["variance of ρ / mean ρ"])


def displacement(apex: str, timing: str, model: str) -> float:
    """Return the rms displacement error [px] of a model."""
    rows = evaluation_rows("gpu", "apex_speed_models")
    found = one(rows, apex=f"apex {apex}", model=model, **{"timing error": timing})
    return float(found["displacement [px]"])


def circle(apex: str, fov: str, field: str) -> float:
    """Return an error of the circle over a field of view [px]."""
    rows = evaluation_rows("gpu", "apex_speed_circle")
    return float(one(rows, apex=f"apex {apex}", **{"field of view": fov})[field])


def cost(scene: str, name: str) -> Row:
    """Return the shape of a cost of recordings of two seconds."""
    return one(evaluation_rows("gpu", "convexity"), scene=scene, cost=name, **{"window [s]": 2.0})


def largest_clock_error_ms() -> float:
    """Return the timing error [ms] at which two degrees with exact refraction err as one degree with the circle."""
    per_ms = displacement("2°", WANDER, "exact model")
    at_one = displacement("1°", WANDER, "exact model")
    model = displacement("1°", CLEAN, "circle")
    return float(model / (per_ms**2 - at_one**2) ** 0.5)


def values() -> Values:
    """Return the values of the subject."""
    about = results("evaluate/gpu.json")["about"]["settings"]
    rates = evaluation_rows("gpu", "event_rate")
    in_room = [row for row in rates if (row["scene"], row["camera"]) == ("room", "handheld")]
    handheld = {row["stream"]: row["rate [Mev/s]"] for row in in_room}
    return {
        "claims.seeds": str(about["seeds"]),
        "claims.size": f"{about['width']} × {about['height']}",
        "claims.duration": f"{about['duration_s']:g}",
        "claims.parts": str(len(numbered())),
        "claims.reproduced": str(counted("reproduced")),
        "claims.undecided": str(counted("undecided")),
        "claims.not_testable": str(counted("not testable")),
        "claims.refuted": str(counted("not reproduced") or "none"),
        "claims.checks": str(len(claims("gpu")) - len(numbered())),
        "claims.checks_not": str(checks("not reproduced")),
        "claims.checks_open": str(checks("undecided")),
        "claims.all": str(len(claims("gpu"))),
        "claims.on_cpu": str(len(claims("cpu"))),
        "claims.differ": str(len(differing_verdicts()) or "none"),
        "claims.ssim_still": fixed(picture("AMI-EV, calibrated", "still"), 2),
        "claims.ssim_still_plain": fixed(picture("S-EV", "still"), 2),
        "claims.ssim_hand": fixed(picture("AMI-EV, calibrated", "handheld"), 2),
        "claims.ssim_hand_plain": fixed(picture("S-EV", "handheld"), 2),
        "claims.ssim_fast": fixed(picture("AMI-EV, calibrated", "fast"), 2),
        "claims.ssim_fast_plain": fixed(picture("S-EV", "fast"), 2),
        "claims.ssim_hand_frames": fixed(picture("camera, 60/s", "handheld"), 2),
        "claims.ssim_fast_frames": fixed(picture("camera, 60/s", "fast"), 2),
        "claims.even_still": fixed(evenness("AMI-EV, calibrated", "still"), 2),
        "claims.even_still_plain": fixed(evenness("S-EV", "still"), 2),
        "claims.chance": fixed(edge("AMI-EV, calibrated", "handheld", "chance"), 2),
        "claims.odsf": fixed(edge("AMI-EV, calibrated", "handheld", "ODS-F"), 2),
        "claims.more_events": fixed(handheld["AMI-EV, raw"] / handheld["S-EV"], 1),
        "claims.j_ideal": fixed(cost("discs, ideal sensor", "J, large η")["error [px]"], 2),
        "claims.j_noise": fixed(cost("discs", "J, large η")["error [px]"], 1),
        "claims.contrast_domain": fixed(cost("discs", "minus contrast")["convex, phase ± [°]"], 0),
        "two.circle_1": fixed(displacement("1°", CLEAN, "circle"), 2),
        "two.circle_2": fixed(displacement("2°", CLEAN, "circle"), 2),
        "two.exact_2_timing": fixed(displacement("2°", WANDER, "exact model"), 2),
        "two.circle_1_timing": fixed(displacement("1°", WANDER, "circle"), 2),
        "two.circle_2_timing": fixed(displacement("2°", WANDER, "circle"), 2),
        "two.timing_ms": WANDER.split()[3],
        "two.clock_ms": significant(largest_clock_error_ms(), 1),
        "two.circle_90_rms": fixed(circle("0.5°", "90°", "rms [px]"), 2),
        "two.circle_90_largest": fixed(circle("0.5°", "90°", "largest [px]"), 1),
    }


def short(text: str) -> str:
    """Return the text of a claim without its conditions in brackets, but with what is compared."""
    bare = re.sub(r" \([^()]*(\([^()]*\)[^()]*)*\)", "", text).rstrip(".")
    compared = [way for way in ("per object", "per event") if way in text]
    return ", ".join([bare, *compared])


def result(claim: Row) -> str:
    """Return the difference and its interval, without the number of seeds."""
    return str(claim["ours"]).split(", 10 seeds")[0].replace("-", "−")


def claim_lines() -> list[list[str]]:
    """Return the lines of the table of the parts of claims that can be tested."""
    testable = [claim for claim in numbered() if claim["verdict"] != "not testable"]
    testable.sort(key=lambda claim: claim["number"])
    return [
        [str(claim["number"]), short(claim["text"]), result(claim), claim["verdict"]]
        for claim in testable
    ]


def two_degree_lines() -> list[list[str]]:
    """Return the lines of the table of displacement errors."""
    lines = []
    for model in ("circle", "exact model"):
        for timing in (CLEAN, WANDER):
            errors = [displacement(apex, timing, model) for apex in ("0.5°", "1°", "2°")]
            lines.append([f"{model}, {timing}", *(fixed(error, 2) for error in errors)])
    return lines


def tables() -> dict[str, Table]:
    """Return the tables of the subject."""
    result_heading = "AMI-EV less S-EV [95 % interval]"
    return {
        "claims": Table(["", "part of a claim", result_heading, "verdict"], claim_lines()),
        "two": Table(["rms displacement error [px]", "0.5°", "1°", "2°"], two_degree_lines()),
    }


def draw_bars(panel: Any, measure: Any, title: str) -> None:
    """Draw a measure of three streams for three motions of the camera."""
    for index, (stream, name) in enumerate(STREAMS.items()):
        heights = [measure(stream, camera) for camera in CAMERAS]
        places = [place + 0.27 * (index - 1) for place in range(len(CAMERAS))]
        panel.bar(places, heights, 0.25, color=COLOURS[index], label=name)
    panel.set_xticks(range(len(CAMERAS)), CAMERAS)
    panel.set_title(title)


def draw_claims() -> Figure:
    """Draw pictures and edges of three streams."""
    figure, axes = new_figure(2, 2.0)
    draw_bars(axes[0], picture, "pictures: SSIM")
    draw_bars(axes[1], lambda stream, camera: edge(stream, camera, "ODS-F"), "edges: ODS-F")
    for place, camera in enumerate(CAMERAS):
        for index, stream in enumerate(STREAMS):
            middle = place + 0.27 * (index - 1)
            chance = edge(stream, camera, "chance")
            axes[1].plot([middle - 0.12, middle + 0.12], [chance, chance], color="black")
    axes[1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def figures() -> dict[str, Figure]:
    """Return the figures of the subject."""
    return {"claims": draw_claims()}
