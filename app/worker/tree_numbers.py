"""Numbers of trees that stay the same while the run is mapped again.

A map numbers its trees in the order in which they begin, so another map of the same run has other numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.evaluation import match
from pipeline.geometry.columns import rows_of
from pipeline.types.records import Trees

Place = tuple[float, float]

SAME = 0.5  # largest distance of the same tree in two maps [m]


class TreeNumbers:
    """The numbers of the trees of a run as people see them.

    In the first map, the trees have the numbers of the map. In another map, a tree that is paired one to one
    within SAME (see `match`) with a confirmed tree of any earlier map has the number of that tree; other
    trees have new numbers.
    """

    def __init__(self) -> None:
        self._places: dict[int, Place] = {}  # last position of each confirmed tree
        self._present: set[int] = set()  # confirmed trees of the frame that was numbered last
        self._number_of: dict[int, int] | None = None  # by the number in the map; None for the first map
        self._next = 1

    def renumber(self, trees: Trees) -> Trees:
        """Return a copy of the trees of a frame of the present map with the numbers that people see. Trees
        without such a number get one, and the positions of confirmed trees are remembered."""
        numbers = trees.number
        if self._number_of is not None:
            known = self._number_of
            self._name({n: p for n, p in _places(trees, np.arange(len(numbers))).items() if n not in known})
            numbers = np.array([known[number] for number in numbers.tolist()], dtype=np.int64)
        confirmed = _places(replace(trees, number=numbers), np.flatnonzero(trees.confirmed))
        self._places.update(confirmed)
        self._present = set(confirmed)
        self._next = max(self._next, int(numbers.max(initial=0)) + 1)
        return replace(trees, number=numbers)

    def begin_map(self, trees: Trees, ended: Mapping[int, Place]) -> None:
        """Begin another map of the run, and give numbers to its trees: first to confirmed trees, then to
        other trees, then to trees that ended.

        Args:
            trees: Trees of the new map at the scan whose trees `renumber` numbered last.
            ended: Dict from the number in the new map of each tree that ended before this scan to its last
                position (x, y) [m].
        """
        self._number_of = {}
        self._name(_places(trees, np.flatnonzero(trees.confirmed)))
        self._name(_places(trees, np.flatnonzero(~trees.confirmed)))
        self._name(ended)

    def known(self, number: int) -> int | None:
        """Return the number that people see of the tree with this number in the present map; None if the tree
        was never numbered. In the first map it is `number` itself, which is not checked."""
        return number if self._number_of is None else self._number_of.get(number)

    def in_map(self, number: int) -> int | None:
        """Return the number in the present map of the tree whose number people see; None if the map has no
        such tree. In the first map it is `number` itself, which is not checked."""
        if self._number_of is None:
            return number
        return next((in_map for in_map, known in self._number_of.items() if known == number), None)

    def stored(self, trees: Trees) -> tuple[Trees, NDArray[np.int64]]:
        """Return a copy of the trees of an earlier frame of the present map with the numbers that people see,
        and their rows in `trees`, int64. Trees that were never numbered are left out: they ended in a rerun
        and were not confirmed."""
        known = [self.known(number) for number in trees.number.tolist()]
        rows = np.array([row for row, number in enumerate(known) if number is not None], np.int64)
        numbers = np.array([number for number in known if number is not None], np.int64)
        return replace(rows_of(trees, rows), number=numbers), rows

    def _name(self, places: Mapping[int, Place]) -> None:
        """Give numbers to trees of the present map. A tree that is paired within SAME with a confirmed tree
        of the last numbered frame gets its number; of the rest, a tree that is paired with an earlier
        confirmed tree gets its number; the others get new numbers in the order of `places`.

        Args:
            places: Dict from the number in the map of each tree without a number to its position (x, y) [m].
        """
        number_of = {} if self._number_of is None else self._number_of
        left = list(places)
        for present in (True, False):
            taken = set(number_of.values())
            free = [n for n in self._places if n not in taken and (n in self._present) is present]
            if not left or not free:
                continue
            found = match(_array([places[n] for n in left]), _array([self._places[n] for n in free]), SAME)
            number_of.update({n: free[k] for n, k in zip(left, found.tolist(), strict=True) if k >= 0})
            left = [n for n in left if n not in number_of]
        for n in left:
            number_of[n] = self._next
            self._next += 1


def _places(trees: Trees, rows: NDArray[np.int64]) -> dict[int, Place]:
    """Return a dict from the number of each tree in these rows to its position (x, y) in the map [m]."""
    places = [(x, y) for x, y in trees.position[rows].tolist()]
    return dict(zip(trees.number[rows].tolist(), places, strict=True))


def _array(places: list[Place]) -> NDArray[np.float64]:
    """Return positions as an array of shape (N, 2)."""
    return np.array(places, dtype=np.float64).reshape(-1, 2)
