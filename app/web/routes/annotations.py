"""Ground truth trees that people annotate: list, add, change, delete, undo, redo, import, export."""

from __future__ import annotations

import json
import re
from typing import Annotated, Any, Literal

import msgspec
from fastapi import APIRouter, Path, Request
from msgspec import Meta
from starlette.responses import Response

from app.dashboard.annotations import Against, contents_of, row_payload
from app.dashboard.dashboard import Dashboard
from app.dashboard.user import NAME
from app.store.records import MOST_ANNOTATIONS, Author, Content, UnknownError, moment
from app.web.responses import BadRequestError, body_of, failure_reply, json_reply, table_reply
from app.web.routes.access import Dash
from pipeline.errors import SourceError

router = APIRouter(prefix="/api")

# Eastings and northings of the earth are smaller.
_FARTHEST_M = 1e7
_BROWSER = r"^[0-9a-f]{16,40}\Z"
_WHO = NAME

_Id = Annotated[int, Meta(ge=0, le=2**31 - 1)]
_Number = Annotated[int, Path(ge=0, le=2**31 - 1)]
_Metres = Annotated[float, Meta(ge=-_FARTHEST_M, le=_FARTHEST_M)]
_Columns = ("x_m", "y_m", "dbh_cm", "class", "who", "edited")


class _Edit(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What every edit says: for which run, from which browser, by whom."""

    run: _Id
    browser: Annotated[str, Meta(pattern=_BROWSER)]
    who: Annotated[str, Meta(pattern=_WHO)]

    @property
    def author(self) -> Author:
        return Author(self.browser, self.who)


class _Add(_Edit, frozen=True, forbid_unknown_fields=True):
    x: _Metres
    y: _Metres
    kind: Literal["tree", "pole", "person", "bush", "other"] = "tree"
    dbh_cm: Annotated[float, Meta(gt=0.0, le=1000.0)] | None = None

    @property
    def content(self) -> Content:
        return Content(self.x, self.y, self.kind, None if self.dbh_cm is None else self.dbh_cm / 100.0)


class _Change(_Add, frozen=True, forbid_unknown_fields=True, kw_only=True):
    version: _Id


class _Delete(_Edit, frozen=True, forbid_unknown_fields=True):
    version: _Id


@router.get("/annotations")
async def read(dashboard: Dash, browser: str = "") -> Response:
    """All of the run, and how many steps a browser can undo and redo."""
    steps = None
    if re.fullmatch(_BROWSER, browser):
        steps = await dashboard.annotating.read(lambda store, run: store.steps(run, browser))
    undo, redo = steps or (0, 0)
    return json_reply({**dashboard.annotating.as_plain(), "undo": undo, "redo": redo})


@router.post("/annotations")
async def add(request: Request, dashboard: Dash) -> Response:
    """Add one."""
    wanted: _Add = await body_of(request, _Add)
    (added,) = await dashboard.annotating.edit(
        wanted.run, lambda store: store.add(wanted.run, wanted.author, [wanted.content])
    )
    return await _done(dashboard, wanted, {"id": added}, 201)


@router.patch("/annotations/{number}")
async def change(request: Request, number: _Number, dashboard: Dash) -> Response:
    """Change one; refused with 409 where it is not of the given version any more."""
    wanted: _Change = await body_of(request, _Change)
    try:
        await dashboard.annotating.edit(
            wanted.run,
            lambda store: store.change(wanted.run, wanted.author, number, wanted.version, wanted.content),
        )
    except UnknownError as error:
        return failure_reply(404, error)
    return await _done(dashboard, wanted, {"id": number})


@router.delete("/annotations/{number}")
async def delete(request: Request, number: _Number, dashboard: Dash) -> Response:
    """Delete one; refused as a change is."""
    wanted: _Delete = await body_of(request, _Delete)
    try:
        await dashboard.annotating.edit(
            wanted.run, lambda store: store.delete(wanted.run, wanted.author, number, wanted.version)
        )
    except UnknownError as error:
        return failure_reply(404, error)
    return await _done(dashboard, wanted, {"id": number})


@router.post("/annotations/undo")
async def undo(request: Request, dashboard: Dash) -> Response:
    """Undo the browser's last step."""
    wanted: _Edit = await body_of(request, _Edit)
    await dashboard.annotating.edit(wanted.run, lambda store: store.undo(wanted.run, wanted.author))
    return await _done(dashboard, wanted, {})


@router.post("/annotations/redo")
async def redo(request: Request, dashboard: Dash) -> Response:
    """Do again what the browser undid last."""
    wanted: _Edit = await body_of(request, _Edit)
    await dashboard.annotating.edit(wanted.run, lambda store: store.redo(wanted.run, wanted.author))
    return await _done(dashboard, wanted, {})


class _Import(_Edit, frozen=True, forbid_unknown_fields=True):
    """A table of trees as text; the unit of a column `dbh` that does not say it."""

    table: str
    dbh_unit: Literal["m", "cm", "mm"] | None = None


@router.post("/annotations/import")
async def import_table(request: Request, dashboard: Dash) -> Response:
    """Add the rows of a CSV in one step; those that stand already are left out and counted."""
    from pipeline.io.ground_truth import parse_truth_trees

    wanted: _Import = await body_of(request, _Import)
    try:
        table = parse_truth_trees(
            wanted.table.removeprefix("\ufeff"), where="the table", dbh_unit=wanted.dbh_unit
        )
    except SourceError as error:
        remedy = "Say the unit of the diameter" if "unit" in error.what else error.remedy
        raise BadRequestError(error.what, where=error.where, remedy=remedy) from None
    contents = contents_of(table)
    for line, content in enumerate(contents):
        _check(content, line)
    if len(contents) > MOST_ANNOTATIONS:
        raise BadRequestError(f"a run may have {MOST_ANNOTATIONS} annotations")
    standing = {_key(row.content) for row in dashboard.annotating.rows}
    new = [content for content in contents if _key(content) not in standing]
    if new:
        await dashboard.annotating.edit(wanted.run, lambda store: store.add(wanted.run, wanted.author, new))
    return await _done(dashboard, wanted, {"added": len(new), "left_out": len(contents) - len(new)})


class _Choice(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the map is scored against."""

    against: Against


@router.put("/annotations/against")
async def score_against(request: Request, dashboard: Dash) -> Response:
    """Choose what the map is scored against; nothing of it is changed."""
    wanted: _Choice = await body_of(request, _Choice)
    dashboard.annotating.score_against(wanted.against)
    return json_reply(dashboard.annotating.as_plain())


@router.get("/annotations.csv")
async def export_table(dashboard: Dash) -> Response:
    """The annotations as a table that the import and `stemmap evaluate` take."""
    from pipeline.io.result_files import csv_text

    return table_reply(csv_text(_Columns, [_row(row) for row in _rows(dashboard)]), "truth.csv")


@router.get("/annotations.geojson")
async def export_geojson(dashboard: Dash) -> Response:
    """The annotations as a FeatureCollection in the frame of the map, which it declares."""
    from pipeline.io.result_files import ROBOTS_FRAME

    features = [_feature(row) for row in _rows(dashboard)]
    collection = {
        "type": "FeatureCollection",
        "coordinateFrame": dict(ROBOTS_FRAME),
        "features": features,
    }
    return table_reply(json.dumps(collection, indent=1) + "\n", "truth.geojson", "application/geo+json")


async def _done(dashboard: Dashboard, edit: _Edit, said: dict[str, Any], status: int = 200) -> Response:
    serial = dashboard.annotating.serial
    steps = await dashboard.annotating.read(lambda store, run: store.steps(run, edit.browser))
    undo_count, redo_count = steps or (0, 0)
    return json_reply({**said, "serial": serial, "undo": undo_count, "redo": redo_count}, status)


def _rows(dashboard: Dashboard) -> list[dict[str, Any]]:
    return [row_payload(row) for row in dashboard.annotating.rows]


def _feature(row: dict[str, Any]) -> dict[str, Any]:
    properties = {"class": row["kind"], "dbh_cm": row["dbh_cm"], "who": row["who"], "edited": _when(row)}
    geometry = {"type": "Point", "coordinates": [row["x"], row["y"]]}
    return {"type": "Feature", "id": row["id"], "geometry": geometry, "properties": properties}


def _row(row: dict[str, Any]) -> list[str]:
    dbh = "" if row["dbh_cm"] is None else f"{row['dbh_cm']:.2f}"
    return [f"{row['x']:.4f}", f"{row['y']:.4f}", dbh, row["kind"], row["who"], _when(row)]


def _when(row: dict[str, Any]) -> str:
    return moment(row["at_s"] * 1_000_000_000)


def _key(content: Content) -> tuple[float, float, str]:
    """What makes two rows the same: kind and place to the millimetre."""
    return round(content.x, 3), round(content.y, 3), content.kind


def _check(content: Content, row: int) -> None:
    """Refuse what a person could not have typed in either."""
    if max(abs(content.x), abs(content.y)) > _FARTHEST_M:
        raise BadRequestError(f"row {row + 1} lies farther than {_FARTHEST_M:.0f} m away")
    if content.dbh is not None and content.dbh > 10.0:
        raise BadRequestError(
            f"row {row + 1} has a DBH of {content.dbh:.1f} m", remedy="Check the unit of the diameter"
        )
