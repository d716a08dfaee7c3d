"""Trees with a diameter after the route of *Coverage* and after driving on for the same length: stands of
`sim:wild`."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from tests.benchmarks.seeds import chosen_seeds
from tests.benchmarks.table import Cell, Table

if TYPE_CHECKING:
    from pipeline.seen_area import SeenRecorder
    from pipeline.simulation.run import SimulatedRun
    from pipeline.types.records import Float, Path, Trees

NAME = "coverage"
LINE = "Trees with a diameter after the way of Coverage, and after driving on for as long"
SEEDS = range(10)
SPACING = 1.5  # m, of the waypoints of a drive


def run() -> list[Table]:
    """Ten stands: the drive of the scenario, then the route, or the course of the scenario for the same
    length."""
    rows, shares = list[tuple[Cell, ...]](), list[tuple[float, float, float]]()
    for seed in chosen_seeds(SEEDS):
        row, share = _stand(seed)
        rows.append(row)
        shares.append(share)
        print(*row, file=sys.stderr, flush=True)
    first, on, way = (100.0 * sum(each) / len(shares) for each in zip(*shares, strict=True))
    rows.append(("all", "", None, first, on, way, way - on))
    columns = (
        "seed", "sensor", "length [m]", "first drive [%]", "driven on [%]", "after the way [%]",
        "gain [points]",
    )  # fmt: skip
    return [
        Table(LINE, columns, tuple(rows), ("Share of the trees of the first drive that have a diameter.",))
    ]


class _Mapped(NamedTuple):
    """A mapped run.

    Attributes:
        path: The estimated path.
        trees: The confirmed trees, in the frame of the scene.
        seen: Area that its scans observed.
    """

    path: Path
    trees: Trees
    seen: SeenRecorder

    def share(self, place: Float) -> float:
        """Return the share of the trees at places of the map, shape (K, 2) [m], that have a diameter here."""
        import numpy as np

        from pipeline.config import preset
        from pipeline.evaluation import match

        tree = match(place, self.trees.position, preset("forest").evaluation.match_distance)
        return float((np.isfinite(self.trees.dbh[tree]) & (tree >= 0)).mean())


def _stand(seed: int) -> tuple[tuple[Cell, ...], tuple[float, float, float]]:
    """One stand: its row, and the shares of trees with a diameter after the three drives."""
    import numpy as np

    from app.extensions.stand.detour import shortest_detour
    from pipeline.config import preset
    from pipeline.simulation.run import open_run
    from pipeline.simulation.scenarios import parse_uri

    first = open_run(parse_uri(f"sim:wild?seed={seed}"))
    mapped, parameters = _map(first), preset("forest")
    assert mapped.trees.sides is not None
    known = np.isfinite(mapped.trees.dbh).tolist()
    found = shortest_detour(
        np.array([mapped.path.x[-1], mapped.path.y[-1]]),
        mapped.trees.position,
        0.5 * mapped.trees.dbh,
        [
            None if is_known else bits
            for is_known, bits in zip(known, mapped.trees.sides.tolist(), strict=True)
        ],
        np.radians(parameters.tracking.dbh_arc_min),
        mapped.seen.area(mapped.path),
        parameters.obstacles.width,
    )
    place = mapped.trees.position
    share = mapped.share(place)
    if found is None:
        return (seed, first.lidar.name, 0.0, 100.0 * share, *[None] * 3), (share,) * 3
    on, way = (
        _map(_driven_on(first, corners, found.length)).share(place) for corners in (None, found.points)
    )
    shares = share, on, way
    percent = [100.0 * share for share in shares]
    return (seed, first.lidar.name, found.length, *percent, percent[2] - percent[1]), shares


def _driven_on(first: SimulatedRun, corners: Float | None, length: float) -> SimulatedRun:
    """The same run with a longer drive: along a route, or, for None, along the course of the scenario.

    Args:
        first: The run.
        corners: Corners of the route, shape (K, 2), the first one where the run ends [m].
        length: Length that is driven in addition [m].
    """
    import numpy as np

    from pipeline.simulation.robot_motion import drive_course, inertial_readings, lay_course, lay_on_terrain
    from pipeline.simulation.run import INERTIAL, SHAKE, odometry_of, random_stream
    from pipeline.simulation.terrain import WheelContact

    request = first.request
    scenario = request.scenario
    done = first.motion.drive
    done_m = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(done.x), np.diff(done.y)))])
    total_m = float(np.interp(request.duration_s, done.t, done_m)) + length
    course = lay_course(np.array(scenario.waypoints), scenario.closed)
    if corners is not None:
        at = np.append(np.arange(0.0, total_m - length - 0.5 * SPACING, SPACING), total_m - length)
        begun = np.column_stack([np.interp(at, done_m, column) for column in (done.x, done.y)])
        legs = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
        on = np.linspace(0.0, legs[-1], max(2, round(legs[-1] / SPACING)) + 1)[1:]
        way = np.column_stack([np.interp(on, legs, column) for column in corners.T])
        course = lay_course(np.concatenate([begun, way]), closed=False)
    drive = drive_course(course, scenario.speed, request.duration_s + 10.0 * length / scenario.speed)
    if corners is not None:  # back into the frame of the scene
        c, s = np.cos(course.heading), np.sin(course.heading)
        x, y = c * drive.x - s * drive.y, s * drive.x + c * drive.y
        drive = replace(drive, x=x, y=y, yaw=drive.yaw + course.heading)
    driven_m = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(drive.x), np.diff(drive.y)))])
    end = int(np.searchsorted(driven_m, min(total_m, driven_m[-1] - 0.1)))
    longer = replace(request, duration_s=float(drive.t[end]))
    kept = slice(0, end + 101)  # half a second longer, as `drive_course`
    drive = replace(drive, **{name: getattr(drive, name)[kept] for name in drive.__slots__})
    motion = lay_on_terrain(drive, WheelContact(first.scene.terrain), random_stream(SHAKE, longer))
    return replace(
        first,
        request=longer,
        motion=motion,
        odometry=odometry_of(motion, longer),
        inertial=inertial_readings(motion, random_stream(INERTIAL, longer)),
        scans=round(longer.duration_s * 1e9) // first.lidar.period_ns,
    )


def _map(run: SimulatedRun) -> _Mapped:
    """Map a run, and record the area that its scans observed."""
    from pipeline.config import preset
    from pipeline.geometry.columns import rows_of
    from pipeline.geometry.poses import Pose2
    from pipeline.io.readers.simulated import SimulatedSource
    from pipeline.mapper import Mapper
    from pipeline.odometry.synchroniser import steps
    from pipeline.seen_area import SeenRecorder, ViewSelection

    source = SimulatedSource("sim:wild", run)
    about = source.description
    mapper = Mapper(preset("forest"), sensor=about.sensor, T_base_lidar=about.T_base_lidar, seed=0)
    seen, views, frame = SeenRecorder(), ViewSelection(), None
    for step in steps(source.records()):
        scan = mapper.segment(step)
        frame = mapper.process(step, scan)
        if views.take(frame.estimate.T_map_base):
            seen.add(frame.stamp_ns, scan.view)
    assert frame is not None
    trees, drive = rows_of(frame.trees, frame.trees.confirmed), run.motion.drive
    T_world_map = Pose2(float(drive.x[0]), float(drive.y[0]), float(drive.yaw[0]))
    placed = replace(trees, position=T_world_map.apply(trees.position))
    return _Mapped(mapper.path, placed, seen)
