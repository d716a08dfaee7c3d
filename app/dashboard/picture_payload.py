"""The points of a scan for pictures that the page draws itself: one block of bytes.

Four bytes of length (little endian), a JSON header of that length, then the arrays one after the other,
each beginning at a multiple of four. The header's "arrays" says name, type, shape and place of each.
Points are whole centimetres in 16 bits, in the level sensor frame: 20 m away an eye sees no less.
"""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from app.dashboard.payload import clusters_payload
from app.dashboard.verdict_counts import counts_of
from pipeline.types.records import Frame, TruthTrees

_ALIGNED = 4
_FARTHEST_CM = 32_767


def packed(header: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> bytes:
    """The block; see above."""
    table, parts, place = [], [], 0
    for name, array in arrays.items():
        content = np.ascontiguousarray(array).tobytes()
        table.append({"name": name, "type": array.dtype.str, "shape": array.shape, "at": place})
        padded = content + bytes(-len(content) % _ALIGNED)
        parts.append(padded)
        place += len(padded)
    text = msgspec.json.encode({**header, "arrays": table})
    text += b" " * (-len(text) % _ALIGNED)
    return b"".join([len(text).to_bytes(4, "little"), text, *parts])


def in_centimetres(points: NDArray[np.float32]) -> NDArray[np.int16]:
    """Points of shape (N, 3) [m] in whole centimetres; what lies beyond 327 m stands at its edge."""
    return np.clip(np.round(100.0 * points), -_FARTHEST_CM, _FARTHEST_CM).astype(np.int16)


def described(frame: Frame, truth: TruthTrees | None, match_distance: float) -> dict[str, Any]:
    """What the header says of a frame's clusters."""
    counts = counts_of(frame, truth, match_distance)
    return {
        "index": frame.index,
        "clusters": clusters_payload(frame),
        **counts.as_plain(),
        "counts": dict(frame.counts),
    }


def stages_payload(frame: Frame) -> bytes:
    """The four stages of Fig. 3: the raw scan, what passed the filters, the clusters and the trunks."""
    arrays = {"raw": in_centimetres(frame.raw), **_clustered(frame)}
    return packed(described(frame, None, 0.0), arrays)


def comparison_payload(
    frames: list[Frame], header: dict[str, Any], truth: TruthTrees | None, match_distance: float
) -> bytes:
    """The same scan under several sets; the arrays of the k-th have its number in their names."""
    arrays = {
        f"{name}{k}": array for k, frame in enumerate(frames) for name, array in _clustered(frame).items()
    }
    pictures = [described(frame, truth, match_distance) for frame in frames]
    return packed({**header, "pictures": pictures}, arrays)


def _clustered(frame: Frame) -> dict[str, NDArray[Any]]:
    circles = np.column_stack([frame.clusters.centre, frame.clusters.radius, frame.clusters.centroid[:, 2]])
    return {
        "points": in_centimetres(frame.filtered),
        "labels": frame.labels.astype(np.int32),
        "circles": circles.astype(np.float32),
    }
