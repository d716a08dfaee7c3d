"""Decision trees that learn from annotations: what there is, grow, stop, use; and which trees are doubted."""

from __future__ import annotations

from fastapi import APIRouter, Request
from starlette.responses import Response

from app.dashboard.learning import Learning
from app.dashboard.payload import doubts_of
from app.web.responses import json_reply
from app.web.routes.access import Dash
from pipeline.errors import StemmapError

router = APIRouter(prefix="/api")


@router.get("/doubts")
async def doubts(dashboard: Dash) -> Response:
    """The found trees, the most doubted first, with the votes on each and how many are needed."""
    share = dashboard.parameters.parameters.classification.tree_share
    shown = dashboard.shown
    return json_reply({"needed": share, "trees": [] if shown is None else doubts_of(shown.frame, share)})


@router.get("/learning")
async def read(request: Request, dashboard: Dash) -> Response:
    """What there is to learn from, and how far it is."""
    return json_reply(await _learning(request).known(dashboard.parameters.parameters.classification.forest))


@router.post("/learning")
async def begin(request: Request, dashboard: Dash) -> Response:
    """Grow new decision trees from all that was annotated; nothing uses them yet."""
    await _learning(request).begin(dashboard.parameters.parameters)
    return json_reply(_learning(request).as_plain(), 202)


@router.delete("/learning")
async def forget(request: Request) -> Response:
    """Stop it, or forget what came of it: the decision trees in force stay."""
    await _learning(request).forget()
    return json_reply(_learning(request).as_plain())


@router.post("/learning/use")
async def use(request: Request, dashboard: Dash) -> Response:
    """Let the new decision trees vote from now on."""
    learned = _learning(request).learned
    if learned is None:
        raise StemmapError("no decision trees were grown", remedy="Grow them first")
    await dashboard.change_parameters({"classification.forest": learned["name"]})
    return json_reply(_learning(request).as_plain())


def _learning(request: Request) -> Learning:
    learning: Learning = request.app.state.learning
    return learning
