"""Receives the maps that robots compute and publish: `python -m app.fleet.hearing ADDRESS`, a child process.

It decodes messages of unknown senders, so it is separate from the server. Twice a second it sends a report as
a line of JSON. It ends when its standard input does.
"""

from __future__ import annotations

import logging
import math
import sys
import threading
import time
from collections import deque
from functools import partial
from typing import Any

import msgspec
import numpy as np

from app.common.child_process import ParentConnection, run_child
from app.robot.address import ZenohAddress, parse_address
from app.robot.link import Inbox
from app.robot.zenoh import ZenohLink
from pipeline.io.readers.container import Channel
from pipeline.io.readers.ros_messages import standard_types
from pipeline.io.recording import outputs
from pipeline.types.clearance import Zone

_log = logging.getLogger(__name__)

MOST_ROBOTS = 16
REPORT_S, _POLL_S = 0.5, 0.01
#: Trees and poses that are read of a message: no page shows more.
MOST_TREES, MOST_POSES = 5000, 400
_RATE_OVER = 20
#: The topics that are listened to.
TOPICS = (outputs.ODOMETRY, outputs.PATH, outputs.DETECTIONS, outputs.CLEARANCE, outputs.ZONE)
UNREADABLE = "messages that could not be read"


class RobotReport(msgspec.Struct, frozen=True):
    """State and map of one robot.

    Attributes:
        silence_s: Age of the newest pose [s]; None before the first.
        rate_hz: Mean rate of the last 20 poses [Hz]; 0 with fewer than two.
        distance_m: Length of the published path up to the newest pose [m].
        clearance: Zone and free distances as on the page; None before the first zone.
        unreadable: Number of messages that could not be read.
        map: Trees, path and pose as `app.fleet.fleet.shown_map` returns them.
        alive: Whether its results are announced now.
    """

    silence_s: float | None
    rate_hz: float
    distance_m: float
    clearance: dict[str, Any] | None
    unreadable: int
    map: dict[str, Any]
    alive: bool


class FleetReport(msgspec.Struct, frozen=True):
    """Message to the server.

    Attributes:
        problem: What is wrong with the connection, for people; empty for nothing.
        place: Description of the connection, for people.
        robots: Reports by namespace.
    """

    problem: str
    place: str
    robots: dict[str, RobotReport]


class Results:
    """The newest results of one robot.

    Args:
        unreadable: Number of messages that could not be read before.

    Attributes:
        losses: Number of messages that were left out, by reason.
    """

    def __init__(self, unreadable: int = 0) -> None:
        self.losses: dict[str, int] = {UNREADABLE: unreadable} if unreadable else {}
        self._pose = [0.0, 0.0, 0.0]
        self._path: list[list[float]] = []
        self._trees: list[dict[str, Any]] = []
        self._ahead: float | None = None
        self._zone: str | None = None
        self._within = 0.0
        self._came_s: deque[float] = deque(maxlen=_RATE_OVER)

    def take(self, topic: str, payload: bytes, now_s: float) -> None:
        """Read a message; if it cannot be read, count it in `losses`. Raises nothing.

        Args:
            topic: One of TOPICS.
            payload: The message in CDR.
            now_s: Present time [s] from any origin.
        """
        try:
            types: Any = standard_types("cdr")
            message = types.deserialize_cdr(payload, outputs.TYPES[topic])
            self._take(topic, message, now_s)
        except Exception:  # any error that a stranger's bytes can cause in a decoder
            self.losses[UNREADABLE] = self.losses.get(UNREADABLE, 0) + 1

    def _take(self, topic: str, message: Any, now_s: float) -> None:  # noqa: ANN401
        """Store the contents of a decoded message. At most MOST_TREES trees are read; a path is thinned to
        about MOST_POSES points with the newest among them.

        Args:
            topic: One of TOPICS.
            message: The decoded message.
            now_s: Present time [s].

        Raises:
            ValueError: A number is not finite or too large; the previous contents remain.
        """
        match topic:
            case outputs.ODOMETRY:
                self._pose = _finite(*_placed(message.pose.pose))
                self._came_s.append(now_s)
            case outputs.PATH:
                step = max(1, -(-len(message.poses) // MOST_POSES))
                self._path = [_finite(*_placed(each.pose)[:2]) for each in message.poses[::-step][::-1]]
            case outputs.DETECTIONS:
                self._trees = [_tree(each) for each in message.detections[:MOST_TREES]]
            case outputs.CLEARANCE:
                ahead, (within,) = float(message.range), _finite(float(message.max_range))
                self._ahead = round(ahead, 3) if math.isfinite(ahead) else None
                self._within = within
            case outputs.ZONE:
                self._zone = Zone(int(message.data)).label

    def report(self, now_s: float, *, alive: bool) -> RobotReport:
        """Return state and map for the page. Nothing is removed, also if the robot is silent.

        Args:
            now_s: Present time [s] from the same origin as in `take`.
            alive: Whether the results of the robot are announced now.

        Raises:
            msgspec.MsgspecError: A figure is not finite.
        """
        path = np.array([*self._path, self._pose[:2]])
        steps = np.diff(path, axis=0)
        heard = self._came_s
        since = now_s - heard[-1] if heard else None
        rate = (len(heard) - 1) / max(heard[-1] - heard[0], 1e-3) if len(heard) > 1 else 0.0
        clearance = {
            "zone": self._zone,
            "ahead_m": self._ahead,
            "beside_m": None,
            "within_m": self._within,
        }
        report = RobotReport(
            silence_s=since,
            rate_hz=round(rate, 1),
            distance_m=round(float(np.hypot(steps[:, 0], steps[:, 1]).sum()), 1),
            clearance=clearance if self._zone is not None else None,
            unreadable=self.losses.get(UNREADABLE, 0),
            map={"trees": self._trees, "path": self._path, "pose": self._pose},
            alive=alive,
        )
        return msgspec.json.decode(msgspec.json.encode(report), type=RobotReport)  # JSON has no infinity


def _placed(pose: Any) -> tuple[float, float, float]:  # noqa: ANN401
    """Return x, y [m] and yaw [rad] of a geometry_msgs/Pose."""
    q = pose.orientation
    yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
    return float(pose.position.x), float(pose.position.y), yaw


def _finite(*values: float) -> list[float]:
    """Return the values, rounded to three decimals.

    Raises:
        ValueError: A value is not finite, or its magnitude is 1e7 or more.
    """
    if not all(math.isfinite(value) and abs(value) < 1e7 for value in values):
        raise ValueError("not a place")
    return [round(value, 3) for value in values]


def _tree(detection: Any) -> dict[str, Any]:  # noqa: ANN401
    """Return the tree of a vision_msgs/Detection3D as JSON values for the page. The ellipse is a circle with
    the larger standard deviation; a width outside of 0 to 10 m gives no DBH.

    Raises:
        ValueError: Position or covariance is not finite.
        IndexError: The detection has no result.
    """
    centre, width = detection.bbox.center.position, float(detection.bbox.size.x)
    x, y = _finite(float(centre.x), float(centre.y))
    covariance = np.asarray(detection.results[0].pose.covariance, np.float64)
    sigma = _finite(math.sqrt(max(float(max(covariance[0], covariance[7])), 0.0)))[0]
    return {
        "x": x,
        "y": y,
        "ellipse": [sigma, sigma, 0.0],
        "dbh_cm": round(100.0 * width, 1) if 0.0 < width < 10.0 else None,
        "sigma_dbh_cm": None,
    }


_BY_TYPE = {topic: outputs.TYPES[topic] for topic in TOPICS}


class ResultReceiver:
    """Receives the results of all robots at a router.

    Args:
        link: Connection to the router.
        inbox: Inbox that the link fills.
    """

    def __init__(self, link: ZenohLink, inbox: Inbox) -> None:
        self._link, self._inbox = link, inbox
        self._robots: dict[str, Results] = {}
        self._topics: dict[int, tuple[str, str]] = {}
        self._known: set[str] = set()
        self._version = -1

    def subscribe_to_new(self) -> None:
        """Subscribe to results that were not announced before. Topics of other types, and robots beyond
        MOST_ROBOTS, are ignored. Nothing happens if the announcements have not changed."""
        if self._version == self._link.version:
            return
        self._version = self._link.version
        for publisher in self._link.publishers():
            found = results_topic(publisher.topic)
            if found is None or publisher.topic in self._known or _BY_TYPE[found[1]] != publisher.msgtype:
                continue
            if found[0] not in self._robots and len(self._robots) >= MOST_ROBOTS:
                continue
            self._robots.setdefault(found[0], Results())
            self._known.add(publisher.topic)
            number = len(self._topics) + 1
            self._topics[number] = found
            self._link.subscribe([Channel(number, publisher.topic, publisher.msgtype, "cdr")])

    def take(self, now_s: float) -> None:
        """Read all messages that arrived into the results of their robots; `now_s` is the present time [s]
        from any origin."""
        while (message := self._inbox.take()) is not None:
            robot, topic = self._topics[message.channel]
            self._robots[robot].take(topic, message.payload, now_s)

    def report(self, now_s: float) -> FleetReport:
        """Return the present state of all robots whose results were ever announced; `now_s` as in `take`."""
        alive = {found[0] for p in self._link.publishers() if (found := results_topic(p.topic)) is not None}
        robots = {name: self._report_of(name, name in alive, now_s) for name in self._robots}
        return FleetReport(self._link.problem, self._link.place, robots)

    def _report_of(self, name: str, alive: bool, now_s: float) -> RobotReport:
        """Return the report of one robot. If its results cannot be reported, they are dropped, which is
        counted, and the report is empty.

        Args:
            name: Name of the robot.
            alive: Whether its connection exists.
            now_s: Time of the report [s].
        """
        try:
            return self._robots[name].report(now_s, alive=alive)
        except Exception:  # any error that a stranger's figures can cause
            _log.exception("the results of %s could not be reported", name or "the robot")
            fresh = self._robots[name] = Results(self._robots[name].losses.get(UNREADABLE, 0) + 1)
            return fresh.report(now_s, alive=alive)


def results_topic(topic: str) -> tuple[str, str] | None:
    """Return the namespace of the robot ("" for none) and the name of the result of a topic; None for any
    other topic."""
    head, _, last = topic.rpartition("/")
    if last not in TOPICS or not head.endswith("/stemmap"):
        return None
    return head.removesuffix("/stemmap").strip("/"), last


def main(uri: str, ending: threading.Event, parent: ParentConnection) -> None:
    """Send reports until the parent closes the connection; the program of the child process.

    Args:
        uri: Address of the router.
        ending: Event that is set when the parent closes the connection.
        parent: Connection to the server.

    Raises:
        SystemExit: The address is not one of Zenoh.
    """
    address = parse_address(uri)
    if not isinstance(address, ZenohAddress):
        raise SystemExit("results are received over Zenoh only")
    inbox = Inbox()
    link = ZenohLink(address, inbox)
    hearing = ResultReceiver(link, inbox)
    reported_s = 0.0
    while not ending.wait(_POLL_S):
        now_s = time.monotonic()
        hearing.subscribe_to_new()
        hearing.take(now_s)
        if now_s >= reported_s + REPORT_S:
            reported_s = now_s
            parent.send(hearing.report(now_s))
    link.close()


if __name__ == "__main__":
    _ending = threading.Event()
    run_child(partial(main, sys.argv[1], _ending), on_close=_ending.set)
