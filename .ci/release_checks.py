"""Checks of the files of a release: what the wheel and the source distribution hold, and what the demo printed."""

import hashlib
import re
import tarfile
import zipfile
from collections.abc import Iterable
from pathlib import Path

MOST_MB = {".whl": 4.0, ".gz": 30.0}
"""Sizes above which something was packed that should not have been."""
MOST_APEX_ERROR_DEG = 0.01
MOST_MODEL_ERROR_PX = 0.02


def wheel_version(wheel: Path) -> str:
    """Return the version in a wheel's name."""
    return wheel.name.split("-")[1]


def files_below(source: Path, folder: str) -> set[str]:
    """Return the files below a folder of the sources, with that folder."""
    below = sorted((source / folder).rglob("*"))
    return {path.relative_to(source).as_posix() for path in below if path.is_file()}


def problems_of_wheel(wheel: Path, source: Path) -> list[str]:
    """Return what is wrong with a wheel, a line each: it holds the package's files, nothing else, and the licence."""
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if not name.endswith("/")}
    information = {name for name in names if name.split("/")[0].endswith(".dist-info")}
    package = files_below(source, "amiwarp")
    foreign = sorted(names - information - package)
    problems = [f"{wheel.name}: {name} does not belong there" for name in foreign]
    problems += [f"{wheel.name}: {name} is missing" for name in sorted(package - names)]
    if not any(name.endswith("/licenses/LICENSE") for name in information):
        problems.append(f"{wheel.name}: the licence is missing")
    return problems + problems_of_size(wheel)


def problems_of_archive(archive: Path, source: Path) -> list[str]:
    """Return what is wrong with a source distribution: files of the package or tests that it lacks, and its size."""
    with tarfile.open(archive) as tar:
        names = {name.partition("/")[2] for name in tar.getnames()}
    wanted = files_below(source, "amiwarp") | files_below(source, "tests")
    wanted |= {"pyproject.toml", "README.md", "LICENSE", "CHANGELOG.md"}
    problems = [f"{archive.name}: {name} is missing" for name in sorted(wanted - names)]
    return problems + problems_of_size(archive)


def problems_of_size(path: Path) -> list[str]:
    """Return a line if a file is larger than its kind should be."""
    size = path.stat().st_size / 1e6
    most = MOST_MB[path.suffix]
    return [f"{path.name}: {size:.1f} MB is more than {most:g} MB"] if size > most else []


def first_command(readme: str) -> list[str]:
    """Return the command of amiwarp in the first block of the README, without the folder of its environment."""
    block = re.search(r"```sh\n(.*?)```", readme, re.S)
    found = re.search(r"\.venv/bin/(amiwarp[^\n&]*)$", block[1] if block else "", re.M)
    if found is None:
        raise ValueError("README.md: the first block has no command .venv/bin/amiwarp at its end")
    return found[1].split()


def error_of_demo(printed: str) -> str:
    """Return what is wrong with the results that the demo prints next to the truth; an empty text if nothing is."""
    apex = re.search(r"([\d.]+) deg found, ([\d.]+) deg true", printed)
    model = re.search(r"model error\s+([\d.]+) px", printed)
    if apex is None or model is None:
        return f"the demo printed no apex angle or no model error:\n{printed}"
    apex_error = abs(float(apex[1]) - float(apex[2]))
    if apex_error > MOST_APEX_ERROR_DEG:
        return f"the demo's apex angle is wrong by {apex_error:.4f} deg"
    if float(model[1]) > MOST_MODEL_ERROR_PX:
        return f"the demo's model error is {model[1]} px"
    return ""


def checksums(paths: Iterable[Path]) -> str:
    """Return the text of a file for `sha256sum --check`."""
    lines = [
        f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n" for path in sorted(paths)
    ]
    return "".join(lines)
