"""The open run of a dashboard is located in the map of a stored run."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from app.common.settings import Settings
from app.extensions.maps import page
from app.extensions.maps.localisation import StoredMap
from app.extensions.maps.page import Locating
from app.extensions.maps.stored_map import read_stored_map, write_stored_map
from pipeline.errors import StemmapError
from pipeline.geometry.poses import Pose2
from tests.app.batch.finished_runs import write_run
from tests.app.extensions.maps.localisation.stands import stand, trees_at
from tests.app.server_for_tests import BEARER, running


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(60):
        while not condition():
            await asyncio.sleep(0.02)


def shown(stamp_ns: int, place: np.ndarray, T_odom_base: Pose2, run: int = 1) -> Any:
    """A shown scan with a map of trees."""
    frame = SimpleNamespace(
        stamp_ns=stamp_ns,
        estimate=SimpleNamespace(T_map_base=T_odom_base),
        trees=trees_at(place, stamp_ns),
        detections=None,
        ground=None,
        base_z=0.0,
        of_drive=True,
    )
    return SimpleNamespace(run=run, frame=frame)


def dashboard() -> Any:
    """A dashboard that has shown nothing yet."""
    parameters = SimpleNamespace(relocalisation=SimpleNamespace(slack=0.1))
    return SimpleNamespace(
        run=1,
        shown=None,
        status=SimpleNamespace(state="playing"),
        parameters=SimpleNamespace(parameters=parameters),
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A finished run with the map of a stand."""
    place = stand(1, side=60.0)
    return Path(write_run(tmp_path / "stand", place, np.full(len(place), 0.3)))


async def test_it_is_found_told_and_forgotten(folder, monkeypatch):
    monkeypatch.setattr(page, "PAUSE_S", 0.01)
    told: list[dict[str, Any]] = []
    here = dashboard()
    locating = Locating(here, told.append)
    assert locating.as_plain()["state"] == "idle"
    await locating.begin("stand", folder)
    begun = {"name": "stand", "serial": 1, "state": "searching", "text": "not found yet", "pose": None}
    assert told[-1] == begun
    true = Pose2(30.0, 30.0, 0.5)  # of the open run in the stored map
    place = stand(1, side=60.0)
    near = place[np.hypot(*(place - 30.0).T) < 14.0]
    here.shown = shown(1_000_000_000, true.inverse().apply(near), Pose2())
    await until(lambda: told[-1]["state"] == "found")
    assert told[-1]["text"].startswith("found: ")
    assert told[-1]["pose"] == pytest.approx(true.inverse().as_array().tolist(), abs=0.05)
    here.run = 2  # another run is opened, and nothing of it is shown yet
    await until(lambda: told[-1]["state"] == "searching")
    here.shown = shown(1_000_000_000, true.inverse().apply(near), Pose2(), run=2)
    await until(lambda: told[-1]["state"] == "found")
    await locating.forget()
    assert told[-1]["state"] == "idle"
    await locating.close()


@pytest.mark.parametrize("state", ["finished", "failed"])
async def test_at_the_end_of_the_run_it_is_not_searched_any_more(folder, monkeypatch, state):
    monkeypatch.setattr(page, "PAUSE_S", 0.01)
    told: list[dict[str, Any]] = []
    here = dashboard()
    locating = Locating(here, told.append)
    await locating.begin("stand", folder)
    here.shown = shown(1_000_000_000, np.array([[3.0, 2.0]]), Pose2())
    here.status.state = state
    await until(lambda: told[-1]["state"] == "not_found")
    assert told[-1]["text"] == "not found in 0 m of driving; play the run again to search more of it"
    await locating.close()


async def test_the_end_is_told_after_the_last_scan_was_searched(folder, monkeypatch):
    monkeypatch.setattr(page, "PAUSE_S", 0.01)
    told: list[dict[str, Any]] = []
    here = dashboard()
    place = stand(1, side=60.0) - 30.0
    newest = shown(2_000_000_000, place[np.hypot(*place.T) < 14.0], Pose2())
    locate = Locating._locate

    async def slow(self: Locating, stored: StoredMap, frame: Any, last: int) -> int:
        """The run ends with a further scan while this one is searched."""
        stamp_ns = await locate(self, stored, frame, last)
        here.shown, here.status.state = newest, "finished"
        return stamp_ns

    monkeypatch.setattr(Locating, "_locate", slow)
    locating = Locating(here, told.append)
    await locating.begin("stand", folder)
    here.shown = shown(1_000_000_000, np.array([[3.0, 2.0]]), Pose2())
    await until(lambda: told[-1]["state"] == "found")
    assert "not_found" not in [each["state"] for each in told]
    await locating.close()


async def test_two_maps_of_one_name_differ(folder):
    told: list[dict[str, Any]] = []
    locating = Locating(dashboard(), told.append)
    for _ in range(2):
        await locating.begin("stand", folder)
    assert told[0]["serial"] != told[1]["serial"]
    await locating.close()


async def test_a_fault_is_told_until_another_run_is_opened(folder, monkeypatch):
    monkeypatch.setattr(page, "PAUSE_S", 0.01)
    told: list[dict[str, Any]] = []
    here = dashboard()
    locating = Locating(here, told.append)
    await locating.begin("stand", folder)
    bad = shown(1_000_000_000, np.zeros((0, 2)), Pose2())
    bad.frame.trees = None
    here.shown = bad
    await until(lambda: told[-1]["state"] == "failed")
    assert told[-1]["text"].startswith("the localisation failed")
    assert told[-1]["pose"] is None
    here.run, here.shown = 2, None
    await until(lambda: told[-1]["state"] == "searching")
    await locating.close()


async def test_two_at_once_leave_one_that_can_be_ended(folder):
    locating = Locating(dashboard(), lambda _: None)
    before = asyncio.all_tasks()
    await locating.begin("first", folder)
    await asyncio.gather(*(locating.begin(name, folder) for name in ("a", "b", "c")))
    assert len(asyncio.all_tasks() - before) == 1
    await locating.forget()
    assert asyncio.all_tasks() == before


async def test_a_map_without_trees_is_refused(tmp_path):
    empty = write_run(tmp_path / "empty", np.zeros((0, 2)), np.zeros(0))
    locating = Locating(dashboard(), lambda _: None)
    with pytest.raises(StemmapError, match="no trees"):
        await locating.begin("empty", empty)
    assert locating.as_plain()["state"] == "idle"


async def test_routes(folder):
    async with running(Settings(recordings=folder.parent)) as (client, _):
        client.headers.update(BEARER)
        assert (await client.post("/api/localise", json={"run": "folder:none"})).status_code == 404
        begun = await client.post("/api/localise", json={"run": "folder:stand"})
        assert begun.status_code == 202, begun.text
        assert begun.json()["state"] == "searching"
        got = (await client.get("/api/localise")).json()
        assert len(got["stems"]) == len(stand(1, side=60.0))
        assert (await client.delete("/api/localise")).json()["state"] == "idle"
        assert (await client.get("/api/localise")).json()["stems"] == []


def test_what_is_neither_a_file_nor_a_folder_is_refused_without_reading_it(tmp_path):
    os.mkfifo(tmp_path / "pipe.stems")
    for path in (tmp_path / "pipe.stems", Path("/dev/zero")):
        with pytest.raises(StemmapError, match="not a stored map"):
            read_stored_map(path)


async def test_the_home_of_an_unknown_user_is_no_folder(tmp_path):
    async with running(Settings(recordings=tmp_path, files="any")) as (client, _):
        answer = await client.post("/api/localise", json={"path": "~no-such-user/map"}, headers=BEARER)
        assert answer.status_code == 409
        assert "there is no such folder or file" in answer.text


async def test_a_folder_or_a_file_of_the_server_is_a_stored_map(folder, tmp_path_factory):
    stored, outside = read_stored_map(folder), tmp_path_factory.mktemp("outside")
    for place in (folder.parent, outside):
        write_stored_map(stored, place / "stand.stems")
    (folder.parent / "run.mcap").write_bytes(b"\x89MCAP0\r\n")
    (folder.parent / "link.stems").symlink_to(outside / "stand.stems")
    settings = Settings(recordings=folder.parent, files="folders")
    async with running(settings) as (client, _):
        client.headers.update(BEARER)

        async def begun(path: Path | str) -> Any:
            return await client.post("/api/localise", json={"path": str(path)})

        listed = (await client.get("/api/localise/files")).json()["files"]
        assert listed == [str(folder.parent / "stand.stems")]
        for path in (folder, folder.parent / "stand.stems", f"file://{folder}"):
            answer = await begun(path)
            assert answer.status_code == 202, answer.text
            assert answer.json()["name"] == Path(path).name
        for path in (outside / "stand.stems", folder.parent / "link.stems", "\0", "~nobody/map"):
            assert (await begun(path)).status_code == 403, path
        for path in (folder.parent / "none", folder.parent / "run.mcap", folder.parent):
            refused = await begun(path)
            assert refused.status_code == 409, path
            assert ".stems" in refused.json()["error"]["remedy"]
