"""The parameters: read, change, reset, download."""

from __future__ import annotations

from typing import Annotated

import msgspec
from fastapi import APIRouter, Request
from msgspec import Meta
from starlette.responses import Response

from app.dashboard.parameters import file_of
from app.web.responses import body_of, json_reply, table_reply
from app.web.routes.access import Dash

router = APIRouter(prefix="/api")

_Name = Annotated[str, Meta(max_length=100)]
_Value = bool | int | float | Annotated[str, Meta(max_length=100)]


class _Changes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    changes: Annotated[dict[_Name, _Value], Meta(min_length=1, max_length=500)]
    gesture: _Name = ""  # of a slider that is held, see ParameterState.change


class _Preset(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: _Name


class _Reach(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    whole: bool


class _Reset(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    names: Annotated[list[_Name], Meta(max_length=500)] = []


@router.get("/parameters")
async def read(dashboard: Dash) -> Response:
    """Values, what differs from the preset, and how each parameter is declared."""
    return json_reply(dashboard.parameters.as_plain_with_specs())


@router.patch("/parameters")
async def change(request: Request, dashboard: Dash) -> Response:
    """Change values by their dotted names."""
    wanted: _Changes = await body_of(request, _Changes)
    await dashboard.change_parameters(wanted.changes, wanted.gesture)
    return await read(dashboard)


@router.post("/parameters/preset")
async def use_preset(request: Request, dashboard: Dash) -> Response:
    """Take all values of a preset."""
    wanted: _Preset = await body_of(request, _Preset)
    await dashboard.use_preset(wanted.name)
    return await read(dashboard)


@router.put("/parameters/reach")
async def reach(request: Request, dashboard: Dash) -> Response:
    """Say what a change acts on: the whole run, or the scans from the standing one on."""
    wanted: _Reach = await body_of(request, _Reach)
    await dashboard.reach(whole=wanted.whole)
    return await read(dashboard)


@router.post("/parameters/undo")
async def undo(dashboard: Dash) -> Response:
    """Take back the last step."""
    await dashboard.tune(lambda state: state.undo())
    return await read(dashboard)


@router.post("/parameters/redo")
async def redo(dashboard: Dash) -> Response:
    """Do again what was undone last."""
    await dashboard.tune(lambda state: state.redo())
    return await read(dashboard)


@router.post("/parameters/reset")
async def reset(request: Request, dashboard: Dash) -> Response:
    """Give the named parameters (none: all) the preset's values again."""
    wanted: _Reset = await body_of(request, _Reset)
    await dashboard.reset_parameters(wanted.names)
    return await read(dashboard)


class _Choice(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: _Name
    value: bool | _Name


@router.patch("/view")
async def choose_view(request: Request, dashboard: Dash) -> Response:
    """Show or hide a layer of the scene, or colour, label or follow otherwise."""
    wanted: _Choice = await body_of(request, _Choice)
    await dashboard.choose_view(wanted.name, wanted.value)
    return json_reply(dashboard.scene.view)


@router.get("/parameters.toml")
async def download(dashboard: Dash) -> Response:
    """All values as a file that `--config` takes."""
    text = file_of(dashboard.parameters.preset, dashboard.parameters.parameters)
    return table_reply(text, "parameters.toml", "application/toml")
