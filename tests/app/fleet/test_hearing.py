"""What one robot publishes of itself harms neither its own card nor those of others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import pytest

from app.fleet.hearing import UNREADABLE, ResultReceiver, Results
from app.robot.link import Inbox
from app.robot.topics import Publisher
from app.robot.zenoh import ZenohLink
from pipeline.io.readers.container import Channel, Message
from pipeline.io.recording import outputs
from pipeline.types.clearance import Clearance, Zone
from tests.app.fakes import START_NS, frame


class FakeLink:
    """A router at which some publish."""

    version, problem, place = 1, "", "connected to a fake"

    def __init__(self, topics: Sequence[str]) -> None:
        self.numbers: dict[str, int] = {}
        self._topics = topics

    def publishers(self) -> list[Publisher]:
        return [Publisher("", topic, outputs.TYPES[topic.rpartition("/")[2]]) for topic in self._topics]

    def subscribe(self, channels: Sequence[Channel]) -> None:
        self.numbers |= {channel.topic: channel.number for channel in channels}


def published(within: float) -> dict[str, bytes]:
    seen = replace(frame(3, START_NS), clearance=Clearance(Zone.STOP, 0.75, within=within))
    return outputs.scan_messages(seen)


@pytest.mark.parametrize("within", [math.inf, -math.inf, math.nan])
def test_a_range_that_is_none_is_counted_and_the_last_one_stays(within: float):
    results = Results()
    for messages in (published(3.0), published(within)):
        for topic in (outputs.ZONE, outputs.CLEARANCE):
            results.take(topic, messages[topic], 1.0)
    told = results.report(1.0, alive=True)
    assert told.clearance is not None
    assert told.clearance["within_m"] == 3.0
    assert told.unreadable == 1


def test_results_that_cannot_be_reported_are_dropped_and_other_robots_are_not_affected():
    link, inbox = FakeLink(["/red/stemmap/odometry", "/blue/stemmap/odometry"]), Inbox()
    hearing = ResultReceiver(cast(ZenohLink, link), inbox)
    hearing.subscribe_to_new()
    for number in link.numbers.values():
        inbox.put(Message(number, 0, published(3.0)[outputs.ODOMETRY]), is_scan=False)
    hearing.take(1.0)
    hearing._robots["red"]._path = [[math.inf, 0.0]]  # a fault in reading
    robots = hearing.report(1.5).robots
    assert (robots["red"].silence_s, robots["red"].unreadable) == (None, 1)
    assert (robots["blue"].silence_s, robots["blue"].unreadable) == (0.5, 0)
    assert hearing._robots["red"].losses == {UNREADABLE: 1}
