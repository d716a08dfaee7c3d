"""Who may talk to the server: every route and every websocket, with each way of being refused."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import json
import socket
import time
from collections.abc import AsyncIterator
from contextlib import suppress
from pathlib import Path

import httpx
import pytest
import pytest_asyncio
from starlette.datastructures import Headers
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosedError, InvalidStatus

from app.common.settings import Settings
from app.common.timers import RequestQueue
from app.web.auth import (
    HEALTH,
    SESSION_S,
    AccessTokens,
    Guard,
    Role,
    allowed_hosts,
    new_token,
    session_value,
    ticket,
    viewer_token,
)
from pipeline.errors import StemmapError
from tests.app.server_for_tests import (
    BEARER,
    COOKIE,
    ENDS,
    HOST,
    PORT,
    TOKEN,
    build_app,
    routes,
    running,
    served,
)

ROUTES = [
    ("GET", "/"),
    ("GET", "/runs"),
    ("GET", "/api/access"),
    ("DELETE", "/api/access/viewer-link"),
    ("GET", "/static/plotly.min.js"),
    ("GET", "/static/index.html"),
    ("GET", "/static/no-such-file.js"),
    ("GET", "/viser/"),
    ("GET", "/api/status"),
    ("GET", "/api/parameters"),
    ("PATCH", "/api/parameters"),
    ("POST", "/api/parameters/preset"),
    ("POST", "/api/parameters/reset"),
    ("PUT", "/api/parameters/reach"),
    ("GET", "/api/parameters.toml"),
    ("GET", "/api/stages"),
    ("POST", "/api/inside"),
    ("GET", "/api/camera"),
    ("GET", "/api/camera/{stamp_ns}.jpg"),
    ("GET", "/api/camera/tree/{number}.jpg"),
    ("GET", "/api/section"),
    ("POST", "/api/compare"),
    ("GET", "/api/sets"),
    ("POST", "/api/sets"),
    ("POST", "/api/sets/use"),
    ("GET", "/api/doubts"),
    ("GET", "/api/course"),
    ("POST", "/api/sets/delete"),
    ("POST", "/api/sets/upload"),
    ("GET", "/api/sets/{name}.toml"),
    ("POST", "/api/parameters/undo"),
    ("POST", "/api/parameters/redo"),
    ("POST", "/api/command"),
    ("POST", "/api/open"),
    ("POST", "/api/loop"),
    ("PATCH", "/api/view"),
    ("GET", "/api/sources"),
    ("GET", "/api/uploads"),
    ("POST", "/api/uploads"),
    ("GET", "/api/runs"),
    ("GET", "/api/runs/{key}"),
    ("PATCH", "/api/runs/{number}"),
    ("DELETE", "/api/runs/{number}"),
    ("POST", "/api/runs/{number}/restore"),
    ("POST", "/api/runs/{key}/replay"),
    ("GET", "/api/trees"),
    ("GET", "/api/trees.csv"),
    ("GET", "/api/path.csv"),
    ("GET", "/api/export/{suffix}"),
    ("GET", "/api/layers/{layer}.geojson"),
    ("GET", "/api/evaluation"),
    ("GET", "/api/pairs"),
    ("GET", "/api/story/cluster/{number}"),
    ("GET", "/api/story/tree/{number}"),
    ("GET", "/api/annotations"),
    ("POST", "/api/annotations"),
    ("PATCH", "/api/annotations/{number}"),
    ("DELETE", "/api/annotations/{number}"),
    ("POST", "/api/annotations/undo"),
    ("POST", "/api/annotations/redo"),
    ("POST", "/api/annotations/import"),
    ("PUT", "/api/annotations/against"),
    ("GET", "/api/annotations.csv"),
    ("GET", "/api/annotations.geojson"),
    ("POST", "/api/repairs"),
    ("POST", "/api/repairs/import"),
    ("GET", "/api/repairs.json"),
    ("GET", "/no/such/route"),
]
MISSES = {("GET", "/static/index.html"), ("GET", "/static/no-such-file.js")}
SESSION = session_value(TOKEN, PORT, ENDS)
SOCKETS = ["/api/live", "/viser", "/viser/"]


@pytest_asyncio.fixture
async def client() -> AsyncIterator[httpx.AsyncClient]:
    async with running() as (client, _):
        yield client


def test_every_route_is_in_the_matrix() -> None:
    known = {(method, path) for method, path in ROUTES} | {("WS", path) for path in SOCKETS}
    known = known | {("GET", "/static/{path:path}"), ("GET", HEALTH)}
    assert routes() == known - {("GET", "/no/such/route"), *MISSES}


async def test_nobody_without_the_token(client: httpx.AsyncClient) -> None:
    for method, path in ROUTES:
        for headers in (
            {},
            {"Cookie": f"stemmap_{PORT}=wrong"},
            {"Cookie": f"stemmap_{PORT}={TOKEN}"},
            {"Cookie": f"stemmap_{PORT + 1}={SESSION}"},
            {"Cookie": f"stemmap_{PORT}={session_value(TOKEN, PORT + 1, ENDS)}"},
            {"Authorization": f"Bearer {SESSION}"},
            {"Authorization": "Bearer wrong"},
            {"Authorization": f"Basic {TOKEN}"},
            {"Cookie": f"stemmap_{PORT}={SESSION}x"},
            {"Cookie": f"stemmap_{PORT}="},
        ):
            answer = await client.request(method, path, headers=headers)
            assert answer.status_code == 401, headers
            assert answer.json()["error"]["remedy"]
        wrong = await client.request(method, f"{path}?token={TOKEN}x")
        assert wrong.status_code == 401


async def test_the_health_is_told_without_a_token_and_nothing_else_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with running() as (client, dashboard):
        assert (await client.get(HEALTH)).status_code == 200
        assert (await client.get(HEALTH)).content == b"{}"
        assert (await client.get(HEALTH, headers={"Host": "evil.example"})).status_code == 403
        assert (await client.post(HEALTH)).status_code == 401
        assert (await client.get(f"{HEALTH}/")).status_code == 401
        monkeypatch.setattr(dashboard.worker, "pid", None)
        assert (await client.get(HEALTH)).status_code == 503


@pytest.mark.parametrize("who", [COOKIE, BEARER])
async def test_who_has_the_token_is_let_in(client: httpx.AsyncClient, who: dict[str, str]) -> None:
    for method, path in ROUTES:
        answer = await client.request(method, path, headers=who)
        assert answer.status_code not in (401, 403)


@pytest.mark.parametrize(
    "host",
    ["evil.example", f"evil.example:{PORT}", f"127.0.0.1:{PORT + 1}", "127.0.0.1", f"[::2]:{PORT}", ""],
)
async def test_a_foreign_host_is_refused(client: httpx.AsyncClient, host: str) -> None:
    for method, path in ROUTES:
        answer = await client.request(method, path, headers={**BEARER, "Host": host})
        assert answer.status_code == 403


@pytest.mark.parametrize(
    "host", [f"127.0.0.1:{PORT}", f"localhost:{PORT}", f"[::1]:{PORT}", f"LocalHost:{PORT}"]
)
async def test_the_names_of_this_machine_are_known(client: httpx.AsyncClient, host: str) -> None:
    assert (await client.get("/api/status", headers={**BEARER, "Host": host})).status_code == 200


@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.example",
        "null",
        f"http://127.0.0.1:{PORT + 1}",
        f"http://localhost:{PORT}",
        "http://127.0.0.1",
    ],
)
async def test_a_foreign_origin_changes_nothing(client: httpx.AsyncClient, origin: str) -> None:
    for method, path in (r for r in ROUTES if r[0] != "GET"):
        for who in (COOKIE, BEARER):
            answer = await client.request(method, path, headers={**who, "Origin": origin})
            assert answer.status_code == 403


async def test_our_own_origin_may(client: httpx.AsyncClient) -> None:
    headers = {**COOKIE, "Origin": f"http://{HOST}"}
    answer = await client.post("/api/command", headers=headers, json={"type": "pause"})
    assert answer.status_code == 202


END = "/api/access/viewer-link"
VIEWER = {"Authorization": f"Bearer {viewer_token(TOKEN)}"}
VIEWERS_COOKIE = {"Cookie": f"stemmap_{PORT}={session_value(viewer_token(TOKEN), PORT, ENDS)}"}


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("who", [VIEWER, VIEWERS_COOKIE])
async def test_who_may_look_changes_nothing(client: httpx.AsyncClient, who: dict[str, str]) -> None:
    client._transport.app.state.limits.viewers = RequestQueue()  # type: ignore[attr-defined]
    for method, path in ROUTES:
        answer = await client.request(method, path, headers=who)
        looks = method == "GET" or path == "/api/compare"  # it asks with a body, and changes nothing
        if looks:
            assert answer.status_code not in (401, 403)
            assert TOKEN not in answer.text
        else:
            assert answer.status_code == 403
            assert answer.json()["error"]["what"] == "this is a view-only link"


async def test_the_viewers_link_becomes_a_cookie_that_looks(client: httpx.AsyncClient) -> None:
    link = (await client.get("/api/access", headers=BEARER)).json()
    viewer_link = f"/?token={viewer_token(TOKEN)}"
    assert link == {"role": "owner", "viewer_link": viewer_link, "viewers": 0}
    answer = await client.get(link["viewer_link"])
    assert answer.status_code == 303
    cookie = {"Cookie": answer.headers["set-cookie"].split(";")[0]}
    looks = {"role": "viewer", "viewer_link": None, "viewers": None}
    assert (await client.get("/api/access", headers=cookie)).json() == looks
    assert viewer_token(viewer_token(TOKEN)) not in (TOKEN, viewer_token(TOKEN))
    # Who has both may do what the stronger one may.
    both = {"Cookie": f"{VIEWERS_COOKIE['Cookie']}; {COOKIE['Cookie']}"}
    assert (await client.get("/api/access", headers=both)).json()["role"] == "owner"


@pytest.mark.slow
async def test_who_may_look_hears_and_selects_nothing() -> None:
    async with served() as (host, dashboard):
        looks = connect(f"ws://{host}/api/live", additional_headers=VIEWER, proxy=None)
        async with (
            looks as viewer,
            connect(f"ws://{host}/api/live", additional_headers=BEARER, proxy=None) as owner,
        ):
            await viewer.send('{"type": "select", "tree": 3}')
            await (await viewer.ping())  # what was sent before it is read
            await owner.send('{"type": "select", "tree": 5}')
            chosen = []
            async with asyncio.timeout(10):
                while 5 not in chosen:
                    message = json.loads(await viewer.recv())
                    if message["type"] == "selection":
                        chosen.append(message["tree"])
        assert 3 not in chosen
        assert dashboard.selector.selection.tree == 5


async def test_the_link_becomes_a_cookie_and_a_clean_address(client: httpx.AsyncClient) -> None:
    answer = await client.get(f"/?token={TOKEN}&view=top")
    assert answer.status_code == 303
    assert answer.headers["location"] == "/?view=top"
    cookie = answer.headers["set-cookie"]
    for part in (f"stemmap_{PORT}=", f"Max-Age={SESSION_S}", "HttpOnly", "SameSite=strict", "Path=/"):
        assert part in cookie
    assert TOKEN not in cookie
    assert answer.headers["referrer-policy"] == "no-referrer"
    assert TOKEN not in answer.text
    assert (await client.get("/", headers={"Cookie": cookie.split(";")[0]})).status_code == 200


async def test_the_token_in_the_address_works_for_the_page_alone(client: httpx.AsyncClient) -> None:
    assert (await client.get(f"/api/status?token={TOKEN}")).status_code == 401
    assert (await client.post(f"/?token={TOKEN}")).status_code == 401


async def test_a_person_without_a_token_reads_what_to_do(client: httpx.AsyncClient) -> None:
    answer = await client.get("/", headers={"Accept": "text/html"})
    assert answer.status_code == 401
    assert "Open the link that stemmap printed" in answer.text


async def test_our_cookie_is_found_among_others(client: httpx.AsyncClient) -> None:
    line = f"a=b; odd name=1; stemmap_{PORT}=old; stemmap_{PORT}={SESSION}"
    assert (await client.get("/api/status", headers={"Cookie": line})).status_code == 200


async def test_every_answer_is_careful(client: httpx.AsyncClient) -> None:
    for method, path in ROUTES:
        for who in ({}, BEARER):
            headers = (await client.request(method, path, headers=who)).headers
            assert headers["x-content-type-options"] == "nosniff"
            assert headers["referrer-policy"] == "no-referrer"
            policy = headers["content-security-policy"]
            assert "frame-ancestors 'self'" in policy
            assert "default-src" in policy
            if path != "/viser/":
                assert "script-src" not in policy
                assert "unsafe-eval" not in policy


@pytest.mark.parametrize("length", ["many", "-1", "1e3", ""])
async def test_a_length_that_is_no_number_is_refused(client: httpx.AsyncClient, length: str) -> None:
    headers = {**BEARER, "Content-Type": "application/json", "Content-Length": length}
    assert (await client.post("/api/open", headers=headers, content=b"{}")).status_code == 413


async def test_a_large_body_is_refused_with_and_without_its_length(client: httpx.AsyncClient) -> None:
    body = b'{"uri": "' + b"x" * 1_000_001 + b'"}'
    headers = {**BEARER, "Content-Type": "application/json"}
    assert (await client.post("/api/open", headers=headers, content=body)).status_code == 413

    async def pieces() -> AsyncIterator[bytes]:
        for start in range(0, len(body), 100_000):
            yield body[start : start + 100_000]

    answer = await client.post("/api/open", headers=headers, content=pieces())
    assert answer.status_code == 413
    assert "1000000 bytes" in answer.json()["error"]["what"]


@pytest.mark.parametrize("path", SOCKETS)
async def test_a_websocket_needs_the_token_and_our_page(path: str) -> None:
    async with served() as (host, _):
        port = host.rpartition(":")[2]
        ours = {"Origin": f"http://{host}"}
        cookie = {"Cookie": f"stemmap_{port}={session_value(TOKEN, int(port), ENDS)}"}
        refusals: list[tuple[dict[str, str], int]] = [
            ({}, 403),
            (ours, 401),
            (cookie, 403),
            ({**cookie, "Origin": "http://evil.example"}, 403),
            ({**cookie, "Origin": f"http://localhost:{port}"}, 403),
            ({**BEARER, "Origin": "null"}, 403),
            ({**ours, "Cookie": f"stemmap_{port}=wrong"}, 401),
            ({"Authorization": "Bearer wrong"}, 403),
        ]
        for headers, status in refusals:
            with pytest.raises(InvalidStatus) as refused:
                await connect(f"ws://{host}{path}", additional_headers=headers, proxy=None)
            assert refused.value.response.status_code == status, headers
        url = f"ws://localhost.evil.example:{port}{path}"
        with pytest.raises(InvalidStatus) as refused:
            await connect(url, host="127.0.0.1", additional_headers=BEARER, proxy=None)
        assert refused.value.response.status_code == 403


async def test_a_websocket_of_our_page_is_accepted() -> None:
    async with served() as (host, _):
        port = host.rpartition(":")[2]
        by_cookie = {
            "Cookie": f"stemmap_{port}={session_value(TOKEN, int(port), ENDS)}",
            "Origin": f"http://{host}",
        }
        for headers in (BEARER, by_cookie):
            async with connect(f"ws://{host}/api/live", additional_headers=headers, proxy=None) as live:
                first = json.loads(await live.recv())
                assert first["type"] in ("status", "parameters", "sets", "truth", "evaluation", "selection")


async def test_what_the_page_does_not_say_ends_the_connection() -> None:
    async with (
        served() as (host, _),
        connect(f"ws://{host}/api/live", additional_headers=BEARER, proxy=None) as live,
    ):
        await live.send('{"type": "select", "tree": "first"}')
        async with asyncio.timeout(10):
            while live.close_code is None:
                with suppress(ConnectionClosedError):
                    await live.recv()
        assert live.close_code == 1003


def test_an_open_address_is_called_by_number_or_own_name_only() -> None:
    settings = Settings(host="0.0.0.0")  # noqa: S104
    guard = Guard(build_app(), tokens=AccessTokens(TOKEN), settings=settings, port=PORT)
    assert guard._is_own_address(f"192.168.1.4:{PORT}")
    assert not guard._is_own_address(f"rebound.example:{PORT}")
    assert not guard._is_own_address(f"192.168.1.4:{PORT + 1}")
    assert f"{socket.gethostname().lower()}:{PORT}" in allowed_hosts("0.0.0.0", PORT)  # noqa: S104
    assert "robot.local:80" in allowed_hosts("127.0.0.1", 80, ["robot.local"])
    assert "robot.local" in allowed_hosts("127.0.0.1", 80, ["robot.local"])


def test_tokens_are_long_and_never_the_same() -> None:
    tokens = {new_token() for _ in range(100)}
    assert len(tokens) == 100
    assert min(map(len, tokens)) >= 32


async def test_who_comes_from_elsewhere_is_led_on_by_a_page_of_our_own(client: httpx.AsyncClient) -> None:
    """A strict cookie would not go along with a redirect that another site began."""
    query = {"token": TOKEN, "run": '"><b>'}
    answer = await client.get("/", params=query, headers={"Sec-Fetch-Site": "cross-site"})
    assert answer.status_code == 200
    assert "SameSite=strict" in answer.headers["set-cookie"]
    assert "url=/?run=%22%3E%3Cb%3E" in answer.text
    assert TOKEN not in answer.text


@pytest.mark.parametrize(
    "host",
    [
        f"127.0.0.1.evil.example:{PORT}",
        f"evil.example.127.0.0.1:{PORT}",
        f"localhost:{PORT}0",
        f"localhost:{PORT}.evil.example",
        f"xlocalhost:{PORT}",
        f"127.0.0.1:{PORT}@evil.example",
        f"user@127.0.0.1:{PORT}",
        f"127.0.0.1:{PORT} ",
        "localhost",
        f"127.0.0.11:{PORT}",
    ],
)
async def test_a_host_that_resembles_ours_is_refused(client: httpx.AsyncClient, host: str) -> None:
    guard = Guard(refusing_app, tokens=AccessTokens(TOKEN), settings=Settings(), port=PORT)
    assert not guard._knows_host(Headers({"host": host}))


@pytest.mark.parametrize(
    "origin",
    [
        f"http://{HOST}.evil.example",
        f"http://{HOST}0",
        f"http://evil.example/{HOST}",
        f"http://x{HOST}",
        f"http://{HOST}/",
        f"http://{HOST}@evil.example",
        f"ftp://{HOST}",
        f"https://localhost:{PORT}",
        "null",
        "",
    ],
)
async def test_an_origin_that_resembles_ours_is_refused(client: httpx.AsyncClient, origin: str) -> None:
    answer = await client.post("/api/command", headers={**COOKIE, "Origin": origin}, json={"type": "pause"})
    assert answer.status_code == 403


async def refusing_app(*_: object) -> None:
    raise AssertionError("nothing may pass")


async def test_a_session_expires_and_is_renewed_by_a_page_load(client: httpx.AsyncClient) -> None:
    now = int(time.time())
    for ends, status in ((now - 1, 401), (now + 60, 200)):
        cookie = {"Cookie": f"stemmap_{PORT}={session_value(TOKEN, PORT, ends)}"}
        assert (await client.get("/api/status", headers=cookie)).status_code == status
    ending = {"Cookie": f"stemmap_{PORT}={session_value(TOKEN, PORT, now + 60)}"}
    forged = {"Cookie": ending["Cookie"].replace(str(now + 60), str(now + 6000))}
    assert (await client.get("/api/status", headers=forged)).status_code == 401
    renewed = (await client.get("/", headers=ending)).headers["set-cookie"]
    assert f"Max-Age={SESSION_S}" in renewed
    assert "HttpOnly" in renewed
    fresh = {"Cookie": f"stemmap_{PORT}={session_value(TOKEN, PORT, now + SESSION_S)}"}
    assert "set-cookie" not in (await client.get("/", headers=fresh)).headers


@pytest.mark.parametrize("role", ["owner", "viewer"])
async def test_a_ticket_opens_the_page_once(client: httpx.AsyncClient, role: Role) -> None:
    token = AccessTokens(TOKEN).token(role)
    once = ticket(token, PORT, role)
    assert TOKEN not in once
    answer = await client.get(f"/?ticket={once}")
    assert (answer.status_code, answer.headers["location"]) == (303, "/")
    cookie = {"Cookie": answer.headers["set-cookie"].partition(";")[0]}
    assert (await client.get("/api/access", headers=cookie)).json()["role"] == role
    client.cookies.clear()
    assert (await client.get(f"/?ticket={once}")).status_code == 401
    as_owner = ticket(viewer_token(TOKEN), PORT, "owner")  # what a viewer could sign
    for wrong in (
        ticket(token, PORT + 1, role),
        ticket("x" * 20, PORT, role),
        as_owner,
        once[:-1],
        "",
        "a.b.c.d",
    ):
        assert (await client.get(f"/?ticket={wrong}")).status_code == 401


async def test_an_ended_link_and_its_sessions_are_refused_and_the_new_one_works(
    client: httpx.AsyncClient,
) -> None:
    once = ticket(viewer_token(TOKEN), PORT, "viewer")
    assert (await client.delete(END, headers=VIEWER)).status_code == 403
    assert (await client.get("/api/status", headers=VIEWER)).status_code == 200, "a viewer ends nothing"
    ended = await client.delete(END, headers=COOKIE)
    assert ended.status_code == 200
    assert ended.json() == (await client.get("/api/access", headers=COOKIE)).json()
    for who in (VIEWER, VIEWERS_COOKIE):
        assert (await client.get("/api/status", headers=who)).status_code == 401
        assert (await client.delete(END, headers=who)).status_code == 401
    for old in (f"/?token={viewer_token(TOKEN)}", f"/?ticket={once}"):
        assert (await client.get(old)).status_code == 401
    for who in (COOKIE, BEARER):
        assert (await client.get("/api/access", headers=who)).json()["role"] == "owner"
    opened = await client.get(ended.json()["viewer_link"])
    assert opened.status_code == 303
    cookie = {"Cookie": opened.headers["set-cookie"].split(";")[0]}
    assert (await client.get("/api/access", headers=cookie)).json()["role"] == "viewer"


async def test_pages_of_an_ended_link_are_closed_and_those_of_owners_stay() -> None:
    async with served() as (host, _), httpx.AsyncClient(base_url=f"http://{host}", headers=BEARER) as client:
        url = f"ws://{host}/api/live"
        async with (
            connect(url, additional_headers=VIEWER, proxy=None) as viewer,
            connect(url, additional_headers=BEARER, proxy=None) as owner,
        ):
            await viewer.recv()
            assert (await client.get("/api/access")).json()["viewers"] == 1
            ended = (await client.delete(END)).json()
            assert ended["viewers"] == 0
            async with asyncio.timeout(10):
                await viewer.wait_closed()
            assert viewer.close_code == 1008
            await (await owner.ping())
        with pytest.raises(InvalidStatus) as refused:
            await connect(url, additional_headers=VIEWER, proxy=None)
        assert refused.value.response.status_code == 403  # without an Origin and a valid token
        again = {"Authorization": f"Bearer {ended['viewer_link'].partition('=')[2]}"}
        async with connect(url, additional_headers=again, proxy=None) as viewer:
            await viewer.recv()


async def test_an_ended_link_stays_ended_after_a_restart_with_the_same_token(tmp_path: Path) -> None:
    settings = Settings(token=TOKEN, folder=tmp_path / "new")
    tokens = AccessTokens.of(settings)
    assert (tokens.owner, tokens.viewer) == (TOKEN, viewer_token(TOKEN))
    await asyncio.gather(tokens.end_viewer_link(), tokens.end_viewer_link())
    assert tokens.viewer != viewer_token(TOKEN)
    again = AccessTokens.of(settings)
    assert (again.owner, again.viewer) == (TOKEN, tokens.viewer)
    # A new owner's token has a new view-only link.
    fresh = AccessTokens.of(Settings(folder=tmp_path))
    await fresh.end_viewer_link()
    assert [path.name for path in tmp_path.iterdir()] == ["new"]


async def test_a_link_ends_even_if_this_cannot_be_saved(tmp_path: Path) -> None:
    tokens = AccessTokens(TOKEN, tmp_path / "file" / "view-only-link")
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(StemmapError, match="cannot be saved"):
        await tokens.end_viewer_link()
    assert tokens.viewer != viewer_token(TOKEN)
    with pytest.raises(StemmapError, match="cannot be read"):
        AccessTokens(TOKEN, tmp_path)


async def test_the_page_for_an_invalid_link_permits_its_own_style_only(client: httpx.AsyncClient) -> None:
    answer = await client.get("/?token=old", headers={"Accept": "text/html"})
    assert answer.status_code == 401
    style = answer.text.partition("<style>")[2].partition("</style>")[0]
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    assert answer.headers.get_list("content-security-policy") == [
        f"default-src 'none'; style-src 'sha256-{digest}'; frame-ancestors 'self'"
    ]
    other = await client.get("/api/status", headers=BEARER)
    assert other.headers["content-security-policy"] == "default-src 'none'; frame-ancestors 'self'"
