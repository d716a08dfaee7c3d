"""`stemmap merge`: two runs of one stand become one map, two stands do not."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from app.cli import main

FILES = {
    "trees.csv", "path.csv", "trees.geojson", "detections.csv", "run.json", "state.zip", "correspondence.csv",
    "seen.csv", "terrain.csv"
}  # fmt: skip


def rows(folder, name="trees.csv"):
    """A table of a run."""
    with (folder / name).open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A stand mapped to 12 s, and from 5 s to 17 s as a run of its own that begins elsewhere."""
    folder = tmp_path_factory.mktemp("runs")
    stand = "sim:stand?seed=4&duration=17"
    assert main(["map", stand, "--out", str(folder / "a"), "--stop-after", "120"]) == 0
    assert main(["simulate", "stand?seed=4&duration=17", "--out", str(folder / "whole.mcap")]) == 0
    _cut(folder / "whole.mcap", folder / "late.mcap", skip_s=5.0)
    assert main(["map", str(folder / "late.mcap"), "--out", str(folder / "b")]) in (0, 3)
    assert main(["map", "sim:stand?seed=9&duration=6", "--out", str(folder / "other")]) == 0
    assert main(["merge", str(folder / "a"), str(folder / "b"), "--out", str(folder / "both")]) == 0
    return folder


def _cut(whole, late, skip_s):
    from mcap.reader import make_reader
    from mcap.writer import Writer

    with whole.open("rb") as source, late.open("wb") as target:
        writer, ids = Writer(target), {}
        writer.start()
        first = None
        for schema, channel, message in make_reader(source).iter_messages():
            first = message.log_time if first is None else first
            if channel.id not in ids:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, kind, dict(channel.metadata)
                )
            if message.log_time - first < skip_s * 1e9 and not channel.topic.startswith("/tf_static"):
                continue
            writer.add_message(ids[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()


@pytest.mark.slow
def test_the_first_run_keeps_its_numbers_and_places(runs):
    before = {row["tree"]: row for row in rows(runs / "a")}
    after = {row["tree"]: row for row in rows(runs / "both")}
    assert set(before) <= set(after)
    assert {file.name for file in (runs / "both").iterdir()} == FILES
    for number, row in before.items():
        off = np.hypot(
            float(row["x_m"]) - float(after[number]["x_m"]), float(row["y_m"]) - float(after[number]["y_m"])
        )
        assert off < 0.3


def test_the_table_says_which_tree_is_which(runs):
    table = rows(runs / "both", "correspondence.csv")
    both = [row for row in table if row["tree_a"] and row["tree_b"]]
    assert [row["tree"] for row in table] == [row["tree"] for row in rows(runs / "both")]
    assert {row["tree_a"] for row in table if row["tree_a"]} >= {row["tree"] for row in rows(runs / "a")}
    assert {row["tree_b"] for row in table if row["tree_b"]} >= {row["tree"] for row in rows(runs / "b")}
    assert all(row["tree"] == row["tree_a"] for row in both)
    assert len(both) >= 8
    assert max(float(row["distance_m"]) for row in both) < 0.6
    assert all(int(row["tree"]) > 0 and not row["distance_m"] for row in table if row not in both)


def test_no_tree_is_there_twice(runs):
    place = np.array([[float(row["x_m"]), float(row["y_m"])] for row in rows(runs / "both")])
    gap = np.hypot(*(place[:, None] - place[None]).transpose(2, 0, 1)) + 9.0 * np.eye(len(place))
    assert gap.min() > 0.4


def test_the_merged_run_can_be_judged_and_continued(runs, tmp_path, capsys):
    assert main(["evaluate", str(runs / "both"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["spurious"] <= 1
    assert told["mean_pair_error_percent"] < 0.5
    words = ["map", "sim:stand?seed=4&duration=8", "--continue", str(runs / "both"), "--out", str(tmp_path)]
    assert main(words) == 0
    before = {row["tree"]: row for row in rows(runs / "both")}
    after = {row["tree"]: row for row in rows(tmp_path)}
    assert len(set(before) & set(after)) >= 0.9 * len(before)
    for number in set(before) & set(after):
        assert abs(float(before[number]["x_m"]) - float(after[number]["x_m"])) < 0.3


def test_the_terrain_of_both_runs_is_written_and_read_again(runs, tmp_path, capsys):
    cells = {
        name: {(row["x_m"], row["y_m"]) for row in rows(runs / name, "terrain.csv")} for name in ("a", "both")
    }
    assert cells["a"] < cells["both"]
    assert main(["export", str(runs / "both"), "--out", str(tmp_path / "gis")]) in (0, 3)
    capsys.readouterr()


def test_paths_and_detections_follow_one_another(runs):
    path = rows(runs / "both", "path.csv")
    assert len(path) == len(rows(runs / "a", "path.csv")) + len(rows(runs / "b", "path.csv"))
    seconds = [float(row["t_s"]) for row in path]
    assert seconds == sorted(seconds)
    scans = [int(row["scan"]) for row in rows(runs / "both", "detections.csv")]
    assert scans == sorted(scans)
    assert scans[-1] < len(path)
    assert json.loads((runs / "both" / "run.json").read_text())["scans"] == len(path)


def test_merging_twice_gives_the_same_bytes(runs, tmp_path):
    assert main(["merge", str(runs / "a"), str(runs / "b"), "--out", str(tmp_path)]) == 0
    for name in FILES:
        assert (tmp_path / name).read_bytes() == (runs / "both" / name).read_bytes(), name


def test_another_stand_is_refused(runs, tmp_path, capsys):
    words = ["merge", str(runs / "a"), str(runs / "other"), "--out", str(tmp_path / "out")]
    assert main(words) == 1
    assert "do not match" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_run_without_a_state_is_refused(runs, tmp_path, capsys):
    assert main(["merge", str(runs / "a"), str(tmp_path), "--out", str(tmp_path / "out")]) == 1
    assert "no saved state" in capsys.readouterr().err


@pytest.mark.parametrize("repaired", ["a", "b"])
def test_a_run_with_repairs_is_refused(repaired, runs, tmp_path, capsys):
    folder = {name: runs / name for name in ("a", "b")}
    folder[repaired] = tmp_path / repaired
    shutil.copytree(runs / repaired, folder[repaired])
    record = json.loads((runs / repaired / "run.json").read_text())
    record["repairs"] = {"applied": {"loop": 1}, "not_applied": []}
    (folder[repaired] / "run.json").write_text(json.dumps(record))
    assert main(["merge", str(folder["a"]), str(folder["b"]), "--out", str(tmp_path / "out")]) == 1
    assert "its map has repairs" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_damaged_detections_are_refused(runs, tmp_path, capsys):
    shutil.copytree(runs / "b", tmp_path / "b")
    with (tmp_path / "b" / "detections.csv").open("a", encoding="utf-8") as file:
        file.write("1" * 140_000)
    assert main(["merge", str(runs / "a"), str(tmp_path / "b"), "--out", str(tmp_path / "out")]) == 1
    assert "its detections cannot be read" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
