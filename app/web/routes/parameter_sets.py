"""Sets of parameters that people saved: list, save, use, delete; in and out as files."""

from __future__ import annotations

from typing import Annotated

import msgspec
from fastapi import APIRouter, Request
from msgspec import Meta
from starlette.responses import Response

from app.dashboard.parameters import read_file
from app.dashboard.user import NAME
from app.web.responses import body_of, json_reply, table_reply
from app.web.routes.access import Dash

router = APIRouter(prefix="/api/sets")

# Letters of any script, so that it can be read everywhere and never steers a terminal or a path.
SET_NAME = r"^\w[\w .+-]{0,39}\Z"
_WHO = NAME
_LONGEST_FILE = 100_000

_Name = Annotated[str, Meta(pattern=SET_NAME)]


class _Save(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: _Name
    who: Annotated[str, Meta(pattern=_WHO)] = "somebody"


class _Named(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: _Name


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    file: Annotated[str, Meta(max_length=100)]
    text: Annotated[str, Meta(max_length=_LONGEST_FILE)]


@router.get("")
async def read(dashboard: Dash) -> Response:
    """What was saved."""
    return json_reply(dashboard.sets.as_plain())


@router.post("")
async def save(request: Request, dashboard: Dash) -> Response:
    """Keep the values in force under a name, in place of those that have it."""
    wanted: _Save = await body_of(request, _Save)
    state = dashboard.parameters
    await dashboard.sets.save(wanted.name, state.preset, state.parameters, wanted.who)
    return json_reply(dashboard.sets.as_plain(), 201)


@router.post("/use")
async def use(request: Request, dashboard: Dash) -> Response:
    """Take all values of a saved set or a preset."""
    wanted: _Named = await body_of(request, _Named)
    preset_name, values = dashboard.sets.named(wanted.name)
    await dashboard.tune(lambda state: state.use(preset_name, values))
    return json_reply({})


@router.post("/delete")
async def delete(request: Request, dashboard: Dash) -> Response:
    """Forget a saved set."""
    wanted: _Named = await body_of(request, _Named)
    await dashboard.sets.delete(wanted.name)
    return json_reply(dashboard.sets.as_plain())


@router.post("/upload")
async def upload(request: Request, dashboard: Dash) -> Response:
    """Take the values of a file as `--config` does."""
    wanted: _File = await body_of(request, _File)
    preset_name, values = read_file(wanted.text, wanted.file, dashboard.parameters.preset)
    await dashboard.tune(lambda state: state.use(preset_name, values))
    return json_reply({})


@router.get("/{name}.toml")
async def download(name: str, dashboard: Dash) -> Response:
    """A saved set as a file that `--config` takes."""
    return table_reply(dashboard.sets.text(name), "parameters.toml", "application/toml")
