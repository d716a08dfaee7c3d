"""Where the maps of a fleet stand in one common frame: that of the first one, as far as stems agree."""

from __future__ import annotations

from typing import Any

from app.batch.compare import align
from pipeline.geometry.poses import Pose2

#: So many trees more than at the last try make another worth its second of computing.
MORE_TREES = 4
#: Fewer stems fix no pose.
LEAST_TREES = 6

Map = dict[str, Any]


class Frames:
    """Tries to lay each map upon the common one, one at a time.

    The first map with trees enough is the common frame. Two replays of one recording share their frame, for
    each begins where the recording does. All others are laid by their stems; what was laid stays until its
    robot opens another source.
    """

    def __init__(self) -> None:
        self._pose: dict[str, Pose2] = {}
        self._how: dict[str, str] = {}
        self._of: dict[str, str] = {}  # digest of the run that the two above were found for
        self._tried: dict[str, int] = {}  # trees at the last try
        self._few: set[str] = set()  # who had too few trees for a try
        self._first: tuple[str, str] | None = None

    def pose(self, name: str) -> Pose2 | None:
        """Where the frame of a map stands in the common one; None where it is not known."""
        return self._pose.get(name)

    def how(self, name: str) -> str:
        """How that is known, or why it is not, in words."""
        why = ": too few trees" if name in self._few else ""
        return self._how.get(name, f"its frame is not known yet{why}")

    async def try_one(self, maps: dict[str, tuple[str, Map]]) -> bool:
        """Lay one more map if any is worth a try; whether one was tried.

        Args:
            maps: The run's digest and the map (a list of trees as the page has them) by name.
        """
        self._forget(maps)
        self._few = {name for name, (_, shown) in maps.items() if len(shown["trees"]) < LEAST_TREES}
        for name, (digest, shown) in maps.items():
            count = len(shown["trees"])
            if self._first is None and count >= LEAST_TREES:
                self._first = (name, digest)
                self._set(name, digest, Pose2(), "the common frame")
            if self._first is None or name in self._pose:
                continue
            first, first_digest = self._first
            if digest and digest == first_digest:
                self._set(name, digest, Pose2(), f"the same recording as {first}")
                continue
            tried = self._tried.get(name)
            if count < LEAST_TREES or (tried is not None and count < tried + MORE_TREES):
                continue
            self._tried[name], self._of[name] = count, digest
            pose, how = await align({"map": maps[first][1]}, {"map": shown})
            self._set(name, digest, pose, how if pose is None else f"{how} of {first}")
            return True
        return False

    def _set(self, name: str, digest: str, pose: Pose2 | None, how: str) -> None:
        self._of[name], self._how[name] = digest, how
        if pose is not None:
            self._pose[name] = pose

    def _forget(self, maps: dict[str, tuple[str, Map]]) -> None:
        """What was known of runs that are left is known no more; without the first, nothing is."""
        if self._first is not None and maps.get(self._first[0], ("", {}))[0] != self._first[1]:
            self.__init__()  # type: ignore[misc]
            return
        for name, digest in list(self._of.items()):
            if maps.get(name, ("", {}))[0] != digest:
                for kept in (self._pose, self._how, self._of, self._tried):
                    kept.pop(name, None)
