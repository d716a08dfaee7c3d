"""Settings of the environment, and the words for what cannot be used."""

from __future__ import annotations

from pathlib import Path

import pytest

from app.common.settings import VARIABLES, RunBudget, Settings, from_environment, is_loopback
from pipeline.errors import StemmapError


def test_nothing_given_is_this_machine_only() -> None:
    assert from_environment({}) == Settings()
    assert Settings().loopback


def test_all_that_can_be_given(tmp_path: Path) -> None:
    given = {
        "STEMMAP_HOST": "localhost",
        "STEMMAP_PORT": "9000",
        "STEMMAP_TOKEN": "0123456789abcdef",
        "STEMMAP_HOSTS": "Robot.local, tunnel ,",
        "STEMMAP_RECORDINGS": str(tmp_path),
        "STEMMAP_FOLDER": str(tmp_path / "kept"),
        "STEMMAP_FILES": "folders",
        "STEMMAP_UPLOAD_GB": "2.5",
        "STEMMAP_RUN_GB": "0.5",
        "STEMMAP_RUN_MEMORY_MB": "30",
    }
    of_extensions = {"STEMMAP_EXTENSIONS"}  # read by app.extension
    assert set(given) | of_extensions == set(VARIABLES)
    assert from_environment(given) == Settings(
        "localhost",
        9000,
        "0123456789abcdef",
        ("robot.local", "tunnel"),
        tmp_path,
        folder=tmp_path / "kept",
        upload_limit=2_500_000_000,
        files="folders",
        run_budget=RunBudget(500_000_000, 30_000_000),
    )


@pytest.mark.parametrize(
    ("given", "folder"),
    [
        ({"HOME": "/people/ann"}, "/people/ann/.local/share/stemmap"),
        ({"HOME": "/people/ann", "XDG_DATA_HOME": "/data"}, "/data/stemmap"),
        ({"HOME": "/people/ann", "STEMMAP_FOLDER": "/kept"}, "/kept"),
    ],
)
def test_annotations_are_kept_where_the_system_keeps_data(given: dict[str, str], folder: str) -> None:
    assert from_environment(given).folder == Path(folder)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("STEMMAP_HOST", "0.0.0.0"),  # noqa: S104
        ("STEMMAP_HOST", "example.org"),
        ("STEMMAP_PORT", "80000"),
        ("STEMMAP_PORT", "http"),
        ("STEMMAP_UPLOAD_GB", "nan"),
        ("STEMMAP_RUN_GB", "0"),
        ("STEMMAP_RUN_MEMORY_MB", "much"),
        ("STEMMAP_TOKEN", "short"),
        ("STEMMAP_TOKEN", "with a\nline break in it"),
        ("STEMMAP_TOKEN", "öööööööööööööööööö"),
        ("STEMMAP_RECORDINGS", "/no/such/folder"),
        ("STEMMAP_FILES", "all"),
    ],
)
def test_what_cannot_be_used_names_the_variable(name: str, value: str) -> None:
    with pytest.raises(StemmapError, match=name):
        from_environment({name: value})


@pytest.mark.parametrize(
    ("host", "loopback"),
    [
        ("127.0.0.1", True),
        ("127.5.5.5", True),
        ("::1", True),
        ("localhost", True),
        ("::", False),
        ("host", False),
    ],
)
def test_loopback(host: str, loopback: bool) -> None:
    assert is_loopback(host) is loopback
