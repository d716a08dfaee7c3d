"""Faults that last make a map doubtful; short ones do not."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.map_faults import DOUBTFUL, EMPTY, GROUNDLESS, MapFaults, fault_of_short_run, reasons_of
from pipeline.slam.pose_quality import RunningStatistics, ScanStatistics, pose_health
from pipeline.types.records import Health

PERIOD_NS = 100_000_000
DOUBT = "the trees contradict the odometry"


def messages_of(pattern, kind="odometry", period_ns=PERIOD_NS):
    """Messages of a run; `pattern` has a 1 for each scan with a fault, 0 for others."""
    faults, messages = MapFaults(), list[str]()
    for k, failed in enumerate(pattern):
        faults, new = faults.after_scan(5 + k * period_ns, {kind: DOUBT} if failed else {})
        messages += new
    return messages, faults


@pytest.mark.parametrize("kind", ["lost", "odometry", "trees", "ground"])
def test_a_fault_of_five_seconds_is_reported_once_with_its_begin(kind):
    messages, faults = messages_of([0] * 100 + [1] * 50, kind)
    assert len(messages) == 1
    assert messages[0].startswith(f"{DOUBTFUL} since 10.0 s: {DOUBT}; ")
    assert faults.message == messages[0]


def test_slips_of_two_seconds_are_not_reported():
    messages, faults = messages_of(([0] * 100 + [1] * 20) * 5)
    assert messages == []
    assert faults.message == ""


def test_a_fault_in_most_of_the_scans_is_reported_once():
    messages, _ = messages_of([1, 1, 1, 0] * 100)
    assert len(messages) == 1
    assert "since 0.8 s" in messages[0]


def test_a_fault_that_is_over_and_returns_is_reported_again():
    messages, faults = messages_of([0] * 10 + [1] * 60 + [0] * 200 + [1] * 60 + [0] * 200)
    assert [text.split(" s:")[0] for text in messages] == [f"{DOUBTFUL} since 1.0", f"{DOUBTFUL} since 27.0"]
    assert faults.message == ""


def test_a_fault_is_measured_by_time_and_not_by_scans():
    assert len(messages_of([1] * 45, period_ns=PERIOD_NS)[0]) == 1
    assert len(messages_of([1] * 450, period_ns=PERIOD_NS // 10)[0]) == 1
    assert len(messages_of([1] * 100, period_ns=PERIOD_NS // 10)[0]) == 0


def test_a_pause_between_two_scans_is_no_fault():
    faults, _ = MapFaults().after_scan(0, {})
    faults, messages = faults.after_scan(3600 * 10**9, {"odometry": "no scan for 3600 s"})
    assert messages == ()
    assert faults.message == ""


def test_the_reasons_are_those_of_the_pose_quality_and_of_the_ground():
    def reasons(state="good", reason="", doubt="", *, ground=False, empty=False):
        health = Health(state=state, reason=reason, doubt=doubt)
        return reasons_of(health, is_ground_missing=ground, is_empty=empty)

    assert reasons() == {}
    assert reasons(state="lost", reason="no tree is found") == {"lost": "no tree is found"}
    assert reasons(state="good", doubt=DOUBT) == {"odometry": DOUBT}
    assert reasons(state="weak", reason=DOUBT, doubt=DOUBT) == {"odometry": DOUBT}
    strange = "most detections are at places without a tree in the map"
    assert reasons(state="weak", reason=strange) == {"trees": strange}
    assert "ground" in reasons(ground=True)
    assert reasons(empty=True) == {"ground": EMPTY}


@pytest.mark.parametrize(
    ("recent", "covariance"),
    [
        (RunningStatistics(mapped=True, ambiguous=0.9), np.diag([1e-4, 1e-4, 1e-6])),
        (RunningStatistics(mapped=True, alone=9.0), np.diag([1e-4, 1e-4, 1e-6])),
        (RunningStatistics(mapped=True), np.diag([0.6**2, 0.6**2, 1e-6])),
    ],
)
def test_a_weak_pose_that_nothing_contradicts_makes_no_map_doubtful(recent, covariance):
    """Real drives through dense forests and parks have such poses for minutes, and right maps."""
    health = pose_health(recent, ScanStatistics(), 50.0, 50, covariance)
    assert health.state == "weak"
    assert reasons_of(health, is_ground_missing=False, is_empty=False) == {}


def test_a_lost_position_makes_a_map_doubtful():
    health = pose_health(RunningStatistics(), ScanStatistics(), 50.0, 50, np.diag([2.0**2, 2.0**2, 1e-6]))
    assert "lost" in reasons_of(health, is_ground_missing=False, is_empty=False)


@pytest.mark.parametrize(
    ("groundless", "is_empty", "reason"), [(3, False, GROUNDLESS), (4, True, EMPTY), (2, False, "")]
)
def test_a_run_that_is_shorter_than_a_lasting_fault_is_judged_by_its_scans(groundless, is_empty, reason):
    told = fault_of_short_run(4, groundless, is_empty=is_empty)
    assert told.startswith(f"{DOUBTFUL} in the whole run: {reason}") if reason else told == ""
