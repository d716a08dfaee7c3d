"""Plots of the open run, drawn, typed, along the path or from GIS files, and their stand figures.

Plots are annotations of the class `plot`: undo, redo and deletion are routes of `app.web.routes.annotations`.
"""

from __future__ import annotations

import asyncio
import base64
import binascii
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path as FilePath
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

import numpy as np
import shapely
from fastapi import APIRouter
from pydantic import Field
from starlette.responses import Response

from app.dashboard.dashboard import Dashboard
from app.dashboard.selection import NothingMappedError
from app.dashboard.shown_run import ShownRun
from app.extensions.stand.parameters import Stand
from app.extensions.stand.plot_files import PLOT, plots_of_run
from app.extensions.stand.plots import centres_along, plot_of
from app.extensions.stand.questions import DETOUR, PLOTS_OF_FILE
from app.extensions.stand.routes.figure_parameters import FigureParameters
from app.sources import opening
from app.store.records import Annotation, Content, UnknownError
from app.store.store import Store
from app.web.responses import BadRequestError, Body, Number, as_bad_request, json_reply
from app.web.routes.access import (
    Dash,
    Edit,
    Metres,
    ViewerTurn,
    apply_edit,
    edited,
    in_thread,
)
from pipeline.errors import StemmapError

router = APIRouter(prefix="/api")

MOST_PLOTS = 500
_DETOUR_S = 60.0
_MOST_CORNERS = 20_000  # of all plots, which every browser receives with each edit
_LONGEST_NAME = 60
_Size = Annotated[float, Field(gt=0.0, le=2000.0)]
_Point = Annotated[list[Metres], Field(min_length=2, max_length=2)]
_Ring = Annotated[list[_Point], Field(min_length=3, max_length=5000)]
_Name = Annotated[str, Field(max_length=_LONGEST_NAME)]
# Without a separator, so that it stays in its folder.
_FileName = Annotated[str, Field(pattern=r"^[^/\\\x00]{1,100}\.[A-Za-z]{3,7}$")]


class _Circle(Body):
    kind: Literal["circle"]
    x: Metres
    y: Metres
    radius: Annotated[float, Field(gt=0.0, le=600.0)]


class _Rectangle(Body):
    """A rectangle by its centre; `turn_deg` is the angle of its length from x towards y."""

    kind: Literal["rectangle"]
    x: Metres
    y: Metres
    length: _Size
    width: _Size
    turn_deg: Annotated[float, Field(ge=-360.0, le=360.0)] = 0.0


class _Polygon(Body):
    """An area by the coordinates of a GeoJSON MultiPolygon."""

    kind: Literal["polygon"]
    polygons: Annotated[
        list[Annotated[list[_Ring], Field(min_length=1, max_length=100)]], Field(min_length=1, max_length=100)
    ]


class _Plot(Body):
    """A plot; without a name it gets the next free number."""

    name: _Name = ""
    shape: Annotated[_Circle | _Rectangle | _Polygon, Field(discriminator="kind")]


class _AddPlot(Edit):
    plots: Annotated[list[_Plot], Field(min_length=1, max_length=MOST_PLOTS)]


class _Along(Edit):
    """Circles of `radius` whose centres are `every` apart along the path [m]."""

    every: Annotated[float, Field(gt=0.0, le=1e4)]
    radius: Annotated[float, Field(gt=0.0, le=500.0)]


class _PlotChange(Edit):
    """A new name, or a new radius of a circle [m]; None leaves it."""

    version: Number
    name: Annotated[str, Field(min_length=1, max_length=_LONGEST_NAME)] | None = None
    radius: Annotated[float, Field(gt=0.0, le=600.0)] | None = None


class _ImportPlots(Edit):
    """Files by name, in base64: one, or the parts of a Shapefile. `crs` is the reference system of a file
    without one, "local" or ""."""

    files: Annotated[
        dict[_FileName, Annotated[str, Field(max_length=1_000_000)]], Field(min_length=1, max_length=8)
    ]
    crs: Annotated[str, Field(max_length=100)] = ""


@router.get("/plots", dependencies=[ViewerTurn])
async def figures(dashboard: Dash, parameters: FigureParameters) -> Response:
    """Return an object with `all` and `plots`, the results of `stand_record` for the whole observed area and
    for the plots, and `problem`, the reason why one of them is missing, else "". `plots` is
    null if there are no plots, and both are null before the first map."""
    if dashboard.shown is None:
        return json_reply({"all": None, "plots": None, "problem": ""})
    return json_reply(await asyncio.to_thread(_figures, ShownRun.of(dashboard), parameters))


@router.get("/detour", dependencies=[ViewerTurn])
async def detour(dashboard: Dash) -> Response:
    """Return the way that shows trees without a diameter from further sides, see
    `app.extensions.stand.questions.detour`; a child process computes it, one at a time. 409 before the first
    map, 422 if it takes too long."""
    run = ShownRun.of(dashboard)
    trees, sides = run.shown.frame.trees, dict[int, int]()
    if trees.sides is not None:
        lacking = trees.confirmed & np.isnan(trees.dbh)
        sides = dict(zip(trees.number[lacking].tolist(), trees.sides[lacking].tolist(), strict=True))
    with as_bad_request():
        async with dashboard.exporting, in_thread(run.folder()) as folder:
            try:
                question = {"ask": DETOUR, "path": str(folder), "sides": sides}
                return json_reply(await opening.ask(question, patience_s=_DETOUR_S))
            except opening.TookTooLongError:
                raise StemmapError(
                    f"the way takes longer than {_DETOUR_S:.0f} s to find",
                    remedy="The arcs around the trees show the sides that were never seen",
                ) from None


@router.post("/plots")
async def add(body: _AddPlot, dashboard: Dash) -> Response:
    """Add plots in one edit; return their numbers (`ids`) and the counts of edits, see `edited`, with 201.
    409 if another run was opened meanwhile, 422 for a shape that is no area, a name that is taken, too many
    plots or corners, or if all are outside of a whole cloud."""
    return await _added(dashboard, body, [(plot.name, plot.shape.model_dump()) for plot in body.plots])


@router.post("/plots/along")
async def add_along(body: _Along, dashboard: Dash) -> Response:
    """Add circles along the path in one edit; responses as in `add`, and 409 before the first scan, 422 if
    there would be too many or, as the path is shorter than half of `every`, none, or for a whole cloud."""
    if dashboard.path is None:
        raise NothingMappedError
    if dashboard.status.one_step is not None:
        raise BadRequestError("a whole cloud has no path", remedy="Draw or type plots, or import a file")
    with as_bad_request():
        centres = centres_along(dashboard.path_xy, body.every).round(3).tolist()
    circles = [{"kind": "circle", "x": x, "y": y, "radius": body.radius} for x, y in centres]
    return await _added(dashboard, body, [("", shape) for shape in circles])


@router.post("/plots/import")
async def import_file(body: _ImportPlots, dashboard: Dash) -> Response:
    """Add the plots of a GIS file, which a child process reads, in one edit; names that are taken get a
    number. Responses as in `add`, and 409 before the first scan, 422 if the file cannot be read."""
    run = ShownRun.of(dashboard)
    with TemporaryDirectory(prefix="stemmap-plots-") as folder:
        file = await asyncio.to_thread(_written, body.files, FilePath(folder))
        async with in_thread(run.folder()) as run_folder:
            question = {
                "ask": PLOTS_OF_FILE,
                "path": str(file),
                "run": str(run_folder),
                "crs": body.crs.strip(),
            }
            with as_bad_request(where=file.name):
                read = await opening.ask(question)
    x, y = dashboard.offset
    moved = [
        [[[[px - x, py - y] for px, py in ring] for ring in part] for part in plot["polygons"]]
        for plot in read["plots"]
    ]
    taken, named = _names(dashboard), []
    for plot, polygons in zip(read["plots"], moved, strict=True):
        name = _free(" ".join(plot["name"].split())[: _LONGEST_NAME - 6].rstrip(), taken)
        taken.add(name)
        named.append((name, {"kind": "polygon", "polygons": polygons}))
    return await _added(dashboard, body, named)


@router.patch("/plots/{number}")
async def change(body: _PlotChange, number: Number, dashboard: Dash) -> Response:
    """Rename a plot, or change the radius of a circle; return its number (`id`) and the counts of edits, see
    `edited`. 404 for an unknown plot, 409 if it does not have this version any more or another run was
    opened, 422 for a name that is empty or taken, or the radius of another shape."""
    row = next((row for row in _rows(dashboard) if row.id == number), None)
    if row is None or row.content.values is None:
        raise UnknownError("there is no such plot", where=f"plot {number}")
    plot = dict(row.content.values)
    if body.name is not None:
        plot["name"] = _checked_name(body.name, _names(dashboard) - {plot["name"]})
    if body.radius is not None:
        if plot["shape"]["kind"] != "circle":
            raise BadRequestError("only a circle has a radius", where=f"plot {number}")
        plot["shape"] = {**plot["shape"], "radius": body.radius}
    content = replace(row.content, values=plot)
    await apply_edit(dashboard, body, Store.change, number, body.version, content)
    return await edited(dashboard, body, {"id": number})


async def _added(dashboard: Dashboard, body: Edit, plots: Sequence[tuple[str, dict[str, Any]]]) -> Response:
    """Add plots in one edit, and return the response 201 with their `ids`, see `edited`. `plots` has the name
    ("" for the next free number) and the shape (dict, see `plot_of`) of each plot. Raises BadRequestError if
    a shape or name is not valid, a name is taken, there would be too many plots or corners, or all are
    outside of a whole cloud; errors of `apply_edit` and `edited` pass through."""
    taken, contents = _names(dashboard), []
    for name, shape in plots:
        name = _checked_name(name, taken) if name else _free("", taken)
        taken.add(name)
        with as_bad_request():
            middle = plot_of(name, shape).shape.centroid
        contents.append(Content(middle.x, middle.y, PLOT, None, {"name": name, "shape": shape}))
    rows = _rows(dashboard)
    corners = sum(_corners(c.values or {}) for c in (*(row.content for row in rows), *contents))
    if len(rows) + len(contents) > MOST_PLOTS or corners > _MOST_CORNERS:
        raise BadRequestError(
            f"a run can have at most {MOST_PLOTS} plots with {_MOST_CORNERS} corners",
            remedy="Simplify the plots, or use stemmap stand --plots FILE",
        )
    with as_bad_request():
        _check_extent(dashboard, [plot_of(name, shape).shape for name, shape in plots])
    ids = await apply_edit(dashboard, body, Store.add, contents)
    return await edited(dashboard, body, {"ids": ids}, 201)


def _check_extent(dashboard: Dashboard, shapes: Sequence[Any]) -> None:
    """Raise a StemmapError if all shapes, polygons in the frame of the map, lie outside of a whole cloud. A
    drive may still reach them."""
    shown = dashboard.shown
    counts = None if dashboard.status.one_step is None or shown is None else shown.counts
    if counts is None or counts.covered is None or not len(counts.covered):
        return
    from app.extensions.stand.run_figures import extent_words

    corners = np.stack([counts.covered.min(axis=0), counts.covered.max(axis=0)])
    if not shapely.box(*corners.ravel()).intersects(shapely.union_all(shapes)):
        raise StemmapError(
            f"{'the plot is' if len(shapes) == 1 else 'all plots are'} outside of the cloud",
            remedy=f"Check the coordinates; the cloud has {extent_words(corners + dashboard.offset)}",
        )


def _names(dashboard: Dashboard) -> set[str]:
    """Return the names of the plots of the open run."""
    return {row.content.values["name"] for row in _rows(dashboard) if row.content.values}


def _rows(dashboard: Dashboard) -> list[Annotation]:
    """Return the annotations that are plots of the open run; other extensions have other classes."""
    return [row for row in dashboard.annotation_editor.others if row.content.kind == PLOT]


def _checked_name(name: str, taken: set[str]) -> str:
    """Return a name with its spaces merged; raises BadRequestError if it is empty, not printable or taken."""
    merged = " ".join(name.split())
    if not merged or not merged.isprintable():
        raise BadRequestError("the name is empty or has characters that cannot be shown", where="name")
    if merged in taken:
        raise BadRequestError(f"another plot is called {merged!r}", remedy="Choose another name")
    return merged


def _free(name: str, taken: set[str]) -> str:
    """Return a name that is not in `taken`: the name itself if it is free, else the name with the next free
    number from 2 in parentheses. For an empty name, return the next free number from 1 as text; for a name
    that is not printable, the next free number from 2. `taken` is not modified."""
    if name and name.isprintable() and name not in taken:
        return name
    names = (f"{name} ({k})" if name and name.isprintable() else str(k) for k in count(2 if name else 1))
    return next(each for each in names if each not in taken)


def _corners(plot: Mapping[str, Any]) -> int:
    """Return the number of corners of the polygons of a plot; 0 for other shapes."""
    return sum(len(ring) for part in plot["shape"].get("polygons", ()) for ring in part)


def _written(files: Mapping[str, str], folder: FilePath) -> FilePath:
    """Write files, a dict from names to their bytes in base64, to a folder. Return the path of the file that
    is read: the first one with a suffix of SUFFIXES, in the order of SUFFIXES. Raises BadRequestError if
    there is none, or for other text than base64."""
    from app.extensions.stand.plot_files import SUFFIXES

    for name, text in files.items():
        try:
            (folder / name).write_bytes(base64.b64decode(text, validate=True))
        except (binascii.Error, ValueError):
            raise BadRequestError("the file was not transferred completely", where=name) from None
    for suffix in SUFFIXES:
        for name in files:
            if name.lower().endswith(suffix):
                return folder / name
    raise BadRequestError(
        "there is no file of plots", remedy="Choose a .gpkg, .geojson or .zip, or all parts of a Shapefile"
    )


def _figures(run: ShownRun, parameters: Stand) -> dict[str, Any]:
    """Return the content of the response of the route `figures` as a dict. A StemmapError of `stand_of`
    becomes `problem`; parts that are not computed are None."""
    from app.extensions.stand.run_figures import stand_of, stand_record

    found: dict[str, Any] = {"all": None, "plots": None, "problem": ""}
    with run.folder() as folder:
        try:
            found["all"] = stand_record(stand_of(folder, parameters))
            if plots := plots_of_run(run):
                found["plots"] = stand_record(stand_of(folder, parameters, plots))
        except StemmapError as error:
            found["problem"] = f"{error.what}. {error.remedy}".strip()
    return found
