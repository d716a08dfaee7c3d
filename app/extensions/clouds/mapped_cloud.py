"""The cloud of a finished run as LAS or LAZ, with the number of the tree and a class per point."""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

import numpy as np

from app.batch.map_frame import heights_at, read_map_frame
from app.batch.run_folder import read_run, read_terrain
from app.extensions.clouds.las import SYSTEM_OF_DRIVE
from pipeline.errors import StemmapError
from pipeline.geometry.poses import Float, Pose2
from pipeline.io.atomic_files import write_beside
from pipeline.io.result_files import ODOMETRY

if TYPE_CHECKING:
    from pipeline.io.readers import Source
    from pipeline.odometry.synchroniser import OdometryChoice
    from pipeline.types.records import Step

EVERY = 5  # scans of a drive between two that are used
MARGIN = 0.10  # m around the trunk at breast height, for lean and roughness of the stem
UNKNOWN_RADIUS = 0.15  # m, of a tree without a diameter
GROUND = 0.15  # m; points this near to the terrain are ground
_CHUNK = 1_000_000
#: Classes of the LAS standard.
UNCLASSIFIED, GROUND_CLASS, HIGH_VEGETATION = 1, 2, 5


def write_cloud(folder: FilePath, file: FilePath) -> int:
    """Write the cloud of a run; return the number of points.

    A source of one step keeps its points and coordinates. Every EVERY-th scan of a drive is read again from
    the source, placed by the path of the run, and thinned. Points within GROUND of the terrain have class 2.
    Other points have class 5 and the number of the nearest tree in the field `tree` if their horizontal
    distance from the tree is at most its radius plus MARGIN (UNKNOWN_RADIUS for a tree without a diameter),
    at any height. The rest has class 1. `tree` is 0 for all points without class 5.

    Args:
        folder: Folder of the run.
        file: File .las or .laz, which is replaced; it does not change after an error.

    Raises:
        StemmapError: The run or its source cannot be read, it is live or continues another run, or no point
            is near known ground, or the file cannot be written.
    """
    import laspy
    from scipy.spatial import cKDTree

    from app.sources.one_step import open_one_step

    run, frame, terrain = read_run(folder), read_map_frame(folder), read_terrain(folder)
    trees = run.trees
    tree_of = cKDTree(trees.position) if len(trees.number) else None
    radius = np.where(np.isfinite(trees.dbh), 0.5 * trees.dbh + MARGIN, UNKNOWN_RADIUS)
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.add_extra_dim(laspy.ExtraBytesParams("tree", np.uint32, "number of the tree"))
    header.generating_software = "stemmap"
    source = None if run.of_drive else open_one_step(run.uri)
    is_of_drive = source is None or source.is_cut_above
    header.system_identifier = SYSTEM_OF_DRIVE if is_of_drive else "stemmap"
    header.creation_date = datetime.date(2000, 1, 1)  # the same run gives the same bytes
    header.scales = np.full(3, 0.001)
    origin = trees.position[:1] if len(trees.number) else np.zeros((1, 2))
    header.offsets = np.floor(np.append(frame.to_crs(origin), frame.z))
    if frame.crs:
        import pyproj

        header.add_crs(pyproj.CRS.from_user_input(frame.crs))
    parts = _parts_of_drive(folder) if source is None else source.points()
    written = 0
    is_laz = file.suffix.lower() == ".laz"
    with write_beside(file) as partial, laspy.open(partial, "w", header=header, do_compress=is_laz) as writer:
        for points in parts:
            ground = heights_at(terrain, points[:, :2])
            number = np.zeros(len(points), np.uint32)
            if tree_of is not None:
                distance, row = tree_of.query(points[:, :2])
                inside = distance <= radius[row]
                number[inside] = trees.number[row[inside]]
            is_ground = np.abs(points[:, 2] - ground) <= GROUND
            number[is_ground] = 0
            record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
            place = frame.to_crs(points[:, :2])
            record.x, record.y, record.z = place[:, 0], place[:, 1], points[:, 2] + frame.z
            record.tree = number
            kind = np.where(number > 0, HIGH_VEGETATION, UNCLASSIFIED)
            record.classification = np.where(is_ground, GROUND_CLASS, kind).astype(np.uint8)
            record.return_number = record.number_of_returns = np.ones(len(points), np.uint8)
            writer.write_points(record)
            written += len(points)
    return written


def _every(source: Source, odometry: OdometryChoice) -> Iterator[tuple[int, Step]]:
    """Yield the number and the step of every EVERY-th scan of a source; a simulated sensor does not scan
    between them.

    Raises:
        SourceError: The source cannot be read.
    """
    from pipeline.io.readers.simulated import SimulatedSource
    from pipeline.odometry.synchroniser import steps

    simulated = isinstance(source, SimulatedSource)
    records = source.records(every=EVERY) if isinstance(source, SimulatedSource) else source.records()
    for index, step in enumerate(steps(records, odometry=odometry)):
        if simulated or index % EVERY == 0:
            yield index * (EVERY if simulated else 1), step


def _parts_of_drive(folder: FilePath) -> Iterator[Float]:
    """Yield the thinned points of a drive in the frame of the map, shape (N, 3) [m], in parts of at most
    _CHUNK; z by the terrain of each scan and the nearest known terrain of the run. Of the scans of the path,
    every EVERY-th is used, except those that have only stems.

    Raises:
        StemmapError: The run is live or has several recordings, its source cannot be read, or no point
            is near known ground.
    """
    from app.extensions.clouds.thinning import Thinned
    from app.sources.live_address import is_live
    from app.sources.opening import open_source
    from app.sources.request import FILE, request_of_kept, with_odometry
    from pipeline.ground.scan_ground import find_terrain, height_above
    from pipeline.preprocessing import acquire

    run, terrain = read_run(folder), read_terrain(folder)
    if is_live(run.uri):
        raise StemmapError("a live run has no recording to be read again", where=run.uri)
    if run.record.get("continued"):
        raise StemmapError("a run of several recordings has no single cloud", where=str(folder))
    odometry = str(run.record.get("odometry") or "auto")
    # The poses of LiDAR odometry are known, and need not be found by registration again.
    registered = folder / ODOMETRY
    request = request_of_kept(run.uri, odometry=odometry, seed=run.seed, choices=run.record.get("chosen"))
    thinned, p = Thinned(1 << 22, 0.02), run.parameters
    with closing(open_source(run.uri, request.options())) as opened:
        motion = f"{FILE}{registered}" if registered.is_file() else odometry
        source, chosen = with_odometry(opened, motion)
        T_base_lidar = source.description.T_base_lidar
        for row, step in _every(source, chosen.steps):
            if row >= len(run.path.x):
                break
            if step.scan.stems is not None:
                continue
            raw, offset = acquire(step, T_base_lidar, p.acquisition)
            height = height_above(raw, find_terrain(raw, p.ground))
            pose = Pose2(float(run.path.x[row]), float(run.path.y[row]), float(run.path.yaw[row]))
            place = pose.apply(raw[:, :2].astype(np.float64) + offset[:2])
            z = height + heights_at(terrain, place, math.inf)
            known = np.isfinite(z)
            values = np.column_stack([place, z, np.zeros(len(z))])[known]
            thinned.add(np.ascontiguousarray(values, np.float32))
    points = thinned.points
    if not len(points):
        raise StemmapError("the run has no points near known ground", where=str(folder))
    for begin in range(0, len(points), _CHUNK):
        yield points[begin : begin + _CHUNK, :3].astype(np.float64)
