"""What came of the run so far: trees, path, score and pair distances."""

from __future__ import annotations

import asyncio

from fastapi import APIRouter
from starlette.responses import Response

from app.dashboard.payload import trees_payload
from app.dashboard.scores import pairs_payload
from app.web.responses import json_reply, table_reply
from app.web.routes.access import Dash

router = APIRouter(prefix="/api")


@router.get("/trees")
async def trees(dashboard: Dash) -> Response:
    """The confirmed trees."""
    shown = dashboard.shown
    rows = [] if shown is None else trees_payload(shown.frame, dashboard.start_ns)
    return json_reply({"trees": rows})


@router.get("/trees.csv")
def trees_table(dashboard: Dash) -> Response:
    """The confirmed trees as a table."""
    from pipeline.io.result_files import TREE_COLUMNS, csv_text, tree_rows

    shown = dashboard.shown
    rows = [] if shown is None else tree_rows(shown.frame.trees, dashboard.start_ns)
    return table_reply(csv_text(TREE_COLUMNS, rows), "trees.csv")


@router.get("/path.csv")
def path_table(dashboard: Dash) -> Response:
    """The path, one row a scan."""
    from pipeline.io.result_files import PATH_COLUMNS, csv_text, path_rows

    path = dashboard.path
    rows = [] if path is None else path_rows(path, dashboard.start_ns)
    return table_reply(csv_text(PATH_COLUMNS, rows), "path.csv")


@router.get("/evaluation")
async def evaluation(dashboard: Dash) -> Response:
    """The score against the ground truth; null where there is none."""
    return json_reply(dashboard.scores.latest)


@router.get("/pairs")
async def pairs(dashboard: Dash) -> Response:
    """Distances between the trees, and their errors where the truth is known."""
    shown = dashboard.shown
    if shown is None:
        return json_reply({"numbers": [], "distance_m": [], "error_percent": None, "left_out": 0})
    match_distance = dashboard.parameters.parameters.evaluation.match_distance
    return json_reply(
        await asyncio.to_thread(pairs_payload, shown.frame.trees, dashboard.truth, match_distance)
    )
