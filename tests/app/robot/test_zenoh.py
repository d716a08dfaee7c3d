"""A robot that speaks ROS 2 over Zenoh, sent by a library that shares no code with ours."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from app.robot.link import LOST_SCANS
from app.robot.source import LiveSource, open_live
from app.robot.zenoh import LOST_OTHERS
from pipeline.errors import SourceError
from pipeline.io.recording import messages
from pipeline.types.records import Clearance, Odometry, Record, Scan, Zone
from tests.app.fakes import START_NS, frame, path, trees
from tests.app.robot.conftest import POINTS, SCANS, Child, Robot, free_port, listening, until


def taken(source: LiveSource, records: list[Record], scans: int) -> None:
    """Take records until so many scans came."""

    def come() -> bool:
        records.extend(source.take())
        return sum(isinstance(record, Scan) for record in records) >= scans

    until(come, lambda: f"{source._link.scans} scans came, {source.losses}, {source.waiting_for()}")


def subscribed(source: LiveSource) -> bool:
    """Whether the robot's topics are chosen and listened to."""
    return source.listen() or "announced and silent" in source.waiting_for()


def test_a_robot_is_found_heard_lost_and_found_again(router: int, robots: Callable[[str], Robot]):
    with closing(listening(f"zenoh:tcp/127.0.0.1:{router}")) as source:
        until(lambda: not source.listen() and "no scans of a robot are announced" in source.waiting_for())
        robot = robots("robot1")
        until(lambda: subscribed(source))
        assert source.robots == ["robot1"]
        robot.send()
        until(source.listen)
        known = source.description
        assert (source.robot, known.has_odometry, known.sensor.rings) == ("robot1", True, 16)
        np.testing.assert_allclose(known.T_base_lidar.t, [0.2, 0.0, 0.9])
        records: list[Record] = []
        taken(source, records, SCANS // 2)
        assert robot.sent() == SCANS
        # On a loaded machine the other library lets messages fall out; holes between them are counted.
        assert source.losses.keys() <= {LOST_SCANS, LOST_OTHERS}
        assert SCANS // 2 <= source._link.scans + source.losses.get(LOST_SCANS, 0) <= SCANS
        assert {len(scan.points) for scan in records if isinstance(scan, Scan)} == {POINTS}
        assert any(isinstance(record, Odometry) for record in records)
        robot.kill()
        until(lambda: not source.take() and "robot robot1 sends no scans any more" in source.notices())
        assert source.robots == []
        until(lambda: "robot robot1 is gone" in source.waiting_for())
        again = robots("robot1")
        until(lambda: not source.take() and "robot robot1 sends scans again" in source.notices())
        again.send()
        heard = sum(isinstance(record, Scan) for record in records)
        taken(source, records, heard + SCANS // 2)


def test_only_the_router_is_connected_and_nothing_listens(router: int):
    with closing(listening(f"zenoh:tcp/127.0.0.1:{router}")) as source:
        until(lambda: "no scans" in source.waiting_for())
        link = source._link
        (connection,) = link.session.info.links()
        assert str(connection.dst).startswith(f"tcp/127.0.0.1:{router}")
        assert source.robots == []


def test_a_router_that_is_not_there_is_named_and_tried_again():
    with closing(listening("zenoh:tcp/127.0.0.1:9")) as source:
        until(lambda: "no connection to tcp/127.0.0.1:9" in source.waiting_for())
        assert not source.listen()


@pytest.mark.slow
def test_others_hear_the_pose_and_the_trees(router: int, robots: Callable[[str], Robot]):
    robot = robots("red")
    near = Clearance(Zone.SLOW, 1.75, 0.0, 2.15, 0.0, within=3.0)
    with closing(open_live(f"zenoh:tcp/127.0.0.1:{router}")) as source:
        source.start(publish=True)
        until(lambda: subscribed(source))
        listener = Child("tests/app/robot/listener.py", str(router), "red")
        assert json.loads(listener.hear()) == {"ready": True}
        stop = threading.Event()

        def say() -> None:
            while not stop.wait(0.05):
                source.mapped(replace(frame(0, START_NS), trees=trees(4), clearance=near), path([0.0, 1.0]))

        saying = threading.Thread(target=say)
        saying.start()
        told = json.loads(listener.hear())
        stop.set()
        saying.join()
        listener.kill()
        assert told["topics"] == [f"/red/stemmap/{name}" for name in sorted(messages.TYPES)]
        assert (told["pose_frame"], told["child"]) == ("map", "base_link")
        assert (told["markers"], told["poses"]) == (1 + 2 * 3, 2)
        assert (told["ahead"], told["zone"]) == (1.75, int(Zone.SLOW))
        robot.send()
        until(source.listen)
        assert not any("stemmap" in topic.name for topic in source.description.topics)


def test_all_robots_at_once_and_unknown_options_are_refused():
    for options, reason in (("robot=*", "only one robot"), ("mapped=robot", "no option 'mapped'")):
        with pytest.raises(SourceError, match=reason):
            open_live(f"zenoh:tcp/127.0.0.1:9?{options}")


@pytest.mark.slow
def test_routers_that_are_connected_pass_a_robot_on(router: int, robots: Callable[[str], Robot]):
    far = free_port()
    other = Child("-m", "tests.app.robot.router", str(far), str(router))
    assert other.hear() == "ready"
    with closing(listening(f"zenoh:tcp/127.0.0.1:{far}?robot=red")) as source:
        robot = robots("red")
        until(lambda: source.listen() or "announced and silent" in source.waiting_for(), source.waiting_for)
        robot.send()
        until(source.listen, source.waiting_for)
        assert source.robots == ["red"]
    other.kill()
