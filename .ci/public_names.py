"""Write the public names of each room into the room's own stub, or check that they are there.

    python .ci/public_names.py [--check]

``amiwarp/__init__.pyi`` lists every public name with its module. ``amiwarp.optics.Camera`` and ``amiwarp.Camera`` are
the same: the stub of a room lists the names whose modules lie in the room, and what its ``__init__.py`` imports. A
function with the name of its module, such as ``iwe``, is in the front door only. What a stub lists below
``OWN_HEADING`` is kept by hand and stays.
"""

import ast
import re
import sys
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "amiwarp"
FRONT = PACKAGE / "__init__.pyi"
LINE = re.compile(r"^from \.(\w+)\.([\w.]+) import (\w+) as (\w+)$")
HEADING = "# Public names of this room. Written by .ci/public_names.py from the front door's.\n\n"
OWN_HEADING = (
    "# Names that are in this room only, kept by hand: what people who add to it need.\n\n"
)


def stubs() -> dict[Path, str]:
    """Return the text of the stub of each room with public names."""
    lines: dict[str, set[str]] = {}
    for line in FRONT.read_text(encoding="utf-8").splitlines():
        match = LINE.match(line)
        if match:
            room, module, name, _ = match.groups()
            if not is_module(PACKAGE / room / name):
                lines.setdefault(room, set()).add(f"from .{module} import {name} as {name}\n")
    for room, rows in lines.items():
        rows |= own_imports(room)
    return {
        PACKAGE / room / "__init__.pyi": HEADING + "".join(sorted(rows)) + own_part(room)
        for room, rows in lines.items()
    }


def own_part(room: str) -> str:
    """Return the part of a room's stub that is kept by hand, with its heading."""
    stub = PACKAGE / room / "__init__.pyi"
    text = stub.read_text(encoding="utf-8") if stub.exists() else ""
    _, heading, names = text.partition(OWN_HEADING)
    return f"\n{heading}{names}" if heading else ""


def is_module(path: Path) -> bool:
    """Return whether a path without its ending is a module or a package."""
    return path.with_suffix(".py").exists() or path.is_dir()


def imports_of(stub: str) -> set[tuple[str, str]]:
    """Return module and name of each import of a stub, however it is formatted."""
    return {
        (str(node.module), alias.name)
        for node in ast.walk(ast.parse(stub))
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


def own_imports(room: str) -> set[str]:
    """Return the lines of the names that the room's ``__init__.py`` imports from its modules."""
    text = (PACKAGE / room / "__init__.py").read_text(encoding="utf-8")
    pattern = rf"^from amiwarp\.{room}\.([\w.]+) import ([^\n(]+)$"
    return {
        f"from .{module} import {name.strip()} as {name.strip()}\n"
        for module, names in re.findall(pattern, text, re.MULTILINE)
        for name in names.split(",")
    }


def main() -> int:
    wanted = stubs()
    stale = [
        path
        for path, text in wanted.items()
        if not path.exists() or imports_of(path.read_text(encoding="utf-8")) != imports_of(text)
    ]
    surplus = [path for path in PACKAGE.glob("*/__init__.pyi") if path not in wanted]
    names = [str(path.relative_to(PACKAGE.parent)) for path in (*stale, *surplus)]
    if "--check" in sys.argv[1:]:
        if names:
            print(f"{', '.join(names)}: stale; run: python .ci/public_names.py", file=sys.stderr)
        return int(bool(names))
    for path in stale:
        path.write_text(wanted[path], encoding="utf-8")
    for path in surplus:
        path.unlink()
    print(f"written: {', '.join(names) or 'nothing, all are right'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
