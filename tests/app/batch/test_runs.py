"""What became of the runs, through the API: recorded, listed, renamed, deleted, played again."""

from __future__ import annotations

import asyncio
import io
import json
import re
import zipfile
from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import AsyncMock

import httpx
import msgspec
import numpy as np
import pytest

from app.batch.run_folder import NO_PATH
from app.cli.flags import source_request
from app.common.settings import Settings
from app.dashboard import run_recorder
from app.dashboard.dashboard import Dashboard
from app.dashboard.run_recorder import MOST_PATH_POINTS, thinned
from app.sources import opening
from app.sources.request import SourceRequest, request_of_kept
from app.store.database import maps
from app.store.records import Author, Content
from app.store.store import Store
from app.worker.protocol import Begin, Open, Report, Shown, Status
from pipeline.errors import SourceError, StemmapError
from pipeline.types.records import Path as DrivenPath
from pipeline.types.records import TruthTrees
from tests.app.fakes import FakeWorker, frame, opened, path, truth_trees
from tests.app.server_for_tests import BEARER, Running, running

TRUTH = truth_trees()
LIVE = "zenoh:tcp/127.0.0.1:7447"
NAMED = {"Cookie": "stemmap_name=Ann%20B"}


async def play(
    dashboard: Dashboard,
    uri: str = "fake:",
    scan: int = 2,
    n_trees: int = 4,
    run: int = 1,
    wanted: Open | None = None,
    truth: TruthTrees | None = TRUTH,
) -> None:
    """A run is opened and shown up to a scan; its record is written when this returns."""
    dashboard.check_source = AsyncMock()  # the sources exist only here
    await dashboard.open(wanted or Open(uri))
    await dashboard.receive(opened(uri, truth=truth, run=run))
    await show(dashboard, scan, n_trees, run)
    async with asyncio.timeout(20):
        while dashboard.run_recorder.record is None:
            await asyncio.sleep(0.01)


async def show(dashboard: Dashboard, scan: int, n_trees: int, run: int = 1) -> None:
    stamp = 5_000_000_000 + scan * 100_000_000
    picture = frame(scan, stamp, x=1.0, n_trees=n_trees)
    await dashboard.receive(Shown(run, 0.1 * scan, picture, 0, path([0.5 * k for k in range(scan + 1)])))


async def runs(client: httpx.AsyncClient) -> list[dict[str, Any]]:
    listed: list[dict[str, Any]] = (await client.get("/api/runs")).json()["runs"]
    return listed


async def test_a_run_that_was_mapped_is_listed_and_shown(both: Running) -> None:
    client, dashboard = both
    assert await runs(client) == []
    await play(dashboard)
    (row,) = await runs(client)
    assert (row["name"], row["uri"], row["scans"], row["trees"]) == ("fake:", "fake:", 3, 3)
    assert (row["all_scans"], row["distance_m"], row["preset"]) == (5, 1.0, "forest")
    assert "map" not in row
    whole = (await client.get(f"/api/runs/{row['key']}")).json()
    assert [tree["number"] for tree in whole["map"]["trees"]] == [1, 2, 3]
    assert whole["map"]["path"] == [[0.0, 0.0], [0.5, 0.0], [1.0, 0.0]]
    assert len(whole["map"]["truth"]) == 3
    assert whole["parameters"]["clustering.eps"] == 0.15
    assert (await client.get("/api/runs")).json()["open"] == row["id"]


async def test_what_comes_later_is_written_when_the_run_is_left(both: Running) -> None:
    client, dashboard = both
    await play(dashboard, scan=1)
    await show(dashboard, 4, 6)
    await show(dashboard, 0, 2)  # going back takes nothing away
    await play(dashboard, "other:", run=2)
    rows = {row["uri"]: row for row in await runs(client)}
    assert (rows["fake:"]["scans"], rows["fake:"]["trees"]) == (5, 5)
    assert rows["other:"]["scans"] == 3


async def test_what_the_database_refused_is_written_when_it_answers_again(
    both: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    client, dashboard = both
    monkeypatch.setattr(run_recorder, "_PAUSE_S", 0.01)
    await play(dashboard, scan=1)
    refused = asyncio.Event()

    async def refuse(_work: object) -> None:
        refused.set()
        raise StemmapError("the disk is full")

    with monkeypatch.context() as full:
        full.setattr(dashboard.store, "ask", refuse)
        await show(dashboard, 4, 6)
        await asyncio.wait_for(refused.wait(), 20)
    async with asyncio.timeout(20):
        while (await runs(client))[0]["scans"] != 5:
            await asyncio.sleep(0.01)


async def test_a_live_run_names_its_recordings(both: Running, tmp_path: Path) -> None:
    client, dashboard = both
    live = Status("playing", scan_index=2, live=True)
    await play(dashboard, LIVE, scan=1)
    names = [str(tmp_path / name) for name in ("first.mcap", "second.mcap")]
    await dashboard.receive(Report(replace(live, recorded_file=names[0])))
    await show(dashboard, 2, 4)
    await dashboard.receive(Report(replace(live, recorded_file=names[1])))  # no scan is shown after it
    await dashboard.receive(Report(replace(live, state="finished", recorded_file=names[1])))
    await play(dashboard, f"{LIVE}2", run=2)
    await dashboard.run_recorder.close()
    named = {}
    for row in await runs(client):
        named[row["uri"]] = (await client.get(f"/api/runs/{row['key']}")).json()["map"]["recordings"]
    assert named == {LIVE: names, f"{LIVE}2": []}
    files = await dashboard.store.ask(lambda store: store.book.files(1))
    with zipfile.ZipFile(io.BytesIO(files)) as archive:
        assert json.loads(archive.read("run.json"))["recordings"] == names


async def test_a_live_run_keeps_its_log(both: Running) -> None:
    client, dashboard = both
    await play(dashboard, LIVE, scan=1)
    live = Status("playing", scan_index=2, live=True)
    await dashboard.receive(Report(live))
    silent = replace(live, state="waiting", detail="no data for 2 s", time_s=0.2, silence_s=3600.0)
    await dashboard.receive(Report(silent))
    await show(dashboard, 8, 4)
    # The worker is started again: what happened before stays.
    opened_again = replace(live, state="waiting", detail="no data for 5 s", time_s=0.4)
    dashboard.worker.restarts += 1
    await dashboard.receive(opened(LIVE, truth=TRUTH))
    await show(dashboard, 9, 4)
    await dashboard.receive(Report(opened_again))
    await play(dashboard, "fake:", run=2)
    await dashboard.run_recorder.close()
    logs = {}
    for row in await runs(client):
        logs[row["uri"]] = (await client.get(f"/api/runs/{row['key']}")).json()["map"]["logs"]
    assert logs["fake:"] == []  # it can be replayed
    first, second = logs[LIVE]
    silence = next(event for event in first["events"] if event["kind"] == "silence")
    assert silence["text"] == "no data for 2 s"
    assert silence["for_s"] == pytest.approx(3600.0, abs=60.0), "by the clock of this computer"
    assert silence["noted_s"] > 1e9
    assert first["start_s"] == dashboard.start_ns / 1e9
    assert [each["text"] for each in second["events"] if each["kind"] == "silence"] == ["no data for 5 s"]


async def test_a_run_that_showed_nothing_leaves_no_record(both: Running) -> None:
    client, dashboard = both
    await dashboard.receive(opened())
    dashboard.check_source = AsyncMock()
    await dashboard.open(Open("other:"))
    assert await runs(client) == []


async def test_who_changed_which_parameter_when(both: Running) -> None:
    client, dashboard = both
    await play(dashboard)
    for eps in (0.2, 0.3):  # a slider that moves
        await client.patch("/api/parameters", json={"changes": {"clustering.eps": eps}}, headers=NAMED)
    await client.patch("/api/parameters", json={"changes": {"clustering.min_points": 9}})
    await dashboard.run_recorder.close()
    (row,) = await runs(client)
    changes = (await client.get(f"/api/runs/{row['key']}")).json()["revisions"]
    assert [(each["who"], each["changes"]) for each in changes] == [
        ("Ann B", {"clustering.eps": [0.15, 0.3]}),
        ("somebody", {"clustering.min_points": [8, 9]}),
    ]
    assert all(each["time_s"] == 0.2 and each["at_s"] > 0 for each in changes)


async def test_rename_delete_and_undo(both: Running) -> None:
    client, dashboard = both
    await play(dashboard)
    (row,) = await runs(client)
    at = f"/api/runs/{row['id']}"
    assert (await client.patch(at, json={"name": " north  stand "})).status_code == 200
    assert (await runs(client))[0]["name"] == "north stand"
    for name in ("", "  ", "a\x00b", "x" * 201):
        assert (await client.patch(at, json={"name": name})).status_code == 422
    refused = await client.delete(at)
    assert (refused.status_code, refused.json()["error"]["what"]) == (409, "this run is open")
    await play(dashboard, "other:", run=2)
    assert (await client.delete(at)).status_code == 200
    assert [each["uri"] for each in await runs(client)] == ["other:"]
    assert (await client.get(at)).status_code == 404
    assert (await client.delete(at)).status_code == 404
    assert (await client.post(f"{at}/restore")).status_code == 200
    assert {each["name"] for each in await runs(client)} == {"north stand", "other:"}


@pytest.mark.parametrize("key", ["99", "nothing", "folder:nothing", "-1", "99999999999999999999"])
async def test_a_run_that_is_not_there(both: Running, key: str) -> None:
    client, _ = both
    assert (await client.get(f"/api/runs/{key}")).status_code == 404
    assert (await client.post(f"/api/runs/{key}/replay")).status_code == 404


async def test_a_run_is_played_again_with_its_parameters(both: Running) -> None:
    client, dashboard = both
    await play(dashboard)
    await client.patch("/api/parameters", json={"changes": {"clustering.eps": 0.4}})
    await show(dashboard, 4, 4)
    await play(dashboard, "other:", run=2)
    await client.post("/api/parameters/preset", json={"name": "paper"})
    key = next(row["key"] for row in await runs(client) if row["uri"] == "fake:")
    assert (await client.post(f"/api/runs/{key}/replay?check_only=true")).status_code == 202
    assert dashboard.source.uri == "other:", "the open run is kept"
    assert (await client.post(f"/api/runs/{key}/replay")).status_code == 202
    await dashboard.receive(opened("fake:", run=3))
    worker = dashboard.worker
    assert isinstance(worker, FakeWorker)
    assert worker.commands[-2] == Open("fake:")
    begun = worker.commands[-1]
    assert isinstance(begun, Begin)
    assert begun.values["clustering"]["eps"] == 0.4
    assert (dashboard.parameters.preset, begun.play) == ("forest", True)


async def test_a_live_run_is_not_replayed_and_the_open_run_goes_on(both: Running) -> None:
    client, dashboard = both
    await play(dashboard, "zenoh:tcp/127.0.0.1:7447")
    await play(dashboard, "other:", run=2)
    worker = dashboard.worker
    assert isinstance(worker, FakeWorker)
    before = list(worker.commands)
    listed = {row["uri"].partition(":")[0]: row for row in await runs(client)}
    key = listed["zenoh"]["key"]
    assert re.fullmatch(r"127.0.0.1:7447, \d{4}-\d\d-\d\d \d\d:\d\d", listed["zenoh"]["name"])
    assert listed["other"]["name"] == "other:"
    assert (await client.get(f"/api/runs/{key}")).json()["live"] is True
    assert (await client.get(f"/api/runs/{listed['other']['key']}")).json()["live"] is False
    answer = await client.post(f"/api/runs/{key}/replay")
    assert answer.status_code == 409
    assert "recording" in answer.text
    assert worker.commands == before


async def test_a_run_is_played_again_with_its_topics_and_mounting(both: Running) -> None:
    client, dashboard = both
    chosen = Open("fake:", topics={"scan": "/other"}, mount=(0.0, 0.1, 2.0, 0.0, 0.0, 0.5))
    await play(dashboard, wanted=chosen)
    await play(dashboard, "other:", run=2)
    key = next(row["key"] for row in await runs(client) if row["uri"] == "fake:")
    assert (await client.post(f"/api/runs/{key}/replay")).status_code == 202
    worker = dashboard.worker
    assert isinstance(worker, FakeWorker)
    asked = [each for each in worker.commands if isinstance(each, Open)]
    assert asked[-3:] == [chosen, Open("other:"), chosen]


@pytest.mark.parametrize("kept", [None, 7, {"topics": {"lidar": "/x"}}, {"mount": [1]}, {"mount": ["a"] * 6}])
def test_damaged_choices_are_left_out(kept: object):
    request = request_of_kept("fake:", odometry="auto", seed=3, choices=kept)
    assert request == SourceRequest("fake:", seed=3)


def test_the_choices_of_a_run_without_a_browser_are_kept_as_well():
    given = Namespace(seed=0, topics=[("imu", "/imu")], mount=(1.0, 2.0, 3.0, 0.0, -90.0, 45.0))
    request = source_request(given, "fake:")
    again = request_of_kept("fake:", odometry="auto", seed=0, choices=request.kept_choices())
    assert again.topics == {"imu": "/imu"}
    np.testing.assert_allclose(again.mount or (), (1.0, 2.0, 3.0, 0.0, -0.5 * np.pi, 0.25 * np.pi))
    assert source_request(Namespace(seed=5, topics=[], mount=None), "fake:").kept_choices() is None


async def test_annotations_keep_topics_mounting_seed_and_odometry_of_the_mapped_run(both: Running) -> None:
    _, dashboard = both
    wanted = Open("fake:", "static", 7, {"scan": "/other"}, (0.0, 0.1, 2.0, 0.0, 0.0, 0.5))
    await play(dashboard, wanted=wanted)
    run, author = dashboard.annotation_editor.run, Author("b" * 16, "Ann")
    assert run is not None
    await dashboard.store.ask(lambda store: store.add(run, author, [Content(1.0, 2.0)]))
    (source,) = await dashboard.store.ask(lambda store: store.annotated_sources())
    state = dashboard.parameters
    expected = msgspec.structs.replace(
        wanted.request(), preset=state.preset, parameters=state.parameters.flat()
    )
    assert source.request == expected


async def test_rejected_trees_do_not_count_in_the_list_and_are_marked_in_the_map(both: Running) -> None:
    client, dashboard = both
    await play(dashboard)
    run, author = dashboard.annotation_editor.run, Author("b" * 16, "Ann")
    assert run is not None
    reviews = [Content(0.0, 0.0), Content(2.0, 0.1, "pole"), Content(4.0, 0.0, "skipped")]
    await dashboard.store.ask(lambda store: store.add(run, author, reviews))
    (row,) = await runs(client)
    assert row["trees"] == 2
    whole = (await client.get(f"/api/runs/{row['key']}")).json()
    assert (whole["trees"], whole["rejected"]) == (2, 1)
    assert [tree["review"] for tree in whole["map"]["trees"]] == ["confirmed", "rejected", "skipped"]
    await dashboard.store.ask(lambda store: store.undo(run, author))
    assert [each["trees"] for each in await runs(client)] == [3]
    await dashboard.store.ask(lambda store: store.redo(run, author))
    assert [each["trees"] for each in await runs(client)] == [2]


async def test_rejected_trees_are_counted_again_only_after_a_change(both: Running) -> None:
    client, dashboard = both
    await play(dashboard)
    await play(dashboard, "other:", run=2)
    run, author = dashboard.annotation_editor.run, Author("b" * 16, "Ann")
    assert run is not None
    await dashboard.store.ask(lambda store: store.add(run, author, [Content(2.0, 0.0, "pole")]))
    assert {each["uri"]: each["trees"] for each in await runs(client)} == {"fake:": 3, "other:": 2}
    read: list[int] = []
    await dashboard.store.ask(lambda store: setattr(store.book, "trees", read.append))
    assert {each["uri"]: each["trees"] for each in await runs(client)} == {"fake:": 3, "other:": 2}
    assert read == []


async def test_a_run_whose_map_is_missing_is_listed(both: Running) -> None:
    client, dashboard = both
    await play(dashboard)
    run, author = dashboard.annotation_editor.run, Author("b" * 16, "Ann")
    assert run is not None
    await dashboard.store.ask(lambda store: store.add(run, author, [Content(2.0, 0.0, "pole")]))

    def remove_maps(store: Store) -> None:
        with store.book._engine.begin() as connection:
            connection.execute(maps.delete())

    await dashboard.store.ask(remove_maps)
    assert [each["trees"] for each in await runs(client)] == [3]


async def test_the_list_has_the_number_of_annotations_of_each_recording(both: Running) -> None:
    client, dashboard = both
    await play(dashboard)
    run, author = dashboard.annotation_editor.run, Author("b" * 16, "Ann")
    assert run is not None
    (listed,) = (await client.get("/api/runs")).json()["runs"]
    assert listed["annotated"] == 0
    contents = [Content(1.0, 2.0), Content(4.0, 2.0, "bush"), Content(9.0, 2.0, "skipped")]
    await dashboard.store.ask(lambda store: store.add(run, author, contents))
    (listed,) = (await client.get("/api/runs")).json()["runs"]
    assert listed["annotated"] == 2, "a skipped tree is not annotated"


async def test_a_shared_run_is_opened_with_its_parameters(both: Running) -> None:
    client, dashboard = both
    body = {"uri": "run.mcap", "seed": 3, "preset": "paper", "parameters": {"clustering.eps": 0.3}}
    assert (await client.post("/api/open", json=body)).status_code == 202
    assert dashboard.request == SourceRequest(
        "run.mcap", seed=3, preset="paper", parameters={"clustering.eps": 0.3}
    )
    wrong = {**body, "parameters": {"clustering.eps": -1.0}}
    assert (await client.post("/api/open", json=wrong)).status_code == 422


async def test_from_afar_a_run_of_a_hidden_file_is_not_opened() -> None:
    async with running(Settings(host="0.0.0.0")) as (client, dashboard):  # noqa: S104
        client.headers.update(BEARER)
        await play(dashboard, "/etc/secret.mcap")
        (row,) = await runs(client)
        assert (await client.post(f"/api/runs/{row['key']}/replay")).status_code == 403


@pytest.mark.slow
async def test_a_finished_folder_in_the_data_folder_is_listed_and_read(tmp_path: Path) -> None:
    from app.cli import main

    folder = tmp_path / "recordings"
    folder.mkdir()
    changed = ("--set", "clustering.min_points=9")
    assert main(["map", "sim:stand?duration=3", "--out", str(folder / "north"), *changed]) == 0
    (folder / "broken").mkdir()
    (folder / "broken" / "run.json").write_text("{")
    (folder / "broken" / "trees.csv").write_text("")
    (tmp_path / "outside").mkdir()
    (folder / "link").symlink_to(tmp_path / "outside")
    async with running(Settings(folder=tmp_path)) as (client, _):
        client.headers.update(BEARER)
        listed = (await client.get("/api/runs")).json()["folders"]
        assert [each["name"] for each in listed] == ["broken", "north"]
        whole = (await client.get("/api/runs/folder:north")).json()
        assert (whole["uri"], whole["scans"], whole["preset"]) == ("sim:stand?duration=3", 30, "forest")
        assert whole["differences"] == {"clustering.min_points": 9}
        assert len(whole["map"]["trees"]) == whole["trees"] > 0
        assert whole["scores"]["TA"]["of"] > 0
        refused = await client.get("/api/runs/folder:broken")
        assert (refused.status_code, "run.json is damaged" in refused.text) == (409, True)
        for key in ("folder:..", "folder:../recordings/north", "folder:outside", "folder:link"):
            assert (await client.get(f"/api/runs/{key}")).status_code == 404


async def test_a_reader_that_dies_or_hangs_is_an_error_for_people() -> None:
    import sys

    dies = (sys.executable, "-c", "import os; os.abort()")
    with pytest.raises(SourceError, match="ended without an answer"):
        await opening.ask({"ask": "recording", "path": __file__}, command=dies)
    hangs = (sys.executable, "-c", "import threading; threading.Event().wait()")
    with pytest.raises(opening.TookTooLongError):
        await opening.ask({"ask": "recording", "path": __file__}, command=hangs, patience_s=0.2)
    with pytest.raises(SourceError, match="no such file"):
        await opening.ask({"ask": "recording", "path": "/no/such.mcap"})


def test_a_long_path_is_thinned_and_keeps_its_ends() -> None:
    zeros = np.zeros(10_000)
    path = DrivenPath(zeros.astype(np.int64), np.arange(10_000.0), zeros, zeros, zeros)
    thin = thinned(path, (1.0, 2.0, 3.0))
    assert len(thin) == MOST_PATH_POINTS
    assert (thin[0], thin[-1]) == ([1.0, 2.0], [10_000.0, 2.0])
    assert thinned(NO_PATH) == []
