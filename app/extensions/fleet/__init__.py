"""The extension `fleet`: several robots or runs at once, each with its own dashboard, and a page of all."""

from __future__ import annotations

from typing import TYPE_CHECKING

from app.extension import Extension, page_folder

if TYPE_CHECKING:
    from fastapi import FastAPI


def _add_routes(app: FastAPI) -> None:
    """Add the way back from a dashboard to the page of all robots."""
    from app.extensions.fleet.fleet import of_dashboard

    app.state.fleet_port = None
    app.include_router(of_dashboard)


EXTENSION = Extension(
    help="several robots or runs at once: a dashboard each, and one page with a map of all",
    takes={"serve": "app.extensions.fleet.serve"},
    web=_add_routes,
    page=page_folder("fleet"),
)
