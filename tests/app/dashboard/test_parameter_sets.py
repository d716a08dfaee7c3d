"""Saved sets: kept, used, shared as files, and told to the browsers; counts before and after a change."""

from __future__ import annotations

import json

import numpy as np
import pytest

from app.cli.flags import chosen_parameters
from app.dashboard.payload import counts_before, counts_of
from app.worker.protocol import Shown
from pipeline.config import preset
from tests.app.fakes import frame, opened, path, truth_trees
from tests.app.server_for_tests import Running


async def test_a_set_is_saved_used_downloaded_and_deleted(both: Running, tmp_path) -> None:
    client, dashboard = both
    await client.post("/api/parameters/preset", json={"name": "paper"})
    await client.patch("/api/parameters", json={"changes": {"clustering.eps": 0.5}})
    saved = await client.post("/api/sets", json={"name": "wet larches", "who": "Ann"})
    assert saved.status_code == 201
    assert [(row["name"], row["who"]) for row in saved.json()["sets"]] == [("wet larches", "Ann")]
    await client.post("/api/parameters/preset", json={"name": "forest"})
    assert (await client.post("/api/sets/use", json={"name": "wet larches"})).status_code == 200
    wanted = preset("paper").replace({"clustering.eps": 0.5})
    assert (dashboard.parameters.preset, dashboard.parameters.parameters) == ("paper", wanted)

    # The command line reads the file.
    file = tmp_path / "set.toml"
    file.write_text((await client.get("/api/sets/wet larches.toml")).text)
    flags = type("Flags", (), {"preset": "forest", "config": file, "assignments": []})()
    assert chosen_parameters(flags, "forest")[1] == wanted
    await client.post("/api/parameters/undo", json={})
    assert dashboard.parameters.preset == "forest"
    upload = {"file": "set.toml", "text": file.read_text()}
    assert (await client.post("/api/sets/upload", json=upload)).status_code == 200
    assert (dashboard.parameters.preset, dashboard.parameters.parameters) == ("paper", wanted)

    assert (await client.post("/api/sets/delete", json={"name": "wet larches"})).json()["sets"] == []
    gone = await client.post("/api/sets/use", json={"name": "wet larches"})
    assert (gone.status_code, gone.json()["error"]["where"]) == (404, "wet larches")


async def test_a_set_that_has_the_name_makes_room(both: Running) -> None:
    client, dashboard = both
    for eps in (0.2, 0.3):
        await client.patch("/api/parameters", json={"changes": {"clustering.eps": eps}})
        await client.post("/api/sets", json={"name": "mine"})
    assert dashboard.sets.named("mine")[1].clustering.eps == 0.3
    assert dashboard.sets.name_of("forest", dashboard.parameters.parameters) == "mine"
    await client.post("/api/parameters/reset", json={})
    await client.post("/api/sets", json={"name": "as forest"})
    assert dashboard.sets.name_of("forest", dashboard.parameters.parameters) == "", "that of the preset"


@pytest.mark.parametrize("name", ["", "../x", "-flag", "x" * 41, "a\x1b[2J", "forest"])
async def test_a_name_that_is_none_is_refused(both: Running, name: str) -> None:
    client, _ = both
    assert (await client.post("/api/sets", json={"name": name})).status_code == 422
    assert (await client.get("/api/sets")).json()["sets"] == []


@pytest.mark.parametrize(
    ("text", "words"),
    [("[clustering", "not a TOML file"), ("[clustering]\neps = 9\n", "eps"), ("[best]\nx = 1\n", "best")],
)
async def test_a_file_that_does_not_fit_changes_nothing(both: Running, text: str, words: str) -> None:
    client, dashboard = both
    answer = await client.post("/api/sets/upload", json={"file": "mine.toml", "text": text})
    assert answer.status_code == 422
    assert words in answer.json()["error"]["what"]
    assert dashboard.parameters.parameters == preset("forest")


async def test_there_is_nothing_to_undo_at_first(both: Running) -> None:
    client, _ = both
    for way in ("undo", "redo"):
        assert (await client.post(f"/api/parameters/{way}", json={})).status_code == 409


async def test_the_page_is_told_what_stood_before_a_change(both: Running) -> None:
    client, dashboard = both
    await dashboard.receive(opened(truth=truth_trees()))
    picture = frame(2, 5_200_000_000, x=1.0, n_trees=4)
    await dashboard.receive(Shown(1, 0.2, picture, 0, path([0.0, 0.5, 1.0])))
    assert json.loads(dashboard.live.map_after(0)[1])["before"] is None  # type: ignore[index]
    await client.patch("/api/parameters", json={"changes": {"clustering.eps": 0.5}})
    await dashboard.receive(Shown(1, 0.2, picture, 0, path([0.0, 0.5, 1.0])))
    told = json.loads(dashboard.live.map_after(0)[1])  # type: ignore[index]
    assert told["before"]["verdicts"] == told["verdicts"]
    await dashboard.receive(Shown(1, 0.3, frame(3, 5_300_000_000, n_trees=4), 0, path([0.0, 0.5, 1.0])))
    await dashboard.receive(Shown(1, 0.2, picture, 0, path([0.0, 0.5, 1.0])))  # back at the scan
    assert json.loads(dashboard.live.map_after(0)[1])["before"] is None  # type: ignore[index]


def test_before_is_of_the_same_scan():
    counts = {"verdicts": {"tree": 1}, "right": None, "wrong": None}
    before = {"type": "map", "index": 1, **counts}
    assert counts_before(None, before) is None
    assert counts_before(before, {**before, "verdicts": {"tree": 2}, "right": 2}) == counts
    assert counts_before(before, {**before, "index": 2}) is None


def test_detections_are_held_against_the_truth_where_they_stand():
    picture = frame(2, 5_200_000_000, x=1.0, n_trees=4)
    places = picture.estimate.T_map_base.apply(picture.detections.centre)
    truth = truth_trees()
    counts = counts_of(picture, truth, 0.5)
    near = [
        min(np.hypot(x - truth.x, y - truth.y)) <= 0.5 and truth.kind[0] == "tree" for x, y in places.tolist()
    ]
    assert (counts["right"], counts["wrong"]) == (sum(near), len(near) - sum(near))
    assert counts_of(picture, None, 0.5)["right"] is None
