"""Tests during a run whether its map can be trusted: a fault that lasts for seconds makes the map doubtful
from its beginning on, also if the robot recovers."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.types.records import ALONE, UNCERTAIN, UNDECIDED, Health

# s; time constant of the running share of scans with a fault. Wheels slip for 1 to 3 s at a root or in mud,
# and the trees correct the step; of a continuous fault, the share exceeds FAILED after 3.5 s.
TIME_S = 5.0
FAILED, OVER = 0.5, 0.1  # shares above which a fault is reported, and below which it is over
PERIOD_MAX_S = 0.5  # s; a longer time between two scans is a pause, in which nothing is known

#: First words of the messages. A run that gives one of them ends with exit code 3.
DOUBTFUL = "the map is doubtful"
EMPTY = "no return is within the range limits; are the points in metres?"
GROUNDLESS = "most scans show no ground (is the LiDAR mounted as stated?)"
_EFFECTS = {
    "lost": "trees from there on may be displaced, missing or mapped twice",
    "odometry": "from there on only the trees in view lead the robot: trees may be displaced or mapped twice",
    "trees": "path and trees from there on may be displaced or mapped twice",
    "ground": "heights and diameters are not measured, and trees from there on may be missing or wrong",
}
KINDS = tuple(_EFFECTS)
# Reasons of weak poses that are no faults of the map, because nothing contradicts it: good recordings have
# them for minutes, such as a dense forest (two trees fit) and a park with lawns (no trees, and uncertain
# until the next ones). A position that is uncertain by more than the distance between trees is "lost".
_UNCONTRADICTED = (ALONE, UNCERTAIN, UNDECIDED)


@dataclass(frozen=True, slots=True)
class Fault:
    """A kind of fault during a run.

    Attributes:
        share: Running share of the scans with the fault, from 0 to 1.
        since_ns: Time of the first scan with the fault since the share was below OVER [ns]; -1 without one.
        message: Message about it; "" if it was not reported since then.
    """

    share: float = 0.0
    since_ns: int = -1
    message: str = ""


@dataclass(frozen=True, slots=True)
class MapFaults:
    """Faults during a run.

    Attributes:
        start_ns, stamp_ns: Times of the first and of the last scan [ns]; -1 before the first scan.
        lost, odometry, trees, ground: The robot is lost; the odometry is contradicted or missing; the trees
            contradict their positions in the map; no ground is in view.
    """

    start_ns: int = -1
    stamp_ns: int = -1
    lost: Fault = Fault()
    odometry: Fault = Fault()
    trees: Fault = Fault()
    ground: Fault = Fault()

    @property
    def message(self) -> str:
        """Message about the first kind of fault that was reported and is not over; "" without one."""
        faults = (self.lost, self.odometry, self.trees, self.ground)
        return next((fault.message for fault in faults if fault.message), "")

    def after_scan(self, stamp_ns: int, reasons: dict[str, str]) -> tuple[MapFaults, tuple[str, ...]]:
        """Return the faults after one more scan, and the messages about faults that now last for too long.

        Args:
            stamp_ns: Time of the scan [ns].
            reasons: Dict from the kinds of faults that the scan has to their reasons, see `reasons_of`.
        """
        start_ns = stamp_ns if self.start_ns < 0 else self.start_ns
        period = min((stamp_ns - self.stamp_ns) * 1e-9, PERIOD_MAX_S) if self.stamp_ns >= 0 else 0.0
        faults = {
            kind: _updated(
                getattr(self, kind), kind, reasons.get(kind, ""), stamp_ns, start_ns, period / TIME_S
            )
            for kind in KINDS
        }
        new = tuple(f.message for kind, f in faults.items() if f.message and not getattr(self, kind).message)
        return MapFaults(start_ns, stamp_ns, **faults), new


def _updated(before: Fault, kind: str, reason: str, stamp_ns: int, start_ns: int, weight: float) -> Fault:
    """Return a fault after one more scan.

    Args:
        before: The fault before.
        kind: Its kind.
        reason: Reason why the scan has the fault; "" if it has not.
        stamp_ns, start_ns: Time of this scan and of the first one [ns].
        weight: Weight of the scan in the running share, its period divided by TIME_S.
    """
    share = before.share + min(weight, 1.0) * (float(bool(reason)) - before.share)
    if share < OVER and not reason:
        return Fault(share)
    since_ns, message = stamp_ns if before.since_ns < 0 else before.since_ns, before.message
    if share > FAILED and reason and not message:
        since_s = (since_ns - start_ns) * 1e-9
        message = f"{DOUBTFUL} since {since_s:.1f} s: {reason}; {_EFFECTS[kind]}"
    return Fault(share, since_ns, message)


def fault_of_short_run(scans: int, groundless: int, *, is_empty: bool) -> str:
    """Return a message if most scans of a run do not show the ground, or no return is in range; "" otherwise.
    A run that is shorter than a fault that lasts has no other message about it.

    Args:
        scans, groundless: Number of scans, and of those that do not show the ground.
        is_empty: Whether there are returns, and none within the range limits.
    """
    if is_empty or groundless > FAILED * scans:
        reason = EMPTY if is_empty else GROUNDLESS
        return (
            f"{DOUBTFUL} in the whole run: {reason}; its trees, heights and diameters may be missing or wrong"
        )
    return ""


def reasons_of(health: Health, *, is_ground_missing: bool, is_empty: bool) -> dict[str, str]:
    """Return a dict from the kinds of faults of a scan to their reasons.

    Args:
        health: Quality of the pose.
        is_ground_missing: Whether the ground was searched for and not found.
        is_empty: Whether the scan has returns, and none within the range limits.
    """
    found = {}
    if health.state == "lost":
        found["lost"] = health.reason
    if health.doubt:
        found["odometry"] = health.doubt
    if health.state == "weak" and not health.doubt and not health.reason.startswith(_UNCONTRADICTED):
        found["trees"] = health.reason
    if is_ground_missing or is_empty:
        found["ground"] = EMPTY if is_empty else GROUNDLESS
    return found
