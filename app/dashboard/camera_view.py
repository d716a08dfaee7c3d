"""The picture of the standing scan for the page: asked of the mapping process, decoded and made smaller by a
process of its own, and kept for who asks for the same one."""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict
from typing import Any

from app.common.draw_picture import Drawing, draw_safely
from app.dashboard.camera_marks import marks_of, motion
from app.explain.client import NoStoryError, WorkerClient
from pipeline.types.records import Frame, Path

#: All browsers together get so many pictures a second at most.
_PAUSE_S = 0.3
_MOST_KEPT = 8


class CameraDesk:
    """Pictures of the run that is shown.

    Args:
        asking: Of the mapping process.
    """

    def __init__(self, asking: WorkerClient) -> None:
        self._asking = asking
        self._kept: OrderedDict[int, bytes] = OrderedDict()
        self._turn = asyncio.Lock()
        self._next_at = 0.0
        # Runs may have pictures of the same time, as simulated ones do, also after a restart.
        self._of = time.time_ns() // 1_000_000

    def forget(self) -> None:
        """Another run begins."""
        self._kept.clear()
        self._of += 1

    def jpeg(self, stamp_ns: int) -> bytes | None:
        """A picture that was told of lately."""
        return self._kept.get(stamp_ns)

    async def look(self, frame: Frame, path: Path | None) -> dict[str, Any]:
        """What is to be seen at the time of a scan: the picture's stamp, its marks, why there are none, and
        `of`, another number for each run.

        Args:
            frame: Of the scan.
            path: Of the run; it tells where the robot was when the picture was taken.

        Raises:
            NoStoryError: There is no picture, and why.
        """
        async with self._turn:
            of = self._of
            await asyncio.sleep(max(0.0, self._next_at - time.monotonic()))
            found = await self._asking.camera(frame.stamp_ns)
            self._check(of)
            picture = found.picture
            if picture.stamp_ns not in self._kept:
                content = await asyncio.to_thread(draw_safely, Drawing.of(picture))
                if content is None:
                    raise NoStoryError(
                        "this picture cannot be decoded", remedy="It is damaged, or of an unknown encoding"
                    )
                self._check(of)
                self._kept[picture.stamp_ns] = content
                while len(self._kept) > _MOST_KEPT:
                    self._kept.popitem(last=False)
            self._next_at = time.monotonic() + _PAUSE_S
        camera, moved = found.camera, motion(path, frame.stamp_ns, picture.stamp_ns)
        return {
            "index": frame.index,
            "of": of,
            "stamp_ns": str(picture.stamp_ns),  # more digits than a number of JavaScript has
            "later_ms": round((picture.stamp_ns - frame.stamp_ns) / 1e6),
            "marks": [] if camera is None else await asyncio.to_thread(marks_of, frame, camera, moved),
            "why": found.why,
            "told": found.told,
        }

    def _check(self, of: int) -> None:
        """Raises: NoStoryError: Another run was opened since."""
        if of != self._of:
            raise NoStoryError("another run was opened", remedy="Its picture comes with its first scan")
