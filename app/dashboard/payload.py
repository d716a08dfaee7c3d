"""Frames as the page receives them: the map without its points, verdict counts, uncertain trees, and the
points of one scan as a binary block."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from app.explain.history import half_axes
from app.worker.protocol import Shown
from pipeline.types.records import CLASSES, Clearance, Frame, Health, Trees, TruthTrees, Verdict

Float = NDArray[np.float64]

_NS = 1_000_000_000
# 0.1 mm: finer than any sensor, and short in JSON.
_DIGITS = 4


def map_payload(shown: Shown) -> dict[str, Any]:
    """Return the message "map" without its path: `index` and `time_s` of the scan [s since the first], `pose`
    and `odom` as [x, y, yaw], `sigma_xy`, the root mean square of the standard deviations of x and y [m],
    `n_eff`, and `health`, `trees`, `verdicts`, `clusters`, `counts`, `layers` and `clearance` as the
    functions of this module return them. Points are not included."""
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
        "trees": trees_payload(frame.trees, start_ns=frame.stamp_ns - round(shown.time_s * _NS)),
        "verdicts": verdict_counts(frame.clusters.verdict),
        "clusters": clusters_payload(frame),
        "counts": dict(frame.counts),
        "layers": layer_counts(frame),
        "clearance": clearance_payload(frame.clearance),
    }


def layer_counts(frame: Frame) -> dict[str, int]:
    """Return the number of objects of a frame by layer of the scene: `raw`, `filtered`, `clusters`, `fits`
    (detected trees with a radius), `particles` and `trees` (confirmed)."""
    return {
        "raw": len(frame.raw),
        "filtered": len(frame.filtered),
        "clusters": len(frame.clusters.size),
        "fits": int(np.count_nonzero(np.isfinite(frame.clusters.radius[frame.detections.cluster]))),
        "particles": len(frame.estimate.particles),
        "trees": int(np.count_nonzero(frame.trees.confirmed)),
    }


def clearance_payload(clearance: Clearance | None) -> dict[str, Any] | None:
    """Return `zone` as text, `ahead_m`, `beside_m` and `within_m`, see `Clearance`; unknown or infinite
    distances are None, and so is the result without a clearance."""
    if clearance is None:
        return None
    ahead, beside = _known(clearance.ahead), _known(clearance.beside)
    return {"zone": clearance.zone.label, "ahead_m": ahead, "beside_m": beside, "within_m": clearance.within}


def health_payload(health: Health) -> dict[str, Any]:
    """Return the pose quality: `state`, `reason`, `n_eff`, `ancestors`, `detections`, `recognised`,
    `ambiguous`, `innovation`, `sigma_xy_m`, `sigma_yaw_deg` and `odometry_sigmas`, see `Health`; unknown
    figures are None."""
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
    """Return the clusters of the scan as columns of equal length: `x`, `y` in the map [m], `distance` from
    the sensor [m], `verdict` (its label), `size` (number of points), `eccentricity` and `radius_cm`. Unknown
    or infinite eccentricities and radii are None."""
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


def trees_payload(trees: Trees, start_ns: int) -> list[dict[str, Any]]:
    """Return the confirmed trees of a table as dicts for the page: `number`, `x`, `y` [m], `ellipse` (see
    `ellipses`), `dbh_cm`, `sigma_dbh_cm`, `eccentricity`, `observations`, `coverage_deg`, `first_seen_s`,
    `last_seen_s`, `height_m`, `sigma_height_m` and `lean_deg`. Unknown diameters, eccentricities, coverages,
    heights and leans are None.

    Args:
        trees: The table.
        start_ns: Time of the first scan, from which the seconds count [ns].
    """
    keep = np.flatnonzero(trees.confirmed)
    unknown = np.full(len(trees.number), np.nan)
    lean = unknown if trees.lean is None else np.degrees(trees.lean)
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
        "height_m": _finite((unknown if trees.height is None else trees.height)[keep]),
        "sigma_height_m": _finite((unknown if trees.height_sigma is None else trees.height_sigma)[keep]),
        "lean_deg": _finite(lean[keep]),
    }
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def ellipses(covariance: Float) -> list[list[float]]:
    """Return [major half axis, minor half axis [m], direction of the major axis [rad]] of the 1-sigma ellipse
    of each covariance, shape (T, 2, 2)."""
    rows: list[list[float]] = np.round(half_axes(covariance), _DIGITS).tolist()
    return rows


def verdict_counts(verdicts: NDArray[np.int32]) -> dict[str, int]:
    """Return the number of clusters by label of the verdict, most frequent first, equally frequent ones in
    the order of `Verdict`."""
    values, counts = np.unique(verdicts, return_counts=True)
    order = np.argsort(-counts, kind="stable")
    return {Verdict(int(values[k])).label: int(counts[k]) for k in order}


def truth_payload(truth: TruthTrees | None) -> dict[str, Any] | None:
    """Return {"trees": [...]}, the objects of the ground truth of all classes with `x`, `y` [m], `dbh_cm`
    (None if unknown) and `kind`; None for None."""
    if truth is None:
        return None
    rows = zip(_rounded(truth.x), _rounded(truth.y), _finite(100.0 * truth.dbh), truth.kind, strict=True)
    return {"trees": [{"x": x, "y": y, "dbh_cm": dbh, "kind": kind} for x, y, dbh, kind in rows]}


def _rounded(values: Float) -> list[float]:
    """Return values rounded to 0.1 mm, as a list of the same shape."""
    rounded: list[float] = np.round(values, _DIGITS).tolist()
    return rounded


def _known(value: float) -> float | None:
    """Return a number rounded to three decimals; None if it is not finite."""
    return round(value, 3) if math.isfinite(value) else None


def _finite(values: Float) -> list[float | None]:
    """Return numbers, shape (N,), rounded to two decimals; None where not finite."""
    return [round(v, 2) if math.isfinite(v) else None for v in values.tolist()]


def counts_of(frame: Frame, truth: TruthTrees | None, match_distance: float) -> dict[str, Any]:
    """Return the verdict counts of a scan: `verdicts`, the number of clusters by verdict, and `right` and
    `wrong`, the numbers of detections that are paired with a true tree (one to one, see `match`), and that
    are not, also because the paired object is no tree; None without ground truth.

    Args:
        frame: Results of the scan.
        truth: Ground truth, or None.
        match_distance: Maximum distance between a detection and its true tree [m].
    """
    verdicts = verdict_counts(frame.clusters.verdict)
    if truth is None:
        return {"verdicts": verdicts, "right": None, "wrong": None}
    from pipeline.evaluation import match

    found = frame.estimate.T_map_base.apply(frame.detections.centre)
    truth_of = match(found, np.column_stack([truth.x, truth.y]), match_distance)
    right = sum(row >= 0 and truth.kind[row] == "tree" for row in truth_of.tolist())
    return {"verdicts": verdicts, "right": right, "wrong": len(found) - right}


class BeforeAfter:
    """Keeps the verdict counts of the current scan before the last change of parameters."""

    def __init__(self) -> None:
        self._now: tuple[int, dict[str, Any] | None] = (-1, None)  # index of the scan, and its counts
        self._before: tuple[int, dict[str, Any] | None] = self._now

    def step(self) -> None:
        """Keep the present counts as those before a change that is a step of its own."""
        self._before = self._now

    def shown(self, index: int, counts: dict[str, Any]) -> dict[str, Any]:
        """Set the counts of the displayed scan, by its index, and return `right` and `wrong` of them and
        `before`, the counts of this scan before the change, for the page; `before` is None without a change,
        and if another scan was displayed since it."""
        self._now = (index, counts)
        if self._before[0] != index:
            self._before = (-1, None)
        return {"right": counts["right"], "wrong": counts["wrong"], "before": self._before[1]}


REACH = 0.45  # m; maximum distance between a tree and its column


def doubts_of(frame: Frame, tree_share: float) -> list[dict[str, Any]]:
    """Return a dict for each confirmed tree, the most uncertain first (share of votes nearest to
    `tree_share`), of equal ones the least observed, then the lowest number: its number (`tree`), the share of
    `votes` for a tree, and the class with most votes besides "tree" (`next`, `next_votes`). [] without
    confirmed trees.

    Trees without a voxel column within REACH have no votes (`votes` and `next_votes` are None) and come last.
    Without any columns, `next` is "" and `next_votes` 0.

    Args:
        frame: Results of the newest scan, with its voxel columns; None for these gives no votes.
        tree_share: Share of the votes that a tree needs.
    """
    from scipy.spatial import cKDTree

    # Same order as on the page: of equal uncertainty, the least observed tree first.
    rows = np.flatnonzero(frame.trees.confirmed)
    rows = rows[np.lexsort((frame.trees.number[rows], frame.trees.observations[rows]))]
    number = frame.trees.number[rows].tolist()
    columns = frame.columns
    if columns is None or not len(columns.share):
        return [{"tree": each, "votes": None, "next": "", "next_votes": 0.0} for each in number]
    distance, column = cKDTree(columns.axis[:, :2]).query(frame.trees.position[rows])
    listed = []
    for tree, far, row in zip(number, distance.tolist(), column.tolist(), strict=True):
        share = columns.share[row]
        other = 1 + int(share[1:].argmax())
        votes, following = (None if far > REACH else round(float(share[k]), 3) for k in (0, other))
        listed.append({"tree": tree, "votes": votes, "next": CLASSES[other].label, "next_votes": following})
    return sorted(listed, key=lambda each: _margin(each["votes"], tree_share))


def _margin(votes: float | None, tree_share: float) -> float:
    """Return how far the votes are from the required share; infinite for None."""
    return float("inf") if votes is None else abs(votes - tree_share)


_ALIGNED = 4
_FARTHEST_CM = 32_767


def binary_payload(header: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> bytes:
    """Return a binary block: length of the header (4 bytes, little-endian), header as JSON, arrays. The
    header and each array are padded to a multiple of four bytes; the length includes the padding.

    Args:
        header: JSON values. A list `arrays` is added, each with `name`, `type` (as `numpy.dtype.str`),
            `shape` and `at`, its first byte after the header.
        arrays: Arrays by name.
    """
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
    """Return points of shape (N, 3) [m] in whole centimetres, int16, clipped to -327.67 m to 327.67 m."""
    return np.clip(np.round(100.0 * points), -_FARTHEST_CM, _FARTHEST_CM).astype(np.int16)


def described(frame: Frame, truth: TruthTrees | None, match_distance: float) -> dict[str, Any]:
    """Return the description of the clusters of a frame for the header of a binary block: `index` of the
    scan, `clusters` (see `clusters_payload`), the result of `counts_of`, and `counts`, numbers of points by
    stage. Arguments as in `counts_of`."""
    return {
        "index": frame.index,
        "clusters": clusters_payload(frame),
        **counts_of(frame, truth, match_distance),
        "counts": dict(frame.counts),
    }


def stages_payload(frame: Frame) -> bytes:
    """Return the stages of Fig. 3 as a binary block: the header of `described` without ground truth, and the
    arrays `raw`, int16, shape (N, 3) [cm], and those of `_clustered`."""
    arrays = {"raw": in_centimetres(frame.raw), **_clustered(frame)}
    return binary_payload(described(frame, None, 0.0), arrays)


def comparison_payload(
    frames: list[Frame], header: dict[str, Any], truth: TruthTrees | None, match_distance: float
) -> bytes:
    """Return one scan under several parameter sets as a binary block. The arrays are those of `_clustered`
    for each set; their names end with the number of the set, from 0. The header has `pictures`, see
    `described`.

    Args:
        frames: Results of the scan with each set.
        header: Further values of the header.
        truth, match_distance: As in `counts_of`.
    """
    arrays = {
        f"{name}{k}": array for k, frame in enumerate(frames) for name, array in _clustered(frame).items()
    }
    pictures = [described(frame, truth, match_distance) for frame in frames]
    return binary_payload({**header, "pictures": pictures}, arrays)


def _clustered(frame: Frame) -> dict[str, NDArray[Any]]:
    """Return arrays for `binary_payload`: `points`, filtered points, int16, shape (M, 3) [cm]; `labels`, the
    cluster of each, int32, shape (M,), -1 for none; and `circles`, x, y, radius (NaN if unknown) and height
    of the centroid of each cluster, float32, shape (K, 4) [m]. All are in the level frame of the sensor."""
    circles = np.column_stack([frame.clusters.centre, frame.clusters.radius, frame.clusters.centroid[:, 2]])
    return {
        "points": in_centimetres(frame.filtered),
        "labels": frame.labels.astype(np.int32),
        "circles": circles.astype(np.float32),
    }
