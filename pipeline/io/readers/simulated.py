"""Simulated runs as a source: `sim:stand`, `sim:paper?seed=3&odometry=poor`, ..."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlencode

from pipeline.errors import SourceError
from pipeline.io.readers.base import FileSource, SourceDescription, SourceOptions
from pipeline.simulation.robot_motion import IMU_HZ, ODOMETRY_HZ
from pipeline.simulation.run import START_NS, SimulatedRun, open_run
from pipeline.simulation.scenarios import CLOUD, SCHEME, RunRequest, parse_uri
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
    simulated LiDAR; None uses the default of the simulation. `sim:cloud?file=&truth=` is a drive through the
    real cloud of a plot.

    Raises:
        UsageError: There is no such scenario or option, or a value is out of bounds.
        SourceError: A file cannot be read, there is no free position for an object in the scene, or no path
            for a robot.
    """
    chosen = SourceOptions() if options is None else options
    request = parse_uri(uri, chosen.seed)
    if request.name == CLOUD:
        return _open_cloud(uri, request, chosen)
    return SimulatedSource(uri, open_run(request, chosen.T_base_lidar))


def open_cloud_drive(uri: str, file: Path, options: SourceOptions) -> SimulatedSource:
    """Open a whole cloud as a run: a simulated robot drives through it, as for `sim:cloud?file=`.

    Args:
        uri: Path as the user wrote it.
        file: File of the cloud.
        options: Choices of the user, of which seed and extrinsics are used.

    Raises:
        SourceError: The cloud cannot be read, or has no path for a robot.
    """
    request = parse_uri(f"{SCHEME}{CLOUD}?{urlencode({'file': str(file)})}", options.seed)
    return _open_cloud(uri, request, options)


def _open_cloud(uri: str, request: RunRequest, options: SourceOptions) -> SimulatedSource:
    """Open a drive through the real cloud of a plot.

    Args:
        uri: URI as the user wrote it.
        request: Scenario and options of the URI.
        options: Choices of the user.

    Raises:
        SourceError: The cloud or the ground truth cannot be read, or the cloud has no path for a robot.
    """
    from pipeline.io.ground_truth import read_truth_trees
    from pipeline.io.readers.clouds import open_cloud
    from pipeline.simulation.cloud_run import open_cloud_run

    trees = read_truth_trees(Path(request.truth).expanduser()) if request.truth else None
    cloud = open_cloud(request.file, options)
    try:
        run = open_cloud_run(request, cloud, trees, options.T_base_lidar)
    except SourceError as error:
        raise SourceError(
            error.what, where=uri, remedy="`stemmap map` maps the cloud as a whole, without a robot"
        ) from None
    kind = f"simulated drive through a whole cloud ({cloud.description.kind})"
    return SimulatedSource(uri, run, knows_trees=trees is not None, kind=kind, warnings=run.warnings)
