"""The private parts of viser that `app.scene.viser_server` uses, and that no other module does."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import viser
from viser import _messages
from websockets.asyncio import server as websockets_server

from app.scene import Scene
from app.scene.viser_server import messages_sent

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


def test_only_one_module_uses_them():
    used = [
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "app").rglob("*.py")
        if PRIVATE.search(path.read_text())
    ]
    assert used == ["app/scene/viser_server.py"]
