"""The results of the run: trees, path, scores, explanations and pictures."""

from __future__ import annotations

import asyncio
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path as FilePath
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, Path, Query
from starlette.responses import FileResponse, Response

from app.dashboard.dashboard import Dashboard
from app.dashboard.payload import (
    binary_payload,
    comparison_payload,
    course_payload,
    doubts_of,
    stages_payload,
    trees_payload,
)
from app.dashboard.scores import pairs_payload
from app.dashboard.selection import NoStoryError, NothingMappedError
from app.dashboard.shown_run import ShownRun
from app.sources import opening
from app.web.responses import (
    LARGEST_NUMBER,
    Body,
    Number,
    Word,
    as_bad_request,
    bytes_reply,
    error_reply,
    json_reply,
    text_reply,
)
from app.web.routes.access import Bounds, Dash, ViewerTurn, in_thread
from app.worker.course import MOST_ROWS, QUANTITIES
from app.worker.protocol import Shown
from pipeline.config import Parameters
from pipeline.errors import StemmapError
from pipeline.geometry.file_arrays import LARGE

router = APIRouter(prefix="/api")

GEOJSON = "application/geo+json"
# Reading a long recording again.
_EXPORT_S = 600.0
_Scan = Annotated[int | None, Query(ge=0, le=LARGEST_NUMBER)]
_Names = Annotated[str, Query(max_length=1000)]
_Most = Annotated[int, Query(ge=2, le=MOST_ROWS)]
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
    """Return the confirmed trees with their reviews as a CSV table, those of a run of one step in its
    coordinates; only the header before the first map."""
    from pipeline.io.result_files import TREE_COLUMNS, csv_text

    if dashboard.shown is None:
        return text_reply(csv_text(TREE_COLUMNS, []), "trees.csv")
    run = ShownRun.of(dashboard)
    return text_reply(run.trees_text(run.by_people()), "trees.csv")


@router.get("/path.csv")
def path_table(dashboard: Dash) -> Response:
    """Return the path as a CSV table, one row per scan, with only its header before the first map."""
    from pipeline.io.result_files import PATH_COLUMNS, csv_text, path_rows

    path = dashboard.path
    rows = [] if path is None else path_rows(path, dashboard.start_ns)
    return text_reply(csv_text(PATH_COLUMNS, rows), "path.csv")


def folder_of_export() -> Iterator[FilePath]:
    """Yield a temporary folder, which is removed after the response is sent."""
    with TemporaryDirectory(prefix="stemmap-export-", dir=LARGE) as name:
        yield FilePath(name)


@router.get("/export/{suffix}", dependencies=[ViewerTurn])
async def export(
    suffix: Literal["gpkg", "geojson"],
    dashboard: Dash,
    there: Annotated[FilePath, Depends(folder_of_export)],
) -> Response:
    """Return the map as a file for geographic information systems, in the reference system of the map; a
    child process writes it. For a run of scans, the bytes are those of `stemmap export` for a run with the
    same map. 409 before the first map; 422 if a package is missing."""
    question = {"ask": "export", "suffix": f".{suffix}"}
    return await exported_file(dashboard, ShownRun.of(dashboard), question, there)


async def exported_file(
    dashboard: Dashboard, run: ShownRun, question: dict[str, Any], there: FilePath
) -> Response:
    """Return the file that a child process exports, one at a time; see `_asked`. 422 if the child reports an
    error or takes too long."""
    with as_bad_request():
        async with dashboard.exporting, in_thread(run.folder()) as folder:
            file = await _asked(question, folder, there)
    media_type = "application/octet-stream"
    return FileResponse(file, 200, {"Cache-Control": "no-store"}, media_type, filename=file.name)


async def exported_layer(
    dashboard: Dashboard, run: ShownRun, question: dict[str, Any], there: FilePath
) -> Response:
    """Return the GeoJSON that a child process exports, see `_asked`; the bytes of the last answer to the same
    kind of question if neither the question nor the files of the run have changed, because programs ask every
    few seconds and a child needs 1.6 s of CPU time. 422 if the child reports an error or takes too long."""
    with as_bad_request():
        async with dashboard.exporting, in_thread(run.folder(with_seen=False)) as folder:
            name = f"{question['ask']} {question.get('layer', '')}"
            key = await asyncio.to_thread(_digest, question, folder)
            if dashboard.layers.get(name, ("", b""))[0] != key:
                file = await _asked(question, folder, there)
                dashboard.layers[name] = (key, await asyncio.to_thread(file.read_bytes))
            return bytes_reply(dashboard.layers[name][1], GEOJSON)


def _digest(question: dict[str, Any], folder: FilePath) -> str:
    """Return a digest of a question and of the names and contents of the files in a folder."""
    digest = hashlib.sha256(json.dumps(question).encode())
    for file in sorted(folder.iterdir()):
        digest.update(f"{file.name} {file.stat().st_size} ".encode() + file.read_bytes())
    return digest.hexdigest()


async def _asked(question: dict[str, Any], folder: FilePath, there: FilePath) -> FilePath:
    """Return the file that a child process exports. Its answer has the path of the file as `file`; the
    question is extended by the folder of the run, "path", and the empty folder of the file, "folder".
    StemmapError if the child reports an error or takes too long."""
    paths = {"path": str(folder), "folder": str(there)}
    try:
        return FilePath((await opening.ask({**question, **paths}, patience_s=_EXPORT_S))["file"])
    except opening.TookTooLongError:
        raise StemmapError(f"the export takes longer than {_EXPORT_S:.0f} s") from None


@router.get("/layers/{layer}.geojson", dependencies=[ViewerTurn])
async def layer(
    layer: Literal["trees", "path"],
    dashboard: Dash,
    there: Annotated[FilePath, Depends(folder_of_export)],
) -> Response:
    """Return the trees or the path of the present map as GeoJSON for other programs, which ask again to be up
    to date: in WGS84, or in the frame of a local map; a child process writes it. 409 before the first map."""
    question = {"ask": "layer", "layer": layer}
    return await exported_layer(dashboard, ShownRun.of(dashboard), question, there)


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


@router.get("/course", dependencies=[ViewerTurn])
async def course(dashboard: Dash, names: _Names = "", most: _Most = 1200, stages: bool = False) -> Response:
    """Return the course of the map, see `course_payload`; 404 before the first map, 503 if the worker is
    busy.

    Args:
        dashboard: The dashboard.
        names: Names of QUANTITIES, separated by commas; others are ignored.
        most: Maximum number of scans.
        stages: Whether to return the times of the stages.
    """
    wanted = [name for name in QUANTITIES if name in names.split(",")]
    found = await dashboard.worker_client.course(wanted, most, stages)
    return json_reply(await asyncio.to_thread(course_payload, found))


@router.get("/doubts")
async def doubts(dashboard: Dash) -> Response:
    """Return an object with `needed`, the share of votes that a tree needs, and `trees`, the result of
    `doubts_of`; no trees before the first map."""
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
    """Return the result of `CameraView.look` for the current scan: the stamp of the camera picture, and the
    boxes of trees and clusters in it; 404 without a picture, 409 before the first map, 503 if the worker is
    busy."""
    return json_reply(await dashboard.camera.look(shown.frame, dashboard.path))


@router.get("/camera/{stamp_ns}.jpg")
async def camera_picture(stamp_ns: _Stamp, dashboard: Dash) -> Response:
    """Return a camera picture, as JPEG, by the stamp [ns] that `GET /api/camera` returned; 404 if it is no
    longer stored."""
    content = dashboard.camera.jpeg(stamp_ns)
    if content is None:
        return error_reply(404, "this picture is not kept any more", remedy="Ask for the newest one")
    return bytes_reply(content, "image/jpeg")


@router.get("/camera/tree/{number}.jpg", dependencies=[ViewerTurn])
async def tree_picture(number: Number, dashboard: Dash, shown: NewestScan) -> Response:
    """Return the part of the camera picture that shows a tree best, as JPEG; an empty answer (204) if no
    picture shows it, also without a usable camera, 409 before the first map, 503 if the worker is busy."""
    try:
        content = await dashboard.camera.tree(number, shown.frame.trees, dashboard.path)
    except NothingMappedError:  # another source was opened meanwhile
        raise
    except NoStoryError:  # usual for a tree behind the camera; browsers would log 404 as an error
        return Response(status_code=204)
    return bytes_reply(content, "image/jpeg")


@router.get("/section", dependencies=[ViewerTurn, Depends(newest_scan)])
async def section(dashboard: Dash) -> Response:
    """Return the accumulated points at breast height seen from above as a binary block, see `binary_payload`.
    The header has `side`, the side of a cell [m], and `origin`, x, y of the lower left corner of cell (0, 0)
    in the map [m]. The array `cells` has the indices of the occupied cells along x and y, int32, shape (N,
    2). 409 before the first map, 503 if the worker is busy."""
    found = await dashboard.worker_client.section()
    return bytes_reply(binary_payload({"side": found.side, "origin": found.origin}, {"cells": found.cells}))


@router.get("/stages", dependencies=[ViewerTurn])
async def stages(shown: NewestScan) -> Response:
    """Return the points of the current scan, stage by stage (Fig. 3), as a binary block, see
    `stages_payload`; 409 before the first map."""
    return bytes_reply(await asyncio.to_thread(stages_payload, shown.frame))


@router.post("/compare", dependencies=[ViewerTurn])
async def compare(body: _Compare, dashboard: Dash, bounds: Bounds) -> Response:
    """Map the current scan with each of two parameter sets. Return both frames as a binary block, see
    `comparison_payload`, with the names `a` and `b` and `differences`, [name, value in a, value in b], in its
    header. 404 for an unknown set or one that the worker refuses, 409 without a scan, 422 for a set that is
    not valid in this version, 429 if too many comparisons wait, 503 if the worker is busy."""
    sets = [_parameters_of(dashboard, name) for name in (body.a, body.b)]
    async with bounds.comparisons.turn():
        frames = await dashboard.worker_client.compare(sets)
    first, second = (each.flat() for each in sets)
    differences = [[name, value, second[name]] for name, value in first.items() if second[name] != value]
    distance = dashboard.parameters.parameters.evaluation.match_distance
    header = {"a": body.a, "b": body.b, "differences": differences}
    return bytes_reply(await asyncio.to_thread(comparison_payload, frames, header, dashboard.truth, distance))


def _parameters_of(dashboard: Dashboard, name: str) -> Parameters:
    """Return the parameters of a preset or saved set; those in force for "". Raises UnknownError for an
    unknown name."""
    return dashboard.sets.named(name)[1] if name else dashboard.parameters.parameters
