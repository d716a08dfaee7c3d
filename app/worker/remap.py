"""The run mapped again with other parameters: a few scans at a time, while the run stands or goes on."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from app.dashboard.map_changes import MapChanges, changes_between
from app.explain.history import TreeHistory
from app.worker.snapshots import ParameterHistory, Snapshots, nbytes
from pipeline.config import Parameters
from pipeline.remapping import ClusterTable, Rerun
from pipeline.types.records import Frame, Path, Step

NOT_OF_THE_MAP = {"evaluation", "obstacles"}  # stages that do not change the map
MOST_MAPS = 2  # earlier maps that are kept for undo and redo
MOST_BYTES = 256 << 20  # of all earlier maps
MOST_SNAPSHOT_BYTES = 64 << 20  # of the snapshots of one earlier map; fewer make going back slower
NS = 1_000_000_000


class MapperLike(Protocol):
    """The part of `pipeline.mapper.Mapper` that a run uses; its state is opaque here."""

    parameters: Parameters

    def process(self, step: Step) -> Frame: ...
    def snapshot(self) -> Any: ...  # noqa: ANN401
    def restore(self, state: Any) -> None: ...  # noqa: ANN401
    @property
    def path(self) -> Path: ...


@dataclass(slots=True)
class RunRecord:
    """Record of the mapped scans: what the map itself does not hold.

    Attributes:
        history: Estimate of each tree over time.
        confirmed_s: Time at which each tree was first confirmed, by its number [s since the first scan].
        clusters: Clusters of all scans.
        time_s: Time of the last scan in the record.
    """

    history: TreeHistory = field(default_factory=TreeHistory)
    confirmed_s: dict[int, float] = field(default_factory=dict)
    clusters: ClusterTable = field(default_factory=ClusterTable)
    time_s: float = -math.inf

    def add(self, frame: Frame, start_ns: int) -> None:
        """Add a scan of a run whose first scan has the time `start_ns`. The record of this scan and of later
        ones is replaced, because the run went back."""
        self.history.record(frame, start_ns)
        self.clusters.record(frame)
        time_s = (frame.stamp_ns - start_ns) / NS
        if time_s <= self.time_s:
            self.confirmed_s = {number: at for number, at in self.confirmed_s.items() if at < time_s}
        self.time_s = time_s
        for number in frame.trees.number[frame.trees.confirmed].tolist():
            self.confirmed_s.setdefault(number, time_s)


@dataclass(slots=True, eq=False)
class RunMap:
    """A map of the scans of a run, with what is needed to go on from it and to go back in it.

    Attributes:
        parameters: Parameters that each scan was mapped with.
        mapper: The mapper.
        snapshots: Earlier states of the mapper.
        record: Record of the mapped scans.
        before: State of the mapper before the current scan; None before the first.
    """

    parameters: ParameterHistory
    mapper: MapperLike
    snapshots: Snapshots[Any]
    record: RunRecord = field(default_factory=RunRecord)
    before: Any = None

    @classmethod
    def fresh(cls, mapper: MapperLike, parameters: Parameters) -> RunMap:
        """A map without scans."""
        return cls(ParameterHistory(parameters), mapper, Snapshots(mapper.snapshot()))

    @property
    def nbytes(self) -> int:
        """Size of the states of the mapper."""
        return self.snapshots.nbytes + nbytes(self.before)


class Remapping:
    """A run that is mapped again from its first scan.

    Args:
        rerun: The rerun, with a fresh mapper.
        start_ns: Time of the first scan.

    Attributes:
        map: The new map, as far as it goes.
    """

    def __init__(self, rerun: Rerun, start_ns: int) -> None:
        self.rerun = rerun
        self.map = RunMap.fresh(rerun.mapper, rerun.mapper.parameters)
        self._start_ns = start_ns

    def work(self, scans: int, until: int) -> bool:
        """Map up to `scans` scans, until `until` are mapped; returns whether they are. Where the run went
        back meanwhile, the rerun goes back as well.

        Raises:
            StemmapError: A scan cannot be read again.
        """
        rerun, snapshots = self.rerun, self.map.snapshots
        if rerun.done > until:
            rerun.go_back(*snapshots.newest(until))
        for _ in range(min(scans, until - rerun.done)):
            if snapshots.is_due(rerun.done):
                snapshots.offer(rerun.done, rerun.mapper.snapshot())
            self.map.record.add(rerun.map_next(), self._start_ns)
        return rerun.done == until

    def finish(self) -> RunMap:
        """The new map. No more scans are mapped."""
        self.rerun.close()
        self.map.before = self.rerun.mapper.snapshot()
        return self.map


class EarlierMaps:
    """Maps of the same scans with earlier parameters, so that undo and redo need no rerun. Their number and
    their size are bounded."""

    def __init__(self) -> None:
        self._maps: list[RunMap] = []

    def __contains__(self, known: object) -> bool:
        return any(each is known for each in self._maps)

    def find(self, parameters: Parameters) -> RunMap | None:
        """The map that was made with these parameters, if any."""
        known = (m for m in self._maps if m.parameters.were_always(parameters, NOT_OF_THE_MAP))
        return next(known, None)

    def add(self, known: RunMap) -> None:
        """Keep a map in its state before the current scan."""
        known.mapper.restore(known.before)
        self._maps.append(replace(known, snapshots=known.snapshots.within(MOST_SNAPSHOT_BYTES)))
        while len(self._maps) > MOST_MAPS or sum(each.nbytes for each in self._maps) > MOST_BYTES:
            del self._maps[0]

    def remove(self, known: RunMap) -> None:
        """Forget a map."""
        self._maps = [each for each in self._maps if each is not known]

    def clear(self) -> None:
        """Forget all maps: the current scan is another one."""
        self._maps.clear()


@dataclass(slots=True)
class MapComparison:
    """The map before a change of parameters, with which the new map is compared.

    Changes of one step, as of a slider that is held, are compared with the map before the first of them.
    """

    _step: int | None = None
    _before: Frame | None = None

    def begin(self, step: int | None) -> None:
        """A change of parameters belongs to this step; None is a step of its own."""
        if step is None or step != self._step:
            self._before = None
        self._step = step

    def changes(
        self, shown: Frame, new: Frame, revision: int, time_s: float, confirmed_s: dict[int, float]
    ) -> MapChanges:
        """Differences between the map before the step and the new one.

        Args:
            shown: The current scan with the map so far.
            new: The same scan with the new map.
            revision: Revision of the parameters.
            time_s: Time of the scan [s since the first scan].
            confirmed_s: When each tree of the new map was confirmed [s].
        """
        if self._before is None or self._before.index != new.index:  # the run went on, or elsewhere
            self._before = shown
        return changes_between(self._before, shown, new, revision, time_s, confirmed_s)
