"""Routes of the localisation of the open run in a stored map."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Annotated

import numpy as np
from fastapi import APIRouter
from pydantic import Field
from starlette.responses import Response

from app.common.settings import Settings
from app.extensions.maps.page import Locating
from app.web.responses import Body, json_reply
from app.web.routes.access import Dash, Deployment, Permission, Permitted, checked_uri, of_app
from app.web.routes.runs import run_folder, whole_run
from pipeline.io.readers import path_of

router = APIRouter(prefix="/api")
MOST_FILES = 500
Located = Annotated[Locating, of_app("locating")]


class _Stored(Body):
    """A stored run by its key, see `run_folder`, or the path of a stored map on the server."""

    run: Annotated[str, Field(max_length=300)] = ""
    path: Annotated[str, Field(max_length=4096)] = ""


@router.get("/localise")
async def localise_state(locating: Located) -> Response:
    """GET /api/localise: return the state, see `Locating.as_plain`, and `stems`, the positions of the stems
    of the stored map in its frame as a list of [x, y] [m]."""
    stored = locating.stored
    stems = [] if stored is None else np.round(stored.position, 2).tolist()
    return json_reply({**locating.as_plain(), "stems": stems})


@router.post("/localise")
async def start_localising(
    body: _Stored, locating: Located, dashboard: Dash, settings: Deployment, permitted: Permitted
) -> Response:
    """POST /api/localise: locate the open run in a stored map, and return the state, with 202. 403 for a path
    that the caller may not open, 404 for an unknown run, 409 if it is no stored map or has no trees."""
    if body.path:
        place = Path(path_of(checked_uri(body.path, permitted)))
        await locating.begin(place.name, place)
        return json_reply(locating.as_plain(), 202)
    name = str((await whole_run(body.run, settings, dashboard))["name"])
    async with run_folder(body.run, settings, dashboard) as folder:
        await locating.begin(name, folder)
    return json_reply(locating.as_plain(), 202)


@router.get("/localise/files")
async def list_files(settings: Deployment, permitted: Permitted) -> Response:
    """GET /api/localise/files: return `files`, the paths of the .stems files directly in the data folders
    that the caller may open."""
    return json_reply({"files": await asyncio.to_thread(_files, settings, permitted)})


def _files(settings: Settings, permitted: Permission) -> list[str]:
    """Return the paths of `list_files`, at most MOST_FILES."""
    found = [str(path) for folder in settings.data_folders for path in sorted(folder.glob("*.stems"))]
    return [path for path in found if permitted(path) is not None][:MOST_FILES]


@router.delete("/localise")
async def stop_localising(locating: Located) -> Response:
    """DELETE /api/localise: end it, and return the state."""
    await locating.forget()
    return json_reply(locating.as_plain())
