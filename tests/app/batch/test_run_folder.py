"""Partial outputs that killed runs left."""

from __future__ import annotations

from pathlib import Path

import pytest

from app.cli import main


def test_a_map_says_at_its_start_what_lies_in_its_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / ".unfinished-abc").mkdir()
    (tmp_path / ".unfinished-file").write_text("no folder")
    assert main(["map", "/nowhere.mcap", "--out", str(tmp_path)]) == 1
    first, second, *_ = capsys.readouterr().err.splitlines()
    assert ".unfinished-abc is the partial output of a run that was killed" in first
    assert "unfinished" not in second
