"""The open run of a dashboard, located in the map of a stored one."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from app.common.timers import cancel

if TYPE_CHECKING:
    from app.dashboard.dashboard import Dashboard
    from app.extensions.maps.localise import LocalisedRun
    from pipeline.localisation import StoredMap

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
        self._run: LocalisedRun | None = None
        self.name = ""
        self.stored: StoredMap | None = None

    def as_plain(self) -> dict[str, Any]:
        """Return the state as a dict of JSON values: `name`; `state`, "idle", "searching", "found" or
        "absent"; `text`; and `pose`, the frame of the stored map in that of the open run, [x, y, yaw] [m, m,
        rad], None unless found."""
        if self.stored is None:
            return {"name": "", "state": "idle", "text": "", "pose": None}
        if self._run is None:
            return {"name": self.name, "state": "searching", "text": "not found yet", "pose": None}
        now = self._run.localisation
        there = None if now.T_map_odom is None else now.T_map_odom.inverse()
        pose = None if there is None else [round(float(value), 5) for value in there.as_array()]
        return {"name": self.name, "state": now.state.name.lower(), "text": now.text, "pose": pose}

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

        stored = await asyncio.to_thread(read_stored_map, folder)
        if not len(stored):
            raise StemmapError("the map has no trees", where=name)
        await self.forget()
        self.name, self.stored = name, stored
        self._task = asyncio.create_task(self._follow(stored))
        self._tell(self.as_plain())

    async def forget(self) -> None:
        """End it; nothing happens if there is none."""
        task, self._task = self._task, None
        await cancel(task)
        self.name, self.stored, self._run = "", None, None
        self._tell(self.as_plain())

    async def close(self) -> None:
        """End it with the server."""
        await cancel(self._task)

    async def _follow(self, stored: StoredMap) -> None:
        """Locate each newest scan. After a jump back in time, and in another run, the search begins again."""
        from app.extensions.maps.localise import LocalisedRun

        last: tuple[int | None, int] | None = None
        told = self.as_plain()
        while True:
            shown = self._dashboard.shown
            if shown is not None and shown.frame.of_drive:
                at = (self._dashboard.run, shown.frame.stamp_ns)
                if last is None or at[0] != last[0] or at[1] < last[1]:
                    slack = self._dashboard.parameters.parameters.relocalisation.slack
                    self._run, last = await asyncio.to_thread(LocalisedRun, stored, slack), None
                if at != last and self._run is not None:
                    last = at
                    await asyncio.to_thread(self._run.add, shown.frame)
                    if (now := self.as_plain()) != told:
                        told = now
                        self._tell(now)
            await asyncio.sleep(PAUSE_S)
