"""Result files of a mapped run. Unknown values are empty, never 0."""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from pipeline.geometry.poses import Float, Pose3
from pipeline.io.atomic_files import UNFINISHED
from pipeline.seen_area import SeenArea
from pipeline.types.records import Bool, Frame, HeightMap, Int, Path, Trees, Verdict

ROWS = "detections.csv"  # written during the run
#: What people measured: trees of the map by tape, and trees that the map lacks. The name is not measured.csv,
#: because a user may have a table of that name for `evaluate` in the same folder.
BY_PEOPLE = "by_people.csv"
#: States of a tree in the review by a person.
OPEN, CONFIRMED, REJECTED, SKIPPED = REVIEWS = ("open", "confirmed", "rejected", "skipped")
TERRAIN_COLUMNS = ("x_m", "y_m", "z_m", "sigma_m", "views")
SEEN_COLUMNS = ("x_m", "y_m", "nearest_m", "views", "clear")


def number_text(value: float, digits: int) -> str:
    """Return a decimal text with `digits` decimals, without exponent and without minus zero; "" for values
    that are not finite."""
    if not math.isfinite(value):
        return ""
    text = f"{value:.{digits}f}"
    return text.lstrip("-") if float(text) == 0.0 else text


def _numbers(values: Iterable[float] | None, digits: int) -> Iterable[str]:
    """Yield the texts of numbers by `number_text`; for None, yield "" endlessly."""
    return itertools.repeat("") if values is None else (number_text(value, digits) for value in values)


def _seconds(stamp_ns: Int, start_ns: int) -> Iterable[str]:
    """Return the times from `start_ns` to stamps [s] as texts with three decimals; "" for a stamp below 0,
    which is unknown."""
    return _numbers(np.where(stamp_ns >= 0, (stamp_ns - start_ns) * 1e-9, math.nan), 3)


#: Columns of trees.csv: name, and the texts for trees and the time from which the seconds count [ns].
_TREES: dict[str, Callable[[Trees, int], Iterable[str]]] = {
    "tree": lambda trees, _: map(str, trees.number),
    "x_m": lambda trees, _: _numbers(trees.position[:, 0], 3),
    "y_m": lambda trees, _: _numbers(trees.position[:, 1], 3),
    "sigma_x_m": lambda trees, _: _numbers(np.sqrt(trees.covariance[:, 0, 0]), 3),
    "sigma_y_m": lambda trees, _: _numbers(np.sqrt(trees.covariance[:, 1, 1]), 3),
    "dbh_cm": lambda trees, _: _numbers(100.0 * trees.dbh, 1),
    "sigma_dbh_cm": lambda trees, _: _numbers(100.0 * trees.dbh_sigma, 1),
    "eccentricity": lambda trees, _: _numbers(trees.eccentricity, 3),
    "observations": lambda trees, _: map(str, trees.observations),
    "coverage_deg": lambda trees, _: _numbers(_known_degrees(trees.coverage, trees.coverage > 0), 0),
    "first_seen_s": lambda trees, start_ns: _seconds(trees.first_seen_ns, start_ns),
    "last_seen_s": lambda trees, start_ns: _seconds(trees.last_seen_ns, start_ns),
    "height_m": lambda trees, _: _numbers(trees.height, 2),
    "sigma_height_m": lambda trees, _: _numbers(trees.height_sigma, 2),
    "lean_deg": lambda trees, _: _numbers(None if trees.lean is None else np.degrees(trees.lean), 2),
    "sigma_assumed": lambda trees, _: ("1" if n == 0 else "0" for n in trees.observations),
}
TREE_COLUMNS = (*_TREES, "review")
#: Those that are read back; `sigma_assumed` follows from the observations.
READ_TREE_COLUMNS = tuple(name for name in TREE_COLUMNS if name != "sigma_assumed")
_PATH: dict[str, Callable[[Path, int], Iterable[str]]] = {
    "t_s": lambda path, start_ns: _seconds(path.stamp_ns, start_ns),
    "x_m": lambda path, _: _numbers(path.x, 4),
    "y_m": lambda path, _: _numbers(path.y, 4),
    "yaw_rad": lambda path, _: _numbers(path.yaw, 5),
    "sigma_xy_m": lambda path, _: _numbers(path.sigma_xy, 4),
}
PATH_COLUMNS = tuple(_PATH)
#: Columns of detections.csv: name, and the texts for a frame and the time of its scan [s].
_DETECTIONS: dict[str, Callable[[Frame, str], Iterable[str]]] = {
    "scan": lambda frame, _: itertools.repeat(str(frame.index)),
    "t_s": lambda _, time: itertools.repeat(time),
    "x_m": lambda frame, _: _numbers(_centres(frame)[:, 0], 3),
    "y_m": lambda frame, _: _numbers(_centres(frame)[:, 1], 3),
    "verdict": lambda frame, _: (Verdict(int(verdict)).label for verdict in frame.clusters.verdict),
    "eccentricity": lambda frame, _: _numbers(frame.clusters.eccentricity, 3),
    "radius_m": lambda frame, _: _numbers(frame.clusters.radius, 3),
    "radial_std_m": lambda frame, _: _numbers(frame.clusters.radial_std, 4),
    "arc_deg": lambda frame, _: _numbers(
        _known_degrees(frame.clusters.arc, np.isfinite(frame.clusters.radius)), 0
    ),
    "points": lambda frame, _: map(str, frame.clusters.size),
    "width_m": lambda frame, _: _numbers(frame.clusters.extent[:, 1], 3),
    "height_m": lambda frame, _: _numbers(frame.clusters.extent[:, 2], 3),
}
DETECTION_COLUMNS = tuple(_DETECTIONS)


def tree_rows(trees: Trees, start_ns: int, reviews: Mapping[int, str] | None = None) -> list[tuple[str, ...]]:
    """Return the confirmed trees as rows of TREE_COLUMNS; unknown values are "".

    Args:
        trees: The map.
        start_ns: Time from which the seconds count [ns]; a stamp below 0 is unknown.
        reviews: Dict from numbers of trees to one of REVIEWS; OPEN for other trees.
    """
    review = ((reviews or {}).get(number, OPEN) for number in trees.number.tolist())
    rows = zip(*(column(trees, start_ns) for column in _TREES.values()), review, strict=False)
    return list(itertools.compress(rows, trees.confirmed))


def path_rows(path: Path, start_ns: int) -> list[tuple[str, ...]]:
    """Return the path as rows of PATH_COLUMNS, one per scan; seconds count from `start_ns` [ns], and are ""
    for a stamp below 0."""
    return list(zip(*(column(path, start_ns) for column in _PATH.values()), strict=True))


def detection_rows(frame: Frame, start_ns: int) -> list[tuple[str, ...]]:
    """Return all clusters of a scan with their verdicts, in the frame of the map, as rows of
    DETECTION_COLUMNS; unknown values are "".

    Args:
        frame: Results of the scan.
        start_ns: Time from which the seconds count [ns].
    """
    time = number_text((frame.stamp_ns - start_ns) * 1e-9, 3) if frame.stamp_ns >= 0 else ""
    return list(zip(*(column(frame, time) for column in _DETECTIONS.values()), strict=False))


def _centres(frame: Frame) -> Float:
    """Return the centres of the clusters in the frame of the map, shape (N, 2) [m]."""
    return frame.estimate.T_map_base.apply(frame.clusters.centre + frame.sensor_offset[:2])


def _known_degrees(angle: Float, known: Bool) -> Float:
    """Return angles [rad] in degrees, shape (N,); NaN where `known`, shape (N,), is False."""
    return np.where(known, np.degrees(angle), math.nan)


def terrain_text(ground: HeightMap) -> str:
    """Return the text of terrain.csv: a header and the rows of `terrain_rows`."""
    return csv_text(TERRAIN_COLUMNS, terrain_rows(ground))


def terrain_rows(ground: HeightMap) -> Iterator[list[str]]:
    """Yield the known cells of the height map as rows of TERRAIN_COLUMNS, from west to east, equal x from
    south to north; x and y are their centres."""
    order = np.lexsort((ground.place[:, 1], ground.place[:, 0]))
    middle = (ground.place[order] + 0.5) * ground.cell
    columns = (middle, ground.height[order], ground.sigma[order], ground.views[order])
    for (x, y), z, sigma, views in zip(*columns, strict=True):
        yield [number_text(x, 3), number_text(y, 3), number_text(z, 3), number_text(sigma, 3), str(views)]


def seen_text(area: SeenArea) -> str:
    """Return the text of seen.csv: the observed cells in the order of `area`; x and y are their centres. The
    distance of the nearest view and the number of views are empty where unknown; clear is 0 or 1."""
    return csv_text(
        SEEN_COLUMNS,
        (
            [
                number_text(x, 3),
                number_text(y, 3),
                number_text(nearest, 2),
                str(views) if views else "",
                str(int(clear)),
            ]
            for (x, y), nearest, views, clear in zip(
                area.centres, area.nearest, area.views, area.clear, strict=True
            )
        ),
    )


ROBOTS_FRAME = {"type": "local", "unit": "m", "origin": "first pose of the robot, x along its heading"}


def geojson(
    trees: Trees,
    start_ns: int,
    *,
    frame: Mapping[str, str] | None = None,
    lon_lat: Float | None = None,
) -> str:
    """Return the text of a GeoJSON FeatureCollection with the confirmed trees. The properties are named as
    TREE_COLUMNS, with null for unknown values; x and y are the geometry. Positions of confirmed trees must be
    finite (else ValueError).

    RFC 7946 requires WGS84; a map without `lon_lat` has a member `coordinateFrame`.

    Args:
        trees: The map.
        start_ns: Time from which the seconds count [ns].
        frame: Description of the coordinates of `trees`; None means ROBOTS_FRAME.
        lon_lat: Longitude and latitude of each confirmed tree, shape (T, 2) [degrees]; None if unknown. They
            become the geometry, and x and y become properties.
    """
    features = tree_features(trees, start_ns, lon_lat=lon_lat)
    return features_text(features, (frame or ROBOTS_FRAME) if lon_lat is None else None)


def tree_features(
    trees: Trees,
    start_ns: int,
    *,
    lon_lat: Float | None = None,
    reviews: Mapping[int, str] | None = None,
) -> list[dict[str, Any]]:
    """Return the confirmed trees as GeoJSON features, JSON values; arguments and errors as in `geojson` and
    `tree_rows`."""
    features = []
    for k, row in enumerate(tree_rows(trees, start_ns, reviews)):
        values = dict(zip(TREE_COLUMNS, row, strict=True))
        if lon_lat is None:
            x, y = float(values.pop("x_m")), float(values.pop("y_m"))
        else:
            x, y = (round(float(v), 8) for v in lon_lat[k])
        properties: dict[str, Any] = {
            name: None if text == "" else text if name == "review" else json.loads(text)
            for name, text in values.items()
        }
        features.append({"id": properties["tree"], **point_feature(x, y, properties)})
    return features


def point_feature(x: float, y: float, properties: dict[str, Any]) -> dict[str, Any]:
    """Return a point as a GeoJSON feature."""
    geometry = {"type": "Point", "coordinates": [x, y]}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def features_text(features: Sequence[dict[str, Any]], frame: Mapping[str, Any] | None) -> str:
    """Return the text of a GeoJSON FeatureCollection.

    Args:
        features: GeoJSON features, JSON values.
        frame: Description of their coordinates; None for longitude and latitude (WGS84).
    """
    collection: dict[str, Any] = {"type": "FeatureCollection"}
    if frame is not None:
        collection["coordinateFrame"] = dict(frame)
    collection["features"] = list(features)
    return json.dumps(collection, indent=1) + "\n"


def csv_text(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return the text of a header and rows, separated by commas and line feeds; cells are quoted where
    necessary."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue()


def csv_in_units(text: str, unit: tuple[float, float], *, to_metres: bool = False) -> str:
    """Return a CSV text whose columns x_m, y_m and z_m are in the units of a reference system, and named x, y
    and z; or, of such a text, the one in metres. Other columns are not changed.

    Args:
        text: Text with a header.
        unit: Metres per unit of x and y, and of z; for 1, 1 the text is returned as it is.
        to_metres: Whether x, y and z become x_m, y_m and z_m.

    Raises:
        ValueError: A cell of these columns is neither empty nor a number, or a row is too short.
    """
    rows = list(csv.reader(io.StringIO(text)))
    if unit == (1.0, 1.0) or not rows:
        return text
    names = {"x": "x_m", "y": "y_m", "z": "z_m"} if to_metres else {"x_m": "x", "y_m": "y", "z_m": "z"}
    factors = {
        k: (unit[0] if name[0] in "xy" else unit[1]) ** (1 if to_metres else -1)
        for k, name in enumerate(rows[0])
        if name in names
    }
    if any(len(row) != len(rows[0]) for row in rows):
        raise ValueError("a row is too short")
    cells = [
        [
            number_text(float(cell) * factors[k], 3) if k in factors and cell else cell
            for k, cell in enumerate(row)
        ]
        for row in rows[1:]
    ]
    return csv_text([names.get(name, name) for name in rows[0]], cells)


#: Poses of the LiDAR by LiDAR odometry, as TUM rows.
ODOMETRY = "odometry.tum"
#: Files of an earlier map that are wrong for a new one, which may have another frame and other tree numbers.
OF_EARLIER_MAP = ("seen.csv", "georeference.json", BY_PEOPLE, ODOMETRY)


def tum_text(poses: Iterable[tuple[int, Pose3]]) -> str:
    """Return poses at times [ns] as TUM rows, which `read_any_poses` reads: t [s], x, y, z [m], qx, qy, qz,
    qw."""
    rows = ["# t_s x_m y_m z_m qx qy qz qw"]
    for stamp_ns, pose in poses:
        w, x, y, z = pose.quaternion().tolist()
        seconds = f"{'-' if stamp_ns < 0 else ''}{abs(stamp_ns) // 10**9}.{abs(stamp_ns) % 10**9:09d}"
        numbers = (*pose.t.tolist(), x, y, z, w)
        rows.append(" ".join((seconds, *(f"{number:.9g}" for number in numbers))))
    return "\n".join(rows) + "\n"


class RunFiles:
    """The output folder of `stemmap map`. Detections are written during the run, the other files at its end;
    all files appear under their names in `finish`.

    Args:
        folder: The folder, which is created if necessary; files of an earlier run are replaced.
        earlier: Folder of the run that this one continues; its detections come first.
        unit: Metres per unit of the reference system in which positions are written, horizontal and vertical,
            see `csv_in_units`.

    Raises:
        OSError: The folder cannot be created or written.
    """

    def __init__(
        self, folder: FilePath, earlier: FilePath | None = None, unit: tuple[float, float] = (1.0, 1.0)
    ) -> None:
        """Create the folder and, in it, a hidden folder for incomplete files, with the detections of the
        earlier run or a header.

        Raises:
            OSError: The folder cannot be created, or a file cannot be written.
        """
        self._folder, self._unit = folder, unit
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

    def __enter__(self) -> RunFiles:
        return self

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        """After an exception, remove the incomplete files, and the folder if this object created it; errors
        as in `abandon`. If there is no exception, nothing is done."""
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
        """Write the other files and move all files to their names, `run.json` last. Files OF_EARLIER_MAP and
        (without a new state) `state.zip` of an earlier run are removed.

        Args:
            trees, path: The map; confirmed trees are written.
            start_ns: Time from which the seconds count [ns].
            run: Content of run.json, as JSON values.
            state: Bytes of state.zip for a continuation; None for no state.
            further: Dict from names of additional files, or of files to replace except run.json, to their
                texts.

        Raises:
            OSError: A file cannot be written or moved.
            ValueError: A number of `run`, or a position of a confirmed tree, is not finite. No file is moved
                or removed then.
        """
        self._detections.close()
        texts = {
            "trees.csv": csv_text(TREE_COLUMNS, tree_rows(trees, start_ns)),
            "path.csv": csv_text(PATH_COLUMNS, path_rows(path, start_ns)),
            "trees.geojson": geojson(trees, start_ns),
            **(further or {}),
            "run.json": json.dumps(run, indent=1, allow_nan=False) + "\n",
        }
        if self._unit != (1.0, 1.0):
            texts[ROWS] = (self._staging / ROWS).read_text(encoding="utf-8")
            texts |= {k: csv_in_units(v, self._unit) for k, v in texts.items() if k.endswith(".csv")}
        for name, text in texts.items():
            (self._staging / name).write_text(text, encoding="utf-8", newline="")
        texts.pop(ROWS, None)
        states = [] if state is None else ["state.zip"]
        for name in OF_EARLIER_MAP:
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
