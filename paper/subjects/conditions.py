"""Conditions of the measurements: nobody measured them, but the results' pages must state them."""

from __future__ import annotations

from matplotlib.figure import Figure

from paper.sources import Table, Values, page

STATED = {
    "conditions.size": ("calibration_photometric.md", "640 × 480"),
    "conditions.rpm": ("calibration_photometric.md", "720"),
    "conditions.mismatch": ("calibration_photometric.md", "5 % mismatch"),
    "conditions.nominal": ("calibration_photometric.md", "1.15 times the true"),
    "conditions.index": ("optics.md", "1.55"),
    "conditions.fov": ("paper_results.md", "60°"),
    "conditions.small": ("calibration_photometric.md", "320 × 240"),
    "conditions.paper_limit": ("paper_results.md", "2 px"),
    "conditions.paper_fov": ("paper_results.md", "90°"),
    "conditions.paper_tolerance": ("paper_results.md", "6 px"),
    "conditions.frames": ("paper_results.md", "60 frames/s"),
    "conditions.interval": ("paper_results.md", "95 %"),
    "conditions.hosts": ("speed.md", "1.6 times"),
    "conditions.damaged": ("reliability.md", "48,000"),
}
"""Page of ``benchmarks/results`` and the text that must stand on it, by key."""


def values() -> Values:
    """Return the conditions, after a look that their pages state them."""
    texts = {}
    for key, (name, text) in STATED.items():
        if text not in page(name):
            raise ValueError(f"{name} does not state {text!r}, which the report says of {key}")
        texts[key] = text
    return texts


def tables() -> dict[str, Table]:
    """Return the tables of the subject."""
    return {}


def figures() -> dict[str, Figure]:
    """Return the figures of the subject."""
    return {}
