"""What does the jobs, wherever it runs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class Done:
    """A worker has answered."""

    worker: str
    answer: bytes


@dataclass(frozen=True, slots=True)
class Lost:
    """A worker ended, or left, before it answered."""

    worker: str
    reason: str


Told = Done | Lost


class Workers(Protocol):
    """Workers that do a job each at a time. Those that end are replaced, or not: `free` says who is there."""

    def free(self) -> list[str]:
        """The workers that wait for a job, by name."""

    def give(self, worker: str, job: bytes) -> None:
        """Give a free worker a job."""

    def told(self, patience_s: float, /) -> list[Told]:
        """What came of the jobs meanwhile; waits so long where nothing did."""

    def close(self) -> None:
        """End all that is being done."""
