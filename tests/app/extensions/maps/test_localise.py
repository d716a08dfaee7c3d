"""`stemmap localise`: a drive is found in the map of an earlier one, and never in that of another stand."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.cli import main

STAND = "sim:stand?duration=20&seed=4"
AGAIN = "sim:stand?duration=12&seed=4&drive=1&odometry=poor"
ELSEWHERE = "sim:stand?duration=12&seed=9"


def rows(file: Path):
    """A table."""
    with file.open(encoding="utf-8") as text:
        return list(csv.DictReader(text))


@pytest.fixture(scope="module")
def stand(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of a stand."""
    folder = tmp_path_factory.mktemp("stand") / "run"
    assert main(["map", STAND, "--out", str(folder)]) == 0
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    """All files of a folder."""
    return {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}


def test_another_drive_is_found_and_the_map_stays(stand, tmp_path, capsys):
    before = contents(stand)
    assert main(["localise", AGAIN, "--map", str(stand), "--out", str(tmp_path)]) == 0
    told = capsys.readouterr().out
    record = json.loads((tmp_path / "localisation.json").read_text(encoding="utf-8"))
    assert f"{record['stems']} of {record['of']} stems in view agree" in told
    trees = len(rows(stand / "trees.csv"))
    assert f"in the whole run: {record['seen_again']} of {trees} trees of the map seen again" in told
    assert "the ground here is" in told
    assert record["state"] == "found"
    assert record["withdrawn"] == 0
    assert np.hypot(*record["T_map_odom"][:2]) < 0.3  # both drives begin at one place
    assert abs(record["T_map_odom"][2]) < 0.02
    assert abs(record["height"]["z_m"]) < 0.15
    assert record["missing"] + record["new"] <= 3
    path = {row["t_s"]: row for row in rows(tmp_path / "path.csv")}
    poses = rows(tmp_path / "poses.csv")
    assert len(poses) > 0.5 * len(path)
    for pose in poses:
        here = path[pose["t_s"]]
        assert abs(float(pose["x_m"]) - float(here["x_m"])) < 0.4
        assert float(pose["sigma_x_m"]) < 0.3
    statuses = [row["status"] for row in rows(tmp_path / "trees_in_map.csv")]
    assert statuses.count("same") == record["seen_again"]
    assert contents(stand) == before


@pytest.mark.slow
def test_another_stand_is_not_found_and_says_so(stand, tmp_path, capsys):
    assert main(["localise", ELSEWHERE, "--map", str(stand), "--out", str(tmp_path)]) == 3
    told = capsys.readouterr().out
    assert "found after" not in told
    assert "yet" not in told
    record = json.loads((tmp_path / "localisation.json").read_text(encoding="utf-8"))
    driven = f"not found in {record['driven_m']:.0f} m of driving"
    final = {"not_found": driven, "absent": "nothing of this map is here"}
    assert final[record["state"]] == record["text"]
    assert record["text"] in told.splitlines()
    assert record["T_map_odom"] is None
    assert rows(tmp_path / "poses.csv") == []
    assert not (tmp_path / "trees_in_map.csv").exists()


@pytest.mark.slow
def test_a_small_file_gives_the_same_place(stand, tmp_path, capsys):
    file = tmp_path / "stand.stems"
    assert main(["pack", str(stand), "--out", str(file)]) == 0
    assert "stems" in capsys.readouterr().out
    assert file.stat().st_size < 10_000
    assert main(["pack", str(stand), "--out", str(file)]) == 1  # it exists
    capsys.readouterr()
    assert main(["localise", AGAIN, "--map", str(file)]) == 0
    assert "stems in view agree" in capsys.readouterr().out
    assert main(["localise", AGAIN, "--map", str(file), "--grow"]) == 1  # it has no state


@pytest.mark.slow
def test_a_map_grows_only_on_demand(stand, tmp_path, capsys):
    import shutil

    grown = tmp_path / "map"
    shutil.copytree(stand, grown)
    before = rows(grown / "trees.csv")
    assert main(["localise", AGAIN, "--map", str(grown), "--grow"]) == 0
    assert "trees now" in capsys.readouterr().out
    after = rows(grown / "trees.csv")
    assert {row["tree"] for row in before} <= {row["tree"] for row in after}
    places = np.array([[float(row["x_m"]), float(row["y_m"])] for row in after])
    apart = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1)) + 9.0 * np.eye(len(places))
    assert apart.min() > 0.4  # nothing twice
    assert main(["localise", ELSEWHERE, "--map", str(grown), "--grow"]) == 3
    assert rows(grown / "trees.csv") == after


@pytest.mark.slow
def test_a_doubtful_map_is_not_added_and_said(stand, tmp_path, capsys, monkeypatch):
    import shutil

    from app.batch.map_run import WRONG
    from app.cli import map as map_command

    map_to = map_command.map_to

    def doubtful(*arguments: Any) -> Any:
        outcome, replaces = map_to(*arguments)
        outcome.warnings.append(f"{WRONG[0]} since 3 s")
        return outcome, replaces

    grown = tmp_path / "map"
    shutil.copytree(stand, grown)
    monkeypatch.setattr(map_command, "map_to", doubtful)
    assert main(["localise", AGAIN, "--map", str(grown), "--grow"]) == 3
    assert "the map stays as it is" in capsys.readouterr().out
    assert contents(grown) == contents(stand)


def test_a_map_with_repairs_does_not_grow(stand, tmp_path, capsys):
    import shutil

    repaired = tmp_path / "map"
    shutil.copytree(stand, repaired)
    record = json.loads((stand / "run.json").read_text(encoding="utf-8"))
    record["repairs"] = {"applied": {"loop": 1}, "not_applied": []}
    (repaired / "run.json").write_text(json.dumps(record), encoding="utf-8")
    assert main(["localise", AGAIN, "--map", str(repaired), "--grow"]) == 1
    assert "its map has repairs" in capsys.readouterr().err
    assert main(["localise", AGAIN, "--map", str(stand), "--grow", "--repairs", "repairs.json"]) == 2
    assert "Remove --repairs" in capsys.readouterr().err


def test_what_is_no_map_is_refused(tmp_path, capsys):
    (tmp_path / "file").write_bytes(b"nothing")
    (tmp_path / "empty").mkdir()
    large = tmp_path / "large"
    with large.open("wb") as sparse:
        sparse.truncate(65 << 20)
    for name, what in (
        ("none", "there is no such folder or file"),
        ("file", "this file is not a stored map"),
        ("large", "this file is not a stored map"),
        ("empty", "this folder has no mapped run"),
    ):
        assert main(["localise", AGAIN, "--map", str(tmp_path / name)]) == 1
        what_to_do = "Give the folder of a run that `stemmap map` wrote, or a .stems file that `stemmap pack`"
        assert capsys.readouterr().err.startswith(f"stemmap: {what} ({tmp_path / name}). {what_to_do}")
