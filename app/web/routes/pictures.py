"""Pictures of the standing scan that the page draws itself: its stages, and two sets side by side."""

from __future__ import annotations

import asyncio
from contextlib import nullcontext
from typing import Annotated

import msgspec
from fastapi import APIRouter, Request
from msgspec import Meta
from starlette.responses import Response

from app.dashboard.dashboard import Dashboard
from app.dashboard.payload import comparison_payload, stages_payload
from app.web.auth import role_of
from app.web.responses import body_of, error_reply
from app.web.routes.access import Dash
from pipeline.config import Parameters

router = APIRouter(prefix="/api")

_Name = Annotated[str, Meta(max_length=60)]
_BYTES = "application/octet-stream"


class _Compare(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Names of presets or saved sets; an empty one means what is in force."""

    a: _Name
    b: _Name


@router.get("/stages")
async def stages(dashboard: Dash) -> Response:
    """The points of the standing scan, stage by stage (Fig. 3)."""
    if dashboard.shown is None:
        return error_reply(409, "nothing is mapped yet", remedy="Press play, or open a run")
    return _block(await asyncio.to_thread(stages_payload, dashboard.shown.frame))


@router.post("/compare")
async def compare(request: Request, dashboard: Dash) -> Response:
    """The standing scan under two sets of parameters."""
    wanted: _Compare = await body_of(request, _Compare)
    sets = [_named(dashboard, name) for name in (wanted.a, wanted.b)]
    async with dashboard.viewers_turns.turn() if role_of(request.scope) == "viewer" else nullcontext():
        frames = await dashboard.asking.compare(sets)
    first, second = (each.flat() for each in sets)
    differences = [[name, value, second[name]] for name, value in first.items() if second[name] != value]
    distance = dashboard.parameters.parameters.evaluation.match_distance
    header = {"a": wanted.a, "b": wanted.b, "differences": differences}
    return _block(await asyncio.to_thread(comparison_payload, frames, header, dashboard.truth, distance))


def _named(dashboard: Dashboard, name: str) -> Parameters:
    return dashboard.sets.named(name)[1] if name else dashboard.parameters.parameters


def _block(content: bytes) -> Response:
    return Response(content, 200, {"Cache-Control": "no-store"}, media_type=_BYTES)
