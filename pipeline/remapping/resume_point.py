"""From which scan on a change acts: the run before it is gone on from there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pipeline.config import Parameters
from pipeline.geometry.poses import Float
from pipeline.mapper import MapperState
from pipeline.remapping.clusters import ClusterTable
from pipeline.remapping.notes import Notes
from pipeline.tracking.kalman import COMPILED
from pipeline.types.records import Int, Path

# What a scan shows hangs on these, and where it was taken on those: nothing of the run before holds to the
# byte where one of them changes.
LOOK = ("acquisition", "filters", "ground", "clustering", "shape")
POSES = ("slam", "relocalisation")
LATE = {"tree_share"}  # of the gathering: it only turns votes into verdicts
GATHERED = ("acquisition", "filters", "ground")  # what is gathered of a scan hangs on these,
AFTERWARDS = {"voxel_size"}  # but not on what follows of them


@dataclass(frozen=True, slots=True, eq=False)
class Basis:
    """A run that was mapped with one set of parameters from its first scan on.

    Attributes:
        parameters: The set.
        notes: Of its scans, see `Journal`.
        states: Of its mapper by the number of scans they hold, that before the first among them.
        stamp_ns, sigma_xy, motion: Of its path, as `Mapper.load` takes them, as long as any state's.
        path: x, y [m], yaw [rad] of the base in the map as it is known at the end, behind all loops, shape
            (N, 3), as long as the notes.
    """

    parameters: Parameters
    notes: Notes
    states: Mapping[int, MapperState]
    stamp_ns: Int
    sigma_xy: Float
    motion: Float
    path: Float

    @classmethod
    def of(
        cls,
        parameters: Parameters,
        notes: Notes,
        states: Mapping[int, MapperState],
        path: Path,
        motion: Float,
    ) -> Basis:
        """With the path of the mapper, and its motion."""
        poses = np.stack([path.x, path.y, path.yaw], axis=1)
        return cls(parameters, notes, states, path.stamp_ns, path.sigma_xy, motion, poses)

    def shows_as(self, parameters: Parameters) -> bool:
        """Whether other parameters find the same clusters and gather in the same way."""
        looks = all(getattr(self.parameters, stage) == getattr(parameters, stage) for stage in LOOK)
        return looks and self.gathers_as(parameters)

    def gathers_as(self, parameters: Parameters) -> bool:
        """Whether other parameters gather what a scan shows in the same way."""
        before, now = self.parameters.classification, parameters.classification
        return before.model_dump(exclude=LATE) == now.model_dump(exclude=LATE)

    def gathers_the_same(self, parameters: Parameters) -> bool:
        """Whether the same is gathered of each scan, whatever clusters there are."""
        kept = [
            [getattr(p, stage).model_dump(exclude=AFTERWARDS) for stage in GATHERED]
            for p in (self.parameters, parameters)
        ]
        return kept[0] == kept[1] and self.gathers_as(parameters)

    def looking_as_before(self, parameters: Parameters) -> Parameters:
        """The other parameters, with those of what a scan shows as they were."""
        return parameters.model_copy(update={stage: getattr(self.parameters, stage) for stage in LOOK})

    def holds_for(self, parameters: Parameters) -> bool:
        """Whether other parameters find the same clusters, and ask for poses and gather in the same way."""
        same = all(getattr(self.parameters, stage) == getattr(parameters, stage) for stage in POSES)
        return same and self.shows_as(parameters)

    def begin(self, parameters: Parameters, clusters: ClusterTable) -> tuple[int, bool]:
        """Where other parameters can begin: with the state of so many scans, and whether the trees of these
        scans must be tracked anew (see `Tail`).

        Args:
            parameters: That are tried.
            clusters: Of at least as many scans as there are notes, or what is behind them is not used.
        """
        before, now = self.parameters, parameters
        if not self.holds_for(now):
            return 0, False
        same = min(len(self.notes), len(clusters))
        if before.detection != now.detection:
            same = clusters.first_judged_otherwise(before.detection, now.detection, same)
        late = before.tracking != now.tracking or before.classification != now.classification
        if late and now.tracking.engine != COMPILED:
            return 0, False
        if late:
            same = min([same, *np.flatnonzero(~self.notes.is_usual[:same])[:1].tolist()])
        scans = max(known for known in self.states if known <= same)
        return scans, late and scans > 0
