"""Recordings that a specification of a data set describes, for tests."""

from pathlib import Path
from typing import Any

from amiwarp.learning.dataset.items import list_items, sources_of_splits
from amiwarp.learning.dataset.specification import load_specification


def items_of(path: Path) -> list[Any]:
    """Return the recordings of a specification file."""
    return list_items(load_specification(path))


def divided(path: Path) -> dict[str, dict[str, int]]:
    """Return the number of sources of each split, by class."""
    loaded = load_specification(path)
    return sources_of_splits(loaded, list_items(loaded))
