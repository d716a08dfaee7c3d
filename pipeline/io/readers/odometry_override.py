"""A source with the motion of another kind than its own."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Protocol

from pipeline.io.readers.base import Source, SourceDescription
from pipeline.io.readers.container import count_loss
from pipeline.types.records import Record, Truth


class Motion(Protocol):
    """Tells the motion of a source whose records it is given one by one.

    Attributes:
        losses: What got no pose, by reason.
    """

    losses: dict[str, int]

    def add(self, record: Record) -> Iterator[Record]:
        """The records that stand for one."""

    def end(self) -> None:
        """Every record from the first to the last was given."""


class WithMotion:
    """A source (see `Source`) through which the records of another go on their way.

    Args:
        source: Closed with this one.
        motion: Tells the odometry.
        digest: Of what else is read; "" for nothing.

    Attributes:
        source: As given.
    """

    def __init__(self, source: Source, motion: Motion, digest: str = "") -> None:
        self.source, self._motion = source, motion
        self._digest = digest

    @property
    def description(self) -> SourceDescription:
        """As the source's own, with odometry."""
        known = self.source.description
        digest = f"{known.digest}+{self._digest}" if self._digest else known.digest
        return replace(known, has_odometry=True, digest=digest)

    @property
    def losses(self) -> dict[str, int]:
        """What was left out, by reason."""
        total = dict(self.source.losses)
        for reason, count in self._motion.losses.items():
            count_loss(total, reason, count)
        return total

    def records(self, start_ns: int | None = None) -> Iterator[Record]:
        """Yield records in the order of time."""
        for record in self.source.records(start_ns):
            yield from self._motion.add(record)
        if start_ns is None:
            self._motion.end()

    def pass_on(self, record: Record) -> Iterator[Record]:
        """The records that stand for one of the source, where somebody else reads it (live)."""
        return self._motion.add(record)

    def truth(self) -> Truth | None:
        """That of the source."""
        return self.source.truth()

    def close(self) -> None:
        """Close the source."""
        self.source.close()
