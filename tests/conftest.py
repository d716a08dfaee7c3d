"""What tests share: where the real data lies, and a limit on threads."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

# The machine is shared: a test that takes every core slows the others down and proves nothing.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_name, "2")


@pytest.fixture(scope="session", autouse=True)
def _annotations_apart(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Servers that tests start keep nothing in the folder of the person who runs the tests."""
    os.environ["STEMMAP_FOLDER"] = str(tmp_path_factory.mktemp("annotations"))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder with real recordings; the test is skipped where it is absent."""
    root = Path(__file__).resolve().parents[1]
    folder = Path(os.environ.get("STEMMAP_DATA", root / ".." / "shared" / "data")).resolve()
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}; set STEMMAP_DATA")
    return folder
