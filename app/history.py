"""What a session remembers of a run, to go back in it: states of the mapper, and which parameters were
in force from which scan on."""

from __future__ import annotations

from bisect import bisect_right
from typing import Generic, TypeVar

from pipeline.parameters import Parameters

S = TypeVar("S")

_SPACING = 50
_MOST_STATES = 40


class Snapshots(Generic[S]):
    """States of the mapper by the number of scans they hold (0: before the first).

    At most 40 are kept: when there are more, every second goes and the spacing doubles, so that a run
    of any length takes the same memory.
    """

    def __init__(self, start: S) -> None:
        self._states: dict[int, S] = {0: start}
        self._spacing = _SPACING

    def offer(self, scans: int, state: S) -> None:
        """Keep a state if it is due."""
        if scans % self._spacing or scans in self._states:
            return
        self._states[scans] = state
        if len(self._states) > _MOST_STATES:
            self._spacing *= 2
            self._states = {n: s for n, s in self._states.items() if n % self._spacing == 0}

    def newest(self, scans: int) -> tuple[int, S]:
        """The newest state that holds at most so many scans, with its number of scans."""
        best = max(n for n in self._states if n <= scans)
        return best, self._states[best]

    def forget_after(self, scans: int) -> None:
        """Drop the states that hold more scans."""
        self._states = {n: s for n, s in self._states.items() if n <= scans}


class ParameterHistory:
    """Which parameters each scan of the run was mapped with."""

    def __init__(self, parameters: Parameters) -> None:
        self._starts = [0]
        self._sets = [parameters]

    def at(self, index: int) -> Parameters:
        """The parameters that a scan was or will be mapped with."""
        return self._sets[bisect_right(self._starts, index) - 1]

    def set_from(self, index: int, parameters: Parameters) -> bool:
        """From a scan on, these are in force. Returns whether anything became different: if not,
        what is known of later scans still holds."""
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
