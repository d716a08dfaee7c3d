"""Maps a whole cloud of a plot and writes the same files as for a run.

Positions are in the coordinates of the cloud; other lengths are in metres. `path.csv` has no rows, because
there is no drive, and there is no `state.zip`. `slices.csv` contains the cross-sections of all trees,
`terrain.csv` the visible ground, `seen.csv` the area that the cloud covers.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from app.batch.map_frame import WGS84, reproject
from app.batch.map_run import MappingResult
from app.batch.run_folder import NO_PATH, as_written, score_map, truth_in_metres
from app.batch.summary import evaluation_lines
from app.common.text import changed_values, count, preset_words, version
from app.extensions.clouds.inventory import PlotMap, map_plot
from app.extensions.clouds.inventory.cross_sections import slice_heights
from app.extensions.clouds.plot_ground import FAR_FROM_PLOT
from app.extensions.clouds.records import CloudDescription, WholeCloud
from app.extensions.clouds.terrain_raster import TerrainRaster
from app.store.forests import kept_forests
from pipeline.config import Parameters
from pipeline.evaluation import MapScores
from pipeline.geometry.poses import Float
from pipeline.io.result_files import (
    ROBOTS_FRAME,
    TERRAIN_COLUMNS,
    RunFiles,
    csv_text,
    geojson,
    number_text,
    seen_text,
)
from pipeline.seen_area import covered_area
from pipeline.types.records import Trees, TruthTrees, Verdict

SLICE_COLUMNS = (
    "tree",
    "height_m",
    "x_m",
    "y_m",
    "radius_m",
    "sigma_radius_m",
    "radial_std_m",
    "coverage_deg",
    "points",
)


def map_plot_run(
    cloud: WholeCloud,
    preset: str,
    parameters: Parameters,
    truth: TruthTrees | None,
    folder: FilePath,
    chosen: dict[str, Any] | None = None,
) -> MappingResult:
    """Map a whole cloud and write its files.

    Args:
        cloud: The cloud.
        preset: Name of the preset.
        parameters: All parameters.
        truth: True trees in the coordinates of the cloud, or None.
        folder: Folder for the files; those of an earlier run are replaced.
        chosen: Choices of the user, see `SourceRequest.kept_choices`.

    Returns:
        The result for people; it has no times.

    Raises:
        StemmapError: The cloud cannot be read, or the forest that is named does not exist.
        OSError: The folder cannot be written; it is unchanged then.
    """
    with RunFiles(folder, unit=cloud.description.crs_unit) as files:
        return _map(cloud, preset, parameters, truth, files, chosen)


def _map(
    cloud: WholeCloud,
    preset: str,
    parameters: Parameters,
    truth: TruthTrees | None,
    files: RunFiles,
    chosen: dict[str, Any] | None,
) -> MappingResult:
    """Map the cloud and finish its files; arguments and errors as in `map_plot_run`."""
    about = cloud.description
    plot = map_plot(cloud, parameters, kept_forests())
    trees = replace(plot.trees, position=plot.trees.position + about.offset[:2])
    evaluation = None
    if truth is not None:
        truth = truth_in_metres(truth, about.crs_unit, about.offset)
        evaluation = score_map(*as_written(trees, NO_PATH, 0), truth, parameters)
    losses = {reason: n for reason, n in cloud.losses.items() if n}
    if plot.counts["apart from the plot"]:
        losses[FAR_FROM_PLOT] = plot.counts["apart from the plot"]
    warnings = list(plot.warnings)
    lon_lat = _lon_lat(trees.position, about.crs, warnings)
    frame = {"type": "the cloud's own", "unit": "m", "crs": about.crs} if about.crs else _OWN_FRAME
    files.add_rows(_detection_rows(plot, about.offset))
    run = _run_record(cloud, plot, preset, parameters, evaluation, warnings, losses, chosen)
    files.finish(
        trees,
        NO_PATH,
        0,
        run,
        None,
        further={
            "trees.geojson": geojson(trees, 0, frame=frame, lon_lat=lon_lat),
            "slices.csv": csv_text(SLICE_COLUMNS, _slice_rows(plot, about.offset)),
            "terrain.csv": csv_text(TERRAIN_COLUMNS, _terrain_rows(plot.ground, about.offset)),
            "seen.csv": seen_text(covered_area(plot.ground.covered_places() + about.offset[:2])),
        },
    )
    summary = [*_summary(about, plot, trees, evaluation), preset_words(preset, parameters)]
    return MappingResult(summary, warnings, losses)


_OWN_FRAME = {**ROBOTS_FRAME, "origin": "that of the cloud"}


def _lon_lat(position: Float, crs: str, warnings: list[str]) -> Float | None:
    """Return longitude and latitude (WGS84) [deg], shape (N, 2), of positions. None if there is no reference
    system, and, with a warning, if it is unknown or a position is outside of its area.

    Args:
        position: x, y [m] in the reference system, shape (N, 2).
        crs: The reference system as text for pyproj; "" for none.
        warnings: The warning is appended to it.
    """
    if not crs:
        return None
    import pyproj

    try:
        lon_lat = reproject(position, crs, WGS84)
    except pyproj.exceptions.ProjError:
        lon_lat = np.full((1, 2), np.inf)
    if not np.isfinite(lon_lat).all():
        warnings.append("unknown coordinate reference system of the cloud: no WGS84 coordinates")
        return None
    return lon_lat


def _detection_rows(plot: PlotMap, offset: Float) -> Iterator[list[str]]:
    """Yield the cells of DETECTION_COLUMNS for each candidate, in the coordinates of the cloud: scan 0,
    without time and eccentricity. The width is the diameter of the circle, the height the extent of the stem.

    Args:
        plot: The map in local coordinates.
        offset: Origin of the local coordinates in those of the cloud, x, y, z [m].
    """
    for stem, place, verdict in zip(plot.stems, plot.place, plot.verdict, strict=True):
        x, y = place + offset[:2]
        radius = np.maximum(stem["radius"], 0.0)  # a line through circles of another height may end before
        yield [
            "0",
            "",
            number_text(x, 3),
            number_text(y, 3),
            Verdict(int(verdict)).label,
            "",
            number_text(radius, 3),
            number_text(stem["scatter"], 4),
            number_text(math.degrees(stem["coverage"]), 0),
            number_text(stem["points"], 0),
            number_text(2.0 * radius, 3),
            number_text(stem["last"] - stem["first"], 3),
        ]


def _slice_rows(plot: PlotMap, offset: Float) -> Iterator[list[str]]:
    """Yield the cells of SLICE_COLUMNS for each cross-section of a tree that has a known radius; heights are
    above the ground at the tree. Arguments as in `_detection_rows`."""
    for number, circles in zip(plot.trees.number, plot.circles[plot.tree_candidate], strict=True):
        for height, s in zip(slice_heights(), circles, strict=True):
            if np.isfinite(s[2]):
                yield [
                    str(number),
                    number_text(height, 2),
                    number_text(s[0] + offset[0], 3),
                    number_text(s[1] + offset[1], 3),
                    number_text(s[2], 4),
                    number_text(math.sqrt(s[6]), 4),
                    number_text(s[7], 4),
                    number_text(math.degrees(s[8]), 0),
                    str(int(s[9])),
                ]


def _terrain_rows(ground: TerrainRaster, offset: Float) -> Iterator[list[str]]:
    """Yield the cells of TERRAIN_COLUMNS for each terrain cell with ground returns, from west to east,
    without interpolated ones: centre and height in the coordinates of the cloud; uncertainty and number of
    views are empty. `offset` as in `_detection_rows`."""
    columns, rows = np.nonzero(ground.seen)
    place = ground.low + (np.stack([columns, rows], axis=1) + 0.5) * ground.cell + offset[:2]
    height = ground.height[columns, rows] + offset[2]
    for (x, y), z in zip(place, height, strict=True):
        yield [number_text(x, 3), number_text(y, 3), number_text(z, 3), "", ""]


def _run_record(
    cloud: WholeCloud,
    plot: PlotMap,
    preset: str,
    parameters: Parameters,
    evaluation: MapScores | None,
    warnings: list[str],
    losses: dict[str, int],
    chosen: dict[str, Any] | None,
) -> dict[str, Any]:
    """Return the content of run.json as a dict.

    The keys are `stemmap` (version); `source`, a dict with `uri`, `kind`, `sha256`, `offset_m` ([x, y, z]),
    `crs` (in metres; None if unknown), `unit` and `up` (text) and, of a cloud in feet, `crs_unit_m`; `chosen`
    where the user chose; `seed` and `scans`, both 0; `preset`, `changed` and `parameters`; `trees`
    (number); `points`, a dict from the stage to the number of points; `verdicts`, a dict from the label to
    the number of candidates; `voxel_size_m`; `ground_m`, [minimum, maximum] of the height of the terrain in
    the coordinates of the cloud; `evaluation` (a dict, None if there is no ground truth); `warnings` and
    `losses`.

    Args:
        cloud, plot: The cloud and its map.
        preset, parameters: With which it was mapped.
        evaluation: Scores; None if there is no ground truth.
        warnings: Messages for people.
        losses: Dict from a reason to the number of points that were left out for it.
        chosen: Choices of the user; None without any.
    """
    about, heights = cloud.description, plot.ground.height
    verdicts = Counter(Verdict(int(v)).label for v in plot.verdict)
    return {
        "stemmap": version(),
        "source": {
            "uri": about.uri,
            "kind": about.kind,
            "sha256": about.digest,
            "offset_m": about.offset.tolist(),
            "crs": about.crs or None,
            "unit": about.unit,
            "up": about.up,
            **({} if about.crs_unit == (1.0, 1.0) else {"crs_unit_m": list(about.crs_unit)}),
        },
        **({} if chosen is None else {"chosen": chosen}),
        "seed": 0,
        "preset": preset,
        "changed": changed_values(preset, parameters),
        "parameters": parameters.model_dump(),
        "scans": 0,
        "trees": len(plot.trees.number),
        "points": plot.counts,
        "voxel_size_m": round(plot.voxel_size, 6),
        "ground_m": [round(float(v) + about.offset[2], 3) for v in (heights.min(), heights.max())],
        "verdicts": dict(sorted(verdicts.items())),
        "evaluation": None if evaluation is None else asdict(evaluation),
        "warnings": warnings,
        "losses": losses,
    }


def _summary(about: CloudDescription, plot: PlotMap, trees: Trees, evaluation: MapScores | None) -> list[str]:
    """Return the result as lines for people.

    Args:
        about: Description of the cloud.
        plot: The map.
        trees: Trees of the map.
        evaluation: Scores; None if there is no ground truth.
    """
    dbh = 100.0 * trees.dbh[np.isfinite(trees.dbh)]
    wide = f", DBH {dbh.min():.1f} to {dbh.max():.1f} cm ({len(dbh)} measured)" if len(dbh) else ", no DBH"
    verdicts = Counter(Verdict(int(v)).label for v in plot.verdict if v != Verdict.TREE)
    refused = ", ".join(f"{n} {label}" for label, n in sorted(verdicts.items()))
    lines = [
        f"{about.uri}: {count(plot.counts['read'], 'point')}, {count(len(trees.number), 'tree')}{wide}",
        f"refused: {refused or 'nothing'}",
        f"unit: {about.unit}; up: {about.up}",
    ]
    return lines + (evaluation_lines(evaluation, whole=True) if evaluation is not None else [])
