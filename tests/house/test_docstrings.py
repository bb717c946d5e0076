"""Public docstrings: in numpydoc form, and their examples run."""

import ast
import dataclasses
import doctest
import enum
import importlib
import inspect
import itertools
import textwrap
from collections.abc import Iterator
from pathlib import Path
from types import FunctionType
from typing import Any

import pytest
from numpydoc.validate import validate

import amiwarp

CHECKS = {
    "GL03", "GL07", "GL08",  # no double blank lines, sections in order, a docstring at all
    "SS01", "SS02", "SS03", "SS04", "SS05", "SS06",  # one summary line: capital, period, infinitive
    "PR01", "PR02", "PR03", "PR04", "PR06", "PR07", "PR08", "PR09",  # every parameter, its type and a sentence
    "RT01", "RT03", "RT04", "RT05",  # the returned value
    "YD01", "EX01",
}  # fmt: skip
"""The checks of numpydoc that are applied here."""


def _inherits(public: type, key: str) -> bool:
    """Whether a member has no docstring but that of a public base class, where it is checked."""
    bases = [
        base
        for base in public.__mro__[1:]
        if base.__name__ in amiwarp.PUBLIC_NAMES and key in vars(base)
    ]
    return vars(public)[key].__doc__ is None and bool(bases)


def _members(name: str) -> Iterator[str]:
    """A public name, and the public methods and properties that its class documents itself."""
    yield name
    public = getattr(amiwarp, name)
    if isinstance(public, type) and public.__module__.startswith("amiwarp"):
        for key, value in vars(public).items():
            kinds = FunctionType | property | classmethod | staticmethod
            if key[0] != "_" and isinstance(value, kinds) and not _inherits(public, key):
                yield f"{name}.{key}"


def _documented() -> list[str]:
    kinds = type | FunctionType
    return [name for name in amiwarp.PUBLIC_NAMES if isinstance(getattr(amiwarp, name), kinds)]


def _found(path: str) -> Any:
    found: Any = amiwarp
    for part in path.split("."):
        found = (
            inspect.getattr_static(found, part) if isinstance(found, type) else getattr(found, part)
        )
    return found


def _plain(public: Any) -> bool:
    """Whether a class has no parameters of its own to describe: fields carry their own docstrings."""
    kinds = enum.Enum | BaseException
    protocol = bool(getattr(public, "_is_protocol", False))
    return isinstance(public, type) and (
        dataclasses.is_dataclass(public) or issubclass(public, kinds) or protocol
    )


def faults(path: str) -> list[str]:
    """Return what numpydoc reports about one public name."""
    public = _found(path)
    checks = set(CHECKS)
    if "." in path:
        checks -= {"EX01"}
    if _plain(public):
        checks -= {"PR01", "PR02", "EX01"}
    if isinstance(public, property):
        checks -= {"RT01", "RT03", "SS05"}
    return [
        f"{path}: {code} {text}"
        for code, text in validate(f"amiwarp.{path}")["errors"]
        if code in checks
    ]


@pytest.mark.parametrize("name", _documented())
def test_public_docstrings_are_in_numpydoc_form(name: str) -> None:
    assert [fault for path in _members(name) for fault in faults(path)] == []


@pytest.mark.parametrize(
    "name", [n for n in _documented() if dataclasses.is_dataclass(getattr(amiwarp, n))]
)
def test_fields_of_public_classes_have_docstrings(name: str) -> None:
    node = ast.parse(textwrap.dedent(inspect.getsource(getattr(amiwarp, name)))).body[0]
    assert isinstance(node, ast.ClassDef)
    body = [*node.body, None]
    bare = [
        ast.unparse(part.target)
        for part, after in itertools.pairwise(body)
        if isinstance(part, ast.AnnAssign)
        and not ast.unparse(part.target).startswith("_")
        and not (isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant))
    ]
    assert bare == []


@pytest.mark.parametrize("name", _documented())
def test_examples_run(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if name == "Network":
        pytest.importorskip("torch")
    public = getattr(amiwarp, name)
    module = importlib.import_module(public.__module__)
    monkeypatch.chdir(tmp_path)
    runner = doctest.DocTestRunner(
        optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE, verbose=False
    )
    for test in doctest.DocTestFinder(exclude_empty=True).find(
        public, name, module=module, globs={"amiwarp": amiwarp}
    ):
        report: list[str] = []
        runner.run(test, out=report.append)
        assert runner.failures == 0, "".join(report)
