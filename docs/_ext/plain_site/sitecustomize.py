"""Hide from this process the packages that a plain installation lacks; Python runs this file from PYTHONPATH."""

import json
import os
import re
import sys
from collections.abc import Iterator
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any


class PlainFinder(PathFinder):
    """Finder of modules and of installed packages that does not find those that a plain installation lacks."""

    modules: frozenset[str] = frozenset()
    distributions: frozenset[str] = frozenset()

    @classmethod
    def find_spec(cls, fullname: str, path: Any = None, target: Any = None) -> Any:
        if path is None and fullname in cls.modules:
            return None
        return super().find_spec(fullname, path, target)

    @classmethod
    def find_distributions(cls, *args: Any, **kwargs: Any) -> Iterator[Any]:
        for one in super().find_distributions(*args, **kwargs):
            if re.sub(r"[-_.]+", "-", one.name).lower() not in cls.distributions:
                yield one


_names = json.loads((Path(os.environ["AMIWARP_PLAIN_FOLDER"]) / "names.json").read_text())
PlainFinder.modules, PlainFinder.distributions = (
    frozenset(_names["modules"]),
    frozenset(_names["distributions"]),
)
sys.meta_path[:] = [PlainFinder if finder is PathFinder else finder for finder in sys.meta_path]
