"""What a release consists of agrees: version, changelog, citation and conda recipe with the package's own settings."""

import re
import tomllib
from typing import Any

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
