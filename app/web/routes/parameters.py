"""The parameters and the view: read, change, undo, reset; parameter sets: save, use, delete, in and out as
files; the search for parameters, their sensitivity, and training of decision trees with annotations."""

from __future__ import annotations

import asyncio
from typing import Annotated

from fastapi import APIRouter
from pydantic import Field
from starlette.responses import Response

from app.dashboard.dashboard import Dashboard
from app.dashboard.parameters import file_of, read_file
from app.tuning.page import MOST_OTHERS, MOST_VALUES, OtherRun, SearchRequest, other_runs, plan_of
from app.tuning.plan import GOALS, SENSIBLE, Plan
from app.web.responses import Body, SaveSet, SetName, Value, Word, json_reply, text_reply
from app.web.routes.access import Dash, Permission, Permitted, Trainer
from pipeline.errors import StemmapError

router = APIRouter(prefix="/api")

_LONGEST_FILE = 100_000
_TOML = "application/toml"


class _Changes(Body):
    """New values by dotted name. `gesture` names the slider movement that they belong to, see
    `ParameterState.change`."""

    changes: Annotated[dict[Word, Value], Field(min_length=1, max_length=500)]
    gesture: Word = ""


class _PresetName(Body):
    name: Word


class _Reach(Body):
    whole: bool


class _Reset(Body):
    names: list[Word] = Field(default_factory=list, max_length=500)


class _ViewChoice(Body):
    name: Word
    value: bool | Word


class _SetName(Body):
    name: SetName


class _ParameterFile(Body):
    file: Word
    text: Annotated[str, Field(max_length=_LONGEST_FILE)]


@router.get("/parameters")
async def read(dashboard: Dash) -> Response:
    """GET /api/parameters: return the values, the names of those that differ from the preset, the declaration
    of each parameter, and the presets, see `ParameterState.as_plain_with_specs`."""
    return json_reply(dashboard.parameters.as_plain_with_specs())


@router.patch("/parameters")
async def change(body: _Changes, dashboard: Dash) -> Response:
    """PATCH /api/parameters: change values by their dotted names; return all values as `GET /api/parameters`
    does. 422 for an unknown name or a wrong value, 409 for a random forest that does not exist; nothing
    changes then."""
    await dashboard.change_parameters(dict(body.changes), body.gesture)
    return await read(dashboard)


@router.post("/parameters/preset")
async def use_preset(body: _PresetName, dashboard: Dash) -> Response:
    """POST /api/parameters/preset: use all values of a preset; return them as `GET /api/parameters` does. 422
    for an unknown preset."""
    await dashboard.use_preset(body.name)
    return await read(dashboard)


@router.put("/parameters/reach")
async def reach(body: _Reach, dashboard: Dash) -> Response:
    """PUT /api/parameters/reach: choose whether changes apply to the whole run, which is then mapped again at
    once, or from the current scan onwards; return the parameters as `GET /api/parameters` does."""
    await dashboard.reach(whole=body.whole)
    return await read(dashboard)


@router.post("/parameters/undo")
async def undo(dashboard: Dash) -> Response:
    """Undo the last change of parameters, whoever made it; return them as `GET /api/parameters` does. 409 if
    there is none."""
    await dashboard.tune(lambda state: state.undo())
    return await read(dashboard)


@router.post("/parameters/redo")
async def redo(dashboard: Dash) -> Response:
    """Repeat the change that was undone last; return the parameters as `GET /api/parameters` does. 409 if
    there is none, a parameter was changed since, or the forest of its values does not exist or cannot be read
    any more; then nothing changes."""
    await dashboard.tune(lambda state: state.redo())
    return await read(dashboard)


@router.post("/parameters/reset")
async def reset(body: _Reset, dashboard: Dash) -> Response:
    """POST /api/parameters/reset: set the named parameters, or all without names, to the values of the
    preset; return the parameters as `GET /api/parameters` does. 422 for an unknown name or values that
    contradict others."""
    await dashboard.reset_parameters(list(body.names))
    return await read(dashboard)


@router.patch("/view")
async def choose_view(body: _ViewChoice, dashboard: Dash) -> Response:
    """PATCH /api/view: show or hide a layer of the scene, or choose colours, labels or whether the view
    follows the robot, for all browsers; return the view, see `Scene.view`. 422 for an unknown choice."""
    await dashboard.choose_view(body.name, body.value)
    return json_reply(dashboard.scene.view)


@router.get("/parameters.toml")
async def download(dashboard: Dash) -> Response:
    """Return all values as a file for `--config`."""
    text = file_of(dashboard.parameters.preset, dashboard.parameters.parameters)
    return text_reply(text, "parameters.toml", _TOML)


@router.get("/sets")
async def saved_sets(dashboard: Dash) -> Response:
    """GET /api/sets: return the result of `ParameterSets.as_plain`: name, author and time of each saved
    set."""
    return json_reply(dashboard.sets.as_plain())


@router.post("/sets")
async def save_set(body: SaveSet, dashboard: Dash) -> Response:
    """POST /api/sets: save the values in force under a name; a set of that name is replaced. Return all saved
    sets as `GET /api/sets` does, with 201; 422 for the name of a preset, 409 if there are too many."""
    state = dashboard.parameters
    await dashboard.sets.save(body.name, state.preset, state.parameters, body.who)
    return json_reply(dashboard.sets.as_plain(), 201)


@router.post("/sets/use")
async def use_set(body: _SetName, dashboard: Dash) -> Response:
    """POST /api/sets/use: use all values of a saved set or a preset, as one change that can be undone. The
    response is empty; 404 if there is none of this name, 422 if its values are not valid in this version, 409
    for a random forest that does not exist."""
    preset_name, values = dashboard.sets.named(body.name)
    await dashboard.tune(lambda state: state.use(preset_name, values))
    return json_reply({})


@router.post("/sets/delete")
async def delete_set(body: _SetName, dashboard: Dash) -> Response:
    """Delete a saved set; return the others as `GET /api/sets` does. 404 if there is none of this name."""
    await dashboard.sets.delete(body.name)
    return json_reply(dashboard.sets.as_plain())


@router.post("/sets/upload")
async def upload_set(body: _ParameterFile, dashboard: Dash) -> Response:
    """POST /api/sets/upload: use the values of a parameter file, as the flag `--config` does; nothing is
    saved. The response is empty; 422 if the file or a value is not valid, 409 for a random forest that does
    not exist."""
    preset_name, values = await asyncio.to_thread(
        read_file, body.text, body.file, dashboard.parameters.preset
    )
    await dashboard.tune(lambda state: state.use(preset_name, values))
    return json_reply({})


@router.get("/sets/{name}.toml")
async def download_set(name: str, dashboard: Dash) -> Response:
    """GET /api/sets/{name}.toml: return a saved set as a file for `--config`; 404 if there is none of this
    name."""
    return text_reply(dashboard.sets.text(name), "parameters.toml", _TOML)


# --- search, sensitivity and training ----------------------------------------------------------------


class _Sensitivity(Body):
    name: Word
    values: Annotated[list[Value], Field(min_length=1, max_length=MOST_VALUES)]


@router.get("/search")
async def search_state(dashboard: Dash, permitted: Permitted) -> Response:
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
    return json_reply({**dashboard.search.as_plain(), **choices})


@router.post("/search")
async def start_search(body: SearchRequest, dashboard: Dash, permitted: Permitted) -> Response:
    """POST /api/search: start a search over the open run, from its first scan to its last, and over other
    recorded runs. Return the state of the search, with 202; 409 while another search runs, if the open run or
    one of the others cannot be searched over, is unknown or named twice, if there are too many, or if the
    store cannot be read; 422 for invalid parameters or bounds. A stopped search is removed."""
    await dashboard.search.start(await _plan(dashboard, permitted, body), body)
    return json_reply(dashboard.search.as_plain(), 202)


@router.post("/search/stop")
async def stop_search(dashboard: Dash) -> Response:
    """POST /api/search/stop: stop the search, if one runs; return its state with the results so far, which
    `GET /api/search` still returns."""
    await dashboard.search.stop()
    return json_reply(dashboard.search.as_plain(), 202)


@router.post("/search/go-on")
async def continue_search(dashboard: Dash, permitted: Permitted) -> Response:
    """POST /api/search/go-on: continue the search that was stopped: start it with the same choices; returns
    and fails as `start_search`, and 409 if no search was stopped. The results of its trials are stored,
    unless parameters or true trees have changed since."""
    request = dashboard.search.request
    if request is None or not dashboard.search.can_go_on:
        raise StemmapError("there is no stopped search", remedy="Start a search")
    return await start_search(request, dashboard, permitted)


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


async def _plan(dashboard: Dashboard, permitted: Permission, wanted: SearchRequest) -> Plan:
    """Return the plan of a search; errors as in `plan_of` and `Dashboard.run_with_truth`.

    Args:
        dashboard: The open run and the parameters in force.
        permitted: Permission of the sender.
        wanted: The request.
    """
    others = await _others(dashboard, permitted) if wanted.also or wanted.held_out else []
    state, run = dashboard.parameters, dashboard.run_with_truth()
    return plan_of(wanted, run, state.parameters, state.preset, others, dashboard.results)


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
