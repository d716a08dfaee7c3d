"""The results of the run: trees, path, scores, explanations and pictures."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import Annotated, Literal, NamedTuple

import numpy as np
from fastapi import APIRouter, Depends, Path, Query
from starlette.responses import Response

from app.dashboard.dashboard import Dashboard
from app.dashboard.payload import comparison_payload, doubts_of, packed, stages_payload, trees_payload
from app.dashboard.scores import pairs_payload
from app.dashboard.selection import NothingMappedError
from app.web.responses import (
    LARGEST_NUMBER,
    Body,
    Number,
    Word,
    block_reply,
    error_reply,
    failure_reply,
    file_reply,
    json_reply,
)
from app.web.routes.access import Bounds, Dash, ViewerTurn
from app.worker.protocol import CloudFrame, Shown
from pipeline.config import Parameters
from pipeline.errors import StemmapError
from pipeline.types.records import Frame, Trees
from pipeline.types.records import Path as RobotPath

router = APIRouter(prefix="/api")

_Scan = Annotated[int | None, Query(ge=0, le=LARGEST_NUMBER)]
_Stamp = Annotated[int, Path(ge=-(2**63), le=2**63 - 1)]


def newest_scan(dashboard: Dash) -> Shown:
    """Return the newest results; NothingMappedError before the first scan."""
    if dashboard.shown is None:
        raise NothingMappedError
    return dashboard.shown


NewestScan = Annotated[Shown, Depends(newest_scan)]


class _Compare(Body):
    """Names of presets or saved sets; an empty name means the parameters in force."""

    a: Word
    b: Word


@router.get("/trees")
async def trees(dashboard: Dash) -> Response:
    """GET /api/trees: return {"trees": [...]}, the confirmed trees, see `trees_payload`; an empty list before
    the first map."""
    shown = dashboard.shown
    if shown is None:
        return json_reply({"trees": []})
    return json_reply(
        {"trees": await asyncio.to_thread(trees_payload, shown.frame.trees, dashboard.start_ns)}
    )


@router.get("/trees.csv")
def trees_table(dashboard: Dash) -> Response:
    """Return the confirmed trees as a CSV table, those of a whole cloud in its coordinates, with only its
    header before the first map."""
    from pipeline.io.result_files import TREE_COLUMNS, csv_text, tree_rows

    shown = dashboard.shown
    rows = (
        []
        if shown is None
        else tree_rows(_in_file(shown.frame.trees, dashboard.status.cloud), dashboard.start_ns)
    )
    return file_reply(csv_text(TREE_COLUMNS, rows), "trees.csv")


@router.get("/path.csv")
def path_table(dashboard: Dash) -> Response:
    """Return the path as a CSV table, one row per scan, with only its header before the first map."""
    from pipeline.io.result_files import PATH_COLUMNS, csv_text, path_rows

    path = dashboard.path
    rows = [] if path is None else path_rows(path, dashboard.start_ns)
    return file_reply(csv_text(PATH_COLUMNS, rows), "path.csv")


@router.get("/export/{suffix}", dependencies=[ViewerTurn])
async def export(
    suffix: Literal["gpkg", "shp", "geojson", "dxf", "xlsx", "tif"], dashboard: Dash, shown: NewestScan
) -> Response:
    """Return the map as a file for GIS, CAD or spreadsheets, in local coordinates or those of a whole cloud;
    a Shapefile as zip archive. For a run of scans, the bytes are those of `stemmap export` for a run with the
    same map. 409 before the first map; 422 if a package is missing or the map lacks what the format shows."""
    if dashboard.path is None:
        raise NothingMappedError
    # All parts are of one run: another source may be opened while the file is written.
    run = _MappedRun(
        dashboard.source.uri, shown.frame, dashboard.path, dashboard.start_ns, dashboard.status.cloud
    )
    try:
        content, name = await asyncio.to_thread(_exported, run, f".{suffix}")
    except StemmapError as error:
        return failure_reply(422, error)
    headers = {"Content-Disposition": f'attachment; filename="{name}"', "Cache-Control": "no-store"}
    return Response(content, 200, headers, media_type="application/octet-stream")


def _in_file(trees: Trees, cloud: CloudFrame | None) -> Trees:
    """Return trees in the coordinates of the file of a whole cloud; those of a run of scans (None) as they
    are."""
    return trees if cloud is None else replace(trees, position=trees.position + cloud.offset[:2])


class _MappedRun(NamedTuple):
    """Parts of the newest map that an export contains.

    Attributes:
        uri: URI of the source.
        frame: Newest results.
        path: The estimated path.
        start_ns: Time of the first scan [ns].
        cloud: Frame of a whole cloud; None for a run of scans.
    """

    uri: str
    frame: Frame
    path: RobotPath
    start_ns: int
    cloud: CloudFrame | None


def _exported(run: _MappedRun, suffix: str) -> tuple[bytes, str]:
    """Return the bytes and the name of the exported file, see `export`."""
    from app.batch.export import export_bytes, for_export
    from app.batch.georeference import MapFrame
    from app.batch.run_folder import as_written
    from pipeline.io.result_files import terrain_rows

    ground, cloud = run.frame.ground, run.cloud
    cells = [] if ground is None else [[float(cell) for cell in row[:3]] for row in terrain_rows(ground)]
    terrain = np.array(cells, np.float64).reshape(-1, 3)
    frame = MapFrame()
    if cloud is not None:
        terrain += cloud.offset
        frame = MapFrame(cloud.crs, how="the cloud's own" if cloud.crs else "")
    written = as_written(_in_file(run.frame.trees, cloud), run.path, run.start_ns)
    return export_bytes(for_export(run.uri, *written, terrain, frame), suffix)


@router.get("/evaluation")
async def evaluation(dashboard: Dash) -> Response:
    """GET /api/evaluation: return the score against the ground truth, see `score_payload`; null without
    ground truth or before the first score."""
    return json_reply(dashboard.scores.latest)


@router.get("/pairs", dependencies=[ViewerTurn])
async def pairs(dashboard: Dash) -> Response:
    """Return the distances between the first confirmed trees as a matrix [m], with their errors [%] if there
    is ground truth, see `pairs_payload`; an empty matrix before the first map."""
    shown = dashboard.shown
    if shown is None:
        return json_reply({"numbers": [], "distance_m": [], "error_percent": None, "left_out": 0})
    match_distance = dashboard.parameters.parameters.evaluation.match_distance
    return json_reply(
        await asyncio.to_thread(pairs_payload, shown.frame.trees, dashboard.truth, match_distance)
    )


@router.get("/doubts")
async def doubts(dashboard: Dash) -> Response:
    """Return the share of votes that a tree needs (`needed`) and the votes on each tree (`trees`, see
    `doubts_of`), the most uncertain first; no trees before the first map."""
    share = dashboard.parameters.parameters.classification.tree_share
    shown = dashboard.shown
    rows = [] if shown is None else await asyncio.to_thread(doubts_of, shown.frame, share)
    return json_reply({"needed": share, "trees": rows})


@router.get("/story/cluster/{number}", dependencies=[ViewerTurn])
async def cluster_story(number: Number, dashboard: Dash, scan: _Scan = None) -> Response:
    """Return verdict, checks and fit of a cluster as JSON (`ClusterStory`); 404 if the scan is no longer
    available or has no such cluster, 503 if the worker is busy.

    Args:
        number: Row of the cluster.
        dashboard: The dashboard.
        scan: Index of a recent scan; by default the newest.
    """
    return json_reply(await dashboard.selector.story(scan, number))


@router.get("/story/tree/{number}", dependencies=[ViewerTurn])
async def tree_story(number: Number, dashboard: Dash) -> Response:
    """Return votes, DBH, coverage and history of a tree by its number (`TreeStory`); 404 if the map has no
    such tree, 503 if the worker is busy."""
    return json_reply(await dashboard.worker_client.tree(number))


@router.get("/camera", dependencies=[ViewerTurn])
async def camera(dashboard: Dash, shown: NewestScan) -> Response:
    """Return the stamp of the camera picture of the current scan, and the boxes of trees and clusters in it,
    see `CameraView.look`; 404 without a picture, 409 before the first map, 503 if the worker is busy."""
    return json_reply(await dashboard.camera.look(shown.frame, dashboard.path))


@router.get("/camera/{stamp_ns}.jpg")
async def camera_picture(stamp_ns: _Stamp, dashboard: Dash) -> Response:
    """Return a camera picture, as JPEG, by the stamp [ns] that `GET /api/camera` returned; 404 if it is no
    longer stored."""
    content = dashboard.camera.jpeg(stamp_ns)
    if content is None:
        return error_reply(404, "this picture is not kept any more", remedy="Ask for the newest one")
    return Response(content, 200, {"Cache-Control": "no-store"}, media_type="image/jpeg")


@router.get("/camera/tree/{number}.jpg", dependencies=[ViewerTurn])
async def tree_picture(number: Number, dashboard: Dash, shown: NewestScan) -> Response:
    """Return the part of the camera picture that shows a tree best, as JPEG; 404 if no picture shows it, 409
    before the first map, 503 if the worker is busy."""
    content = await dashboard.camera.tree(number, shown.frame.trees, dashboard.path)
    return Response(content, 200, {"Cache-Control": "no-store"}, media_type="image/jpeg")


@router.get("/section", dependencies=[ViewerTurn, Depends(newest_scan)])
async def section(dashboard: Dash) -> Response:
    """Return the accumulated points at breast height seen from above as a binary block: side of a cell and
    lower left corner of cell (0, 0) [m], and the occupied cells along x and y; 409 before the first map, 503
    if the worker is busy."""
    found = await dashboard.worker_client.section()
    return block_reply(packed({"side": found.side, "origin": found.origin}, {"cells": found.cells}))


@router.get("/stages", dependencies=[ViewerTurn])
async def stages(shown: NewestScan) -> Response:
    """Return the points of the current scan, stage by stage (Fig. 3), as a binary block; 409 before the first
    map."""
    return block_reply(await asyncio.to_thread(stages_payload, shown.frame))


@router.post("/compare", dependencies=[ViewerTurn])
async def compare(body: _Compare, dashboard: Dash, bounds: Bounds) -> Response:
    """Map the current scan with each of two parameter sets. Return both frames as a binary block, with the
    names and the differing parameters in its header. 404 for an unknown set, 409 without a scan, 429 if too
    many comparisons wait, 503 if the worker is busy."""
    sets = [_parameters_of(dashboard, name) for name in (body.a, body.b)]
    async with bounds.comparisons.turn():
        frames = await dashboard.worker_client.compare(sets)
    first, second = (each.flat() for each in sets)
    differences = [[name, value, second[name]] for name, value in first.items() if second[name] != value]
    distance = dashboard.parameters.parameters.evaluation.match_distance
    header = {"a": body.a, "b": body.b, "differences": differences}
    return block_reply(await asyncio.to_thread(comparison_payload, frames, header, dashboard.truth, distance))


def _parameters_of(dashboard: Dashboard, name: str) -> Parameters:
    """Return the parameters of a preset or saved set; those in force for "". Raises UnknownError for an
    unknown name."""
    return dashboard.sets.named(name)[1] if name else dashboard.parameters.parameters
