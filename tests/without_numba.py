"""Plugin of pytest for NUMBA_DISABLE_JIT=1: kernels are plain functions, which have no cache.

STEMMAP_TEST_LIMIT_S limits the computing time of a test and of its fixtures: the process ends with
`mutation.TIMEOUT`. With STEMMAP_TEST_LINES, the path of a file, such a test is skipped instead, and the file
gets the time of each test that passes and the lines of `mutation.ROOMS` that it executes.
"""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import coverage
import pytest

import pipeline.jit
from tests.mutation import ROOMS, TIMEOUT

for _name in ("_keep_by_all_sources", "_take_no_constants"):
    setattr(pipeline.jit, _name, lambda *_: None)
_LIMIT_S = float(os.environ.get("STEMMAP_TEST_LIMIT_S", "0"))
_FILE = os.environ.get("STEMMAP_TEST_LINES")
_SHARED = "fixtures that several tests share"
_lines = coverage.Coverage(
    data_file=None,
    config_file=False,
    include=[room if room.endswith(".py") else f"{room}/*" for room in ROOMS],
)
_context = _SHARED
_seconds: dict[str, float] = {}
_passed: list[str] = []


def _end(*_: object) -> None:
    if not _FILE:
        os._exit(TIMEOUT)
    pytest.skip(f"computes longer than {_LIMIT_S:g} s without numba")


def pytest_collection_finish() -> None:
    """Begin to record lines: those that run at import are not recorded."""
    if _FILE:
        _lines.start()


@contextmanager
def _recorded_for(context: str) -> Iterator[None]:
    global _context
    before, _context = _context, context
    if _FILE:
        _lines.switch_context(context)
    try:
        yield
    finally:
        _context = before
        if _FILE:
            _lines.switch_context(before)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Record the lines of a test."""
    with _recorded_for(item.nodeid):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(fixturedef: pytest.FixtureDef[object]) -> Iterator[None]:
    """Record the lines of a fixture that several tests share for all of them."""
    with _recorded_for(_context if fixturedef.scope == "function" else _SHARED):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup() -> Iterator[None]:
    """Limit the time of the fixtures of a test."""
    yield from _limited()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Iterator[None]:
    """Limit the time of a test."""
    yield from _limited()


def _limited() -> Iterator[None]:
    signal.signal(signal.SIGVTALRM, _end)
    signal.setitimer(signal.ITIMER_VIRTUAL, _LIMIT_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Note the time of a test, and whether it passed."""
    _seconds[report.nodeid] = _seconds.get(report.nodeid, 0.0) + report.duration
    if report.when == "call" and report.passed:
        _passed.append(report.nodeid)


def pytest_sessionfinish() -> None:
    """Write times and lines."""
    if not _FILE:
        return
    _lines.stop()
    data = _lines.get_data()
    number = {name: k for k, name in enumerate(_passed)}
    lines: dict[str, dict[int, list[int]]] = {}
    for file in data.measured_files():
        lines[Path(file).relative_to(Path.cwd()).as_posix()] = {
            line: sorted(number.values()) if _SHARED in names else [number[n] for n in names if n in number]
            for line, names in data.contexts_by_lineno(file).items()
        }
    content = {"seconds": {name: _seconds[name] for name in _passed}, "lines": lines}
    Path(_FILE).write_text(json.dumps(content), encoding="utf-8")
