"""A finished run in the files of other tools, and back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from app.batch.run_folder import read_run
from app.extensions.formats.tree_manager import write_tree_manager
from pipeline.errors import StemmapError
from tests.app.cli.test_commands import stemmap

RUN = "sim:stand?duration=12"


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short run, mapped."""
    from app.cli import main

    folder = tmp_path_factory.mktemp("run") / "out"
    assert main(["map", RUN, "--out", str(folder)]) == 0
    return folder


@pytest.mark.slow
def test_what_is_exported_maps_to_the_same_trees(mapped, tmp_path, capsys):
    states, back = tmp_path / "states", tmp_path / "back"
    told = stemmap(capsys, "export", mapped, "--out", states)
    assert (told.code, told.err) == (0, "")
    first = read_run(mapped)
    assert told.out == f"{len(first.path.x)} frames with {len(first.trees.number)} trees in {states}\n"
    assert stemmap(capsys, "map", states, "--out", back, "--set", "acquisition.range_max=40").code == 0
    again = read_run(back)
    assert len(first.trees.number) == len(again.trees.number) > 5
    gap = np.linalg.norm(first.trees.position[:, None] - again.trees.position[None], axis=2)
    same = gap.argmin(axis=1)
    assert len(set(same.tolist())) == len(same)
    assert gap.min(axis=1).max() < 0.1
    assert np.median(gap.min(axis=1)) < 0.01
    np.testing.assert_allclose(again.trees.dbh[same], first.trees.dbh, atol=0.002)
    assert np.hypot(again.path.x - first.path.x, again.path.y - first.path.y).max() < 0.05


def test_a_frame_has_what_was_seen_by_then_and_near_it(mapped, tmp_path):
    run = read_run(mapped)
    left_out = write_tree_manager(tmp_path / "states", run.path, run.trees, 4.0)
    near = np.hypot(run.trees.position[:, None, 0] - run.path.x, run.trees.position[:, None, 1] - run.path.y)
    seen = (near <= 4.0) & (run.trees.first_seen_ns[:, None] <= run.path.stamp_ns)
    counts = [
        (tmp_path / "states" / f"TreeManagerState_{k}.csv").read_text().count("\n") - 1
        for k in range(len(run.path.x))
    ]
    assert counts == seen.sum(axis=0).tolist()
    assert left_out == np.count_nonzero(~seen.any(axis=1)) > 0
    assert [file.name for file in tmp_path.iterdir()] == ["states"]


def test_trees_that_are_in_no_frame_are_said(mapped, tmp_path, capsys):
    told = stemmap(capsys, "export", mapped, "--out", tmp_path / "states", "--reach", "4")
    assert told.code == 3
    assert told.err.startswith("left out: ")
    assert "trees farther than 4 m from the path (" in told.err


def test_what_is_there_is_not_overwritten(mapped, tmp_path, capsys):
    (tmp_path / "mine.txt").write_text("mine")
    stemmap(capsys, "export", mapped, "--out", tmp_path).refused(1, "not empty")
    stemmap(capsys, "export", mapped, "--out", tmp_path / "mine.txt").refused(1, "not empty")
    assert [file.name for file in tmp_path.iterdir()] == ["mine.txt"]
    stemmap(capsys, "export", tmp_path, "--out", tmp_path / "new").refused(1, "stemmap map")
    stemmap(capsys, "export", mapped, "--out", tmp_path / "new", "--reach", "0").refused(2, "not a distance")
    stemmap(capsys, "export", mapped, "--out", "/proc/nowhere/new").refused(1, "cannot write")
    stemmap(capsys, "export", mapped, "--to", "tree-manager").refused(2, "--out")
    for name in ("a.gpkg", "a.laz"):
        stemmap(capsys, "export", mapped, "--to", name, "--out", tmp_path / "new").refused(2, "--out is only")


def test_a_write_that_fails_leaves_nothing(mapped, tmp_path, monkeypatch):
    run = read_run(mapped)

    def full(*_: object, **__: object) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(StemmapError, match="No space left"):
        write_tree_manager(tmp_path / "states", run.path, run.trees, 4.0)
    assert list(tmp_path.iterdir()) == []
