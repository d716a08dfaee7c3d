"""Routes of the search for parameters and of their sensitivity."""

from __future__ import annotations

import asyncio
from typing import Annotated

from fastapi import APIRouter
from pydantic import Field
from starlette.responses import Response

from app.dashboard.dashboard import Dashboard
from app.dashboard.shown_run import truth_in_file
from app.extensions.search import results_in
from app.extensions.search.jobs import RunWithTruth
from app.extensions.search.page import (
    MOST_OTHERS,
    MOST_VALUES,
    OtherRun,
    Question,
    SearchRequest,
    Sensitivity,
    TuneSearch,
    other_runs,
    plan_of,
)
from app.extensions.search.plan import GOALS, SENSIBLE, Plan
from app.web.responses import Body, SaveSet, Value, Word, json_reply
from app.web.routes.access import Dash, Permission, Permitted, of_app
from pipeline.errors import StemmapError

router = APIRouter(prefix="/api")
Search = Annotated[TuneSearch, of_app("search")]
Curve = Annotated[Sensitivity, of_app("sensitivity")]


def run_with_truth(dashboard: Dashboard) -> RunWithTruth:
    """Return the open run for a search or a sensitivity curve, see `RunWithTruth.shown` for errors."""
    truth = truth_in_file(dashboard.truth, dashboard.status.one_step)
    return RunWithTruth.shown(dashboard.source, dashboard.digest, truth)


class _Sensitivity(Body):
    name: Word
    values: Annotated[list[Value], Field(min_length=1, max_length=MOST_VALUES)]


@router.get("/search")
async def search_state(dashboard: Dash, permitted: Permitted, search: Search) -> Response:
    """GET /api/search: return the keys of `TuneSearch.as_plain`; `goals`, a list of objects with `name` and
    `words`; `sensible`, a list of suggested parameters "NAME=LOW..HIGH"; `runs`, a list of the other recorded
    runs (see `OtherRun.as_plain`), empty if the store cannot be read; and `most_runs`, the maximum number of
    runs that can be chosen."""
    try:
        runs = [run.as_plain() for run in await _others(dashboard, permitted)]
    except StemmapError:  # the open run can still be searched over
        runs = []
    choices = {
        "sensible": SENSIBLE,
        "goals": [{"name": name, "words": goal.words} for name, goal in GOALS.items()],
        "runs": runs,
        "most_runs": MOST_OTHERS,
    }
    return json_reply({**search.as_plain(), **choices})


@router.post("/search")
async def start_search(
    body: SearchRequest, dashboard: Dash, permitted: Permitted, search: Search
) -> Response:
    """POST /api/search: start a search over the open run, from its first scan to its last, and over other
    recorded runs. Return the state of the search, with 202; 409 while another search runs, if the open run or
    one of the others cannot be searched over, is unknown or named twice, if there are too many, or if the
    store cannot be read; 422 for invalid parameters or bounds. A stopped search is removed."""
    await search.start(await _plan(dashboard, permitted, body), body)
    return json_reply(search.as_plain(), 202)


@router.post("/search/stop")
async def stop_search(search: Search) -> Response:
    """POST /api/search/stop: stop the search, if one runs; return its state with the results so far, which
    `GET /api/search` still returns."""
    await search.stop()
    return json_reply(search.as_plain(), 202)


@router.post("/search/go-on")
async def continue_search(dashboard: Dash, permitted: Permitted, search: Search) -> Response:
    """POST /api/search/go-on: continue the search that was stopped: start it with the same choices; returns
    and fails as `start_search`, and 409 if no search was stopped. The results of its trials are stored,
    unless parameters or true trees have changed since."""
    request = search.request
    if request is None or not search.can_go_on:
        raise StemmapError("there is no stopped search", remedy="Start a search")
    return await start_search(request, dashboard, permitted, search)


@router.post("/search/use")
async def use_found(dashboard: Dash, search: Search) -> Response:
    """Use the values of the best set, as one change that can be undone. The response is empty; 409 if no
    better set was found."""
    preset_name, values, _ = search.found()
    await dashboard.tune(lambda state: state.use(preset_name, values))
    return json_reply({})


@router.post("/search/save")
async def save_found(body: SaveSet, dashboard: Dash, search: Search) -> Response:
    """Save the best set under a name, with its provenance, in place of one of this name; return all saved
    sets, with 201. 409 if no better set was found, 422 for the name of a preset."""
    preset_name, values, text = search.found()
    await dashboard.sets.save(body.name, preset_name, values, body.who, text)
    return json_reply(dashboard.sets.as_plain(), 201)


@router.post("/sensitivity")
async def start_sensitivity(body: _Sensitivity, dashboard: Dash, sensitivity: Curve) -> Response:
    """POST /api/sensitivity: start to score the whole run over values of a parameter, in their order, in
    place of an analysis in progress. The response is empty (202), and the points so far are broadcast after
    each score. 409 if no run is open, it is live or has no true trees; 422 for an unknown parameter, or no or
    more than MOST_VALUES values."""
    run, parameters = run_with_truth(dashboard), dashboard.parameters.parameters
    sensitivity.ask(Question(run, parameters, body.name, tuple(body.values)))
    return json_reply({}, 202)


@router.delete("/sensitivity")
async def stop_sensitivity(sensitivity: Curve) -> Response:
    """DELETE /api/sensitivity: stop the sensitivity analysis, if one runs. The response is empty."""
    await sensitivity.leave()
    return json_reply({})


async def _plan(dashboard: Dashboard, permitted: Permission, wanted: SearchRequest) -> Plan:
    """Return the plan of a search; errors as in `plan_of` and `run_with_truth`.

    Args:
        dashboard: The open run and the parameters in force.
        permitted: Permission of the sender.
        wanted: The request.
    """
    others = await _others(dashboard, permitted) if wanted.also or wanted.held_out else []
    state, run = dashboard.parameters, run_with_truth(dashboard)
    return plan_of(wanted, run, state.parameters, state.preset, others, results_in(dashboard.store.folder))


async def _others(dashboard: Dashboard, permitted: Permission) -> list[OtherRun]:
    """Return the recorded runs except the open one, see `other_runs`; runs that may not be opened are
    included with `why_not`.

    Args:
        dashboard: The dashboard with its store and its open run.
        permitted: Permission of the sender.

    Raises:
        StemmapError: The store cannot be read.
    """
    rows, annotated = await dashboard.store.ask(lambda s: (s.book.listed(), s.annotated_sources()))
    return await asyncio.to_thread(other_runs, rows, annotated, dashboard.digest, permitted)
