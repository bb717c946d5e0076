"""What a release consists of agrees: version, changelog, citation, recipe, issue forms, and the checks of its files."""

import hashlib
import importlib.util
import re
import shutil
import sys
import tarfile
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml

import amiwarp
from tests import ROOT

PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))[
    "project"
]
CONDA_NAMES = {"blosc": "python-blosc", "matplotlib": "matplotlib-base"}
"""Names at conda-forge that differ from those at PyPI."""


def read_yaml(name: str) -> dict[str, Any]:
    """Return the content of a YAML file of the project."""
    content: dict[str, Any] = yaml.safe_load((ROOT / name).read_text(encoding="utf-8"))
    return content


def conda_requirement(requirement: str) -> str:
    """Return a requirement of pyproject.toml as conda writes it; markers do not exist there."""
    match = re.fullmatch(r"([\w.-]+)(?:\[.*?\])?\s*([^;\s]*)\s*(?:;.*)?", requirement)
    assert match is not None, requirement
    return f"{CONDA_NAMES.get(match[1], match[1])} {match[2]}".strip()


def test_the_version_is_the_same_everywhere() -> None:
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    latest = re.search(r"^## (\S+)", changelog, re.M)
    assert latest is not None
    assert latest[1] == amiwarp.__version__
    assert str(read_yaml("CITATION.cff")["version"]) == amiwarp.__version__
    assert read_yaml("recipe/recipe.yaml")["context"]["version"] == amiwarp.__version__


def test_the_conda_recipe_needs_what_the_package_needs() -> None:
    recipe = read_yaml("recipe/recipe.yaml")
    wanted = [
        f"python {PROJECT['requires-python']}",
        *map(conda_requirement, PROJECT["dependencies"]),
    ]
    assert recipe["requirements"]["run"] == wanted
    assert recipe["about"]["summary"] == PROJECT["description"]
    entries = [f"{name} = {target}" for name, target in PROJECT["scripts"].items()]
    assert recipe["build"]["python"]["entry_points"] == entries


def test_requirements_are_written_as_conda_does() -> None:
    assert conda_requirement("blosc>=1.11; sys_platform == 'linux'") == "python-blosc >=1.11"
    assert conda_requirement("amiwarp[dv,torch]") == "amiwarp"
    assert conda_requirement("av >=14,<20") == "av >=14,<20"


def test_the_changelog_of_the_first_release_is_short() -> None:
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    first = changelog.partition("\n## 0.1.0")[2].partition("\n## ")[0]
    assert 20 <= len(first.splitlines()) <= 80


FORMS = ("bug.yml", "file.yml", "idea.yml")


@pytest.mark.parametrize("name", FORMS)
def test_an_issue_form_is_complete_and_asks_for_the_version(name: str) -> None:
    """What GitHub requires of a form; the labels of fields ask for what every answer needs."""
    folder = ROOT / ".github" / "ISSUE_TEMPLATE"
    if not folder.is_dir():
        pytest.skip("the source distribution has no issue forms")
    form = read_yaml(f".github/ISSUE_TEMPLATE/{name}")
    fields = [field for field in form["body"] if field["type"] != "markdown"]
    assert form["name"]
    assert form["description"]
    assert {field["type"] for field in fields} <= {"input", "textarea", "dropdown"}
    identifiers = [field["id"] for field in fields]
    assert len(set(identifiers)) == len(identifiers)
    labels = " ".join(field["attributes"]["label"] for field in fields)
    assert "`amiwarp --version`" in labels
    assert "`amiwarp info" in labels


@pytest.fixture(scope="module")
def release() -> Iterator[ModuleType]:
    """Return the program that makes the files of a release, with its checks."""
    sys.path.insert(0, str(ROOT / ".ci"))
    try:
        spec = importlib.util.spec_from_file_location("release", ROOT / ".ci" / "release.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        yield module
    finally:
        sys.path.remove(str(ROOT / ".ci"))


PACKAGE = ("amiwarp/__init__.py", "amiwarp/py.typed", "amiwarp/page/page.html")
LICENCE = "amiwarp-1.0.dist-info/licenses/LICENSE"


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """Return a folder with the files of a small package and a test."""
    folder = tmp_path / "source"
    for name in (*PACKAGE, "tests/test_it.py", "pyproject.toml", "README.md", "LICENSE"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(name)
    (folder / "CHANGELOG.md").write_text("none")
    return folder


def make_wheel(folder: Path, *names: str) -> Path:
    wheel = folder / "amiwarp-1.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        for name in names:
            archive.writestr(name, "text")
    return wheel


@pytest.mark.parametrize(
    ("names", "problem"),
    [
        ((*PACKAGE, LICENCE), None),
        ((*PACKAGE, LICENCE, "tests/test_it.py"), "tests/test_it.py does not belong there"),
        ((*PACKAGE, LICENCE, "amiwarp/results.json"), "amiwarp/results.json does not belong there"),
        ((*PACKAGE[:2], LICENCE), "amiwarp/page/page.html is missing"),
        (PACKAGE, "the licence is missing"),
    ],
)
def test_a_wheel_holds_the_package_and_nothing_else(
    names: tuple[str, ...], problem: str | None, release: Any, source: Path
) -> None:
    wheel = make_wheel(source.parent, *names)
    found = release.release_checks.problems_of_wheel(wheel, source)
    assert found == ([] if problem is None else [f"{wheel.name}: {problem}"])
    assert release.release_checks.wheel_version(wheel) == "1.0"


def test_a_source_distribution_holds_the_tests_too(release: Any, source: Path) -> None:
    archive = source.parent / "amiwarp-1.0.tar.gz"
    problems = release.release_checks.problems_of_archive
    with tarfile.open(archive, "w:gz") as tar:
        tar.add(source, "amiwarp-1.0")
    assert problems(archive, source) == []
    (source / "tests" / "test_more.py").write_text("more")
    assert problems(archive, source) == [f"{archive.name}: tests/test_more.py is missing"]


def test_a_file_that_is_too_large_is_seen(
    release: Any, source: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wheel = make_wheel(source.parent, *PACKAGE, LICENCE)
    monkeypatch.setitem(release.release_checks.MOST_MB, ".whl", 1e-4)
    (found,) = release.release_checks.problems_of_wheel(wheel, source)
    assert found.endswith("MB is more than 0.0001 MB")


def test_the_first_command_of_the_readme_is_tried(release: Any) -> None:
    first_command = release.release_checks.first_command
    assert first_command((ROOT / "README.md").read_text(encoding="utf-8")) == ["amiwarp", "demo"]
    assert first_command("```sh\npip && .venv/bin/amiwarp info a.h5\n```\n")[1:] == ["info", "a.h5"]
    with pytest.raises(ValueError, match=r"README\.md: the first block has no command"):
        first_command("```sh\npip install .\n```\n```sh\n.venv/bin/amiwarp demo\n```\n")


DEMO = "apex      {apex} deg found, 1.0000 deg true\nmodel error   {error} px rms over image"


@pytest.mark.parametrize(
    ("printed", "wrong"),
    [
        (DEMO.format(apex="1.0005", error="0.0008"), ""),
        (DEMO.format(apex="0.9995", error="0.0008"), ""),
        (
            DEMO.format(apex="1.0205", error="0.0008"),
            "the demo's apex angle is wrong by 0.0205 deg",
        ),
        (
            DEMO.format(apex="0.9795", error="0.0008"),
            "the demo's apex angle is wrong by 0.0205 deg",
        ),
        (DEMO.format(apex="1.0005", error="0.0210"), "the demo's model error is 0.0210 px"),
        ("nothing", "the demo printed no apex angle or no model error:\nnothing"),
    ],
)
def test_the_demo_must_find_the_truth(printed: str, wrong: str, release: Any) -> None:
    assert release.release_checks.error_of_demo(printed) == wrong


def test_checksums_are_for_sha256sum(release: Any, tmp_path: Path) -> None:
    for name in ("b", "a"):
        (tmp_path / name).write_text(name)
    text = release.release_checks.checksums([tmp_path / "b", tmp_path / "a"])
    wanted = [f"{hashlib.sha256(name.encode()).hexdigest()}  {name}" for name in "ab"]
    assert text.splitlines() == wanted


def test_an_interpreter_is_found_by_its_version(release: Any) -> None:
    version = "{}.{}".format(*sys.version_info)
    assert release.find_python(version) is not None or shutil.which(f"python{version}") is None
    assert release.find_python("3.99") is None


def test_a_version_that_is_another_ones_is_not_taken(
    release: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A program called python3.98 that is another version, as a shim may be."""
    shim = tmp_path / "python3.98"
    shim.write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    shim.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    assert release.find_python("3.98") is None


@pytest.mark.skipif(shutil.which("ssh-keygen") is None, reason="needs ssh-keygen")
def test_a_signature_is_verified_and_a_changed_file_is_seen(release: Any, tmp_path: Path) -> None:
    key = tmp_path / "key"
    release.call("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", key)
    sums = tmp_path / "SHA256SUMS"
    sums.write_text("0  a\n")
    release.sign(sums, key, None)
    verify = ["ssh-keygen", "-Y", "verify", "-f", tmp_path / "allowed_signers", "-I", "amiwarp"]
    verify += ["-n", "file", "-s", tmp_path / "SHA256SUMS.sig"]
    assert "Good" in release.call(*verify, given=sums)
    sums.write_text("1  a\n")
    with pytest.raises(release.ReleaseError, match="verify"):
        release.call(*verify, given=sums)
