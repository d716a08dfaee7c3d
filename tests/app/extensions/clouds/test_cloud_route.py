"""The cloud of the open run, written by a child process for the page."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import pytest

from app.extensions.clouds.routes import cloud
from tests.app.server_for_tests import BEARER, running
from tests.app.web.test_routes import show


async def test_a_child_is_asked_for_the_cloud(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    async def ask(question: dict[str, str], patience_s: float) -> dict[str, str]:
        module, function = question["ask"].split(":")
        assert getattr(import_module(module), function) is cloud
        assert Path(question["path"]).is_dir()
        file = Path(question["folder"]) / "cloud.laz"
        file.write_bytes(b"points")
        return {"file": str(file)}

    monkeypatch.setattr("app.web.routes.results.LARGE", tmp_path)
    monkeypatch.setattr("app.sources.opening.ask", ask)
    async with running() as (client, dashboard):
        await show(dashboard)
        reply = await client.get("/api/export/laz", headers=BEARER)
    assert (reply.status_code, reply.content) == (200, b"points")
    assert reply.headers["content-disposition"] == 'attachment; filename="cloud.laz"'
    assert list(tmp_path.iterdir()) == []
