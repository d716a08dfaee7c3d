"""Starts without a pose in stored maps, and their results."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import chi2

from app.extensions.maps.localisation import Localiser, State
from app.extensions.maps.localisation.search import search_map
from pipeline.loop_closure.stem_matching import MapStems
from tests.benchmarks.localise.drives import SLACK, Drive, Reference, frame_offsets

WITHIN = 60.0  # m of driving
LONGER = 20.0  # m, in which a fix is followed
WRONG_XY, WRONG_YAW = 2.0, math.radians(5.0)


@dataclass(slots=True, eq=False)
class Start:
    """Result of one start in one map.

    Attributes:
        is_there: Whether the stored drive passed the whole path.
        found: Distance driven until the robot was found [m]; NaN if it was not.
        wrong: Whether a wrong pose was reported as found at any time.
        error_xy, error_yaw: Median errors while it was found [m, rad]; NaN if not found or unknown.
        search_s: CPU times of the scans with a search [s].
        state: State at the end.
        withdrawn: Number of withdrawn fixes.
        squared: Squared Mahalanobis distance of the position while it was found.
    """

    is_there: bool
    found: float = math.nan
    wrong: bool = False
    error_xy: float = math.nan
    error_yaw: float = math.nan
    search_s: list[float] = field(default_factory=list)
    state: State = State.SEARCHING
    withdrawn: int = 0
    squared: list[float] = field(default_factory=list)


def run_start(
    drive: Drive,
    begin: int,
    seed: int,
    references: Sequence[Reference],
    stored: Sequence[Drive | None] | None = None,
) -> list[Start]:
    """Return the results of one start of a drive in some maps; the way is mapped once.

    Args:
        drive: The drive.
        begin: Its first frame.
        seed: Of odometry and mapper.
        references: The stored maps.
        stored: The recorded drive of each map, by which the true poses are corrected, see `frame_offsets`;
            None where the true poses share a frame.
    """
    truth, driven = drive.truth, drive.driven
    end = int(np.searchsorted(driven, driven[begin] + WITHIN + LONGER)) + 1
    end = min(end, len(truth))
    drives = [None] * len(references) if stored is None else stored
    offsets = [
        np.zeros((end - begin, 3)) if of is None else frame_offsets(drive, of, begin, end) for of in drives
    ]
    localisers = [Localiser(reference.stored, SLACK, index=reference.index) for reference in references]
    starts = [Start(reference.covers(truth[begin:end, :2])) for reference in references]
    errors: list[list[tuple[float, float]]] = [[] for _ in references]
    for frame, stamp_ns, pose, trees, view in drive.mapped(begin, end, seed):
        for reference, localiser, start, of, offset in zip(
            references, localisers, starts, errors, offsets, strict=True
        ):
            searches, began = localiser.localisation.searches, time.thread_time()
            got = localiser.update(stamp_ns, pose, trees, view=view)
            if got.searches > searches:
                start.search_s.append(time.thread_time() - began)
            start.state, start.withdrawn = got.state, got.withdrawn
            if got.T_map_odom is None:
                continue
            if math.isnan(start.found):
                start.found = got.driven
            shift, is_at = offset[frame - begin], got.T_map_odom @ pose
            there = reference.there(truth[frame] + np.nan_to_num(shift))
            off = there.inverse() @ is_at
            distance = math.hypot(off.x, off.y)
            start.wrong = start.wrong or distance > WRONG_XY or abs(off.yaw) > WRONG_YAW
            if np.isnan(shift).any():
                continue
            of.append((distance, abs(off.yaw)))
            error = np.array([is_at.x - there.x, is_at.y - there.y])
            start.squared.append(float(error @ np.linalg.solve(got.covariance[:2, :2], error)))
    for start, of in zip(starts, errors, strict=True):
        if of:
            start.error_xy, start.error_yaw = (float(v) for v in np.median(of, axis=0))
    return starts


REVISIT = 5.0  # m; TreeLoc++ counts a place within it as found
SEEN = 30.0  # m around the robot, in which the stems of a single frame are
SIGMA = 0.05  # m; of a stem
LEVEL = 1e-6  # of false alarms; the best pose is counted without its test


def frames_found(drive: Drive, reference: Reference) -> tuple[int, int]:
    """Return how many single frames of a drive are found in a stored map, and the number of frames within
    REVISIT of its drive.

    A frame is levelled by its true roll and pitch, as by gravity. The best pose of a search counts as found
    within REVISIT, whether or not the search accepts it (recall@1).
    """
    index = reference.index
    found = of = 0
    for k, truth in enumerate(drive.truth):
        if not reference.covers(truth[None, :2], REVISIT):
            continue
        there = reference.there(truth)
        of += 1
        here = drive.seen(k, SEEN) - truth[:2]
        unknown = np.full(len(here), np.nan)
        stems = MapStems(here, np.full(len(here), SIGMA), unknown, unknown)
        fix = search_map(stems, index, SLACK, LEVEL)
        if fix.pose is not None:
            found += math.hypot(fix.pose.x - there.x, fix.pose.y - there.y) <= REVISIT
    return found, of


COLUMNS = (
    "on the way",
    "found within 60 m",
    "[%]",
    "wrong fixes",
    "found after [m]",
    "position [cm]",
    "heading [deg]",
    "95 % covers [%]",
    "search [ms]",
    "95 % [ms]",
    "withdrawn",
    "nothing is here",
)


def row_of(starts: Iterable[Start]) -> tuple[int | float, ...]:
    """Return the cells of COLUMNS: starts on the way of the stored drive; of these found within WITHIN, and
    in percent; wrong fixes of all starts; median distance to the fix; medians of position and heading;
    share of the positions in their 95 % intervals; median and 95 % of the search; withdrawn fixes; starts
    that ended in "nothing of this map is here"."""
    starts = list(starts)
    there = [s for s in starts if s.is_there]
    found = [s for s in there if s.found <= WITHIN]
    squared = np.array([d2 for s in found for d2 in s.squared])
    search = [t for s in starts for t in s.search_s] or [math.nan]

    def middle(values: list[float]) -> float:
        known = [v for v in values if not math.isnan(v)]
        return float(np.median(known)) if known else math.nan

    return (
        len(there),
        len(found),
        100.0 * len(found) / max(len(there), 1),
        sum(s.wrong for s in starts),
        middle([s.found for s in found]),
        100.0 * middle([s.error_xy for s in found]),
        math.degrees(middle([s.error_yaw for s in found])),
        100.0 * float(np.mean(squared <= chi2.ppf(0.95, 2))) if len(squared) else math.nan,
        1e3 * float(np.median(search)),
        1e3 * float(np.quantile(search, 0.95)),
        sum(s.withdrawn for s in starts),
        sum(s.state is State.ABSENT for s in starts),
    )
