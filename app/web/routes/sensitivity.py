"""How much a parameter matters: asked for, and given up."""

from __future__ import annotations

from typing import Annotated

import msgspec
from fastapi import APIRouter, Request
from msgspec import Meta
from starlette.responses import Response

from app.tuning.sweep.sensitivity import MOST_VALUES
from app.web.responses import body_of, json_reply
from app.web.routes.access import Dash

router = APIRouter(prefix="/api")

_Word = Annotated[str, Meta(max_length=100)]


class _Asked(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: _Word
    values: Annotated[list[bool | int | float | _Word], Meta(min_length=1, max_length=MOST_VALUES)]


@router.post("/sensitivity")
async def ask(request: Request, dashboard: Dash) -> Response:
    """Score the whole run over values of a parameter, in their order; each point is told as it comes."""
    wanted: _Asked = await body_of(request, _Asked)
    dashboard.how_much_matters(wanted.name, wanted.values)
    return json_reply({}, 202)


@router.delete("/sensitivity")
async def stop(dashboard: Dash) -> Response:
    """Give it up."""
    await dashboard.sensitivity.leave()
    return json_reply({})
