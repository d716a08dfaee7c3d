"""The bridge carries viser's messages both ways, and nothing that a browser should not say."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import httpx
import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from websockets.asyncio.client import ClientConnection, connect
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.http11 import Request, Response
from websockets.typing import Subprotocol

from app.web.auth import viewer_token
from app.web.viser_proxy import LARGEST, is_allowed
from tests.app.fake_scene import FakeScene
from tests.app.server_for_tests import BEARER, TOKEN, served

VERSION = Subprotocol("viser-v1.1.1")

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1, 0, 0, 0],
    "position": [0, 0.5, 1],
    "fov": 1.2,
    "near": 0.1,
    "far": 1000,
    "image_height": 640,
    "image_width": 800,
    "look_at": [0, 0, 0],
    "up_direction": [0, 0, 1],
}
SLIDER = {"type": "GuiUpdateMessage", "uuid": "a-b", "updates": {"value": 0.25}}
CLICK = {
    "type": "SceneNodeClickMessage",
    "name": "/trees",
    "instance_index": 4,
    "ray_origin": [0, 0, 1],
    "ray_direction": [1, 0, 0],
    "screen_pos": [0.5, 0.5],
    "modifier": None,
    "owner": "",
}
COMMAND = {"type": "CommandTriggerMessage", "uuid": "follow"}


def pack(message: object) -> bytes:
    return msgspec.msgpack.encode(message)


@pytest.mark.parametrize("message", [CAMERA, SLIDER, CLICK, COMMAND])
def test_what_the_page_needs_is_allowed(message: dict[str, Any]) -> None:
    assert is_allowed(pack(message))


@pytest.mark.parametrize(
    "message",
    [
        {"type": "ShareUrlRequest"},
        {"type": "ShareUrlDisconnect"},
        {
            "type": "FileTransferStartUpload",
            "source_component_uuid": "a",
            "transfer_uuid": "b",
            "filename": "x",
            "mime_type": "y",
            "part_count": 1,
            "size_bytes": 10**15,
        },
        {"type": "RunJavascriptMessage", "source": "alert(1)"},
        {"type": "GetRenderResponseMessage", "payload": b"x", "render_uuid": "y"},
        {"type": "RemoveSceneNodeMessage", "name": "/"},
        {"type": "ViewerCameraMessage"},
        {**CAMERA, "fov": float("nan")},
        {**CAMERA, "position": [0, 0, float("inf")]},
        {**CAMERA, "wxyz": [1, 0, 0]},
        {**CAMERA, "image_width": 10**9},
        {**CAMERA, "more": 1},
        {**SLIDER, "updates": {"value": float("nan")}},
        {**SLIDER, "updates": {"value": {"nested": 1}}},
        {**SLIDER, "updates": {"min": 0}},
        {**SLIDER, "updates": {"value": 1, "_impl": 2}},
        {**SLIDER, "updates": {"value": "x" * 3000}},
        {**SLIDER, "updates": {}},
        {**CLICK, "instance_index": -1},
        {},
        [],
        5,
    ],
)
def test_all_else_is_dropped(message: object) -> None:
    assert not is_allowed(pack(message))


def test_a_large_message_is_dropped_unread() -> None:
    assert not is_allowed(pack(SLIDER) + b"\0" * LARGEST)


@given(st.binary(max_size=300))
def test_any_bytes_are_judged_without_an_error(content: bytes) -> None:
    assert not is_allowed(content)


@asynccontextmanager
async def fake_viser(
    handler: Callable[[ServerConnection], Any],
) -> AsyncIterator[FakeScene]:
    """A server that speaks viser's subprotocol and refuses who does not know the secret."""

    def check(connection: ServerConnection, request: Request) -> Response | None:
        known = request.headers.get("X-Stemmap-Secret") == "secret"
        return None if known else connection.respond(403, "no")

    async with serve(
        handler, "127.0.0.1", 0, subprotocols=[VERSION], process_request=check, compression=None
    ) as server:
        yield FakeScene(next(iter(server.sockets)).getsockname()[1])


def browser(host: str, **options: Any) -> connect:
    options.setdefault("subprotocols", [VERSION])
    return connect(f"ws://{host}/viser", additional_headers=BEARER, proxy=None, **options)


async def test_messages_pass_both_ways_and_forbidden_ones_do_not() -> None:
    heard: asyncio.Queue[bytes | str] = asyncio.Queue()

    async def handler(connection: ServerConnection) -> None:
        await connection.send(b"\0" * 2_000_000)
        async for message in connection:
            heard.put_nowait(message)

    async with fake_viser(handler) as scene, served(scene) as (host, _):
        async with browser(host, max_size=None) as page:
            assert page.subprotocol == VERSION
            assert await page.recv() == b"\0" * 2_000_000
            for message in (pack({"type": "ShareUrlRequest"}), "text", b"\xc1", pack(SLIDER)):
                await page.send(message)
            async with asyncio.timeout(10):
                assert await heard.get() == pack(SLIDER)
        assert heard.empty()


@pytest.mark.parametrize("message", [SLIDER, CLICK, COMMAND])
def test_who_may_look_moves_the_camera_alone(message: dict[str, Any]) -> None:
    assert is_allowed(pack(CAMERA), looks_only=True)
    assert not is_allowed(pack(message), looks_only=True)


async def test_a_viewers_messages_stop_at_the_bridge() -> None:
    heard: asyncio.Queue[bytes | str] = asyncio.Queue()

    users: list[str] = []

    async def handler(connection: ServerConnection) -> None:
        assert connection.request is not None
        users.append(connection.request.headers["X-Stemmap-User"])
        async for message in connection:
            heard.put_nowait(message)

    looks = {"Authorization": f"Bearer {viewer_token(TOKEN)}"}
    named = {**BEARER, "Cookie": "stemmap_name=Ann"}
    async with fake_viser(handler) as scene, served(scene) as (host, _):
        at = f"ws://{host}/viser"
        async with connect(at, additional_headers=looks, proxy=None, subprotocols=[VERSION]) as page:
            for message in (SLIDER, CLICK, COMMAND, CAMERA):
                await page.send(pack(message))
            async with asyncio.timeout(10):
                assert await heard.get() == pack(CAMERA)
        assert heard.empty()
        async with connect(at, additional_headers=named, proxy=None, subprotocols=[VERSION]) as page:
            await page.send(pack(SLIDER))
            async with asyncio.timeout(10):
                assert await heard.get() == pack(SLIDER)
    assert users == ["somebody", "Ann"]


async def test_the_scene_of_an_ended_view_only_link_is_closed() -> None:
    gone = asyncio.Event()

    async def handler(connection: ServerConnection) -> None:
        await connection.send(b"hello")
        await closed(connection)
        gone.set()

    looks = {"Authorization": f"Bearer {viewer_token(TOKEN)}"}
    async with (
        fake_viser(handler) as scene,
        served(scene) as (host, _),
        connect(f"ws://{host}/viser", additional_headers=looks, proxy=None, subprotocols=[VERSION]) as page,
    ):
        assert await page.recv() == b"hello"
        async with httpx.AsyncClient(headers=BEARER) as client:
            assert (await client.get(f"http://{host}/api/access")).json()["viewers"] == 0, "not a page"
            await client.delete(f"http://{host}/api/access/viewer-link")
        await closed(page)
        assert page.close_code == 1008
        async with asyncio.timeout(10):
            await gone.wait()


async def closed(connection: ClientConnection | ServerConnection) -> None:
    async with asyncio.timeout(10):
        await connection.wait_closed()


async def test_when_viser_leaves_the_browser_is_let_go() -> None:
    async def handler(connection: ServerConnection) -> None:
        await connection.send(b"last")

    async with fake_viser(handler) as scene, served(scene) as (host, _), browser(host) as page:
        assert await page.recv() == b"last"
        with pytest.raises(ConnectionClosed):
            await page.recv()


async def test_when_the_browser_leaves_viser_is_let_go() -> None:
    gone = asyncio.Event()

    async def handler(connection: ServerConnection) -> None:
        await connection.send(b"hello")
        await closed(connection)
        gone.set()

    async with fake_viser(handler) as scene, served(scene) as (host, _):
        async with browser(host) as page:
            await page.recv()
        async with asyncio.timeout(10):
            await gone.wait()


async def test_a_slow_browser_holds_viser_back() -> None:
    sent = 0

    async def handler(connection: ServerConnection) -> None:
        nonlocal sent
        for _ in range(400):
            await connection.send(b"\0" * 500_000)
            sent += 1

    async with (
        fake_viser(handler) as scene,
        served(scene) as (host, _),
        browser(host, max_size=None, max_queue=1) as page,
    ):
        for received in range(100):
            await page.recv()
            for _ in range(50):  # viser gets its chances to run ahead
                await asyncio.sleep(0)
            assert sent - received < 60  # 30 MB in sockets and queues, of 200
        page.transport.abort()


async def test_more_browsers_than_the_machine_can_bear_are_sent_away(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.web.routes.access.MOST", {"owner": 2, "viewer": 2})

    async def handler(connection: ServerConnection) -> None:
        await connection.send(b"hello")
        await closed(connection)

    async with fake_viser(handler) as scene, served(scene) as (host, _):
        async with browser(host) as first, browser(host) as second:
            assert (await first.recv(), await second.recv()) == (b"hello", b"hello")
            with pytest.raises(InvalidStatus):
                await browser(host)
        async with asyncio.timeout(10):
            while True:
                try:
                    async with browser(host) as again:
                        assert await again.recv() == b"hello"
                    break
                except InvalidStatus:  # the places are not given back yet
                    await asyncio.sleep(0.01)


async def test_a_wrong_secret_or_no_viser_is_a_refusal() -> None:
    async def handler(connection: ServerConnection) -> None:
        await connection.send(b"hello")

    async with fake_viser(handler) as scene:
        scene.secret = "wrong"
        async with served(scene) as (host, _):
            with pytest.raises(InvalidStatus) as refused:
                await browser(host)
            assert refused.value.response.status_code == 403
    async with served(scene) as (host, _):
        with pytest.raises(InvalidStatus):
            await browser(host)


async def test_the_real_scene_is_reached() -> None:
    from app.dashboard.parameters import ParameterState
    from app.scene import Scene

    class Commands:
        async def change_parameters(self, changes: Any) -> None: ...
        async def use_preset(self, name: str) -> None: ...
        async def reset_parameters(self, names: list[str]) -> None: ...
        async def choose_view(self, name: str, value: str | bool) -> None: ...
        async def select_tree(self, number: int | None) -> None: ...
        async def select_cluster(self, scan: int, cluster: int) -> None: ...

    scene = Scene(Commands(), asyncio.get_running_loop())
    try:
        scene.show_parameters(ParameterState().parameters, "forest")
        async with served(scene) as (host, _), browser(host, max_size=None) as page:  # type: ignore[arg-type]
            assert page.subprotocol == VERSION
            async with asyncio.timeout(20):
                assert len(await page.recv()) > 16
    finally:
        scene.close()
