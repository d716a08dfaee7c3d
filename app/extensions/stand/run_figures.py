"""Stand figures of a finished run: reads its folder and plots, and writes tables."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import Any, NamedTuple

import numpy as np
import shapely

from app.batch.map_frame import MapFrame, read_map_frame
from app.batch.run_folder import (
    ByPeople,
    FinishedRun,
    counted_dbh,
    read_by_people,
    read_run,
    read_seen_area,
)
from app.common.text import count, version
from app.extensions.stand.figures import (
    FEW_TREES,
    FIGURES,
    HECTARE,
    Estimate,
    PlotTrees,
    StandFigures,
    combined,
    compared_with_gaps,
)
from app.extensions.stand.parameters import Stand
from app.extensions.stand.plots import (
    LEAST_TREES,
    DetectionFunction,
    SamplePlot,
    detection_function,
    figures_of,
    seen_plot,
    within_reach,
)
from app.extensions.stand.volume import VolumeFormula
from pipeline.errors import StemmapError
from pipeline.geometry.poses import Float
from pipeline.io.result_files import CONFIRMED, csv_text, number_text
from pipeline.seen_area import SeenArea
from pipeline.types.records import Bool, Trees

ALL = "all"
_MOST_NAMED = 3  # trees of one kind


class PeopleCount(NamedTuple):
    """Trees in the observed part of a plot, of at least the minimum diameter or without one: those with a
    diameter by tape, also added ones, those that people added, and those of the map that they rejected."""

    dbh_by_tape: int
    trees_added: int
    trees_removed: int


@dataclass(frozen=True, slots=True, eq=False)
class StandResult:
    """Stand parameters of a run.

    Attributes:
        run, frame: The run and the frame of its map.
        trees: Trees of the figures, see `counted_trees`.
        parameters: Parameters of the computation.
        plots: The plots; if there are none, the whole observed area.
        whole: Whether there are no plots, and the only one is the whole observed area.
        seen: Observed area within reach.
        figures: Dict from the name of each plot to its stand parameters.
        total: Dict from each stand parameter to its mean over the plots; with one observed plot, that of
            the plot.
        by_people: Dict from the name of each plot to the numbers of trees for which people's measurements
            and reviews count in it.
        left_out: Dict from the reason to the number of trees of the map, or added by people, that no plot
            counts for it: `rejected` (in the review), `outside_of_plots` (only with plots),
            `outside_of_observed_area` or `below_minimum_dbh`, whichever comes first. A tree without a
            diameter is not below the minimum.
        added_out_of_sight: Positions of the trees that people added and that do not count because they are
            outside of the observed area, shape (M, 2) [m] in the frame of the map.
        detection: Probability of detection over distance.
        warnings: Messages, those of plots with the name of the plot.
    """

    run: FinishedRun
    frame: MapFrame
    trees: PlotTrees
    parameters: Stand
    plots: Sequence[SamplePlot]
    whole: bool
    seen: SeenArea
    figures: dict[str, StandFigures]
    total: dict[str, Estimate]
    by_people: dict[str, PeopleCount]
    left_out: dict[str, int]
    added_out_of_sight: Float
    detection: DetectionFunction
    warnings: tuple[str, ...]


def stand_of(folder: FilePath, parameters: Stand, plots: Sequence[SamplePlot] = ()) -> StandResult:
    """Return the stand parameters of a finished run with what people stated about its trees, see
    `counted_trees`; rejected trees do not count. Nothing is written.
    Diameters that look like those of another unit, few trees, and overlapping plots are warnings.

    Args:
        folder: Folder of the run.
        parameters: Parameters of the computation.
        plots: Plots in the frame of the map; without any, the whole observed area is one plot.

    Raises:
        StemmapError: The folder is not that of a run, a file is damaged, the run has no seen.csv or observed
            nothing within reach, two plots have the same name, no plot touches the observed area, or the
            volume formula is not valid.
    """
    run, frame = read_run(folder), read_map_frame(folder)
    warnings = []
    recorded = read_seen_area(folder)
    if recorded is None:
        raise StemmapError(
            "the run has no record of what was observed (seen.csv)", where=str(folder), remedy="Map it again"
        )
    seen = within_reach(recorded, parameters)
    if not len(seen.place):
        is_still = run.record.get("distance_m") == 0.0
        raise StemmapError(
            f"no area was observed within reach{': the sensor did not move' if is_still else ''}",
            where=str(folder),
            remedy="Map more of it, or allow a greater reach (--reach) or fewer views (--views-min)",
        )
    names = [plot.name for plot in plots]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise StemmapError(f"two plots are called {twice!r}", remedy="Give each plot its own name")
    trees = counted_trees(run.trees, run.reviews, read_by_people(folder), parameters)
    chosen = list(plots) or [seen_plot(ALL, seen)]
    figures = figures_of(chosen, trees, seen, parameters)
    if not plots:
        hull = SamplePlot(ALL, chosen[0].shape.convex_hull)
        gaps = trees.where(hull.contains(trees.position) & (seen.rows(trees.position) < 0))
        figures[ALL] = compared_with_gaps(figures[ALL], gaps, hull.shape.area, parameters)
    observed = [f for f in figures.values() if f.seen > 0.0]
    if not observed:
        raise StemmapError(
            f"{'the plot is' if len(chosen) == 1 else 'all plots are'} outside of what the run observed",
            where=str(folder),
            remedy=f"Check the coordinates; the map is in {frame.title} coordinates, "
            f"{extent_words(frame.to_crs(seen.centres))}",
        )
    for name, f in figures.items():
        warnings += [f"plot {name}: {text}" if plots else text for text in f.warnings]
    areas = [plot.shape for plot in chosen]
    if shapely.union_all(areas).area < 0.999 * sum(shape.area for shape in areas):
        warnings.append("plots overlap: what they share counts in each of them")
    if len(chosen) > 1 and 0 < sum(f.trees for f in figures.values()) < FEW_TREES:
        warnings.append("fewer than ten trees in all plots: the figures are uncertain")
    if np.nanmax(trees.dbh, initial=0.0) > 3.0:
        warnings.append("a diameter is larger than 3 m: is the column dbh_cm of trees.csv in centimetres?")
    elif np.isfinite(trees.dbh).sum() >= 3 and np.nanmax(trees.dbh) < 0.02:
        warnings.append("all diameters are below 2 cm: is the column dbh_cm of trees.csv in metres?")
    total = combined(figures) if len(observed) > 1 else dict(observed[0].values)
    left_out = _left_out(trees, plots, seen, parameters.dbh_min)
    rejected = PlotTrees(run.rejected.position, run.rejected.dbh, run.rejected.dbh_sigma)
    return StandResult(
        run,
        frame,
        trees,
        parameters,
        chosen,
        not plots,
        seen,
        figures,
        total,
        {plot.name: _people_count(plot, trees, rejected, seen, parameters.dbh_min) for plot in chosen},
        {
            "rejected": len(run.rejected.number),
            **{reason: int(np.count_nonzero(applies)) for reason, applies in left_out.items()},
        },
        trees.position[left_out["outside_of_observed_area"] & ~trees.of_map],
        detection_function(trees, seen, parameters),
        tuple(warnings),
    )


def _left_out(
    trees: PlotTrees, plots: Sequence[SamplePlot], seen: SeenArea, dbh_min: float
) -> dict[str, Bool]:
    """Return a dict from each reason of `StandResult.left_out` except `rejected` to whether no plot counts
    each tree for it, the first reason only; without `outside_of_plots` if there are no plots."""
    reasons = {
        "outside_of_observed_area": seen.rows(trees.position) < 0,
        "below_minimum_dbh": trees.dbh < dbh_min,
    }
    if plots:
        inside = np.any([plot.contains(trees.position) for plot in plots], axis=0)
        reasons = {"outside_of_plots": ~inside, **reasons}
    counted = np.ones(len(trees.dbh), np.bool_)
    result = {}
    for reason, applies in reasons.items():
        result[reason] = counted & applies
        counted &= ~applies
    return result


def _people_count(
    plot: SamplePlot, trees: PlotTrees, rejected: PlotTrees, seen: SeenArea, dbh_min: float
) -> PeopleCount:
    """Return the numbers of a plot."""
    counted, removed = (
        each.where(plot.contains(each.position) & (seen.rows(each.position) >= 0) & ~(each.dbh < dbh_min))
        for each in (trees, rejected)
    )
    by_tape = 0 if counted.by_tape is None else int(np.count_nonzero(counted.by_tape))
    return PeopleCount(by_tape, int(np.count_nonzero(~counted.of_map)), len(removed.dbh))


def people_words(counted: PeopleCount) -> str:
    """Return what people changed in a plot, for example "3 diameters by tape, 1 tree added, 2 trees removed";
    "" if nothing."""
    words = ("diameter", "by tape"), ("tree", "added"), ("tree", "removed")
    return ", ".join(f"{count(n, what)} {how}" for n, (what, how) in zip(counted, words, strict=True) if n)


def counted_trees(trees: Trees, reviews: Mapping[int, str], people: ByPeople, parameters: Stand) -> PlotTrees:
    """Return the trees of stand figures: those of the map in their order, then those that people added. A
    diameter by tape takes the place of that of the map, see `counted_dbh`; an added tree has no other
    diameter and no height. They have volumes by the formula of the parameters, unless it is empty.

    Args:
        trees: Trees of the map without those that a person rejected.
        reviews: Dict from the number of each tree to the state of its review, see `FinishedRun`.
        people: What people measured; diameters by tape of other trees are ignored.
        parameters: Parameters of the computation.

    Raises:
        StemmapError: The formula is not valid.
    """
    tape = np.concatenate([people.tape_of(trees.number.tolist()), people.added_dbh])
    by_tape, unknown = np.isfinite(tape), np.full(len(people.added), np.nan)

    def with_added(column: Float | None) -> Float:
        """Return a column of the trees of the map with unknown values for the others."""
        return np.full(len(tape), np.nan) if column is None else np.concatenate([column, unknown])

    confirmed = [reviews.get(number) == CONFIRMED for number in trees.number.tolist()]
    diameter, sigma, _ = counted_dbh(tape, with_added(trees.dbh), with_added(trees.dbh_sigma))
    counted = PlotTrees(
        np.concatenate([trees.position, people.added]),
        diameter,
        sigma,
        height=with_added(trees.height),
        height_sigma=with_added(trees.height_sigma),
        by_tape=by_tape,
        added=np.arange(len(tape)) >= len(trees.number),
        confirmed=np.array([*confirmed, *[False] * len(people.added)], np.bool_),
    )
    if not parameters.volume:
        return counted
    formula, dbh, height = VolumeFormula.parse(parameters.volume), counted.dbh, with_added(trees.height)
    volume, sigma = formula.with_sigma(dbh, counted.dbh_sigma, height, with_added(trees.height_sigma))
    _, shared = formula.with_sigma(dbh, counted.shared(parameters.dbh_shared_sigma), height, with_added(None))
    return replace(counted, volume=volume, volume_sigma=sigma, volume_shared=shared)


def extent_words(points: np.ndarray) -> str:
    """Return the bounding box of points, shape (N, 2) [m], as text; N is at least 1."""
    low, high = points.min(axis=0), points.max(axis=0)
    return f"x {low[0]:.0f} to {high[0]:.0f} m, y {low[1]:.0f} to {high[1]:.0f} m"


PLOT_COLUMNS = (
    "plot",
    "area_m2",
    "seen_m2",
    "trees",
    "trees_without_dbh",
    "trees_with_height",
    "trees_with_volume",
    *PeopleCount._fields,
    "detection",
    "detection_se",
)
CLASS_COLUMNS = ("plot", "from_cm", "to_cm", "trees", "n_ha", "n_ha_se", "g_ha", "g_ha_se")


def stand_files(result: StandResult) -> dict[str, str]:
    """Return a dict from the names of three files to their texts. stand.csv has the columns PLOT_COLUMNS,
    then each stand parameter of FIGURES and its standard error with "_se", one row per plot, and for several
    plots a row `mean` with only stand parameters. classes.csv has the columns CLASS_COLUMNS, one row per plot
    and class, then one without limits for its trees without a diameter, if there are any. stand.json is
    `stand_record`. Unknown values are empty cells or null."""
    header = (*PLOT_COLUMNS, *(f"{name}{end}" for name in FIGURES for end in ("", "_se")))
    rows = []
    for name, f in result.figures.items():
        about = [name, f"{f.area:.2f}", f"{f.seen:.2f}"]
        about += [str(number) for number in (f.trees, f.without_dbh, f.with_height)]
        about.append("" if f.with_volume is None else str(f.with_volume))
        about += [str(number) for number in result.by_people[name]]
        rows.append([*about, *_numbers(f.detection), *_cells(dict(f.values))])
    if len(result.figures) > 1:
        rows.append(["mean", *[""] * (len(PLOT_COLUMNS) - 1), *_cells(result.total)])
    classes = []
    for name, f in result.figures.items():
        classes += [
            [name, f"{c.low:g}", f"{c.high:g}", str(c.trees), *_numbers((*c.n_ha, *c.g_ha))]
            for c in f.classes
        ]
        if f.without_dbh:
            per_ha = Estimate(HECTARE * f.without_dbh / f.seen)
            classes.append([name, "", "", str(f.without_dbh), *_numbers((*per_ha, *Estimate()))])
    return {
        "stand.csv": csv_text(header, rows),
        "classes.csv": csv_text(CLASS_COLUMNS, classes),
        "stand.json": json.dumps(stand_record(result), indent=1, allow_nan=False) + "\n",
    }


def stand_record(result: StandResult) -> dict[str, Any]:
    """Return the content of stand.json, a dict of JSON values.

    Each parameter of the stand is a list [value, standard error], in which an unknown number is None. The
    keys are:

    - `stemmap`: version; `source`: URI of the run; `crs`: name of the frame; `warnings`: list of strings;
    - `parameters`: dict of the parameters of `Stand`;
    - `trees_in_map`: number of trees, with rejected ones; `trees_added`: number of trees that people added;
    `trees_left_out`: dict from a reason to the number of trees of either that no plot counts;
    `added_out_of_sight`: list of [x, y] in the frame of the map [m] of the added ones that do not count
    because they are outside of the observed area;
    - `detection_sigma_m`: None if detection does not decrease with distance or is not estimated;
    - `detection_not_estimated`: the reason, see `DetectionFunction`, "" if it is estimated;
    - `units`: dict from each stand parameter to its unit;
    - `plots`: dict from the name of each plot to a dict with `area_m2`, `seen_m2`, `trees`,
    `trees_without_dbh`, `trees_with_height`, `trees_with_volume` (None if unknown), `dbh_by_tape`,
    `trees_added` and `trees_removed` (see PeopleCount), `detection` (a stand parameter), the other stand
    parameters by name, and `classes`, a list of dicts with `from_cm`, `to_cm`, `trees`, `n_ha` and `g_ha`;
    - `mean`: dict from each stand parameter to its mean over all plots.
    """
    return {
        "stemmap": version(),
        "source": result.run.uri,
        "crs": result.frame.name,
        "parameters": result.parameters.model_dump(),
        "trees_in_map": len(result.run.trees.number) + len(result.run.rejected.number),
        "trees_added": int(np.count_nonzero(~result.trees.of_map)),
        "trees_left_out": result.left_out,
        "added_out_of_sight": result.added_out_of_sight.round(3).tolist(),
        "detection_sigma_m": _finite(result.detection.sigma),
        "detection_not_estimated": result.detection.reason,
        "units": {name: unit for name, (_, unit) in FIGURES.items()},
        "plots": {
            name: {
                "area_m2": round(f.area, 3),
                "seen_m2": round(f.seen, 3),
                "trees": f.trees,
                "trees_without_dbh": f.without_dbh,
                "trees_with_height": f.with_height,
                "trees_with_volume": f.with_volume,
                **result.by_people[name]._asdict(),
                "detection": _pair(f.detection),
                **{key: _pair(value) for key, value in f.values.items()},
                "classes": [
                    {
                        "from_cm": c.low,
                        "to_cm": c.high,
                        "trees": c.trees,
                        "n_ha": _pair(c.n_ha),
                        "g_ha": _pair(c.g_ha),
                    }
                    for c in f.classes
                ],
            }
            for name, f in result.figures.items()
        },
        "mean": {key: _pair(value) for key, value in result.total.items()},
        "warnings": list(result.warnings),
    }


def _pair(estimate: Estimate) -> list[float | None]:
    """Return [value, standard error] of an estimate, rounded to six decimals; None in place of a number that
    is not finite."""
    return [_finite(value) for value in estimate]


def _finite(value: float) -> float | None:
    """Return a number rounded to six decimals; None if it is not finite."""
    return round(float(value), 6) if math.isfinite(value) else None


def _cells(values: dict[str, Estimate]) -> list[str]:
    """Return value and standard error of each stand parameter as cells, in the order of FIGURES, see
    `_numbers`."""
    return _numbers([value for name in FIGURES for value in values[name]])


def _numbers(values: Sequence[float]) -> list[str]:
    """Return each number as text with four decimals; "" if it is not finite."""
    return [number_text(value, 4) for value in values]


def stand_summary(result: StandResult) -> list[str]:
    """Return the stand parameters over all observed plots as lines for people: their trees and area, trees
    that are not counted, with the places of added ones, and what people changed if there are any, the stand
    parameters that have a value, detection, and the meaning of the standard errors. Warnings are not
    included."""
    observed = [f for f in result.figures.values() if f.seen > 0.0]
    seen, area = sum(f.seen for f in observed), sum(f.area for f in observed)
    trees = sum(f.trees for f in observed)
    of = "whole observed area" if result.whole else count(len(observed), "plot")
    least = f"{100.0 * result.parameters.dbh_min:g} cm"
    part = f" of {area:,.0f} m2" if area - seen > 0.5 else ""
    left_out = ", ".join(f"{n} {reason.replace('_', ' ')}" for reason, n in result.left_out.items() if n)
    lines = [
        f"{of}: {count(trees, 'tree')} from {least} on {seen:,.0f} m2 observed{part}, "
        f"coordinates {result.frame.title}"
    ]
    if left_out:
        lines.append(f"trees that are not counted: {left_out}")
    if len(result.added_out_of_sight):
        places = result.frame.to_crs(result.added_out_of_sight).tolist()
        named = [f"{x:.2f}, {y:.2f}" for x, y in places[:_MOST_NAMED]]
        if more := len(places) - len(named):
            named.append(f"and {more} more")
        lines.append(f"added by people outside of the observed area, not counted: {'; '.join(named)}")
    for name, counted in result.by_people.items():
        if words := people_words(counted):
            lines.append(f"by people{'' if result.whole else f', plot {name}'}: {words}")
    for name, (title, unit) in FIGURES.items():
        value, se = result.total[name]
        if math.isfinite(value):
            error = f" +- {_digits(se)}" if math.isfinite(se) else ""
            unknown = "" if error or name.endswith("_plain") else ", standard error not known"
            lines.append(f"{title}: {_digits(value)}{error} {unit}".rstrip() + unknown)
    detection = result.detection
    if math.isfinite(detection.sigma):
        lines.append(f"detection: half-normal over distance, sigma {detection.sigma:.1f} m")
        lines.append(
            "which to use: the figures without correction; corrected ones only where trees far from the path "
            "were missed, because they are too large where the stand is thinner there"
        )
    else:
        lines.append(f"detection: {_NO_DECREASE[detection.reason]}")
    corrected = "; corrected figures also detection" if math.isfinite(detection.sigma) else ""
    errors = "between plots" if len(observed) > 1 else f"of this area: diameters, occlusion{corrected}"
    false = f"{100.0 * result.parameters.count_error:g} % of the stems for false and missed trees"
    lines.append(f"+- standard error {errors}; {false}, less for trees that people confirmed")
    return lines


_NO_DECREASE = {
    "": "does not decrease with distance within reach",
    "correction": "not estimated, every tree in view counts as found",
    "whole_cloud": "not estimated for a whole cloud, every tree counts as found",
    "few_trees": f"not estimated from fewer than {LEAST_TREES} trees, every tree in view counts as found",
}


def _digits(value: float) -> str:
    """Return a number as text with two decimals if its absolute value is below 10, with one if it is below
    100, else with none and a comma between thousands."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.2f}" if abs(value) < 10 else f"{value:.1f}"
