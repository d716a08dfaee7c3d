"""What tests share: where the real data lies, a limit on threads, and both cores for the whole suite."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

# A kernel compiles at its first call, and a busy machine is slow; the same examples come each time, so that a
# failure can be repeated and is never somebody else's.
settings.register_profile(
    "stemmap", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("stemmap")

ROOT = Path(__file__).resolve().parents[1]
_WORKERS = 2
_WITH_OTHER_PROCESSES = {"app", "browser"}

# Where Python is told to keep no bytecode beside the sources, it is kept apart: a server and its worker would
# compile all that they import at each start, which is half of what a start costs, and the tests start dozens.
if sys.dont_write_bytecode:
    sys.dont_write_bytecode = False
    sys.pycache_prefix = os.environ["PYTHONPYCACHEPREFIX"] = str(ROOT / ".pytest_cache" / "bytecode")
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# The machine is shared: a test that takes every core slows the others down and proves nothing.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_name, "1")


def pytest_sessionstart(session: pytest.Session) -> None:
    """The whole suite compiles the mapper once, on both cores, before its two processes would do so each."""
    if getattr(session.config.option, "numprocesses", None):
        from app.worker.numba_warmup import compile_ahead

        compile_ahead()


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """The whole suite runs on two cores, a part that somebody names in one process, which starts at once."""
    return _WORKERS if config.args_source is pytest.Config.ArgsSource.TESTPATHS else 0


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What hangs on other processes, sockets and browsers may be tried once more; the summary names it.

    Laws, closed forms and oracles never are: the same input gives them the same answer.
    """
    for item in items:
        if item.path.relative_to(ROOT / "tests").parts[0] in _WITH_OTHER_PROCESSES:
            item.add_marker(pytest.mark.flaky(reruns=1))


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Why the first try failed is told in full: a race that was met once is a race."""
    for report in terminalreporter.stats.get("rerun", []):
        terminalreporter.section(f"first try of {report.nodeid}")
        terminalreporter.write_line(report.longreprtext)


@pytest.fixture(scope="session", autouse=True)
def _annotations_apart(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Servers that tests start keep nothing in the folder of the person who runs the tests."""
    os.environ["STEMMAP_FOLDER"] = str(tmp_path_factory.mktemp("annotations"))


@pytest.fixture(autouse=True)
def _compiling_is_not_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a command says is compared to the letter, whether or not its kernels were compiled before."""

    def unheard(_tell: Callable[[], None]) -> AbstractContextManager[None]:
        return nullcontext()

    # `app.cli.flags` takes it from there each time; workers have their own name for it.
    monkeypatch.setattr("pipeline.jit.on_compiling", unheard)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder with real recordings; the test is skipped where it is absent."""
    folder = Path(os.environ.get("STEMMAP_DATA", ROOT / ".." / "shared" / "data")).resolve()
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}; set STEMMAP_DATA")
    return folder
