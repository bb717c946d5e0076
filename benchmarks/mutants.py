"""Mutation test: do the tests notice small defects in the code?

    python -m benchmarks.mutants [--count 200] [--seed 1] [--only AREA …] [--jobs 2] [--map FOLDER] [--out FILE.json]

Cosmic Ray (``pip install '.[mutants]'``) finds the places in the modules of ``benchmarks/mutants.toml`` where a small
change is possible. A seeded sample of these places, spread over the modules by their number of places, is changed, one
at a time, in copies of the repository. A mutant is killed if a test fails among those that run the changed function.
Kernels are compiled and decoders run in another process, so it is not known which tests run them: all tests of the area
are used. The exit status is 1 if a mutant survives that ``mutants.toml`` does not explain.

Not changed are annotations, texts of errors and blocks for type checkers. All tests must pass without a change first;
that run also records which test runs which line. ``--map`` keeps this record for the next run of the same code.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import difflib
import functools
import itertools
import json
import os
import random
import re
import subprocess
import sys
import tempfile
import tomllib
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import coverage
from cosmic_ray import plugins
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import MutationVisitor
from cosmic_ray.operators.operator import Operator
from parso.python.tree import Name, PythonNode

from benchmarks.copies import (
    PATIENCE,
    ROOT,
    START_S,
    files_of_tests,
    make_copies,
    run_python,
    write_code,
)

CONFIG = ROOT / "benchmarks" / "mutants.toml"

TESTS_S = 60.0
"""Default of the total duration of the tests of the area, and of other tests, that are run on one mutant [s]."""

ARITHMETIC, BITS, ORDER = (
    "(Add|Sub|Mul|Div|FloorDiv|Mod)",
    "(RShift|LShift|BitOr|BitAnd|BitXor)",
    "(Eq|NotEq|Lt|LtE|Gt|GtE)",
)
OPERATORS = re.compile(
    f"core/(ReplaceBinaryOperator_({ARITHMETIC}_{ARITHMETIC}|{BITS}_{BITS}|Pow_Mul)"
    f"|ReplaceComparisonOperator_({ORDER}_{ORDER}|Is_IsNot|IsNot_Is)|ReplaceUnaryOperator_Delete_(Not|USub|Invert)"
    "|(?!Replace(Binary|Comparison|Unary)|Variable).*)"
)
"""Cosmic Ray's operators without those that make nonsense, such as a shift by a float."""


PYTEST = ["-q", "-x", "-p", "no:cacheprovider", "-p", "benchmarks.mutants_plugin"]


class DropCall(Operator):
    """Leave out a call whose result is not used."""

    def mutation_positions(self, node: Any) -> Iterator[Any]:
        """Yield the position of a statement that is a call."""
        call = node.children[0] if node.type == "simple_stmt" else node
        if (
            call is not node
            and call.type == "atom_expr"
            and call.children[-1].get_code().startswith("(")
        ):
            yield call.start_pos, call.end_pos

    def mutate(self, node: PythonNode, index: int) -> PythonNode:
        """Put ``pass`` in its place."""
        node.children[0] = Name("pass", node.start_pos, node.get_first_leaf().prefix)
        return node

    @classmethod
    def examples(cls) -> tuple[()]:
        """Give none."""
        return ()


@dataclass(frozen=True)
class Mutant:
    """One change of one place of a module: ``before`` is replaced by ``after`` at ``line``."""

    area: str
    module: str
    line: int
    before: str
    after: str
    operator: str
    function: str
    """Qualified name of the function, if its body alone is changed and it is not part of a kernel."""
    code: str


Place = tuple[str, str, int, list[tuple[str, int]]]
"""Area, module, line, and each possible change by operator and occurrence."""


def places_of(area: str, module: str) -> list[Place]:
    """Return all places of a module that can be changed."""
    source = (ROOT / module).read_text()
    nodes, skipped = list(ast_nodes(get_ast(source))), list(_skipped(ast.parse(source)))
    found: dict[Any, list[tuple[str, int]]] = {}
    for name, operator in _operators().items():
        positions = (position for node in nodes for position in operator.mutation_positions(node))
        for occurrence, (start, end) in enumerate(positions):
            if not any(first <= start < last for first, last in skipped):
                found.setdefault((start, end), []).append((name, occurrence))
    return [(area, module, start[0], changes) for (start, _), changes in sorted(found.items())]


def _operators() -> dict[str, Any]:
    classes = {
        name: plugins.get_operator(name)
        for name in plugins.operator_names()
        if OPERATORS.fullmatch(name)
    }
    return {"amiwarp/DropCall": DropCall()} | {
        name: operator() for name, operator in classes.items()
    }


def _skipped(tree: ast.AST) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """Yield the extents of annotations, raised errors, unions of types, type-checking blocks and some decorators."""
    for node in ast.walk(tree):
        parts: list[Any] = [getattr(node, "annotation", None), getattr(node, "returns", None)]
        if isinstance(node, ast.Raise):
            parts.append(node.exc)
        if isinstance(node, ast.Expr) and ast.unparse(node).startswith("wp.set_module_options"):
            parts.append(node)
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            parts.append(node)
        if isinstance(node, ast.Assign) and re.fullmatch(
            r"[A-Z]\w+( \| [A-Z]\w+)+", ast.unparse(node.value)
        ):
            parts.append(node.value)
        for part in filter(None, parts):
            yield (part.lineno, part.col_offset), (part.end_lineno, part.end_col_offset)
        for decorator in getattr(node, "decorator_list", ()):
            if re.match(r"wp\.|overload|dataclass", ast.unparse(decorator)):
                yield (decorator.lineno, 0), (decorator.end_lineno, decorator.end_col_offset)


def sample(areas: list[dict[str, Any]], count: int, seed: int) -> list[Mutant]:
    """Return ``count`` mutants of different places. Each module gets its share, and each place one change."""
    rng = random.Random(seed)
    places: list[Place] = []
    for area in areas:
        for module in sorted(
            {str(p.relative_to(ROOT)) for glob in area["modules"] for p in ROOT.glob(glob)}
        ):
            found = places_of(area["name"], module)
            places += rng.sample(found, len(found))
    step = len(places) / count
    start = rng.uniform(0, step)
    print(f"{count} of {len(places)} places", flush=True)
    return [
        next(filter(None, (_mutant(place, rng) for place in places[int(start + k * step) :])))
        for k in range(count)
    ]


def _mutant(place: Place, rng: random.Random) -> Mutant | None:
    """Apply one of the possible changes of a place, or return None if none is valid Python."""
    area, module, line, changes = place
    source = (ROOT / module).read_text()
    for name, occurrence in rng.sample(changes, len(changes)):
        try:
            code = MutationVisitor.mutate_code(source, _operators()[name], occurrence)
            ast.parse(code)
        except (
            SyntaxError,
            AttributeError,
        ):  # ExceptionReplacer cannot change a dotted name among others
            continue
        changed = [k for k in difflib.ndiff(source.splitlines(), code.splitlines()) if k[0] in "+-"]
        before, after = (" ".join(k[2:].strip() for k in changed if k[0] == sign) for sign in "-+")
        function = "" if "/kernels/" in module else _function(ast.parse(source), line)[2]
        return Mutant(area, module, line, before, after, name.split("/")[1], function, code)
    return None


class Map:
    """Which tests run which lines, and how long they take."""

    def __init__(self, folder: Path) -> None:
        """Read a record that :func:`record` made."""
        known = json.loads((folder / "tests.json").read_text())
        self.seconds: dict[str, float] = known["seconds"]
        self._called: dict[str, list[str]] = known["called"]
        self._data = coverage.CoverageData(str(folder / "lines"))
        self._data.read()

    def tests(self, mutant: Mutant, files: list[str], most_s: float) -> list[list[str]]:
        """Return the tests of a mutant: those of its area that run its function, then others that do.

        Those of files that name the module come first, then those that run the line, then the fastest. Tests that call
        the module in the reading process may run it, too. If nothing is known, all tests of the area are taken.
        """
        own = {
            test
            for test in self.seconds
            if Path(_file_of(test)).stem.removeprefix("test_") in files
        }
        lines: dict[int, list[str]] = {}
        for name in self._data.measured_files():
            if name.endswith(mutant.module):
                lines = self._data.contexts_by_lineno(name)
        first, last, _ = _function(ast.parse((ROOT / mutant.module).read_text()), mutant.line)
        near = {
            test
            for line in range(first, last + 1)
            for test in lines.get(line, ())
            if test in self.seconds
        }
        dotted = mutant.module.removesuffix(".py").replace("/", ".")
        near |= {
            test
            for test, called in self._called.items()
            if any(dotted in _imported(name) for name in called)
        }
        near = near or own
        here, naming = set(lines.get(mutant.line, ())), _files_naming(dotted)

        def affordable(tests: set[str]) -> list[str]:
            ordered = sorted(
                tests,
                key=lambda test: (
                    _file_of(test) not in naming,
                    test not in here,
                    self.seconds[test],
                ),
            )
            totals = itertools.accumulate(self.seconds[test] for test in ordered)
            return [test for test, total in zip(ordered, totals, strict=True) if total < most_s]

        return [affordable(tests) for tests in (near & own, near - own)]


def _file_of(test: str) -> str:
    return test.partition("::")[0]


@functools.cache
def _imported(dotted: str) -> frozenset[str]:
    """Return a module of ``amiwarp.io`` and those that it imports there, directly or not."""
    path = ROOT / f"{dotted.replace('.', '/')}.py"
    names = (
        re.findall(r"^from (amiwarp\.io\.\w+) import", path.read_text(), re.MULTILINE)
        if path.exists()
        else ()
    )
    return frozenset({dotted}).union(*map(_imported, names))


@functools.cache
def _files_naming(dotted: str) -> set[str]:
    """Return the test files that import a module, or a name that a package's stub takes from it."""
    names = {dotted}
    packages = dotted.split(".")[:-1]
    for depth in range(1, len(packages) + 1):
        package = ".".join(packages[:depth])
        stub = ROOT.joinpath(*packages[:depth], "__init__.pyi")
        module = dotted.removeprefix(package)
        listed = re.findall(
            rf"^from {re.escape(module)} import (\w+) as",
            stub.read_text() if stub.exists() else "",
            re.MULTILINE,
        )
        names |= {f"{package}.{name}" for name in listed}
    return {
        str(path.relative_to(ROOT))
        for path in (ROOT / "tests").rglob("test_*.py")
        if names & _imports(path)
    }


@functools.cache
def _imports(path: Path) -> set[str]:
    """Return the modules, and the names from modules, that a file imports."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    modules = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    given = [node for node in nodes if isinstance(node, ast.ImportFrom) and node.module]
    return modules.union(
        *({node.module, *(f"{node.module}.{a.name}" for a in node.names)} for node in given)
    )


def _function(tree: ast.AST, line: int, prefix: str = "") -> tuple[int, int, str]:
    """Return the first and the last line and the name of the outermost function whose body contains a line.

    For other lines, return those of the whole module and no name.
    """
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.ClassDef) and node.lineno <= line <= (node.end_lineno or 0):
            return _function(node, line, f"{prefix}{node.name}.")
        if isinstance(node, ast.FunctionDef):
            first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
            if first <= line <= (node.end_lineno or 0):
                return (
                    node.body[0].lineno,
                    node.end_lineno or 0,
                    prefix + node.name if line >= node.body[0].lineno else "",
                )
    return 1, 1_000_000, ""


def record(folder: Path, copy: Path, files: list[str]) -> None:
    """Run the tests without a change, and record the lines that each one runs."""
    folder.mkdir(parents=True, exist_ok=True)
    options = folder / "coverage.ini"
    options.write_text(
        "[run]\nsource_pkgs = amiwarp\nomit = */kernels/*,*/viewer/*,*/plotting/*\nconcurrency = thread\n"
        f"relative_files = true\ndata_file = {folder / 'lines'}\n"
    )
    environment = {"MUTANTS_DURATIONS": str(folder / "tests.json")}
    command = [
        "-m",
        "coverage",
        "run",
        f"--rcfile={options}",
        "-m",
        "pytest",
        *files_of_tests(copy, files),
    ]
    code, output = run_python(copy, [*command, *PYTEST], None, environment)
    if code:
        # The next run would take it for the record of all tests
        (folder / "tests.json").unlink(missing_ok=True)
        raise SystemExit(f"{output[-3000:]}\nthe tests do not pass without a change")


class Worker:
    """A copy of the repository, and a process that has collected the tests there."""

    def __init__(self, copy: Path, files: list[str]) -> None:
        """Start the process; :meth:`judge` waits for it."""
        self.copy = copy
        here, there = os.pipe(), os.pipe()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "pytest", *files, *PYTEST, "--capture=no"], cwd=copy, stdout=subprocess.DEVNULL,
            env=os.environ | {"PYTHONPATH": str(copy), "MUTANTS_PIPES": f"{here[0]} {there[1]}"},
            pass_fds=(here[0], there[1]),
        )  # fmt: skip
        os.close(here[0])
        os.close(there[1])
        self._requests, self._replies = os.fdopen(here[1], "w"), os.fdopen(there[0])
        self._ready = False

    def close(self) -> None:
        """Let the process end."""
        self._requests.close()
        self._process.wait()

    def judge(
        self, mutant: Mutant, tests: list[list[str]], seconds: dict[str, float]
    ) -> tuple[str, str]:
        """Run the tests on a mutant. Return ``killed`` or ``survived``, and what killed it."""
        path = self.copy / mutant.module
        if not self._ready and self._replies.readline() != "ready\n":
            raise SystemExit("the tests cannot be collected")
        self._ready = True
        original, changed = path.read_text(), path.stat().st_mtime
        # Also if the function is replaced: other processes import the file
        write_code(path, mutant.code)
        try:
            for some in filter(None, tests):
                limit_s = PATIENCE * sum(seconds[test] for test in some) + START_S
                cause = self._replaced(mutant, some, limit_s) if mutant.function else None
                if cause is None:
                    cause = self._imported(mutant, some, limit_s)
                if cause:
                    return "killed", cause[:300]
        finally:
            path.write_text(original)
            os.utime(path, (changed, changed))
        return "survived", f"{sum(map(len, tests))} tests"

    def _replaced(self, mutant: Mutant, tests: list[str], limit_s: float) -> str | None:
        """Run the tests with the changed function. Return what failed, or None if it cannot be changed."""
        path = str(self.copy / mutant.module)
        request = {
            "path": path,
            "function": mutant.function,
            "code": mutant.code,
            "tests": tests,
            "limit_s": limit_s,
        }
        self._requests.write(json.dumps(request) + "\n")
        self._requests.flush()
        cause: str | None = json.loads(self._replies.readline())
        return cause

    def _imported(self, mutant: Mutant, tests: list[str], limit_s: float) -> str:
        """Run the tests in a new process. Return what failed."""
        code, output = run_python(self.copy, ["-m", "pytest", *tests, *PYTEST], limit_s, {})
        if code == 4 and "not found:" in output:  # the change renames parametrised tests
            files = sorted({_file_of(test) for test in tests})
            code, output = run_python(self.copy, ["-m", "pytest", *files, *PYTEST], 4 * limit_s, {})
        reasons = [
            line
            for line in output.splitlines()
            if line.startswith(("FAILED", "ERROR", "E  ", "timeout"))
        ]
        return "" if code == 0 else reasons[-1] if reasons else output.strip()[-200:]


def explained(row: dict[str, Any], equivalents: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the outcome of a mutant. A survivor that changes nothing which a test can see is equivalent."""
    for known in equivalents if row["outcome"] == "survived" else ():
        if (
            all(known[name] == row[name] for name in ("module", "before"))
            and row["after"] in known["after"]
        ):
            return row | {"outcome": "equivalent", "cause": known["reason"]}
    return row


def score(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the share of killed mutants among those that are not equivalent, and the number of each outcome."""
    outcomes = Counter(row["outcome"] for row in rows)
    share = outcomes["killed"] / max(len(rows) - outcomes["equivalent"], 1)
    return {"score": round(share, 3), "outcomes": dict(outcomes)}


def main() -> None:
    """Read the command line, judge the sample and print the survivors and the score."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=200, help="number of mutants")
    parser.add_argument("--seed", type=int, default=1, help="another seed gives another sample")
    parser.add_argument("--only", nargs="+", metavar="AREA", help="names of areas")
    parser.add_argument("--jobs", type=int, default=2, help="mutants at the same time")
    parser.add_argument(
        "--seconds", type=float, default=TESTS_S, help="duration of the tests of one mutant"
    )
    parser.add_argument(
        "--map", type=Path, metavar="FOLDER", help="folder that keeps which test runs which line"
    )
    parser.add_argument("--out", type=Path, help="file of all mutants and their outcomes")
    parser.add_argument(
        "--again",
        type=Path,
        metavar="FILE.json",
        help="judge only the survivors of an earlier --out",
    )
    given = parser.parse_args()
    config = tomllib.loads(CONFIG.read_text())
    areas = [area for area in config["area"] if given.only is None or area["name"] in given.only]
    mutants = sample(areas, given.count, given.seed)
    rows: list[dict[str, Any]] = []
    before: dict[str, Any] | None = None
    if given.again:
        earlier = json.loads(given.again.read_text())
        known_rows = [explained(row, config.get("equivalent", [])) for row in earlier["mutants"]]
        before = earlier.get("before", score(known_rows))
        rows = [row for row in known_rows if row["outcome"] != "survived"]
        settled = {(row["module"], row["before"], row["after"]) for row in rows}
        mutants = [
            mutant
            for mutant in mutants
            if (mutant.module, mutant.before, mutant.after) not in settled
        ]
    names = list(dict.fromkeys(name for area in areas for name in area["tests"]))
    files_of = {area["name"]: area["tests"] for area in areas}
    with tempfile.TemporaryDirectory() as scratch, contextlib.ExitStack() as opened:
        copies = make_copies(Path(scratch), given.jobs)
        folder = given.map or Path(scratch) / "map"
        if not (folder / "tests.json").exists():
            record(folder, copies[0], names)
        known = Map(folder)
        files = sorted({_file_of(test) for test in known.seconds})
        workers: SimpleQueue[Worker] = SimpleQueue()
        for copy in copies:
            workers.put(opened.enter_context(contextlib.closing(Worker(copy, files))))

        def one(mutant: Mutant) -> None:
            worker = workers.get()
            try:
                tests = known.tests(mutant, files_of[mutant.area], given.seconds)
                outcome, cause = worker.judge(mutant, tests, known.seconds)
            finally:
                workers.put(worker)
            row = {
                key: value
                for key, value in asdict(mutant).items()
                if key not in ("function", "code")
            }
            cause = re.sub(r"(?<![\w.])(/[\w.-]+){2,}/", "", cause)  # folders of this machine
            row = explained(
                row | {"outcome": outcome, "cause": cause}, config.get("equivalent", [])
            )
            rows.append(row)
            change = f"{mutant.module}:{mutant.line} {mutant.before}  ->  {mutant.after}"
            print(f"{row['outcome']:10} {change}  [{row['cause']}]", flush=True)

        with ThreadPoolExecutor(given.jobs) as pool:
            # The slow ones last
            list(pool.map(one, sorted(mutants, key=lambda mutant: not mutant.function)))
    rows.sort(key=lambda row: (row["module"], row["line"]))
    total = score(rows)
    print(
        f"{total['outcomes']}: {100 * total['score']:.1f} % of those that are not equivalent are killed"
    )
    if given.out:
        by_area = {name: score([row for row in rows if row["area"] == name]) for name in files_of}
        result = {"seed": given.seed, "before": before, **total, "areas": by_area, "mutants": rows}
        given.out.write_text(json.dumps(result, indent=1, ensure_ascii=False) + "\n")
    sys.exit("survived" in total["outcomes"])


if __name__ == "__main__":
    main()
