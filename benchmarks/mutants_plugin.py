"""Pytest plugin of ``benchmarks.mutants``: it records which test runs which line, and runs tests on changed functions.

A test process collects the tests once. For each mutant it forks; the child replaces the code of the changed function
and runs the tests of this mutant until one fails. Functions of Python that are not part of a kernel can be replaced.
"""

from __future__ import annotations

import gc
import json
import os
import select
import signal
import sys
import time
from collections.abc import Generator
from pathlib import Path
from types import CodeType, FunctionType

import pytest

PIPES = os.environ.pop("MUTANTS_PIPES", "")
"""Numbers of the pipes for requests and replies, or nothing to run the tests as usual."""

DURATIONS = os.environ.pop("MUTANTS_DURATIONS", "")
"""File for the durations of the tests, and for the modules that each calls in the reading process."""

_seconds: dict[str, float] = {}
_called: dict[str, list[str]] = {}
_modules: set[str] = set()
_failures: list[str] = []


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Measure the duration of a test with its fixtures [s]. Coverage, if it runs, gets the test's name."""
    coverage = sys.modules.get("coverage")
    recording = coverage and coverage.Coverage.current()
    if recording is not None:
        recording.switch_context(item.nodeid)
    began = time.perf_counter()
    _modules.clear()
    try:
        return (yield)
    finally:
        _seconds[item.nodeid], _called[item.nodeid] = time.perf_counter() - began, sorted(_modules)
        if recording is not None:
            recording.switch_context("")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Run tests in the order of the command line, not in that of ``conftest.py``."""
    rank = {name: k for k, name in enumerate(config.args)}
    items.sort(key=lambda item: rank.get(item.nodeid, 0))


def pytest_sessionstart() -> None:
    """Note calls to the reading process, in which coverage does not run."""
    if DURATIONS:
        from amiwarp.io.reading_process import Function, ReadingProcess, name_of

        send = ReadingProcess.send

        def noted(
            process: ReadingProcess, function: Function, *arguments: object, **options: object
        ) -> None:
            named = [name_of(function), *(text for text in arguments if isinstance(text, str))]
            _modules.update(text.partition(":")[0] for text in named if text.startswith("amiwarp."))
            send(process, function, *arguments, **options)  # type: ignore[arg-type]

        ReadingProcess.send = noted  # type: ignore[method-assign]


def pytest_sessionfinish() -> None:
    """Write the durations and the calls."""
    if DURATIONS:
        Path(DURATIONS).write_text(json.dumps({"seconds": _seconds, "called": _called}))


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Note the last line of the error of a failed test."""
    if report.failed:
        errors = [line for line in report.longreprtext.splitlines() if line.startswith("E ")]
        _failures.append(f"{report.nodeid}: {errors[0][2:].strip() if errors else ''}")


def pytest_runtestloop(session: pytest.Session) -> bool | None:
    """Serve requests: each is a changed function and the names of tests. Reply what fails, or an empty text."""
    if not PIPES:
        return None
    requests, replies = map(int, PIPES.split())
    items = {item.nodeid: item for item in session.items}
    with os.fdopen(requests) as lines, os.fdopen(replies, "w") as answers:
        answers.write("ready\n")
        answers.flush()
        for line in lines:
            request = json.loads(line)
            tests = [items[name] for name in request["tests"] if name in items]
            answers.write(json.dumps(_in_child(session, request, tests)) + "\n")
            answers.flush()
    return True


def _in_child(
    session: pytest.Session, request: dict[str, str], tests: list[pytest.Item]
) -> str | None:
    """Fork, change the function in the child and run the tests there. Return None if the function cannot be changed."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.setsid()
        answer = None
        if _replace(request["path"], request["function"], request["code"]):
            for test, following in zip(tests, [*tests[1:], None], strict=True):
                session.config.hook.pytest_runtest_protocol(item=test, nextitem=following)
                if _failures:
                    break
            answer = (_failures or [""])[0]
        os.write(writing, json.dumps(answer).encode())
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as reply:
        if not select.select([reply], [], [], float(request["limit_s"]))[0]:
            os.killpg(child, signal.SIGKILL)
        found = reply.read()
    _, status = os.waitpid(child, 0)
    return json.loads(found) if found else f"hangs or ends the process with status {status}"


def _replace(path: str, name: str, source: str) -> bool:
    """Replace the code of the functions with this qualified name in a file. Return whether that was possible."""

    def codes(code: CodeType) -> Generator[CodeType]:
        for constant in code.co_consts:
            if isinstance(constant, CodeType):
                yield constant
                yield from codes(constant)

    new = {
        code.co_firstlineno: code
        for code in codes(compile(source, path, "exec"))
        if code.co_qualname == name
    }
    gc.unfreeze()  # conftest.py hides all that exists from the collector, and so from the next line
    functions = [
        one
        for one in gc.get_objects()
        if type(one) is FunctionType and one.__code__.co_filename == path
    ]
    changed = [function for function in functions if function.__code__.co_qualname == name]
    for function in changed:
        function.__code__ = new[function.__code__.co_firstlineno]
    loaded = any(getattr(module, "__file__", None) == path for module in list(sys.modules.values()))
    # A module that is not loaded yet will be imported with the change
    return bool(changed) or not loaded
