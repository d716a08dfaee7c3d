"""Frames as the page receives them: the map without its points, verdict counts, uncertain trees, and the
points of one scan as a binary block."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from app.common.height_range import height_range
from app.explain.records import half_axes
from app.store.records import Content
from app.worker.course import QUANTITIES
from app.worker.protocol import RunCourse, Shown
from pipeline.config import Parameters
from pipeline.geometry.arcs import along_arc
from pipeline.repairs.record import identity_of
from pipeline.types.records import CLASSES, Clearance, Frame, Health, Trees, TruthTrees, Verdict, Zone
from pipeline.types.units import SECOND_NS

Float = NDArray[np.float64]

# 0.1 mm: finer than any sensor, and short in JSON.
_DIGITS = 4


def map_payload(shown: Shown, truth: TruthTrees | None, parameters: Parameters) -> dict[str, Any]:
    """Return the message "map" without its path and without points as a dict of JSON values.

    The keys are `type`, "map"; `index` and `time_s` of the scan [s since the first scan]; `pose` and `odom`,
    lists [x [m], y [m], yaw [rad]] of `T_map_base` and `T_odom_base`; `sigma_xy`, the root mean square of the
    standard deviations of x and y [m]; `n_eff`; `counts`, those of the frame; `health`, `trees`, `clusters`,
    `layers`, `clearance` and `obstacle`, the results of the functions of this module; `loops`, pairs of
    scans, `problems`, `repaired_numbers` and `agreeing`, as in `Shown`; `repairs`, the `identity_of` the
    repairs to which they belong; `intensity`, `has_intensity` of `Shown`; `height_range`, the heights at the
    ends of the colour ramp [m], see `height_range`; and the keys of `counts_of`.

    Args:
        shown: The scan with the map.
        truth: As in `counts_of`.
        parameters: The parameters in force.
    """
    frame = shown.frame
    estimate = frame.estimate
    return {
        "type": "map",
        "index": frame.index,
        "time_s": shown.time_s,
        "pose": _rounded(estimate.T_map_base.as_array()),
        "odom": _rounded(frame.T_odom_base.as_array()),
        "sigma_xy": round(estimate.sigma_xy, _DIGITS),
        "n_eff": round(estimate.n_eff, 1),
        "health": health_payload(frame.health),
        "trees": trees_payload(frame.trees, start_ns=frame.stamp_ns - round(shown.time_s * SECOND_NS)),
        "clusters": clusters_payload(frame),
        "counts": dict(frame.counts),
        **counts_of(frame, truth, parameters.evaluation.match_distance),
        "layers": layer_counts(frame),
        "clearance": clearance_payload(frame.clearance),
        "obstacle": obstacle_payload(frame, parameters.obstacles.width),
        "intensity": shown.has_intensity,
        "height_range": [round(height, 1) for height in height_range(frame)],
        "loops": shown.loops.tolist(),
        "repairs": identity_of(shown.repairs),
        "problems": list(shown.problems),
        "repaired_numbers": [list(numbers) for numbers in shown.repaired_numbers],
        "agreeing": [list(stems) for stems in shown.agreeing],
    }


def course_payload(course: RunCourse) -> dict[str, Any]:
    """Return the course of a map as a dict of JSON values: `scans` and `time_s`, as in `RunCourse`; `values`
    and `stages`, dicts from names to lists with one number for each scan, None where unknown or infinite; and
    `quantities`, a dict from the names of known quantities to dicts with `title` and `unit`."""
    quantities = {name: QUANTITIES[name] for name in QUANTITIES if name in course.known}
    return {
        "scans": course.scans.tolist(),
        "time_s": _rounded(course.time_s),
        "values": {name: [*map(_known, values.tolist())] for name, values in course.values.items()},
        "stages": {name: [*map(_known, values.tolist())] for name, values in course.stages.items()},
        "quantities": {name: {"title": each.title, "unit": each.unit} for name, each in quantities.items()},
    }


def layer_counts(frame: Frame) -> dict[str, int]:
    """Return a dict from layers of the scene to the number of their objects in a frame: `raw` and `filtered`
    (points), `clusters`, `fits` (detected trees with a known radius), `particles` and `trees` (confirmed)."""
    return {
        "raw": len(frame.raw),
        "filtered": len(frame.filtered),
        "clusters": len(frame.clusters.size),
        "fits": int(np.count_nonzero(np.isfinite(frame.clusters.radius[frame.detections.cluster]))),
        "particles": len(frame.estimate.particles),
        "trees": int(np.count_nonzero(frame.trees.confirmed)),
    }


def clearance_payload(clearance: Clearance | None) -> dict[str, Any] | None:
    """Return a dict with `zone` (its label), `ahead_m`, `beside_m` and `within_m`, see `Clearance`; None for
    None. Distances ahead and beside that are NaN or infinite are None."""
    if clearance is None:
        return None
    ahead, beside = _known(clearance.ahead), _known(clearance.beside)
    return {"zone": clearance.zone.label, "ahead_m": ahead, "beside_m": beside, "within_m": clearance.within}


_SECTIONS = 8  # of a side of the path on the 2D map


def obstacle_payload(frame: Frame, width: float) -> dict[str, Any] | None:
    """Return the nearest obstacle in the slow or stop zone as a dict with `x` and `y` in the map [m], and
    `outline`, the corners [x, y] of the path that is checked [m]; None without an obstacle in these zones.

    Args:
        frame: Results of the scan.
        width: Width of the path [m].
    """
    clearance = frame.clearance
    if clearance is None or clearance.zone not in (Zone.SLOW, Zone.STOP):
        return None
    s = np.linspace(clearance.begins, clearance.begins + clearance.within, _SECTIONS + 1)
    right, left = (
        along_arc(s, side, clearance.curvature, clearance.backward) for side in (-0.5 * width, 0.5 * width)
    )
    place = frame.estimate.T_map_base.apply(np.vstack([(clearance.x, clearance.y), right, left[::-1]]))
    (x, y), *outline = np.round(place, 3).tolist()
    return {"x": x, "y": y, "outline": outline}


def health_payload(health: Health) -> dict[str, Any]:
    """Return the pose quality as a dict with `state`, `reason`, `n_eff`, `ancestors`, `detections`,
    `recognised`, `ambiguous`, `innovation`, `sigma_xy_m`, `sigma_yaw_deg` and `odometry_sigmas`, see
    `Health`. Numbers that are NaN or infinite are None, others are rounded to 3 decimals."""
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
    """Return the clusters of the scan as a dict of lists with one value per cluster: `x`, `y` in the map [m],
    `distance` from the sensor [m], `verdict` (its label), `size` (number of points), `eccentricity` and
    `radius_cm`. Unknown or infinite eccentricities and radii are None."""
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
    """Return the confirmed trees of a table as a list of dicts for the dashboard, with `number`, `x`, `y`
    [m], `ellipse` (see `ellipses`), `dbh_cm`, `sigma_dbh_cm`, `eccentricity`, `observations`, `coverage_deg`,
    `first_seen_s`, `last_seen_s`, `height_m`, `sigma_height_m`, `lean_deg` and, of a tree without a diameter,
    `sides`, see `Trees`. Unknown diameters, eccentricities, coverages, heights, leans and sides are None.
    Positions, diameters, heights and leans are rounded once, to the decimals of trees.csv.

    Args:
        trees: The table.
        start_ns: Time of the first scan, from which the seconds count [ns].
    """
    keep = np.flatnonzero(trees.confirmed)
    unknown = np.full(len(trees.number), np.nan)
    lean = unknown if trees.lean is None else np.degrees(trees.lean)
    sides = np.full(len(trees.number), np.nan) if trees.sides is None else trees.sides.astype(np.float64)
    columns: dict[str, Sequence[Any]] = {
        "number": trees.number[keep].tolist(),
        "x": np.round(trees.position[keep, 0], 3).tolist(),
        "y": np.round(trees.position[keep, 1], 3).tolist(),
        "ellipse": ellipses(trees.covariance[keep]),
        "dbh_cm": _finite(100.0 * trees.dbh[keep], 1),
        "sigma_dbh_cm": _finite(100.0 * trees.dbh_sigma[keep], 1),
        "eccentricity": _finite(trees.eccentricity[keep]),
        "observations": trees.observations[keep].tolist(),
        "coverage_deg": _finite(np.degrees(trees.coverage[keep])),
        "first_seen_s": _rounded((trees.first_seen_ns[keep] - start_ns) / SECOND_NS),
        "last_seen_s": _rounded((trees.last_seen_ns[keep] - start_ns) / SECOND_NS),
        "height_m": _finite((unknown if trees.height is None else trees.height)[keep]),
        "sigma_height_m": _finite((unknown if trees.height_sigma is None else trees.height_sigma)[keep]),
        "lean_deg": _finite(lean[keep]),
        "sides": [
            None if math.isnan(seen) or math.isfinite(dbh) else int(seen)
            for seen, dbh in zip(sides[keep].tolist(), trees.dbh[keep].tolist(), strict=True)
        ],
    }
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def ellipses(covariance: Float) -> list[list[float]]:
    """Return a list [major half axis [m], minor half axis [m], direction of the major axis [rad]] for the
    1-sigma ellipse of each covariance, shape (T, 2, 2) [m^2]."""
    rows: list[list[float]] = np.round(half_axes(covariance), _DIGITS).tolist()
    return rows


def verdict_counts(verdicts: NDArray[np.int32]) -> dict[str, int]:
    """Return a dict from the label of each verdict that occurs to its number of clusters, most frequent
    first, equally frequent ones in the order of `Verdict`."""
    values, counts = np.unique(verdicts, return_counts=True)
    order = np.argsort(-counts, kind="stable")
    return {Verdict(int(values[k])).label: int(counts[k]) for k in order}


def truth_payload(truth: TruthTrees | None, annotations: Sequence[Content] = ()) -> dict[str, Any] | None:
    """Return {"trees": [...]}, a list of a dict for each object of the ground truth, of any class, with `x`,
    `y` [m], `dbh_cm` (None if unknown) and `kind`; None for None.

    Args:
        truth: The ground truth.
        annotations: The annotations in it, whose objects are its last ones. Their dicts have also `annotated`
            (True) and `taped`, whether the DBH is that of the annotation.
    """
    if truth is None:
        return None
    columns = zip(_rounded(truth.x), _rounded(truth.y), _finite(100.0 * truth.dbh), truth.kind, strict=True)
    rows: list[dict[str, Any]] = [
        {"x": x, "y": y, "dbh_cm": dbh, "kind": kind} for x, y, dbh, kind in columns
    ]
    for row, content in zip(rows[len(rows) - len(annotations) :], annotations, strict=True):
        row.update(annotated=True, taped=content.dbh is not None)
    return {"trees": rows}


def _rounded(values: Float) -> list[float]:
    """Return values rounded to 0.1 mm, as a list of the same shape."""
    rounded: list[float] = np.round(values, _DIGITS).tolist()
    return rounded


def _known(value: float) -> float | None:
    """Return a number rounded to three decimals; None if it is not finite."""
    return round(value, 3) if math.isfinite(value) else None


def _finite(values: Float, digits: int = 2) -> list[float | None]:
    """Return numbers, shape (N,), rounded to `digits` decimals; None where not finite."""
    return [round(v, digits) if math.isfinite(v) else None for v in values.tolist()]


def counts_of(frame: Frame, truth: TruthTrees | None, match_distance: float) -> dict[str, Any]:
    """Return a dict with `verdicts`, the result of `verdict_counts` for the scan; `right`, the number of
    detections that are paired one to one with a true tree (see `match`); and `wrong`, the number of other
    detections, also of those paired with an object that is no tree. `right` and `wrong` are None if there is
    no ground truth.

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


def counts_before(before: dict[str, Any] | None, now: dict[str, Any]) -> dict[str, Any] | None:
    """Return the keys of `counts_of` of an earlier message "map" of the same scan; None if there is none.

    Args:
        before: The message before the last change of parameters; None without one.
        now: The message that is shown.
    """
    if before is None or before["index"] != now["index"]:
        return None
    return {name: before[name] for name in ("verdicts", "right", "wrong")}


REACH = 0.45  # m; maximum distance between a tree and its column


def doubts_of(frame: Frame, tree_share: float) -> list[dict[str, Any]]:
    """Return a list of a dict for each confirmed tree: `tree`, the number; `votes`, the share of votes for a
    tree; `next`, the label of the other class with most votes; and `next_votes`, its share. The trees whose
    `votes` are nearest to `tree_share` come first; of equal ones, the one with fewer observations, then with
    the lower number.

    The votes are those of the nearest voxel column. If it is not within REACH, `votes` and `next_votes` are
    None and the tree comes last. If the frame has no columns, `votes` is None, `next` "" and `next_votes` 0.

    Args:
        frame: Results of the newest scan.
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
    """Return the absolute difference between the votes and the required share; infinity for None."""
    return float("inf") if votes is None else abs(votes - tree_share)


_ALIGNED = 4
_FARTHEST_CM = 32_767


def binary_payload(header: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> bytes:
    """Return a binary block: length of the header (4 bytes, little-endian), header as JSON, arrays. The
    header and each array are padded to a multiple of four bytes; the length includes the padding.

    Args:
        header: A dict of JSON values. The key `arrays` is added, a list of dicts with `name`, `type` (as
            `numpy.dtype.str`), `shape` and `at`, the offset of the array from the end of the header [bytes].
        arrays: Dict from names to arrays.
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
    """Return points, shape (N, 3) [m], rounded to centimetres, int16 [cm], clipped to -32767 to 32767."""
    return np.clip(np.round(100.0 * points), -_FARTHEST_CM, _FARTHEST_CM).astype(np.int16)


def described(frame: Frame, truth: TruthTrees | None, match_distance: float) -> dict[str, Any]:
    """Return the description of the clusters of a frame for the header of a binary block, a dict with `index`
    of the scan, `clusters` (see `clusters_payload`), the keys of `counts_of`, and `counts` of the frame.
    Arguments as in `counts_of`."""
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
    for each set; the number of the set, from 0, is appended to their names. The header has `pictures`, a list
    of the result of `described` for each set.

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
    """Return a dict of arrays for `binary_payload`: `points`, filtered points, int16, shape (M, 3) [cm];
    `labels`, the cluster of each point, int32, shape (M,), -1 for none; and `circles`, x, y, radius (NaN if
    unknown) and height of the centroid of each cluster, float32, shape (K, 4) [m]. All are in the level frame
    of the sensor."""
    circles = np.column_stack([frame.clusters.centre, frame.clusters.radius, frame.clusters.centroid[:, 2]])
    return {
        "points": in_centimetres(frame.filtered),
        "labels": frame.labels.astype(np.int32),
        "circles": circles.astype(np.float32),
    }
