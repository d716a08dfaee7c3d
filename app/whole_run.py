"""The whole run mapped again with other parameters, as a session asks for it."""

from __future__ import annotations

from dataclasses import dataclass

from app.map_changes import MapChanges, changes_between
from app.run import Run
from pipeline.parameters import Parameters
from pipeline.records import Frame


@dataclass(slots=True)
class WholeRun:
    """What is asked for and not begun.

    Attributes:
        wanted_there: Begin once the sought scan is reached: until then nobody knows up to where.
    """

    wanted_there: bool = False

    def arrived(self, run: Run, parameters: Parameters) -> bool:
        """The sought scan stands; what waited for it begins. Whether anything did."""
        wanted, self.wanted_there = self.wanted_there, False
        if wanted:
            run.remap(parameters)
        return wanted

    @staticmethod
    def work(run: Run, scans: int, revision: int, time_s: float) -> tuple[Frame, MapChanges] | None:
        """Map so many scans more again.

        Args:
            run: That is mapped again.
            scans: At most.
            revision: Of the parameters that are tried.
            time_s: Of the standing scan.

        Returns:
            Once all are mapped, the standing scan with the new map and what it changes; before, None.

        Raises:
            StemmapError: A scan cannot be looked at again. The map stays as it is.
        """
        before = run.frame
        done = None if before is None else run.remap_on(scans)
        if before is None or done is None:
            return None
        frame, confirmed_s = done
        return frame, changes_between(before, frame, revision, time_s, confirmed_s)
