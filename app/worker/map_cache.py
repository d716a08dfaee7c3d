"""Maps that a run had at its standing scan under other parameters: undo and redo need not map it again."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from app.worker.remap import Remapping, Told
from app.worker.snapshots import ParameterHistory, Snapshots, nbytes
from pipeline.config import Parameters
from pipeline.mapper import Mapper
from pipeline.remapping import Basis, Journal, KeptScans, look_key

MOST = 2
MOST_BYTES = 256 << 20
MOST_STATES = 64 << 20  # of it, for the states of one map: with fewer it takes longer to go back in it


@dataclass(frozen=True, slots=True, eq=False)
class Left:
    """All that a run knew of its scans before the standing one, mapped with one set of parameters.

    Attributes:
        standing: Number of these scans.
        before: State of the mapper after them.
    """

    parameters: Parameters
    standing: int
    mapper: Mapper
    before: Any
    snapshots: Snapshots[Any]
    told: Told
    journal: Journal
    kept: KeptScans

    @classmethod
    def of(cls, remapping: Remapping, standing: int) -> Left:
        """What a rerun came to, which maps no more scans."""
        rerun = remapping.rerun
        rerun.stop_reading()  # its mapper holds it as long as the run goes on
        return cls(
            remapping.parameters,
            standing,
            rerun.mapper,
            rerun.mapper.snapshot(),
            remapping.snapshots,
            remapping.told,
            rerun.journal,
            rerun.kept,
        )

    @property
    def nbytes(self) -> int:
        """About what it takes."""
        return self.journal.nbytes + self.snapshots.nbytes + nbytes(self.before)

    def is_sound(self) -> bool:
        """Whether what is kept of its scans is still what these parameters look at."""
        return self.kept.holds(self.standing, look_key(self.parameters))


class LeftBehind:
    """The last few of them, which take a bounded memory together. All are of the same standing scan."""

    def __init__(self) -> None:
        self._left: list[Left] = []

    def __contains__(self, left: Left) -> bool:
        return any(one is left for one in self._left)

    def find(self, parameters: Parameters, aside: set[str]) -> Left | None:
        """The one that was mapped with these, those of some stages left aside."""
        for left in self._left:
            if ParameterHistory(left.parameters).were_always(parameters, aside) and left.is_sound():
                return left
        return None

    def add(self, left: Left, used: KeptScans) -> None:
        """Keep one; `used`: what the run keeps of its scans now."""
        left.mapper.restore(left.before)  # it lets go of what it made of the standing scan
        self._left.append(replace(left, snapshots=left.snapshots.within(MOST_STATES)))
        while len(self._left) > MOST or sum(one.nbytes for one in self._left) > MOST_BYTES:
            self.take(self._left[0], used)

    def take(self, left: Left, used: KeptScans) -> None:
        """Keep it no more."""
        self._left = [one for one in self._left if one is not left]
        self.close_unused(left.kept, used)

    def close_unused(self, kept: KeptScans, used: KeptScans) -> None:
        """Let go of what is kept of scans if neither the run nor one of these uses it."""
        if kept is not used and all(one.kept is not kept for one in self._left):
            kept.close()

    def forget(self, used: KeptScans) -> None:
        """Keep none: another scan will stand."""
        while self._left:
            self.take(self._left[0], used)


def basis_of(
    parameters: ParameterHistory,
    standing: int,
    mapper: Mapper,
    before: Any,  # noqa: ANN401 - a state, None before there is one
    snapshots: Snapshots[Any],
    journal: Journal,
) -> Basis:
    """What the scans of a run so far were mapped to with one set of parameters; see `Left`."""
    notes = journal.first(parameters.until(max(standing, 0)))
    states = snapshots.first(len(notes))
    if before is not None and before.path_length <= len(notes):
        states[before.path_length] = before
    return Basis.of(parameters.at(0), notes, states, mapper.path, mapper.motion)
