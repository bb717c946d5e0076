"""Tests import public names: of ``amiwarp``, or of the packages that list theirs in a stub. A module may then move.

Inner is what no stub lists: a name of a module inside a room, the module itself, and a private name. The tests of
``amiwarp/kernels/`` may look inside.
"""

import ast
import functools
import re
from collections import Counter
from pathlib import Path

import pytest

from tests import ROOT

INNER = {
    "benchmarks": 2,
    "brightness": 1,
    "calib": 236,
    "cli": 33,
    "command_line": 1,
    "compensation": 15,
    "conftest": 1,
    "cylinder_model": 11,
    "events": 10,
    "firmware": 6,
    "house": 21,
    "imaging": 21,
    "io": 136,
    "learning": 28,
    "lens": 14,
    "live": 98,
    "optics": 39,
    "plotting": 17,
    "reconstruction": 17,
    "results": 2,
    "rig": 1,
    "rig_world": 1,
    "schema": 7,
    "sensors": 2,
    "simulation": 67,
    "studies": 221,
    "viewer": 167,
}
"""Number of inner names that the tests of each room import. It may only fall; then write the new number here."""
DOTTED = re.compile(r"amiwarp(\.\w+){2,}")
"""A name inside a room in a string, as ``monkeypatch.setattr`` takes it."""


@functools.cache
def listed(package: str) -> frozenset[str]:
    """Return the names that the stub of a package lists; none if it has no stub."""
    stub = ROOT.joinpath(*package.split("."), "__init__.pyi")
    if not stub.exists():
        return frozenset()
    imports = [
        node for node in ast.parse(stub.read_text()).body if isinstance(node, ast.ImportFrom)
    ]
    return frozenset(alias.name for node in imports for alias in node.names)


def is_module(name: str) -> bool:
    """Return whether a dotted name is a module or a package of the repository."""
    path = ROOT.joinpath(*name.split("."))
    return path.with_suffix(".py").exists() or path.is_dir()


def is_inner(package: str, name: str) -> bool:
    """Return whether ``from package import name`` needs to know what is inside a room."""
    if name in listed(package):
        return False
    if name.startswith("_") and not name.endswith("__"):
        return True
    depth = package.count(".")
    return depth >= 2 or (depth == 1 and is_module(f"{package}.{name}"))


def inner_names(code: str) -> list[str]:
    """Return the inner names that code imports or has in its strings."""
    found = []
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names if DOTTED.fullmatch(alias.name)]
        elif isinstance(node, ast.ImportFrom) and re.match(r"amiwarp\b", node.module or ""):
            package = str(node.module)
            found += [
                f"{package}.{alias.name}" for alias in node.names if is_inner(package, alias.name)
            ]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found += [node.value] if DOTTED.fullmatch(node.value) else []
    return found


def test_tests_import_no_more_inner_names_than_before() -> None:
    found: Counter[str] = Counter()
    for path in sorted((ROOT / "tests").rglob("*.py")):
        room = path.relative_to(ROOT / "tests").parts[0].removesuffix(".py")
        if room != "kernels" and path != Path(__file__):
            found[room] += len(inner_names(path.read_text()))
    assert {room: number for room, number in sorted(found.items()) if number} == INNER


@pytest.mark.parametrize(
    ("code", "inner"),
    [
        ("from amiwarp import Camera", []),
        ("from amiwarp.optics import MODELS, Camera", []),
        ("from amiwarp.live.link import Stop", []),
        ("from amiwarp.errors import AmiwarpError", []),
        ("from benchmarks.amiwarp.x import y", []),
        ("from amiwarp.live.link.protocol import Stop", ["amiwarp.live.link.protocol.Stop"]),
        ("from amiwarp.live.link import protocol", ["amiwarp.live.link.protocol"]),
        ("from amiwarp.viewer import Inspector, panel", ["amiwarp.viewer.panel"]),
        ("from amiwarp.tasks import _hidden", ["amiwarp.tasks._hidden"]),
        ("from amiwarp import __version__", []),
        ("import amiwarp.imaging.iwe", ["amiwarp.imaging.iwe"]),
        ("import amiwarp.imaging, json", []),
        ("def f():\n    from amiwarp.io.spans import Span as S", ["amiwarp.io.spans.Span"]),
        ("patch('amiwarp.tasks.cores', 'amiwarp.io')", ["amiwarp.tasks.cores"]),
    ],
)
def test_inner_names_are_seen(code: str, inner: list[str]) -> None:
    assert inner_names(code) == inner
