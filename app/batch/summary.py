"""Totals of a run and its summary as text."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from app.common.text import count
from pipeline.config import Parameters
from pipeline.evaluation import MapScores, PathError, Rate
from pipeline.geometry.columns import rows_of
from pipeline.geometry.poses import Float
from pipeline.io.readers import MessageFormat, added
from pipeline.map_faults import DOUBTFUL
from pipeline.odometry.synchroniser import JUMP_SPEED, PAUSE_NS
from pipeline.types.records import Frame, Health, HealthState, Int, Path, Verdict

if TYPE_CHECKING:
    from app.batch.saved_run import RunSource
    from pipeline.io.readers.base import RecordedTopic


_ROWS = 16_384  # of a path that are added up at once: a status is sent many times a second
MOST_SPANS = 200  # written; the rest is counted


@dataclass(slots=True)
class _HealthSpan:
    """Consecutive scans with one state of the pose quality; the reason is that of the first scan."""

    state: HealthState
    reason: str
    first: int
    last: int
    start_ns: int
    end_ns: int


@dataclass(slots=True, eq=False)
class RunHealth:
    """Pose quality over a run: numbers of scans by state, worst values, and spans of weak or lost scans."""

    _scans: Counter[str] = field(default_factory=Counter)
    _spans: list[_HealthSpan] = field(default_factory=list)
    _spans_left_out: int = 0
    _was: HealthState = "good"
    _worst: dict[str, float] = field(default_factory=dict)

    @classmethod
    def of_both(cls, first: RunHealth, second: RunHealth, scans: int, shift_ns: int) -> RunHealth:
        """Return the pose quality of two consecutive runs as another object; at most MOST_SPANS spans are
        kept, the others counted.

        Args:
            first, second: Pose quality of the runs.
            scans: Number of scans of the first run.
            shift_ns: Offset that is added to the times of the second run [ns].
        """
        moved = [
            replace(
                span,
                first=span.first + scans,
                last=span.last + scans,
                start_ns=span.start_ns + shift_ns,
                end_ns=span.end_ns + shift_ns,
            )
            for span in second._spans
        ]
        spans = first._spans + moved
        left_out = first._spans_left_out + second._spans_left_out + max(len(spans) - MOST_SPANS, 0)
        worst = {
            name: (min if name in ("n_eff", "ancestors") else max)(
                run._worst[name] for run in (first, second) if name in run._worst
            )
            for name in {**first._worst, **second._worst}
        }
        return cls(first._scans + second._scans, spans[:MOST_SPANS], left_out, second._was, worst)

    def add(self, frame: Frame) -> None:
        """Add the next scan: count its state, update the worst values, and extend or begin a span if it is
        not good."""
        health = frame.health
        self._scans[health.state] += 1
        self._remember_worst(health)
        if health.state != "good":
            self._extend(frame, health)
        self._was = health.state

    def _extend(self, frame: Frame, health: Health) -> None:
        """Extend the last span if the state is the same as in the scan before, else begin one; above
        MOST_SPANS spans are only counted."""
        if health.state == self._was and (self._spans or self._spans_left_out):
            if not self._spans_left_out:
                self._spans[-1].last, self._spans[-1].end_ns = frame.index, frame.stamp_ns
        elif len(self._spans) < MOST_SPANS:
            at, stamp = frame.index, frame.stamp_ns
            self._spans.append(_HealthSpan(health.state, health.reason, at, at, stamp, stamp))
        else:
            self._spans_left_out += 1

    def _remember_worst(self, health: Health) -> None:
        """Update the worst values: the minimum of n_eff and ancestors, and the maximum, at least 0, of the
        others. Maxima ignore values that are not finite."""
        found = {
            "sigma_xy_m": health.sigma_xy,
            "sigma_yaw_deg": math.degrees(health.sigma_yaw),
            "innovation": health.innovation,
            "odometry_sigmas": health.odometry,
            "ambiguous": health.ambiguous,
        }
        for name, value in found.items():
            if math.isfinite(value):
                self._worst[name] = max(value, self._worst.get(name, 0.0))
        for name, value in {"n_eff": health.n_eff, "ancestors": float(health.ancestors)}.items():
            self._worst[name] = min(value, self._worst.get(name, math.inf))

    def record(self, start_ns: int) -> dict[str, Any]:
        """Return the record for run.json as a dict.

        The keys are `scans`, a dict from each state to its number of scans; `worst`, a dict with the worst
        values that are known of `sigma_xy_m`, `sigma_yaw_deg`, `innovation`, `odometry_sigmas`, `ambiguous`,
        `n_eff` and `ancestors`; `spans`, a list of at most MOST_SPANS dicts with `state`, `reason`, `scans`
        [first, last] and `time_s` [first, last], seconds after `start_ns`; and `spans_left_out`, the number
        of further spans.
        """
        return {
            "scans": {state: self._scans[state] for state in ("good", "weak", "lost")},
            "worst": {name: round(value, 4) for name, value in sorted(self._worst.items())},
            "spans": [
                {
                    "state": span.state,
                    "reason": span.reason,
                    "scans": [span.first, span.last],
                    "time_s": [round((t - start_ns) * 1e-9, 3) for t in (span.start_ns, span.end_ns)],
                }
                for span in self._spans
            ],
            "spans_left_out": self._spans_left_out,
        }

    def summary(self) -> list[str]:
        """Return a line for people if any scan was weak or lost; else []."""
        weak, lost = self._scans["weak"], self._scans["lost"]
        if not weak and not lost:
            return []
        why = Counter(span.reason.partition(" by ")[0].partition(" for ")[0] for span in self._spans)
        return [f"health: {count(weak, 'scan')} weak, {lost} lost; most often: {why.most_common(1)[0][0]}"]


JUST_BEGUN = 20  # scans


STILL_M = 0.1


def health_word(frame: Frame | None, distance_m: float = math.inf) -> str:
    """Return the pose quality of a scan in one or two words: that of `Health.state`, or why it is too early.

    "good" means that nothing contradicts the pose. Without trees, and in the first `JUST_BEGUN` scans,
    nothing could contradict it; the result is then "no trees yet" or "just begun", and "no scan yet" for
    None. The pose of a sensor that has moved less than STILL_M is not tested either: "static".

    Args:
        frame: Results of the scan.
        distance_m: Driven distance [m].
    """
    if frame is None:
        return "no scan yet"
    if frame.estimate.health.state != "good":
        return frame.estimate.health.state
    if not frame.trees.confirmed.any():
        return "no trees yet"
    if frame.health.state != "good":
        return frame.health.state
    if frame.index < JUST_BEGUN:
        return "just begun"
    return "static" if distance_m < STILL_M else "good"


_SAME_DRIVE = ("origin", "resume")
_NS = 1e-9


@dataclass(slots=True, eq=False)
class RunTotals:
    """Counts over a run.

    Attributes:
        warned: Counter from each warning to the number of times that it was given.
        points: Dict from the names in `Frame.counts` to sums over the scans.
        verdicts: Number of clusters by label of the verdict.
        health: Quality of the poses.
    """

    warned: Counter[str]
    points: Counter[str] = field(default_factory=Counter)
    verdicts: Counter[str] = field(default_factory=Counter)
    health: RunHealth = field(default_factory=RunHealth)

    def add(self, frame: Frame) -> None:
        """Add the next scan: its pose quality, counts of points, verdicts of clusters and warnings."""
        self.health.add(frame)
        self.points.update(frame.counts)
        self.verdicts.update(Verdict(int(v)).label for v in frame.clusters.verdict)
        self.warned.update(frame.warnings)

    def warnings(self) -> list[str]:
        """Return each warning once, see `warning_texts`."""
        return warning_texts(self.warned)


def lost_share(health: Mapping[str, int]) -> float | None:
    """Return the share of scans in which the pose was lost, from 0 to 1; None if there are no scans.

    Args:
        health: Dict from the state of the pose quality, see `Health`, to its number of scans.
    """
    scans = sum(health.values())
    return health.get("lost", 0) / scans if scans else None


def warning_texts(warned: Mapping[str, int]) -> list[str]:
    """Return each warning once, with the number of times that it was given if that is not 1."""
    return [text if n == 1 else f"{text} ({n:,} times)" for text, n in warned.items()]


def exit_code(warnings: Iterable[str], losses: Mapping[str, int], wrong: tuple[str, ...]) -> int:
    """Return the exit code of a mapping command: 3 with losses or with a warning that begins with one of
    `wrong`; else 0.

    Args:
        warnings: Messages to the user.
        losses: Dict from reasons to numbers of records that were left out.
        wrong: First words of warnings after which the map is not to be trusted.
    """
    return 3 if losses or any(text.startswith(wrong) for text in warnings) else 0


def unconfirmed_warning(frame: Frame, parameters: Parameters) -> str:
    """Return a warning with the number of trees that are not confirmed; "" if there are none, or if a
    classifier confirms trees by more than their number of scans.

    Args:
        frame: Results of the last scan.
        parameters: Parameters of the mapping.
    """
    tentative = int(np.count_nonzero(~frame.trees.confirmed))
    if parameters.classification.method != "none" or not tentative:
        return ""
    them, p = "1 tree was" if tentative == 1 else f"{tentative} trees were", parameters.tracking
    times, flags = f"fewer than {p.hits_to_confirm} times", "--set tracking.hits_to_confirm=1"
    if p.confirm_time:
        times += f" or for less than {p.confirm_time:g} s"
        flags += " --set tracking.confirm_time=0"
    return f"{them} seen {times} and left out of the map; {flags} includes them"


_MOST_LISTED = 12  # trees
LEFT_OUT = 0.1  # share of the scans above which their loss makes the map doubtful


def scans_left_out(losses: Mapping[str, int]) -> dict[str, int]:
    """Return the losses of whole scans, whose reasons begin with "scans"; others, such as poses or times of
    points, are of scans that are mapped without them."""
    return {reason: n for reason, n in losses.items() if reason.startswith("scans")}


def left_out_warning(losses: Mapping[str, int], scans: int) -> str:
    """Return a warning if more than LEFT_OUT of the scans of a run were left out; else "".

    Args:
        losses: Dict from reasons to numbers of records that were left out, see `scans_left_out`.
        scans: Number of mapped scans.
    """
    left_out = scans_left_out(losses)
    lost = sum(left_out.values())
    if lost <= LEFT_OUT * (lost + scans):
        return ""
    return (
        f"{DOUBTFUL} in the whole run: {lost:,} of {lost + scans:,} scans were left out, most often: "
        f"{max(left_out, key=left_out.__getitem__)}; trees may be missing"
    )


def far_truth(reach: float) -> str:
    """Return the message for ground truth that is not within `reach` metres of the path."""
    return (
        f"no ground truth is within {reach:g} m of the path: it must be in the frame of the map, "
        "with the first pose as the origin and x along its heading "
        "(evaluation.reach includes trees at a larger distance)"
    )


def far_map(scores: MapScores, match_distance: float) -> str:
    """Return the message for a map in which no true tree is matched; "" if at least one is matched, or there
    are no true trees near the path.

    Args:
        scores: Scores of the map.
        match_distance: Maximum distance between a tree and its ground truth [m].
    """
    if scores.TA.count or not scores.TA.of:
        return ""
    return f"none of {count(scores.TA.of, 'true tree')} has a mapped tree within {match_distance:g} m"


def breaks_of(sources: Iterable[RunSource]) -> list[int]:
    """Return the indices of the scans with which another drive begins; a resumed drive is not another one."""
    return [source.from_scan for source in sources if source.start not in _SAME_DRIVE]


def driven_steps(path: Path) -> Float:
    """Return the distance driven from each scan to the next one [m], shape (N - 1,) for N > 0.

    The distance is 0 across a pause (PAUSE_NS), because the sender may have restarted, and across a jump
    (JUMP_SPEED), because the pose was set and the robot did not drive. A pause is also longer than twice the
    lower quartile of the times between scans, because a robot may stop for each scan.
    """
    return _steps(path, _longest_step_ns(path.stamp_ns))


def _longest_step_ns(stamp_ns: Int) -> float:
    """Return the longest time between two scans that is no pause [ns]."""
    parts = (stamp_ns[k : k + _ROWS + 1] for k in range(0, len(stamp_ns) - 1, _ROWS))
    if all((np.diff(part) <= PAUSE_NS).all() for part in parts):
        return PAUSE_NS
    return max(PAUSE_NS, 2 * float(np.percentile(np.diff(stamp_ns), 25, method="lower")))


def _steps(path: Path, longest_ns: float) -> Float:
    metres: Float = np.hypot(np.diff(path.x), np.diff(path.y))
    time_ns = np.diff(path.stamp_ns)
    is_driven = (time_ns <= longest_ns) & (metres <= JUMP_SPEED * np.maximum(time_ns * _NS, 0.1))
    return np.where(is_driven, metres, 0.0)


def driven(path: Path, breaks: Iterable[int] = ()) -> tuple[float, float]:
    """Return duration [s] and distance [m] of the drives, without the gaps between two drives; 0, 0 for fewer
    than two scans. See `driven_steps`.

    Args:
        path: One row per scan.
        breaks: First scan of each further drive, see `breaks_of`; others than 1 to N - 1 are ignored.
    """
    longest_ns, time_ns, metres, breaks = _longest_step_ns(path.stamp_ns), 0, 0.0, tuple(breaks)
    for start in range(0, len(path.x) - 1, _ROWS):
        part = rows_of(path, slice(start, start + _ROWS + 1))
        is_step = np.ones(len(part.x) - 1, np.bool_)
        is_step[[scan - start - 1 for scan in breaks if start < scan < start + len(part.x)]] = False
        time_ns += int(np.diff(part.stamp_ns)[is_step].sum())
        metres += float(_steps(part, longest_ns)[is_step].sum())
    return time_ns * _NS, metres


def summary_lines(
    uri: str,
    frame: Frame,
    driven_s_m: tuple[float, float],
    evaluation: MapScores | None,
    error: PathError | None,
) -> list[str]:
    """Return the summary of a run, with scores where ground truth is known.

    Args:
        uri: URI of the source.
        frame: Result of the last scan.
        driven_s_m: Duration [s] and distance [m].
        evaluation, error: Scores of trees and path; None if there is no ground truth.
    """
    seconds, metres = driven_s_m
    trees = int(np.count_nonzero(frame.trees.confirmed))
    scans = count(frame.index + 1, "scan")
    with_dbh = int(np.count_nonzero(frame.trees.confirmed & np.isfinite(frame.trees.dbh)))
    mapped = f"{count(trees, 'tree')}, {with_dbh} of them with a DBH"
    if trees and not with_dbh:
        mapped += " (a DBH needs views of more sides of the trunk)"
    lines = [f"{uri}: {scans}, {seconds:.1f} s, {metres:.1f} m driven, {mapped}"]
    if evaluation is not None:
        lines += evaluation_lines(evaluation)
    if error is not None:
        how = "after alignment" if error.aligned else "in the frame of the map"
        lines.append(
            f"path: RMS {error.rms:.3f} m, median {error.median:.3f} m, largest {error.largest:.3f} m "
            f"({count(error.compared, 'true position')}, {how})"
        )
    return lines


def evaluation_lines(e: MapScores, *, whole: bool = False) -> list[str]:
    """Return the scores as text, with counts and rates; "-" for an unknown value, and a warning if the ground
    truth is in doubt.

    Args:
        e: The scores.
        whole: Whether all true trees count, as without a drive.
    """
    where = "in the whole plot" if whole else f"within {e.reach:g} m of the path"
    beyond = count(e.beyond, "object of the ground truth is", "objects of the ground truth are")
    doubt = truth_in_doubt(e)
    return [
        f"trees found (TA) {rate_text(e.TA)}, missed (FR) {rate_text(e.FR)} {where}",
        *([f"not counted: {beyond} farther from the path (evaluation.reach)"] if e.beyond else []),
        f"other objects left out (TR) {rate_text(e.TR)}, mapped as trees (FA) {rate_text(e.FA)}; "
        f"{count(e.spurious, 'spurious tree')}",
        *([f"missed at x, y [m]: {_listed([f'{x:.1f}, {y:.1f}' for x, y in e.missed])}"] if e.missed else []),
        *([f"false trees of the map: {_listed([str(number) for number in e.false])}"] if e.false else []),
        f"completeness {_percent(e.completeness)}   correctness {_percent(e.correctness)}   "
        f"F1 {_percent(e.f1)}",
        f"position RMSE {_metres(e.position_rmse)}   DBH RMSE {_metres(e.dbh_rmse)} "
        f"({count(e.dbh_count, 'tree')})   mean pair error {_pair(e.mean_pair_error_percent)}",
        *([f"warning: {doubt}"] if doubt else []),
    ]


def _listed(names: list[str]) -> str:
    """Return the first _MOST_LISTED names as text, and how many more there are."""
    more = len(names) - _MOST_LISTED
    return "; ".join(names[:_MOST_LISTED]) + (f"; and {more} more" if more > 0 else "")


def truth_in_doubt(e: MapScores) -> str:
    """Return a warning that the ground truth may belong to another forest, or that the unit of its diameters
    is wrong; "" if neither is in doubt, see `MapScores`."""
    if not e.is_doubtful:
        return _unit_in_doubt(e.dbh_factor)
    few = f"only {e.TA.count}" if e.TA.count else "none"
    verb = "is" if e.TA.count <= 1 else "are"
    return (
        f"{few} of {count(e.TA.of, 'true tree')} {verb} near a mapped one: is this the ground truth of this "
        "forest, in the frame of the map?"
    )


def _unit_in_doubt(factor: float) -> str:
    """Return a warning that diameters are `factor` times too large; "" for 1."""
    if factor == 1.0:
        return ""
    times = f"{factor:g} times" if factor > 1.0 else f"1/{1.0 / factor:g} of"
    return (
        f"the diameters of the ground truth are about {times} those of the map: is their unit right? The "
        "name of their column states it (dbh_mm, dbh_cm, dbh_m), or --dbh-unit for a column dbh"
    )


def rate_text(rate: Rate) -> str:
    """Return a rate as text, for example "9/10 (90.0 %)"."""
    return f"{rate.count}/{rate.of} ({_percent(rate.rate)})"


def _percent(value: float | None) -> str:
    """Return a share as text in percent; "-" for None."""
    return "-" if value is None else f"{100.0 * value:.1f} %"


def _metres(value: float | None) -> str:
    """Return a length [m] as text with its value in centimetres, "3.2 cm"; "-" for None."""
    return "-" if value is None else f"{100.0 * value:.1f} cm"


def _pair(value: float | None) -> str:
    """Return a pair error [%] as text; "-" for None."""
    return "-" if value is None else f"{value:.2f} %"


def unread_scans(topics: Iterable[RecordedTopic]) -> list[str]:
    """Return a line that names the topics of further LiDARs of a recording, which are not read; [] without
    any. A topic in the frame of the one that is read has the same LiDAR."""
    known = list(topics)
    read = [topic for topic in known if topic.read_as == "scan"]
    frames = {topic.frame for topic in read} - {""}
    is_planar = any(topic.type.endswith("/LaserScan") for topic in read)
    # Packets are those of a LiDAR whose clouds are read, except beside a planar one.
    kinds = [kind for kind in added(MessageFormat) if kind.sweeps is not None or kind.recording is not None]
    packets = {name for kind in kinds for name in kind.msgtypes}
    usable = {name for kind in kinds if not kind.refusal for name in kind.msgtypes}
    unread = [
        topic.name
        for topic in known
        if topic.messages
        and not topic.read_as
        and topic.frame not in frames
        and (is_planar and topic.type in usable if topic.type in packets else topic.fits == "scan")
    ]
    return [f"not read: {', '.join(unread)}, further scans; --topic scan=NAME maps another"] * bool(unread)


def start_lines(last: RunSource) -> list[str]:
    """Return where a run was found to start in an earlier map, as one line for people; [] if its start was
    not found by stems."""
    if last.start != "constellation":
        return []
    x, y, yaw = last.pose
    return [
        f"started at {x:.2f}, {y:.2f} m, {np.degrees(yaw):.1f} degrees of the map: {last.stems} stems agree"
    ]
