"""What a scan showed as a row of numbers and a block of bytes, and back to the bit.

The row says how many of everything there are; the block then holds the arrays one behind the other, each at
a multiple of eight bytes, and what is said in words as JSON. Reading makes no copy.
"""

from __future__ import annotations

import json
import math
from typing import Any

import lz4.frame
import numpy as np
from numpy.typing import NDArray

from pipeline.gathering.memory import SLICE, SLICES
from pipeline.gathering.sight import ELEVATIONS
from pipeline.geometry import Pose2
from pipeline.perception import Looked, Overview
from pipeline.records import Clusters, Float32, Int32, PoseMeasurement, Scan, Step, Turn, UInt16, Verdict
from pipeline.terrain import SECTORS, Terrain
from pipeline.visibility import BINS

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
        ("depth", "<i4"),  # bytes of its depth image, packed: most of it is empty
        ("rings", "<i4"),  # of the overview's terrain
        ("fused_rings", "<i4"),  # of the terrain that goes into the height map, or NONE
        ("words", "<i4"),  # bytes of JSON
    ]
)
_CLUSTERS: dict[str, tuple[str, tuple[int, ...]]] = {
    "size": ("<i8", ()),
    "centroid": ("<f8", (3,)),
    "eigenvalues": ("<f8", (3,)),
    "eccentricity": ("<f8", ()),
    "centre": ("<f8", (2,)),
    "covariance": ("<f8", (2, 2)),
    "radius": ("<f8", ()),
    "radius_sigma": ("<f8", ()),
    "radial_std": ("<f8", ()),
    "arc": ("<f8", ()),
    "extent": ("<f8", (3,)),
    "hidden": ("?", ()),
    "cut": ("?", ()),
}
_ALIGN = 8
NO_POINTS: Float32 = np.zeros((0, 3), np.float32)
NO_HEIGHT: Float32 = np.zeros(0, np.float32)
NO_LABELS: Int32 = np.zeros(0, np.int32)


def pack(step: Step, looked: Looked) -> tuple[Any, bytes]:
    """A row of HEAD, and the block.

    Of the scan only the time is kept, of the points only those of the overview that are low enough to be
    remembered; and of these not z, which nobody asks beside the height above the ground.
    """
    over, fused = looked.overview, looked.terrain
    points, height = (NO_POINTS, NO_HEIGHT) if over is None else _remembered(over.points, over.height)
    depth = np.zeros(0, np.uint8) if over is None else _packed(over.depth)
    words = _words(step, looked)
    head = np.zeros((), HEAD)
    head["index"], head["stamp_ns"] = step.index, step.scan.stamp_ns
    head["odometry"] = math.nan if step.T_odom_base is None else step.T_odom_base.as_array()
    head["turn"] = math.nan if step.turn is None else (step.turn.angle, step.turn.sigma)
    head["slack"], head["offset"] = step.slack, looked.sensor_offset
    head["clusters"] = len(looked.clusters.size)
    head["heights"] = NONE if looked.heights is None else len(looked.heights)
    head["points"] = NONE if over is None else len(points)
    head["depth"] = len(depth)
    head["rings"] = NONE if over is None else over.terrain.shape[1]
    head["fused_rings"] = NONE if fused is None else fused.height.shape[1]
    head["words"] = len(words)

    arrays: list[NDArray[Any]] = [
        getattr(looked.clusters, name).astype(kind, copy=False) for name, (kind, _) in _CLUSTERS.items()
    ]
    if looked.heights is not None:
        arrays.append(looked.heights)
    arrays.append(looked.free)
    if over is not None:
        arrays += [points, height, over.steepest, depth, over.terrain]
    if fused is not None:
        arrays += [fused.height, fused.seen]
    parts = [np.ascontiguousarray(array).tobytes() for array in arrays] + [words]
    return head, b"".join(part + b"\0" * (-len(part) % _ALIGN) for part in parts)


def unpack(head: Any, block: bytearray) -> tuple[Step, Looked]:  # noqa: ANN401 - a row of HEAD
    """What `pack` was given, without the raw points.

    The block is not copied. It is one that could be written to, because kernels are compiled for such arrays.

    Raises:
        ValueError: The block does not hold what the row says.
    """
    cut = _Cutter(block)
    clusters, points, rings, fused_rings = (
        int(head[name]) for name in ("clusters", "points", "rings", "fused_rings")
    )
    columns = {name: cut(kind, (clusters, *rest)) for name, (kind, rest) in _CLUSTERS.items()}
    heights = None if head["heights"] == NONE else cut("<f8", (clusters,))
    free = cut("<f8", (BINS,))
    overview = terrain = None
    if points != NONE:
        overview = Overview(
            points=_in_space(cut("<f4", (points, 2))),
            height=cut("<f4", (points,)),
            steepest=cut("<f8", (BINS,)),
            depth=_unpacked(cut("u1", (int(head["depth"]),))),
            terrain=cut("<f8", (SECTORS, rings)),
        )
    if fused_rings != NONE:
        terrain = Terrain(cut("<f8", (SECTORS, fused_rings)), cut("?", (SECTORS, fused_rings)))
    told = json.loads(cut("u1", (int(head["words"]),)).tobytes())
    looked = Looked(
        raw=NO_POINTS,
        filtered=NO_POINTS,
        labels=NO_LABELS,
        clusters=Clusters(**columns, verdict=np.full(clusters, Verdict.OTHER, np.int32)),
        heights=heights,
        free=free,
        sensor_offset=np.array(head["offset"]),
        overview=overview,
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


class _Cutter:
    """Takes one array after the other from a block."""

    def __init__(self, block: bytearray) -> None:
        self._block = block
        self._at = 0

    def __call__(self, kind: str, shape: tuple[int, ...]) -> Any:  # noqa: ANN401 - of the kind
        count = math.prod(shape)
        array = np.frombuffer(self._block, kind, count, self._at)
        length = count * array.itemsize
        self._at += length + -length % _ALIGN
        return array.reshape(shape)


def _remembered(points: Float32, height: Float32) -> tuple[Float32, Float32]:
    """x, y and height of the points that `Gathering.add` does not leave out wherever they are."""
    low = (height > 0.0) & (height < HIGHEST)
    return points[low, :2], height[low]


def _packed(depth: UInt16) -> NDArray[np.uint8]:
    return np.frombuffer(lz4.frame.compress(depth.astype("<u2", copy=False).tobytes()), np.uint8)


def _unpacked(packed: NDArray[np.uint8]) -> UInt16:
    block = bytearray(lz4.frame.decompress(packed.tobytes()))
    return np.frombuffer(block, "<u2", BINS * ELEVATIONS).reshape(BINS, ELEVATIONS)


def _in_space(places: Float32) -> Float32:
    points = np.zeros((len(places), 3), np.float32)
    points[:, :2] = places
    return points


def _words(step: Step, looked: Looked) -> bytes:
    m = step.measured
    told = {
        "warnings": step.warnings,
        "doubt": step.doubt,
        "measured": None
        if m is None
        else [m.stamp_ns, m.T_map_base.as_array().tolist(), m.covariance.tolist()],
        "looked": looked.warnings,
        "counts": looked.counts,
    }
    return json.dumps(told, separators=(",", ":")).encode()


def _measured(told: Any) -> PoseMeasurement | None:  # noqa: ANN401 - JSON
    if told is None:
        return None
    return PoseMeasurement(int(told[0]), Pose2(*told[1]), np.array(told[2]))
