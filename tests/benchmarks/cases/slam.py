"""FastSLAM at three sizes; at the smallest one, also in plain Python."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from tests.benchmarks.table import Cell, Table, ratio
from tests.benchmarks.timing import in_turns, middle, quantile

if TYPE_CHECKING:
    from pipeline.types.records import Detections, Float

NAME = "slam"
LINE = "One step of FastSLAM with ten observations, at three numbers of particles and landmarks"

SIZES = ((100, 30, 300), (100, 1_000, 300), (1_000, 1_000, 60))  # particles, landmarks, steps
SAME_DENSITY = (100, 1_000, 10_000)  # landmarks on the same lattice, 100 particles
GROWTH_STEPS = 200
PEER_STEPS = 7
OBSERVED = 10
SPACING = 3.0  # m between landmarks on their lattice
SIGMA = 0.05
AROUND = 25.0  # m
STRIDE = 0.05  # m a step
TIMES = 4  # number of views after which all landmarks affect the weights


def run() -> list[Table]:
    """Our FastSLAM at all sizes, the peer at the smallest size."""
    rows = [row(*SIZES[0], peer_steps=PEER_STEPS), *(row(*size, peer_steps=0) for size in SIZES[1:])]
    columns = ("particles", "landmarks", "ours ms", "p99", "plain Python ms", "ratio of medians")
    return [
        Table(
            "FastSLAM, ten observations a step",
            columns,
            tuple(rows),
            ("Every particle knows all landmarks; resampling is part of a step when it is needed.",),
        ),
        growth(),
    ]


def growth() -> Table:
    """CPU time of a step by the size of a map of constant density, measured in turns."""
    sides = {str(n): Driven(_ours(100, n), n, known=True) for n in SAME_DENSITY}
    times = in_turns(sides, GROWTH_STEPS, clock=time.thread_time)
    rows = tuple((n, middle(t), sum(t) / len(t)) for n, t in zip(SAME_DENSITY, times.values(), strict=True))
    return Table(
        "100 particles, ten observations, one tree on 9 m2: a step by the trees in the map",
        ("trees", "median ms", "mean ms"),
        rows,
        ("CPU time; the mean has the steps in it that resample. Within 15 m stand about 75 trees.",),
    )


def row(particles: int, landmarks: int, steps: int, peer_steps: int) -> tuple[Cell, ...]:
    """Time steps of one size."""
    sides: dict[str, Callable[[], object]] = {
        "ours": Driven(_ours(particles, landmarks), landmarks, known=True)
    }
    if peer_steps:
        sides["peer"] = Driven(plain_python(particles), landmarks)
    side_by_side = in_turns(sides, peer_steps) if peer_steps else {"peer": []}
    ours = in_turns({"ours": sides["ours"]}, steps)["ours"]
    peer = middle(side_by_side["peer"]) if peer_steps else None
    beside = middle(side_by_side["ours"]) if peer_steps else None
    return (
        particles,
        landmarks,
        middle(ours),
        quantile(ours, 0.99),
        peer,
        ratio(peer, beside) if peer is not None and beside is not None else "",
    )


Feed = Callable[[int, float, "Float"], None]


class Driven:
    """A filter with a map of a lattice of landmarks, through which each call drives one step.

    Args:
        feed: Function that processes a scan.
        landmarks: Of the lattice.
        known: Whether the map of the filter contains them; otherwise the filter first observes them, ten at a
        time.
    """

    def __init__(self, feed: Feed, landmarks: int, *, known: bool = False) -> None:
        import numpy as np

        self._lattice = _lattice(landmarks)
        # Landmarks that can be among the nearest within ten metres of path, so that the search for them takes
        # equal time.
        self._around = self._lattice[np.hypot(self._lattice[:, 0], self._lattice[:, 1]) < AROUND]
        self._feed, self._x, self._index = feed, 0.0, 0
        self._random = np.random.default_rng(0)
        for _ in range(0 if known else TIMES):
            for first in range(0, landmarks, OBSERVED):
                self._observe(self._lattice[first : first + OBSERVED], 0.0)

    def __call__(self) -> None:
        """Drive one step and observe the ten nearest landmarks; return to the start after ten metres."""
        import numpy as np

        motion = STRIDE if (self._index // 200) % 2 == 0 else -STRIDE
        self._x += motion
        distance = np.hypot(self._around[:, 0] - self._x, self._around[:, 1])
        self._observe(self._around[np.argsort(distance)[:OBSERVED]], motion)

    def _observe(self, landmarks: Float, motion: float) -> None:
        import numpy as np

        seen = landmarks - np.array([self._x, 0.0]) + self._random.normal(0.0, 0.5 * SIGMA, landmarks.shape)
        self._feed(self._index, motion, seen)
        self._index += 1


def _lattice(landmarks: int) -> Float:
    """Return the positions of the landmarks, shape (L, 2) [m]."""
    import numpy as np

    columns = max(1, round(landmarks**0.5))
    k = np.arange(landmarks)
    lattice: Float = SPACING * np.stack([k // columns, k % columns - columns // 2], axis=1).astype(float)
    lattice[:, 0] -= 5.0
    return lattice


def _ours(particles: int, landmarks: int) -> Feed:
    """Return our filter with its map. If it observed the lattice from one place, it could not distinguish ten
    landmarks from those one lattice step away, and the map would contain many of them twice."""
    import numpy as np

    from pipeline.config import Parameters
    from pipeline.detection.free_space import BINS
    from pipeline.geometry.poses import Pose2
    from pipeline.slam import FastSlam
    from pipeline.slam.particle_maps import MapColumns
    from pipeline.slam.state import SlamState

    slam = FastSlam(Parameters().replace({"slam.particles": particles}).slam, 0)
    known = MapColumns(
        _lattice(landmarks),
        np.tile([SIGMA**2 / TIMES, 0.0, SIGMA**2 / TIMES], (landmarks, 1)),
        np.full(landmarks, TIMES, np.int32),
        np.full(landmarks, TIMES, np.float32),
        np.arange(landmarks),
    )
    slam.state = SlamState.in_map(np.zeros((particles, 3)), known)
    nothing_missed = np.zeros(BINS)

    def feed(index: int, motion: float, seen: Float) -> None:
        slam.process(index, Pose2(motion, 0.0, 0.0), detections_of(seen, SIGMA), nothing_missed)

    return feed


def detections_of(seen: Float, sigma: float) -> Detections:
    """Detections at places in the base frame, shape (D, 2) [m], with an error of this sigma [m]."""
    import numpy as np

    from pipeline.types.records import Detections

    unknown = np.full(len(seen), np.nan)
    covariance = np.tile(sigma**2 * np.eye(2), (len(seen), 1, 1))
    return Detections(np.arange(len(seen)), seen, covariance, unknown, unknown, np.zeros(len(seen)), unknown)


def plain_python(particles: int) -> Feed:
    """Return the filter of the peer, which gets the map by observations."""
    import numpy as np

    from pipeline.config import Parameters
    from tests.benchmarks.peer.fastslam import FastSlam
    from tests.benchmarks.peer.stages import Detection

    values: dict[str, Any] = dict(Parameters().replace({"slam.particles": particles}).flat())
    slam = FastSlam(values, 0)

    def feed(_index: int, motion: float, seen: Float) -> None:
        slam.process((motion, 0.0, 0.0), [Detection(z, SIGMA**2 * np.eye(2), 1.0) for z in seen])
        slam.estimate()
        slam.resample_if_needed()

    return feed
