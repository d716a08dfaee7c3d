"""A run that is localised in a stored map while it is mapped: its poses in that map, and the comparison."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from app.batch.run_folder import read_run, read_seen_area
from app.batch.visits import VisitComparison, VisitTrees, compare_visits, with_known_sigma
from app.common.text import count, version
from app.extensions.maps.localisation import Localisation, Localiser, State, StoredMap
from pipeline.geometry.gaussian import spread_by_pose
from pipeline.geometry.poses import Float, Pose2, Pose3, wrap_angle
from pipeline.io.atomic_files import write_texts
from pipeline.io.recording.messages import map_odom_messages
from pipeline.io.result_files import csv_text, number_text
from pipeline.seen_area import SeenArea
from pipeline.slam.frame_uncertainty import transported_covariance
from pipeline.types.records import Bool, Frame, HeightMap, Path

TERRAIN_REACH = 20.0  # m around the robot; more of the local terrain is not compared
SEEN_REACH = 15.0  # m; a place counts as observed up to this distance
MATCH = 1.0  # m; largest distance of the two positions of a tree
DBH_SIGMA = 0.01  # m, of a diameter without a standard deviation
_POSE = ("x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad")
POSE_COLUMNS = ("t_s", *_POSE, "sigma_x_m", "sigma_y_m", "sigma_yaw_rad")
MAP_ODOM_COLUMNS = ("t_s", *_POSE, "stems", "of", "residual_m", "state")
TREE_COLUMNS = ("tree_map", "tree", "x_m", "y_m", "status", "growth_cm", "sigma_growth_cm", "significant")


class LocalisedRun:
    """Localises a run scan by scan, and keeps the poses in the stored map.

    Args:
        stored: The map.
        slack: The parameter `relocalisation.slack` [m].

    Attributes:
        localiser: The localiser.
        events: Time [ns] and localisation at each change of the state.
    """

    def __init__(self, stored: StoredMap, slack: float) -> None:
        self.localiser = Localiser(stored, slack)
        self.events: list[tuple[int, Localisation]] = []
        self._start_ns: int | None = None
        self._poses: list[list[str]] = []
        self._map_odom: list[list[str]] = []
        self._ground: HeightMap | None = None
        self._terrain: Float = np.zeros((0, 3))

    @property
    def localisation(self) -> Localisation:
        """The localisation after the last scan."""
        return self.localiser.localisation

    def add(self, frame: Frame) -> bool:
        """Localise a scan; return whether the state has changed."""
        if self._start_ns is None:
            self._start_ns = frame.stamp_ns
        before = self.localisation
        T_odom_base = frame.estimate.T_map_base
        got = self.localiser.update(
            frame.stamp_ns, T_odom_base, frame.trees, self._near(frame), frame.detections
        )
        seconds = number_text((frame.stamp_ns - self._start_ns) * 1e-9, 3)
        T_map_odom = got.pose_3d
        if got.T_map_odom is not None and T_map_odom is not None:
            base = T_map_odom.apply(np.array([[T_odom_base.x, T_odom_base.y, frame.base_z]]))[0]
            roll, pitch, yaw = T_map_odom.euler()
            tilt = Pose2(0.0, 0.0, T_odom_base.yaw).rotation().T @ np.array([pitch, -roll])
            heading = float(wrap_angle(yaw + T_odom_base.yaw))
            numbers = (*base, -tilt[1], tilt[0], heading, *np.sqrt(np.diag(got.covariance)))
            self._poses.append([seconds, *_texts(numbers)])
            if got.T_map_odom != before.T_map_odom:
                row = (*T_map_odom.t, roll, pitch, yaw)
                agree = (str(got.stems), str(got.of), number_text(got.residual, 3), got.state.name.lower())
                self._map_odom.append([seconds, *_texts(row), *agree])
        changed = got.state is not before.state or got.withdrawn != before.withdrawn
        if changed:
            self.events.append((frame.stamp_ns - self._start_ns, got))
        return changed

    def _near(self, frame: Frame) -> Float:
        """Return x, y, z of the cells of the local terrain around the robot, shape (K, 3) [m]."""
        ground = frame.ground
        if ground is not None and ground is not self._ground:
            self._ground = ground
            middle = (ground.place + 0.5) * ground.cell
            self._terrain = np.column_stack([middle, ground.height]).astype(np.float64)
        at = frame.estimate.T_map_base
        return self._terrain[
            np.hypot(self._terrain[:, 0] - at.x, self._terrain[:, 1] - at.y) <= TERRAIN_REACH
        ]

    def texts(self) -> dict[str, str]:
        """Return the texts of the files by their names: poses.csv, the pose of each scan in the frame of the
        stored map while it was found, and map_odom.csv, the pose of the frame of this run in it."""
        return {
            "poses.csv": csv_text(POSE_COLUMNS, self._poses),
            "map_odom.csv": csv_text(MAP_ODOM_COLUMNS, self._map_odom),
        }


def _texts(numbers: Sequence[float]) -> list[str]:
    """Return numbers with five decimals."""
    return [number_text(float(number), 5) for number in numbers]


def in_stored_map(frame: Frame, path: Path, found: Localisation) -> tuple[Frame, Path] | None:
    """Return the results of a scan and the path in the frame of the stored map; None unless found."""
    T = found.T_map_odom
    if T is None:
        return None
    C = T.rotation()
    trees = frame.trees
    pose = T @ frame.estimate.T_map_base
    spread = spread_by_pose(T.apply(trees.position), pose.as_array(), found.covariance)
    moved = replace(
        trees, position=T.apply(trees.position), covariance=C @ trees.covariance @ C.T + spread, sides=None
    )
    estimate = replace(frame.estimate, T_map_base=pose, covariance=found.covariance, relative=None)
    x, y = T.apply(np.stack([path.x, path.y], axis=1)).T
    along = Path(path.stamp_ns, x, y, wrap_angle(path.yaw + T.yaw), path.sigma_xy)
    return replace(frame, estimate=estimate, trees=moved), along


def map_odom(frame: Frame, found: Localisation) -> dict[str, bytes]:
    """Return the message of the pose of the odometry in the stored map at a scan, by its topic; empty unless
    found. The frame of the run is not that of the odometry, because SLAM corrects its drift."""
    T_map_run = found.pose_3d
    if T_map_run is None:
        return {}
    base = frame.estimate.T_map_base
    run_odom = base @ frame.T_odom_base.inverse()
    at = Pose3.from_euler(np.array([run_odom.x, run_odom.y, 0.0]), 0.0, 0.0, run_odom.yaw)
    T_map_odom = T_map_run @ at
    robot = T_map_run.apply(np.array([[base.x, base.y, 0.0]]))[0]
    dx, dy = (T_map_odom.t - robot)[:2]
    covariance = transported_covariance(found.covariance, float(dx), float(dy))
    return map_odom_messages(frame.stamp_ns, T_map_odom, covariance)


@dataclass(frozen=True, slots=True, eq=False)
class Changes:
    """Comparison of the trees of a run with those of the stored map.

    Attributes:
        found: Pairs of trees; a is the stored map.
        missing, new: Rows of the trees of the map that the run looked for in vain, and of the run where the
            map was observed and has none.
        trees: Trees of the run.
    """

    found: VisitComparison
    missing: list[int] = field(default_factory=list)
    new: list[int] = field(default_factory=list)
    trees: VisitTrees | None = None

    @property
    def lines(self) -> list[str]:
        """The comparison for people."""
        growth = self.found.growth[np.isfinite(self.found.growth)]
        known = (
            f"in the whole run: {len(self.found.shift)} of {count(len(self.found.b_of), 'tree')} of the map "
            f"seen again, {len(self.missing)} missing, "
        )
        lines = [f"{known}{len(self.new)} new"]
        if len(growth):
            se = f" +- {100.0 * growth.std(ddof=1) / math.sqrt(len(growth)):.2f}" if len(growth) > 1 else ""
            lines.append(
                f"diameter since the map: mean {100.0 * growth.mean():+.2f} cm{se} "
                f"({count(len(growth), 'tree')}), "
                f"significant for {np.count_nonzero(self.found.significant)}"
            )
        return lines


def changes(stored: StoredMap, map_folder: FilePath, run: FilePath, T_map_odom: Pose2) -> Changes:
    """Return the comparison of a run with the stored map.

    Args:
        stored: The map.
        map_folder: Folder of the map; if it is a packed file, which has no seen area, no tree counts as new.
        run: Folder of the run.
        T_map_odom: Pose of the frame of the run in the map.

    Raises:
        StemmapError: A file of a folder is damaged.
    """
    trees = read_run(run).trees
    sigma = np.sqrt(0.5 * np.trace(trees.covariance, axis1=1, axis2=2))
    now = with_known_sigma(
        VisitTrees(trees.number, trees.position, sigma, trees.dbh, trees.dbh_sigma), DBH_SIGMA
    )
    own = np.sqrt(0.5 * (stored.covariance[:, 0] + stored.covariance[:, 2]))
    then = with_known_sigma(
        VisitTrees(stored.number, stored.position, own, stored.dbh, stored.dbh_sigma), DBH_SIGMA
    )
    found = compare_visits(then, now, T_map_odom, reach=MATCH, refine=True)
    T = found.T_a_b
    lost = np.flatnonzero(found.b_of < 0)
    looked = _observed(read_seen_area(run), T.inverse().apply(stored.position[lost]))
    extra = np.setdiff1d(np.arange(len(now.number)), found.b_of)
    seen = read_seen_area(map_folder) if map_folder.is_dir() else None
    known = _observed(seen, T.apply(now.position[extra]))
    return Changes(found, lost[looked].tolist(), extra[known].tolist(), now)


def _observed(seen: SeenArea | None, points: Float) -> Bool:
    """Return whether an area contains each position near enough to be observed, shape (N,)."""
    if seen is None or not len(points):
        return np.zeros(len(points), np.bool_)
    clear = seen.clear_cells()
    observed: Bool = clear.where(~(clear.nearest > SEEN_REACH)).rows(points) >= 0
    return observed


def tree_table(stored: StoredMap, done: Changes) -> str:
    """Return the text of trees_in_map.csv: the trees of the map and of the run, in the frame of the map."""
    found, now = done.found, done.trees
    assert now is not None  # noqa: S101 - set by `changes`
    place = found.T_a_b.apply(now.position)
    missing, new, rows, pair = set(done.missing), set(done.new), [], 0
    for k, row in enumerate(found.b_of.tolist()):
        at = [number_text(float(v), 3) for v in stored.position[k]]
        if row < 0:
            status = "missing" if k in missing else "not looked at"
            rows.append([str(stored.number[k]), "", *at, status, "", "", ""])
            continue
        growth, sigma = 100.0 * found.growth[pair], 100.0 * found.growth_sigma[pair]
        known = [number_text(growth, 2), number_text(sigma, 2)]
        mark = str(bool(found.significant[pair])).lower() if math.isfinite(growth) else ""
        same = "moved" if found.moved[pair] else "same"
        rows.append([str(stored.number[k]), str(now.number[row]), *at, same, *known, mark])
        pair += 1
    for row in np.setdiff1d(np.arange(len(now.number)), found.b_of).tolist():
        at = [number_text(float(v), 3) for v in place[row]]
        rows.append(
            ["", str(now.number[row]), *at, "new" if row in new else "outside of the map", "", "", ""]
        )
    return csv_text(TREE_COLUMNS, rows)


def record(run: LocalisedRun, done: Changes | None) -> dict[str, Any]:
    """Return the content of localisation.json: `stemmap` (version), `state`, `text`, `found_at_m`,
    `driven_m`, `searches`, `withdrawn`, `stems`, `of`, `residual_m`, `sigma_m_m_rad`, `T_map_odom` (x, y,
    yaw), `height` (z_m at the robot, roll_rad, pitch_rad), `events`, and the numbers `seen_again`, `missing`
    and `new`; unknown values are None."""
    l10n = run.localisation
    pose, height = l10n.T_map_odom, l10n.pose_3d if l10n.height is not None else None
    roll, pitch = (None, None) if height is None else (float(v) for v in height.euler()[:2])
    sigma = np.sqrt(np.diag(l10n.covariance)).tolist()
    return {
        "stemmap": version(),
        "state": l10n.state.name.lower(),
        "text": l10n.text,
        "found_at_m": None if math.isnan(l10n.found_at) else round(l10n.found_at, 2),
        "driven_m": round(l10n.driven, 2),
        "searches": l10n.searches,
        "withdrawn": l10n.withdrawn,
        "stems": l10n.stems,
        "of": l10n.of,
        "residual_m": None if math.isnan(l10n.residual) else round(l10n.residual, 4),
        "sigma_m_m_rad": None if pose is None else [round(v, 5) for v in sigma],
        "T_map_odom": None if pose is None else pose.as_array().tolist(),
        "height": None
        if l10n.height is None
        else {"z_m": l10n.height.z, "roll_rad": roll, "pitch_rad": pitch},
        "events": [
            {"t_s": round(t * 1e-9, 3), "driven_m": round(e.driven, 2), "text": e.text} for t, e in run.events
        ],
        "seen_again": None if done is None else len(done.found.shift),
        "missing": None if done is None else len(done.missing),
        "new": None if done is None else len(done.new),
    }


def write_localised(run: LocalisedRun, done: Changes | None, folder: FilePath) -> None:
    """Write poses.csv, map_odom.csv, localisation.json and, with a comparison, trees_in_map.csv to a folder.

    Raises:
        StemmapError: A file cannot be written.
    """
    texts = run.texts()
    if done is not None:
        texts["trees_in_map.csv"] = tree_table(run.localiser.stored, done)
    texts["localisation.json"] = json.dumps(record(run, done), indent=1, allow_nan=False) + "\n"
    write_texts(folder, texts)


def is_reliable(run: LocalisedRun) -> bool:
    """Return whether the robot is found at the end, and no fix was withdrawn."""
    return run.localisation.state is State.FOUND and not run.localisation.withdrawn
