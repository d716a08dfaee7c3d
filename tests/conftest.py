"""Settings and fixtures of all tests: hypothesis profiles, threads, worker processes and real recordings."""

from __future__ import annotations

import gc
import os
import sys
from collections import Counter
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from xdist.scheduler import LoadFileScheduling

ROOT = Path(__file__).resolve().parents[1]
_WORKERS = 2
# Folder and files that take longest, in this order (uv run pytest --durations=0 lists the times).
_LONGEST = (
    "browser",
    "app/extensions/maps/localisation/test_localiser.py",
    "app/extensions/clouds/test_cloud_run.py",
    "app/extensions/clouds/test_cloud_frame.py",
    "app/extensions/stand/test_georeference_routes.py",
    "app/extensions/clouds/test_map_plot.py",
    "app/worker/test_remap.py",
    "app/extensions/maps/test_localise.py",
    "app/worker/test_supervisor.py",
)

# No deadline, because a kernel compiles at its first call. The default profile draws the same few examples at
# each run; `deep` draws many, and others at each run (--hypothesis-profile=deep).
_CHECKS = [HealthCheck.too_slow]
settings.register_profile(
    "default", deadline=None, suppress_health_check=_CHECKS, derandomize=True, max_examples=25
)
settings.register_profile(
    "deep",
    deadline=None,
    suppress_health_check=_CHECKS,
    derandomize=False,
    max_examples=1000,
    print_blob=True,
)
settings.load_profile("default")

# Without bytecode beside the sources, each server and worker process of a test would compile its imports.
if sys.dont_write_bytecode:
    sys.dont_write_bytecode = False
    sys.pycache_prefix = os.environ["PYTHONPYCACHEPREFIX"] = str(ROOT / ".pytest_cache" / "bytecode")
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

gc.disable()  # until all is imported and collected, see below

# Two test processes share the cores, so each library computes in one thread.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_name, "1")


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile the kernels of the mapper once, on both cores, before the test processes need them."""
    if getattr(session.config.option, "numprocesses", None):
        from app.worker.numba_warmup import compile_ahead

        compile_ahead()


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Return 2 processes for the whole suite and none for named paths, which then start at once."""
    return _WORKERS if config.args_source is pytest.Config.ArgsSource.TESTPATHS else 0


class _Scheduler(LoadFileScheduling):  # type: ignore[misc]
    """Gives a process the tests of one file, or all of the browser, which share a server and a browser."""

    def _split_scope(self, nodeid: str) -> str:
        file = nodeid.split("::", 1)[0]
        return "tests/browser" if file.startswith("tests/browser/") else file


def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> _Scheduler:
    """Return the scheduler of the test processes."""
    return _Scheduler(config, log)


@pytest.hookimpl(tryfirst=True)  # before pytest selects by marks
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the further variants of `slow_after` as slow, and put what takes longest first, so that the test
    processes end together."""
    variants: Counter[str] = Counter()
    for item in items:
        if marker := item.get_closest_marker("slow_after"):
            variants[item.nodeid.split("[")[0]] += 1
            if variants[item.nodeid.split("[")[0]] > marker.args[0]:
                item.add_marker(pytest.mark.slow)
    order = {name: k for k, name in enumerate(_LONGEST)}

    def rank(item: pytest.Item) -> int:
        name = item.path.relative_to(ROOT / "tests").as_posix()
        return order.get("browser" if name.startswith("browser/") else name, len(order))

    items.sort(key=rank)


def pytest_collection_finish() -> None:
    """Leave what is imported and collected out of the searches for garbage, an eighth of the time."""
    gc.collect()
    gc.freeze()
    gc.enable()


def pytest_sessionfinish() -> None:
    """Let libraries free at the end what they have."""
    gc.unfreeze()


@pytest.fixture(scope="session", autouse=True)
def _annotations_apart(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Keep the database of the servers that tests start out of the user's folder."""
    os.environ["STEMMAP_FOLDER"] = str(tmp_path_factory.mktemp("annotations"))


@pytest.fixture(autouse=True)
def _compiling_is_not_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """Suppress the notice that kernels compile, because tests compare a command's whole output."""

    def unheard(_tell: Callable[[], None]) -> AbstractContextManager[None]:
        return nullcontext()

    # `app.cli.flags` reads the attribute at each call; worker processes use their own name for it.
    monkeypatch.setattr("pipeline.jit.on_compiling", unheard)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder with real recordings; the test is skipped where it is absent."""
    folder = Path(os.environ.get("STEMMAP_DATA", ROOT / ".." / "shared" / "data")).resolve()
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}; set STEMMAP_DATA")
    return folder
