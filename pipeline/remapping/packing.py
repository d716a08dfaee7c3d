"""What a scan showed as a row of numbers and a block of bytes, and back to the bit.

The row says how many of everything there are; the block, packed by Zstandard, holds what is said in words as
JSON, and then the arrays one behind the other (see `pipeline.remapping.coding`).
"""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import zstandard

from pipeline.classification.ray_statistics import ELEVATIONS
from pipeline.classification.voxel_map import SLICE, SLICES
from pipeline.detection.cluster_shape import eccentricity
from pipeline.detection.free_space import BINS
from pipeline.front_end import ColumnInput, SegmentedScan
from pipeline.geometry.poses import Pose2
from pipeline.geometry.quantisation import GROUND, POINT
from pipeline.ground.terrain import SECTORS, Terrain
from pipeline.remapping.coding import (
    Cutter,
    bits_from,
    from_planes,
    heights_coded,
    heights_from,
    image_coded,
    image_from,
    places_coded,
    places_from,
    planes,
    row_coded,
    row_from,
)
from pipeline.types.records import Clusters, Float32, Int32, PoseMeasurement, Scan, Step, Turn, Verdict

NONE = -1
HIGHEST = SLICES * SLICE  # m above the ground; what is higher is not gathered
HEAD = np.dtype(
    [
        ("index", "<i8"),
        ("stamp_ns", "<i8"),
        ("odometry", "<f8", 3),  # x, y [m], yaw [rad] of T_odom_base; NaN where there is none
        ("turn", "<f8", 2),  # angle and sigma [rad]; NaN where there is none
        ("slack", "<f8", 2),
        ("offset", "<f8", 3),  # the sensor in the base frame [m]
        ("clusters", "<i4"),
        ("heights", "<i4"),  # as many as clusters, or NONE
        ("points", "<i4"),  # of the overview, or NONE
        ("rings", "<i4"),  # of the overview's terrain
        ("fused_rings", "<i4"),  # of the terrain that goes into the height map, or NONE
        ("words", "<i4"),  # bytes of JSON
        ("bytes", "<i4"),  # of the block before it was packed
    ]
)
# Numbers of a cluster and how many of each there are; flags are apart, and so is the eccentricity, which
# follows from the eigenvalues unless somebody else has told it.
_CLUSTERS: dict[str, tuple[int, ...]] = {
    "size": (),
    "centroid": (3,),
    "eigenvalues": (3,),
    "centre": (2,),
    "covariance": (2, 2),
    "radius": (),
    "radius_sigma": (),
    "radial_std": (),
    "arc": (),
    "extent": (3,),
}
_COLUMNS = sum(math.prod(rest) for rest in _CLUSTERS.values())
LARGEST = 1 << 28  # bytes of a block; the largest clouds that we know take a fiftieth
_LEVEL = 1  # others take longer and make it smaller by a hundredth
NO_POINTS: Float32 = np.zeros((0, 3), np.float32)
NO_HEIGHT: Float32 = np.zeros(0, np.float32)
NO_LABELS: Int32 = np.zeros(0, np.int32)


class TooLargeError(ValueError):
    """A scan shows more than is kept of any."""


def pack(step: Step, looked: SegmentedScan) -> tuple[Any, bytes]:
    """A row of HEAD, and the block.

    Of the scan only the time is kept, of the points only those of the overview that are low enough to be
    remembered; and of these not z, which nobody asks beside the height above the ground.

    Raises:
        TooLargeError: The block is larger than `unpack` takes.
    """
    over, fused = looked.column_input, looked.terrain
    points, height = (NO_POINTS, NO_HEIGHT) if over is None else _remembered(over.points, over.height)
    words = _words(step, looked)
    head = np.zeros((), HEAD)
    head["index"], head["stamp_ns"] = step.index, step.scan.stamp_ns
    head["odometry"] = math.nan if step.T_odom_base is None else step.T_odom_base.as_array()
    head["turn"] = math.nan if step.turn is None else (step.turn.angle, step.turn.sigma)
    head["slack"], head["offset"] = step.slack, looked.sensor_offset
    head["clusters"] = len(looked.clusters.size)
    head["heights"] = NONE if looked.heights is None else len(looked.heights)
    head["points"] = NONE if over is None else len(points)
    head["rings"] = NONE if over is None else over.terrain.shape[1]
    head["fused_rings"] = NONE if fused is None else fused.height.shape[1]
    head["words"] = len(words)

    parts = [words, *_clusters_coded(looked.clusters)]
    if looked.heights is not None:
        parts.append(planes(looked.heights[None]))
    parts.append(row_coded(looked.free))
    if over is not None:
        parts += [places_coded(points, height, POINT), row_coded(over.steepest), image_coded(over.depth)]
        parts.append(heights_coded(over.terrain, GROUND))
    if fused is not None:
        parts += [heights_coded(fused.height, GROUND), np.packbits(fused.seen).tobytes()]
    block = b"".join(parts)
    if len(block) > LARGEST:
        raise TooLargeError(f"what it showed takes more than {LARGEST >> 20} MB")
    head["bytes"] = len(block)
    return head, zstandard.ZstdCompressor(level=_LEVEL).compress(block)


def unpack(head: Any, block: bytearray) -> tuple[Step, SegmentedScan]:  # noqa: ANN401 - a row of HEAD
    """What `pack` was given, without the raw points.

    Its arrays can be written to, because kernels are compiled for such arrays.

    Raises:
        ValueError: The block does not hold what the row says.
    """
    clusters, points, rings, fused_rings = (
        int(head[name]) for name in ("clusters", "points", "rings", "fused_rings")
    )
    cut = Cutter(_unpacked(block, int(head["bytes"])))
    told = json.loads(cut("u1", int(head["words"])).tobytes())
    found = _clusters_from(cut, clusters)
    heights = None if head["heights"] == NONE else from_planes(cut, "<f8", 1, clusters)[0]
    free = row_from(cut, BINS)
    overview = terrain = None
    if points != NONE:
        places, height = places_from(cut, points, POINT)
        overview = ColumnInput(
            points=places,
            height=height,
            steepest=row_from(cut, BINS),
            depth=image_from(cut, BINS, ELEVATIONS),
            terrain=heights_from(cut, SECTORS, rings, GROUND),
        )
    if fused_rings != NONE:
        ground = heights_from(cut, SECTORS, fused_rings, GROUND)
        terrain = Terrain(ground, bits_from(cut, ground.size).reshape(ground.shape))
    looked = SegmentedScan(
        raw=NO_POINTS,
        filtered=NO_POINTS,
        labels=NO_LABELS,
        clusters=found,
        heights=heights,
        free=free,
        sensor_offset=np.array(head["offset"]),
        column_input=overview,
        terrain=terrain,
        warnings=tuple(told["looked"]),
        counts=told["counts"],
    )
    odometry, turn = head["odometry"].tolist(), head["turn"].tolist()
    step = Step(
        index=int(head["index"]),
        scan=Scan(int(head["stamp_ns"]), NO_POINTS),
        T_odom_base=None if math.isnan(odometry[0]) else Pose2(*odometry),
        warnings=tuple(told["warnings"]),
        doubt=told["doubt"],
        slack=tuple(head["slack"].tolist()),
        measured=_measured(told["measured"]),
        turn=None if math.isnan(turn[0]) else Turn(*turn),
    )
    return step, looked


def _remembered(points: Float32, height: Float32) -> tuple[Float32, Float32]:
    """x, y and height of the points that `Gathering.add` does not leave out wherever they are."""
    low = (height > 0.0) & (height < HIGHEST)
    return points[low, :2], height[low]


def _unpacked(block: bytearray, size: int) -> bytearray:
    try:
        if not 0 <= size <= LARGEST or zstandard.frame_content_size(block) != size:
            raise ValueError("the block is not as long as the row says")
        return bytearray(zstandard.ZstdDecompressor().decompress(block))
    except zstandard.ZstdError as error:
        raise ValueError(str(error)) from None


def _clusters_coded(clusters: Clusters) -> list[bytes]:
    count = len(clusters.size)
    columns = [
        getattr(clusters, name).astype("<f8", copy=False).reshape(count, math.prod(rest)).T
        for name, rest in _CLUSTERS.items()
    ]
    told = eccentricity(clusters.eigenvalues)
    other = told.view(np.uint64) != clusters.eccentricity.view(np.uint64)
    flags = [np.packbits(bits).tobytes() for bits in (clusters.hidden, clusters.cut, other)]
    return [planes(np.concatenate(columns)), *flags, planes(clusters.eccentricity[None, other])]


def _clusters_from(cut: Cutter, count: int) -> Clusters:
    rows, at = from_planes(cut, "<f8", _COLUMNS, count), 0
    columns: dict[str, Any] = {}
    for name, rest in _CLUSTERS.items():
        width = math.prod(rest)
        columns[name] = np.ascontiguousarray(rows[at : at + width].T).reshape(count, *rest)
        at += width
    columns["size"] = columns["size"].astype(np.int64)
    columns |= {name: bits_from(cut, count) for name in ("hidden", "cut")}
    other = bits_from(cut, count)
    columns["eccentricity"] = eccentricity(columns["eigenvalues"])
    columns["eccentricity"][other] = from_planes(cut, "<f8", 1, int(np.count_nonzero(other)))[0]
    return Clusters(**columns, verdict=np.full(count, Verdict.OTHER, np.int32))


def _words(step: Step, looked: SegmentedScan) -> bytes:
    m = step.measured
    told = {
        "warnings": step.warnings,
        "doubt": step.doubt,
        "measured": None
        if m is None
        else [
            m.stamp_ns,
            m.T_map_base.as_array().tolist(),
            m.covariance.tolist(),
            m.gate if math.isfinite(m.gate) else None,
            None if m.shared is None else m.shared.tolist(),
            m.source,
        ],
        "looked": looked.warnings,
        "counts": looked.counts,
    }
    return json.dumps(told, separators=(",", ":")).encode()


def _measured(told: Any) -> PoseMeasurement | None:  # noqa: ANN401 - JSON
    if told is None:
        return None
    stamp_ns, pose, covariance, gate, shared, source = told
    return PoseMeasurement(
        int(stamp_ns),
        Pose2(*pose),
        np.array(covariance),
        math.inf if gate is None else float(gate),
        None if shared is None else np.array(shared),
        int(source),
    )
