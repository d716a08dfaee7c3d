"""A frame as the page needs it: the map without the points."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.explain.estimate_history import half_axes
from app.worker.internal_protocol import Shown
from pipeline.types.clearance import Clearance
from pipeline.types.pose_health import Health
from pipeline.types.records import Frame, Trees, TruthTrees, Verdict

Float = NDArray[np.float64]

_NS = 1_000_000_000
# A tenth of a millimetre: finer than any sensor, and short on the wire.
_DIGITS = 4
JUST_BEGUN = 20  # scans


def map_payload(shown: Shown) -> dict[str, Any]:
    """The message "map" without its path."""
    frame = shown.frame
    estimate = frame.estimate
    return {
        "type": "map",
        "index": frame.index,
        "time_s": shown.time_s,
        "pose": _rounded(estimate.T_map_base.as_array()),
        "odom": _rounded(frame.T_odom_base.as_array()),
        "sigma_xy": round(float(np.sqrt(np.mean(np.diagonal(estimate.covariance)[:2]))), _DIGITS),
        "n_eff": round(estimate.n_eff, 1),
        "health": health_payload(frame.health),
        "trees": trees_payload(frame, start_ns=frame.stamp_ns - round(shown.time_s * _NS)),
        "verdicts": verdict_counts(frame.clusters.verdict),
        "clusters": clusters_payload(frame),
        "counts": dict(frame.counts),
        "layers": layer_counts(frame),
        "clearance": clearance_payload(frame.clearance),
    }


def layer_counts(frame: Frame) -> dict[str, int]:
    """How much each layer of the scene shows; the path and the truth the page counts itself."""
    return {
        "raw": len(frame.raw),
        "filtered": len(frame.filtered),
        "clusters": len(frame.clusters.size),
        "fits": int(np.count_nonzero(np.isfinite(frame.clusters.radius[frame.detections.cluster]))),
        "particles": len(frame.estimate.particles),
        "trees": int(np.count_nonzero(frame.trees.confirmed)),
    }


def clearance_payload(clearance: Clearance | None) -> dict[str, Any] | None:
    """How far the way is free; what is not known, or nowhere, is None."""
    if clearance is None:
        return None
    ahead, beside = _known(clearance.ahead), _known(clearance.beside)
    return {"zone": clearance.zone.label, "ahead_m": ahead, "beside_m": beside, "within_m": clearance.within}


def health_word(frame: Frame | None) -> str:
    """How far the map can be trusted, in a word or two. "good" says that nothing speaks against the pose,
    which is no praise before there is a map that could."""
    if frame is None:
        return "no scan yet"
    if frame.health.state != "good":
        return frame.health.state
    if not frame.trees.confirmed.any():
        return "no trees yet"
    return "just begun" if frame.index < JUST_BEGUN else "good"


def health_payload(health: Health) -> dict[str, Any]:
    """How far the pose can be trusted: one word, why, and the figures behind it; what is not known is
    None."""
    return {
        "state": health.state,
        "reason": health.reason,
        "n_eff": _known(health.n_eff),
        "ancestors": health.ancestors,
        "detections": health.detections,
        "recognised": _known(health.recognised),
        "ambiguous": _known(health.ambiguous),
        "innovation": _known(health.innovation),
        "sigma_xy_m": _known(health.sigma_xy),
        "sigma_yaw_deg": _known(math.degrees(health.sigma_yaw)),
        "odometry_sigmas": _known(health.odometry),
    }


def clusters_payload(frame: Frame) -> dict[str, list[Any]]:
    """The clusters of the scan as columns, in the frame of the map; what is not known is None."""
    clusters = frame.clusters
    base = clusters.centre + frame.sensor_offset[:2]
    place = frame.estimate.T_map_base.apply(base)
    return {
        "x": np.round(place[:, 0], 2).tolist(),
        "y": np.round(place[:, 1], 2).tolist(),
        "distance": np.round(np.hypot(*clusters.centre.T), 1).tolist(),
        "verdict": [Verdict(verdict).label for verdict in clusters.verdict.tolist()],
        "size": clusters.size.tolist(),
        "eccentricity": _finite(clusters.eccentricity),
        "radius_cm": _finite(100.0 * clusters.radius),
    }


def trees_payload(frame: Frame, start_ns: int) -> list[dict[str, Any]]:
    """The confirmed trees, one dict each; what is not known is None."""
    return tree_rows(frame.trees, start_ns)


def tree_rows(trees: Trees, start_ns: int) -> list[dict[str, Any]]:
    """The confirmed trees of a table, one dict each; what is not known is None."""
    keep = np.flatnonzero(trees.confirmed)
    columns: dict[str, Sequence[Any]] = {
        "number": trees.number[keep].tolist(),
        "x": _rounded(trees.position[keep, 0]),
        "y": _rounded(trees.position[keep, 1]),
        "ellipse": ellipses(trees.covariance[keep]),
        "dbh_cm": _finite(100.0 * trees.dbh[keep]),
        "sigma_dbh_cm": _finite(100.0 * trees.dbh_sigma[keep]),
        "eccentricity": _finite(trees.eccentricity[keep]),
        "observations": trees.observations[keep].tolist(),
        "coverage_deg": _finite(np.degrees(trees.coverage[keep])),
        "first_seen_s": _rounded((trees.first_seen_ns[keep] - start_ns) / _NS),
        "last_seen_s": _rounded((trees.last_seen_ns[keep] - start_ns) / _NS),
    }
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def ellipses(covariance: Float) -> list[list[float]]:
    """Half axes [m] and direction of the longer one [rad] of the 1-sigma ellipses of (T, 2, 2)."""
    rows: list[list[float]] = np.round(half_axes(covariance), _DIGITS).tolist()
    return rows


def verdict_counts(verdicts: NDArray[np.int32]) -> dict[str, int]:
    """How many clusters ended with each verdict, in words, the most frequent first."""
    values, counts = np.unique(verdicts, return_counts=True)
    order = np.argsort(-counts, kind="stable")
    return {Verdict(int(values[k])).label: int(counts[k]) for k in order}


def truth_payload(truth: TruthTrees | None) -> dict[str, Any] | None:
    """The ground truth trees, None when there are none."""
    if truth is None:
        return None
    rows = zip(_rounded(truth.x), _rounded(truth.y), _finite(100.0 * truth.dbh), truth.kind, strict=True)
    return {"trees": [{"x": x, "y": y, "dbh_cm": dbh, "kind": kind} for x, y, dbh, kind in rows]}


def path_points(path_xy: Float, start: int) -> dict[str, Any]:
    """The piece of a path (N, 2) from a row on, for a page that has the rows before it."""
    return {"start": start, "points": np.round(path_xy[start:], 3).tolist()}


def first_difference(old: Float | None, new: Float) -> int:
    """How many rows from the start two paths (N, 2) have in common."""
    if old is None:
        return 0
    n = min(len(old), len(new))
    differs = (old[:n] != new[:n]).any(axis=1)
    return int(np.argmax(differs)) if differs.any() else n


def _rounded(values: Float) -> list[float]:
    rounded: list[float] = np.round(values, _DIGITS).tolist()
    return rounded


def _known(value: float) -> float | None:
    return round(value, 3) if math.isfinite(value) else None


def _finite(values: Float) -> list[float | None]:
    return [round(v, 2) if math.isfinite(v) else None for v in values.tolist()]
