"""The search for parameters on the page: start, stop, go on, use and save what it found."""

from __future__ import annotations

import asyncio
from typing import Annotated

import msgspec
from fastapi import APIRouter, Request
from msgspec import Meta
from starlette.responses import Response

from app.common.settings import Settings
from app.dashboard.dashboard import Dashboard
from app.dashboard.user import NAME
from app.tuning.goal import GOALS
from app.tuning.plan import Plan
from app.tuning.request import MOST_OTHERS, OtherRun, SearchRequest, other_runs, plan_of
from app.tuning.search_space import SENSIBLE
from app.web.responses import body_of, json_reply
from app.web.routes.access import Dash
from app.web.routes.parameter_sets import SET_NAME
from app.web.routes.run import what_may_be_opened
from pipeline.errors import StemmapError

router = APIRouter(prefix="/api/search")


class _Save(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: Annotated[str, Meta(pattern=SET_NAME)]
    who: Annotated[str, Meta(pattern=NAME)] = "somebody"


@router.get("")
async def read(request: Request, dashboard: Dash) -> Response:
    """How the search goes, what can be searched for, and over which other runs."""
    try:
        runs = [run.as_plain() for run in await _others(request, dashboard)]
    except StemmapError:  # the run that is open can be searched over all the same
        runs = []
    choices = {
        "sensible": SENSIBLE,
        "goals": [{"name": n, "words": words} for n, words in GOALS.items()],
        "runs": runs,
        "most_runs": MOST_OTHERS,
    }
    return json_reply({**dashboard.search.as_plain(), **choices})


@router.post("")
async def start(request: Request, dashboard: Dash) -> Response:
    """Search over the run that is open, from its first scan to its last, and over others of the list."""
    wanted: SearchRequest = await body_of(request, SearchRequest)
    await dashboard.search.start(await _plan(request, dashboard, wanted), wanted)
    return json_reply(dashboard.search.as_plain(), 202)


@router.post("/stop")
async def stop(dashboard: Dash) -> Response:
    """End the search; what it found stays."""
    await dashboard.search.stop()
    return json_reply(dashboard.search.as_plain(), 202)


@router.post("/go-on")
async def go_on(request: Request, dashboard: Dash) -> Response:
    """Go on with the search that was stopped, with the same choices."""
    search = dashboard.search
    if search.asked is None:
        raise StemmapError("there is no stopped search", remedy="Search")
    await search.go_on(await _plan(request, dashboard, search.asked))
    return json_reply(search.as_plain(), 202)


@router.post("/use")
async def use(dashboard: Dash) -> Response:
    """Take the values of the best set, as one step that can be undone."""
    preset_name, values, _ = dashboard.search.found()
    await dashboard.tune(lambda state: state.use(preset_name, values))
    return json_reply({})


@router.post("/save")
async def save(request: Request, dashboard: Dash) -> Response:
    """Keep the best set under a name, with where it comes from."""
    wanted: _Save = await body_of(request, _Save)
    preset_name, values, text = dashboard.search.found()
    await dashboard.sets.save(wanted.name, preset_name, values, wanted.who, text)
    return json_reply(dashboard.sets.as_plain(), 201)


async def _plan(request: Request, dashboard: Dashboard, wanted: SearchRequest) -> Plan:
    others = await _others(request, dashboard) if wanted.also or wanted.held_out else []
    state = dashboard.parameters
    source, digest, truth = dashboard.source, dashboard.digest, dashboard.truth
    return plan_of(wanted, source, digest, truth, state.parameters, state.preset, others)


async def _others(request: Request, dashboard: Dashboard) -> list[OtherRun]:
    """The other runs of the list.

    Raises:
        StemmapError: It cannot be read.
    """
    settings: Settings = request.app.state.settings
    rows, annotated = await dashboard.keeper.ask(lambda s: (s.book.listed(), s.annotated_sources()))
    digest = dashboard.digest
    return await asyncio.to_thread(
        lambda: other_runs(rows, annotated, digest, lambda uri: what_may_be_opened(uri, settings))
    )
