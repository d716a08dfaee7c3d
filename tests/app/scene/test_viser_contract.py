"""The private parts of viser that `app.scene.viser_server` uses, and that no other module does."""

from __future__ import annotations

import dataclasses
import inspect
import re
from pathlib import Path

import numpy as np
import viser
from viser import _messages
from websockets.asyncio import server as websockets_server

from app.scene import Scene
from app.scene.viser_server import messages_sent
from tests.app.scene.frames import make_frame

ROOT = Path(__file__).resolve().parents[3]
PRIVATE = re.compile(r"_websock_server|\bviser\._[a-z]|from viser import _")


def test_viser_has_the_private_parts_that_are_used(scene: Scene):
    server = scene._server
    assert isinstance(server, viser.ViserServer)
    assert messages_sent(server) > 0
    assert callable(server._websock_server.register_handler)
    assert callable(server._websock_server.unregister_handler)
    assert inspect.iscoroutinefunction(server.gui._handle_gui_updates)
    for name in ("ShareUrlRequest", "ShareUrlDisconnect", "GuiUpdateMessage"):
        assert hasattr(_messages, name)
    assert "updates" in _messages.GuiUpdateMessage.__annotations__
    assert "process_request" in inspect.signature(websockets_server.serve.__init__).parameters


def test_a_browser_that_connects_later_gets_positions_and_colours_of_a_batch_by_one_message(scene: Scene):
    frame = make_frame(0)
    scene.show(frame, np.zeros((1, 4)))
    moved = dataclasses.replace(frame.trees, position=frame.trees.position + 0.1)
    scene.show(dataclasses.replace(make_frame(1), trees=moved), np.zeros((2, 4)))
    kept = [
        message.updates
        for message in scene._server._websock_server.get_message_buffer().message_from_id.values()
        if isinstance(message, _messages.SceneNodeUpdateMessage) and message.name == "/world/trees"
    ]
    assert [set(updates) for updates in kept] == [
        {"batched_wxyzs", "batched_positions", "batched_scales", "batched_colors"}
    ]
    assert len(kept[0]["batched_positions"]) == len(kept[0]["batched_colors"])


def test_only_one_module_uses_them():
    used = [
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "app").rglob("*.py")
        if PRIVATE.search(path.read_text())
    ]
    assert used == ["app/scene/viser_server.py"]
