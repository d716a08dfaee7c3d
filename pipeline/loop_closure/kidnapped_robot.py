"""Kidnapped robot: a robot that was carried away is noticed, and found again in the map.

While it is lost, the stems around it are mapped separately from the map. When their constellation is found
among the trees of the map, mapping continues there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from pipeline.config import Parameters
from pipeline.geometry.poses import Float, Pose2
from pipeline.loop_closure import detection
from pipeline.loop_closure.correction import LoopClosure, RelocalisedPose, Restart, SearchFailure
from pipeline.loop_closure.stem_matching import MapStems, find_constellation, worst_sigma
from pipeline.slam import FastSlam, Motion, SlamState
from pipeline.types.records import Detections, Int, PoseEstimate

S = TypeVar("S")

# Views between two stored states. In so many views without known trees, the running share of found trees
# decreases from 1 to less than that of a supported pose, so that the older state precedes them.
SPACING = 5
PARTICLES = 30  # of the local map
HYPOTHESES = 100_000
FARTHEST = 100.0  # m; after a search of this length, mapping continues at the pose by odometry
LOCAL_MAP = 1  # spawn key of the random numbers of the local map


@dataclass(frozen=True, slots=True, eq=False)
class RelocaliserState(Generic[S]):
    """State of the relocaliser between two scans.

    Attributes:
        kept: The last two stored states of the mapper, older first, as pairs of the number of the next scan
            and the state.
        views: Number of views at the newer stored state.
        motions: Scan number and motion of each scan after the older stored state.
        local: Local map of a search; None while the robot is not lost.
        driven: Distance driven since the search began [m].
        since: First scan that mapped nothing because the robot was lost.
    """

    kept: tuple[tuple[int, S], ...] = ()
    views: int = 0
    motions: tuple[tuple[int, Motion], ...] = ()
    local: SlamState | None = None
    driven: float = 0.0
    since: int = 0

    def copy(self) -> RelocaliserState[S]:
        """Return a copy that a search does not change; the stored states of the mapper are shared."""
        return replace(self, local=None if self.local is None else self.local.copy())


@dataclass(frozen=True, slots=True, eq=False)
class LocalMapMatch:
    """Pose of the base in the map, the covariance of x, y [m], yaw [rad], shape (3, 3), and the numbers of
    the trees that agree, int64, shape (K,)."""

    T_map_base: Pose2
    covariance: Float
    numbers: Int


class Relocaliser(Generic[S]):
    """Finds a lost robot in the map of a mapper whose states are of type S."""

    def __init__(self, seed: int) -> None:
        """Create a relocaliser that is not searching and has no stored state. The seed of the local map is
        derived from `seed`, the seed of the run."""
        self._seed = local_seed(seed)
        self.state: RelocaliserState[S] = RelocaliserState()

    @property
    def is_searching(self) -> bool:
        """Whether a search is going on because the robot is lost."""
        return self.state.local is not None

    def reset(self) -> None:
        """End a search, and discard the stored states and motions: the map returns to none of them."""
        self.state = RelocaliserState()

    def needs_state(self, views: int, is_supported: bool) -> bool:
        """Return whether `remember` must get the state of the mapper before this scan: if no state is stored,
        or if the pose is supported and SPACING views have passed since the last stored state.

        Args:
            views: Number of scans that SLAM has used so far.
            is_supported: See `FastSlam.is_supported`.
        """
        return not self.state.kept or (is_supported and views - self.state.views >= SPACING)

    def remember(self, index: int, motion: Motion, views: int, state: S | None) -> None:
        """Store the motion to a scan, and the state of the mapper before it where one is given; see
        `needs_state`. Only the last two states and the motions since the older one are kept.

        Args:
            index: Number of the scan.
            motion: Motion from the scan before.
            views: See `needs_state`.
            state: State of the mapper before the scan, or None.
        """
        s = self.state
        if state is not None:
            kept = (*s.kept[-1:], (index, state))
            motions = tuple(each for each in s.motions if each[0] >= kept[0][0])
            s = replace(s, kept=kept, views=views, motions=motions)
        self.state = replace(s, motions=(*s.motions, (index, motion)))

    def begin(self, index: int, detections: Detections, free: Float, parameters: Parameters) -> Restart[S]:
        """Begin a search at a scan: start a local map with at most PARTICLES particles at the origin, and map
        the detections in it. The stored states are discarded.

        Args:
            index: Number of the scan.
            detections: Trees in the base frame.
            free: Free distance by azimuth, shape (bins,) [m].
            parameters: Parameters of all stages.

        Returns:
            The older stored state (or the only one), to which the mapper must return, with the motions since
            then.

        Raises:
            IndexError: No state was stored by `remember`.
        """
        s = self.state
        local = SlamState.at_origin(min(PARTICLES, parameters.slam.particles))
        self.state = RelocaliserState(local=local, since=s.motions[0][0])
        self._map_locally(local, index, Motion(Pose2()), detections, free, parameters)
        return Restart(s.kept[0][1], s.motions)

    def search(
        self,
        index: int,
        motion: Motion,
        detections: Detections,
        free: Float,
        parameters: Parameters,
        run: detection.RunHistory,
    ) -> RelocalisedPose | LoopClosure | SearchFailure | None:
        """Map a scan in the local map, and search the local map among the confirmed trees of the map if the
        local map uses the scan. The search continues until `reset`, after a decision as well.

        Args:
            index, motion, detections, free: See `FastSlam.process`; a measured pose of the motion is ignored.
            parameters: Parameters of all stages.
            run: The map and the path, with the pose by odometry at this scan.

        Returns:
            The decision: a loop closure if the odometry can have led to the found pose, otherwise a
            relocalised pose; a failure after FARTHEST metres of search. None while the search continues, and
            if there is no search.
        """
        if self.state.local is None:
            return None
        views = self.state.local.views
        slam, estimate = self._map_locally(self.state.local, index, motion, detections, free, parameters)
        match = _match(slam, estimate, parameters, run) if slam.state.views > views else None
        if match is None:
            return SearchFailure() if self.state.driven > FARTHEST else None
        stems, last = len(match.numbers), self.state.since - 1
        loop = detection.loop_to(
            run, match.numbers, match.T_map_base, match.covariance, last, run.estimate.covariance
        )
        if loop is None:
            return RelocalisedPose(match.T_map_base, match.covariance, stems)
        return LoopClosure(loop, stems)

    def _map_locally(
        self,
        local: SlamState,
        index: int,
        motion: Motion,
        detections: Detections,
        free: Float,
        parameters: Parameters,
    ) -> tuple[FastSlam, PoseEstimate]:
        """Process a scan in the local map, and add its motion to the distance of the search; replaces
        `state`.

        Args:
            local: State of the local map; the number of its particles is kept.
            index: Number of the scan.
            motion: Motion from the scan before; a measured pose is ignored, because it is in the frame of the
                map.
            detections: Trees in the base frame.
            free: Free distance by azimuth, shape (bins,) [m].
            parameters: Parameters of all stages.

        Returns:
            The filter of the local map after the scan, and the pose in the local map.
        """
        slam = FastSlam(parameters.slam.model_copy(update={"particles": len(local.pose)}), self._seed)
        slam.state = local
        # Measured poses are in the frame of the map, and not in that of the local one.
        estimate = slam.process(index, motion._replace(measured=None), detections, free)
        driven = self.state.driven + float(np.hypot(motion.step.x, motion.step.y))
        self.state = replace(self.state, local=slam.state, driven=driven)
        return slam, estimate


def _match(
    slam: FastSlam, estimate: PoseEstimate, parameters: Parameters, run: detection.RunHistory
) -> LocalMapMatch | None:
    """Search the local map among the confirmed trees of the map; None if it is not found, see
    `find_constellation`.

    Args:
        slam: Filter of the local map.
        estimate: Pose of the base in the local map.
        parameters: Parameters of all stages.
        run: The map.
    """
    trees = run.trees
    match = find_constellation(
        _stems(slam, parameters), MapStems.of_trees(trees), parameters.relocalisation, hypotheses=HYPOTHESES
    )
    if match.pose is None:
        return None
    numbers = trees.number[trees.confirmed][match.reference]
    relative = estimate.local_covariance
    pose, covariance = detection.through(match.pose, match.covariance, estimate.T_map_base, relative)
    return LocalMapMatch(pose, covariance, numbers)


def _stems(slam: FastSlam, parameters: Parameters) -> MapStems:
    """Return the landmarks of the best particle of the local map with at least `hits_to_weigh` hits, as stems
    of unknown diameter."""
    landmarks = slam.state.map_of(slam.state.best)
    known = landmarks.hits >= parameters.slam.hits_to_weigh
    unknown = np.full(int(np.count_nonzero(known)), np.nan)
    return MapStems(landmarks.mean[known], worst_sigma(landmarks.covariance[known]), unknown, unknown)


def local_seed(seed: int) -> int:
    """Return the seed of the local map for the seed of a run, >= 0. It is independent of the seeds of all
    runs, also of those with a near seed."""
    sequence = np.random.SeedSequence(seed, spawn_key=(LOCAL_MAP,))
    return int(sequence.generate_state(1)[0])
