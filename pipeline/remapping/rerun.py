"""A run mapped again from what its scans showed, with other parameters from the first scan on."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from itertools import dropwhile

from pipeline.errors import StemmapError
from pipeline.front_end import SegmentedScan
from pipeline.mapper import Mapper, MapperState
from pipeline.remapping.cache_key import look_key
from pipeline.remapping.journal import Journal
from pipeline.remapping.resume_point import Basis
from pipeline.remapping.retracking import Recalled, Tail
from pipeline.remapping.scan_cache import DamagedError, KeptScans
from pipeline.types.records import Frame, Step

Reread = Callable[[], Iterator[Step]]
Ahead = Callable[[Callable[[Step], SegmentedScan], Iterator[Step]], Iterator[tuple[Step, SegmentedScan]]]


def one_by_one(
    look: Callable[[Step], SegmentedScan], steps: Iterator[Step]
) -> Iterator[tuple[Step, SegmentedScan]]:
    """Each step with what it shows."""
    return ((step, look(step)) for step in steps)


class Rerun:
    """Maps the scans of a run one after the other; the map is that which `Mapper.process` would give.

    Where a run with other parameters is known, the scans before the first one that the change touches are
    passed over; where it touches nothing before the tracking, trees alone are tracked anew. What was kept is
    used where the parameters look at a scan in the same way; else all scans are read once more, and what they
    show now is kept beside.

    Args:
        mapper: Fresh, with the parameters that are tried.
        kept: The scans. More may come while the rerun goes on.
        reread: The steps of the run from its first on; None where they come only once.
        basis: What is known of the run with other parameters; of the same seed and sensor.
        ahead: How scans are looked at that are read once more: one by one, or ahead of the mapping.

    Attributes:
        journal: What the stages make of each scan.
        passed: Scans that are as they were and were not mapped again.
    """

    def __init__(
        self,
        mapper: Mapper,
        kept: KeptScans,
        reread: Reread | None = None,
        basis: Basis | None = None,
        ahead: Ahead = one_by_one,
    ) -> None:
        self.mapper = mapper
        self.journal = Journal()
        self.passed = 0
        self._kept = kept
        self._key = look_key(mapper.parameters)
        self._next = self._stop = 0
        self._reread, self._ahead = reread, ahead
        self._steps: Iterator[tuple[Step, SegmentedScan]] | None = None
        self._fresh: KeptScans | None = None
        self._tail: Tail | None = None
        self._until = 0  # scans that are tracked anew alone
        mapper.note = lambda noted: self.journal.note(noted, mapper.parameters.slam)
        if basis is not None:
            self._go_on_from(basis)

    @property
    def done(self) -> int:
        """Scans that are mapped."""
        return self._next

    @property
    def tracks_alone(self) -> bool:
        """Whether of the next scan the trees alone are found anew, which takes next to nothing."""
        return self._tail is not None

    @property
    def kept(self) -> KeptScans:
        """What the scans show to these parameters, as far as they are mapped."""
        return self._kept if self._fresh is None else self._fresh

    def frames(self, scans: int) -> Generator[Frame | Recalled, None, None]:
        """Map on until so many scans are mapped; the frames have no points and no clearance, unless the
        scans were read once more. Scans of which the trees alone are found anew are told some at a time.

        Raises:
            StemmapError: A scan is not kept and cannot be read once more, or what was kept is damaged.
        """
        while self._tail is not None and self._next < scans:
            recalled = self._tracked(self._tail, scans)
            self._next = recalled.index + 1
            yield recalled
        if self._next == scans:
            return
        self._stop = scans
        for step, scan in self._shown():
            self._next += 1
            yield self.mapper.process(step, scan)

    def state(self) -> MapperState | None:
        """All that is known once the frames that were asked for are given; None where no mapper was."""
        return self.mapper.snapshot() if self._tail is None else self._tail.state()

    def go_back(self, scans: int, state: MapperState) -> None:
        """Stand where so many scans were mapped, with the state that the mapper had then."""
        self._next, self._steps, self._tail = scans, None, None
        self.mapper.restore(state)

    def stop_reading(self) -> None:
        """Let go of the source, and of what was looked at ahead: no more scans are mapped."""
        self._steps = None

    def close(self) -> None:
        """Forget what was kept beside."""
        self.stop_reading()
        if self._fresh is not None:
            self._fresh.close()

    def _go_on_from(self, basis: Basis) -> None:
        scans, anew = basis.begin(self.mapper.parameters, self._kept.clusters)
        if scans == 0:
            return
        notes = basis.notes.first(scans)
        self.journal.take(notes)
        state = basis.states[0] if anew else basis.states[scans]
        self.mapper.load(state, basis.stamp_ns, basis.sigma_xy, basis.motion)
        if anew:
            states = {known: basis.states[known] for known in basis.states if known <= scans}
            self._tail, self._until = Tail(self.mapper.parameters, notes, states), scans
        else:
            self._next = self.passed = scans

    def _tracked(self, tail: Tail, scans: int) -> Recalled:
        recalled = tail.track(min(scans, self._until))
        state = tail.state() if tail.done == self._until else None
        if state is not None:
            self.mapper.restore(state)
            self._tail = None
        return recalled

    def _shown(self) -> Iterator[tuple[Step, SegmentedScan]]:
        """What the scans show that are asked for."""
        index = self._next
        while index < self._stop:
            yield self._shown_by(index)
            index += 1

    def _shown_by(self, index: int) -> tuple[Step, SegmentedScan]:
        kept = self.kept
        if kept.has(index, self._key):
            try:
                return kept.scan(index)
            except DamagedError:
                if self._reread is None:
                    raise
                kept.forget_from(index)
        step, looked = self._read_on(index)
        self.kept.put(step, looked, self._key)
        return step, looked

    def _read_on(self, index: int) -> tuple[Step, SegmentedScan]:
        if self._reread is None:
            raise StemmapError(
                "the scans of a live run cannot be read once more, and what these parameters change has to "
                "be looked for in them",
                remedy="Open the recording of the run",
            )
        if self._steps is None:
            left = dropwhile(lambda step: step.index != index, self._reread())
            self._steps = self._ahead(self.mapper.segmenter(), left)
            if self._fresh is None:
                self._fresh = self._begun_anew(index)
        for step, looked in self._steps:
            if step.index == index:
                return step, looked
        raise StemmapError(f"the source does not give scan {index} again", remedy="Open it anew")

    def _begun_anew(self, index: int) -> KeptScans:
        """What is kept before a scan, in a file of its own."""
        fresh = KeptScans(self._kept.folder)
        for k in range(index):
            fresh.put(*self._kept.scan(k), self._key)
        return fresh
