"""Free places: where something can stand without touching its neighbours or the robot's course."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from pipeline.errors import SourceError
from pipeline.simulation.trajectory import Course
from pipeline.types.records import Float

# Places are drawn few at a time while there is room, and many when the plot grows full.
_BATCHES = (8, 16, 32, 64, 128, *[256] * 36)


class Plot:
    """A square plot with a course through it, and what stands there already."""

    def __init__(self, course: Course, half_side: float) -> None:
        line = np.stack([course.x, course.y], axis=1)[::5]
        self.centre = 0.5 * (line.min(axis=0) + line.max(axis=0))
        self.half_side = half_side
        self._line = cKDTree(line)
        self._taken = np.empty((0, 3))

    def from_course(self, places: Float) -> Float:
        """Distance of places (N, 2) from the middle of the course [m]."""
        distance: Float = self._line.query(places)[0]
        return distance

    def from_things(self, places: Float) -> Float:
        """Distance of places (N, 2) from the nearest surface of what stands there [m]."""
        if self._taken.shape[0] == 0:
            return np.full(places.shape[0], np.inf)
        away = np.hypot(places[:, :1] - self._taken[:, 0], places[:, 1:] - self._taken[:, 1])
        free: Float = (away - self._taken[:, 2]).min(axis=1)
        return free

    def take(self, x: float, y: float, radius: float) -> None:
        """Something now stands there."""
        self._taken = np.vstack([self._taken, [x, y, radius]])

    def find(
        self, radius: float, gap: float, near: float, far: float, rng: np.random.Generator, what: str
    ) -> tuple[float, float]:
        """Take a free place for something of a radius [m].

        Args:
            radius: Of the thing.
            gap: Least distance between its surface and its neighbours' [m].
            near, far: Least and greatest distance of its surface from the course [m].
            rng: Draws the places.
            what: What it is, for the error.

        Raises:
            SourceError: The plot is full.
        """
        for count in _BATCHES:
            places = self.centre + self.half_side * rng.uniform(-1.0, 1.0, (count, 2))
            off = self.from_course(places) - radius
            good = (off >= near) & (off <= far)
            good[good] = self.from_things(places[good]) - radius >= gap
            if good.any():
                x, y = (float(value) for value in places[int(np.argmax(good))])
                self.take(x, y, radius)
                return x, y
        raise self.full(what)

    @staticmethod
    def full(what: str) -> SourceError:
        """The error that says that nothing more fits."""
        return SourceError(
            f"no place is left for another {what} in the simulated stand",
            remedy="Ask for fewer trees with trees=N",
        )
