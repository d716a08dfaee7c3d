"""The whole command: results are stored, and a run that fails is reported."""

from __future__ import annotations

from pathlib import Path

import pytest

from app.cli import main

RUN = "sim:paper?duration=1"
FILES = ("results.csv", "means.csv", "results.json")


def evaluate(folder: Path, *words: str) -> int:
    """Two sets on a run that there is and one that there is not."""
    runs = [RUN, "none.mcap"]
    return main(["evaluate", *runs, "--param-grid", "slam.particles=5..7/3", "--out", str(folder), *words])


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a process of this machine found; what it keeps lies beside."""
    folder = tmp_path_factory.mktemp("here")
    assert evaluate(folder / "out", "--jobs", "1", "--keep", str(folder / "keep")) == 3
    return folder


@pytest.mark.slow
def test_what_is_known_is_not_computed_again_and_a_run_that_fails_is_said(
    here, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr("app.extensions.search.jobs.COMMAND", ("false",))  # a worker that ends at once
    assert evaluate(tmp_path, "--jobs", "1", "--keep", str(here / "keep")) == 3
    told = capsys.readouterr()
    assert "3 stored results used" in told.err
    assert told.err.count("left out: ") == 1
    assert "none.mcap" in told.err
    assert told.out.count("slam.particles=7") >= 1
    for name in FILES:
        assert (here / "out" / name).read_bytes() == (tmp_path / name).read_bytes()
