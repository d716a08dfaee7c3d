"""A whole cloud as a run of one scan: its frame has the cloud, the candidates for stems and the trees.

The inventory is computed in steps, so that commands are executed between them. Parameters that change the map
begin another inventory; until it is complete, the map of the one before is shown.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import replace

import numpy as np

from app.batch.run_folder import NO_PATH
from app.batch.summary import FAR_FROM_PLOT
from app.common.timers import Stopwatch
from app.store.forests import kept_forests
from app.worker.protocol import RunCounts, RunCourse
from app.worker.tree_numbers import TreeNumbers
from pipeline.classification.column_extraction import BREAST
from pipeline.config import Parameters
from pipeline.errors import StemmapError
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.inventory import PARAMETERS, Inventory, PlotMap, finish
from pipeline.inventory.terrain_raster import TerrainRaster
from pipeline.io.block_file import LARGE
from pipeline.io.readers.base import FileSource, SourceDescription
from pipeline.types.records import (
    CloudDescription,
    Clusters,
    Detections,
    Float,
    Float32,
    Frame,
    HeightMap,
    Int32,
    Path,
    PoseEstimate,
    Record,
    Sensor,
    Trees,
    Verdict,
    WholeCloud,
    no_detections,
)


class CloudSource(FileSource):
    """A whole cloud as a source of one scan at time 0, without records.

    Attributes:
        cloud: The cloud.
    """

    def __init__(self, cloud: WholeCloud) -> None:
        super().__init__()
        self.cloud = cloud
        about = cloud.description
        self._description = SourceDescription(
            uri=about.uri,
            kind=f"whole cloud, {about.kind}",
            sensor=Sensor(name="whole cloud"),
            T_base_lidar=Pose3.identity(),
            has_odometry=False,
            has_imu=False,
            scans=1,
            start_ns=0,
            end_ns=0,
            digest=about.digest,
            warnings=about.warnings,
        )

    @property
    def losses(self) -> dict[str, int]:
        """Dict from reasons to numbers of points left out; not a copy."""
        return self.cloud.losses

    def records(self) -> Iterator[Record]:
        """Yield nothing: a whole cloud has no scans."""
        yield from ()


class InventoryRun:
    """A whole cloud whose stems are mapped. It has the interface of `app.worker.run.Run`, as far as a run of
    one scan needs it.

    Args:
        source: The cloud; `close` closes it.
        parameters: All parameters.

    Attributes:
        frame, confirmed_s: The map as a frame, and 0 for each of its trees [s]; None before it is complete.
        plot: The map in the frame of the cloud minus its offset; None before.
        current: 0 if there is a map, else -1.
    """

    odometry = ""
    is_bare = False
    is_whole = True
    start_ns = 0
    path: Path = NO_PATH
    cache_notice = ""

    def __init__(self, source: CloudSource, parameters: Parameters) -> None:
        self.source, self.warnings = source, source.description.warnings
        self.stopwatch = Stopwatch()
        self.frame: Frame | None = None
        self.confirmed_s: Float | None = None
        self.plot: PlotMap | None = None
        self.current = -1
        self._inventory = Inventory(source.cloud, kept_forests(), LARGE)
        self._parameters = self._mapped_with = parameters
        self._numbers = TreeNumbers()
        self._job: Generator[float, None, PlotMap] | None = None
        self._share = 0.0

    @property
    def about(self) -> CloudDescription:
        """Description of the cloud."""
        return self.source.cloud.description

    @property
    def share(self) -> float | None:
        """Share of the present inventory that is done, from 0 to 1; None if none is computed."""
        return None if self._job is None else self._share

    def counts(self, index: int) -> RunCounts:
        """Return the counts of the present map; empty before it is complete."""
        del index
        frame, plot = self.frame, self.plot
        if frame is None or plot is None:
            return RunCounts()
        far = {FAR_FROM_PLOT: plot.counts["apart from the plot"]}
        verdicts = Counter(Verdict(int(v)).label for v in plot.verdict)
        losses = {reason: n for reason, n in {**self.source.losses, **far}.items() if n}
        return RunCounts(
            verdicts=dict(sorted(verdicts.items())),
            losses=losses,
            warnings=list(plot.warnings),
            covered=plot.ground.covered_places(),
        )

    def kept(self, index: int) -> None:
        """Return None: the only scan is the current one."""
        del index

    @property
    def accumulated(self) -> Float32:
        """Points of the cross-sections: x, y and height above the ground, shape (N, 3) [m]; none before the
        map is complete."""
        if self.plot is None:
            return np.zeros((0, 3), np.float32)
        return self.plot.points[:, [0, 1, 3]].astype(np.float32)

    @property
    def odometry_xy(self) -> Float:
        """No positions, shape (0, 2)."""
        return np.zeros((0, 2))

    def course(self, names: Sequence[str], most: int, *, stages: bool) -> RunCourse:
        """Return a course without scans: a whole cloud has none. The arguments are ignored."""
        del names, most, stages
        return RunCourse(np.zeros(0, np.int64), np.zeros(0), {}, {}, [])

    def take_views(self) -> list[tuple[int, Float]]:
        """Return nothing: the area that a whole cloud covers does not come from views."""
        return []

    @property
    def known(self) -> int:
        """Number of scans that were read."""
        return self.current + 1

    def peek_ns(self) -> int | None:
        """Return 0 before the map is complete, else None."""
        return 0 if self.current < 0 else None

    def index_at(self, stamp_ns: int) -> int | None:
        """Return 0, the index of the only scan."""
        del stamp_ns
        return 0

    def stamp_ns(self, index: int) -> int:
        """Return the time of the only scan [ns]."""
        del index
        return 0

    def approach(self, index: int) -> None:
        """Do nothing: there is one scan."""

    def map_next(self, *, hurried: bool = False) -> Frame | None:
        """Compute the next step of the first inventory. Return the frame of the map if this step completed
        the map; None if it is not complete yet, or was complete before the call.

        Args:
            hurried: Ignored; it is there because `Run.map_next` has it.

        Raises:
            StemmapError: The cloud cannot be mapped; the next call begins the inventory again.
        """
        del hurried
        if self.current >= 0:
            return None
        if self._job is None:
            self._begin()
        return self.frame if self._advance() else None

    def use(self, parameters: Parameters, index: int) -> bool:
        """Use other parameters. If there is no map yet, or they change it, another inventory begins in place
        of one that is not complete. Returns False, since no scan is to be mapped again; `index` is
        ignored."""
        del index
        self._parameters = parameters
        before, now = self._mapped_with.flat(), parameters.flat()
        if self.current < 0 or any(before[name] != now[name] for name in PARAMETERS):
            self._begin()
        return False

    def remap(self, parameters: Parameters, on_preview: Callable[[Trees], None]) -> None:
        """Do nothing: `use` maps the whole cloud."""

    def cancel_remapping(self) -> None:
        """Leave an inventory that is not complete; the map does not change."""
        self._job = None

    @property
    def remapped(self) -> float | None:
        """Share of the inventory that replaces the map, from 0 to 1; None if there is none."""
        return self.share if self.current >= 0 else None

    def remap_next(self) -> tuple[Frame, dict[int, float]] | None:
        """Compute the next step of the inventory that replaces the map.

        Returns:
            The frame of the new map and a dict from each tree number to the confirmation time 0 [s]; None
            while the new map is not complete, and if no inventory is computed.

        Raises:
            StemmapError: The cloud cannot be mapped with these parameters. The map does not change.
        """
        if self._job is None or not self._advance() or self.frame is None:
            return None
        return self.frame, dict.fromkeys(self.frame.trees.number.tolist(), 0.0)

    def map_again(self) -> Frame | None:
        """Return the present frame; None before the map is complete."""
        return self.frame

    def map_with(self, sets: Sequence[Parameters]) -> list[Frame]:
        """Return the frame of the map with each set of parameters, with tree numbers of its own; the run does
        not change.

        Raises:
            StemmapError: The cloud cannot be mapped with a set.
        """
        return [_frame_of(finish(self._inventory.steps(each))) for each in sets]

    def parameters_at(self, index: int) -> Parameters:
        """Return the parameters of the present map, which are the same for all scans; `index` is ignored."""
        del index
        return self._mapped_with

    def close(self) -> None:
        """Close the cloud and delete the temporary file."""
        self._job = None
        self._inventory.close()
        self.source.close()

    def row_of(self, number: int) -> int:
        """Return the row of a tree in the map.

        Raises:
            StemmapError: There is no such tree.
        """
        rows = [] if self.frame is None else np.flatnonzero(self.frame.trees.number == number).tolist()
        if not rows:
            raise StemmapError(f"there is no tree {number} in the map", remedy="Select another")
        return int(rows[0])

    def _begin(self) -> None:
        """Begin an inventory with the present parameters."""
        self._job, self._share = self._inventory.steps(self._parameters), 0.0

    def _advance(self) -> bool:
        """Compute the next step of the inventory.

        Returns:
            Whether this step completed the map, which is then the current one. False if there is no
            inventory.

        Raises:
            StemmapError: The cloud cannot be mapped. As after any other exception, the inventory is abandoned
                and the current map does not change.
        """
        job = self._job
        if job is None:
            return False
        try:
            with self.stopwatch.aside():
                self._share = next(job)
        except StopIteration as end:
            self._job = None
            self._take(end.value)
            return True
        except BaseException:
            self._job = None
            raise
        return False

    def _take(self, plot: PlotMap) -> None:
        """Make a map the present one; trees that stayed keep their numbers."""
        frame = _frame_of(plot)
        if self.current >= 0:
            self._numbers.begin_map(frame.trees, {})
        self.frame = replace(frame, trees=self._numbers.renumber(frame.trees))
        self.confirmed_s = np.zeros(len(frame.trees.number))
        self.plot, self.current, self._mapped_with = plot, 0, self._parameters


def _frame_of(plot: PlotMap) -> Frame:
    """Return a map of a cloud as a frame. The pose is the middle of the plot with yaw 0 and `base_z` the
    ground there; points and clusters are relative to it. `filtered` has the thinned points, `raw` none. The
    label of a point is the row of the candidate to whose crown or stem it belongs, -1 if there is none."""
    middle = plot.ground.low + 0.5 * plot.ground.cell * np.array(plot.ground.height.shape)
    base_z = float(plot.ground.at(middle[:1], middle[1:])[0])
    points = (plot.whole[:, :3] - np.append(middle, base_z)).astype(np.float32)
    labels = np.append(plot.tree_candidate, -1).astype(np.int32)[plot.crowns.tree]
    clusters = _clusters_of(plot, middle, base_z, labels)
    return Frame(
        index=0,
        stamp_ns=0,
        raw=np.zeros((0, 3), np.float32),
        filtered=points,
        labels=labels,
        clusters=clusters,
        detections=_detections_of(clusters),
        estimate=PoseEstimate(
            T_map_base=Pose2(float(middle[0]), float(middle[1]), 0.0),
            covariance=np.zeros((3, 3)),
            particles=np.zeros((0, 3)),
            weights=np.zeros(0),
            n_eff=0.0,
            landmarks=np.zeros((0, 2)),
        ),
        T_odom_base=Pose2(),
        sensor_offset=np.zeros(3),
        trees=plot.trees,
        counts=plot.counts,
        warnings=plot.warnings,
        ground=_height_map(plot.ground),
        base_z=base_z,
        of_cloud=True,
    )


def _clusters_of(plot: PlotMap, middle: Float, base_z: float, labels: Int32) -> Clusters:
    """Return the candidates as clusters; eccentricity, covariance and `radius_sigma` are NaN. A candidate
    without a circle has the extent of a thin box at breast height.

    Args:
        plot: The map.
        middle, base_z: Origin of the frame of the clusters: x, y, shape (2,), and z in the map [m].
        labels: Row of the candidate of each thinned point, shape (N,), -1 for none.
    """
    stems, n = plot.stems, len(plot.stems)
    nan = np.full(n, np.nan)
    foot = plot.ground.at(plot.place[:, 0], plot.place[:, 1]) - base_z
    # A candidate without a circle is shown as a thin box at breast height.
    low = np.nan_to_num(stems["first"], nan=BREAST - 1.0)
    radius = np.maximum(stems["radius"], 0.0)  # a line through circles of another height may end before
    width = 2.0 * np.nan_to_num(radius, nan=0.1)
    height = np.nan_to_num(stems["last"] - stems["first"], nan=1.0)
    size = np.maximum(np.bincount(labels[labels >= 0], minlength=n), np.nan_to_num(stems["points"]))
    return Clusters(
        size=size.astype(np.int64),
        centroid=np.column_stack([plot.place - middle, foot + low + 0.5 * height]),
        eccentricity=nan,
        centre=plot.place - middle,
        covariance=np.tile(np.eye(2) * np.nan, (n, 1, 1)),
        radius=radius,
        radius_sigma=nan,
        radial_std=stems["scatter"].copy(),
        arc=stems["coverage"].copy(),
        extent=np.column_stack([width, width, height]),
        hidden=np.zeros(n, np.bool_),
        cut=np.zeros(n, np.bool_),
        verdict=plot.verdict,
    )


def _detections_of(clusters: Clusters) -> Detections:
    """Return the trees among the clusters as detections."""
    rows = np.flatnonzero(clusters.verdict == Verdict.TREE)
    return replace(
        no_detections(),
        cluster=rows,
        centre=clusters.centre[rows],
        covariance=clusters.covariance[rows],
        radius=clusters.radius[rows],
        radius_sigma=clusters.radius_sigma[rows],
        arc=clusters.arc[rows],
        eccentricity=clusters.eccentricity[rows],
    )


def _height_map(ground: TerrainRaster) -> HeightMap:
    """Return the visible ground as a height map whose cells begin at multiples of the cell size. Standard
    deviations are NaN, and each cell has one view."""
    cell = ground.cell
    first = np.floor(ground.low / cell).astype(np.int64)
    place = np.argwhere(np.ones(np.array(ground.height.shape) + 1, np.bool_)) + first
    centre = ((place + 0.5) * cell).astype(np.float64)
    there = np.floor((centre - ground.low) / cell).astype(np.int64)
    inside = np.flatnonzero(((there >= 0) & (there < ground.seen.shape)).all(axis=1))
    inside = inside[ground.seen[tuple(there[inside].T)]]
    place, centre = place[inside], centre[inside]
    return HeightMap(
        cell=cell,
        place=place.astype(np.int32),
        height=ground.at(centre[:, 0], centre[:, 1]).astype(np.float32),
        sigma=np.full(len(place), np.nan, np.float32),
        views=np.ones(len(place), np.int32),
    )
