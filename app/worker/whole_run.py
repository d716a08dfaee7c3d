"""The whole run mapped again with other parameters, as a session asks for it."""

from __future__ import annotations

from dataclasses import dataclass

from app.dashboard.map_changes import MapChanges, changes_between
from app.worker.run import Run
from pipeline.config import Parameters
from pipeline.types.records import Frame


@dataclass(slots=True)
class WholeRun:
    """What is asked for and not begun, and what it is compared with.

    Attributes:
        wanted_there: Begin once the sought scan is reached: until then nobody knows up to where.
    """

    wanted_there: bool = False
    _step: int | None = None
    _before: Frame | None = None  # the map before the step

    def begin(self, step: int | None) -> None:
        """A change comes; those of one step are compared with the map before the first of them."""
        if step is None or step != self._step:
            self._before = None
        self._step = step

    def arrived(self, run: Run, parameters: Parameters) -> bool:
        """The sought scan stands; what waited for it begins. Whether anything did."""
        wanted, self.wanted_there = self.wanted_there, False
        if wanted:
            run.remap(parameters)
        return wanted

    def work(self, run: Run, scans: int, revision: int, time_s: float) -> tuple[Frame, MapChanges] | None:
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
        shown = run.frame
        done = None if shown is None else run.remap_on(scans)
        if shown is None or done is None:
            return None
        frame, confirmed_s = done
        if self._before is None or self._before.index != frame.index:  # the run went on, or elsewhere
            self._before = shown
        return frame, changes_between(self._before, shown, frame, revision, time_s, confirmed_s)
