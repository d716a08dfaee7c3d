"""The robots of the tests."""

from pathlib import Path

import pytest

from tests.app.extensions.dds.fast_dds import compiled
from tests.app.robot.conftest import drive
from tests.app.robot.test_live_camera import run

__all__ = ["drive", "fast_dds", "run"]


@pytest.fixture(scope="session")
def fast_dds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The program of `tests.app.extensions.dds.fast_dds.Peer`."""
    return compiled(tmp_path_factory.mktemp("fastdds"))
