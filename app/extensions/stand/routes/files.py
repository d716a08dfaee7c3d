"""Files of a run with its plots: for GIS, CAD and spreadsheets, and the report."""

from __future__ import annotations

import asyncio
from dataclasses import asdict
from pathlib import Path as FilePath
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends
from shapely.geometry import mapping
from starlette.responses import Response

from app.batch.run_folder import read_run_record
from app.dashboard.dashboard import Dashboard
from app.dashboard.shown_run import ShownRun
from app.extensions.stand.heading import Heading, heading_of, stored_heading
from app.extensions.stand.parameters import Stand
from app.extensions.stand.plot_files import plots_of_run, stored_plots
from app.extensions.stand.plots import SamplePlot
from app.extensions.stand.questions import EXPORT, LAYER, REPORT
from app.extensions.stand.routes.figure_parameters import FigureParameters
from app.sources import opening
from app.web.responses import bytes_reply
from app.web.routes.access import Dash, Deployment, ViewerTurn
from app.web.routes.results import exported_file, exported_layer, folder_of_export
from app.web.routes.runs import Key, is_open_run, run_folder

router = APIRouter(prefix="/api")

# A PDF of a large stand on a busy machine.
_REPORT_S = 240.0


@router.get("/layers/plots.geojson", dependencies=[ViewerTurn])
async def plots_layer(dashboard: Dash, there: Annotated[FilePath, Depends(folder_of_export)]) -> Response:
    """Return the plots of the run as GeoJSON, in the coordinates of the other layers; a child process writes
    them. 409 before the first map."""
    run = ShownRun.of(dashboard)
    plots = [(plot.name, mapping(plot.shape)) for plot in plots_of_run(run)]
    return await exported_layer(dashboard, run, {"ask": LAYER, "plots": plots}, there)


def _add_export(suffix: str) -> None:
    """Add the route of a format, which returns the map with the plots of the run as a file, in the reference
    system of the map. For a run of scans, the bytes are those of `stemmap export` for a run with the same map
    and plots. 409 before the first map; 422 if a package is missing, the map lacks what the format shows, or
    all plots are outside of what was observed."""

    @router.get(f"/export/{suffix}", dependencies=[ViewerTurn], name=f"export_{suffix}")
    async def export(
        dashboard: Dash, parameters: FigureParameters, there: Annotated[FilePath, Depends(folder_of_export)]
    ) -> Response:
        run = ShownRun.of(dashboard)
        question = {"ask": EXPORT, "suffix": f".{suffix}", **_of_plots(plots_of_run(run), parameters)}
        return await exported_file(dashboard, run, question, there)


# The GeoPackage has plots, in place of that of the program.
for _suffix in ("gpkg", "shp", "dxf", "xlsx", "tif"):
    _add_export(_suffix)


@router.get("/runs/{key}/report/{suffix}", dependencies=[ViewerTurn])
async def report(
    key: Key,
    suffix: Literal["html", "pdf"],
    dashboard: Dash,
    settings: Deployment,
    parameters: FigureParameters,
    language: Literal["en", "de"] = "en",
) -> Response:
    """Return the report of `stemmap report` for a run with its plots and heading; a child process writes it.
    The key is the number of a record, "folder:NAME", or "open" for the open run. 404 for an unknown run, 409
    if there is no report of it, as no PDF without Chromium."""
    async with run_folder(key, settings, dashboard) as folder:
        plots, heading = await _edits_of(key, folder, dashboard)
        with TemporaryDirectory(prefix="stemmap-report-") as there:
            file = FilePath(there) / f"report.{suffix}"
            question = {
                "ask": REPORT,
                "path": str(folder),
                "file": str(file),
                "language": language,
                "heading": asdict(heading),
                **_of_plots(plots, parameters),
            }
            await opening.ask(question, patience_s=_REPORT_S)
            return bytes_reply(await asyncio.to_thread(file.read_bytes), filename=file.name)


def _of_plots(plots: list[SamplePlot], parameters: Stand) -> dict[str, Any]:
    """Return the keys "plots" and "parameters" of a question."""
    return {
        "plots": [(plot.name, mapping(plot.shape)) for plot in plots],
        "parameters": parameters.model_dump(),
    }


async def _edits_of(key: str, folder: FilePath, dashboard: Dashboard) -> tuple[list[SamplePlot], Heading]:
    """Return the plots and the heading of a run by its key and its folder; StemmapError if the store cannot
    be used."""
    if is_open_run(key, dashboard):
        run = ShownRun.of(dashboard)
        return plots_of_run(run), heading_of(row.content for row in run.edits)
    source = (await asyncio.to_thread(read_run_record, folder))["source"]
    return await dashboard.store.ask(
        lambda store: (stored_plots(store, source), stored_heading(store, source))
    )
