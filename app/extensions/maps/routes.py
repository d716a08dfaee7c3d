"""Routes of the localisation of the open run in a stored map."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from fastapi import APIRouter
from pydantic import Field
from starlette.responses import Response

from app.extensions.maps.page import Locating
from app.web.responses import Body, json_reply
from app.web.routes.access import Dash, Deployment, of_app
from app.web.routes.runs import run_folder, whole_run

router = APIRouter(prefix="/api")
Located = Annotated[Locating, of_app("locating")]


class _Stored(Body):
    """A stored run by its key, see `run_folder`."""

    run: Annotated[str, Field(min_length=1, max_length=300)]


@router.get("/localise")
async def localise_state(locating: Located) -> Response:
    """GET /api/localise: return the state, see `Locating.as_plain`, and `stems`, the positions of the stems
    of the stored map in its frame as a list of [x, y] [m]."""
    stored = locating.stored
    stems = [] if stored is None else np.round(stored.position, 2).tolist()
    return json_reply({**locating.as_plain(), "stems": stems})


@router.post("/localise")
async def start_localising(
    body: _Stored, locating: Located, dashboard: Dash, settings: Deployment
) -> Response:
    """POST /api/localise: locate the open run in the map of a stored run, and return the state, with 202. 404
    for an unknown run, 409 if it has no files or no trees."""
    name = str((await whole_run(body.run, settings, dashboard))["name"])
    async with run_folder(body.run, settings, dashboard) as folder:
        await locating.begin(name, folder)
    return json_reply(locating.as_plain(), 202)


@router.delete("/localise")
async def stop_localising(locating: Located) -> Response:
    """DELETE /api/localise: end it, and return the state."""
    await locating.forget()
    return json_reply(locating.as_plain())
