"""Files saved by earlier versions are read by the commands and the dashboard of this version.

The tests use the command line and the HTTP interface only, so that they do not depend on module names.
`data/saved_by_0_1_0/README.md` lists the files and how they were written.
"""

from __future__ import annotations

import csv
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any
from unittest.mock import patch

import httpx
import numpy as np
import pytest

from app.cli import main

# The saved files use names that the parameters had then.
pytestmark = pytest.mark.filterwarnings("ignore:the parameter .* (is now called|no longer exists)")

SAVED = Path(__file__).parent / "data" / "saved_by_0_1_0"
RUN, MERGED, DATA_FOLDER = SAVED / "run", SAVED / "merged", SAVED / "data_folder"
PAGE_FILE, CLI_FILE = SAVED / "parameters_page.toml", SAVED / "parameters_cli.toml"
STAND = "sim:stand?duration=4"
# Current names; the saved files use the names that the parameters had in 0.1.0.
RUN_CHANGES = {
    "shape.split_slices": 6,
    "slam.particles": 20,
    "classification.range_max": 12.0,
    "classification.voxels_log2": 12,
    "classification.tree_share": 0.45,
}
PAGE_CHANGES = {
    "shape.split_slices": 6,
    "classification.range_max": 12.0,
    "classification.voxels_log2": 14,
    "classification.tree_share": 0.45,
}
CLI_CHANGES = {
    "detection.whole": False,
    "shape.split_slices": 6,
    "classification.range_max": 12.5,
    "classification.tree_share": 0.45,
}
# Parameters of 0.1.0 that no longer exist.
REMOVED = {
    "gathering.every",
    "shape.plane",
    "slam.looks",
    "tracking.gate",
    "tracking.distance_max",
    "tracking.misses_per_hit",
}
NAMES_OF_0_1_0 = {"shape.split_slices": "shape.slices"}


def as_saved(changes: dict[str, Any]) -> dict[str, Any]:
    """The same changes under the names of 0.1.0."""
    return {
        NAMES_OF_0_1_0.get(name, name.replace("classification.", "gathering.")): value
        for name, value in changes.items()
    }


FOREST = "aeaf1162d766d6a2"
UPLOAD = "upload-20261123-043941-6cfa6d.mcap"
READY = re.compile(r"stemmap is ready: (http://127\.0\.0\.1:\d+)/\?token=(\S+)")
ANN, BOB = {"browser": "a" * 16, "who": "Ann"}, {"browser": "b" * 16, "who": "Bob"}
LONGEST_S = 120.0  # until a server answers as expected


def console_script() -> str:
    """The command `stemmap` of the environment of the tests."""
    script = shutil.which("stemmap", path=str(Path(sys.executable).parent))
    assert script is not None
    return script


def stemmap(*words: str | Path, folder: Path | None = None) -> str:
    """What a command prints; `folder` is the data folder."""
    environment = {} if folder is None else {"STEMMAP_FOLDER": str(folder)}
    printed = io.StringIO()
    with patch.dict(os.environ, environment), redirect_stdout(printed):
        assert main([*map(str, words)]) == 0
    return printed.getvalue()


def table(folder: Path, name: str = "trees.csv") -> list[dict[str, str]]:
    """The rows of a table of a run."""
    with (folder / name).open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def record_of(folder: Path) -> dict[str, Any]:
    """The content of `run.json`."""
    record: dict[str, Any] = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    return record


def flat(tables: dict[str, Any]) -> dict[str, Any]:
    """Parameters by dotted name."""
    return {f"{stage}.{name}": value for stage, values in tables.items() for name, value in values.items()}


def assert_numbers_are_kept(before: Path, after: Path) -> None:
    """Nearly all trees of the first map are in the second, with the same number at the same place."""
    old = {row["tree"]: row for row in table(before)}
    new = {row["tree"]: row for row in table(after)}
    kept = set(old) & set(new)
    assert len(kept) >= 0.9 * len(old)
    for number in kept:
        x, y = (float(old[number][axis]) - float(new[number][axis]) for axis in ("x_m", "y_m"))
        assert np.hypot(x, y) < 0.3, number


# --- runs -----------------------------------------------------------------------------------------


def test_a_drive_is_resumed(tmp_path: Path):
    out = tmp_path / "out"
    stemmap("map", STAND, "--continue", RUN, "--start", "resume", "--out", out)
    record = record_of(out)
    assert (record["scans"], record["seed"]) == (40, 3)
    assert flat(record["parameters"]).items() >= RUN_CHANGES.items()
    assert record["evaluation"]["f1"] >= 0.9
    assert_numbers_are_kept(RUN, out)
    # The poses and the detections of the first part are those of the saved run.
    assert len(table(out, "path.csv")) == 40
    first = (RUN / "detections.csv").read_text(encoding="utf-8")
    assert (out / "detections.csv").read_text(encoding="utf-8").startswith(first)


def test_a_second_drive_finds_its_start_in_the_map(tmp_path: Path):
    out = tmp_path / "out"
    stemmap("map", "sim:stand?duration=2&sigma=0.03&drive=1", "--continue", RUN, "--out", out)
    record = record_of(out)
    (second,) = record["continued"]
    assert second["start"] == "constellation"
    assert np.abs(second["pose"][:2]).max() < 0.15
    assert record["scans"] == 15 + 20
    assert_numbers_are_kept(RUN, out)


def test_a_merged_map_is_continued(tmp_path: Path):
    out = tmp_path / "out"
    again = "sim:stand?duration=2&seed=4&sigma=0.03&drive=2"
    stemmap("map", again, "--continue", MERGED, "--start", "auto", "--out", out)
    record = record_of(out)
    assert [source["start"] for source in record["continued"]] == ["merged", "constellation"]
    assert record["scans"] == 20 + 20
    assert_numbers_are_kept(MERGED, out)


def test_two_saved_runs_are_merged(tmp_path: Path):
    out = tmp_path / "out"
    stemmap("merge", MERGED, MERGED, "--out", out)
    correspondence = table(out, "correspondence.csv")
    assert correspondence
    assert all(row["tree_a"] == row["tree_b"] for row in correspondence)


def test_a_run_is_evaluated_as_it_was_then():
    now = json.loads(stemmap("evaluate", "--json", RUN))
    then = record_of(RUN)["evaluation"]
    assert now["TA"] == then["TA"] == {"count": 12, "of": 13}
    assert now["f1"] == pytest.approx(then["f1"])
    assert now["position_rmse"] == pytest.approx(then["position_rmse"], rel=1e-3)


def test_a_run_is_exported(tmp_path: Path):
    stemmap("export", RUN, "--reach", "60", "--out", tmp_path / "states")
    names = {path.name for path in (tmp_path / "states").iterdir()}
    assert names == {"trajectory.txt", *(f"TreeManagerState_{k}.csv" for k in range(15))}


# --- parameters -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("file", "changes"), [(PAGE_FILE, PAGE_CHANGES), (CLI_FILE, CLI_CHANGES)], ids=["page", "command line"]
)
def test_a_parameter_file_sets_all_its_values(file: Path, changes: dict[str, Any]):
    saved = flat(tomllib.loads(file.read_text(encoding="utf-8")))
    assert saved.items() >= as_saved(changes).items()
    saved = {name: value for name, value in saved.items() if name not in REMOVED}
    now = flat(tomllib.loads(stemmap("params", "--format", "toml", "--config", file)))
    assert as_saved(now).items() >= saved.items()


def test_a_learned_forest_is_used(tmp_path: Path):
    out = tmp_path / "out"
    forest = f"gathering.forest={FOREST}"
    words = ("map", "sim:stand?duration=1", "--config", CLI_FILE, "--set", forest, "--out", out)
    stemmap(*words, folder=DATA_FOLDER)
    former = {"ground.height_max": 2.0, "slam.update_distance": 0.0}  # defaults of that version in the file
    assert record_of(out)["changed"] == {**CLI_CHANGES, **former, "classification.forest": FOREST}


# --- the dashboard and its database ---------------------------------------------------------------


@contextmanager
def dashboard(folder: Path, log: Path) -> Iterator[httpx.Client]:
    """A client of a dashboard that has opened the annotated run, on a data folder."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("STEMMAP_")}
    command = [console_script(), "serve", "--no-browser", "--port", "0", STAND]
    with (
        log.open("w", encoding="utf-8") as errors,
        subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            env={**environment, "STEMMAP_FOLDER": str(folder)},
        ) as server,
    ):
        try:
            assert server.stdout is not None
            link = READY.match(server.stdout.readline())
            assert link, log.read_text(encoding="utf-8")
            with httpx.Client(base_url=link[1], timeout=30, trust_env=False) as client:
                client.headers["Origin"] = link[1]
                assert client.get(f"/?token={link[2]}").status_code == 303
                yield client
        finally:
            server.send_signal(signal.SIGINT)
            try:
                server.wait(30)
            except subprocess.TimeoutExpired:
                server.kill()


def until(condition: Callable[[], bool]) -> None:
    """Wait for a condition."""
    end = time.monotonic() + LONGEST_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.1)


def read(client: httpx.Client, address: str, **query: str) -> Any:
    """The JSON of an answer."""
    answer = client.get(f"/api/{address}", params=query)
    assert answer.status_code == 200, answer.text
    return answer.json()


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """A dashboard on a copy of the data folder, with the saved run and an uploaded file in it."""
    folder = tmp_path_factory.mktemp("saved") / "data"
    shutil.copytree(DATA_FOLDER, folder)
    shutil.copytree(RUN, folder / "recordings" / "run")
    (folder / "recordings" / UPLOAD).touch()
    with dashboard(folder, folder.with_name("log")) as client:
        until(lambda: bool(read(client, "annotations")["trees"]))
        yield client


def contents(client: httpx.Client) -> dict[int, tuple[float, float, str, float | None, str, int]]:
    """The annotations by their ids."""
    rows = read(client, "annotations")["trees"]
    names = ("x", "y", "kind", "dbh_cm", "who", "version")
    return {row["id"]: tuple(row[name] for name in names) for row in rows}


def edit(client: httpx.Client, what: str, author: dict[str, str]) -> dict[str, Any]:
    """Undo or redo a step of an author."""
    run = read(client, "annotations")["run"]
    answer = client.post(f"/api/annotations/{what}", json={"run": run, **author})
    assert answer.status_code == 200, answer.text
    said: dict[str, Any] = answer.json()
    return said


def test_annotations_keep_their_undo_history(client: httpx.Client):
    saved = {
        1: (1.3, -2.1, "tree", 32.0, "Ann", 2),
        2: (4.0, 3.5, "pole", None, "Ann", 3),
        3: (-2.5, 6.75, "tree", 19.0, "Bob", 4),
        5: (10.0, 1.0, "tree", 25.0, "Ann", 1),
        6: (11.0, -1.0, "person", None, "Ann", 1),
    }
    assert contents(client) == saved
    steps = [read(client, "annotations", browser=each["browser"]) for each in (ANN, BOB)]
    assert [(each["undo"], each["redo"]) for each in steps] == [(4, 1), (4, 0)]
    edit(client, "redo", ANN)
    assert contents(client)[2] == (4.1, 3.5, "pole", None, "Ann", 4)
    edit(client, "undo", ANN)
    edit(client, "undo", ANN)  # the import of two rows
    assert set(contents(client)) == {1, 2, 3}
    edit(client, "undo", BOB)
    assert contents(client)[3][3] == 18.0
    edit(client, "undo", BOB)  # the deletion
    assert contents(client)[4] == (7.0, 0.5, "bush", None, "Bob", 3)


def test_runs_keep_their_records_maps_and_revisions(client: httpx.Client):
    rows = {row["id"]: row for row in read(client, "runs")["runs"]}
    first, second = rows[1], rows[2]
    assert (first["name"], first["uri"], first["scans"], first["trees"]) == ("first stand", STAND, 40, 52)
    assert (second["name"], second["seed"], second["trees"]) == ("sim:paper?duration=3", 7, 8)
    assert first["parameters"].items() >= as_saved(PAGE_CHANGES).items()
    assert first["scores"]["f1"] == pytest.approx(10 / 11)
    whole = read(client, "runs/1")
    assert len(whole["map"]["trees"]) == 52
    assert [each["revision"] for each in whole["revisions"]] == [1, 2, 4]
    assert whole["revisions"][0]["changes"] == {
        "shape.slices": [4, 6],
        "slam.looks": [100.0, 50.0],
        "gathering.every": [4, 2],
    }
    assert whole["revisions"][0]["who"] == "Ann"


def test_a_finished_folder_is_shown(client: httpx.Client):
    whole = read(client, "runs/folder:run")
    assert whole["trees"] == len(table(RUN))
    assert whole["parameters"].items() >= RUN_CHANGES.items()


def test_parameter_sets_are_downloaded_and_used(client: httpx.Client):
    rows = [(row["name"], row["who"]) for row in read(client, "sets")["sets"]]
    assert rows == [("paper as it is", "Bob"), ("young stand", "Ann")]
    assert client.get("/api/sets/young stand.toml").text == PAGE_FILE.read_text(encoding="utf-8")
    assert client.post("/api/sets/use", json={"name": "young stand"}).status_code == 200
    assert read(client, "parameters")["values"].items() >= PAGE_CHANGES.items()
    assert client.post("/api/sets/use", json={"name": "paper as it is"}).status_code == 200
    assert read(client, "parameters")["preset"] == "paper"


def test_an_upload_keeps_its_name(client: httpx.Client):
    named = [each for each in read(client, "sources")["recordings"] if isinstance(each, dict)]
    assert [(each["name"], each["doc"]) for each in named] == [("north stand.mcap", "ROS 2 MCAP, uploaded")]
