"""Which file of results, machine and date each subject comes from."""

from __future__ import annotations

from matplotlib.figure import Figure

from paper.sources import Row, Table, Values, results

FILES = {
    "calibration": ("calibration_photometric_cuda.json",),
    "whole turn": (
        "true_optics_drawn8000_cuda.json",
        "true_optics_fresh9000_cuda.json",
        "true_optics_drawn_cuda.json",
        "true_optics_fresh_cuda.json",
        "atlas_optics.json",
        "atlas.json",
    ),
    "sums in phase": ("phase_cpu.json", "phase_cuda.json"),
    "claims, two degrees": ("evaluate/gpu.json", "evaluate/cpu.json"),
    "speed": ("speed_cpu.json", "speed_cuda.json", "stream_cpu.json", "stream_cuda.json"),
}
"""Files of each subject whose times or seeds depend on a machine. Errors of models are computed: ``optics.md``."""
UNSTATED = "–"


def origin(subject: str, name: str) -> list[str]:
    """Return the line of a file."""
    content: Row = results(name)
    about = content.get("about", content)
    machine = about.get("machine", UNSTATED)
    if isinstance(machine, dict):
        machine = machine["device"]
    machine = machine.replace("(R)", "")
    return [subject, name, machine, about.get("date", UNSTATED), about.get("commit", UNSTATED)]


def values() -> Values:
    """Return the values of the subject."""
    return {}


def tables() -> dict[str, Table]:
    """Return the tables of the subject."""
    lines = [origin(subject, name) for subject, names in FILES.items() for name in names]
    return {"origins": Table(["subject", "file", "machine", "date", "commit"], lines)}


def figures() -> dict[str, Figure]:
    """Return the figures of the subject."""
    return {}
