"""What tests and studies of the package say about itself."""

from __future__ import annotations

from matplotlib.figure import Figure

from paper.sources import Table, Values, fixed, percent, results


def first_look() -> tuple[int, int]:
    """Return how many defects were planted in the two counted rounds, and how many were noticed at once."""
    rounds = [results("planted.json")["first_run"][name] for name in ("round 2", "round 3")]
    noticed = sum(each["killed"] for each in rounds)
    return noticed + sum(each["survived"] for each in rounds), noticed


def unsaid_share() -> float:
    """Return the share of damaged event files whose events change and of which nothing is said."""
    total = results("fuzz_events.json")["events"]["total"]
    unsaid = sum(count for name, count in total.items() if name.startswith("silent"))
    return float(unsaid / sum(total.values()))


def values() -> Values:
    """Return the values of the subject."""
    mutants = results("mutants.json")
    planted, noticed = first_look()
    atlas = results("atlas.json")
    inside = atlas["aims"]["success inside"]
    outside = atlas["aims"]["silent failures outside"]
    return {
        "trust.mutants": str(len(mutants["mutants"])),
        "trust.mutants_noticed": percent(mutants["before"]["score"]),
        "trust.planted": str(planted),
        "trust.planted_noticed": percent(noticed / planted),
        "trust.unsaid_files": percent(unsaid_share(), 0),
        "trust.atlas": fixed(atlas["cells"], 0),
        "trust.atlas_inside": fixed(inside["total"], 0),
        "trust.atlas_success": percent(inside["share"], 1),
        "trust.atlas_outside": fixed(outside["total"], 0),
        "trust.atlas_silent": str(outside["count"]),
    }


def tables() -> dict[str, Table]:
    """Return the tables of the subject."""
    return {}


def figures() -> dict[str, Figure]:
    """Return the figures of the subject."""
    return {}
