"""The camera's picture of the standing scan, with what the map knows in it."""

from __future__ import annotations

from fastapi import APIRouter
from starlette.responses import Response

from app.web.responses import error_reply, json_reply
from app.web.routes.access import Dash

router = APIRouter(prefix="/api")


@router.get("/camera")
async def camera(dashboard: Dash) -> Response:
    """Which picture it is, and where trees and clusters stand in it."""
    if dashboard.shown is None:
        return error_reply(409, "nothing is mapped yet", remedy="Press play, or open a run")
    return json_reply(await dashboard.camera.look(dashboard.shown.frame, dashboard.path))


@router.get("/camera/{stamp_ns}.jpg")
async def picture(stamp_ns: int, dashboard: Dash) -> Response:
    """A picture that was told of."""
    content = dashboard.camera.jpeg(stamp_ns)
    if content is None:
        return error_reply(404, "this picture is no more there", remedy="Ask for the newest one")
    return Response(content, 200, {"Cache-Control": "no-store"}, media_type="image/jpeg")
