"""Repairs of the map of the open run: add, import and save.

They are annotations of the class REPAIR: deletion, undo and redo are routes of `app.web.routes.annotations`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

import msgspec
from fastapi import APIRouter
from pydantic import Field
from starlette.responses import Response

from app.dashboard.annotations import carried_by
from app.dashboard.dashboard import Dashboard
from app.dashboard.selection import NothingMappedError
from app.store.records import REPAIR, Content
from app.store.store import Store
from app.web.responses import BadRequestError, Number, as_bad_request, text_reply
from app.web.routes.access import Dash, Edit, Metres, apply_edit, edited
from pipeline.repairs.record import MOST, Kind, Repair, numbers_at, parse_repairs, repairs_text, seen_from
from pipeline.repairs.trees import repaired_trees

router = APIRouter(prefix="/api")

_Place = Annotated[list[Metres], Field(min_length=2, max_length=2)]


class _AddRepair(Edit):
    """A repair: positions of trees in the map; of "forbid", the scans of both ends of the loop; the class."""

    kind: Kind
    places: Annotated[list[_Place], Field(max_length=2, default=[])]
    scans: Annotated[list[Number], Field(max_length=2, default=[])]
    value: Literal["", "tree", "pole", "person", "bush", "other"] = ""


class _ImportRepairs(Edit):
    """Text of a file of repairs."""

    text: Annotated[str, Field(max_length=1_000_000)]


@router.post("/repairs")
async def add(body: _AddRepair, dashboard: Dash) -> Response:
    """Add a repair; the annotations of moved and merged trees follow, at a repair of the path once the map
    has it. Return its number (`id`) and the counts of edits, see `edited`, with 201. 409 before the first map
    or if another run was opened meanwhile, 422 for a repair that is not valid, and for a tie of a position
    without a tree."""
    if len(dashboard.annotation_editor.repairs) >= MOST:
        raise BadRequestError(f"a run can have at most {MOST} repairs")
    repair = _repair(body, dashboard)
    moved, shown = _carried(dashboard, [repair]), dashboard.shown
    (added,) = await apply_edit(dashboard, body, Store.edit, [_content(repair)], moved)
    if repair.is_of_loop and shown is not None:
        trees, places = shown.frame.trees, [(x, y) for x, y in body.places]
        pair = numbers_at(trees, places, confirmed=True)
        dashboard.annotation_editor.await_map(added, body.author, repair, trees, pair)
    return await edited(dashboard, body, {"id": added}, 201)


@router.post("/repairs/import")
async def import_file(body: _ImportRepairs, dashboard: Dash) -> Response:
    """Add the repairs of a file in one edit, without those that the run has already; return their number
    (`added`) and the counts of edits, see `edited`. 422 if the text is no file of repairs."""
    with as_bad_request("the file"):
        known = dashboard.annotation_editor.repairs
        new = [repair for repair in parse_repairs(body.text, "the file") if repair not in known]
        if len(known) + len(new) > MOST:
            raise BadRequestError(f"a run can have at most {MOST} repairs")
    if new:
        moved = _carried(dashboard, new)
        await apply_edit(dashboard, body, Store.edit, [_content(repair) for repair in new], moved)
    return await edited(dashboard, body, {"added": len(new)})


@router.get("/repairs.json")
async def save(dashboard: Dash) -> Response:
    """Return the repairs as a file for the import and for `stemmap map --repairs`."""
    return text_reply(repairs_text(dashboard.annotation_editor.repairs), "repairs.json", "application/json")


def _repair(body: _AddRepair, dashboard: Dashboard) -> Repair:
    """Return the repair of a request. A tie gets the times at which its trees were seen and their positions
    in the frames of the robot, so that it holds where the path is another one.

    Raises:
        NothingMappedError: There is no map.
        BadRequestError: The repair is not valid, or has no tree at a position.
    """
    if dashboard.shown is None or dashboard.path is None:
        raise NothingMappedError
    path = dashboard.path
    places, stamps = [(x, y) for x, y in body.places], list[int]()
    if any(scan >= len(path.stamp_ns) for scan in body.scans):
        raise BadRequestError("the run has fewer scans")
    stamps = [int(path.stamp_ns[scan]) for scan in body.scans]
    if body.kind == "tie":
        views = [seen_from(dashboard.shown.frame.trees, path, place) for place in places]
        seen = [view for view in views if view is not None]
        if len(seen) < len(views):
            raise BadRequestError("there is no tree", remedy="Click two trees of the map")
        stamps, places = [at for at, _ in seen], [place for _, place in seen]
    repair = Repair(body.kind, tuple(places), tuple(stamps), body.value)
    if repair.problem:
        raise BadRequestError(repair.problem)
    return repair


def _carried(dashboard: Dashboard, repairs: Sequence[Repair]) -> list[tuple[int, int, Content | None]]:
    """Return the changes of the annotations with which new repairs are added, see `carried_by`; none without
    a map. Repairs that the shown map does not have yet come first."""
    if dashboard.shown is None:
        return []
    editor, trees = dashboard.annotation_editor, dashboard.shown.frame.trees
    for repair in editor.repairs:
        if repair not in dashboard.shown.repairs and not repair.is_of_loop:
            trees, _ = repaired_trees(trees, repair)
    return carried_by(trees, [*editor.rows, *editor.skipped], repairs)


def _content(repair: Repair) -> Content:
    """Return the annotation of a repair, at its first position."""
    x, y = repair.places[0] if repair.places else (0.0, 0.0)
    return Content(x, y, REPAIR, values=msgspec.to_builtins(repair))
