"""The extension `maps`: a run continues the map of an earlier one, is localised in it, or merged with it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from app.extension import Extension, page_folder

if TYPE_CHECKING:
    from fastapi import FastAPI


def _add_routes(app: FastAPI) -> None:
    """Add the localisation in a stored map and its routes to a dashboard."""
    from app.extensions.maps.page import Locating
    from app.extensions.maps.routes import router

    dashboard = app.state.dashboard
    app.state.locating = locating = Locating(
        dashboard, lambda state: dashboard.live.publish("localise", state)
    )
    app.state.closing.append(locating.close)
    app.include_router(router)


EXTENSION = Extension(
    help="maps of several drives: stemmap map --continue, merge, localise and pack",
    commands={
        "merge": "app.extensions.maps.merge_command",
        "localise": "app.extensions.maps.localise_command",
        "pack": "app.extensions.maps.pack_command",
    },
    web=_add_routes,
    page=page_folder("maps"),
    takes={"map": "app.extensions.maps.map_command"},
)
