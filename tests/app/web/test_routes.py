"""The API: what it gives, what it refuses and with which words."""

from __future__ import annotations

import asyncio
import json
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import msgspec
import pytest

from app.common.settings import Files, Settings
from app.common.timers import RequestQueue
from app.dashboard.dashboard import Dashboard
from app.sources import opening
from app.sources.one_step import OneStep
from app.web.auth import viewer_token
from app.web.routes.access import permitted_uri
from app.web.routes.run import recordings
from app.worker.protocol import (
    Advance,
    Answer,
    AskCluster,
    MapChanges,
    Open,
    Play,
    Remapped,
    Report,
    Rough,
    Seek,
    SetParameters,
    Shown,
    Status,
    TreeChange,
    WorkerBusyError,
)
from pipeline.config import field_specs, preset
from pipeline.io import readers
from tests.app.explain.stories import cluster_story
from tests.app.fakes import FakeWorker, frame, opened, path, truth_trees
from tests.app.server_for_tests import BEARER, PORT, TOKEN, Running, running


def told(dashboard: Dashboard) -> list[Any]:
    worker = dashboard.worker
    assert isinstance(worker, FakeWorker)
    return worker.commands


async def show(dashboard: Dashboard, n_trees: int = 4, truth: bool = True) -> None:
    await dashboard.receive(opened(truth=truth_trees() if truth else None))
    picture = frame(2, 5_200_000_000, x=1.0, n_trees=n_trees)
    await dashboard.receive(Shown(1, 0.2, picture, 0, path([0.0, 0.5, 1.0])))


async def test_status_is_what_the_worker_said(both: Running) -> None:
    client, dashboard = both
    await dashboard.receive(Report(Status("paused", time_s=3.5, trees=7)))
    answer = (await client.get("/api/status")).json()
    assert (answer["state"], answer["time_s"], answer["trees"]) == ("paused", 3.5, 7)
    assert "type" not in answer


@pytest.mark.parametrize(
    ("body", "command"),
    [
        ({"type": "play"}, Play()),
        ({"type": "advance", "scans": -3}, Advance(-3)),
        ({"type": "seek", "time_s": 12.5}, Seek(12.5)),
    ],
)
async def test_commands_reach_the_worker(both: Running, body: dict[str, Any], command: Any) -> None:
    client, dashboard = both
    assert (await client.post("/api/command", json=body)).status_code == 202
    assert told(dashboard)[-1] == command


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (b'{"type": "explode"}', "explode"),
        (b'{"type": "open", "uri": "/etc/passwd"}', "open"),
        (b'{"type": "seek", "time_s": NaN}', "does not fit"),
        (b'{"type": "seek", "time_s": -1}', "time_s"),
        (b'{"type": "seek", "time_s": 1e10}', "time_s"),
        (b'{"type": "set_speed", "factor": -1}', "factor"),
        (b'{"type": "set_speed", "factor": 1e-300}', "factor"),
        (b'{"type": "set_speed", "factor": 1e9}', "factor"),
        (b'{"type": "advance", "scans": -1000000001}', "scans"),
        (b"[" * 5000, "parsing the body"),
    ],
)
async def test_what_is_no_command_is_refused(both: Running, body: bytes, words: str) -> None:
    client, dashboard = both
    before = list(told(dashboard))
    answer = await client.post("/api/command", content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code in (400, 422)
    assert words in answer.json()["error"]["what"]
    assert told(dashboard) == before


async def test_a_form_of_another_page_is_no_json(both: Running) -> None:
    client, _ = both
    answer = await client.post(
        "/api/command", content=b'{"type":"play"}', headers={"Content-Type": "text/plain"}
    )
    assert answer.status_code == 422


async def test_parameters_tell_values_specs_and_presets(both: Running) -> None:
    client, _ = both
    answer = (await client.get("/api/parameters")).json()
    assert answer["values"] == preset("forest").flat()
    assert [spec["name"] for spec in answer["specs"]] == [spec.name for spec in field_specs()]
    assert {"name", "doc"} == set(answer["presets"][0])
    assert (answer["preset"], answer["changed"]) == ("forest", [])


async def test_a_change_reaches_worker_scene_and_answer(both: Running) -> None:
    client, dashboard = both
    answer = await client.patch("/api/parameters", json={"changes": {"clustering.eps": 1}})
    assert answer.json()["values"]["clustering.eps"] == 1.0
    assert answer.json()["changed"] == ["clustering.eps"]
    assert answer.json()["revision"] == 1
    sent = told(dashboard)[-1]
    assert isinstance(sent, SetParameters)
    assert (sent.values["clustering"]["eps"], sent.revision) == (1.0, 1)
    reset = await client.post("/api/parameters/reset", json={"names": ["clustering.eps"]})
    assert (reset.json()["changed"], reset.json()["revision"]) == ([], 2)
    paper = await client.post("/api/parameters/preset", json={"name": "paper"})
    assert paper.json()["values"] == preset("paper").flat()


async def test_what_a_change_acts_on_is_told_to_the_worker(both: Running) -> None:
    client, dashboard = both
    assert (await client.get("/api/parameters")).json()["whole"] is True
    for whole in (False, True):
        answer = await client.put("/api/parameters/reach", json={"whole": whole})
        assert answer.json()["whole"] is whole
        sent = told(dashboard)[-1]
        assert isinstance(sent, SetParameters)
        assert sent.whole is whole
    assert (await client.put("/api/parameters/reach", json={"whole": "yes"})).status_code == 422


async def test_a_run_that_was_mapped_again_has_its_own_marks_and_keeps_the_selection(both: Running) -> None:
    client, dashboard = both
    await show(dashboard)
    await dashboard.select_tree(2)
    changes = MapChanges(
        revision=1,
        scans=3,
        time_s=0.2,
        before=4,
        after=2,
        ghost=[(0.0, 1.0, None)],
        changes=[],
        confirmed=[(1, 0.1), (5, 0.2)],
    )
    frame = dashboard.shown.frame if dashboard.shown else None
    assert frame is not None
    await dashboard.receive(Rough(7, 1, frame.trees))  # of a run that was left
    assert "places" not in json.loads(dashboard.live._messages["rough"][1])
    await dashboard.receive(Rough(1, 1, frame.trees))
    rough = json.loads(dashboard.live._messages["rough"][1])
    assert (rough["revision"], len(rough["places"])) == (1, len(frame.trees.number))
    await dashboard.receive(Remapped(7, changes))  # of a run that was left
    assert dashboard.selector.selection.tree == 2
    await dashboard.receive(Remapped(1, changes))
    assert dashboard.selector.selection.tree == 2
    marks = [e for e in dashboard.events.as_plain()["events"] if e["kind"] == "tree"]
    assert [(e["t"], e["text"]) for e in marks] == [(0.1, "Tree 1 mapped"), (0.2, "Tree 5 mapped")]
    assert (await client.get("/api/trees")).status_code == 200
    gone = [TreeChange("vanished", 2, 0.0, 0.0, "now: nothing was detected there")]
    await dashboard.receive(Remapped(1, msgspec.structs.replace(changes, changes=gone)))
    assert dashboard.selector.selection.tree is None


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"clustering.eps": 1e9}, "clustering.eps = 1000000000.0: should be less than or equal to 5"),
        ({"clustering.epz": 0.2}, "no parameter 'clustering.epz'"),
    ],
)
async def test_a_bad_change_names_parameter_and_bound(
    both: Running, changes: dict[str, Any], words: str
) -> None:
    client, dashboard = both
    before = dashboard.parameters.as_plain()
    answer = await client.patch("/api/parameters", json={"changes": changes})
    assert answer.status_code in (400, 422)
    assert words in answer.json()["error"]["what"]
    assert dashboard.parameters.as_plain() == before


async def test_an_unknown_preset_or_name_is_refused(both: Running) -> None:
    client, _ = both
    assert (await client.post("/api/parameters/preset", json={"name": "best"})).status_code == 422
    assert (await client.post("/api/parameters/reset", json={"names": ["best"]})).status_code == 422


async def test_the_download_is_what_config_takes(both: Running) -> None:
    client, _ = both
    await client.patch("/api/parameters", json={"changes": {"slam.particles": 33}})
    answer = await client.get("/api/parameters.toml")
    assert tomllib.loads(answer.text)["slam"]["particles"] == 33
    assert "parameters.toml" in answer.headers["content-disposition"]


async def test_opening_tells_the_worker(both: Running) -> None:
    client, dashboard = both
    body = {"uri": "sim:slope", "odometry": "static", "seed": 4}
    assert (await client.post("/api/open", json=body)).status_code == 202
    assert told(dashboard)[-1] == Open("sim:slope", "static", 4)
    assert (await client.get("/api/status")).json()["state"] == "starting"


async def test_a_source_is_checked_without_leaving_the_run(both: Running) -> None:
    client, dashboard = both
    before, status = len(told(dashboard)), dashboard.status
    path = "/api/open?check_only=true"
    assert (await client.post(path, json={"uri": "sim:slope"})).status_code == 202
    assert (await client.post(path, json={"uri": "sim:nowhere"})).status_code == 409
    assert (len(told(dashboard)), dashboard.status) == (before, status)


async def test_a_live_run_is_recorded_to_a_new_file_in_the_data_folder(tmp_path: Path) -> None:
    async with running(Settings(folder=tmp_path)) as (client, dashboard):
        client.headers.update(BEARER)
        body = {"uri": "velodyne:127.0.0.1:2368", "record": True}
        assert (await client.post("/api/open", json=body)).status_code == 202
        record = Path(told(dashboard)[-1].record)
        assert record.parent == tmp_path / "recordings"
        assert record.suffix == ".mcap"
        assert (await client.post("/api/command", json={"type": "record"})).status_code == 202
        assert Path(told(dashboard)[-1].path).parent == tmp_path / "recordings"
        answer = await client.post("/api/open", json={**body, "uri": "sim:stand"})
        assert answer.status_code == 422
        assert "only a live run can be recorded" in answer.text
    async with running(Settings()) as (client, dashboard):
        client.headers.update(BEARER)
        before = len(told(dashboard))
        assert (await client.post("/api/open", json=body)).status_code == 409
        assert len(told(dashboard)) == before


async def test_only_a_live_run_is_recorded_later(both: Running) -> None:
    client, _ = both
    answer = await client.post("/api/command", json={"type": "record"})
    assert answer.status_code == 422
    assert "only a live run can be recorded" in answer.text


@pytest.mark.parametrize("body", [{"uri": ""}, {"uri": "sim:stand", "odometry": "guess"}])
async def test_what_cannot_be_opened_is_refused(both: Running, body: dict[str, Any]) -> None:
    client, _ = both
    assert (await client.post("/api/open", json=body)).status_code == 422


async def test_from_the_network_only_offered_files_are_opened(tmp_path: Path) -> None:
    (tmp_path / "run.mcap").touch()
    (tmp_path / "link.mcap").symlink_to("/etc/passwd")
    settings = Settings(host="0.0.0.0", recordings=tmp_path)  # noqa: S104
    async with running(settings) as (client, dashboard):
        client.headers.update(BEARER)
        for uri, status in [
            ("sim:stand", 202),
            (str(tmp_path / "run.mcap"), 202),
            ("/etc/passwd", 403),
            (str(tmp_path / ".." / "other"), 403),
            ("nul\0byte", 403),
            (str(tmp_path / "link.mcap"), 403),
            ("~/x", 403),
            ("~nobody-of-this-name/x", 403),
            (f"file://{tmp_path / 'run.mcap'}", 202),
            ("file:///etc/passwd", 403),
            ("file:/etc/passwd", 403),
            (f"file://file://{tmp_path / 'run.mcap'}", 403),
            ("http://127.0.0.1/", 403),
        ]:
            answer = await client.post("/api/open", json={"uri": uri})
            assert answer.status_code == status, uri
            if status == 202 and not uri.startswith("sim:"):
                assert told(dashboard)[-1] == Open(str((tmp_path / "run.mcap").resolve()))


async def test_a_home_in_the_working_folder_is_not_the_home(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is looked at is what is opened: `~` is a home here as it is where files are opened."""
    (tmp_path / "~").mkdir()
    (tmp_path / "~" / "x").touch()
    (tmp_path / "file:").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", "/elsewhere")
    settings = Settings(host="0.0.0.0", recordings=tmp_path)  # noqa: S104
    assert permitted_uri("~/x", settings, any_file=False) is None
    assert permitted_uri("file:///etc/passwd", settings, any_file=False) is None
    assert permitted_uri("sim:stand", settings, any_file=False) == "sim:stand"
    assert permitted_uri("~/x", Settings(), any_file=True) == "~/x"


async def test_sources_offer_scenarios_and_recordings(tmp_path: Path) -> None:
    (tmp_path / "done").mkdir()
    for name in ("b.mcap", "a.pcap", ".hidden", "done/run.json", "written.mcap"):
        (tmp_path / name).write_bytes(b"0")
    (tmp_path / "begun.mcap").touch()
    async with running(Settings(recordings=tmp_path)) as (client, dashboard):
        dashboard.status = Status(
            "playing", recording="recording written.mcap, 0 MB", recorded_file=str(tmp_path / "written.mcap")
        )
        answer = (await client.get("/api/sources", headers=BEARER)).json()
    assert "sim:stand" in [scenario["uri"] for scenario in answer["scenarios"]]
    assert [each["uri"] for each in answer["recordings"]] == [f"{tmp_path}/a.pcap", f"{tmp_path}/b.mcap"]


def test_recordings_in_folders_are_named_by_their_path_in_the_data_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in (
        "plot/day/1.mcap",
        "plot/day/2.mcap",
        "plot/bag/metadata.yaml",
        "plot/bag/bag_0.mcap",
        "plot/bag/bag_1.mcap",
        "plot/b.pcap",
        "plot/b.txt",
        "kitti/velodyne/0.bin",
        "a/b/c/d/deep.mcap",
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"0")
    (tmp_path / "loop").symlink_to(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "gone.mcap").symlink_to(tmp_path / "nowhere.mcap")
    (tmp_path / "done").mkdir()
    for name in ("done/run.json", "done/a.laz"):
        (tmp_path / name).write_bytes(b"0")
    opener = readers.folder_opener

    def refused(folder: Path) -> object:
        if folder.name == "a":
            raise PermissionError
        return opener(folder)

    monkeypatch.setattr(readers, "folder_opener", refused)
    found = recordings([tmp_path, tmp_path / "nowhere"])
    assert [name for _, name in found] == [
        "kitti", "plot/b.pcap", "plot/bag", "plot/day/1.mcap", "plot/day/2.mcap",
    ]  # fmt: skip
    assert all(path == tmp_path / name for path, name in found)


async def test_results_before_the_first_scan_are_empty(both: Running) -> None:
    client, _ = both
    assert (await client.get("/api/trees")).json() == {"trees": []}
    assert (await client.get("/api/evaluation")).json() is None
    assert (await client.get("/api/pairs")).json()["numbers"] == []
    assert (await client.get("/api/trees.csv")).text.count("\n") == 1
    assert (await client.get("/api/path.csv")).text.count("\n") == 1


async def test_trees_and_path_as_json_and_tables(both: Running) -> None:
    client, dashboard = both
    await show(dashboard)
    trees = (await client.get("/api/trees")).json()["trees"]
    assert [tree["number"] for tree in trees] == [1, 2, 3]  # the fourth is not confirmed
    assert [tree["dbh_cm"] for tree in trees] == [30.0, None, 30.0]
    assert trees[1]["ellipse"][:2] == [0.2, 0.1]
    assert (trees[0]["first_seen_s"], trees[0]["last_seen_s"]) == (0.0, 0.1)
    table = (await client.get("/api/trees.csv")).text.splitlines()
    assert table[0].startswith("tree,x_m,y_m")
    assert len(table) == 4
    rows = (await client.get("/api/path.csv")).text.splitlines()
    assert rows[1].startswith("0.000,0.0000")
    assert len(rows) == 4


async def exported_twice(both: Running, tmp_path: Path, suffix: str) -> tuple[httpx.Response, Path]:
    """The answer of the route of an export, and the file that the command writes for the same run; before the
    first map the route refuses."""
    from app.cli import main
    from pipeline.config import Parameters
    from pipeline.io.result_files import RunFiles

    client, dashboard = both
    refused = await client.get(f"/api/export/{suffix}")
    assert (refused.status_code, "nothing is mapped" in refused.text) == (409, True)
    await show(dashboard)
    assert dashboard.shown is not None
    assert dashboard.path is not None
    source = {"uri": dashboard.source.uri, "sha256": ""}
    run = {"source": source, "seed": 0, "parameters": Parameters().model_dump()}
    more = {"terrain.csv": "x_m,y_m,z_m,sigma_m,views\n"}
    folder = tmp_path / "run"
    files = RunFiles(folder)
    files.finish(dashboard.shown.frame.trees, dashboard.path, dashboard.start_ns, run, None, more)
    file = tmp_path / "out" / f"trees.{suffix}"
    file.parent.mkdir()
    assert await asyncio.to_thread(main, ["export", str(folder), "--to", str(file)]) == 0
    reply = await client.get(f"/api/export/{suffix}")
    assert reply.status_code == 200
    return reply, file


@pytest.mark.parametrize("suffix", ["gpkg", "geojson"])
async def test_the_export_gives_the_bytes_of_the_command(both: Running, tmp_path: Path, suffix: str) -> None:
    reply, file = await exported_twice(both, tmp_path, suffix)
    assert reply.content == file.read_bytes()
    assert reply.headers["content-disposition"] == f'attachment; filename="trees.{suffix}"'


async def test_layers_for_other_programs_follow_the_run(both: Running) -> None:
    client, dashboard = both
    assert (await client.get("/api/layers/trees.geojson")).status_code == 409
    await show(dashboard)
    assert dashboard.shown is not None
    trees = await client.get("/api/layers/trees.geojson")
    assert trees.headers["content-type"].startswith("application/geo+json")
    confirmed = int(dashboard.shown.frame.trees.confirmed.sum())
    assert len(trees.json()["features"]) == confirmed > 0
    assert trees.json() == (await client.get("/api/export/geojson")).json()
    path = (await client.get("/api/layers/path.geojson")).json()
    assert path["coordinateFrame"]["type"] == "local"
    (line,) = path["features"]
    assert (line["geometry"]["type"], line["properties"]) == ("LineString", {"name": "path"})
    assert len(line["geometry"]["coordinates"]) > 1


@pytest.mark.slow
async def test_a_layer_is_made_again_only_after_a_change(
    both: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    client, dashboard = both
    await show(dashboard)
    asked, ask = list[str](), opening.ask

    async def counted(question: dict[str, Any], **options: Any) -> dict[str, Any]:
        asked.append(question["layer"])
        return await ask(question, **options)

    monkeypatch.setattr(opening, "ask", counted)
    first, second = [(await client.get("/api/layers/trees.geojson")).content for _ in range(2)]
    assert first == second
    assert asked == ["trees"]
    assert (await client.get("/api/layers/path.geojson")).content != first
    dashboard.digest = "another recording"
    assert (await client.get("/api/layers/trees.geojson")).status_code == 200
    assert asked == ["trees", "path", "trees"]


async def test_the_files_of_a_run_of_one_step_are_in_its_coordinates(both: Running) -> None:
    client, dashboard = both
    await show(dashboard)
    assert dashboard.shown is not None
    one_step = OneStep((470600.0, 3810200.0, 300.0), "EPSG:26912", 1000, [])
    await dashboard.receive(Report(Status("finished", scan_index=0, one_step=one_step)))
    assert (await client.get("/api/status")).json()["one_step"]["offset"] == [470600.0, 3810200.0, 300.0]
    x, y = dashboard.shown.frame.trees.position[0]
    row = (await client.get("/api/trees.csv")).text.splitlines()[1].split(",")
    assert [float(row[1]), float(row[2])] == pytest.approx([x + 470600.0, y + 3810200.0], abs=1e-3)
    first = (await client.get("/api/export/geojson")).json()["features"][0]
    assert first["properties"]["x_m"] == pytest.approx(x + 470600.0, abs=1e-3)
    assert first["geometry"]["coordinates"] == pytest.approx([-111.3, 34.4], abs=0.3)  # of zone 12
    trees = (await client.get("/api/trees")).json()["trees"]
    assert {tree["height_m"] for tree in trees} == {None}


@pytest.mark.parametrize("suffix", ["gpkg"])
async def test_a_child_writes_the_file_of_an_export_which_is_removed(
    both: Running, monkeypatch, tmp_path, suffix
) -> None:
    client, dashboard = both
    assert (await client.get(f"/api/export/{suffix}")).status_code == 409
    await show(dashboard)

    async def ask(question: dict[str, str], patience_s: float) -> dict[str, str]:
        file = Path(question["folder"]) / f"map.{suffix}"
        assert file.is_relative_to(tmp_path)
        assert Path(question["path"]).is_dir()
        file.write_bytes(b"the file")
        return {"file": str(file)}

    monkeypatch.setattr("app.web.routes.results.LARGE", tmp_path)
    monkeypatch.setattr("app.sources.opening.ask", ask)
    reply = await client.get(f"/api/export/{suffix}")
    assert reply.content == b"the file"
    assert reply.headers["content-disposition"] == f'attachment; filename="map.{suffix}"'
    assert list(tmp_path.iterdir()) == []


async def test_pairs_have_distances_and_errors_of_matched_trees(both: Running) -> None:
    client, dashboard = both
    await show(dashboard)
    pairs = (await client.get("/api/pairs")).json()
    assert pairs["numbers"] == [1, 2, 3]
    assert pairs["distance_m"] == [[0.0, 2.0, 4.0], [2.0, 0.0, 2.0], [4.0, 2.0, 0.0]]
    true_distance = (1.95**2 + 0.1**2) ** 0.5
    assert pairs["error_percent"][0][1] == pytest.approx(
        100 * abs(2 - true_distance) / true_distance, abs=0.01
    )
    assert pairs["error_percent"][0][2] is None
    await show(dashboard, truth=False)
    assert (await client.get("/api/pairs")).json()["error_percent"] is None


@pytest.mark.parametrize(
    "path",
    [
        "/static/../pyproject.toml",
        "/static/%2e%2e/pyproject.toml",
        "/static/..%2fpyproject.toml",
        "/static//etc/passwd",
        "/static/.hidden",
        "/static/%00",
        "/static/",
        "/static/js",
        f"/static/{'x' * 5000}",
        f"/static/{'x' * 300}/{'y/' * 3000}z",
        "/viser/index.html",
        "/docs",
        "/openapi.json",
    ],
)
async def test_nothing_else_is_served(both: Running, path: str) -> None:
    client, _ = both
    answer = await client.get(path)
    assert answer.status_code == 404
    assert answer.json()["error"]["what"]


async def test_the_page_and_its_libraries_are_served(both: Running) -> None:
    client, _ = both
    page = await client.get("/")
    assert page.headers["content-type"].startswith("text/html")
    assert page.headers["cache-control"] == "no-cache"
    plotly = await client.get("/static/plotly.min.js")
    assert "javascript" in plotly.headers["content-type"]
    assert len(plotly.content) > 1_000_000
    viser = await client.get("/viser/")
    assert "Viser" in viser.text
    assert viser.headers["cache-control"] == "no-cache"


async def test_what_a_browser_has_already_is_not_sent_again(both: Running) -> None:
    client, _ = both
    first = await client.get("/static/plotly.min.js")
    headers = {"If-None-Match": f'"other", W/{first.headers["etag"]}'}
    again = await client.get("/static/plotly.min.js", headers=headers)
    assert (again.status_code, again.content) == (304, b"")
    assert (await client.get("/", headers=headers)).status_code == 200


async def test_a_fault_is_an_answer_and_stands_in_the_log(
    both: Running, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    _, dashboard = both
    transport = httpx.ASGITransport(dashboard_app(both), raise_app_exceptions=False)
    monkeypatch.setattr(type(dashboard.parameters), "as_plain_with_specs", None)
    async with httpx.AsyncClient(transport=transport, base_url=str(both[0].base_url)) as client:
        answer = await client.get("/api/parameters", headers=BEARER)
    assert answer.status_code == 500
    assert "fault in stemmap" in answer.json()["error"]["what"]
    assert "TypeError" in caplog.text


def dashboard_app(both: Running) -> Any:
    transport = both[0]._transport
    assert isinstance(transport, httpx.ASGITransport)
    return transport.app


async def test_stories_are_told_and_refused_in_words(both: Running) -> None:
    client, dashboard = both
    refused = await client.get("/api/story/tree/3")
    assert refused.status_code == 409
    assert "nothing is mapped yet" in refused.json()["error"]["what"]
    await show(dashboard)
    worker_client = asyncio.create_task(client.get("/api/story/cluster/4?scan=231"))
    while not (asked := [m for m in told(dashboard) if isinstance(m, AskCluster)]):
        await asyncio.sleep(0.01)
    assert (asked[0].scan, asked[0].cluster) == (231, 4)
    await dashboard.receive(Answer(asked[0].ticket, cluster=cluster_story(eccentricity=float("inf"))))
    story = (await worker_client).json()
    assert story["verdict"] == "too long"
    assert story["eccentricity"] is None
    assert story["checks"][0]["title"] == "Eccentricity max"
    for wrong in ("cluster/-1", "cluster/4?scan=x", "tree/99999999999", "tree/first"):
        assert (await client.get(f"/api/story/{wrong}")).status_code == 422


async def test_a_loop_is_set_and_left_and_a_wrong_one_refused(both: Running) -> None:
    client, dashboard = both
    assert (await client.post("/api/loop", json={"from_s": 1.0, "to_s": 4.0})).status_code == 202
    assert dashboard.loop.span == (1.0, 4.0)
    for wrong in (
        {"from_s": 4.0, "to_s": 4.2},
        {"from_s": 9.0, "to_s": 1.0},
        {"from_s": -1.0, "to_s": 5.0},
        {},
    ):
        assert (await client.post("/api/loop", json=wrong)).status_code == 422
    assert dashboard.loop.span == (1.0, 4.0)
    assert (await client.post("/api/loop", json={"from_s": None, "to_s": None})).status_code == 202
    assert dashboard.loop.span is None


def numbers_of(schema: Any, where: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Every numeric schema, with its place."""
    if isinstance(schema, dict):
        if schema.get("type") in ("integer", "number") and "const" not in schema and "enum" not in schema:
            yield where, schema
        for key, part in schema.items():
            yield from numbers_of(part, f"{where}/{key}")
    elif isinstance(schema, list):
        for k, part in enumerate(schema):
            yield from numbers_of(part, f"{where}/{k}")


async def test_every_numeric_field_of_every_route_is_bounded_by_declaration() -> None:
    async with running() as (client, _):
        described = (await client.get("/api/openapi.json", headers=BEARER)).json()
        assert (await client.get("/api/openapi.json")).status_code == 401
    paths = {
        path: {
            method: {k: v for k, v in each.items() if k != "responses"} for method, each in methods.items()
        }
        for path, methods in described["paths"].items()
    }
    schemas = {name: s for name, s in described["components"]["schemas"].items() if "Validation" not in name}
    found = list(numbers_of({"paths": paths, "schemas": schemas}))
    assert len(found) > 20
    lower, upper = ("minimum", "exclusiveMinimum"), ("maximum", "exclusiveMaximum")
    unbounded = [
        place
        for place, schema in found
        if not (any(k in schema for k in lower) and any(k in schema for k in upper))
    ]
    assert unbounded == []


async def test_a_command_while_the_worker_restarts_is_answered_503(both: Running) -> None:
    client, dashboard = both

    async def refuse(_: object) -> None:
        raise WorkerBusyError("the mapping process is not ready for commands")

    dashboard.worker.send = refuse  # type: ignore[method-assign, assignment]
    answer = await client.post("/api/command", json={"type": "seek", "time_s": 1.0})
    assert (answer.status_code, answer.headers["Retry-After"]) == (503, "3")


async def test_of_two_quick_opens_the_last_is_open(both: Running) -> None:
    _, dashboard = both
    entered, go = asyncio.Event(), asyncio.Event()

    async def slow_leave() -> None:
        entered.set()
        await go.wait()

    dashboard.leaving.append(slow_leave)
    first = asyncio.create_task(dashboard.open(Open("a:")))
    await entered.wait()
    dashboard.leaving.remove(slow_leave)
    second = asyncio.create_task(dashboard.open(Open("b:")))
    await asyncio.sleep(0)
    go.set()
    await asyncio.gather(first, second)
    assert told(dashboard)[-1] == Open("b:")
    assert (dashboard.source.uri, dashboard.status.source) == ("b:", "b:")


async def test_viewers_wait_for_one_another_and_a_long_queue_is_refused(both: Running) -> None:
    client, dashboard = both
    await show(dashboard)
    viewer = {"Authorization": f"Bearer {viewer_token(TOKEN)}"}
    dashboard_app(both).state.limits.viewers = RequestQueue(0.05)
    answers = await asyncio.gather(*(client.get("/api/pairs", headers=viewer) for _ in range(12)))
    statuses = [answer.status_code for answer in answers]
    assert set(statuses) == {200, 429}
    assert all(answer.headers["Retry-After"] for answer in answers if answer.status_code == 429)
    assert (await client.get("/api/pairs")).status_code == 200  # an owner does not wait


@pytest.mark.parametrize(
    ("files", "headers", "status"),
    [
        ("", {}, 202),
        ("", {"X-Forwarded-For": "1.2.3.4"}, 403),
        ("", {"Forwarded": "for=1.2.3.4"}, 403),
        ("", {"Host": f"forest.example:{PORT}"}, 403),
        ("folders", {}, 403),
        ("any", {"X-Forwarded-For": "1.2.3.4"}, 202),
    ],
)
async def test_any_file_is_opened_from_this_machine_or_by_an_explicit_setting(
    files: Files, headers: dict[str, str], status: int
) -> None:
    async with running(Settings(files=files, hosts=("forest.example",))) as (client, _):
        body = {"uri": "/etc/hostname"}
        answer = await client.post("/api/open", headers={**BEARER, **headers}, json=body)
        assert answer.status_code == status
        poses = {"uri": "sim:stand", "odometry": "file:/etc/hostname"}
        assert (
            await client.post("/api/open", headers={**BEARER, **headers}, json=poses)
        ).status_code == status


async def test_a_set_with_deeply_nested_names_is_refused_at_once(both: Running) -> None:
    client, _ = both
    for text in (f"{'a.' * 30_000}a = 1", f"[{'a.' * 30_000}a]", f"x = {{{'a.' * 30_000}a = 1}}"):
        answer = await client.post("/api/sets/upload", json={"file": "deep.toml", "text": text})
        assert answer.status_code == 422
        assert "nested" in answer.json()["error"]["what"]
