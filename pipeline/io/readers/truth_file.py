"""Ground truth of a simulated recording, attached to it as JSON."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
import numpy as np

from pipeline.errors import SourceError
from pipeline.io.readers.base import COORDINATE_LIMIT
from pipeline.types.records import Sensor, Truth, TruthPath, TruthTrees

ATTACHMENT = "stemmap_truth.json"
SIZE_LIMIT = 64 << 20
_LIMIT = COORDINATE_LIMIT
Rows = Annotated[
    list[Annotated[float, msgspec.Meta(ge=-_LIMIT, le=_LIMIT)]], msgspec.Meta(max_length=2_000_000)
]


_UNKNOWN = Sensor()


class _Sensor(msgspec.Struct, frozen=True):
    name: str = _UNKNOWN.name
    rings: Annotated[int, msgspec.Meta(ge=0, le=1024)] = _UNKNOWN.rings
    ring_step: Annotated[float, msgspec.Meta(ge=0, le=3.2)] = _UNKNOWN.ring_step
    azimuth_step: Annotated[float, msgspec.Meta(gt=0, le=3.2)] = _UNKNOWN.azimuth_step
    range_sigma: Annotated[float, msgspec.Meta(gt=0, le=10)] = _UNKNOWN.range_sigma
    range_max: Annotated[float, msgspec.Meta(gt=0, le=10_000)] = _UNKNOWN.range_max


class _Trees(msgspec.Struct, frozen=True):
    x: Rows
    y: Rows
    dbh: Annotated[list[float | None], msgspec.Meta(max_length=2_000_000)]
    kind: Annotated[
        list[Literal["tree", "pole", "person", "bush", "other"]], msgspec.Meta(max_length=2_000_000)
    ]


class _Path(msgspec.Struct, frozen=True):
    stamp_ns: Annotated[
        list[Annotated[int, msgspec.Meta(ge=0, lt=2**62)]], msgspec.Meta(max_length=2_000_000)
    ]
    x: Rows
    y: Rows
    yaw: Rows


class _File(msgspec.Struct, frozen=True):
    version: Literal[1]
    sensor: _Sensor | None = None
    trees: _Trees | None = None
    path: _Path | None = None


def read_truth(content: bytes, where: str) -> tuple[Truth, Sensor | None]:
    """Decode the attachment into the ground truth, in the map frame, and the sensor (None if not named).

    Raises:
        SourceError: It is not JSON of this form, a number is beyond 1e8, or columns differ in length.
    """
    try:
        file = msgspec.json.decode(content, type=_File)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise SourceError(f"the attached ground truth cannot be read: {error}", where=where) from error
    for columns in (file.trees, file.path):
        if columns is not None and len({len(column) for column in msgspec.structs.astuple(columns)}) != 1:
            raise SourceError("the columns of the attached ground truth differ in length", where=where)
    trees = None if file.trees is None else _trees(file.trees)
    path = None if file.path is None else _path(file.path)
    sensor = None if file.sensor is None else Sensor(**msgspec.structs.asdict(file.sensor))
    return Truth(trees, path), sensor


def _trees(columns: _Trees) -> TruthTrees:
    dbh = [np.nan if diameter is None else diameter for diameter in columns.dbh]
    return TruthTrees(np.array(columns.x), np.array(columns.y), np.array(dbh, float), tuple(columns.kind))


def _path(columns: _Path) -> TruthPath:
    stamp_ns = np.array(columns.stamp_ns, dtype=np.int64)
    order = np.argsort(stamp_ns, kind="stable")
    x, y, yaw = (np.array(column, dtype=np.float64)[order] for column in (columns.x, columns.y, columns.yaw))
    return TruthPath(stamp_ns[order], x, y, yaw, same_frame=True)
