"""Repairs of trees: the row of each kind in the table of trees."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from pipeline.geometry.columns import rows_of
from pipeline.repairs.record import GATE, Repair, nearest_tree, numbers_at
from pipeline.types.records import Float, Int, Trees

SIDES = 36  # sectors of `Trees.sides`


def repaired_trees(trees: Trees, repair: Repair) -> tuple[Trees, str]:
    """Return the trees after a repair of trees, and why it does not apply, "" if it does.

    Args:
        trees: The trees; not changed.
        repair: A repair that is not of a loop.
    """
    x, y = repair.places[0]
    becomes_tree = repair.value == "tree"
    row = nearest_tree(trees, repair.places[0], confirmed=not becomes_tree)
    if row is None and becomes_tree and nearest_tree(trees, repair.places[0], confirmed=True) is not None:
        return trees, ""  # it is a tree already
    if row is None:
        return trees, f"no {'candidate' if becomes_tree else 'tree'} is within {GATE} m of {x:.2f}, {y:.2f}"
    match repair.kind:
        case "merge":
            other = nearest_tree(trees, repair.places[1], confirmed=True)
            if other is None:
                x, y = repair.places[1]
                return trees, f"no tree is within {GATE} m of {x:.2f}, {y:.2f}"
            if other == row:
                return trees, f"both positions are of tree {trees.number[row]}"
            return merged_trees(trees, np.array([row]), np.array([other])), ""
        case "split":
            return _split(trees, row, np.array(repair.places[1])), ""
        case "move":
            return _placed(trees, row, np.array(repair.places[1])), ""
        case "class":
            confirmed = trees.confirmed.copy()
            confirmed[[row] if becomes_tree else _at_one_place(trees, row)] = becomes_tree
            return replace(trees, confirmed=confirmed), ""
        case _:
            return rows_of(trees, np.delete(np.arange(len(trees.number)), _at_one_place(trees, row))), ""


def _at_one_place(trees: Trees, row: int) -> Int:
    """Return the rows of a confirmed tree and of those whose stems overlap with its own, which are further
    copies of one thing: two stems cannot be at one place. An unknown diameter counts as 0."""
    radius = 0.5 * np.nan_to_num(trees.dbh)
    away = np.hypot(*(trees.position - trees.position[row]).T)
    overlaps = trees.confirmed & (away < radius + radius[row])
    overlaps[row] = True
    return np.flatnonzero(overlaps)


def numbers_of(trees: Trees, repair: Repair) -> tuple[int, ...]:
    """Return the numbers of the trees that a repair of trees is about; those not in the map are left out."""
    if repair.kind in ("delete", "class") and repair.value != "tree":
        row = nearest_tree(trees, repair.places[0], confirmed=True)
        return () if row is None else tuple(trees.number[_at_one_place(trees, row)].tolist())
    places = repair.places if repair.kind == "merge" else repair.places[:1]
    return numbers_at(trees, places, confirmed=repair.value != "tree")


def merged_trees(trees: Trees, into: Int, others: Int) -> Trees:
    """Return the trees without the rows `others`, each merged into a row of `into`, shape (M,); no row is in
    both, or twice.

    The position is the mean weighted by the inverse variances; diameter and height are means as by
    `_consensus`; eccentricity and lean are means weighted by the observations. The sides that were observed
    are joined. The observations are those of the union of the scans: their sum if one tree was last seen
    before the other one was first seen. Otherwise it is not known which scans detected both, and the larger
    number is taken, which the union has at least.
    """
    if not len(into):
        return trees
    a, b = rows_of(trees, into), rows_of(trees, others)
    inverse = np.linalg.inv(a.covariance) + np.linalg.inv(b.covariance)
    covariance = np.linalg.inv(inverse)
    position = np.einsum(
        "nij,nj->ni",
        covariance,
        np.linalg.solve(a.covariance, a.position[:, :, None])[:, :, 0]
        + np.linalg.solve(b.covariance, b.position[:, :, None])[:, :, 0],
    )
    dbh, dbh_sigma = _consensus(a.dbh, a.dbh_sigma, b.dbh, b.dbh_sigma)
    both = a.observations + b.observations
    is_apart = (a.last_seen_ns < b.first_seen_ns) | (b.last_seen_ns < a.first_seen_ns)
    observed = np.where(is_apart, both, np.maximum(a.observations, b.observations))
    share = a.observations / np.maximum(both, 1)
    coverage, sides = np.maximum(a.coverage, b.coverage), None
    if a.sides is not None and b.sides is not None:
        sides = a.sides | b.sides
        coverage = np.maximum(coverage, np.array([bin(s).count("1") for s in sides]) * (2 * math.pi / SIDES))
    columns = {
        "position": position,
        "covariance": covariance,
        "dbh": dbh,
        "dbh_sigma": dbh_sigma,
        "eccentricity": _mean(a.eccentricity, b.eccentricity, share),
        "observations": observed,
        "coverage": np.minimum(coverage, 2 * math.pi),
        "first_seen_ns": np.minimum(a.first_seen_ns, b.first_seen_ns),
        "last_seen_ns": np.maximum(a.last_seen_ns, b.last_seen_ns),
        "confirmed": a.confirmed | b.confirmed,
        "sides": sides,
    }
    if a.height is not None and b.height is not None and a.height_sigma is not None:
        assert b.height_sigma is not None  # noqa: S101 - both are of one table
        height = _consensus(a.height, a.height_sigma, b.height, b.height_sigma)
        columns |= {"height": height[0], "height_sigma": height[1]}
    if a.lean is not None and b.lean is not None:
        columns["lean"] = _mean(a.lean, b.lean, share)
    changed = {}
    for name, values in columns.items():
        if values is not None:
            column = getattr(trees, name).copy()
            column[into] = values
            changed[name] = column
    return rows_of(replace(trees, **changed), np.setdiff1d(np.arange(len(trees.number)), others))


def number_beside(numbers: Int, number: int) -> int:
    """Return the number of a stem that is separated from a tree: 9001, 9002 and so on for tree 9, the first
    that `numbers` does not have. Numbers that follow the last one would be those of trees to come."""
    taken, beside = set(numbers.tolist()), 1000 * number + 1
    while beside in taken:
        beside += 1
    return beside


def _split(trees: Trees, row: int, place: Float) -> Trees:
    """Return the trees with a copy of a row at a position, see `number_beside`. The diameters of both are
    unknown, because that of the row was fitted to both stems."""
    table = _placed(rows_of(trees, np.append(np.arange(len(trees.number)), row)), -1, place)
    both = [row, len(trees.number)]
    numbers, dbh, dbh_sigma = table.number.copy(), table.dbh.copy(), table.dbh_sigma.copy()
    numbers[-1] = number_beside(trees.number, int(trees.number[row]))
    dbh[both] = dbh_sigma[both] = np.nan
    return replace(table, number=numbers, dbh=dbh, dbh_sigma=dbh_sigma)


def _placed(trees: Trees, row: int, place: Float) -> Trees:
    """Return the trees with a row at a position that a person gave: no scan detected the stem there, so that
    its standard deviation counts as assumed."""
    position, observations = trees.position.copy(), trees.observations.copy()
    position[row], observations[row] = place, 0
    return replace(trees, position=position, observations=observations)


def _consensus(a: Float, sigma_a: Float, b: Float, sigma_b: Float) -> tuple[Float, Float]:
    """Return consensus means of two measurements, and their standard deviations; where one value is NaN, the
    other one.

    Values that differ by more than their standard deviations explain have a further variance tau^2 each, such
    that (a - b)^2 = sigma_a^2 + sigma_b^2 + 2 tau^2 (Paule and Mandel, Journal of Research of the National
    Bureau of Standards 87, 1982). Far apart, the mean is then (a + b) / 2 with the standard deviation
    |a - b| / 2, which covers both.
    """
    gap, known_a, known_b = a - b, np.isfinite(a) & (sigma_a > 0.0), np.isfinite(b) & (sigma_b > 0.0)
    further = np.maximum(0.5 * (gap**2 - sigma_a**2 - sigma_b**2), 0.0)
    further = np.where(known_a & known_b, further, 0.0)
    weight_a = np.where(known_a, 1.0 / (sigma_a**2 + further), 0.0)
    weight_b = np.where(known_b, 1.0 / (sigma_b**2 + further), 0.0)
    total = weight_a + weight_b
    known = total > 0.0
    safe = np.where(known, total, 1.0)
    mean = (weight_a * np.nan_to_num(a) + weight_b * np.nan_to_num(b)) / safe
    either, sigma = np.where(np.isfinite(a), a, b), np.where(np.isfinite(a), sigma_a, sigma_b)
    return np.where(known, mean, either), np.where(known, safe**-0.5, sigma)


def _mean(a: Float, b: Float, share: Float) -> Float:
    """Return means with the share of `a`; where one value is NaN, the other one."""
    mean: Float = np.where(np.isnan(a), b, np.where(np.isnan(b), a, share * a + (1.0 - share) * b))
    return mean
