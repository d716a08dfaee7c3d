"""Atomic files: a file appears complete or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.errors import StemmapError
from pipeline.io.atomic_files import write_beside


def test_a_file_appears_when_it_is_whole(tmp_path):
    path = tmp_path / "run.csv"
    with write_beside(path) as partial:
        assert partial.parent == tmp_path
        partial.write_text("x\n")
        assert not path.exists()
    assert path.read_text() == "x\n"
    assert [file.name for file in tmp_path.iterdir()] == ["run.csv"]


@pytest.mark.parametrize("failure", [ValueError, KeyboardInterrupt])
def test_a_failure_leaves_what_was_there(tmp_path, failure):
    path = tmp_path / "run.csv"
    path.write_text("old\n")

    def fail() -> None:
        with write_beside(path) as partial:
            partial.write_text("half")
            raise failure

    with pytest.raises(failure):
        fail()
    assert path.read_text() == "old\n"
    assert [file.name for file in tmp_path.iterdir()] == ["run.csv"]


def test_a_missing_folder_and_a_folder_in_place_of_a_file_are_said(tmp_path):
    for path, words in ((tmp_path / "no" / "run.csv", "no such folder"), (tmp_path, "is a folder")):
        with pytest.raises(StemmapError, match=words), write_beside(path):
            pass
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_one_clear_line(tmp_path):
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full on this system")
    path = tmp_path / "run.csv"

    def fill() -> None:
        with write_beside(path), Path("/dev/full").open("w") as file:
            file.write("x" * 100_000)

    with pytest.raises(StemmapError, match=r"cannot write the file.*run\.csv"):
        fill()
    assert list(tmp_path.iterdir()) == []
