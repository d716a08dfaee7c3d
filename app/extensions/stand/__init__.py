"""The extension `stand`: sample plots and stand figures, coordinates, files for GIS, CAD and spreadsheets,
the report, and the comparison of two visits."""

from __future__ import annotations

from typing import TYPE_CHECKING

from app.extension import Extension, page_folder

if TYPE_CHECKING:
    from fastapi import FastAPI

#: Expected standard deviation of a coordinate of a control point [m], unless the user gives another.
POINT_SIGMA = 0.125


def _add_routes(app: FastAPI) -> None:
    """Add the routes to a dashboard."""
    from app.extensions.stand.routes import files, georeference, heading, plots, visits

    for module in (plots, georeference, heading, files, visits):
        app.include_router(module.router)


EXTENSION = Extension(
    help="sample plots, stand figures, coordinates, GIS files, the report, and two visits compared",
    commands={
        name: f"app.extensions.stand.commands.{name}"
        for name in ("compare", "stand", "georeference", "report")
    },
    takes={"export": "app.extensions.stand.commands.export"},
    web=_add_routes,
    page=page_folder("stand"),
)
