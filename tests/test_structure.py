"""Rules for the code that a program can check: lazy imports, public names, no import cycles, one way to open files.

Which room may import which is a contract of import-linter in ``pyproject.toml``.
"""

import ast
import functools
import graphlib
import importlib
import inspect
import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import FunctionType, ModuleType

import pytest
import warp as wp

import amiwarp
from amiwarp.tasks import no_garbage_collection

PACKAGE = Path(__file__).parents[1] / "amiwarp"
MODULES = sorted(PACKAGE.rglob("*.py"))
KERNEL_PARAMETERS = 10
HEAVY = (
    "warp",
    "nlopt",
    "h5py",
    "hdf5plugin",
    "pyvista",
    "serial",
    "av",
    "matplotlib",
    "scipy",
    "trame",
    "aiohttp",
)


def name_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@functools.cache
def tree_of(path: Path) -> ast.Module:
    with no_garbage_collection():  # it would visit all trees again and again, for three seconds
        return ast.parse(path.read_text())


@functools.cache
def nodes_of(path: Path) -> list[ast.AST]:
    """Return the imports, functions and calls in a file. A walk through all files takes seconds."""
    kinds = (ast.Import, ast.ImportFrom, ast.FunctionDef, ast.Call)
    return [node for node in ast.walk(tree_of(path)) if isinstance(node, kinds)]


@pytest.fixture(scope="module", autouse=True)
def trees() -> Iterator[None]:
    """Free the syntax trees after this file's tests."""
    yield
    tree_of.cache_clear()
    nodes_of.cache_clear()


def imports_of(path: Path) -> Iterator[str]:
    """Yield the modules that a file imports: in functions, and for types only, too."""
    for node in nodes_of(path):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@functools.cache
def device_code() -> list[tuple[str, str, ast.FunctionDef]]:
    """Return the place, the decorator and the syntax tree of every Warp kernel and device function."""
    found = []
    for path in MODULES:
        for node in nodes_of(path):
            if isinstance(node, ast.FunctionDef):
                for decorator in node.decorator_list:
                    text = ast.unparse(decorator)
                    if text.startswith(("wp.kernel", "wp.func")):
                        found.append((f"{name_of(path)}.{node.name}:{node.lineno}", text.partition("(")[0], node))
    return found


def test_there_is_something_to_check() -> None:
    kinds = [kind for _, kind, _ in device_code()]
    assert kinds.count("wp.kernel") >= 5
    assert kinds.count("wp.func") >= 20


def test_kernels_take_few_parameters() -> None:
    wide = [
        f"{where}: {len(node.args.args)} parameters"
        for where, kind, node in device_code()
        if kind == "wp.kernel" and len(node.args.args) > KERNEL_PARAMETERS
    ]
    assert wide == []


def test_kernel_modules_keep_their_annotations() -> None:
    """Postponed annotations break kernels whose types come from a closure."""
    files = {where.rpartition(".")[0] for where, _, _ in device_code()}
    postponed = [name_of(path) for path in MODULES if name_of(path) in files and "__future__" in set(imports_of(path))]
    assert postponed == []


def test_no_local_structure_has_the_name_of_a_constant_of_warp() -> None:
    """Warp takes ``e.angle`` for its constant ``e`` until it has generated code, then compiles the module once more."""
    constants = {name for name in dir(wp) if isinstance(getattr(wp, name), int | float)}
    found = [
        f"{where}: {part.value.id}"
        for where, _, node in device_code()
        for part in ast.walk(node)
        if isinstance(part, ast.Attribute) and isinstance(part.value, ast.Name) and part.value.id in constants
    ]
    assert found == []


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
    import amiwarp.imaging.iwe as images

    assert images.iwe is amiwarp.iwe


def test_types_in_public_signatures_are_public() -> None:
    """Checks public functions, and fields, properties and methods of public classes."""
    missing = {
        f"{name} uses {used}"
        for name in amiwarp.__all__
        for used in _types_of(name)
        if used not in amiwarp.__all__ and used in classes()
    }
    assert sorted(missing) == []


@functools.cache
def classes() -> set[str]:
    """Return the names of the package's classes."""
    nodes = (node for path in MODULES for node in tree_of(path).body)
    return {node.name for node in nodes if isinstance(node, ast.ClassDef) and not node.name.startswith("_")}


def _types_of(name: str) -> Iterator[str]:
    public = getattr(amiwarp, name)
    if not isinstance(public, type | FunctionType):
        return
    body = tree_of(Path(inspect.getfile(inspect.unwrap(public)))).body
    node = [node for node in body if getattr(node, "name", None) == public.__name__][-1]  # after its overloads
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
    """Return the modules of the package that a file imports."""
    known = {name_of(other) for other in MODULES}
    return {module for module in imports_of(path) if module in known} - {name_of(path), "amiwarp"}


def test_no_modules_import_each_other() -> None:
    """Not even for types or inside functions. Packages that only re-export names do not count."""
    graph = {name_of(path): imported_modules(path) for path in MODULES if path.name != "__init__.py"}
    order = graphlib.TopologicalSorter({name: used & set(graph) for name, used in graph.items()})
    order.prepare()


def test_a_cycle_would_be_seen() -> None:
    with pytest.raises(graphlib.CycleError):
        graphlib.TopologicalSorter({"a": {"b"}, "b": {"a"}}).prepare()


OPENERS = {"open", "np.load", "h5py.File", "trimesh.load", "trimesh.load_mesh", "pyvista.read", "sqlite3.connect"}
"""Functions that open a file, of Python and of the libraries that the package uses."""
OPENING_NAMES = {
    "open", "read_text", "read_bytes", "memmap", "open_memmap", "fromfile", "loadtxt", "genfromtxt", "loadmat",
    "read_csv", "read_table", "ZipFile", "TarFile", "GzipFile", "FileIO", "_Input", "imread", "imopen", "VideoCapture",
    "Decoder", "copyfile", "copy2",
}  # fmt: skip
"""Last parts of the names of others, whatever their module is called."""
OPEN_NO_FILE = {
    "read_text",  # of input_files
    "drivers.open", "dv.io.camera.open", "archive.open", "playback.open", "stream.open", "inspector.open",
    "self.open", "tabs.open",
}  # fmt: skip
"""Functions with such names that read no file."""
OPENED_OTHERWISE = {
    "amiwarp.io.files: _Input(path)": "the way that all take",
    # Functions of the reading process. ReadingProcess.send has checked and noted the path.
    "amiwarp.io.hdf5_server: h5py.File(path, 'r')": "reading process",
    "amiwarp.io.hdf5_server: h5py.h5f.open(name, how, fapl=access)": "reading process",
    "amiwarp.io.hdf5_server: h5py.h5f.open(name, how | h5py.h5f.ACC_SWMR_READ, fapl=access)": "reading process",
    "amiwarp.io.hdf5_server: open(path, 'rb')": "reading process",
    "amiwarp.io.ros_bags: open(path, 'rb')": "reading process",
    "amiwarp.io.ros_packed: open(source, 'rb')": "reading process",
    "amiwarp.io.ros_packed: open(source / 'metadata.yaml', encoding='utf-8')": "reading process",
    "amiwarp.io.ros_bags: bag.open()": "reading process",
    # Files of the system and of the package.
    "amiwarp.io.files: Path('/proc/sys/kernel/random/boot_id').read_text(encoding='ascii')": "system",
    "amiwarp.io.reading_process: os.open('/proc/self/statm', os.O_RDONLY)": "system",
    "amiwarp.studies.cluster: info.read_text(encoding='utf-8')": "system",
    "amiwarp.live.stream.sources: open(0, 'rb', buffering=0, closefd=False)": "standard input",
    "amiwarp.viewer.serve: path.read_text(encoding='utf-8')": "file of the package",
    "amiwarp.viewer.serve: (FOLDER / 'page.html').read_text(encoding='utf-8')": "file of the package",
    # Unfinished files of this process, or of a child of it.
    "amiwarp.imaging.export: open(part, 'r+b')": "own file",
    "amiwarp.io.files: open(path, 'r+b')": "lock file",
    "amiwarp.io.files: os.open(folder, os.O_RDONLY)": "folder that is locked",
    "amiwarp.io.native_format: open(self.part, 'r+b')": "own file",
    "amiwarp.io.plain_files: (folder / name).open('rb')": "own file",
    # What is no file.
    "amiwarp.io.hdf5_server: h5py.h5a.open(group, attribute.encode())": "attribute",
    "amiwarp.io.hdf5_server: h5py.h5g.open(file, b'/')": "group",
    "amiwarp.io.hdf5_server: h5py.h5o.open(parent, key)": "group or dataset",
    "amiwarp.io.table_server: h5py.File(path, 'r')": "reading process",
    "amiwarp.io.table_server: loadmat(path, simplify_cells=True)": "reading process",
    "amiwarp.io.text_files: np.loadtxt(kept, np.int64, ndmin=1, comments=None, encoding='ascii', usecols=at)": "lines",
    "amiwarp.io.text_files: np.loadtxt(kept, ndmin=2, comments=None, encoding='ascii')": "lines",
    "amiwarp.plotting.figures: Image.open(buffer)": "bytes",
    "amiwarp.simulation.worlds.world_files: Image.open(io.BytesIO(data), formats=PICTURE_FORMATS)": "bytes",
    "amiwarp.simulation.worlds.world_files: trimesh.load(file, file_type=kind, resolver=files, force='scene', "
    "process=False)": "open file",
    "amiwarp.studies.evaluate.study: Image.open(io.BytesIO(base64.b64decode(text, validate=True)), "
    "formats=['PNG'])": "bytes",
}
"""Calls that open a file for reading in another way, and what they open."""


def last_name(node: ast.AST) -> str:
    """Return the last part of the name of a called function; empty for other nodes and for calls of other values."""
    function = node.func if isinstance(node, ast.Call) else None
    return function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")


def opened_otherwise(nodes: Iterable[ast.AST]) -> Iterator[str]:
    """Yield the calls that open a file for reading, other than ``open_input(path)`` and ``f(input_path(path))``."""
    for node in nodes:
        last = last_name(node)
        if last not in OPENING_NAMES | {name.rpartition(".")[2] for name in OPENERS}:
            continue
        assert isinstance(node, ast.Call)
        name = ast.unparse(node.func)
        if name in OPEN_NO_FILE or (name not in OPENERS and last not in OPENING_NAMES):
            continue
        modes = [*node.args[:2], *(word.value for word in node.keywords if word.arg == "mode")]
        texts = [set(str(mode.value)) for mode in modes if isinstance(mode, ast.Constant)]
        if any(text <= set("rwxabt+") and text & set("wxa") for text in texts):
            continue
        if name == "os.open" and ("O_CREAT" in ast.unparse(node) or "O_WRONLY" in ast.unparse(node)):
            continue
        inner = (call.func for call in ast.walk(node) if isinstance(call, ast.Call))
        if not any(isinstance(func, ast.Name) and func.id == "input_path" for func in inner):
            yield ast.unparse(node)


def test_inputs_are_opened_in_one_way() -> None:
    """So each is checked to be a regular file, and no command can write over it."""
    found = {f"{name_of(path)}: {call}" for path in MODULES for call in opened_otherwise(nodes_of(path))}
    assert found == set(OPENED_OTHERWISE)


def test_paths_reach_the_reading_process_as_paths() -> None:
    """ReadingProcess.send checks and notes them. As text they would pass by."""
    texts = [
        name_of(path)
        for path in MODULES
        if path.name != "reading_process.py"
        for node in nodes_of(path)
        if last_name(node) == "abspath" and ast.unparse(node.func) == "os.path.abspath"
    ]
    assert texts == []


@pytest.mark.parametrize(
    "code",
    ["open(path)", "open(path, 'rb')", "open(path, mode='r')", "path.open()", "(a / b).open('rb')", "path.read_text()",
     "path.read_bytes()", "os.open(path, os.O_RDONLY)", "np.load(path, mmap_mode='r')", "np.loadtxt(path)",
     "h5py.File(path)", "h5py.File(path, 'r')", "av.open(str(path))", "Image.open(path)", "zipfile.ZipFile(path)",
     "trimesh.load(path)", "evt.Decoder(path)", "open(path, 'r+b')", "path.open(mode)", "ZipFile(path)",
     "shutil.copyfile(path, part)"],
)  # fmt: skip
def test_another_way_would_be_seen(code: str) -> None:
    assert list(opened_otherwise(ast.walk(ast.parse(f"def read(path):\n    return {code}")))) != []


@pytest.mark.parametrize(
    "code",
    ["open(path, 'w')", "path.open('xb')", "h5py.File(path, 'w')", "zipfile.ZipFile(part, 'x')",
     "os.open(path, os.O_RDWR | os.O_CREAT)", "np.load(input_path(path))", "av.open(str(input_path(path)))"],
)  # fmt: skip
def test_other_calls_are_no_inputs(code: str) -> None:
    assert list(opened_otherwise(ast.walk(ast.parse(code)))) == []
