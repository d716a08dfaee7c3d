"""`stemmap map --continue`: in two parts as at once, in the saved map again, and never by chance."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from app.cli import main

PLAIN = "sim:paper?duration=4"
STAND = "sim:stand?duration=15&seed=4"
FILES = ("trees.csv", "path.csv", "trees.geojson", "detections.csv", "run.json", "state.zip")


def rows(folder, name="trees.csv"):
    """A table of a run."""
    with (folder / name).open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def stand(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The beginning of a stand, mapped once."""
    folder = tmp_path_factory.mktemp("stand") / "run"
    assert main(["map", STAND, "--out", str(folder)]) == 0
    return folder


def test_a_run_in_two_parts_gives_the_bytes_of_one(tmp_path):
    once, part, whole = tmp_path / "once", tmp_path / "part", tmp_path / "whole"
    assert main(["map", PLAIN, "--seed", "3", "--out", str(once)]) == 0
    assert main(["map", PLAIN, "--seed", "3", "--out", str(part), "--stop-after", "17"]) == 0
    assert len(rows(part, "path.csv")) == 17
    words = ["map", PLAIN, "--continue", str(part), "--start", "resume", "--out", str(whole)]
    assert main(words) == 0
    for name in FILES:
        assert (whole / name).read_bytes() == (once / name).read_bytes(), name


def test_into_its_own_folder_too(tmp_path):
    assert main(["map", PLAIN, "--out", str(tmp_path), "--stop-after", "5"]) == 0
    words = ["map", PLAIN, "--continue", str(tmp_path), "--start", "resume", "--out", str(tmp_path)]
    assert main(words) == 0
    assert len(rows(tmp_path, "path.csv")) == 40


@pytest.mark.slow
def test_a_second_run_finds_its_start_and_keeps_the_numbers(stand, tmp_path, capsys):
    other = "sim:stand?duration=15&seed=4&sigma=0.03&drive=1"  # the same stand seen with another noise
    assert main(["map", other, "--continue", str(stand), "--out", str(tmp_path)]) == 0
    assert "stems agree" in capsys.readouterr().out
    record = json.loads((tmp_path / "run.json").read_text())
    (second,) = record["continued"]
    assert second["start"] == "constellation"
    assert abs(second["pose"][0]) < 0.15
    assert abs(second["pose"][1]) < 0.15
    assert abs(second["pose"][2]) < 0.02
    before = {row["tree"]: row for row in rows(stand)}
    after = {row["tree"]: row for row in rows(tmp_path)}
    kept = set(before) & set(after)
    assert len(kept) >= 0.95 * len(before)  # what the second drive adds may turn a verdict
    for number in kept:
        assert abs(float(before[number]["x_m"]) - float(after[number]["x_m"])) < 0.3, number
    places = np.array([[float(row["x_m"]), float(row["y_m"])] for row in before.values()])
    for number in set(after) - set(before):  # what the first run missed may be found, but nothing twice
        x, y = float(after[number]["x_m"]), float(after[number]["y_m"])
        assert np.hypot(*(places - (x, y)).T).min() > 0.5, number
    assert len(after) <= 1.1 * len(before)
    assert record["evaluation"]["spurious"] <= 1
    assert len(rows(tmp_path, "path.csv")) == 2 * len(rows(stand, "path.csv"))
    once = json.loads((stand / "run.json").read_text())
    assert record["duration_s"] == pytest.approx(2 * once["duration_s"], abs=0.01)  # the pause is none
    assert record["distance_m"] == pytest.approx(2 * once["distance_m"], rel=0.05)  # nor is the jump a drive


@pytest.mark.slow
def test_the_same_recording_twice_is_warned_of(stand, tmp_path, capsys):
    words = ["map", PLAIN, "--out", str(tmp_path / "a"), "--stop-after", "5"]
    assert main(words) == 0
    words = [
        "map",
        PLAIN,
        "--continue",
        str(tmp_path / "a"),
        "--out",
        str(tmp_path / "b"),
        "--stop-after",
        "5",
    ]
    assert main([*words, "--start", "0,0,0"]) == 0
    assert "already part of the map" in capsys.readouterr().err
    assert main([*words, "--start", "resume"]) == 0
    assert "already part of the map" not in capsys.readouterr().err


@pytest.mark.slow
def test_another_stand_is_not_found_in_the_map(stand, tmp_path, capsys):
    words = ["map", "sim:stand?duration=15&seed=9", "--continue", str(stand), "--out", str(tmp_path / "out")]
    assert main(words) == 1
    told = capsys.readouterr().err
    assert "not found in the saved map" in told
    assert "Continue a map of the same stand, or give the start with --start" in told
    assert not (tmp_path / "out").exists()


def test_live_robots_need_a_given_start_and_others_scans(tmp_path, capsys, monkeypatch):
    run, out = str(tmp_path / "run"), tmp_path / "out"
    assert main(["map", PLAIN, "--out", run, "--stop-after", "3"]) == 0
    assert main(["map", "zenoh:tcp/127.0.0.1:9?robot=r", "--continue", run, "--out", str(out)]) == 1
    assert "--start X,Y,YAW" in capsys.readouterr().err
    monkeypatch.setattr("app.sources.one_step.is_one_step", lambda _uri, _options: True)
    assert main(["map", PLAIN, "--continue", run, "--out", str(out)]) == 2
    assert "no scans" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.slow
def test_a_start_that_is_given_is_taken(stand, tmp_path):
    words = ["map", "sim:stand?duration=3&seed=4", "--continue", str(stand), "--out", str(tmp_path)]
    assert main([*words, "--start", "0,0,0"]) == 0
    (second,) = json.loads((tmp_path / "run.json").read_text())["continued"]
    assert second["start"] == "given"
    numbers = {row["tree"] for row in rows(stand)}
    kept = numbers & {row["tree"] for row in rows(tmp_path)}
    assert len(kept) >= 0.95 * len(numbers)  # more views may turn a verdict


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        (["--start", "last"], 2, "--continue"),
        (["--continue", "none"], 1, "no saved state"),
        (["--continue", "none", "--start", "here"], 2, "--start"),
        (["--stop-after", "0"], 2, "--stop-after"),
    ],
)
def test_what_cannot_be_continued_is_said(words, code, told, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["map", PLAIN, "--out", "out", *words]) == code
    assert told in capsys.readouterr().err
    assert not Path("out").exists()


@pytest.mark.slow
def test_a_whole_run_has_nothing_to_resume(tmp_path, capsys):
    assert main(["map", PLAIN, "--out", str(tmp_path / "a"), "--stop-after", "40"]) == 0
    words = [
        "map",
        PLAIN,
        "--continue",
        str(tmp_path / "a"),
        "--start",
        "resume",
        "--out",
        str(tmp_path / "b"),
    ]
    assert main(words) == 1
    assert "not mapped yet" in capsys.readouterr().err


def test_a_damaged_state_is_refused(tmp_path, capsys):
    assert main(["map", PLAIN, "--out", str(tmp_path), "--stop-after", "3"]) == 0
    data = (tmp_path / "state.zip").read_bytes()
    for broken in (data[:100], b"", data[: len(data) // 2]):
        (tmp_path / "state.zip").write_bytes(broken)
        assert main(["map", PLAIN, "--continue", str(tmp_path), "--out", str(tmp_path / "b")]) == 1
        assert "damaged" in capsys.readouterr().err


def test_a_map_without_a_drive_cannot_be_continued_or_merged(tmp_path, capsys):
    source = {"uri": "plot.laz", "offset_m": [0.0, 0.0, 0.0]}
    (tmp_path / "run.json").write_text(json.dumps({"source": source, "parameters": {}}))
    folder, out = str(tmp_path), str(tmp_path / "out")
    for words in (["map", PLAIN, "--continue", folder], ["merge", folder, folder]):
        assert main([*words, "--out", out]) == 1
        assert "no map of a drive and cannot be continued" in capsys.readouterr().err
