"""A fleet in process, with fake workers: who may see it, what it tells, and how it ends."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

import app.extensions.fleet.fleet as fleet_module
from app.common.settings import Settings
from app.dashboard.run_recorder import _Page
from app.extensions.fleet.fleet import Fleet, Frames, build_fleet, warm_kernels
from app.extensions.fleet.members import named
from app.sources.request import SourceRequest
from app.store.records import NewRun
from app.web.auth import AccessTokens, viewer_token
from app.web.serving import bind
from app.worker.protocol import Open
from tests.app.fake_scene import FakeScene
from tests.app.fakes import FakeWorker
from tests.app.server_for_tests import TOKEN

SETTINGS = Settings(port=0)


def make(port: int, settings: Settings = SETTINGS, tokens: AccessTokens | None = None) -> Fleet:
    return Fleet(
        settings,
        port,
        tokens or AccessTokens(TOKEN),
        make_scene=lambda _dashboard, _loop: FakeScene(),
        make_worker=FakeWorker,
    )


@asynccontextmanager
async def served(*names: str) -> AsyncIterator[tuple[str, Fleet]]:
    """The page of a fleet on a real port; gives `host:port`."""
    import uvicorn

    from app.web.serving import uvicorn_config

    listening = bind(SETTINGS)
    port = listening.getsockname()[1]
    tokens = AccessTokens(TOKEN)
    fleet = make(port, tokens=tokens)
    for name in names:
        assert fleet.add(name, Open(f"fake:{name}"))
    app = build_fleet(SETTINGS, port=port, tokens=tokens, fleet=fleet)
    server = uvicorn.Server(uvicorn_config(app))
    task = asyncio.create_task(server._serve([listening]))
    async with asyncio.timeout(60):
        while not (server.started and all(member.started for member in fleet.members.values())):
            await asyncio.sleep(0.01)
    try:
        yield f"127.0.0.1:{port}", fleet
    finally:
        server.should_exit = True
        await task
        listening.close()


async def test_each_robot_has_a_card_and_a_dashboard_of_its_own():
    async with served("red", "blue") as (host, fleet), httpx.AsyncClient() as client:
        bearer = {"Authorization": f"Bearer {TOKEN}"}
        page = await client.get(f"http://{host}/", headers=bearer)
        assert page.status_code == 200
        assert "default-src 'self'" in page.headers["content-security-policy"]
        async with connect(f"ws://{host}/api/fleet", additional_headers=bearer) as browser:
            async with asyncio.timeout(60):
                told: dict[str, Any] = {}
                while not all(member["source"] for member in told.get("members", [{"source": ""}])):
                    told = json.loads(await browser.recv())
        assert [member["name"] for member in told["members"]] == ["red", "blue"]
        assert [member["source"] for member in told["members"]] == ["fake:red", "fake:blue"]
        ports = [fleet.members[name].port for name in ("red", "blue")]
        assert len({*ports, int(host.partition(":")[2])}) == 3
        lead = await client.get(f"http://{host}/robots/blue", headers=bearer)
        assert lead.status_code == 303
        assert lead.headers["location"].startswith(f"http://127.0.0.1:{ports[1]}/?ticket=owner.")
        assert TOKEN not in lead.headers["location"]
        assert lead.headers["referrer-policy"] == "no-referrer"
        back = await client.get(f"http://127.0.0.1:{ports[1]}/robots", headers=bearer)
        assert back.status_code == 303
        assert back.headers["location"].startswith(f"http://{host}/?ticket=owner.")
        looking = {"Authorization": f"Bearer {viewer_token(TOKEN)}"}
        back = await client.get(f"http://127.0.0.1:{ports[1]}/robots", headers=looking)
        assert back.headers["location"].startswith(f"http://{host}/?ticket=viewer.")
        for place, robots in ((f"127.0.0.1:{ports[0]}", "/robots"),):
            link = await client.get(f"http://{place}/api/fleet", headers=bearer)
            assert link.json()["page"] == robots
        own = await client.get(lead.headers["location"], follow_redirects=True)
        assert own.status_code == 200
        assert "2D map" in own.text
        assert fleet.members["blue"].dashboard is not fleet.members["red"].dashboard


async def test_only_who_holds_the_token_comes_in():
    async with served("red") as (host, fleet), httpx.AsyncClient() as client:
        port = fleet.members["red"].port
        looking = {"Authorization": f"Bearer {viewer_token(TOKEN)}"}
        bearer = {"Authorization": f"Bearer {TOKEN}"}
        for path in ("/", "/robots/red", "/api/access", "/static/js/extensions/fleet/robots.js"):
            assert (await client.get(f"http://{host}{path}")).status_code == 401
            wrong = {**bearer, "Host": "evil.example"}
            assert (await client.get(f"http://{host}{path}", headers=wrong)).status_code == 403
        lead = await client.get(f"http://{host}/robots/red", headers=looking)
        assert f":{port}/?ticket=viewer." in lead.headers["location"]
        for name in ("green", "..%2Fred", "%00", "a" * 3000):
            assert (await client.get(f"http://{host}/robots/{name}", headers=bearer)).status_code == 404
        for headers in ({}, {**bearer, "Origin": "http://evil.example"}):
            with pytest.raises(InvalidStatus):
                async with connect(f"ws://{host}/api/fleet", additional_headers=headers):
                    pass
        async with connect(f"ws://{host}/api/fleet", additional_headers=bearer) as browser:
            await browser.send("{}")
            async with asyncio.timeout(30):
                await browser.wait_closed()
        assert browser.close_code == 1003


async def test_the_view_only_link_of_a_fleet_ends_on_all_its_pages():
    async with served("red", "blue") as (host, fleet), httpx.AsyncClient() as client:
        dashboards = [f"127.0.0.1:{fleet.members[name].port}" for name in ("red", "blue")]
        bearer = {"Authorization": f"Bearer {TOKEN}"}
        looking = {"Authorization": f"Bearer {viewer_token(TOKEN)}"}
        lead = await client.get(f"http://{host}/robots/red", headers=looking)
        async with (
            connect(f"ws://{host}/api/fleet", additional_headers=looking) as page,
            connect(f"ws://{host}/api/fleet", additional_headers=bearer) as page_of_owner,
        ):
            access = (await client.get(f"http://{dashboards[0]}/api/access", headers=bearer)).json()
            assert access["viewers"] == 1
            url = f"http://{dashboards[0]}/api/access/viewer-link"
            assert (await client.delete(url, headers=bearer)).status_code == 200
            async with asyncio.timeout(30):
                await page.wait_closed()
            assert page.close_code == 1008
            await (await page_of_owner.ping())
        assert (await client.get(lead.headers["location"])).status_code == 401, "a ticket of a viewer"
        for place in (host, *dashboards):
            assert (await client.get(f"http://{place}/api/access", headers=looking)).status_code == 401
            assert (await client.get(f"http://{place}/api/access", headers=bearer)).status_code == 200


async def test_all_end_with_the_page_and_free_their_ports():
    async with served("red", "blue") as (_, fleet):
        ports = [member.port for member in fleet.members.values()]
        workers = [member.dashboard.worker for member in fleet.members.values()]
    assert all(isinstance(worker, FakeWorker) and worker.closed for worker in workers)
    for port in ports:
        bind(Settings(port=port)).close()


async def test_what_has_no_room_is_said(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(fleet_module, "MOST_ROBOTS", 1)
    async with served("red") as (_, fleet):
        assert fleet.add("red", Open("fake:red")), "the same is no other"
        assert not fleet.add("blue", Open("fake:blue"))
        assert "more than 1 robots; blue" in fleet.notice
        fleet.send_cards()
        (_, told), *_ = [m for m in fleet.live.messages_after(0) if b'"fleet"' in m[1]]
        assert json.loads(told)["notice"] == fleet.notice


def test_runs_are_named_by_their_files_and_record_apart():
    runs = [
        Open(uri, record="/data/live.mcap") for uri in ("/a/run.mcap", "/b/run.mcap", "sim:stand?drive=1")
    ]
    found = named(runs)
    assert list(found) == ["run", "run (2)", "sim:stand?drive=1"]
    assert len({source.record for source in found.values()}) == 3
    assert {Path(source.record).parent for source in found.values()} == {Path("/data")}
    assert next(iter(named(runs[:1]).values())).record == "/data/live.mcap"


def test_robots_are_named_by_their_whole_address():
    uris = ("zenoh:tcp/192.168.1.5:7447", "zenoh:tcp/192.168.1.6:7447", "velodyne:192.168.1.201")
    assert list(named([Open(uri) for uri in uris])) == [
        "192.168.1.5:7447",
        "192.168.1.6:7447",
        "velodyne:192.168.1.201",
    ]


async def begun(fleet: Fleet, name: str) -> None:
    async with asyncio.timeout(60):
        while not fleet.members[name].started:
            await asyncio.sleep(0.01)


async def test_robots_begin_when_what_they_need_is_compiled():
    compiled = asyncio.Event()

    async def warm() -> None:
        await compiled.wait()

    fleet = Fleet(
        SETTINGS,
        40000,
        AccessTokens(TOKEN),
        make_scene=lambda _dashboard, _loop: FakeScene(),
        make_worker=FakeWorker,
        warm=warm,
    )
    assert fleet.add("red", Open("fake:red"))
    fleet.start()
    await asyncio.sleep(0.05)
    fleet.send_cards()
    (_, told), *_ = [m for m in fleet.live.messages_after(0) if b'"fleet"' in m[1]]
    (card,) = json.loads(told)["members"]
    assert (card["state"], card["source"]) == ("starting", "fake:red")
    assert "compiles" in card["detail"]
    assert not card["answers"]
    assert not fleet.members["red"].started
    app = build_fleet(SETTINGS, port=40000, tokens=AccessTokens(TOKEN), fleet=fleet)
    bearer = {"Authorization": f"Bearer {TOKEN}"}
    page = httpx.ASGITransport(app)
    async with httpx.AsyncClient(transport=page, base_url="http://127.0.0.1:40000", headers=bearer) as client:
        refused = await client.get("/robots/red")
        assert refused.status_code == 503
        assert "does not answer" in refused.json()["error"]["what"]
        compiled.set()
        await begun(fleet, "red")
        assert (await client.get("/robots/red")).status_code == 303
    assert fleet.members["red"].answers
    assert fleet.add("blue", Open("fake:blue"))
    await begun(fleet, "blue")
    await fleet.close()


@pytest.mark.parametrize("code", ["pass", "raise SystemExit(3)"])
async def test_compiling_may_fail_and_is_waited_for(code: str):
    await warm_kernels([sys.executable, "-c", code])


async def test_a_fleet_that_ends_while_it_compiles_leaves_nothing():
    forever = [sys.executable, "-c", "import time; time.sleep(1000)"]
    waiting = Fleet(SETTINGS, 40000, AccessTokens(TOKEN), warm=lambda: warm_kernels(forever))
    waiting.add("red", Open("fake:red"))
    waiting.start()
    await asyncio.sleep(0.05)
    await waiting.close()


async def test_a_map_that_cannot_be_aligned_is_logged_and_the_fleet_still_ends(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    async def broken(_frames: Frames, _maps: object) -> bool:
        raise OSError("no process")

    monkeypatch.setattr(Frames, "try_one", broken)
    fleet = make(40000)
    fleet.start()
    async with asyncio.timeout(60):
        while "could not be aligned" not in caplog.text:
            await asyncio.sleep(0.01)
    await fleet.close()


async def test_a_task_that_had_failed_hinders_no_end(caplog: pytest.LogCaptureFixture):
    async def broken() -> None:
        raise OSError("no process")

    fleet = make(40000)
    fleet._aligning = asyncio.create_task(broken(), name="frames")
    await asyncio.wait([fleet._aligning])
    await fleet.close()
    assert "frames had ended with a fault" in caplog.text


async def test_a_run_that_is_open_in_any_dashboard_is_not_deleted():
    async with served("red", "blue") as (_, fleet), httpx.AsyncClient() as client:
        red, blue = fleet.members.values()
        blue.dashboard.run_recorder._page = _Page(
            NewRun(0, "run", "fake", SourceRequest("fake:blue")), 3, record=7
        )
        for member, words in ((red, "of another robot"), (blue, "is open")):
            place = f"http://127.0.0.1:{member.port}/api/runs/7"
            refused = await client.delete(place, headers={"Authorization": f"Bearer {TOKEN}"})
            assert refused.status_code == 409
            assert words in refused.json()["error"]["what"]
