"""A whole cloud as a source that is mapped in one step."""

from __future__ import annotations

from collections import Counter
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from app.explain.records import ClusterStory, TreeStory
from app.extensions.clouds import stories
from app.extensions.clouds.frame import frame_of
from app.extensions.clouds.inventory import PARAMETERS, Inventory, PlotMap
from app.extensions.clouds.plot_ground import FAR_FROM_PLOT
from app.extensions.clouds.records import WholeCloud
from app.sources.one_step import OneStep, OneStepSource
from app.store.forests import kept_forests
from app.worker.protocol import RunCounts
from pipeline.config import Parameters
from pipeline.geometry.file_arrays import LARGE
from pipeline.geometry.poses import Pose3
from pipeline.io.readers.base import SourceDescription
from pipeline.types.records import Float, Float32, Frame, Sensor, Verdict


class CloudSource(OneStepSource):
    """A whole cloud.

    Args:
        cloud: The cloud.
    """

    def __init__(self, cloud: WholeCloud) -> None:
        super().__init__()
        self._cloud = cloud
        self._inventory = Inventory(cloud, kept_forests(), LARGE)
        known = cloud.description
        self.about = OneStep(
            tuple(known.offset.tolist()),
            known.crs,
            known.points,
            list(PARAMETERS),
            known.crs_unit,
            known.unit,
            known.up,
        )
        self.is_cut_above = known.cut_above
        self._description = SourceDescription(
            uri=known.uri,
            kind=f"whole cloud, {known.kind}",
            sensor=Sensor(name="whole cloud"),
            T_base_lidar=Pose3.identity(),
            has_odometry=False,
            has_imu=False,
            scans=1,
            start_ns=0,
            end_ns=0,
            digest=known.digest,
            warnings=known.warnings,
        )

    @property
    def losses(self) -> dict[str, int]:
        """Dict from reasons to numbers of points left out; not a copy."""
        return self._cloud.losses

    def steps(self, parameters: Parameters) -> Generator[float, None, CloudMap]:
        """Map the cloud, see `Inventory.steps`."""
        return CloudMap((yield from self._inventory.steps(parameters)), self.losses)

    def points(self) -> Iterator[Float]:
        """Yield the points in the coordinates of the file, shape (N, 3) [m]."""
        for part in self._cloud.parts():
            yield part[:, :3].astype(np.float64) + self._cloud.description.offset

    def close(self) -> None:
        """Delete the temporary file."""
        self._inventory.close()


@dataclass(eq=False)
class CloudMap:
    """The map of a whole cloud.

    Attributes:
        plot: The map in the frame of the cloud minus its offset.
        losses: Dict from reasons to numbers of points that were left out when the cloud was read.
    """

    plot: PlotMap
    losses: dict[str, int]

    @cached_property
    def frame(self) -> Frame:
        """The map as a frame."""
        return frame_of(self.plot)

    @cached_property
    def accumulated(self) -> Float32:
        """Points of the cross-sections: x, y and height above the ground, shape (N, 3) [m]."""
        return self.plot.points[:, [0, 1, 3]].astype(np.float32)

    def counts(self) -> RunCounts:
        """Return the counts of the map."""
        far = {FAR_FROM_PLOT: self.plot.counts["apart from the plot"]}
        verdicts = Counter(Verdict(int(v)).label for v in self.plot.verdict)
        return RunCounts(
            verdicts=dict(sorted(verdicts.items())),
            losses={reason: n for reason, n in {**self.losses, **far}.items() if n},
            warnings=list(self.plot.warnings),
            covered=self.plot.ground.covered_places(),
        )

    def tree_story(self, frame: Frame, row: int, parameters: Parameters) -> TreeStory:
        """Return the explanation of a tree."""
        return stories.tree_story(self.plot, frame, row, parameters)

    def cluster_story(self, frame: Frame, row: int, parameters: Parameters) -> ClusterStory:
        """Return the explanation of a candidate."""
        return stories.cluster_story(self.plot, frame, row, parameters)
