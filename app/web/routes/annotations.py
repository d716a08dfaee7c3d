"""Annotated ground truth trees: list, add, change, delete, undo, redo, import, export."""

from __future__ import annotations

import asyncio
import json
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
import numpy as np
from fastapi import APIRouter
from pydantic import Field
from starlette.responses import Response

from app.batch.run_edits import SAME_THING, annotation_of_tree, reach_at
from app.common.user import is_user_name
from app.dashboard.annotations import (
    SAME_PLACE,
    Against,
    carried_back,
    import_plan,
    is_doubtful_dbh,
    row_payload,
    usual_dbh,
)
from app.dashboard.dashboard import Dashboard
from app.store.records import (
    KINDS,
    MOST_ANNOTATIONS,
    REPAIR,
    SKIPPED,
    Annotation,
    Author,
    Content,
    StaleError,
    contents_of,
    moment,
)
from app.store.store import Store
from app.web.responses import BadRequestError, Body, Number, json_reply, text_reply
from app.web.routes.access import BROWSER, FARTHEST_M, Dash, Edit, Metres, apply_edit, edited
from pipeline.errors import SourceError
from pipeline.repairs.record import Repair
from pipeline.types.records import Trees

if TYPE_CHECKING:
    from pipeline.io.csv_table import CsvTable

router = APIRouter(prefix="/api")

_LARGEST_DBH_M = 10.0
_AT_TREE_M = 0.1  # an answer is given at the tree, which moves in a live map until it arrives
_FEW_DIAMETERS = 3  # of a table and of the map, whose median tells the unit
_MOST_NAMED = 500  # contradictions, replacements and doubts of an import that are named, each
_Columns = ("x_m", "y_m", "dbh_cm", "class", "who", "dbh_who", "edited", "tree")


class _AddAnnotation(Edit):
    x: Metres
    y: Metres
    kind: Literal["tree", "pole", "person", "bush", "other", "skipped"] = "tree"
    dbh_cm: Annotated[float, Field(gt=0.0, le=100.0 * _LARGEST_DBH_M)] | None = None

    @property
    def content(self) -> Content:
        """Content of the annotation, with the DBH in metres."""
        return Content(self.x, self.y, self.kind, None if self.dbh_cm is None else self.dbh_cm / 100.0)


class _AnnotationChange(_AddAnnotation):
    version: Number


class _Delete(Edit):
    version: Number


class _Turn(Edit):
    """Undo or redo; `subjects` are those of the tab in which it is pressed, see `Store.steps`."""

    subjects: Annotated[list[Annotated[str, Field(max_length=10)]], Field(max_length=10, default=[])]


class _ImportTable(Edit):
    """A table of trees as text, and the name of its file; `dbh_unit` is the unit of a column `dbh` whose
    header does not name it. With `replaces` a row replaces the class and the diameter of its annotation, see
    `import_plan`."""

    table: Annotated[str, Field(max_length=1_000_000)]
    file: Annotated[str, Field(max_length=300)] = ""
    replaces: bool = False
    dbh_unit: Literal["m", "cm", "mm"] | None = None

    @property
    def author(self) -> Author:
        """The import: what a table states is no answer of the person who imports it."""
        name = re.sub(r"[^\w .@-]", "_", self.file)
        return Author(self.browser, f"import of {name}"[:40].rstrip() if name else "import")


class _TruthChoice(Body):
    """The ground truth that the map is scored against."""

    against: Against


@router.get("/annotations")
async def read(dashboard: Dash, browser: str = "") -> Response:
    """Return the annotations of the run, and how many edits this browser can undo and redo, see
    `Store.steps`; none without a run or with an invalid name of the browser."""
    steps = None
    if re.fullmatch(BROWSER, browser):
        steps = await dashboard.annotation_editor.read(lambda store, run: store.steps(run, browser))
    undo, redo = steps or ({}, {})
    return json_reply({**dashboard.annotation_editor.as_plain(), "undo": undo, "redo": redo})


@router.post("/annotations")
async def add(body: _AddAnnotation, dashboard: Dash) -> Response:
    """Add an annotation, or mark a tree as skipped in the review (kind "skipped", which is no ground truth
    and not exported); return its number (`id`) and the counts of edits, see `edited`, with 201. 409 if
    another run was opened meanwhile, nothing can be annotated, the tree there has an annotation that states a
    class, or the run has MOST_ANNOTATIONS."""
    content = replace(body.content, reach=_reach_at(dashboard, body.x, body.y))
    trees = None if dashboard.shown is None else dashboard.shown.frame.trees

    def add_first(store: Store, run: int, author: Author) -> int:
        known = [row for row in store.annotations(run) if row.content.kind in (*KINDS, SKIPPED)]
        other = None if trees is None else _answer_before(trees, known, content)
        if other is not None and other.content.kind == content.kind and content.dbh is None:
            return other.id  # both agree
        if other is not None:
            raise StaleError(
                f"it was annotated by {other.who} meanwhile ({other.content.kind})",
                remedy="Your answer was not saved; select the tree again to replace it",
            )
        return store.add(run, author, [content])[0]

    added = await apply_edit(dashboard, body, add_first)
    return await edited(dashboard, body, {"id": added}, 201)


@router.patch("/annotations/{number}")
async def change(body: _AnnotationChange, number: Number, dashboard: Dash) -> Response:
    """Change an annotation; 409 if it does not have this version any more or another run was opened, 404 for
    an unknown one. Return its number (`id`) and the counts of edits, see `edited`."""
    content = replace(body.content, reach=await asyncio.to_thread(_reach_after, dashboard, number, body))
    await apply_edit(dashboard, body, Store.change, number, body.version, content)
    return await edited(dashboard, body, {"id": number})


@router.delete("/annotations/{number}")
async def delete(body: _Delete, number: Number, dashboard: Dash) -> Response:
    """Delete an annotation; with a repair, what it did to annotations of trees is taken back. 409 if it does
    not have this version any more or another run was opened, 404 for an unknown one. Return its number (`id`)
    and the counts of edits, see `edited`."""
    rows = [row for row in dashboard.annotation_editor.others if row.id == number]
    repairs = [msgspec.convert(row.content.values, Repair) for row in rows if row.content.kind == REPAIR]

    def remove(store: Store, run: int, author: Author) -> None:
        back = [each for repair in repairs for each in carried_back(repair, store.changed_with(number))]
        store.edit(run, author, (), [(number, body.version, None), *back])

    await apply_edit(dashboard, body, remove)
    return await edited(dashboard, body, {"id": number})


@router.post("/annotations/undo")
async def undo(body: _Turn, dashboard: Dash) -> Response:
    """Undo the last edit of the browser, of these subjects if there are any; return the counts of edits, see
    `edited`. 409 if there is none, if another person has changed the annotation since, or if another run was
    opened."""
    await apply_edit(dashboard, body, Store.undo, body.subjects)
    return await edited(dashboard, body, {})


@router.post("/annotations/redo")
async def redo(body: _Turn, dashboard: Dash) -> Response:
    """Repeat the edit that the browser undid last, of these subjects if there are any; return the counts of
    edits, see `edited`. 409 if there is none, if another person has changed the annotation since, or if
    another run was opened."""
    await apply_edit(dashboard, body, Store.redo, body.subjects)
    return await edited(dashboard, body, {})


@router.post("/annotations/import")
async def import_table(body: _ImportTable, dashboard: Dash) -> Response:
    """Add the rows of a CSV table, and the diameters that annotations lack, in one edit, see `import_plan`.
    The author of each is that of the row in a column `who`, and of its diameter that in a column `dbh_who`
    or, without it, `who`; else the import ("import of plot.csv"), also where the row names an author of the
    annotation that it changes.

    Return the number of added annotations (`added`), of diameters added to others (`filled`), of annotations
    whose class or diameter is replaced (`replaced`), of rows that exist already as annotations or earlier in
    the table (`left_out`), and of rows that are left out because they contradict an annotation or another row
    (`differing`), with the first _MOST_NAMED of each as text (`additions`, `fillings`, `replacements`,
    `differences`) and of the doubtful diameters (`doubts`, in all `doubtful`); of rows that are not exactly
    at the place of their annotation (`beside`), with the smallest and the largest distance (`beside_m`); and
    the counts of edits, see `edited`. 422 if the table cannot be read or has too many rows or rows with
    faults, of which the first 10 are named, 409 as in `add`; then nothing is stored. Without anything new
    there is no edit."""
    one_step = dashboard.status.one_step
    unit = (1.0, 1.0) if one_step is None else one_step.crs_unit
    contents, has_diameters = await asyncio.to_thread(_imported, body, dashboard.offset, unit)
    if dashboard.shown is not None:
        await asyncio.to_thread(_check_unit, dashboard.shown.frame.trees, contents)
    rows = dashboard.annotation_editor.rows
    choices = {"replaces": body.replaces, "has_diameters": has_diameters}
    plan = await asyncio.to_thread(import_plan, rows, contents, name=body.author.who, **choices)
    changed = [*plan.filled, *plan.replaced]
    before = {row.id: row.content for row in rows}
    name_of = _namer(dashboard)
    replacements = [
        _replacement(name_of(before[number]), before[number], content)
        for number, _, content in plan.replaced[:_MOST_NAMED]
        if content is not None
    ]
    differences = [_difference(name_of(here), here, there) for here, there in plan.conflicts[:_MOST_NAMED]]
    fillings = [
        f"{name_of(before[number])}: {_dbh_text(content.dbh)}"
        for number, _, content in plan.filled[:_MOST_NAMED]
        if content is not None
    ]
    added = [replace(each, reach=_reach_at(dashboard, each.x, each.y)) for each in plan.added]
    if added or changed:
        await apply_edit(dashboard, body, Store.edit, added, changed)
    name_of = _namer(dashboard)
    stored = [*added, *(content for _, _, content in changed if content is not None)]
    doubts = _doubts(dashboard, stored, name_of)
    payload = {
        "added": len(added),
        "additions": [f"{name_of(each)}: {each.kind}" for each in added[:_MOST_NAMED]],
        "filled": len(plan.filled),
        "fillings": fillings,
        "replaced": len(plan.replaced),
        "left_out": plan.repeated,
        "differing": len(plan.conflicts),
        "differences": differences,
        "replacements": replacements,
        "doubtful": len(doubts),
        "doubts": doubts[:_MOST_NAMED],
        "beside": len(plan.beside),
        "beside_m": [round(end(plan.beside), 3) for end in (min, max) if plan.beside],
    }
    return await edited(dashboard, body, payload)


@router.put("/annotations/against")
async def score_against(body: _TruthChoice, dashboard: Dash) -> Response:
    """Choose whether the map is scored against the ground truth of the source, the annotations or both, for
    all browsers; neither is changed. Return the annotations with this choice."""
    dashboard.annotation_editor.score_against(body.against)
    return json_reply(dashboard.annotation_editor.as_plain())


@router.get("/annotations.csv")
async def export_table(dashboard: Dash) -> Response:
    """Return the annotations as a CSV table for the import and for `stemmap evaluate`, those of a run of one
    step in the coordinates of its file; `tree` is the number of the tree that each is about in the map of the
    shown scan. Only the header without annotations."""
    from pipeline.io.result_files import csv_text

    return text_reply(csv_text(_Columns, [_row(row) for row in _rows(dashboard)]), "truth.csv")


@router.get("/annotations.geojson")
async def export_geojson(dashboard: Dash) -> Response:
    """Return the annotations as a FeatureCollection of points in the frame of the map, or of the file of a
    run of one step, which it declares, with class, DBH [cm], authors, time and number of the tree in
    the map of the shown scan; no features without annotations."""
    from pipeline.io.result_files import ROBOTS_FRAME

    frame = dict(ROBOTS_FRAME)
    if dashboard.status.one_step is not None:
        frame["origin"] = "that of the file"
    features = [_feature(row) for row in _rows(dashboard)]
    collection = {
        "type": "FeatureCollection",
        "coordinateFrame": frame,
        "features": features,
    }
    return text_reply(json.dumps(collection, indent=1) + "\n", "truth.geojson", "application/geo+json")


def _rows(dashboard: Dashboard) -> list[dict[str, Any]]:
    """Return the annotations of objects of the open run as dicts, see `row_payload`, with `tree`, the number
    of the tree that it is about in the map of the shown scan, None for none; for a run of one step, in the
    coordinates of its file."""
    x, y = dashboard.offset
    tree_of = _tree_numbers(dashboard)
    rows = [(row_payload(row), tree_of.get(row.content)) for row in dashboard.annotation_editor.rows]
    return [{**row, "x": row["x"] + x, "y": row["y"] + y, "tree": tree} for row, tree in rows]


def _reach_at(dashboard: Dashboard, x: float, y: float) -> float | None:
    """Return the reach of an annotation in the map of the shown scan, see `reach_at`."""
    if dashboard.shown is None:
        return None
    trees = dashboard.shown.frame.trees
    return reach_at(trees.position[trees.confirmed], (x, y))


def _answer_before(trees: Trees, known: Sequence[Annotation], content: Content) -> Annotation | None:
    """Return the annotation of the tree at whose place a new one is made, if it states a class or both are
    skips; None if there is none. Two people may answer for one tree at the same moment.

    Args:
        trees: Trees of the shown map.
        known: The annotations of objects and skipped trees.
        content: The new annotation.
    """
    position = trees.position[trees.confirmed]
    away = np.hypot(*(position - (content.x, content.y)).T)
    if not len(away) or away.min() >= _AT_TREE_M:
        return None
    row = annotation_of_tree(position, [each.content for each in known]).get(int(away.argmin()))
    if row is None or (known[row].content.kind == SKIPPED and content.kind != SKIPPED):
        return None
    return known[row]


def _reach_after(dashboard: Dashboard, number: int, body: _AnnotationChange) -> float | None:
    """Return the reach of an annotation after a change. It stays if neither place nor class changes, and if
    the annotation is about no tree of the shown map and stays near its place: it is about none then."""
    editor = dashboard.annotation_editor
    before = next((row.content for row in [*editor.rows, *editor.skipped] if row.id == number), None)
    if before is not None:
        moved = math.dist((body.x, body.y), (before.x, before.y))
        if before.kind != SKIPPED and before not in _tree_numbers(dashboard):
            stays = moved < SAME_THING
        else:
            stays = moved < SAME_PLACE and body.kind == before.kind
        if stays:
            return before.reach
    return _reach_at(dashboard, body.x, body.y)


def _tree_numbers(dashboard: Dashboard) -> dict[Content, int]:
    """Return a dict from each annotation that is about a tree of the map of the shown scan to the number of
    that tree, see `reviews_of`."""
    if dashboard.shown is None:
        return {}
    trees = dashboard.shown.frame.trees
    contents = [row.content for row in dashboard.annotation_editor.rows]
    of_tree = annotation_of_tree(trees.position[trees.confirmed], contents)
    numbers = trees.number[trees.confirmed].tolist()
    return {contents[k]: numbers[row] for row, k in of_tree.items()}


def _namer(dashboard: Dashboard) -> Callable[[Content], str]:
    """Return a function that returns what people call the thing of an annotation: its tree in the map of the
    shown scan, else its place."""
    numbers, (x, y) = _tree_numbers(dashboard), dashboard.offset

    def name_of(content: Content) -> str:
        number = numbers.get(content)
        place = f"{content.x + x:.2f}, {content.y + y:.2f}"
        return f"the annotation at {place}" if number is None else f"tree {number}"

    return name_of


def _dbh_text(dbh: float | None) -> str:
    """Return a diameter [m] for people, with at most 0.1 mm."""
    return "no DBH" if dbh is None else f"{100.0 * dbh:.2f}".rstrip("0").rstrip(".") + " cm"


def _range_text(dbh: tuple[float, float]) -> str:
    """Return a range of diameters [m] for people."""
    return f"{100.0 * dbh[0]:.0f} to {100.0 * dbh[1]:.0f} cm"


def _difference(name: str, here: Content, there: Content) -> str:
    """Return how a row of a table (`there`) contradicts the annotation at its place, which people call
    `name`."""
    if here.kind != there.kind:
        return f"{name} is {here.kind} here, {there.kind} in the file"
    return f"{name} has DBH {_dbh_text(here.dbh)} here, {_dbh_text(there.dbh)} in the file"


def _replacement(name: str, before: Content, after: Content) -> str:
    """Return how a row of a table changes the annotation that it replaces, which people call `name`."""
    was, now = (
        (before.kind, after.kind) if before.kind != after.kind else map(_dbh_text, (before.dbh, after.dbh))
    )
    return f"{name}: {was} -> {now}"


def _doubts(
    dashboard: Dashboard, contents: Sequence[Content], name_of: Callable[[Content], str]
) -> list[str]:
    """Return a text for each annotation with a doubtful DBH, see `is_doubtful_dbh`."""
    if dashboard.shown is None:
        return []
    trees, doubts = dashboard.shown.frame.trees, list[str]()
    rows = np.flatnonzero(trees.confirmed)
    usual = usual_dbh(trees.dbh[rows])
    tree_of = {of: rows[k] for k, of in annotation_of_tree(trees.position[rows], contents).items()}
    for k, content in enumerate(contents):
        mapped, sigma = math.nan, math.nan
        if (row := tree_of.get(k)) is not None:
            mapped, sigma = float(trees.dbh[row]), float(trees.dbh_sigma[row])
        if content.dbh is not None and is_doubtful_dbh(content.dbh, mapped, sigma, usual):
            known = f"{_dbh_text(mapped)} in the map"
            here = known if math.isfinite(mapped) else f"none in the map; usual are {_range_text(usual)}"
            doubts.append(f"{name_of(content)} has {_dbh_text(content.dbh)}, {here}")
    return doubts


def _feature(row: dict[str, Any]) -> dict[str, Any]:
    """Return an annotation, see `_rows`, as a GeoJSON feature (dict): a point at x, y with the `id` of the
    annotation and the properties `class`, `dbh_cm`, `who`, `dbh_who`, `edited` (time as text) and `tree`."""
    properties = {
        "class": row["kind"], "dbh_cm": row["dbh_cm"], "who": row["who"],
        "dbh_who": row["dbh_who"] or None, "edited": _when(row), "tree": row["tree"],
    }  # fmt: skip
    geometry = {"type": "Point", "coordinates": [row["x"], row["y"]]}
    return {"type": "Feature", "id": row["id"], "geometry": geometry, "properties": properties}


def _row(row: dict[str, Any]) -> list[str]:
    """Return an annotation, see `_rows`, as the cells of `_Columns`; the DBH is "" if it is unknown."""
    dbh = "" if row["dbh_cm"] is None else f"{row['dbh_cm']:.2f}"
    tree = "" if row["tree"] is None else str(row["tree"])
    return [
        f"{row['x']:.4f}",
        f"{row['y']:.4f}",
        dbh,
        row["kind"],
        row["who"],
        row["dbh_who"],
        _when(row),
        tree,
    ]


def _when(row: dict[str, Any]) -> str:
    """Return the time of the last edit of an annotation, see `_rows`, as text."""
    return moment(round(row["at_s"] * 1e9))


def _faults(content: Content) -> Iterator[SourceError]:
    """Yield what of a row of a table an annotation cannot have."""
    if abs(content.x) > FARTHEST_M or abs(content.y) > FARTHEST_M:
        yield SourceError(f"it is farther than {FARTHEST_M:,.0f} m from the origin")
    if content.dbh is not None and content.dbh > _LARGEST_DBH_M:
        yield SourceError(f"the DBH is {content.dbh:.1f} m", remedy="Check the unit of the diameter")
    for column, name in (("who", content.who), ("dbh_who", content.dbh_who)):
        if name and not is_user_name(name):
            yield SourceError(f"{column} = {name[:60]!r} is not a name")


def _check_unit(trees: Trees, contents: list[Content]) -> None:
    """Raise BadRequestError if the diameters of a table are in another unit than its header says: if the
    median of their ratios to those of the map is nearer to 10 or to 1/10 than to 1.

    Args:
        trees: Trees of the shown map.
        contents: The rows in the frame of the map.
    """
    position, mapped = trees.position[trees.confirmed], trees.dbh[trees.confirmed]
    rows = annotation_of_tree(position, contents)
    dbh = [(contents[k].dbh or np.nan) / mapped[row] for row, k in rows.items()]
    ratios = np.array([ratio for ratio in dbh if np.isfinite(ratio)])
    if len(ratios) >= _FEW_DIAMETERS and abs(np.log10(middle := float(np.median(ratios)))) > 0.5:
        raise BadRequestError(
            f"the diameters of the table are {middle:.2g} times those of the map, by the median of "
            f"{len(ratios)} trees",
            remedy="Check the unit of the diameter: the header names it, as dbh_cm or dbh_mm",
        )


def _imported(
    body: _ImportTable, offset: tuple[float, float], unit: tuple[float, float] = (1.0, 1.0)
) -> tuple[list[Content], bool]:
    """Return the rows of an imported table in the frame of the map, with their authors where the table names
    them, and whether it has a column of diameters; raises BadRequestError if it cannot be read, has too many
    rows or rows with faults. A table of a file in feet may be in feet or in metres, see `truth_in_metres`.

    Args:
        body: The request.
        offset: Offset of the frame of the map in the coordinates of the file [m].
        unit: Metres per unit of the reference system of the file, horizontal and vertical.
    """
    from app.batch.run_folder import truth_in_metres
    from pipeline.io.csv_table import CsvTable, refuse_faults
    from pipeline.io.ground_truth import DBH_COLUMNS, KIND_COLUMNS, Faults, truth_trees_of

    faults: Faults = []
    try:
        table = CsvTable(body.table.removeprefix("\ufeff"), "table of trees", "the table")
        if len(table.rows) > MOST_ANNOTATIONS:
            raise SourceError(f"a run can have at most {MOST_ANNOTATIONS} annotations")
        trees = truth_in_metres(truth_trees_of(table, faults, dbh_unit=body.dbh_unit), unit, offset)
        placed = contents_of(replace(trees, x=trees.x - offset[0], y=trees.y - offset[1]))
        authors = zip(placed, table.text("who"), table.text("dbh_who"), strict=True)
        contents = [replace(each, who=who, dbh_who=dbh_who) for each, who, dbh_who in authors]
        diameters = table.find(DBH_COLUMNS)
        if body.replaces and (kind := table.find(KIND_COLUMNS)) is not None:
            faults += _empty_classes(table, kind)
        faults += [] if diameters is None else _no_diameters(table, diameters)
        for k, content in enumerate(contents):
            for fault in _faults(content):
                what = f"line {table.lines[k]}: {fault.what}"
                faults.append((k, SourceError(what, where=table.where, remedy=fault.remedy)))
        refuse_faults(faults)
    except SourceError as error:
        remedy = "Choose the unit of the diameter" if "its unit" in error.what else error.remedy
        raise BadRequestError(error.what, where=error.where, remedy=remedy) from None
    return contents, diameters is not None


def _empty_classes(table: CsvTable, name: str) -> Iterator[tuple[int, SourceError]]:
    """Yield a fault for each row without a class, with which it would replace that of its annotation."""
    for k, text in enumerate(table.text(name)):
        if not text:
            yield k, SourceError(f"line {table.lines[k]}: no {name}", where=table.where)


def _no_diameters(table: CsvTable, name: str) -> Iterator[tuple[int, SourceError]]:
    """Yield a fault for each diameter of 0 or less; an empty cell states none."""
    for k, diameter in enumerate(table.numbers(name, required=False, faults={})):
        if diameter <= 0.0:
            yield k, SourceError(f"line {table.lines[k]}: {name} {diameter:g} is no DBH", where=table.where)
