"""The house rules that a machine can check: budgets of device code, lazy imports, and which way imports run."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "amiwarp"
MODULES = sorted(PACKAGE.rglob("*.py"))
KERNEL_LINES, KERNEL_PARAMETERS, FILE_LINES = 25, 10, 400
FUNC_LINES = 18
"""Aim at 12. A bilinear vote and the steps of the pixel model are one thought each and would not gain by a cut."""
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

KERNELS_MAY_IMPORT = {"amiwarp.optics.camera", "amiwarp.errors", "amiwarp.kernels"}
"""Kernels turn host objects to structs, so they know the camera; nothing of files, users or recordings."""

ORDER = (
    ("errors", "regular"),
    ("values",),
    ("prism",),
    ("kernels", "camera", "multilevel"),
    ("optics", "events", "encoder", "unwrapping", "turning", "machine"),
    ("pictures", "motion", "clouds"),
    ("io", "uploads", "link"),
    ("iwe", "peers"),
    (
        "placing",
        "gatherer",
        "batches",
        "compensate",
        "compensator",
        "iwe_files",
        "sharpness",
        "metrics",
        "scenery",
        "tiles",
    ),
    ("pairs",),
    ("residuals",),
    ("brightness",),
    ("calib", "engine", "reconstruct"),
    ("stream",),
    ("picture_files",),
    ("simulate",),
    ("translate", "figures", "presets"),
    ("stability", "design"),
    ("chart", "viewer", "demo"),
    ("cli",),
    ("__main__",),
)
"""The way an event goes, first to last: a module imports from its own row or from an earlier one."""


def name_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports_of(path: Path) -> Iterator[str]:
    """Modules that a file imports at run time, at any depth; ``if TYPE_CHECKING`` does not count."""
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


def device_code() -> Iterator[tuple[str, str, ast.FunctionDef]]:
    """Every Warp kernel and device function: where, which of the two, and its syntax tree."""
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                for decorator in node.decorator_list:
                    text = ast.unparse(decorator)
                    if text.startswith(("wp.kernel", "wp.func")):
                        yield f"{name_of(path)}.{node.name}:{node.lineno}", text.partition("(")[0], node


def length(node: ast.FunctionDef) -> int:
    """Lines of the body, docstring excluded."""
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


def test_kernels_know_nothing_of_files_or_users() -> None:
    wrong = [
        f"{name_of(path)} imports {module}"
        for path in MODULES
        if name_of(path).startswith("amiwarp.kernels")
        for module in imports_of(path)
        if module.startswith("amiwarp") and ".".join(module.split(".")[:2]) not in KERNELS_MAY_IMPORT | {"amiwarp"}
    ]
    assert wrong == []


def rank(module: str) -> int:
    """Row of a module; one without a place is reported by the test below."""
    part = module.split(".")[1]
    return next((i for i, names in enumerate(ORDER) if part in names), len(ORDER))


def inner_imports() -> Iterator[tuple[str, str]]:
    """(importing module, imported module) inside the package, the front door excluded."""
    known = {name_of(path) for path in MODULES}
    for path in MODULES:
        for module in imports_of(path):
            if name_of(path) != "amiwarp" and module in known and module != "amiwarp":
                yield name_of(path), module


def test_every_module_has_its_place() -> None:
    placed = {name for row in ORDER for name in row}
    assert {name_of(path).split(".")[1] for path in MODULES if name_of(path) != "amiwarp"} - placed == set()


def test_imports_run_one_way() -> None:
    wrong = [f"{user} imports {used}" for user, used in inner_imports() if rank(used) > rank(user)]
    assert wrong == []
