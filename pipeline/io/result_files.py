"""Result files of a mapped run. Unknown values are empty, never 0."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import math
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.io.atomic_files import UNFINISHED, hold
from pipeline.stand.seen_area import SeenArea
from pipeline.types.records import Frame, HeightMap, Path, Trees, Verdict

ROWS = "detections.csv"  # written during the run
TREE_COLUMNS = (
    "tree",
    "x_m",
    "y_m",
    "sigma_x_m",
    "sigma_y_m",
    "dbh_cm",
    "sigma_dbh_cm",
    "eccentricity",
    "observations",
    "coverage_deg",
    "first_seen_s",
    "last_seen_s",
    "height_m",
    "sigma_height_m",
    "lean_deg",
)
#: Columns that earlier versions did not write.
NEW_TREE_COLUMNS = TREE_COLUMNS[-3:]
PATH_COLUMNS = ("t_s", "x_m", "y_m", "yaw_rad", "sigma_xy_m")
TERRAIN_COLUMNS = ("x_m", "y_m", "z_m", "sigma_m", "views")
SEEN_COLUMNS = ("x_m", "y_m", "nearest_m", "views")
DETECTION_COLUMNS = (
    "scan",
    "t_s",
    "x_m",
    "y_m",
    "verdict",
    "eccentricity",
    "radius_m",
    "radial_std_m",
    "arc_deg",
    "points",
    "width_m",
    "height_m",
)


def tree_rows(trees: Trees, start_ns: int) -> list[list[str]]:
    """Return the confirmed trees as rows of TREE_COLUMNS; unknown values are empty. Seconds count from
    `start_ns` [ns]; a stamp below 0 is unknown."""
    unknown = np.full(len(trees.number), math.nan)
    height, height_sigma, lean = (
        unknown if column is None else column for column in (trees.height, trees.height_sigma, trees.lean)
    )
    return [
        [
            str(trees.number[k]),
            _number(trees.position[k, 0], 3),
            _number(trees.position[k, 1], 3),
            _number(math.sqrt(trees.covariance[k, 0, 0]), 3),
            _number(math.sqrt(trees.covariance[k, 1, 1]), 3),
            _number(100.0 * trees.dbh[k], 1),
            _number(100.0 * trees.dbh_sigma[k], 1),
            _number(trees.eccentricity[k], 3),
            str(trees.observations[k]),
            _number(math.degrees(trees.coverage[k]), 0) if trees.coverage[k] > 0 else "",
            _number(_seconds(trees.first_seen_ns[k], start_ns), 3),
            _number(_seconds(trees.last_seen_ns[k], start_ns), 3),
            _number(height[k], 2),
            _number(height_sigma[k], 2),
            _number(math.degrees(lean[k]), 1),
        ]
        for k in np.flatnonzero(trees.confirmed)
    ]


def path_rows(path: Path, start_ns: int) -> list[list[str]]:
    """Return the path as rows of PATH_COLUMNS, one per scan; seconds count from `start_ns`."""
    return [
        [
            _number(_seconds(stamp, start_ns), 3),
            _number(x, 4),
            _number(y, 4),
            _number(yaw, 5),
            _number(sigma, 4),
        ]
        for stamp, x, y, yaw, sigma in zip(
            path.stamp_ns, path.x, path.y, path.yaw, path.sigma_xy, strict=True
        )
    ]


def terrain_text(ground: HeightMap) -> str:
    """Return the text of terrain.csv: a header and the rows of `terrain_rows`."""
    return csv_text(TERRAIN_COLUMNS, terrain_rows(ground))


def terrain_rows(ground: HeightMap) -> Iterator[list[str]]:
    """Yield the known cells of the height map as rows of TERRAIN_COLUMNS, from west to east; x and y are
    their centres."""
    order = np.lexsort((ground.place[:, 1], ground.place[:, 0]))
    middle = (ground.place[order] + 0.5) * ground.cell
    columns = (middle, ground.height[order], ground.sigma[order], ground.views[order])
    for (x, y), z, sigma, views in zip(*columns, strict=True):
        yield [_number(x, 3), _number(y, 3), _number(z, 3), _number(sigma, 3), str(views)]


def seen_text(area: SeenArea) -> str:
    """Return the text of seen.csv: the observed cells from west to east; x and y are their centres. The
    distance of the nearest free view and the number of views are empty where unknown."""
    return csv_text(
        SEEN_COLUMNS,
        (
            [_number(x, 3), _number(y, 3), _number(nearest, 2), str(views) if views else ""]
            for (x, y), nearest, views in zip(area.centres, area.nearest, area.views, strict=True)
        ),
    )


def detection_rows(frame: Frame, start_ns: int) -> list[list[str]]:
    """Return all clusters of a scan with their verdicts, in the frame of the map, as rows of
    DETECTION_COLUMNS; unknown values are empty.

    Args:
        frame: Results of the scan.
        start_ns: Time from which the seconds count [ns].
    """
    c = frame.clusters
    centre = frame.estimate.T_map_base.apply(c.centre + frame.sensor_offset[:2])
    fitted = np.isfinite(c.radius)
    return [
        [
            str(frame.index),
            _number(_seconds(frame.stamp_ns, start_ns), 3),
            _number(centre[k, 0], 3),
            _number(centre[k, 1], 3),
            Verdict(int(c.verdict[k])).label,
            _number(c.eccentricity[k], 3),
            _number(c.radius[k], 3),
            _number(c.radial_std[k], 4),
            _number(math.degrees(c.arc[k]), 0) if fitted[k] else "",
            str(c.size[k]),
            _number(c.extent[k, 1], 3),
            _number(c.extent[k, 2], 3),
        ]
        for k in range(len(c.size))
    ]


ROBOTS_FRAME = {"type": "local", "unit": "m", "origin": "first pose of the robot, x along its heading"}


def geojson(
    trees: Trees,
    start_ns: int,
    *,
    frame: Mapping[str, str] | None = None,
    lon_lat: Float | None = None,
) -> str:
    """Return the text of a GeoJSON FeatureCollection with the confirmed trees; unknown values are null.
    Positions must be finite.

    RFC 7946 requires WGS84; a map without georeference has a member `coordinateFrame`.

    Args:
        trees: The map.
        start_ns: Origin of the seconds.
        frame: Description of the coordinates of `trees`; None means ROBOTS_FRAME.
        lon_lat: Longitude and latitude of each confirmed tree, shape (T, 2) [degrees], if known. They become
            the geometry, and x and y become properties.
    """
    features = []
    for k, row in enumerate(tree_rows(trees, start_ns)):
        values = dict(zip(TREE_COLUMNS, row, strict=True))
        if lon_lat is None:
            x, y = float(values.pop("x_m")), float(values.pop("y_m"))
        else:
            x, y = (round(float(v), 8) for v in lon_lat[k])
        properties: dict[str, Any] = {
            name: None if text == "" else json.loads(text) for name, text in values.items()
        }
        features.append(
            {
                "type": "Feature",
                "id": properties["tree"],
                "geometry": {"type": "Point", "coordinates": [x, y]},
                "properties": properties,
            }
        )
    collection: dict[str, Any] = {"type": "FeatureCollection"}
    if lon_lat is None:
        collection["coordinateFrame"] = dict(ROBOTS_FRAME if frame is None else frame)
    collection["features"] = features
    return json.dumps(collection, indent=1) + "\n"


def csv_text(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return the text of a header and rows, separated by commas and line feeds; cells are quoted where
    necessary."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue()


class RunFiles:
    """The output folder of `stemmap map`. Detections are written during the run, all else at its end; all
    files appear under their names in `finish`.

    Args:
        folder: The folder, which is created if necessary; files of an earlier run are replaced.
        earlier: Folder of the run that this one continues; its detections come first.

    Raises:
        OSError: The folder cannot be created or written.
    """

    def __init__(self, folder: FilePath, earlier: FilePath | None = None) -> None:
        """Create the folder and, in it, a hidden folder for incomplete files, with the detections of the
        earlier run or a header."""
        self._folder = folder
        self._made_folder = not folder.exists()
        folder.mkdir(parents=True, exist_ok=True)
        # A separate folder, so that two runs into the same folder do not mix their files.
        self._staging = FilePath(tempfile.mkdtemp(prefix=UNFINISHED, dir=folder))
        rows = self._staging / ROWS
        if earlier is not None and (earlier / rows.name).is_file():
            shutil.copyfile(earlier / rows.name, rows)
        else:
            rows.write_text(csv_text(DETECTION_COLUMNS, []), encoding="utf-8", newline="")
        self._detections = rows.open("a", encoding="utf-8", newline="")
        with contextlib.suppress(OSError):  # a network disk may not support locks
            hold(self._detections)

    def __enter__(self) -> RunFiles:
        return self

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        """After an exception, remove the incomplete files, see `abandon`."""
        if error is not None:
            self.abandon()

    def add(self, frame: Frame, start_ns: int) -> None:
        """Write the clusters of a scan to the detections; seconds count from `start_ns` [ns]."""
        writer = csv.writer(self._detections, lineterminator="\n")
        writer.writerows(detection_rows(frame, start_ns))

    def add_rows(self, rows: Iterable[Sequence[str]]) -> None:
        """Write rows of DETECTION_COLUMNS to the detections."""
        csv.writer(self._detections, lineterminator="\n").writerows(rows)

    def finish(
        self,
        trees: Trees,
        path: Path,
        start_ns: int,
        run: dict[str, Any],
        state: bytes | None,
        further: Mapping[str, str] | None = None,
    ) -> None:
        """Write the other files and move all files to their names, `run.json` last. Files `seen.csv`,
        `georeference.json` and (without a new state) `state.zip` of an earlier run are removed.

        Args:
            trees, path: The map; confirmed trees are written.
            start_ns: Time from which the seconds count [ns].
            run: Content of run.json; numbers are finite.
            state: State for a continuation; None without.
            further: Texts of additional files, or of files to replace, by name.

        Raises:
            OSError: The disk refuses.
        """
        self._detections.close()
        texts = {
            "trees.csv": csv_text(TREE_COLUMNS, tree_rows(trees, start_ns)),
            "path.csv": csv_text(PATH_COLUMNS, path_rows(path, start_ns)),
            "trees.geojson": geojson(trees, start_ns),
            **(further or {}),
            "run.json": json.dumps(run, indent=1, allow_nan=False) + "\n",
        }
        for name, text in texts.items():
            (self._staging / name).write_text(text, encoding="utf-8", newline="")
        states = [] if state is None else ["state.zip"]
        for name in ("seen.csv", "georeference.json"):  # of an earlier run, which may have another frame
            (self._folder / name).unlink(missing_ok=True)
        if state is None:
            (self._folder / "state.zip").unlink(missing_ok=True)
        else:
            (self._staging / "state.zip").write_bytes(state)
        # run.json last: if it exists, so do the others
        for name in (ROWS, *states, *texts):
            (self._staging / name).replace(self._folder / name)
        self._staging.rmdir()

    def abandon(self) -> None:
        """Remove the incomplete files, and the folder if this object created it; files of an earlier run do
        not change.

        Raises:
            OSError: The created folder contains other files.
        """
        self._detections.close()
        for file in self._staging.iterdir():
            file.unlink()
        self._staging.rmdir()
        if self._made_folder:
            self._folder.rmdir()


def _seconds(stamp_ns: int, start_ns: int) -> float:
    """Return the time from `start_ns` to a stamp [s]; NaN for a stamp below 0, which is unknown."""
    return (int(stamp_ns) - start_ns) * 1e-9 if stamp_ns >= 0 else math.nan


def _number(value: float, digits: int) -> str:
    """Return a decimal text with `digits` decimals, without exponent and without minus zero; empty for values
    that are not finite."""
    if not math.isfinite(value):
        return ""
    text = f"{value:.{digits}f}"
    return text.lstrip("-") if float(text) == 0.0 else text
