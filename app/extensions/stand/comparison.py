"""Comparison of two visits of a stand, each a finished run or a table of trees."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import shapely

from app.batch.map_frame import WGS84, MapFrame, read_map_frame, reproject
from app.batch.run_folder import counted_dbh, read_by_people, read_run, read_seen_area
from app.batch.visits import (
    VisitComparison,
    VisitTrees,
    compare_visits,
    with_known_sigma,
)
from app.common.text import count, version
from app.extensions.stand.parameters import Stand
from app.extensions.stand.plots import within_reach
from pipeline.config import Parameters
from pipeline.config.stages import Relocalisation
from pipeline.errors import StemmapError
from pipeline.geometry.poses import Float, Pose2
from pipeline.io.atomic_files import write_texts
from pipeline.io.csv_table import CsvTable
from pipeline.io.ground_truth import LARGEST_FILE, read_truth_trees
from pipeline.io.result_files import csv_text
from pipeline.loop_closure.stem_matching import MapStems, find_constellation
from pipeline.seen_area import SeenArea
from pipeline.types.records import Bool

# Assumed distortions of a map over the extent of a constellation [m], the smallest first.
SLACKS = (0.1, 0.2, 0.3)
_HYPOTHESES = 3_000_000
TABLE_SIGMA = 0.05  # m, of a position in a table
# A greater median ratio of diameters is one of units: inch to cm is 2.54, circumference to diameter pi.
LARGEST_RATIO = 2.0
FEWEST_RATIOS = 3  # a median of fewer may be one wrong pair
BORDER = 0.5  # m; a table of trees covers their convex hull with this border
COLUMNS = (
    "status",
    "tree_a",
    "tree_b",
    "x_m",
    "y_m",
    "shift_m",
    "dbh_a_cm",
    "dbh_b_cm",
    "growth_cm",
    "sigma_growth_cm",
    "significant",
)


@dataclass(frozen=True, slots=True, eq=False)
class Visit:
    """A visit: its trees, and where it looked.

    Attributes:
        name: For messages.
        trees: Trees of the visit, without rejected ones.
        rejected: Positions of the trees that a person rejected, shape (R, 2) [m].
        seen: Observed area of a run; None for a table, or a run without a record of it.
        frame: Reference system of its coordinates.
    """

    name: str
    trees: VisitTrees
    rejected: Float
    seen: SeenArea | None
    frame: MapFrame

    def observed(self, points: Float) -> Bool:
        """Return whether the visit looked at each position in its frame, shape (N, 2) [m]: inside the
        observed area, or without one inside the convex hull of its trees with BORDER around it."""
        if self.seen is not None:
            return self.seen.rows(points) >= 0
        hull = shapely.MultiPoint(self.trees.position).convex_hull.buffer(BORDER)
        inside: Bool = shapely.contains_xy(hull, *np.reshape(points, (-1, 2)).T)
        return inside


def align_visits(a: VisitTrees, b: VisitTrees, parameters: Relocalisation) -> tuple[Pose2, int]:
    """Return the pose of b in the frame of a and the number of stems that agree, without an initial pose. The
    distortions of the maps in SLACKS are tried in ascending order in place of the parameter `slack`, until a
    pose is found.

    Raises:
        StemmapError: No pose is found, see `find_constellation`.
    """
    centre_a, centre_b = (np.nanmean(v.position, axis=0) if len(v.number) else np.zeros(2) for v in (a, b))
    stems = [
        MapStems(v.position - c, np.maximum(v.sigma, 0.02), v.dbh, v.dbh_sigma)
        for v, c in ((a, centre_a), (b, centre_b))
    ]
    reason = "too few stems"
    for slack in SLACKS:
        chosen = parameters.model_copy(update={"slack": slack})
        found = find_constellation(stems[1], stems[0], chosen, hypotheses=_HYPOTHESES)
        if found.pose is not None:
            there = Pose2(float(centre_a[0]), float(centre_a[1]), 0.0)
            back = Pose2(-float(centre_b[0]), -float(centre_b[1]), 0.0)
            return there @ found.pose @ back, len(found.local)
        reason = found.reason or reason
    raise StemmapError(
        f"the stems of the two maps do not agree with certainty ({reason})",
        remedy="Compare visits that share more trees, or give --same-frame if their coordinates are the same",
    )


def read_visit(path: FilePath, *, dbh_unit: str | None = None, may_be_empty: bool = False) -> Visit:
    """Return the visit of a run folder or of a table of trees (CSV). Rejected trees of a run, and objects in
    a table that are not trees, are left out. A diameter by tape takes the place of that of the map. Trees of
    a table have the sigma TABLE_SIGMA and a local frame; the observed area of a run is that within the
    default reach of stand figures.

    Args:
        path: The folder or the table.
        dbh_unit: Unit of a diameter column of a table without a unit.
        may_be_empty: Whether the folder or table may have no trees.

    Raises:
        StemmapError: The folder or table cannot be read, or has no trees.
    """
    if path.is_dir():
        run, recorded = read_run(path), read_seen_area(path)
        trees = run.trees
        seen = None if recorded is None else within_reach(recorded.clear_cells(), Stand())
        sigma = np.sqrt(0.5 * np.trace(trees.covariance, axis1=1, axis2=2))
        tape = read_by_people(path).tape_of(trees.number.tolist())
        dbh, dbh_sigma, _ = counted_dbh(tape, trees.dbh, trees.dbh_sigma)
        found = VisitTrees(trees.number, trees.position, sigma, dbh, dbh_sigma)
        visit = Visit(str(path), found, run.rejected.position, seen, read_map_frame(path))
    else:
        table = read_truth_trees(path, dbh_unit=dbh_unit)
        keep = np.array([kind == "tree" for kind in table.kind], np.bool_)
        n = int(np.count_nonzero(keep))
        numbers = _numbers(path, keep)
        position = np.stack([table.x, table.y], axis=1)[keep]
        unknown = np.full(n, np.nan)
        found = VisitTrees(numbers, position, np.full(n, TABLE_SIGMA), np.asarray(table.dbh)[keep], unknown)
        visit = Visit(str(path), found, np.zeros((0, 2)), None, MapFrame())
    if not len(visit.trees.number) and not may_be_empty:
        raise StemmapError("there are no trees", where=str(path))
    return visit


def _numbers(path: FilePath, keep: Bool) -> np.ndarray:
    """Return the tree numbers of the selected rows of a table, int64, in the order of the rows: the cells of
    the column "tree" if these are different integers in all rows of the table, else the positions of the rows
    in the table, from 1.

    Args:
        path: The table, a CSV file.
        keep: Which of the N rows are selected, shape (N,).

    Raises:
        StemmapError: The table cannot be read.
    """
    cells = CsvTable.read(path, "table of trees", LARGEST_FILE).text("tree")
    try:
        numbers = np.array([int(cell) for cell in cells], np.int64)
    except (ValueError, OverflowError):
        numbers = np.zeros(0, np.int64)
    if len(numbers) != len(keep) or len(np.unique(numbers)) < len(numbers):
        numbers = np.arange(1, len(keep) + 1)
    return numbers[keep]


def compare(
    a: Visit, b: Visit, *, same_frame: bool = False, reach: float = 1.0, dbh_sigma: float = 0.01
) -> VisitComparison:
    """Find the pose of the second visit in the frame of the first by their stems, without an initial pose,
    and compare the trees of pairs.

    Args:
        a, b: The earlier and the later visit.
        same_frame: Whether their coordinates are taken as equal; then there is no alignment, `T_a_b` is the
            identity, and nothing is raised.
        reach: Maximum distance of the two positions of a tree in the frame of `a` [m].
        dbh_sigma: Standard deviation of a known diameter that has none [m].

    Raises:
        StemmapError: The stems do not agree with certainty.
    """
    first, second = (with_known_sigma(visit.trees, dbh_sigma) for visit in (a, b))
    try:
        pose, stems = (Pose2(), 0) if same_frame else align_visits(first, second, Parameters().relocalisation)
    except StemmapError as error:
        raise StemmapError(error.what, remedy=f"{error.remedy}{_other_unit(first, second)}") from None
    return compare_visits(first, second, pose, reach=reach, refine=not same_frame, stems=stems)


def _other_unit(a: VisitTrees, b: VisitTrees) -> str:
    """Return a hint for an error if the median diameters of two visits seem to have other units, else ""."""
    known = [visit.dbh[np.isfinite(visit.dbh)] for visit in (a, b)]
    if not all(len(dbh) for dbh in known):
        return ""
    first, second = (float(np.median(dbh)) for dbh in known)
    if 1.0 / LARGEST_RATIO <= second / first <= LARGEST_RATIO:
        return ""
    return f". The median diameters are {100 * first:.1f} and {100 * second:.1f} cm: check their units"


def _shared_sigma(trees: VisitTrees) -> float:
    """Return the standard deviation of the mean of the diameters by the error that they share [m]; 0 for a
    table without standard deviations, such as those by tape."""
    sigma = trees.dbh_sigma[np.isfinite(trees.dbh)]
    return float(np.minimum(np.nan_to_num(sigma), Stand().dbh_shared_sigma).mean()) if len(sigma) else 0.0


def rows_of(a: Visit, b: Visit, found: VisitComparison) -> list[dict[str, Any]]:
    """Return a dict with the keys COLUMNS for each tree, with None for unknown values: first for the trees of
    a in their order, each with its pair in b, then for the unpaired trees of b. Positions are in the frame of
    a.

    The status is `same` or `moved` for a pair. For a tree of one visit, it is `rejected in a` or `rejected in
    b` if a rejected tree of the other visit is within `found.reach`; else `missing` (only in a) or `new`
    (only in b) if the other visit observed the position; else `not seen in a` or `not seen in b`.
    """
    place_b = found.T_a_b.apply(b.trees.position)
    only_a = _status_in(b, "b", "missing", found.T_a_b.inverse().apply(a.trees.position), found.reach)
    only_b = _status_in(a, "a", "new", place_b, found.reach)
    rows, pair = [], 0
    for k, row in enumerate(found.b_of.tolist()):
        x, y = a.trees.position[k]
        if row < 0:
            rows.append(_row(only_a[k], a.trees.number[k], None, x, y, dbh_a=a.trees.dbh[k]))
            continue
        known = math.isfinite(found.growth[pair])
        rows.append(
            _row(
                "moved" if found.moved[pair] else "same",
                a.trees.number[k],
                b.trees.number[row],
                x,
                y,
                shift=found.shift[pair],
                dbh_a=a.trees.dbh[k],
                dbh_b=b.trees.dbh[row],
                growth=found.growth[pair],
                sigma=found.growth_sigma[pair],
                significant=bool(found.significant[pair]) if known else None,
            )
        )
        pair += 1
    for row in np.setdiff1d(np.arange(len(b.trees.number)), found.b_of).tolist():
        rows.append(_row(only_b[row], None, b.trees.number[row], *place_b[row], dbh_b=b.trees.dbh[row]))
    return rows


def _status_in(visit: Visit, name: str, observed: str, points: Float, reach: float) -> list[str]:
    """Return the status of each position, shape (N, 2) in the frame of a visit, at which the visit has no
    tree: "rejected in NAME" within `reach` [m] of a rejected tree; else the word `observed` if it looked
    there, or "not seen in NAME"."""
    near = np.hypot(*(points[:, None, :] - visit.rejected[None]).transpose(2, 0, 1)) <= reach
    rejected, seen = near.any(axis=1), visit.observed(points)
    return [
        f"rejected in {name}" if no else observed if looked else f"not seen in {name}"
        for no, looked in zip(rejected.tolist(), seen.tolist(), strict=True)
    ]


def _row(
    status: str,
    tree_a: Any,  # noqa: ANN401 - a numpy integer or None
    tree_b: Any,  # noqa: ANN401
    x: float,
    y: float,
    *,
    shift: float = math.nan,
    dbh_a: float = math.nan,
    dbh_b: float = math.nan,
    growth: float = math.nan,
    sigma: float = math.nan,
    significant: bool | None = None,
) -> dict[str, Any]:
    """Return a dict from the names in COLUMNS to rounded values; None for NaN. The arguments are in metres;
    diameters and growth of the result are in centimetres."""

    def number(value: float, digits: int) -> float | None:
        return round(float(value), digits) if math.isfinite(value) else None

    values = (
        status,
        None if tree_a is None else int(tree_a),
        None if tree_b is None else int(tree_b),
        number(x, 3),
        number(y, 3),
        number(shift, 3),
        *(number(100.0 * v, 2) for v in (dbh_a, dbh_b, growth, sigma)),
        significant,
    )
    return dict(zip(COLUMNS, values, strict=True))


def comparison_record(a: Visit, b: Visit, found: VisitComparison) -> dict[str, Any]:
    """Return the results of a comparison as a dict of JSON values; unknown values are None.

    The keys are `stemmap` (version) and the names `a` and `b`; `alignment`, a dict with the pose of b in a
    (`x_m`, `y_m`, `turn_deg`), `shift_of_centre_m` ([x, y] of the mean position of the trees of b) and
    `stems`; the numbers of trees `trees_a` and `trees_b`; `counts`, a dict from each status to its number of
    rows; `pairs`, the number of pairs, and `shift_rms_m`; `with_dbh`, the number of pairs with a DBH in both
    visits, and of these `growth_mean_cm`, `growth_weighted_cm`, `growth_se_cm` (at least two pairs, with the
    error that the diameters of a visit share, which is taken as independent of that of the other visit),
    `dbh_rms_difference_cm` and the number `significant`; and `warnings`, a list of strings.
    """
    rows = rows_of(a, b, found)
    growth = found.growth[np.isfinite(found.growth)]
    weight = 1.0 / np.square(found.growth_sigma[np.isfinite(found.growth)])
    known, position = len(growth) > 0, b.trees.position
    centre = position.mean(axis=0, keepdims=True) if len(position) else np.zeros((1, 2))
    return {
        "stemmap": version(),
        "a": a.name,
        "b": b.name,
        "alignment": {
            "x_m": found.T_a_b.x,
            "y_m": found.T_a_b.y,
            "turn_deg": math.degrees(found.T_a_b.yaw),
            "shift_of_centre_m": (found.T_a_b.apply(centre) - centre)[0].tolist(),
            "stems": found.stems,
        },
        "trees_a": len(a.trees.number),
        "trees_b": len(b.trees.number),
        "counts": {s: sum(1 for r in rows if r["status"] == s) for s in _SYMBOLS},
        "pairs": len(found.shift),
        "shift_rms_m": float(np.sqrt(np.mean(np.square(found.shift)))) if len(found.shift) else None,
        "growth_mean_cm": 100.0 * float(growth.mean()) if known else None,
        "growth_weighted_cm": 100.0 * float(weight @ growth / weight.sum()) if known else None,
        "growth_se_cm": 100.0
        * math.hypot(growth.std(ddof=1) / math.sqrt(len(growth)), *(_shared_sigma(v.trees) for v in (a, b)))
        if len(growth) > 1
        else None,
        "dbh_rms_difference_cm": 100.0 * float(np.sqrt(np.mean(np.square(growth)))) if known else None,
        "with_dbh": len(growth),
        "significant": int(np.count_nonzero(found.significant)),
        "warnings": _unit_warnings(a, b, found),
    }


def _unit_warnings(a: Visit, b: Visit, found: VisitComparison) -> list[str]:
    """Return a warning if the median ratio of the diameters of at least FEWEST_RATIOS pairs cannot be growth;
    else []."""
    pairs = np.flatnonzero(found.b_of >= 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = b.trees.dbh[found.b_of[pairs]] / a.trees.dbh[pairs]
    ratio = ratio[np.isfinite(ratio)]
    if len(ratio) < FEWEST_RATIOS:
        return []
    median = float(np.median(ratio))
    if 1.0 / LARGEST_RATIO <= median <= LARGEST_RATIO:
        return []
    return [
        f"the diameters of the later visit are {median:.3g} times those of the earlier one (median of "
        f"{count(len(ratio), 'pair')}): check the units of both, and whether one has circumferences"
    ]


def comparison_lines(record: dict[str, Any]) -> list[str]:
    """Return the results of `comparison_record` as lines for people, without its warnings; unknown values are
    left out."""
    pose, counts = record["alignment"], record["counts"]
    east, north = pose["shift_of_centre_m"]
    how = f"aligned by {count(pose['stems'], 'stem')}" if pose["stems"] else "coordinates taken as equal"
    lines = [
        f"{record['pairs']} trees in both of {record['trees_a']} and {record['trees_b']}; {how}: shift "
        f"{east:.2f}, {north:.2f} m, turn {pose['turn_deg']:.2f} degrees",
        ", ".join(f"{n} {status}" for status, n in counts.items() if n),
    ]
    if record["shift_rms_m"] is not None:
        lines.append(f"positions differ by {100 * record['shift_rms_m']:.1f} cm (RMS)")
    if record["growth_mean_cm"] is not None:
        se = record["growth_se_cm"]
        lines.append(
            f"diameter, b minus a: mean {record['growth_mean_cm']:+.2f} cm"
            + (f" +- {se:.2f}" if se is not None else "")
            + f", RMS {record['dbh_rms_difference_cm']:.2f} cm ({count(record['with_dbh'], 'tree')}), "
            f"significant for {record['significant']}"
        )
    return lines


def comparison_csv(rows: list[dict[str, Any]]) -> str:
    """Return the rows of `rows_of` as a CSV table; unknown values are empty."""
    cells = [
        ["" if v is None else str(v).lower() if isinstance(v, bool) else str(v) for v in row.values()]
        for row in rows
    ]
    return csv_text(COLUMNS, cells)


def write_comparison(a: Visit, b: Visit, found: VisitComparison, folder: FilePath) -> None:
    """Write comparison.csv, comparison.json, comparison.svg (a map) and comparison.geojson to a folder, which
    is created if necessary. The visits have at least one tree.

    Raises:
        OSError: The folder cannot be created.
        StemmapError: A file cannot be written.
    """
    rows = rows_of(a, b, found)
    texts = {
        "comparison.csv": comparison_csv(rows),
        "comparison.json": json.dumps(comparison_record(a, b, found), indent=1, allow_nan=False) + "\n",
        "comparison.geojson": _geojson(a, rows),
        "comparison.svg": comparison_map(rows),
    }
    write_texts(folder, texts)


def _geojson(a: Visit, rows: list[dict[str, Any]]) -> str:
    """Return the rows of `rows_of` as GeoJSON text: points in WGS84 if the first visit has a reference
    system, else in its local frame, which is declared."""
    place = np.array([[row["x_m"], row["y_m"]] for row in rows], np.float64).reshape(-1, 2)
    collection: dict[str, Any] = {"type": "FeatureCollection"}
    if a.frame.crs:
        place = np.round(reproject(a.frame.to_crs(place), a.frame.crs, WGS84), 8)
    else:
        collection["coordinateFrame"] = {"type": "local", "unit": "m", "origin": "that of the first visit"}
    collection["features"] = [
        {"type": "Feature", "geometry": {"type": "Point", "coordinates": point}, "properties": row}
        for point, row in zip(place.tolist(), rows, strict=True)
    ]
    return json.dumps(collection, indent=1, allow_nan=False) + "\n"


#: Symbol of each status on the map: fill and line.
_SYMBOLS = {
    "same": ("#5f8f64", "#1e5b24"),
    "moved": ("#e0b000", "#6b5400"),
    "missing": ("none", "#c02020"),
    "new": ("#2060c0", "#103060"),
    "not seen in a": ("none", "#999"),
    "not seen in b": ("none", "#999"),
    "rejected in a": ("none", "#c080c0"),
    "rejected in b": ("none", "#c080c0"),
}


def comparison_map(rows: list[dict[str, Any]]) -> str:
    """Return a map of the trees of `rows_of`, at least one, by their status as SVG, with a scale bar and a
    legend; significant growth is a filled circle with a ring."""
    from jinja2 import Environment, PackageLoader

    place = np.array([[row["x_m"], row["y_m"]] for row in rows], np.float64).reshape(-1, 2)
    low, high = place.min(axis=0) - 2.0, place.max(axis=0) + 2.0
    scale = 180.0 / max(float((high - low).max()), 1.0)
    width, height = ((high - low) * scale).tolist()
    environment = Environment(
        loader=PackageLoader("app.extensions.stand", "."),
        autoescape=True,
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    at = (place - [low[0], high[1]]) * [scale, -scale]
    return environment.get_template("comparison.svg.j2").render(
        trees=[(row, x, y) for row, (x, y) in zip(rows, at.tolist(), strict=True)],
        symbols=_SYMBOLS,
        width=width,
        height=height,
        scale=scale,
    )
