"""Nobody but the bridge may talk to viser."""

from __future__ import annotations

import urllib.error
import urllib.request

import pytest
from viser import _messages
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus
from websockets.typing import Subprotocol

from app.scene import SECRET_HEADER, Scene

PROTOCOL = Subprotocol("viser-v1.1.1")


@pytest.mark.parametrize("given", [None, "", "wrong"])
async def test_a_handshake_without_the_secret_is_refused(scene: Scene, given: str | None):
    headers = {} if given is None else {SECRET_HEADER: given}
    with pytest.raises(InvalidStatus) as refused:
        async with connect(
            f"ws://127.0.0.1:{scene.port}", subprotocols=[PROTOCOL], additional_headers=headers
        ):
            pass
    assert refused.value.response.status_code == 403


async def test_with_the_secret_the_scene_is_sent(scene: Scene):
    headers = {SECRET_HEADER: scene.secret}
    async with connect(
        f"ws://127.0.0.1:{scene.port}", subprotocols=[PROTOCOL], additional_headers=headers, max_size=None
    ) as socket:
        assert socket.subprotocol == PROTOCOL
        assert len(await socket.recv()) > 1000


async def test_the_page_of_viser_needs_the_secret_too(scene: Scene):
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(f"http://127.0.0.1:{scene.port}/", timeout=10)


async def test_two_scenes_have_two_secrets_and_two_ports(scene: Scene, recorder):
    other = Scene(recorder, scene._loop)
    try:
        assert (other.port, other.secret) != (scene.port, scene.secret)
        with pytest.raises(InvalidStatus):
            async with connect(
                f"ws://127.0.0.1:{scene.port}", additional_headers={SECRET_HEADER: other.secret}
            ):
                pass
    finally:
        other.close()


async def test_it_listens_on_this_machine_only_and_opens_no_tunnel(scene: Scene):
    assert scene._server.get_host() == "127.0.0.1"
    handlers = scene._server._websock_server._incoming_handlers
    assert _messages.ShareUrlRequest not in handlers
    assert _messages.ShareUrlDisconnect not in handlers
