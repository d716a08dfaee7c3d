"""Contents of a source before it is opened: topics by role, and the mounting of the LiDAR."""

from __future__ import annotations

import time
from contextlib import closing
from dataclasses import asdict
from math import degrees
from typing import Any

from app.robot.address import parse_address
from app.robot.inbox import CountingInbox, Heard
from app.robot.source import link_for
from app.robot.topics import Publisher, countable
from pipeline.errors import SourceError
from pipeline.io.readers import open_source
from pipeline.io.readers.base import RecordedTopic
from pipeline.io.readers.clouds import is_cloud
from pipeline.io.readers.topics import TYPES_BY_ROLE

#: A robot's topics are listened for so long, and so long after the last new one.
LISTEN_S, SETTLE_S = 8.0, 1.5
#: So long they are counted.
COUNT_S = 3.0
_LOOK_S = 0.05
MOST_TOPICS = 500
_ROLES = {kind: role for role, kinds in reversed(TYPES_BY_ROLE.items()) for kind in kinds}


def recorded(uri: str) -> dict[str, Any]:
    """Return the contents of a file, folder or simulated run.

    Raises:
        SourceError: The source cannot be read.
    """
    if is_cloud(uri):
        raise SourceError("a whole cloud has no topics", where=uri, remedy="Open it as it is")
    with closing(open_source(uri)) as source:
        about = source.description
        known = about.start_ns is not None and about.end_ns is not None
        seconds = 1e-9 * ((about.end_ns or 0) - (about.start_ns or 0)) if known else 0.0
        shown = about.topics[:MOST_TOPICS]
        topics = [{**asdict(topic), "rate_hz": _rate(topic.messages, seconds)} for topic in shown]
        mounted = about.T_base_lidar
        place = [*map(float, mounted.t), *map(degrees, mounted.euler())]
        return {
            "kind": about.kind,
            "topics": topics,
            "mount": [round(number, 3) + 0.0 for number in place] if about.topics else None,
            "warnings": list(about.warnings)[:20],
        }


def heard(uri: str) -> dict[str, Any]:
    """Return the topics of a live robot with the rates of the usable ones.

    Raises:
        SourceError: The address is invalid.
    """
    address, inbox = parse_address(uri), CountingInbox()
    make_link, _ = link_for(address)
    with closing(make_link(address, inbox)) as link:
        begun = changed = time.monotonic()
        known = link.publishers()
        while (now := time.monotonic()) < begun + LISTEN_S and not (known and now > changed + SETTLE_S):
            time.sleep(_LOOK_S)
            if (there := link.publishers()) != known:
                known, changed = there, now
        listened = countable(known, MOST_TOPICS)
        if listened:
            link.subscribe(listened)
            time.sleep(COUNT_S)
        numbers = {channel.number for channel in listened}
        topics = [_counted(each, inbox.heard(k), k in numbers) for k, each in enumerate(known[:MOST_TOPICS])]
        told = [] if topics else [f"no topic was announced within {LISTEN_S:.0f} s"]
        return {"kind": "live", "topics": topics, "mount": None, "warnings": told}


def _counted(publisher: Publisher, heard: Heard, listened: bool) -> dict[str, Any]:
    """Return the description of a topic."""
    why = ""
    if listened and not heard.messages and not publisher.topic.endswith("tf_static"):
        why = f"silent for {COUNT_S:g} s"
    topic = RecordedTopic(publisher.topic, publisher.msgtype, 0, "", _ROLES.get(publisher.msgtype, ""), why)
    counted = heard.messages if listened else None
    return {**asdict(topic), "messages": counted, "seconds": COUNT_S, "rate_hz": heard.rate_hz}


def _rate(messages: int, seconds: float) -> float | None:
    return round((messages - 1) / seconds, 1) if seconds > 0.0 and messages > 1 else None
