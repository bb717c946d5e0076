"""Rules for the code that a program can check: size of device code, lazy imports, public names, no import cycles.

Which room may import which is a contract of import-linter in ``pyproject.toml``.
"""

import ast
import functools
import graphlib
import importlib
import inspect
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from types import FunctionType, ModuleType

import pytest

import amiwarp

PACKAGE = Path(__file__).parents[1] / "amiwarp"
MODULES = sorted(PACKAGE.rglob("*.py"))
KERNEL_LINES, KERNEL_PARAMETERS, FILE_LINES = 25, 10, 400
FUNC_LINES = 18
"""Largest number of lines; aim at 12. A bilinear vote and the steps of the pixel model are one idea each."""
HEAVY = (
    "warp",
    "nlopt",
    "h5py",
    "hdf5plugin",
    "pyvista",
    "serial",
    "faery",
    "av",
    "matplotlib",
    "scipy",
    "trame",
    "aiohttp",
)


def name_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports_of(path: Path) -> Iterator[str]:
    """Yield modules that a file imports at run time, in functions too; ``if TYPE_CHECKING`` does not count."""
    stack: list[ast.AST] = [ast.parse(path.read_text())]
    while stack:
        node = stack.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            stack.extend(node.orelse)
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        stack.extend(ast.iter_child_nodes(node))


@functools.cache
def device_code() -> list[tuple[str, str, ast.FunctionDef]]:
    """Return the place, the decorator and the syntax tree of every Warp kernel and device function."""
    found = []
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                for decorator in node.decorator_list:
                    text = ast.unparse(decorator)
                    if text.startswith(("wp.kernel", "wp.func")):
                        found.append((f"{name_of(path)}.{node.name}:{node.lineno}", text.partition("(")[0], node))
    return found


def length(node: ast.FunctionDef) -> int:
    """Return the number of lines of the body without the docstring."""
    body = node.body[1:] if ast.get_docstring(node) is not None else node.body
    return (body[-1].end_lineno or 0) - body[0].lineno + 1 if body else 0


def test_there_is_something_to_check() -> None:
    kinds = [kind for _, kind, _ in device_code()]
    assert kinds.count("wp.kernel") >= 5
    assert kinds.count("wp.func") >= 20


def test_kernels_and_device_functions_stay_small() -> None:
    long = [
        f"{where}: {length(node)} lines"
        for where, kind, node in device_code()
        if length(node) > (KERNEL_LINES if kind == "wp.kernel" else FUNC_LINES)
    ]
    assert long == []


def test_kernels_take_few_parameters() -> None:
    wide = [
        f"{where}: {len(node.args.args)} parameters"
        for where, kind, node in device_code()
        if kind == "wp.kernel" and len(node.args.args) > KERNEL_PARAMETERS
    ]
    assert wide == []


def test_files_stay_readable() -> None:
    lengths = {name_of(path): len(path.read_text().splitlines()) for path in MODULES}
    assert {name: lines for name, lines in lengths.items() if lines > FILE_LINES} == {}


def test_kernel_modules_keep_their_annotations() -> None:
    """Postponed annotations break kernels whose types come from a closure."""
    files = {where.rpartition(".")[0] for where, _, _ in device_code()}
    postponed = [name_of(path) for path in MODULES if name_of(path) in files and "__future__" in set(imports_of(path))]
    assert postponed == []


def test_import_loads_nothing_heavy() -> None:
    script = f"import sys, amiwarp; print(*[m for m in {HEAVY!r} if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", script], cwd=PACKAGE.parent, capture_output=True, text=True, check=True)
    assert out.stdout.split() == []


def test_every_public_name_loads() -> None:
    script = "import amiwarp; [getattr(amiwarp, name) for name in amiwarp.__all__]"
    subprocess.run([sys.executable, "-c", script], cwd=PACKAGE.parent, capture_output=True, text=True, check=True)


def test_no_public_name_is_a_module() -> None:
    assert sorted({path.stem for path in PACKAGE.iterdir()} & set(amiwarp.__all__)) == []


def test_a_module_can_be_imported_under_another_name() -> None:
    for path in MODULES:
        if name_of(path) != "amiwarp.__main__":
            assert isinstance(importlib.import_module(name_of(path)), ModuleType)
    import amiwarp.imaging.warped_image as images

    assert images.iwe is amiwarp.iwe


def test_types_in_public_signatures_are_public() -> None:
    """Checks public functions, and fields, properties and methods of public classes."""
    missing = {
        f"{name} uses {used}"
        for name in amiwarp.__all__
        for used in _types_of(name)
        if used not in amiwarp.__all__ and used in CLASSES
    }
    assert sorted(missing) == []


CLASSES = {
    node.name
    for path in MODULES
    for node in ast.parse(path.read_text()).body
    if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
}


def _types_of(name: str) -> Iterator[str]:
    public = getattr(amiwarp, name)
    if not isinstance(public, type | FunctionType):
        return
    node = ast.parse(textwrap.dedent(inspect.getsource(public))).body[0]
    inner = [node] if isinstance(node, ast.FunctionDef) else list(ast.iter_child_nodes(node))
    for part in inner:
        if isinstance(part, ast.FunctionDef) and (part is node or part.name == "__init__" or part.name[0] != "_"):
            every = [*part.args.args, *part.args.kwonlyargs, part.args.vararg, part.args.kwarg]
            yield from _names([part.returns, *(arg.annotation for arg in every if arg is not None)])
        elif isinstance(part, ast.AnnAssign) and not ast.unparse(part.target).startswith("_"):
            yield from _names([part.annotation])


def _names(annotations: list[ast.expr | None]) -> Iterator[str]:
    for annotation in annotations:
        for node in ast.walk(annotation) if annotation is not None else ():
            if isinstance(node, ast.Name):
                yield node.id


def imported_modules(path: Path) -> set[str]:
    """Return the modules of the package that a file imports at run time, in functions too."""
    known = {name_of(other) for other in MODULES}
    return {module for module in imports_of(path) if module in known} - {name_of(path), "amiwarp"}


def test_no_modules_import_each_other() -> None:
    """No cycles at run time, imports inside functions included. Packages that only re-export names do not count."""
    graph = {name_of(path): imported_modules(path) for path in MODULES if path.name != "__init__.py"}
    order = graphlib.TopologicalSorter({name: used & set(graph) for name, used in graph.items()})
    order.prepare()


def test_a_cycle_would_be_seen() -> None:
    with pytest.raises(graphlib.CycleError):
        graphlib.TopologicalSorter({"a": {"b"}, "b": {"a"}}).prepare()
