"""What a person can choose of a source before it is opened: topics by role, and where the LiDAR stands."""

from __future__ import annotations

import time
from contextlib import closing
from dataclasses import asdict
from math import degrees
from typing import Any

from app.robot.source import open_live
from pipeline.errors import SourceError
from pipeline.sources import open_source
from pipeline.sources.base import RecordedTopic
from pipeline.sources.clouds import is_cloud
from pipeline.sources.topics import TYPES_BY_ROLE

#: A robot's topics are listened for so long, and so long after the last new one.
LISTEN_S, SETTLE_S = 8.0, 1.5
_LOOK_S = 0.05
MOST_TOPICS = 500
#: What can be chosen live: pictures are not listened to.
_LIVE_ROLES = {kind: role for role, kinds in TYPES_BY_ROLE.items() if role != "camera" for kind in kinds}


def recorded(uri: str) -> dict[str, Any]:
    """Of a file, folder or simulated run.

    Raises:
        SourceError: It cannot be read.
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
    """Of a robot that is there now; nothing is subscribed, so nobody counts its messages.

    Raises:
        SourceError: The address is none.
    """
    with closing(open_live(uri)) as source:
        begun = changed = time.monotonic()
        known = source.publishers()
        while (now := time.monotonic()) < begun + LISTEN_S and not (known and now > changed + SETTLE_S):
            time.sleep(_LOOK_S)
            if (there := source.publishers()) != known:
                known, changed = there, now
        found = [
            RecordedTopic(each.topic, each.msgtype, 0, "", _LIVE_ROLES.get(each.msgtype, ""))
            for each in known[:MOST_TOPICS]
        ]
        topics = [{**asdict(topic), "messages": None, "rate_hz": None} for topic in found]
        told = [] if topics else [f"no topic was announced within {LISTEN_S:.0f} s"]
        return {"kind": "live", "topics": topics, "mount": None, "warnings": told}


def _rate(messages: int, seconds: float) -> float | None:
    return round((messages - 1) / seconds, 1) if seconds > 0.0 and messages > 1 else None
