"""Hears what robots publish of their own maps: `python -m app.fleet.hearing ADDRESS`.

A process of its own, because it takes apart what strangers send. Twice a second it says in a line of JSON
what it knows; it ends when its standard input does.
"""

from __future__ import annotations

import json
import logging
import sys
import threading
import time

from app.fleet.results import TOPICS, UNREADABLE, Results
from app.robot.address import ZenohAddress, parse_address
from app.robot.inbox import Inbox
from app.robot.zenoh import ZenohLink
from pipeline.io.readers.container import Channel
from pipeline.io.recording import outputs

_log = logging.getLogger(__name__)

MOST_ROBOTS = 16
SAY_S, _POLL_S = 0.5, 0.01
_BY_TYPE = {topic: outputs.TYPES[topic] for topic in TOPICS}


class Hearing:
    """The results of all robots at a router.

    Args:
        link: To the router, and the inbox that it fills.
        inbox: Of the link.
    """

    def __init__(self, link: ZenohLink, inbox: Inbox) -> None:
        self._link, self._inbox = link, inbox
        self._robots: dict[str, Results] = {}
        self._topics: dict[int, tuple[str, str]] = {}
        self._known: set[str] = set()
        self._version = -1

    def look_around(self) -> None:
        """Subscribe to the results that were not heard of before."""
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
            self._link.subscribe([Channel(number, publisher.topic, publisher.msgtype, "cdr", "", "", 0)])

    def take(self, now_s: float) -> None:
        """Take all messages that came."""
        while (message := self._inbox.take()) is not None:
            robot, topic = self._topics[message.channel]
            self._robots[robot].take(topic, message.payload, now_s)

    def said(self, now_s: float) -> str:
        """What is known, as JSON in one line."""
        alive = {found[0] for p in self._link.publishers() if (found := results_topic(p.topic)) is not None}
        robots = [f"{json.dumps(name)}: {self._of(name, name in alive, now_s)}" for name in self._robots]
        problem, place = json.dumps(self._link.problem), json.dumps(self._link.place)
        return f'{{"problem": {problem}, "place": {place}, "robots": {{{", ".join(robots)}}}}}'

    def _of(self, name: str, alive: bool, now_s: float) -> str:
        """One robot. What cannot be said of it is forgotten and counted: the others are heard on."""
        try:
            return json.dumps({**self._robots[name].as_plain(now_s), "alive": alive}, allow_nan=False)
        except Exception:  # whatever a stranger's figures come to
            _log.exception("what %s published could not be shown", name or "the robot")
            fresh = self._robots[name] = Results(self._robots[name].losses.get(UNREADABLE, 0) + 1)
            return json.dumps({**fresh.as_plain(now_s), "alive": alive}, allow_nan=False)


def results_topic(topic: str) -> tuple[str, str] | None:
    """The robot and which result a topic is of; None of any other."""
    head, _, last = topic.rpartition("/")
    if last not in TOPICS or not head.endswith("/stemmap"):
        return None
    return head.removesuffix("/stemmap").strip("/"), last


def main(uri: str) -> None:
    """Hear and say until the standard input ends."""
    address = parse_address(uri)
    if not isinstance(address, ZenohAddress):
        raise SystemExit("results are heard over Zenoh alone")
    inbox, ending = Inbox(), threading.Event()
    link = ZenohLink(address, inbox)
    hearing = Hearing(link, inbox)

    def wait_for_the_end() -> None:
        sys.stdin.buffer.read()
        ending.set()

    threading.Thread(target=wait_for_the_end, daemon=True).start()
    said_s = 0.0
    while not ending.wait(_POLL_S):
        now_s = time.monotonic()
        hearing.look_around()
        hearing.take(now_s)
        if now_s >= said_s + SAY_S:
            said_s = now_s
            print(hearing.said(now_s), flush=True)  # noqa: T201
    link.close()


if __name__ == "__main__":
    main(sys.argv[1])
