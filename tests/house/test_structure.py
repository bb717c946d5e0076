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
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import FunctionType, ModuleType

import pytest
import warp as wp

import amiwarp
from amiwarp.schema.type_names import NamedType
from amiwarp.tasks import no_garbage_collection
from tests import ROOT

PACKAGE = ROOT / "amiwarp"
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
                        found.append(
                            (
                                f"{name_of(path)}.{node.name}:{node.lineno}",
                                text.partition("(")[0],
                                node,
                            )
                        )
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
    postponed = [
        name_of(path)
        for path in MODULES
        if name_of(path) in files and "__future__" in set(imports_of(path))
    ]
    assert postponed == []


def test_no_local_structure_has_the_name_of_a_constant_of_warp() -> None:
    """Warp takes ``e.angle`` for its constant ``e`` until it has generated code, then compiles the module once more."""
    constants = {name for name in dir(wp) if isinstance(getattr(wp, name), int | float)}
    found = [
        f"{where}: {part.value.id}"
        for where, _, node in device_code()
        for part in ast.walk(node)
        if isinstance(part, ast.Attribute)
        and isinstance(part.value, ast.Name)
        and part.value.id in constants
    ]
    assert found == []


def test_import_loads_nothing_heavy() -> None:
    script = f"import sys, amiwarp; print(*[m for m in {HEAVY!r} if m in sys.modules])"
    out = subprocess.run(
        [sys.executable, "-c", script],
        cwd=PACKAGE.parent,
        capture_output=True,
        text=True,
        check=True,
    )
    assert out.stdout.split() == []


def test_every_public_name_loads() -> None:
    script = "import amiwarp; [getattr(amiwarp, name) for name in amiwarp.PUBLIC_NAMES]"
    subprocess.run(
        [sys.executable, "-c", script],
        cwd=PACKAGE.parent,
        capture_output=True,
        text=True,
        check=True,
    )


def test_each_room_has_its_public_names() -> None:
    front = ast.parse((PACKAGE / "__init__.pyi").read_text())
    homes = {
        alias.name: node.module.split(".")
        for node in front.body
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
    }
    in_rooms = {name: home[0] for name, home in homes.items() if home[0] in amiwarp.GROUPS}
    assert len(in_rooms) > 150
    for name, room in in_rooms.items():
        place = PACKAGE / room / name
        if place.is_dir() or place.with_suffix(".py").exists():
            continue  # a function with the name of its module is in the front door only
        found = getattr(importlib.import_module(f"amiwarp.{room}"), name)
        assert found is getattr(amiwarp, name) or isinstance(getattr(amiwarp, name), NamedType)
    assert len(amiwarp.__all__) <= 70
    assert set(amiwarp.__all__) <= set(amiwarp.PUBLIC_NAMES)


def test_no_public_name_is_a_module() -> None:
    assert sorted({path.stem for path in PACKAGE.iterdir()} & set(amiwarp.PUBLIC_NAMES)) == []


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
        for name in amiwarp.PUBLIC_NAMES
        for used in _types_of(name)
        if used not in amiwarp.PUBLIC_NAMES and used in classes()
    }
    assert sorted(missing) == []


@functools.cache
def classes() -> set[str]:
    """Return the names of the package's classes."""
    nodes = (node for path in MODULES for node in tree_of(path).body)
    return {
        node.name
        for node in nodes
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    }


def _types_of(name: str) -> Iterator[str]:
    public = getattr(amiwarp, name)
    if not isinstance(public, type | FunctionType):
        return
    body = tree_of(Path(inspect.getfile(inspect.unwrap(public)))).body
    # After its overloads
    node = [node for node in body if getattr(node, "name", None) == public.__name__][-1]
    inner = [node] if isinstance(node, ast.FunctionDef) else list(ast.iter_child_nodes(node))
    for part in inner:
        if isinstance(part, ast.FunctionDef) and (
            part is node or part.name == "__init__" or part.name[0] != "_"
        ):
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
    graph = {
        name_of(path): imported_modules(path) for path in MODULES if path.name != "__init__.py"
    }
    order = graphlib.TopologicalSorter({name: used & set(graph) for name, used in graph.items()})
    order.prepare()


def test_a_cycle_would_be_seen() -> None:
    with pytest.raises(graphlib.CycleError):
        graphlib.TopologicalSorter({"a": {"b"}, "b": {"a"}}).prepare()


OPENERS = {
    "open",
    "np.load",
    "h5py.File",
    "trimesh.load",
    "trimesh.load_mesh",
    "pyvista.read",
    "sqlite3.connect",
}
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
    "amiwarp.io.inputs: _Input(path)": "the way that all take",
    # Functions of the reading process. ReadingProcess.send has checked and noted the path.
    "amiwarp.io.hdf5.server_rows: h5py.File(path, 'r')": "reading process",
    "amiwarp.io.hdf5.server_sensors: h5py.File(path, 'r')": "reading process",
    "amiwarp.io.hdf5.server: h5py.h5f.open(name, how, fapl=access)": "reading process",
    "amiwarp.io.hdf5.server: h5py.h5f.open(name, how | h5py.h5f.ACC_SWMR_READ, fapl=access)": "reading process",
    "amiwarp.io.hdf5.server_datasets: open(path, 'rb')": "reading process",
    "amiwarp.io.ros.bags: open(path, 'rb')": "reading process",
    "amiwarp.io.ros.packed: open(source, 'rb')": "reading process",
    "amiwarp.io.ros.packed: open(source / 'metadata.yaml', encoding='utf-8')": "reading process",
    "amiwarp.io.ros.bags: bag.open()": "reading process",
    # Files of the system and of the package.
    "amiwarp.io.unfinished: Path('/proc/sys/kernel/random/boot_id').read_text(encoding='ascii')": "system",
    "amiwarp.io.reading_server: os.open('/proc/self/statm', os.O_RDONLY)": "system",
    "amiwarp.studies.machine: info.read_text(encoding='utf-8')": "system",
    "amiwarp.live.stream.sources: open(0, 'rb', buffering=0, closefd=False)": "standard input",
    "amiwarp.workarounds: path.read_text(encoding='utf-8')": "file of the package",
    "amiwarp.imaging.c_sums: (TEMPLATES / name).read_text(encoding='utf-8')": "file of the package",
    "amiwarp.viewer.page_files: (FOLDER / 'page.html').read_text(encoding='utf-8')": "file of the package",
    # Unfinished files of this process, or of a child of it.
    "amiwarp.imaging.export: open(part, 'r+b')": "own file",
    "amiwarp.io.unfinished: open(path, 'r+b')": "lock file",
    "amiwarp.io.outputs: os.open(folder, os.O_RDONLY)": "folder that is locked",
    "amiwarp.io.native.live_writer: open(self.part, 'r+b')": "own file",
    "amiwarp.io.npz_writer: (folder / name).open('rb')": "own file",
    # What is no file.
    "amiwarp.io.hdf5.server_objects: h5py.h5a.open(group, attribute.encode())": "attribute",
    "amiwarp.io.hdf5.server_objects: h5py.h5g.open(file, b'/')": "group",
    "amiwarp.io.hdf5.server_objects: h5py.h5o.open(parent, key)": "group or dataset",
    "amiwarp.io.hdf5.server_columns: h5py.File(path, 'r')": "reading process",
    "amiwarp.io.columns.matlab: loadmat(path, simplify_cells=True)": "reading process",
    "amiwarp.io.text.reader: np.loadtxt(kept, np.int64, ndmin=1, comments=None, encoding='ascii', "
    "usecols=time_column)": "lines",
    "amiwarp.io.text.reader: np.loadtxt(kept, ndmin=2, comments=None, encoding='ascii')": "lines",
    "amiwarp.plotting.figures: Image.open(buffer)": "bytes",
    "amiwarp.simulation.worlds.mesh_reader: Image.open(io.BytesIO(data), formats=PICTURE_FORMATS)": "bytes",
    "amiwarp.simulation.worlds.mesh_reader: trimesh.load(file, file_type=kind, resolver=files, force='scene', "
    "process=False)": "open file",
    "amiwarp.studies.evaluate.stored_pictures: Image.open(data, formats=['PNG'])": "bytes",
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
        if name == "os.open" and (
            "O_CREAT" in ast.unparse(node) or "O_WRONLY" in ast.unparse(node)
        ):
            continue
        inner = (call.func for call in ast.walk(node) if isinstance(call, ast.Call))
        if not any(isinstance(func, ast.Name) and func.id == "input_path" for func in inner):
            yield ast.unparse(node)


def test_inputs_are_opened_in_one_way() -> None:
    """So each is checked to be a regular file, and no command can write over it."""
    found = {
        f"{name_of(path)}: {call}" for path in MODULES for call in opened_otherwise(nodes_of(path))
    }
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


OTHER_ROOMS = {"benchmarks", "firmware", "house", "rig", "ros"}
"""Folders of tests of what is not in the package: of other folders, and of the repository as a whole."""


def misplaced(folder: Path, rooms: set[str]) -> list[str]:
    """Return the test files that are in no room, have a namesake, or are in a room without ``__init__.py``."""
    files = sorted(folder.rglob("test_*.py"))
    names = Counter(path.name for path in files)
    return [
        path.relative_to(folder).as_posix()
        for path in files
        if path.parent.parent != folder
        or path.parent.name not in rooms
        or not path.with_name("__init__.py").exists()
        or names[path.name] > 1
    ]


def test_each_test_file_is_in_the_room_that_it_tests() -> None:
    """Its name is unique: other programs name it without its folder."""
    rooms = {path.name for path in PACKAGE.iterdir() if (path / "__init__.py").exists()}
    assert misplaced(ROOT / "tests", rooms | OTHER_ROOMS) == []


def test_a_misplaced_test_file_is_seen(tmp_path: Path) -> None:
    files = (
        "test_top.py",
        "io/test_one.py",
        "io/test_two.py",
        "io/deep/test_three.py",
        "cli/test_two.py",
        "gone/test_four.py",
    )
    for file in files:
        path = tmp_path / file
        path.parent.mkdir(exist_ok=True, parents=True)
        path.touch()
        path.with_name("__init__.py").touch()
    (tmp_path / "lens").mkdir()
    (tmp_path / "lens" / "test_five.py").touch()
    assert misplaced(tmp_path, {"io", "cli", "lens"}) == [
        "cli/test_two.py",
        "gone/test_four.py",
        "io/deep/test_three.py",
        "io/test_two.py",
        "lens/test_five.py",
        "test_top.py",
    ]
