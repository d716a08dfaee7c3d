"""Pose graph of keyframes and stems: the smoother behind FastSLAM, and the correction of path and landmarks
by its solution.

x*, l* = argmin   sum_k  |x_k-1^-1 x_k - u_k|^2_Q
                + sum_kj rho(|C_k^T (l_j - p_k) - z_kj|_R)
                + sum_ij rho(|x_i^-1 x_j - t_ij|_T)

x_k are the poses of keyframes, p_k and C_k their positions and rotations, l_j the positions of stems, u_k the
motions by odometry between keyframes, z_kj the detections of stems with the data association of FastSLAM, and
t_ij the loops that stem matching finds. rho is the Cauchy kernel, which switches off a wrong association or a
wrong loop. `graph_solver` finds the minimum, starting at the present estimate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.geometry.pose_arrays import composed, interpolated, inverse, rotated_rows
from pipeline.geometry.poses import Float, Pose2, wrap_angle
from pipeline.slam.association import associate
from pipeline.slam.graph_solver import Problem, cauchy_weight
from pipeline.slam.motion import Noise, compounded
from pipeline.slam.particle_maps import MapColumns
from pipeline.slam.places import REVISIT_DISTANCE
from pipeline.types.records import Bool, Int

#: Stems of one keyframe in the graph; bounds the cost of a keyframe.
STEMS_MAX = 64
GOLDEN = 0.6180339887498949  # golden ratio; its multiples modulo 1 order the stems evenly and reproducibly
#: Keyframes of the graph; beyond it every second one is dropped, which bounds the cost of a solution.
KEYFRAMES_MAX = 2000
#: Loops of a graph that is thinned; beyond it every second one is dropped, because their ends stay.
LOOPS_MAX = 250
#: Growth of the graph between two solutions: a share of it, and at least so many keyframes. All solutions
#: of a run together cost a bounded multiple of the last one.
GROWTH, GROWTH_MIN = 0.1, 5


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """One keyframe.

    Attributes:
        scan: Number of the scan.
        first_birth: Landmarks with this birth number or a later one were begun at this keyframe or after it.
        distance: Distance driven until here [m].
        motion: x, y [m], yaw [rad] since the keyframe before, shape (3,).
        covariance: Covariance of `motion`, shape (3, 3); infinite where no odometry connects the two.
        birth: Birth numbers of the detected landmarks, int64, shape (D,).
        centre: Positions of the landmarks in the frame of the base, shape (D, 2) [m].
        R: Covariances of the positions xx, xy, yy, shape (D, 3) [m^2].
    """

    scan: int
    first_birth: int
    distance: float
    motion: Float
    covariance: Float
    birth: Int
    centre: Float
    R: Float


@dataclass(frozen=True, slots=True, eq=False)
class ScanDetections:
    """The detections of one scan between two keyframes; the attributes are those of Keyframe."""

    scan: int
    distance: float
    birth: Int
    centre: Float
    R: Float


def combined(scans: Sequence[ScanDetections | Keyframe], T_keyframe_base: Float) -> tuple[Int, Float, Float]:
    """Return the means of detections of the same landmark over several scans, weighted by the inverse traces
    of their covariances.

    Of more than STEMS_MAX landmarks those with the smallest value of a hash are taken. All keyframes use the
    same hash, so that a stem which one keyframe takes is taken by the others as well, as far as they see it
    (bottom-k sampling; Broder 1997), near and far.

    Args:
        scans: The scans, at least one; they may have no detections.
        T_keyframe_base: Pose of each scan with respect to the keyframe, x, y [m], yaw [rad], shape (S, 3).

    Returns:
        Birth numbers, int64, shape (D,), in the order of the hash; positions in the frame of the keyframe,
        shape (D, 2) [m]; and covariances xx, xy, yy, shape (D, 3) [m^2]; D is at most STEMS_MAX.
    """
    count = [len(s.birth) for s in scans]
    pose = np.repeat(T_keyframe_base, count, axis=0)
    birth, z = np.concatenate([s.birth for s in scans]), np.concatenate([s.centre for s in scans])
    R = rotated_rows(np.concatenate([s.R for s in scans]), pose[:, 2])
    z = composed(pose, np.column_stack([z, np.zeros(len(z))]))[:, :2]
    names, of = np.unique(birth, return_inverse=True)
    weight = 1.0 / (R[:, 0] + R[:, 2])
    total = np.bincount(of, weight, len(names))
    mean = np.column_stack([np.bincount(of, weight * z[:, a], len(names)) for a in range(2)]) / total[:, None]
    # The covariance of a weighted mean of independent errors.
    square = np.column_stack([np.bincount(of, weight**2 * R[:, a], len(names)) for a in range(3)])
    spread = square / (total**2)[:, None]
    taken = np.argsort(names * GOLDEN % 1.0, kind="stable")[:STEMS_MAX]
    return names[taken], mean[taken], spread[taken]


@dataclass(frozen=True, slots=True)
class Revisit:
    """A stretch at the end of the path that shows known landmarks again.

    Attributes:
        first_birth: Landmarks with a smaller birth number are known from before.
        begin: Driven distance from which on keyframes belong to it [m].
    """

    first_birth: int
    begin: float

    def of(self, keyframe: Keyframe) -> Bool:
        """Return which detections of a keyframe belong to the revisit, shape (D,)."""
        known: Bool = (keyframe.birth < self.first_birth) & (keyframe.distance >= self.begin)
        return known


@dataclass(frozen=True, slots=True, eq=False)
class LoopEdge:
    """A relative pose that stem matching measured.

    Attributes:
        scans: Scan numbers of both keyframes.
        motion: x, y [m], yaw [rad] from the first to the second, shape (3,).
        covariance: Covariance of the motion, shape (3, 3).
    """

    scans: tuple[int, int]
    motion: Float
    covariance: Float


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The minimum of a graph.

    Attributes:
        pose: x, y [m], yaw [rad] of each keyframe, shape (K, 3).
        birth: Birth numbers of the landmarks of the graph, int64, shape (L,), ascending.
        position: Positions x, y of the landmarks in the map, shape (L, 2) [m].
        covariance: Covariance of each keyframe's pose with respect to the first one, shape (K, 3, 3).
        of_map: Part of these covariances that comes from the other poses and stems, shape (K, 3, 3), positive
            semidefinite. By the law of total variance it is Cov(x) - Cov(x | all others). Another pose that
            is found by the same stems shares it. The first keyframe, which is fixed, has that of the second.
        conditional: Covariance of the newest keyframe's pose given all other poses and stems, shape (3, 3).
    """

    pose: Float
    birth: Int
    position: Float
    covariance: Float
    of_map: Float
    conditional: Float


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeGraph:
    """The graph. It is immutable, so that states may share it.

    Attributes:
        keyframes: In the order of the path.
        pose: Pose of each keyframe by the filter or by the last solution, shape (K, 3).
        loops: Loops that stem matching found.
        revisits: Keyframes since the last solution that show stems for the first time in REVISIT_DISTANCE.
        solved: Number of keyframes at the last solution.
    """

    keyframes: tuple[Keyframe, ...] = ()
    pose: Float = field(default_factory=lambda: np.zeros((0, 3)))
    loops: tuple[LoopEdge, ...] = ()
    revisits: int = 0
    solved: int = 0

    @property
    def scans(self) -> Int:
        """Scan numbers of the keyframes, int64, shape (K,), ascending."""
        return np.array([k.scan for k in self.keyframes], np.int64)

    @property
    def newest_scan(self) -> int:
        """Scan number of the newest keyframe, -1 if there is none."""
        return self.keyframes[-1].scan if self.keyframes else -1

    def with_keyframe(self, keyframe: Keyframe, pose: Float) -> KeyframeGraph:
        """Return the graph with one more keyframe, at a pose x, y [m], yaw [rad] by the filter, shape (3,).
        It replaces the newest keyframe if that has the same scan. `revisits` grows by 1 if the keyframe is a
        revisit. With more than KEYFRAMES_MAX keyframes the result is thinned."""
        kept = len(self.keyframes) - (self.newest_scan == keyframe.scan)
        graph = replace(
            self,
            keyframes=(*self.keyframes[:kept], keyframe),
            pose=np.concatenate([self.pose[:kept], pose[None]]),
            revisits=self.revisits + self._is_revisit(keyframe),
        )
        return graph.thinned() if len(graph.keyframes) > KEYFRAMES_MAX else graph

    def with_loop(
        self, anchor: int, T_map_base: Pose2, covariance: Float, path: Float, *, end: int | None = None
    ) -> KeyframeGraph:
        """Return the graph with a loop from an earlier keyframe to the newest one; unchanged with fewer than
        two keyframes.

        Args:
            anchor: Number of a scan near the place. The loop begins at the last keyframe before or at it, or
                at the first keyframe for an earlier scan.
            T_map_base: Pose of the newest keyframe, found by the trees around the anchor.
            covariance: Covariance of x, y [m], yaw [rad] of this pose, axes of the map, shape (3, 3).
            path: Estimated pose of each scan, x, y [m], yaw [rad], shape (N, 3). The trees around the anchor
                are mapped from it; `pose` is that of single particles until the first solution.
            end: Scan of the keyframe at `T_map_base` in place of the newest one.
        """
        if len(self.keyframes) < 2:
            return self
        row = max(int(np.searchsorted(self.scans[:-1], anchor, side="right")) - 1, 0)
        pose = path[self.keyframes[row].scan]
        motion = composed(inverse(pose[None]), T_map_base.as_array()[None])[0]
        c, s = np.cos(pose[2]), np.sin(pose[2])
        C = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        scans = (self.keyframes[row].scan, self.newest_scan if end is None else end)
        return replace(self, loops=(*self.loops, LoopEdge(scans, motion, C @ covariance @ C.T)))

    def first_birth_after(self, scan: int) -> int:
        """Return the `first_birth` of the first keyframe after a scan, or of the newest keyframe if none is
        later.

        Raises:
            IndexError: The graph has no keyframe.
        """
        row = int(np.searchsorted(self.scans, scan, side="right"))
        return self.keyframes[min(row, len(self.keyframes) - 1)].first_birth

    def solved_by(self, solution: Solution) -> KeyframeGraph:
        """Return the graph with the poses of its solution, no revisits, and `solved` at the present number of
        keyframes."""
        return replace(self, pose=solution.pose, revisits=0, solved=len(self.keyframes))

    @property
    def is_due(self) -> bool:
        """Whether revisits were added since the last solution, and the graph has grown by the share GROWTH,
        and by GROWTH_MIN keyframes at least."""
        grown = len(self.keyframes) - self.solved
        return self.revisits > 0 and grown >= max(GROWTH_MIN, GROWTH * len(self.keyframes))

    def renamed(self, birth: Int, name: Int) -> KeyframeGraph:
        """Return the graph in which the birth numbers `birth` are replaced by those in `name`; birth numbers
        that the graph does not have are ignored.

        Args:
            birth: Present birth numbers, int64, shape (N,), ascending.
            name: New birth numbers, int64, shape (N,).
        """
        if not len(birth):
            return self

        def rename(keyframe: Keyframe) -> Keyframe:
            row = np.minimum(np.searchsorted(birth, keyframe.birth), len(birth) - 1)
            return replace(keyframe, birth=np.where(birth[row] == keyframe.birth, name[row], keyframe.birth))

        return replace(self, keyframes=tuple(rename(k) for k in self.keyframes))

    def revisit(self, scan: int) -> Revisit:
        """Return the present revisit of what was mapped until a scan: at least the last REVISIT_DISTANCE of
        the path. Its detections show landmarks that were begun until then; before it, there is a gap of
        REVISIT_DISTANCE without such detections, or the first REVISIT_DISTANCE after the scan.

        Raises:
            IndexError: The graph has no keyframe.
        """
        row = min(int(np.searchsorted(self.scans, scan, side="right")), len(self.keyframes) - 1)
        first, newest = self.keyframes[row], self.keyframes[-1].distance
        begin = first.distance + REVISIT_DISTANCE
        shown = [k.distance for k in self.keyframes if (k.birth < first.first_birth).any()]
        at = np.array([*(distance for distance in shown if distance >= begin), newest])
        gaps = np.flatnonzero(np.diff(at) > REVISIT_DISTANCE)
        last = at[gaps[-1] + 1] if len(gaps) else at[0]
        return Revisit(first.first_birth, max(begin, float(min(last, newest - REVISIT_DISTANCE))))

    def without(self, revisit: Revisit) -> KeyframeGraph:
        """Return the graph without the detections of a revisit: the path may have drifted by more than the
        distance between trees."""
        keyframes = list(self.keyframes)
        for n, k in enumerate(keyframes):
            if (shown := revisit.of(k)).any():
                keyframes[n] = replace(k, birth=k.birth[~shown], centre=k.centre[~shown], R=k.R[~shown])
        return replace(self, keyframes=tuple(keyframes))

    def support(self, revisit: Revisit, solution: Solution) -> float:
        """Return the sum of the kernel weights (`cauchy_weight`) of all detections on the way of a revisit,
        each with the nearest known landmark of a solution, independently of its data association."""
        total = 0.0
        for keyframe, pose in zip(self.keyframes, solution.pose, strict=True):
            _, position = _nearest_known(revisit, keyframe, pose, solution)
            if len(position):
                C = Pose2(*pose.tolist()).rotation()
                y = (position - pose[:2]) @ C - keyframe.centre
                xx, xy, yy = keyframe.R.T
                d2 = (yy * y[:, 0] ** 2 - 2.0 * xy * y[:, 0] * y[:, 1] + xx * y[:, 1] ** 2) / (
                    xx * yy - xy**2
                )
                total += float(cauchy_weight(d2).sum())
        return total

    def with_known(self, whole: KeyframeGraph, revisit: Revisit, solution: Solution) -> KeyframeGraph:
        """Return the graph with the detections of a revisit that it does not have, but `whole` (the same
        keyframes) has: each as the nearest known landmark in a solution within TWICE, unless the keyframe has
        this landmark already. Other ones are left out."""
        keyframes = list(self.keyframes)
        for n, (mine, full) in enumerate(zip(self.keyframes, whole.keyframes, strict=True)):
            left = np.flatnonzero(revisit.of(full))
            birth, position = _nearest_known(revisit, full, solution.pose[n], solution)
            if not len(left) or not len(birth):
                continue
            away = np.hypot(*(position - _in_map(full.centre, solution.pose[n])).T)
            near = left[(away[left] < TWICE) & ~np.isin(birth[left], mine.birth)]
            near = near[np.argsort(away[near], kind="stable")]  # the nearest detection of a landmark is first
            near = near[np.unique(birth[near], return_index=True)[1]]
            keyframes[n] = replace(
                mine,
                birth=np.concatenate([mine.birth, birth[near]]),
                centre=np.concatenate([mine.centre, full.centre[near]]),
                R=np.concatenate([mine.R, full.R[near]]),
            )
        return replace(self, keyframes=tuple(keyframes))

    def thinned(self) -> KeyframeGraph:
        """Return the graph without every second keyframe, and without every second loop of more than
        LOOPS_MAX. The ends of the other loops and the newest keyframe stay.

        Motions are compounded; over a keyframe without odometry the covariance is infinite. The next keyframe
        takes the detections of a dropped one at the present relative pose, combined by landmark and at most
        STEMS_MAX of them; without odometry between both they are lost."""
        loops = self.loops
        while len(loops) > LOOPS_MAX:
            loops = loops[len(loops) % 2 :: 2]
        ends = {scan for loop in loops for scan in loop.scans} | {self.newest_scan}
        rows, kept = list[int](), list[Keyframe]()
        motion, covariance = np.zeros(3), np.zeros((3, 3))
        dropped = list[int]()
        for row, keyframe in enumerate(self.keyframes):
            x, y, yaw = keyframe.motion
            unknown = not (np.isfinite(covariance).all() and np.isfinite(keyframe.covariance).all())
            motion, covariance = compounded(motion, covariance, x, y, yaw, keyframe.covariance)
            if unknown:
                covariance = np.full((3, 3), np.inf)
                dropped.clear()  # their pose relative to this keyframe is unknown
            dropped.append(row)
            if row % 2 == 0 or keyframe.scan in ends:
                T_keyframe_base = composed(inverse(self.pose[row][None]), self.pose[dropped])
                birth, centre, R = combined([self.keyframes[k] for k in dropped], T_keyframe_base)
                rows.append(row)
                kept.append(
                    replace(keyframe, motion=motion, covariance=covariance, birth=birth, centre=centre, R=R)
                )
                motion, covariance = np.zeros(3), np.zeros((3, 3))
                dropped.clear()
        solved = int(np.searchsorted(rows, self.solved))
        return replace(self, keyframes=tuple(kept), pose=self.pose[rows], loops=loops, solved=solved)

    def solve(self, *, added: int = 0) -> Solution | None:
        """Return the minimum next to the present poses. None with fewer than two keyframes, if the problem is
        singular, if a covariance is not positive definite, or if no step decreases the cost. After
        ITERATIONS_MAX steps the best estimate so far is the result. The graph is unchanged.

        Args:
            added: Number of loops at the end that have their full weight, without the kernel, which has no
                slope far from the minimum: a loop that was just added, or those of a person.
        """
        if len(self.keyframes) < 2:
            return None
        try:
            problem = Problem(self)
            minimum = problem.minimum(quadratic_loops=added)
            if minimum is None:
                return None
            pose, stem, normal = minimum
            # A block of the diagonal is the information of a pose given all other unknowns.
            conditional = np.linalg.inv(normal.U[-1])
            return Solution(pose, problem.birth, stem, *problem.marginals(normal), conditional)
        except np.linalg.LinAlgError:
            return None

    def _is_revisit(self, keyframe: Keyframe) -> bool:
        """Return whether a keyframe detects at least two landmarks that were begun more than REVISIT_DISTANCE
        of path ago and that no keyframe within this distance detected. False while the path is shorter."""
        recent: list[Int] = []
        first_birth = -1
        for before in reversed(self.keyframes):
            if keyframe.distance - before.distance > REVISIT_DISTANCE:
                first_birth = before.first_birth
                break
            recent.append(before.birth)
        if first_birth < 0:
            return False
        old = keyframe.birth[keyframe.birth < first_birth]
        seen = np.concatenate(recent) if recent else old[:0]
        return int(np.count_nonzero(~np.isin(old, seen))) >= 2


def _in_map(centre: Float, pose: Float) -> Float:
    """Return detections in the frame of the base, shape (D, 2) [m], in the map at a pose, shape (3,)."""
    return pose[:2] + centre @ Pose2(*pose.tolist()).rotation().T


def _nearest_known(
    revisit: Revisit, keyframe: Keyframe, pose: Float, solution: Solution
) -> tuple[Int, Float]:
    """Return the nearest known landmark of each detection of a keyframe at a pose, shape (3,): birth numbers,
    shape (D,), and positions in a solution, shape (D, 2) [m]; both empty outside of the revisit and without
    known landmarks."""
    known = solution.birth < revisit.first_birth
    if keyframe.distance < revisit.begin or not known.any() or not len(keyframe.birth):
        return np.zeros(0, np.int64), np.zeros((0, 2))
    place = solution.position[known]
    away = _in_map(keyframe.centre, pose)[:, None] - place[None]
    nearest = np.argmin(np.einsum("dlk,dlk->dl", away, away), axis=1)
    return solution.birth[known][nearest], place[nearest]


JUMP, JUMP_TURN = 1.0, 1.0  # m, rad; a larger difference between path and odometry is no motion
TWICE = 1.0  # m; closer landmarks of before and after the loop are the same tree


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """A loop: the robot is at a known place again.

    Attributes:
        first: Scan at which the robot left the place.
        anchor: Scan at or before `first` that was taken near the place.
        T_map_base: Pose of the base at the newest scan.
        covariance: Covariance of this pose relative to the trees there, x, y [m], yaw [rad], shape (3, 3).
    """

    first: int
    anchor: int
    T_map_base: Pose2
    covariance: Float


def corrected_path(path: Float, graph: KeyframeGraph, solution: Solution) -> Float:
    """Return the path with the keyframes of a solution, x, y [m], yaw [rad], shape (N, 3).

    Between two keyframes the path keeps its shape, and the difference at the second one is spread evenly.
    Scans before the first keyframe and after the last one move with it. A section without odometry (infinite
    covariance) moves with the keyframe at its start. `path` is the path before, with the same shape; the
    graph has at least one keyframe.
    """
    scans = graph.scans
    keyframe = np.maximum(np.searchsorted(scans, np.arange(len(path)), side="right") - 1, 0)
    before = path[scans]
    since = composed(inverse(before[keyframe]), path)
    motions = np.concatenate([np.full((1, 3), np.nan), composed(inverse(before[:-1]), before[1:])])
    motions[[not np.isfinite(k.covariance).all() for k in graph.keyframes]] = np.nan
    return interpolated(solution.pose, motions, scans, keyframe, since)


def corrected_landmarks(
    known: MapColumns, graph: KeyframeGraph, solution: Solution, path: Float
) -> MapColumns:
    """Return the landmarks of one particle after a correction of the path.

    A landmark of the graph is at its solution; another one moves with the keyframe that began it. All
    covariances turn with that keyframe. Hits, scores and births are unchanged.

    Args:
        known: Landmarks of the particle.
        graph: Keyframes with the births of their landmarks.
        solution: Corrected keyframes and landmarks.
        path: Path of the particle before the correction, shape (N, 3).
    """
    mean, turn = _moved_rigidly(known.mean, known.birth, graph, solution, path)
    _, ours, theirs = np.intersect1d(known.birth, solution.birth, return_indices=True)
    mean[ours] = solution.position[theirs]
    return known._replace(mean=mean, covariance=rotated_rows(known.covariance, turn))


def _moved_rigidly(
    place: Float, birth: Int, graph: KeyframeGraph, solution: Solution, path: Float
) -> tuple[Float, Float]:
    """Return the positions of landmarks, each moved rigidly with the keyframe that began it, shape (L, 2)
    [m], and the rotations of these keyframes, shape (L,) [rad]. Landmarks from before the first keyframe move
    with the first one.

    Args:
        place: Positions of the landmarks, shape (L, 2) [m].
        birth: Birth numbers of the landmarks, int64, shape (L,).
        graph, solution: Keyframes and their corrected poses.
        path: Path before the correction, shape (N, 3).
    """
    first = np.array([k.first_birth for k in graph.keyframes], np.int64)
    row = np.maximum(np.searchsorted(first, birth, side="right") - 1, 0)
    was, now = path[graph.scans][row], solution.pose[row]
    turn = wrap_angle(now[:, 2] - was[:, 2])
    c, s = np.cos(turn), np.sin(turn)
    dx, dy = (place - was[:, :2]).T
    return now[:, :2] + np.column_stack([c * dx - s * dy, s * dx + c * dy]), turn


def same_trees(known: MapColumns, first_birth: int) -> tuple[Int, Int]:
    """Return pairs of landmarks within TWICE of each other, one begun before a loop and one after it, each
    landmark in at most one pair (pairs with the highest likelihood first): the birth numbers of the later
    ones, ascending, and of the earlier ones, int64, shape (N,) each.

    Args:
        known: Landmarks of one particle after the correction.
        first_birth: Birth number of the first landmark after the loop.
    """
    old, young = np.flatnonzero(known.birth < first_birth), np.flatnonzero(known.birth >= first_birth)
    of, _ = associate(
        known.mean[young], known.covariance[young], known.mean[old], known.covariance[old], np.inf, TWICE
    )
    again = np.flatnonzero(of >= 0)
    birth, name = known.birth[young[again]], known.birth[old[of[again]]]
    order = np.argsort(birth)
    return birth[order], name[order]


def joined(known: MapColumns, birth: Int, name: Int) -> MapColumns:
    """Return the landmarks without those of the birth numbers `birth`; their hits are added to the landmarks
    of the birth numbers `name`, which keep position and covariance and get the better score of the pair.

    Args:
        known: Landmarks of one particle.
        birth: Landmarks that are removed, int64, shape (N,).
        name: The remaining landmark of each pair, int64, shape (N,); see `same_trees`.

    Raises:
        KeyError: A birth number does not exist.
    """
    hits, score = known.hits.copy(), known.score.copy()
    keep = np.ones(len(known.birth), np.bool_)
    row = {int(b): k for k, b in enumerate(known.birth)}
    for young, old in zip(birth.tolist(), name.tolist(), strict=True):
        k, o = row[young], row[old]
        hits[o] += hits[k]
        score[o] = max(score[o], score[k])
        keep[k] = False
    return MapColumns(known.mean[keep], known.covariance[keep], hits[keep], score[keep], known.birth[keep])


def without_jumps(path: Float, motion: Float) -> tuple[Float, int]:
    """Return a copy of the path with each jump replaced by the motion of the odometry, and the number of
    jumps; the path after a jump moves rigidly.

    A jump is a step of the path that differs from the odometry by more than JUMP or JUMP_TURN: a correction
    moved the pose, not the robot. A long step that the odometry reports is no jump, since scans may be lost.

    Args:
        path: x, y [m], yaw [rad], shape (N, 3).
        motion: Motion by odometry from the scan before to each scan, shape (N, 3); row 0 is ignored.
    """
    step = composed(inverse(path[:-1]), path[1:])
    apart = step - motion[1:]
    turned = np.abs(wrap_angle(apart[:, 2])) > JUMP_TURN
    jumps = np.flatnonzero((np.hypot(*apart[:, :2].T) > JUMP) | turned).tolist()
    out = path.copy()
    for k in jumps:
        go_on = composed(out[k][None], motion[k + 1][None])
        tail = composed(inverse(out[k + 1][None]).repeat(len(out) - k - 1, axis=0), out[k + 1 :])
        out[k + 1 :] = composed(go_on.repeat(len(tail), axis=0), tail)
    return out, len(jumps)


def drift_of(path: Float, first: int, noise: Noise) -> Float:
    """Return the covariance of the last pose relative to that of scan `first`, x, y [m], yaw [rad], shape (3,
    3), if only odometry connects the two. A heading error moves all later positions. Zeros if `first` is the
    last scan. `path` has the shape (N, 3)."""
    step = np.diff(path[first:], axis=0)
    distance = np.hypot(step[:, 0], step[:, 1])
    heading = noise.turn_distance**2 * distance + noise.turn**2 * np.abs(wrap_angle(step[:, 2]))
    ahead = path[-1, :2] - path[first + 1 :, :2]
    lever = np.column_stack([-ahead[:, 1], ahead[:, 0], np.ones(len(ahead))])
    total: Float = (lever * heading[:, None]).T @ lever
    total += noise.distance**2 * float(distance.sum()) * np.diag([1.0, 1.0, 0.0])
    return total
