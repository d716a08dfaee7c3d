"""Plugin of pytest for NUMBA_DISABLE_JIT=1: kernels are plain functions, which have no cache.

With STEMMAP_QUICK_TESTS, the path of a file, tests that compute longer than LIMIT_S are skipped, and the
names of those that pass are written to the file.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

import pipeline.jit

setattr(pipeline.jit, "_keep_by_all_sources", lambda _kernel, _module: None)  # noqa: B010 - private
LIMIT_S = 2.0  # CPU time of a test or of its fixtures
_FILE = os.environ.get("STEMMAP_QUICK_TESTS")
_passed: list[str] = []


def _skip(*_: object) -> None:
    pytest.skip(f"computes longer than {LIMIT_S:g} s without numba")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup() -> Iterator[None]:
    """Limit the time of the fixtures of a test."""
    yield from _limited()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Iterator[None]:
    """Limit the time of a test."""
    yield from _limited()


def _limited() -> Iterator[None]:
    if _FILE:
        signal.signal(signal.SIGVTALRM, _skip)
        signal.setitimer(signal.ITIMER_VIRTUAL, LIMIT_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Note a test that passed."""
    if report.when == "call" and report.passed:
        _passed.append(report.nodeid)


def pytest_sessionfinish() -> None:
    """Write the names of the tests that passed."""
    if _FILE:
        Path(_FILE).write_text("\n".join(_passed) + "\n", encoding="utf-8")
