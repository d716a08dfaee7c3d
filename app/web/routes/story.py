"""Stories: how a cluster or a tree came to be what it is."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Query
from starlette.responses import Response

from app.explain.client import NoStoryError
from app.web.responses import failure_reply, json_reply
from app.web.routes.access import Dash

router = APIRouter(prefix="/api/story")

_MOST = 2**31 - 1
_Number = Annotated[int, Path(ge=0, le=_MOST)]


@router.get("/cluster/{number}")
async def cluster(
    number: _Number, dashboard: Dash, scan: Annotated[int | None, Query(ge=0, le=_MOST)] = None
) -> Response:
    """Verdict, checks and fit of a cluster of a scan that was shown lately; without `scan` of the newest."""
    try:
        return json_reply(await dashboard.selecting.story(scan, number))
    except NoStoryError as error:
        return failure_reply(404, error)


@router.get("/tree/{number}")
async def tree(number: _Number, dashboard: Dash) -> Response:
    """Votes, DBH, coverage and history of a tree as it stands."""
    try:
        return json_reply(await dashboard.asking.tree(number))
    except NoStoryError as error:
        return failure_reply(404, error)
