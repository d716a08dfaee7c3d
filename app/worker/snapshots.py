"""States and parameters that a session keeps to step back in a run."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from copy import copy
from dataclasses import fields, is_dataclass
from typing import Generic, TypeVar

import numpy as np

from pipeline.config import Parameters
from pipeline.slam import Genealogy, Smoother

S = TypeVar("S")

_SPACING = 50
_MOST_STATES = 40
_MOST_BYTES = 256 << 20


def nbytes(state: object) -> int:
    """Return the number of bytes of all arrays in nested dataclasses, lists and tuples."""
    if isinstance(state, np.ndarray | Genealogy | Smoother):
        return state.nbytes
    if isinstance(state, list | tuple):
        return sum(map(nbytes, state))
    if is_dataclass(state):
        return sum(nbytes(getattr(state, field.name)) for field in fields(state))
    return 0


class Snapshots(Generic[S]):
    """States of the mapper by the number of scans they contain (0: before the first scan).

    At most 40 states and 256 MB are kept: beyond that, every second state is dropped and the spacing doubles,
    so that the memory is bounded for a run of any length. The first state is always kept.

    Args:
        start: State before the first scan.
        size_of: Returns the size of a state [bytes].
    """

    def __init__(self, start: S, size_of: Callable[[S], int] = nbytes) -> None:
        self._states: dict[int, S] = {0: start}
        self._sizes: dict[int, int] = {0: size_of(start)}
        self._size_of = size_of
        self._spacing = _SPACING

    @property
    def nbytes(self) -> int:
        """Total size of all states [bytes]."""
        return sum(self._sizes[n] for n in self._states)

    def within(self, most_bytes: int) -> Snapshots[S]:
        """Return a copy with every second state dropped until the size limit is met."""
        fewer = copy(self)
        while len(fewer._states) > 1 and fewer.nbytes > most_bytes:
            fewer._spacing *= 2
            fewer._states = {n: s for n, s in fewer._states.items() if n % fewer._spacing == 0}
        fewer._states, fewer._sizes = dict(fewer._states), {n: self._sizes[n] for n in fewer._states}
        return fewer

    def offer(self, scans: int, state: S) -> None:
        """Store a state if it is due."""
        if not self.is_due(scans):
            return
        self._states[scans], self._sizes[scans] = state, self._size_of(state)
        while len(self._states) > 1 and self._are_too_many():
            self._spacing *= 2
            self._states = {n: s for n, s in self._states.items() if n % self._spacing == 0}

    def _are_too_many(self) -> bool:
        return len(self._states) > _MOST_STATES or self.nbytes > _MOST_BYTES

    def is_due(self, scans: int) -> bool:
        """Return whether `offer` would store a state with this number of scans."""
        return scans % self._spacing == 0 and scans not in self._states

    def next_due(self, scans: int, most: int) -> int:
        """Return the next number of scans at which `offer` stores a state, at most `most`."""
        return min(scans - scans % self._spacing + self._spacing, most)

    def first(self, scans: int) -> dict[int, S]:
        """Return the states with at most this number of scans."""
        return {known: state for known, state in self._states.items() if known <= scans}

    def newest(self, scans: int) -> tuple[int, S]:
        """Return the newest state with at most this number of scans, and its number of scans."""
        best = max(n for n in self._states if n <= scans)
        return best, self._states[best]

    def forget_after(self, scans: int) -> None:
        """Drop the states with more scans."""
        self._states = {n: s for n, s in self._states.items() if n <= scans}


class ParameterHistory:
    """Parameters with which each scan of the run was mapped."""

    def __init__(self, parameters: Parameters) -> None:
        self._starts = [0]
        self._sets = [parameters]

    def at(self, index: int) -> Parameters:
        """Return the parameters with which a scan was or will be mapped."""
        return self._sets[bisect_right(self._starts, index) - 1]

    def until(self, scans: int) -> int:
        """Return the number of leading scans that were mapped with the parameters of the first scan."""
        return min([scans, *self._starts[1:2]])

    def were_always(self, parameters: Parameters, aside: set[str]) -> bool:
        """Return whether every scan was mapped with these values, except those of some stages."""
        wanted = parameters.model_dump(exclude=aside)
        return all(known.model_dump(exclude=aside) == wanted for known in self._sets)

    def set_from(self, index: int, parameters: Parameters) -> bool:
        """Set the parameters from a scan onwards and return whether any value changes.

        Without a change, the results of later scans remain valid.
        """
        if self.at(index) == parameters and self._starts[-1] <= index:
            return False
        kept = max(1, sum(start < index for start in self._starts))
        self._starts, self._sets = self._starts[:kept], self._sets[:kept]
        if index == 0:
            self._sets[0] = parameters
        elif self._sets[-1] != parameters:
            self._starts.append(index)
            self._sets.append(parameters)
        return True
