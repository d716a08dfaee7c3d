"""A tiny source, mapper and worker that stand in for the real ones."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import cast
from zlib import crc32

import numpy as np

from app.worker.protocol import Opened, ToWorker
from app.worker.session import Session
from app.worker.supervisor import OnMessage, WorkerProcess
from pipeline.config import Parameters
from pipeline.detection.free_space import BINS
from pipeline.errors import SourceError
from pipeline.front_end import SegmentedScan, StageTimer, no_timer
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.io.readers.base import Source, SourceDescription, SourceOptions
from pipeline.mapper import Mapper
from pipeline.slam.keyframe_graph import KeyframeGraph
from pipeline.types.records import (
    Clusters,
    Detections,
    Frame,
    Odometry,
    Path,
    PoseEstimate,
    Record,
    Scan,
    Sensor,
    Step,
    Trees,
    Truth,
    TruthTrees,
)

PERIOD_NS = 100_000_000
START_NS = 5_000_000_000


def scan(k: int) -> Scan:
    """The k-th scan: three points that differ from scan to scan."""
    points = np.array([[k, 0, 0], [0, k, 0], [0, 0, k]], np.float32) + 1
    return Scan(stamp_ns=START_NS + k * PERIOD_NS, points=points)


class FakeSource:
    """So many scans at 10 Hz with odometry at the same times; can fail at a scan, or never repeat."""

    def __init__(
        self,
        scans: int,
        *,
        uri: str = "fake:",
        fails_at: int | None = None,
        drifts: bool = False,
        truth: TruthTrees | None = None,
        preset: str = "forest",
    ) -> None:
        self.scans = scans
        self.fails_at = fails_at
        self.drifts = drifts
        self.reads = 0
        self.closed = False
        self.losses: dict[str, int] = {}
        self._truth = truth
        self.description = SourceDescription(
            uri=uri,
            kind="fake run",
            sensor=Sensor(),
            T_base_lidar=Pose3.identity(),
            has_odometry=True,
            has_imu=False,
            scans=scans,
            start_ns=START_NS,
            end_ns=START_NS + (scans - 1) * PERIOD_NS,
            digest="0",
            preset=preset,
        )

    def records(self) -> Iterator[Record]:
        self.reads += 1
        drift = 0.01 * self.reads if self.drifts else 0.0
        for k in range(self.scans):
            if k == self.fails_at:
                raise SourceError("the file ends here", where=f"scan {k}")
            pose = Pose3.from_euler([0.1 * k + drift, 0, 0], 0, 0, 0)
            yield Odometry(START_NS + k * PERIOD_NS, pose)
            yield scan(k)

    def truth(self) -> Truth | None:
        return Truth(trees=self._truth) if self._truth else None

    def close(self) -> None:
        self.closed = True


@dataclass(frozen=True)
class FakeState:
    chain: int
    path: tuple[tuple[int, float], ...]


class FakeMapper:
    """Its pose is a checksum over all steps and parameters so far: any difference in history shows."""

    def __init__(self, parameters: Parameters, seed: int, timer: StageTimer = no_timer) -> None:
        self.parameters = parameters
        self._state = FakeState(seed, ())
        self._timer = timer
        self.graph, self.tree_landmarks = KeyframeGraph(), np.full(4, -1)

    def segment(self, step: Step) -> SegmentedScan:
        nothing = np.zeros((0, 3), np.float32)
        clusters = frame(step.index, step.scan.stamp_ns).clusters
        return SegmentedScan(
            nothing,
            nothing,
            np.zeros(0, np.int32),
            clusters,
            None,
            np.zeros(BINS),
            np.zeros(BINS),
            np.zeros(3),
            None,
            None,
            (),
            {},
        )

    def process(self, step: Step, _scan: SegmentedScan | None = None) -> Frame:
        odometry = step.T_odom_base or Pose2()
        with self._timer("chain"):
            seen = struct.pack(
                "<qqqdd",
                self._state.chain,
                step.index,
                step.scan.stamp_ns,
                odometry.x,
                self.parameters.clustering.eps,
            )
            chain = crc32(seen)
        if self.parameters.clustering.eps == 5.0:
            raise ZeroDivisionError("a fault on purpose")
        self._state = FakeState(chain, (*self._state.path, (step.scan.stamp_ns, float(chain))))
        return frame(step.index, step.scan.stamp_ns, x=float(chain), warnings=step.warnings)

    def snapshot(self) -> FakeState:
        return self._state

    def restore(self, state: FakeState) -> None:
        self._state = state

    @property
    def path(self) -> Path:
        return path([x for _, x in self._state.path], [stamp for stamp, _ in self._state.path])


def make_mapper(_source: SourceDescription, parameters: Parameters, seed: int, timer: StageTimer) -> Mapper:
    return cast(Mapper, FakeMapper(parameters, seed, timer))


def path(x: list[float], stamps: list[int] | None = None) -> Path:
    n = len(x)
    given = [START_NS + k * PERIOD_NS for k in range(n)] if stamps is None else stamps
    return Path(np.array(given, np.int64), np.array(x, np.float64), *(np.zeros(n) for _ in range(3)))


def trees(n: int = 0) -> Trees:
    """Trees in a row, the last one not confirmed."""
    k = np.arange(n)
    return Trees(
        number=k + 1,
        position=np.stack([2.0 * k, np.zeros(n)], axis=1),
        covariance=np.tile(np.diag([0.04, 0.01]), (n, 1, 1)),
        dbh=np.where(k % 2 == 0, 0.3, np.nan),
        dbh_sigma=np.where(k % 2 == 0, 0.01, np.nan),
        eccentricity=np.full(n, 6.0),
        observations=k + 5,
        coverage=np.full(n, np.pi),
        first_seen_ns=np.full(n, START_NS, np.int64),
        last_seen_ns=np.full(n, START_NS + PERIOD_NS, np.int64),
        confirmed=k < n - 1,
    )


def frame(
    index: int, stamp_ns: int, *, x: float = 0.0, n_trees: int = 0, warnings: tuple[str, ...] = ()
) -> Frame:
    clusters = Clusters(
        size=np.array([30]),
        centroid=np.zeros((1, 3)),
        eccentricity=np.array([np.inf]),
        centre=np.zeros((1, 2)),
        covariance=np.eye(2)[None],
        radius=np.array([np.nan]),
        radius_sigma=np.array([np.nan]),
        radial_std=np.zeros(1),
        arc=np.zeros(1),
        hidden=np.zeros(1, np.bool_),
        cut=np.zeros(1, np.bool_),
        extent=np.zeros((1, 3)),
        verdict=np.array([8], np.int32),
    )
    detections = Detections(
        cluster=np.zeros(0, np.int64),
        centre=np.zeros((0, 2)),
        covariance=np.zeros((0, 2, 2)),
        radius=np.zeros(0),
        radius_sigma=np.zeros(0),
        arc=np.zeros(0),
        eccentricity=np.zeros(0),
    )
    estimate = PoseEstimate(
        T_map_base=Pose2(x, 1.0, 0.1),
        covariance=np.diag([0.01, 0.01, 0.001]),
        particles=np.zeros((3, 3)),
        weights=np.full(3, 1 / 3),
        n_eff=3.0,
        landmarks=np.zeros((0, 2)),
    )
    return Frame(
        index=index,
        stamp_ns=stamp_ns,
        raw=np.ones((5, 3), np.float32),
        filtered=np.ones((4, 3), np.float32),
        labels=np.zeros(4, np.int32),
        clusters=clusters,
        detections=detections,
        estimate=estimate,
        T_odom_base=Pose2(x, 0.0, 0.0),
        sensor_offset=np.array([0.0, 0.0, 0.5]),
        trees=trees(n_trees),
        counts={"returns": 5},
        warnings=warnings,
    )


def truth_trees() -> TruthTrees:
    return TruthTrees(
        x=np.array([0.05, 2.0, 9.0]),
        y=np.array([0.0, 0.1, 0.0]),
        dbh=np.array([0.31, np.nan, 0.2]),
        kind=("tree", "tree", "pole"),
    )


def make_session(
    source: FakeSource,
    parameters: Parameters | None = None,
    compiling: Callable[[], Iterator[bool]] = lambda: iter(()),
) -> Session:
    """A session on a fake source (opened again and again) with fake mappers, and a compilation of any
    length."""

    def open_source(uri: str, _options: SourceOptions) -> Source:
        if uri == "missing:":
            raise SourceError("there is no such file", where=uri)
        source.closed = False
        source.description = replace(source.description, uri=uri)
        return source

    return Session(
        open_source=open_source,
        make_mapper=make_mapper,
        parameters=parameters or Parameters(),
        compiling=compiling,
    )


class FakeWorker(WorkerProcess):
    """Remembers what it was told."""

    pid: int | None = 1

    def __init__(self) -> None:
        self.commands: list[ToWorker] = []
        self.restarts = 0
        self.closed = False

    async def start(self, _on_message: OnMessage) -> None:
        pass

    async def send(self, command: ToWorker) -> None:
        self.commands.append(command)

    async def close(self) -> None:
        self.closed = True


def opened(
    uri: str = "fake:", preset: str = "forest", truth: TruthTrees | None = None, run: int = 1
) -> Opened:
    return Opened(uri=uri, kind="fake run", preset=preset, scans=5, end_s=0.4, truth=truth, run=run)
