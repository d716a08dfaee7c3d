"""Runs with disturbances, from records to page: each disturbance is reported with a warning and a state, and
adds at most one false tree; within fifty scans the pose is good again or reported as lost."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest

from app.batch.summary import health_word
from app.worker.protocol import Open
from app.worker.session import Session
from pipeline.config import Parameters
from pipeline.geometry.poses import Pose3
from pipeline.io.readers.base import SourceDescription
from pipeline.map_faults import DOUBTFUL
from pipeline.mapper import Mapper
from pipeline.types.records import Frame, Record, Truth
from tests.benchmarks.troubled import AFTER, KNOWN, PLACES, SENSOR, TROUBLES, Drive, drive, parameters
from tests.pipeline.strategies import first_of

WITHIN = 50  # scans
NO_WORSE = 0.2  # m beyond the error before


class Told:
    """A source of ready records."""

    def __init__(self, drive: Drive) -> None:
        self.drive = drive
        self.losses: dict[str, int] = {}
        self.description = SourceDescription(
            uri="told:",
            kind="told records",
            sensor=SENSOR,
            T_base_lidar=Pose3.identity(),
            has_odometry=True,
            has_imu=False,
            scans=None,
            start_ns=0,
            end_ns=None,
            digest="0",
            preset="stems",
        )

    def records(self) -> Iterator[Record]:
        """All of them: nobody goes back here."""
        yield from self.drive.records

    def truth(self) -> Truth | None:
        """None."""
        return None

    def close(self) -> None:
        """Nothing is open."""


@dataclass(frozen=True, slots=True, eq=False)
class Day:
    """What the page was told: of each scan its number, the picture, the state of SLAM and the warnings."""

    drive: Drive
    rows: list[tuple[int, Frame, str, tuple[str, ...]]]

    def since(self, scan: int) -> list[tuple[int, Frame, str, tuple[str, ...]]]:
        """The scans since one, by the time of the drive."""
        return [row for row in self.rows if row[0] >= scan]


def lived(place: str, seed: int, name: str, p: Parameters | None = None) -> Day:
    """Play a drive in a session, and look at its status after each scan."""
    trouble = TROUBLES[name]
    driven = drive(PLACES[place], seed, trouble)
    session = Session(
        open_source=lambda _uri, _options: Told(driven),
        make_mapper=lambda source, p, seed, timer: Mapper(
            p, sensor=source.sensor, T_base_lidar=Pose3.identity(), seed=seed, timer=timer
        ),
        parameters=parameters() if p is None else p,
    )
    session.open(Open("told:", "auto", seed))
    session.play()
    rows: list[tuple[int, Frame, str, tuple[str, ...]]] = []
    while (frame := session.work()) is not None:
        status = session.status()
        assert set(frame.warnings) <= set(status.warnings), "each warning reaches the page"
        at = (frame.stamp_ns // 1_000_000 - (trouble.pause_ms if frame.index >= KNOWN else 0)) // 100
        rows.append((at, frame, frame.health.state, frame.warnings))
        assert status.health == health_word(frame)
    session.close()
    return Day(driven, rows)


def assert_survived(name: str, day: Day, *, enough: bool = True) -> None:
    """What is asked of every bad day; enough: trees are seen that contradict an odometry for long, else it is
    weak in the end."""
    trouble = TROUBLES[name]
    first, soon_by = 1 if trouble.from_start else KNOWN, trouble.soon
    soon = [row for row in day.since(first) if row[0] <= first + soon_by]
    assert any(trouble.said in word for row in soon for word in row[3]), "warned of at once"
    if not trouble.from_start:
        assert trouble.state in [row[2] for row in soon], "a state at once"
        assert {row[2] for row in day.rows if row[0] < KNOWN} == {"good"}
    if not trouble.once:
        later = day.since(first + soon_by + 1)
        warned = [any(trouble.said in word for word in row[3]) for row in later]
        assert np.mean(warned) > 0.9, "warned of as long as it lasts"
    _, frame, state, _ = day.rows[-1]
    assert state == day.rows[-2][2]
    before = max(day.drive.error(row[0], row[1].estimate.T_map_base) for row in day.rows if row[0] < KNOWN)
    error = day.drive.error(day.rows[-1][0], frame.estimate.T_map_base)
    lost = trouble.may_be_lost and state == "lost"
    word = "good" if enough else "weak"
    assert lost or error < before + NO_WORSE
    # A fault that lasts makes the map doubtful until its cause is over.
    for _, shown, now, _ in day.since(first + WITHIN):
        doubtful = now == "weak" and shown.health.reason.startswith(DOUBTFUL)
        assert lost or now == word or doubtful
    trees = frame.trees.position[frame.trees.confirmed]
    assert day.drive.false_trees(trees, before + (0.0 if lost else error)) <= 1


@pytest.mark.slow_after(8)
@pytest.mark.parametrize("name", TROUBLES)
@pytest.mark.parametrize(("place", "seed"), first_of([("stand", 1), ("a circle", 2)]))
def test_a_bad_day(name: str, place: str, seed: int) -> None:
    assert_survived(name, lived(place, seed, name))


@pytest.mark.slow_after(2)
@pytest.mark.parametrize("name", ["stuck", "odometry ends", "jump of 0.5 m", "kidnapped"])
@pytest.mark.parametrize(("place", "seed"), first_of([("few trees", 4), ("at 3 m/s", 3), ("dense", 5)]))
def test_elsewhere(name: str, place: str, seed: int) -> None:
    assert_survived(name, lived(place, seed, name), enough=(name, place) != ("stuck", "few trees"))


@pytest.mark.parametrize(("place", "seed"), first_of([("dense", 5), ("at 3 m/s", 3)]))
def test_stuck_from_the_start_where_more_trees_stand_than_people_walk(place: str, seed: int) -> None:
    assert_survived("stuck from the start", lived(place, seed, "stuck from the start"))


@pytest.mark.slow_after(2)
@pytest.mark.parametrize("name", ["stuck", "odometry ends", "jump of 0.5 m", "gap, pushed", "kidnapped"])
def test_with_fastslam_1(name: str) -> None:
    assert_survived(name, lived("stand", 6, name, parameters(**{"slam.method": "fastslam1"})))


def test_stuck_wheels_of_a_filter_that_waits_for_half_a_metre() -> None:
    """It would wait for ever: no metre is driven."""
    day = lived("stand", 7, "stuck", parameters(**{"slam.update_distance": 0.5}))
    assert_survived("stuck", day)
    assert len(day.since(KNOWN)) == AFTER
