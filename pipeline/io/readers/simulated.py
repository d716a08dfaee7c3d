"""Simulated runs as a source: `sim:stand`, `sim:paper?seed=3&odometry=poor`, ..."""

from __future__ import annotations

from collections.abc import Iterator

from pipeline.io.readers.base import FileSource, SourceDescription, SourceOptions
from pipeline.simulation.robot_motion import IMU_HZ, ODOMETRY_HZ
from pipeline.simulation.run import START_NS, SimulatedRun, open_run
from pipeline.simulation.scenarios import parse_uri
from pipeline.types.records import Record, Truth

_TICK_NS = 1_000_000_000 // IMU_HZ


class SimulatedSource(FileSource):
    """A simulated run as a source (see `pipeline.io.readers.base.Source`)."""

    def __init__(
        self,
        uri: str,
        run: SimulatedRun,
        *,
        knows_trees: bool = True,
        kind: str = "simulated run",
        warnings: tuple[str, ...] = (),
    ) -> None:
        """Describe a simulated run; nothing is simulated.

        Args:
            uri: URI as the user wrote it.
            run: The run.
            knows_trees: Whether the ground truth has trees.
            kind: Name of the format.
            warnings: Messages for the user.
        """
        super().__init__()
        self.run = run
        self._knows_trees = knows_trees
        last = START_NS + (run.scans - 1) * run.lidar.period_ns
        self._description = SourceDescription(
            uri=uri,
            kind=kind,
            sensor=run.lidar.sensor,
            T_base_lidar=run.T_base_lidar,
            has_odometry=True,
            has_imu=True,
            scans=run.scans,
            start_ns=START_NS,
            end_ns=last,
            digest=run.digest(),
            warnings=warnings,
        )

    def records(self, *, every: int = 1) -> Iterator[Record]:
        """Yield all records in the order of time; with equal times IMU, odometry, scan.

        The stamp of a scan is the start of its sweep, so readings during the sweep follow it. Readings
        continue to the end of the last sweep, so that every sweep can be undistorted.

        Args:
            every: Only every n-th scan is simulated and yielded, with all other readings.
        """
        period = self.run.lidar.period_ns
        per_odometry, per_scan = IMU_HZ // ODOMETRY_HZ, period // _TICK_NS
        for tick in range(self.run.scans * per_scan + 1):
            yield self.run.imu_record(tick)
            if tick % per_odometry == 0:
                yield self.run.odometry_record(tick // per_odometry)
            if tick % (per_scan * every) == 0 and tick // per_scan < self.run.scans:
                yield self.run.sweep(tick // per_scan).scan

    def truth(self) -> Truth:
        """Return the trees and other objects (None if they are unknown), and the true path."""
        trees = self.run.true_trees() if self._knows_trees else None
        return Truth(trees=trees, path=self.run.true_path())


def open_simulated(uri: str, options: SourceOptions | None = None) -> SimulatedSource:
    """Open `sim:NAME?seed=&sigma=&odometry=&duration=&trees=`.

    `options.seed` applies when the URI has no seed; `options.T_base_lidar` are the extrinsics of the
    simulated LiDAR; None uses the default of the simulation.

    Raises:
        UsageError: There is no such scenario or option, or a value is out of bounds.
        SourceError: There is no free position for an object in the scene.
    """
    chosen = SourceOptions() if options is None else options
    request = parse_uri(uri, chosen.seed)
    return SimulatedSource(uri, open_run(request, chosen.T_base_lidar))
