"""The open run of a dashboard, located in the map of a stored one."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from app.common.timers import cancel

if TYPE_CHECKING:
    from app.dashboard.dashboard import Dashboard
    from app.extensions.maps.localisation import StoredMap
    from app.extensions.maps.localise import LocalisedRun
    from pipeline.types.records import Frame

_log = logging.getLogger(__name__)
PAUSE_S = 0.3  # between two looks at the newest scan; a search takes less


class Locating:
    """Locates the shown scans of a dashboard in a stored map. The work is done in a thread.

    Args:
        dashboard: The dashboard.
        tell: Called with the state for the browsers whenever it changes, see `as_plain`.

    Attributes:
        name: Name of the stored run; "" without one.
        stored: Its map; None without one.
    """

    def __init__(self, dashboard: Dashboard, tell: Callable[[dict[str, Any]], None]) -> None:
        self._dashboard, self._tell = dashboard, tell
        self._task: asyncio.Task[None] | None = None
        self._lock = asyncio.Lock()  # held by `begin`, `forget` and `close`, so that one task runs at a time
        self._run: LocalisedRun | None = None
        self._problem = ""
        self._serial = 0  # number of maps so far
        self.name = ""
        self.stored: StoredMap | None = None

    def as_plain(self) -> dict[str, Any]:
        """Return the state as a dict of JSON values: `name`; `serial`, which tells maps of one name apart;
        `state`, "idle", "searching", "found", "not_found", "absent" or "failed"; `text`; and `pose`, the
        frame of the stored map in that of the open run, [x, y, yaw] [m, m, rad], None unless found."""
        of = {"name": self.name, "serial": self._serial}
        if self.stored is None:
            return {**of, "state": "idle", "text": "", "pose": None}
        if self._problem:
            return {**of, "state": "failed", "text": self._problem, "pose": None}
        if self._run is None:
            return {**of, "state": "searching", "text": "not found yet", "pose": None}
        now = self._run.localisation
        there = None if now.T_map_odom is None else now.T_map_odom.inverse()
        pose = None if there is None else [round(float(value), 5) for value in there.as_array()]
        state = now.state.name.lower()
        text = f"{now.text}; play the run again to search more of it" if state == "not_found" else now.text
        return {**of, "state": state, "text": text, "pose": pose}

    async def begin(self, name: str, folder: Path) -> None:
        """Read a stored map and begin to locate the open run in it, in place of an earlier one.

        Args:
            name: Name of the stored run.
            folder: Its folder, which is read before this returns.

        Raises:
            StemmapError: The map cannot be read, or has no trees.
        """
        from app.extensions.maps.stored_map import read_stored_map
        from pipeline.errors import StemmapError

        async with self._lock:
            stored = await asyncio.to_thread(read_stored_map, folder)
            if not len(stored):
                raise StemmapError("the map has no trees", where=name)
            await self._end()
            self.name, self.stored, self._serial = name, stored, self._serial + 1
            self._task = asyncio.create_task(self._follow(stored))
            self._tell(self.as_plain())

    async def forget(self) -> None:
        """End it; nothing happens if there is none."""
        async with self._lock:
            await self._end()
            self._tell(self.as_plain())

    async def close(self) -> None:
        """End it with the server."""
        async with self._lock:
            await self._end()

    async def _end(self) -> None:
        """End the task and forget the map."""
        task, self._task = self._task, None
        await cancel(task)
        self.name, self.stored, self._run, self._problem = "", None, None, ""

    async def _follow(self, stored: StoredMap) -> None:
        """Locate each newest scan. After a jump back in time, and in another run, the search begins again;
        after a fault in another run only."""
        run, last = self._dashboard.run, -1
        before = self.as_plain()
        while True:
            if self._dashboard.run != run:
                run, self._run, self._problem = self._dashboard.run, None, ""
            shown = self._dashboard.shown
            if shown is not None and shown.run == run and shown.frame.of_drive and not self._problem:
                try:
                    last = await self._locate(stored, shown.frame, last)
                except Exception as error:
                    _log.exception("the localisation in the map of %s failed", self.name)
                    self._run, self._problem = None, f"the localisation failed: {error}"
            is_searched = self._dashboard.shown is shown  # no further scan has arrived meanwhile
            is_over = is_searched and self._dashboard.status.state in ("finished", "failed")
            if self._run is not None and is_over:
                self._run.localiser.end()
            if self._dashboard.run == run and (now := self.as_plain()) != before:
                before = now
                self._tell(now)
            await asyncio.sleep(PAUSE_S)

    async def _locate(self, stored: StoredMap, frame: Frame, last: int) -> int:
        """Locate a scan if it is not that of the time `last` [ns]; return its time [ns]."""
        from app.extensions.maps.localise import LocalisedRun

        if self._run is None or frame.stamp_ns < last:
            slack = self._dashboard.parameters.parameters.relocalisation.slack
            self._run = await asyncio.to_thread(LocalisedRun, stored, slack)
        elif frame.stamp_ns == last:
            return last
        await asyncio.to_thread(self._run.add, frame)
        return frame.stamp_ns
