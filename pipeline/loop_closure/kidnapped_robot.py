"""A robot that was carried away: what it mapped while it did not know is taken back, the stems around it
are mapped apart, and once their constellation is found in the map it goes on there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from pipeline.config import Parameters
from pipeline.detection.free_space import BINS
from pipeline.geometry.poses import Float, Pose2
from pipeline.loop_closure import detection
from pipeline.loop_closure.stem_matching import Stems, find_constellation
from pipeline.loop_closure.stem_matching.stem_constellation import worst_sigma
from pipeline.slam import BackEnd, FastSlam, Loop, Motion, SlamState
from pipeline.types.records import Detections, Int, PoseEstimate, Trees, nothing_found

S = TypeVar("S")

SPACING = 12  # scans between two states that are kept; losing the known trees takes about eight
PARTICLES = 30  # of the small map
EVERY = 3  # scans between two searches
HYPOTHESES = 100_000
FARTHEST = 100.0  # m; after so long a search the map goes on where the odometry leads
SEEDS = 1  # added to the run's seed, for the small map
NOTHING_FREE: Float = np.zeros(BINS)
ASTRAY = (
    "the robot is lost: what was mapped since the known trees were last seen is taken back, and the map is "
    "searched for the stems around"
)
BENT = "the path drifted since then: it is bent, and what was mapped from it with it"
NOT_FOUND = "the stems around were not found in the map; it goes on where the odometry leads"


@dataclass(frozen=True, slots=True, eq=False)
class RecoveryState(Generic[S]):
    """What is known between two scans.

    Attributes:
        kept: The last two states of the mapper that are kept, older first.
        motions: Number and motion of every scan since the older one.
        local: The small map of a search; None while the robot knows where it is.
        driven: Since the search began [m].
        since: Scan; those since then mapped nothing.
    """

    kept: tuple[S, ...] = ()
    motions: tuple[tuple[int, Motion], ...] = ()
    local: SlamState | None = None
    driven: float = 0.0
    since: int = 0

    def copy(self) -> RecoveryState[S]:
        """Independent of a search that goes on."""
        return replace(self, local=None if self.local is None else self.local.copy())


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Where the robot is in the map, with the covariance of x, y [m], yaw [rad], and the numbers of the trees
    that agree, int64, shape (K,)."""

    T_map_base: Pose2
    covariance: Float
    numbers: Int


@dataclass(frozen=True, slots=True)
class Mapped(Generic[S]):
    """What is asked of a mapper whose states are of type S.

    Attributes:
        slam: Where it is.
        state: Gives all its state without that of its recovery.
        take_back: Leaves its map as it was in a state.
        trees: Gives the trees of its map.
        run: Gives what is known of the run, with a pose.
        bend: Closes a loop: path and map are bent.
        place: Puts the base where it was found, with the covariance of that.
    """

    slam: BackEnd
    state: Callable[[], S]
    take_back: Callable[[S], None]
    trees: Callable[[], Trees]
    run: Callable[[PoseEstimate], detection.Mapped]
    bend: Callable[[Loop], None]
    place: Callable[[Pose2, Float], None]


class Recovery(Generic[S]):
    """Finds the pose of each scan for a mapper, and the robot when it is lost."""

    def __init__(self, seed: int) -> None:
        self._seed = seed + SEEDS
        self.state: RecoveryState[S] = RecoveryState()

    @property
    def searching(self) -> bool:
        """Whether the robot does not know where it is."""
        return self.state.local is not None

    def locate(
        self,
        index: int,
        motion: Motion,
        found: Detections,
        free: Float,
        parameters: Parameters,
        mapped: Mapped[S],
    ) -> tuple[PoseEstimate, tuple[str, ...]]:
        """The pose after a scan, and what a person should know of how it was found.

        Args:
            index, motion, found, free: As `FastSlam.process` takes them.
            parameters: Of all stages.
            mapped: The mapper; its map goes back where the robot went astray.
        """
        slam = mapped.slam
        if parameters.relocalisation.method == "none":
            self._end()
            return slam.process(index, motion, found, free), ()
        if self.searching:
            return self._follow(index, motion, found, free, parameters, mapped)
        self._remember(index, motion, mapped)
        estimate = slam.process(index, motion, found, free)
        if not slam.is_astray:
            return estimate, ()
        estimate = self._begin(estimate, found, parameters, mapped)
        self._search(index, Motion(Pose2()), found, free, parameters, mapped.trees)
        return estimate, (ASTRAY,)

    def _remember(self, index: int, motion: Motion, mapped: Mapped[S]) -> None:
        """Take a scan that is about to be mapped."""
        s = self.state
        if not s.kept or index % SPACING == 0:
            kept = (*s.kept[-1:], mapped.state())
            motions = s.motions[-SPACING:] if len(kept) > 1 else ()
            s = replace(s, kept=kept, motions=motions)
        self.state = replace(s, motions=(*s.motions, (index, motion)))

    def _begin(
        self, estimate: PoseEstimate, found: Detections, parameters: Parameters, mapped: Mapped[S]
    ) -> PoseEstimate:
        """Go back to the map before the robot went astray, and follow the odometry from there."""
        s, slam = self.state, mapped.slam
        recent = slam.state.recent
        mapped.take_back(s.kept[0])
        for index, motion in s.motions:
            estimate = slam.process(index, motion, nothing_found(found), NOTHING_FREE)
        slam.state = replace(slam.state, recent=recent)
        local = SlamState.at_origin(min(PARTICLES, parameters.slam.particles))
        self.state = RecoveryState(local=local, since=s.motions[0][0])
        return replace(estimate, health=slam.lost(estimate))

    def _follow(
        self,
        index: int,
        motion: Motion,
        found: Detections,
        free: Float,
        parameters: Parameters,
        mapped: Mapped[S],
    ) -> tuple[PoseEstimate, tuple[str, ...]]:
        """A scan of a robot that is lost: the odometry leads, until the stems around are found."""
        slam = mapped.slam
        estimate = slam.process(index, motion, nothing_found(found), NOTHING_FREE)
        at = self._search(index, motion, found, free, parameters, mapped.trees)
        if at is not None:
            told: tuple[str, ...] = (f"found again in the map by {len(at.numbers)} stems that agree",)
            loop = self._loop(at, estimate, mapped)
            if loop is None:
                mapped.place(at.T_map_base, at.covariance)
            else:
                mapped.bend(loop)
                told = (*told, BENT)
            self._end()
            return slam.estimate(estimate), told
        if self.state.driven > FARTHEST:
            slam.give_up()
            self._end()
            return estimate, (NOT_FOUND,)
        return estimate, ()

    def _loop(self, at: Found, estimate: PoseEstimate, mapped: Mapped[S]) -> Loop | None:
        """The loop that the robot has driven, where it was not carried."""
        last, run = self.state.since - 1, mapped.run(estimate)
        return detection.loop_to(run, at.numbers, at.T_map_base, at.covariance, last, estimate.covariance)

    def _search(
        self,
        index: int,
        motion: Motion,
        found: Detections,
        free: Float,
        parameters: Parameters,
        trees: Callable[[], Trees],
    ) -> Found | None:
        """Take a scan into the small map and look for it among the trees of the map."""
        s = self.state
        if s.local is None:
            return None
        slam = FastSlam(parameters.slam.model_copy(update={"particles": len(s.local.pose)}), self._seed)
        slam.state = s.local
        # Measured poses are in the frame of the map, and not in that of the small one.
        estimate = slam.process(index, motion._replace(measured=None), found, free)
        driven = s.driven + float(np.hypot(motion.step.x, motion.step.y))
        self.state = replace(s, local=slam.state, driven=driven)
        if index % EVERY:
            return None
        known = trees()
        match = find_constellation(
            _stems(slam, parameters),
            Stems.of_trees(known),
            parameters.relocalisation,
            hypotheses=HYPOTHESES,
        )
        if match.pose is None:
            return None
        numbers = known.number[known.confirmed][match.reference]
        own = detection.nearby(estimate)
        return Found(*detection.through(match.pose, match.covariance, estimate.T_map_base, own), numbers)

    def forget(self) -> None:
        """Take nothing back to before now: the map was bent since."""
        self._end()

    def _end(self) -> None:
        """The robot is mapped again."""
        self.state = RecoveryState()


def _stems(slam: FastSlam, parameters: Parameters) -> Stems:
    """The landmarks of the small map that were seen more than once."""
    landmarks = slam.state.map_of(slam.state.best)
    known = landmarks.hits >= parameters.slam.hits_to_weigh
    unknown = np.full(int(np.count_nonzero(known)), np.nan)
    return Stems(landmarks.mean[known], worst_sigma(landmarks.covariance[known]), unknown, unknown)
