"""The command `stemmap simulate` with its flags."""

from __future__ import annotations

import argparse
import csv

import pytest

from app.cli import simulate
from pipeline.errors import StemmapError
from pipeline.io.readers.simulated import open_simulated


def command(*words: object) -> int:
    parser = argparse.ArgumentParser()
    simulate.configure(parser)
    return simulate.run(parser.parse_args([str(word) for word in words]))


def test_it_writes_the_recording_and_the_table_of_trees(tmp_path, capsys):
    out = tmp_path / "run.mcap"
    assert command("paper", "--out", out, "--duration", "0.5e1", "--seed", "3") == 0
    assert "50 scans" in capsys.readouterr().out
    assert sorted(file.name for file in tmp_path.iterdir()) == ["run.mcap", "run.trees.csv"]
    with (tmp_path / "run.trees.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    truth = open_simulated("sim:paper?seed=3").run.scene.truth
    assert [row["class"] for row in rows] == list(truth.kind)
    for row, x, dbh in zip(rows, truth.x, truth.dbh, strict=True):
        assert float(row["x_m"]) == pytest.approx(x, abs=1e-4)
        assert (row["dbh_cm"] == "") == (dbh != dbh)
    assert float(rows[0]["dbh_cm"]) == pytest.approx(30.0)


def test_the_flags_are_options_of_the_scenario(tmp_path):
    one, other = tmp_path / "one.mcap", tmp_path / "other.mcap"
    command("paper", "--out", one, "--duration", "1", "--seed", "3")
    command("sim:paper?seed=3&duration=1", "--out", other)
    assert one.read_bytes() == other.read_bytes()
    with pytest.raises(StemmapError, match="given twice"):
        command("paper?seed=3", "--out", tmp_path / "third.mcap", "--seed", "4")


def test_it_overwrites_only_when_told_to(tmp_path):
    for name in ("run.mcap", "run.trees.csv"):
        there = tmp_path / name
        there.write_text("mine")
        with pytest.raises(StemmapError, match="--force"):
            command("paper", "--out", tmp_path / "run.mcap", "--duration", "1")
        assert there.read_text() == "mine"
        there.unlink()
    command("paper", "--out", tmp_path / "run.mcap", "--duration", "1")
    command("paper", "--out", tmp_path / "run.mcap", "--duration", "1", "--force")


def test_wrong_words_leave_nothing(tmp_path, capsys):
    with pytest.raises(SystemExit):
        command("paper", "--out", tmp_path / "run.bag")
    assert "must end in .mcap" in capsys.readouterr().err
    with pytest.raises(StemmapError, match="no scenario"):
        command("jungle", "--out", tmp_path / "run.mcap")
    with pytest.raises(StemmapError, match="no such folder"):
        command("paper", "--out", tmp_path / "no" / "run.mcap", "--duration", "1")
    assert list(tmp_path.iterdir()) == []
