"""The reference system of the map of the open run, by control points, GNSS or by hand.

It is an annotation of the class `frame`: undo, redo and deletion are routes of `app.web.routes.annotations`.
"""

from __future__ import annotations

import asyncio
from pathlib import Path as FilePath
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

from fastapi import APIRouter
from pydantic import Field
from starlette.responses import Response

from app.dashboard.shown_run import ShownRun
from app.extensions.stand import POINT_SIGMA
from app.extensions.stand.georeference import NAME_MAX
from app.extensions.stand.questions import GEOREFERENCE, POINTS_OF_TABLE
from app.sources import opening
from app.store.records import FRAME, Content
from app.store.store import Store
from app.web.responses import BadRequestError, Body, Number, as_bad_request, json_reply
from app.web.routes.access import Dash, Edit, Metres, apply_edit, edited, in_thread
from pipeline.io.readers.base import COORDINATE_LIMIT

router = APIRouter(prefix="/api")

# Reading the fixes of a long recording.
_GNSS_PATIENCE_S = 300.0
_MOST_POINTS = 200  # every browser receives them with each edit of an annotation
_LONGEST_CRS = 100
_Coordinate = Annotated[float, Field(gt=-COORDINATE_LIMIT, lt=COORDINATE_LIMIT)]


class _ControlPoint(Body):
    """A control point: a tree by its number, or a place on the map."""

    name: Annotated[str, Field(max_length=NAME_MAX)] = ""
    east: _Coordinate
    north: _Coordinate
    tree: Number | None = None
    x: Metres | None = None
    y: Metres | None = None
    z: _Coordinate | None = None


class _ControlPoints(Body):
    """Two or more points."""

    how: Literal["control"]
    points: Annotated[list[_ControlPoint], Field(max_length=_MOST_POINTS, default_factory=list)]
    point_sigma: Annotated[float, Field(gt=0.0, le=100.0)] = POINT_SIGMA


class _Gnss(Body):
    how: Literal["gnss"]


class _ByHand(Body):
    """Position of the map's origin, and the angle of its x axis from east to north."""

    how: Literal["hand"]
    east: _Coordinate
    north: _Coordinate
    turn_deg: Annotated[float, Field(ge=-360.0, le=360.0)] = 0.0
    z: _Coordinate = 0.0


_Crs = Annotated[str, Field(min_length=1, max_length=_LONGEST_CRS)]


class _Table(Body):
    """A CSV table of control points as text."""

    crs: _Crs
    table: Annotated[str, Field(max_length=1_000_000)]


class _Georeference(Edit):
    crs: _Crs
    by: Annotated[_ControlPoints | _Gnss | _ByHand, Field(discriminator="how")]


@router.post("/georeference/points")
async def points_of_table(body: _Table, dashboard: Dash) -> Response:
    """Return the control points of a table, which a child process reads, without storing them: `points`, with
    the fields of `_ControlPoint` and null for what could not be read, and `faults`, a list of [index of the
    point, text]. 422 if the table has too many points or another fault than those of single rows."""
    with TemporaryDirectory(prefix="stemmap-points-") as folder:
        file = FilePath(folder) / "points.csv"
        await asyncio.to_thread(file.write_text, body.table, encoding="utf-8")
        with as_bad_request(where=""):
            found = await opening.ask({"ask": POINTS_OF_TABLE, "path": str(file), "crs": body.crs.strip()})
    if len(found["points"]) > _MOST_POINTS:
        raise BadRequestError(
            f"a run can have at most {_MOST_POINTS} control points",
            remedy="Leave some out, or use stemmap georeference --control FILE",
        )
    x, y = dashboard.offset
    for point in found["points"]:
        if point["x"] is not None and point["y"] is not None:
            point.update(_placed(point, (-x, -y)))
    return json_reply(found)


@router.put("/georeference")
async def georeference(body: _Georeference, dashboard: Dash) -> Response:
    """Find the reference system of the map as `stemmap georeference` does, in a child process, and store it
    in one edit, in place of the one before; files and figures have it from then on. Return the counts of
    edits, see `edited`. 409 before the first map, or if another run was opened or the reference system was
    changed meanwhile; 422 if the values contradict one another or do not fit
    the reference system."""
    run, by = ShownRun.of(dashboard), body.by.model_dump()
    offset = dashboard.offset
    async with in_thread(run.folder()) as folder:
        question: dict[str, Any] = {"ask": GEOREFERENCE, "path": str(folder), "crs": body.crs.strip(), **by}
        if isinstance(body.by, _ControlPoints):
            question["points"] = [_named(point, k, offset) for k, point in enumerate(by["points"], 1)]
        elif isinstance(body.by, _Gnss):
            question["start_ns"] = run.start_ns
        with as_bad_request(where=""):
            found = await opening.ask(question, patience_s=_GNSS_PATIENCE_S)
    points = [_named(point, 0, (-offset[0], -offset[1])) for point in found["points"]]
    crs = found["frame"]["crs"]
    if len(crs) > _LONGEST_CRS:  # WKT; what was typed can be sent again
        crs = body.crs.strip()
    values = {**by, "points": points, "crs": crs, "frame": found["frame"]}
    content, before = Content(0.0, 0.0, FRAME, None, values), dashboard.annotation_editor.frame
    if before is None:
        await apply_edit(dashboard, body, Store.add, [content])
    else:
        await apply_edit(dashboard, body, Store.change, before.id, before.version, content)
    return await edited(dashboard, body, {})


def _named(point: dict[str, Any], number: int, offset: tuple[float, float]) -> dict[str, Any]:
    """Return a control point as a new dict with a name. For a tree, the default name is the number of the
    tree, and `x` and `y` are None. For another point, the default name is `number`, and `offset` is added to
    `x` and `y`, rounded to micrometres. Raises BadRequestError for a point with neither a tree nor `x` and
    `y`.

    Args:
        point: The fields of `app.batch.map_frame.ControlPoint`.
        number: Number of the point.
        offset: x, y [m] that are added to the position.
    """
    if point["tree"] is not None:
        return {**point, "name": point["name"] or str(point["tree"]), "x": None, "y": None}
    if point["x"] is None or point["y"] is None:
        raise BadRequestError(
            f"point {point['name'] or number} has no place on the map",
            remedy="Pick it on the map, or name a tree",
        )
    return {**point, "name": point["name"] or str(number), **_placed(point, offset)}


def _placed(point: dict[str, Any], offset: tuple[float, float]) -> dict[str, float]:
    """Return `x` and `y` of a point with an offset, rounded to micrometres."""
    return {"x": round(point["x"] + offset[0], 6), "y": round(point["y"] + offset[1], 6)}
