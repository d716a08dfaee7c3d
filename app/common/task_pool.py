"""Where a command computes its tasks, if not in processes on this machine."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol


class TaskPool(Protocol):
    """Processes elsewhere that call functions of this program. An extension sets one as `pool` of the
    arguments of a command, see `takes` of `app.extension.Extension`; the command closes it."""

    @property
    def count(self) -> int:
        """Number of tasks that are computed at the same time."""

    def call(self, function: Callable[[bytes], bytes], task: bytes, place: int = 0) -> bytes:
        """Return the result of a function for a task. Several threads may wait for their results.

        Args:
            function: A function of a module of this program, which can be imported by its name.
            task: Its argument.
            place: From 0 to `count`; tasks with an equal place go to the same process where possible,
                because it may keep what an earlier task read.

        Raises:
            StemmapError: The task was lost several times, or the pool is closed.
        """

    def warnings(self) -> list[str]:
        """Return warnings on processes that were lost, for people."""

    def close(self, function: Callable[[], None]) -> None:
        """Cancel the tasks, call a function once in each process that can be reached, and leave the pool. A
        second call does nothing."""
