"""A robot that was carried away: what it mapped while it did not know is taken back, the stems around it
are mapped apart, and once their constellation is found in the map it goes on there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from pipeline.geometry import Float, Pose2
from pipeline.parameters import Parameters
from pipeline.records import Detections, PoseEstimate, Trees
from pipeline.relocalisation import Stems, find_constellation
from pipeline.relocalisation.stems import worst_sigma
from pipeline.slam import FastSlam, Motion, SlamState

S = TypeVar("S")

SPACING = 12  # scans between two states that are kept; losing the known trees takes about eight
PARTICLES = 30  # of the small map
EVERY = 3  # scans between two searches
HYPOTHESES = 100_000
FARTHEST = 100.0  # m; after so long a search the map goes on where the odometry leads
SEEDS = 1  # added to the run's seed, for the small map


@dataclass(frozen=True, slots=True, eq=False)
class RecoveryState(Generic[S]):
    """What is known between two scans.

    Attributes:
        kept: The last two states of the mapper that are kept, older first.
        motions: Number and motion of every scan since the older one.
        local: The small map of a search; None while the robot knows where it is.
        driven: Since the search began [m].
    """

    kept: tuple[S, ...] = ()
    motions: tuple[tuple[int, Motion], ...] = ()
    local: SlamState | None = None
    driven: float = 0.0

    def copy(self) -> RecoveryState[S]:
        """Independent of a search that goes on."""
        return replace(self, local=None if self.local is None else self.local.copy())


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Where the robot is in the map, with the covariance of x, y [m], yaw [rad], and how many stems agree."""

    T_map_base: Pose2
    covariance: Float
    stems: int


class Recovery(Generic[S]):
    """Watches over a mapper whose states are of type S."""

    def __init__(self, seed: int) -> None:
        self._seed = seed + SEEDS
        self.state: RecoveryState[S] = RecoveryState()

    @property
    def searching(self) -> bool:
        """Whether the robot does not know where it is."""
        return self.state.local is not None

    def remember(self, index: int, motion: Motion, snapshot: Callable[[], S]) -> None:
        """Take a scan that is about to be mapped."""
        s = self.state
        if not s.kept or index % SPACING == 0:
            kept = (*s.kept[-1:], snapshot())
            motions = s.motions[-SPACING:] if len(kept) > 1 else ()
            s = replace(s, kept=kept, motions=motions)
        self.state = replace(s, motions=(*s.motions, (index, motion)))

    def begin(self, parameters: Parameters) -> tuple[S, tuple[tuple[int, Motion], ...]]:
        """Begin a search; returns the state before the robot went astray and the motions since."""
        s = self.state
        local = SlamState.at_origin(min(PARTICLES, parameters.slam.particles))
        self.state = replace(s, kept=(), motions=(), local=local, driven=0.0)
        return s.kept[0], s.motions

    def search(
        self, index: int, motion: Motion, found: Detections, free: Float, trees: Trees, parameters: Parameters
    ) -> Found | None:
        """Take a scan into the small map and look for it among the trees of the map.

        Args:
            index, motion, found, free: As `FastSlam.process` takes them.
            trees: Of the map.
            parameters: Of all stages.
        """
        s = self.state
        if s.local is None:
            return None
        slam = FastSlam(parameters.slam.model_copy(update={"particles": len(s.local.pose)}), self._seed)
        slam.state = s.local
        estimate = slam.process(index, motion, found, free)
        driven = s.driven + float(np.hypot(motion.step.x, motion.step.y))
        self.state = replace(s, local=slam.state, driven=driven)
        if index % EVERY:
            return None
        match = find_constellation(
            _stems(slam, parameters), Stems.of_trees(trees), parameters.relocalisation, hypotheses=HYPOTHESES
        )
        if match.pose is None:
            return None
        return Found(*_through(match.pose, match.covariance, estimate), len(match.local))

    @property
    def is_over(self) -> bool:
        """Whether the search has taken so long that the map goes on without it."""
        return self.state.driven > FARTHEST

    def end(self) -> None:
        """The robot is mapped again."""
        self.state = RecoveryState()


def _stems(slam: FastSlam, parameters: Parameters) -> Stems:
    """The landmarks of the small map that were seen more than once."""
    landmarks = slam.state.map_of(slam.state.best)
    known = landmarks.hits >= parameters.slam.hits_to_weigh
    unknown = np.full(int(np.count_nonzero(known)), np.nan)
    return Stems(landmarks.mean[known], worst_sigma(landmarks.covariance[known]), unknown, unknown)


def _through(T_map_local: Pose2, covariance: Float, estimate: PoseEstimate) -> tuple[Pose2, Float]:
    """The pose of the base in the map, and its covariance from those of the match and the small map."""
    C = np.eye(3)
    C[:2, :2] = T_map_local.rotation()
    T_map_base = T_map_local @ estimate.T_map_base
    J = np.eye(3)
    J[0, 2], J[1, 2] = T_map_local.y - T_map_base.y, T_map_base.x - T_map_local.x
    return T_map_base, J @ covariance @ J.T + C @ estimate.covariance @ C.T
