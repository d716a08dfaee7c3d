"""Routes of extensions are as guarded as those of the core: token, Host, Origin, and view-only links."""

from __future__ import annotations

import pytest
from fastapi import APIRouter, FastAPI

from app.extension import extensions_on
from app.web.auth import viewer_token
from tests.app.server_for_tests import BEARER, TOKEN, pairs_of, routes, running

VIEWER = {"Authorization": f"Bearer {viewer_token(TOKEN)}"}


@pytest.fixture
def added(monkeypatch: pytest.MonkeyPatch) -> set[tuple[str, str]]:
    """Method and path of each route that an extension adds to the next application."""
    found: set[tuple[str, str]] = set()
    include = FastAPI.include_router

    def watched(app: FastAPI, router: APIRouter) -> None:
        found.update({pair for route in router.routes for pair in pairs_of(route)} - routes())
        include(app, router)

    monkeypatch.setattr(FastAPI, "include_router", watched)
    return found


async def test_routes_of_extensions_are_guarded(added: set[tuple[str, str]]):
    async with running() as (client, _):
        ours = {pair for pair in added if pair[0] != "WS"}
        assert len(ours) >= sum(each.web is not None for each in extensions_on().values()) > 0
        for method, path in ours:
            assert (await client.request(method, path)).status_code == 401
            foreign = {**BEARER, "Host": "evil.example"}
            assert (await client.request(method, path, headers=foreign)).status_code == 403
            if method != "GET":
                foreign = {**BEARER, "Origin": "http://evil.example"}
                assert (await client.request(method, path, headers=foreign)).status_code == 403
                assert (await client.request(method, path, headers=VIEWER)).status_code == 403


async def test_what_costs_minutes_is_for_owners():
    async with running() as (client, _):
        answer = await client.get("/api/export/laz", headers=VIEWER)
        assert (answer.status_code, answer.json()["error"]["what"]) == (403, "this is a view-only link")
        assert (await client.get("/api/export/laz", headers=BEARER)).status_code == 409  # no map yet
