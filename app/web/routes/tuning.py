"""Search for parameters, their sensitivity, and training of decision trees with annotations."""

from __future__ import annotations

import asyncio
from typing import Annotated

from fastapi import APIRouter
from pydantic import Field
from starlette.responses import Response

from app.common.settings import Settings
from app.dashboard.dashboard import Dashboard
from app.tuning.page import MOST_OTHERS, MOST_VALUES, OtherRun, SearchRequest, other_runs, plan_of
from app.tuning.plan import GOALS, SENSIBLE, Plan
from app.web.responses import Body, SaveSet, Value, Word, json_reply
from app.web.routes.access import AnyFile, Dash, Deployment, Trainer, permitted_uri
from pipeline.errors import StemmapError

router = APIRouter(prefix="/api")


class _Sensitivity(Body):
    name: Word
    values: Annotated[list[Value], Field(min_length=1, max_length=MOST_VALUES)]


@router.get("/search")
async def search_state(dashboard: Dash, settings: Deployment, any_file: AnyFile) -> Response:
    """GET /api/search: return the keys of `TuneSearch.as_plain`; `goals`, a list of objects with `name` and
    `words`; `sensible`, a list of suggested parameters "NAME=LOW..HIGH"; `runs`, a list of the other recorded
    runs (see `OtherRun.as_plain`), empty if the store cannot be read; and `most_runs`, the maximum number of
    runs that can be chosen."""
    try:
        runs = [run.as_plain() for run in await _others(dashboard, settings, any_file)]
    except StemmapError:  # the open run can still be searched over
        runs = []
    choices = {
        "sensible": SENSIBLE,
        "goals": [{"name": name, "words": goal.words} for name, goal in GOALS.items()],
        "runs": runs,
        "most_runs": MOST_OTHERS,
    }
    return json_reply({**dashboard.search.as_plain(), **choices})


@router.post("/search")
async def start_search(
    body: SearchRequest, dashboard: Dash, settings: Deployment, any_file: AnyFile
) -> Response:
    """POST /api/search: start a search over the open run, from its first scan to its last, and over other
    recorded runs. Return the state of the search, with 202; 409 while another search runs, if the open run or
    one of the others cannot be searched over, is unknown or named twice, if there are too many, or if the
    store cannot be read; 422 for invalid parameters or bounds. A stopped search is removed."""
    await dashboard.search.start(await _plan(dashboard, settings, any_file, body), body)
    return json_reply(dashboard.search.as_plain(), 202)


@router.post("/search/stop")
async def stop_search(dashboard: Dash) -> Response:
    """POST /api/search/stop: stop the search, if one runs; return its state with the results so far, which
    `GET /api/search` still returns."""
    await dashboard.search.stop()
    return json_reply(dashboard.search.as_plain(), 202)


@router.post("/search/go-on")
async def continue_search(dashboard: Dash, settings: Deployment, any_file: AnyFile) -> Response:
    """POST /api/search/go-on: continue the search that was stopped: start it with the same choices; returns
    and fails as `start_search`, and 409 if no search was stopped. The results of its trials are stored,
    unless parameters or true trees have changed since."""
    request = dashboard.search.request
    if request is None or not dashboard.search.can_go_on:
        raise StemmapError("there is no stopped search", remedy="Start a search")
    return await start_search(request, dashboard, settings, any_file)


@router.post("/search/use")
async def use_found(dashboard: Dash) -> Response:
    """Use the values of the best set, as one change that can be undone. The response is empty; 409 if no
    better set was found."""
    preset_name, values, _ = dashboard.search.found()
    await dashboard.tune(lambda state: state.use(preset_name, values))
    return json_reply({})


@router.post("/search/save")
async def save_found(body: SaveSet, dashboard: Dash) -> Response:
    """Save the best set under a name, with its provenance, in place of one of this name; return all saved
    sets, with 201. 409 if no better set was found, 422 for the name of a preset."""
    preset_name, values, text = dashboard.search.found()
    await dashboard.sets.save(body.name, preset_name, values, body.who, text)
    return json_reply(dashboard.sets.as_plain(), 201)


@router.post("/sensitivity")
async def start_sensitivity(body: _Sensitivity, dashboard: Dash) -> Response:
    """POST /api/sensitivity: start to score the whole run over values of a parameter, in their order, in
    place of an analysis in progress. The response is empty (202), and the points so far are broadcast after
    each score. 409 if no run is open, it is live or has no true trees; 422 for an unknown parameter, or no or
    more than MOST_VALUES values."""
    dashboard.how_much_matters(body.name, list(body.values))
    return json_reply({}, 202)


@router.delete("/sensitivity")
async def stop_sensitivity(dashboard: Dash) -> Response:
    """DELETE /api/sensitivity: stop the sensitivity analysis, if one runs. The response is empty."""
    await dashboard.sensitivity.leave()
    return json_reply({})


@router.get("/learning")
async def learning_state(learning: Trainer, dashboard: Dash) -> Response:
    """GET /api/learning: return the numbers of annotations that a training can use, and its progress, see
    `Learning.known`."""
    in_force = dashboard.parameters.parameters.classification.forest
    return json_reply(await learning.known(in_force))


@router.post("/learning")
async def start_learning(learning: Trainer, dashboard: Dash) -> Response:
    """POST /api/learning: start to train new decision trees with all annotations, and return the progress,
    with 202. They are not used before `POST /api/learning/use`. 409 while a training runs or without a data
    folder."""
    await learning.begin(dashboard.parameters.parameters)
    return json_reply(learning.as_plain(), 202)


@router.delete("/learning")
async def stop_learning(learning: Trainer) -> Response:
    """Stop the training, or discard its result, and return the progress; the decision trees in force stay,
    and so does the file of trained ones."""
    await learning.forget()
    return json_reply(learning.as_plain())


@router.post("/learning/use")
async def use_learned(learning: Trainer, dashboard: Dash) -> Response:
    """POST /api/learning/use: classify with the new decision trees, as a change of parameters; return the
    progress of the training. 409 if there are none."""
    learned = learning.learned
    if learned is None:
        raise StemmapError("no decision trees were trained", remedy="Train them first")
    await dashboard.change_parameters({"classification.forest": learned["name"]})
    return json_reply(learning.as_plain())


async def _plan(dashboard: Dashboard, settings: Settings, any_file: bool, wanted: SearchRequest) -> Plan:
    """Return the plan of a search; errors as in `plan_of` and `Dashboard.run_with_truth`.

    Args:
        dashboard: The open run and the parameters in force.
        settings: Settings with the permitted folders.
        any_file: Whether the caller may open every file.
        wanted: The request.
    """
    others = await _others(dashboard, settings, any_file) if wanted.also or wanted.held_out else []
    state, run = dashboard.parameters, dashboard.run_with_truth()
    return plan_of(wanted, run, state.parameters, state.preset, others, dashboard.results)


async def _others(dashboard: Dashboard, settings: Settings, any_file: bool) -> list[OtherRun]:
    """Return the recorded runs except the open one, see `other_runs`; runs that may not be opened are
    included with `why_not`.

    Args:
        dashboard: The dashboard with its store and its open run.
        settings: Settings with the permitted folders.
        any_file: Whether the caller may open every file.

    Raises:
        StemmapError: The store cannot be read.
    """
    rows, annotated = await dashboard.store.ask(lambda s: (s.book.listed(), s.annotated_sources()))
    digest = dashboard.digest
    return await asyncio.to_thread(
        lambda: other_runs(rows, annotated, digest, lambda uri: permitted_uri(uri, settings, any_file))
    )
