"""Questions about a run and its files that a child process with limits answers, see `opening.ask`."""

from __future__ import annotations

from dataclasses import asdict
from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.errors import StemmapError

if TYPE_CHECKING:
    from app.extensions.stand.plots import SamplePlot

PLOTS_OF_FILE, POINTS_OF_TABLE, GEOREFERENCE, REPORT, VISITS, EXPORT, LAYER, DETOUR = (
    f"{__name__}:{name}"
    for name in ("plots", "points", "georeference", "report", "visits", "export", "layer", "detour")
)


def plots(question: dict[str, Any]) -> dict[str, Any]:
    """Return {"plots": [...]}, a list of a dict for each plot of a GIS file, with `name` and `polygons`.
    `polygons` are the coordinates of a GeoJSON MultiPolygon in the frame of the map of a run [m], rounded to
    1 mm, without the last corner of each ring, which repeats the first.

    Args:
        question: The key "path" has the file, "run" the folder of the run, and "crs" the reference system of
            a file without one, "local" or "".

    Raises:
        StemmapError: See `app.extensions.stand.plot_files.read_plots`.
    """
    import shapely

    from app.extensions.stand.plot_files import read_plots

    found = read_plots(Path(question["path"]), Path(question["run"]), crs=question["crs"] or None)
    rows = []
    for plot in found:
        parts = getattr(plot.shape, "geoms", [plot.shape])
        rings = [[part.exterior, *part.interiors] for part in parts]
        corners = [[shapely.get_coordinates(ring)[:-1].round(3).tolist() for ring in part] for part in rings]
        rows.append({"name": plot.name, "polygons": corners})
    return {"plots": rows}


def points(question: dict[str, Any]) -> dict[str, Any]:
    """Return the control points of a table: `points`, a list of the fields of each `ControlPoint`, with None
    for numbers that could not be read, and `faults`, a list of [index of the row, text].

    Args:
        question: The key "path" has the CSV file, and "crs" the reference system.

    Raises:
        StemmapError: The reference system is not valid, or see `read_point_rows`.
    """
    from math import isfinite

    from app.extensions.stand import georeference as geo

    found, faults = geo.read_point_rows(Path(question["path"]), geo.projected(question["crs"]))
    rows = [asdict(point) for point in found]
    for row in rows:
        row.update({name: row[name] if isfinite(row[name]) else None for name in ("east", "north")})
    texts = [[k, f"{fault.what}. {fault.remedy}".rstrip(". ")] for k, fault in sorted(faults.items())]
    return {"points": rows, "faults": texts}


def georeference(question: dict[str, Any]) -> dict[str, Any]:
    """Return the reference system of a map as a dict: `frame`, see `app.batch.map_frame.MapFrame.record`,
    and `points`, a list of the fields of each `ControlPoint` ([] for methods without control points). Nothing
    is written.

    Args:
        question: The key "path" has the folder of the run, "crs" the reference system, and "how" is
            "control", with the control points as `points`, and `point_sigma` [m]; "gnss", with the time of
            the first scan as `start_ns`; or "hand", with the position of the origin as `east`, `north` and
            `z` [m] and `turn_deg`.

    Raises:
        StemmapError: See `app.extensions.stand.georeference`.
    """
    from app.extensions.stand import georeference as geo

    folder, crs, how = Path(question["path"]), geo.projected(question["crs"]), question["how"]
    points: list[geo.ControlPoint] = []
    if how == "control":
        points = [geo.ControlPoint(**point) for point in question["points"]]
        frame = geo.by_control_points(folder, points, crs, question["point_sigma"])
    elif how == "gnss":
        frame = geo.by_gnss(folder, crs, question["start_ns"])
    else:
        east, north, z = (question[name] for name in ("east", "north", "z"))
        frame = geo.by_hand(folder, crs, east, north, radians(question["turn_deg"]), z)
    return {"frame": frame.record(), "points": [asdict(point) for point in points]}


def report(question: dict[str, Any]) -> dict[str, Any]:
    """Write the report of a run to a file; return {}.

    Args:
        question: The key "path" has the folder of the run, "file" the .html or .pdf file, "language" the
            language of the report, "heading" the fields of `Heading`, and "plots" and "parameters" as in
            `export`.

    Raises:
        StemmapError, OSError: See `app.extensions.stand.report`.
    """
    from app.extensions.stand.heading import Heading
    from app.extensions.stand.parameters import Stand
    from app.extensions.stand.report import report_page, write_report

    page = report_page(
        Path(question["path"]),
        language=question["language"],
        plots=_plots_of(question),
        parameters=Stand.model_validate(question["parameters"]),
        heading=Heading(**question["heading"]),
    )
    write_report(page, Path(question["file"]))
    return {}


def export(question: dict[str, Any]) -> dict[str, Any]:
    """Export a run with its plots to a file for GIS, CAD or spreadsheets; return {"file": its path}.

    Args:
        question: The key "path" has the folder of the run, "suffix" the suffix of a format of
            `app.extensions.stand.gis_files.WRITERS`, "folder" the empty folder of the file, "plots" a list of
            [name, GeoJSON geometry] in the coordinates of the files of the run, and "parameters" the values
            of `Stand`.

    Raises:
        StemmapError, OSError: The file cannot be written, or all plots are outside of what was observed.
    """
    from app.batch.export import export_one_file
    from app.extensions.stand.gis_files import WRITERS, read_with_plots
    from app.extensions.stand.parameters import Stand
    from app.extensions.stand.run_figures import stand_of

    folder, plots = Path(question["path"]), _plots_of(question)
    parameters = Stand.model_validate(question["parameters"])
    run = read_with_plots(folder, stand_of(folder, parameters, plots) if plots else None)
    return {"file": str(export_one_file(run, question["suffix"], WRITERS, Path(question["folder"])))}


def layer(question: dict[str, Any]) -> dict[str, Any]:
    """Write the plots of a run as GeoJSON, see `shapes_geojson`; return {"file": its path}.

    Args:
        question: The key "path" has the folder of the run, "folder" the empty folder of the file, and "plots"
            is as in `export`.

    Raises:
        StemmapError, OSError: The run cannot be read, or the file cannot be written.
    """
    import shapely

    from app.batch.export import shapes_geojson
    from app.batch.map_frame import read_map_frame

    frame = read_map_frame(Path(question["path"]))
    placed = [(plot.name, shapely.transform(plot.shape, frame.to_crs)) for plot in _plots_of(question)]
    file = Path(question["folder"]) / "plots.geojson"
    file.write_text(shapes_geojson(placed, frame), encoding="utf-8")
    return {"file": str(file)}


def detour(question: dict[str, Any]) -> dict[str, Any]:
    """Return the way that shows trees without a diameter from further sides, see `shortest_detour`:
    `points`, a list of x, y [m], `trees`, the numbers of the trees that it completes, and `length_m`; {} if
    there is none.

    Args:
        question: The key "path" has the folder of the run, and "sides" the sectors from which each tree
            without a diameter was seen, see `Trees.sides`, by its number as text.

    Raises:
        StemmapError: The run cannot be read.
    """
    import numpy as np

    from app.batch.run_folder import read_run, read_seen_area
    from app.extensions.stand.detour import shortest_detour

    run, seen = read_run(Path(question["path"])), read_seen_area(Path(question["path"]))
    if seen is None or not run.of_drive:
        return {}
    sides = [question["sides"].get(str(number)) for number in run.trees.number.tolist()]
    found = shortest_detour(
        np.array([run.path.x[-1], run.path.y[-1]]),
        run.trees.position,
        0.5 * run.trees.dbh,
        sides,
        radians(run.parameters.tracking.dbh_arc_min),
        seen,
        run.parameters.obstacles.width,
    )
    if found is None:
        return {}
    numbers = run.trees.number[found.trees].tolist()
    return {"points": found.points.round(2).tolist(), "trees": numbers, "length_m": round(found.length, 1)}


def _plots_of(question: dict[str, Any]) -> list[SamplePlot]:
    """Return the plots of a question of `report` or `export`."""
    import shapely

    from app.extensions.stand.plots import SamplePlot

    return [SamplePlot(name, shapely.geometry.shape(shape)) for name, shape in question["plots"]]


def visits(question: dict[str, Any]) -> dict[str, Any]:
    """Return the comparison of two visits of a stand, aligned by their stems if possible, else compared as if
    their frames were equal.

    Args:
        question: `paths` are two folders of runs or tables of trees, the earlier one first, `names` their
            names for errors; `same_frame` states whether their frames are equal.

    Returns:
        A dict with `how`, how the visits were aligned, or why they were not; `aligned`, whether they are
        aligned or share their frame; `pose`, [x [m], y [m], yaw [rad]] of the later visit in the frame of the
        earlier one; `rows`, see `rows_of`; `csv`, the rows as CSV text; `places_b`, a dict from the number
        (as text) of each tree of the later visit to its position [x, y] [m] in the frame of the earlier one;
        and `record`, see `comparison_record`.

    Raises:
        StemmapError: The files of a visit cannot be read; the error names the visit by its name.
    """
    from app.extensions.stand.comparison import (
        compare,
        comparison_csv,
        comparison_record,
        read_visit,
        rows_of,
    )

    read = []
    for path, name in zip(question["paths"], question["names"], strict=True):
        try:
            read.append(read_visit(Path(path), may_be_empty=True))
        except StemmapError as error:
            raise StemmapError(error.what, where=name, remedy=error.remedy) from None
    a, b = read
    how, aligned = "same recording", True
    try:
        found = compare(a, b, same_frame=question["same_frame"])
        if not question["same_frame"]:
            how = f"aligned by {found.stems} stems"
    except StemmapError as error:
        found, how, aligned = compare(a, b, same_frame=True), f"not aligned: {error.what}", False
    rows, places = rows_of(a, b, found), found.T_a_b.apply(b.trees.position)
    return {
        "how": how,
        "aligned": aligned,
        "pose": [found.T_a_b.x, found.T_a_b.y, found.T_a_b.yaw],
        "rows": rows,
        "csv": comparison_csv(rows),
        "places_b": {
            str(number): place
            for number, place in zip(b.trees.number.tolist(), places.round(3).tolist(), strict=True)
        },
        "record": comparison_record(a, b, found),
    }
