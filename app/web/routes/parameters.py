"""The parameters and the view: read, change, undo, reset; parameter sets: save, use, delete, in and out as
files."""

from __future__ import annotations

import asyncio
from typing import Annotated

from fastapi import APIRouter
from pydantic import Field
from starlette.responses import Response

from app.dashboard.parameters import file_of, read_file
from app.web.responses import Body, SaveSet, SetName, Value, Word, json_reply, text_reply
from app.web.routes.access import Dash

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
