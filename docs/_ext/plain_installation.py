"""Hide from programs what a plain ``pip install .`` does not install, so that pages are run as most readers run them.

:func:`prepare` fills a folder with programs for PATH: ``amiwarp``, ``python`` and the programs of other packages. Each
first runs with ``plain_site/sitecustomize.py``, which hides every package that only an extra, or a tool of this
environment, has brought. If it ends because one is missing, it notes what it needs and runs again with all packages,
so that later commands of the page find its files. The page must name the extra (:func:`named`).
"""

from __future__ import annotations

import importlib.metadata
import inspect
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
SITE = Path(__file__).parent / "plain_site"
FOLDER, NEEDS = "AMIWARP_PLAIN_FOLDER", "AMIWARP_PLAIN_NEEDS"
"""Environment variables: the folder that :func:`prepare` has filled, and the file that gets what programs need."""
INSTALLERS = {"pip", "setuptools", "wheel"}
REMEDY = re.compile(r"pip install 'amiwarp\[([a-z]+)\]'")
MISSING = re.compile(r"ModuleNotFoundError: No module named '([^'.]+)")


@cache
def extras() -> dict[str, list[str]]:
    """Return the requirements of each extra in pyproject.toml; the plain installation's are at the key ''."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return {"": project["dependencies"], **project["optional-dependencies"]}


def canonical(name: str) -> str:
    """Return the name of a distribution in the form that can be compared."""
    return re.sub(r"[-_.]+", "-", name).lower()


@cache
def installed_by(extra: str = "") -> frozenset[str]:
    """Return the distributions that amiwarp with an extra installs, and what these require in turn."""
    from packaging.requirements import Requirement

    todo = [Requirement(f"amiwarp[{extra}]" if extra else "amiwarp")]
    seen: set[tuple[str, frozenset[str]]] = set()
    while todo:
        requirement = todo.pop()
        name, wanted = canonical(requirement.name), frozenset(requirement.extras)
        if (name, wanted) in seen:
            continue
        seen.add((name, wanted))
        for text in _requirements(name, wanted):
            one = Requirement(text)
            if one.marker is None or any(
                one.marker.evaluate({"extra": key}) for key in ("", *wanted)
            ):
                todo.append(one)
    return frozenset(name for name, _ in seen)


def _requirements(name: str, wanted: Iterable[str]) -> list[str]:
    if name == "amiwarp":  # pyproject.toml may be newer than what is installed
        return [text for key in ("", *wanted) for text in extras()[key]]
    try:
        return importlib.metadata.requires(name) or []
    except importlib.metadata.PackageNotFoundError:  # an extra that is not installed here
        return []


def hidden_names() -> dict[str, Any]:
    """Return what a plain installation lacks of this environment.

    The keys are ``distributions``, ``modules`` and ``programs`` with the distribution of each, and ``extras`` with the
    distributions that each installs.
    """
    plain = installed_by() | INSTALLERS
    modules: dict[str, str] = {}
    programs: dict[str, str] = {}
    distributions, kept = (
        set(),
        {entry.name for entry in ROOT.iterdir()},
    )  # folders that programs of the pages import
    for one in importlib.metadata.distributions():
        name = canonical(one.name)
        if name in plain:
            kept |= modules_of(one)
            continue
        distributions.add(name)
        modules.update(dict.fromkeys(modules_of(one), name))
        programs.update(
            {entry.name: name for entry in one.entry_points.select(group="console_scripts")}
        )
    modules = {module: name for module, name in modules.items() if module not in kept}
    return {
        "distributions": sorted(distributions),
        "modules": modules,
        "programs": programs,
        "extras": {extra: sorted(installed_by(extra)) for extra in extras() if extra},
    }


def modules_of(distribution: importlib.metadata.Distribution) -> set[str]:
    """Return the top-level modules and packages that a distribution has installed."""
    firsts = {file.parts[0] for file in distribution.files or []}
    found = {inspect.getmodulename(first) or first for first in firsts}
    return {name for name in found if name.isidentifier()} - {"__pycache__"}


def prepare(folder: Path) -> None:
    """Fill a folder with the programs for PATH and the list of hidden names."""
    names = hidden_names()
    (folder / "bin").mkdir(parents=True)
    (folder / "names.json").write_text(json.dumps(names))
    real = Path(sys.executable).parent
    for name in ("amiwarp", "python", *names["programs"]):
        if (real / name).exists():
            program = folder / "bin" / name
            command = shlex.join([sys.executable, __file__, str(real / name)])
            program.write_text(f'#!/bin/sh\nexec {command} "$@"\n')
            program.chmod(0o755)


def environment(variables: dict[str, str], folder: Path, needs: Path) -> dict[str, str]:
    """Return environment variables with which programs hide packages, and note in the file ``needs`` what they need."""
    path = os.pathsep.join([str(folder / "bin"), variables["PATH"]])
    return {
        **variables,
        FOLDER: str(folder),
        NEEDS: str(needs),
        "PATH": path,
        "PYTHONPATH": _plain_path(True),
    }


def _plain_path(plain: bool) -> str:
    """Return the value of PYTHONPATH with which packages are hidden, or shown."""
    others = [
        path
        for path in os.environ.get("PYTHONPATH", "").split(os.pathsep)
        if path not in ("", str(SITE))
    ]
    return os.pathsep.join([str(SITE), *others] if plain else others)


def names() -> dict[str, Any]:
    """Return what is hidden from the programs of this process's folder."""
    return json.loads((Path(os.environ[FOLDER]) / "names.json").read_text())


def need_of(error: str, *, command: bool) -> str | None:
    """Return what a program lacks by the end of what it has printed: ``[EXTRA]``, a distribution, or None.

    amiwarp says in one line which extra is missing; ``command`` is whether the program is its command, which must not
    show a traceback. Code that imports another package itself needs that package.
    """
    lines = error.strip().splitlines() or [""]
    extra, module = REMEDY.search(lines[-1]), MISSING.match(lines[-1])
    if command:
        return f"[{extra[1]}]" if extra and "Traceback" not in error else None
    if extra:
        return f"[{extra[1]}]"
    files = re.findall(r'^ *File "([^"]+)"', error, re.M)
    return (
        names()["modules"].get(module[1])
        if module and not (files and of_amiwarp(files[-1]))
        else None
    )


def of_amiwarp(file: str) -> bool:
    """Return whether a file of Python code belongs to amiwarp."""
    return Path(file).is_relative_to(ROOT / "amiwarp") or "/site-packages/amiwarp/" in file


def named(page: str, need: str) -> bool:
    """Return whether a page's text names the extra or the distribution that a command needs."""
    found = {
        extra
        for group in re.findall(r"(?:amiwarp|\.)\[([a-z,]+)\]", page)
        for extra in group.split(",")
    }
    if need.startswith("["):
        return need[1:-1] in found
    words = {
        canonical(word)
        for line in re.findall(r"pip install ([^`\n]+)", page)
        for word in re.findall(r"[\w-]+", line)
    }
    return need in words or any(need in names()["extras"].get(extra, []) for extra in found)


def note(need: str) -> None:
    """Note what a page must name."""
    with open(os.environ[NEEDS], "a") as file:
        file.write(need + "\n")


def noted() -> list[str]:
    """Return what has been noted since the last call."""
    file = Path(os.environ[NEEDS])
    found = dict.fromkeys(file.read_text().split())
    file.write_text("")
    return list(found)


_set_aside: dict[str, Any] = {}
"""Hidden modules that this process has imported while they were shown."""


@contextmanager
def everything_shown() -> Iterator[None]:
    """Show the hidden packages to this process, whose ``sitecustomize`` hides them, and to programs that it starts."""
    from sitecustomize import PlainFinder

    hidden, path = PlainFinder.modules, os.environ["PATH"]
    sys.modules.update(_set_aside)
    PlainFinder.modules = frozenset()
    os.environ.update(PATH=path.partition(os.pathsep)[2], PYTHONPATH=_plain_path(False))
    try:
        yield
    finally:
        PlainFinder.modules = hidden
        os.environ.update(PATH=path, PYTHONPATH=_plain_path(True))
        found = [name for name in sys.modules if name.partition(".")[0] in hidden]
        _set_aside.update({name: sys.modules.pop(name) for name in found})


def run(
    command: list[str], variables: dict[str, str], **streams: Any
) -> subprocess.CompletedProcess[str]:
    """Run a program, and pass the first signal that is to end this one on to it, in a group of its own."""
    pending: list[int] = []

    def send(number: int, _: Any) -> None:
        if not pending:
            child.send_signal(number)
        pending.append(number)

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(
            number, lambda *_: None
        )  # caught, so that the program does not inherit an ignored signal
    child = subprocess.Popen(command, env=variables, text=True, start_new_session=True, **streams)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, send)
    _, error = child.communicate()
    return subprocess.CompletedProcess(command, child.returncode, None, error)


def main(command: list[str]) -> int:
    """Run a program as in a plain installation, and again with all packages if it says that it needs one."""
    program = Path(command[0]).name
    shown = {
        **os.environ,
        "PATH": os.environ["PATH"].partition(os.pathsep)[2],
        "PYTHONPATH": _plain_path(False),
    }
    plain = {**os.environ, "PYTHONPATH": _plain_path(True)}
    if program in names()["programs"]:
        note(names()["programs"][program])
        return run(command, shown).returncode
    known, job = Path(os.environ[NEEDS] + ".known"), " ".join([program, *command[1:2]])
    if program == "amiwarp" and known.exists() and job in known.read_text().splitlines():
        return run(
            command, shown
        ).returncode  # a command that has named its extra on this page saves the time
    code = run(command, plain).returncode
    if code == 1:
        again = run(command, plain, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        need = need_of(again.stderr, command=program == "amiwarp")
        code = again.returncode
        if need:
            note(need)
            with open(known, "a") as file:
                file.write(job + "\n")
            code = run(command, shown).returncode
    return code if code >= 0 else 128 - code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
