"""Publishes the results on the network of the robot, declared as rmw_zenoh declares the topics of a node."""

from __future__ import annotations

import hashlib
import struct
import time
from collections.abc import Mapping
from typing import Any

from app.robot.zenoh import ADMIN, PUBLISHER, data_key
from pipeline.io.recording import outputs

NODE = "stemmap"
# Reliability, durability (1 repeats the last message for late subscribers), history and depth.
_VOLATILE, _LATCHED = "::,10:,:,:,,", ":1:,1:,:,:,,"


class RosPublisher:
    """Publishes pose, path and trees below `/<robot>/stemmap/`.

    Args:
        session: Session of zenoh with the router of the robot.
        domain: ROS_DOMAIN_ID.
        robot: Namespace of the robot, "" for none.
    """

    def __init__(self, session: Any, domain: int, robot: str) -> None:  # noqa: ANN401
        self._prefix = f"/{robot}/stemmap" if robot else "/stemmap"
        self._tokens: list[Any] = []
        self._publishers: dict[str, _Topic] = {}
        namespace = f"/{robot}".replace("/", "%") if robot else "%"
        head = f"{ADMIN}/{domain}/{session.info.zid()}/0"
        tail = f"%/{namespace}/{NODE}"
        self._declare(session, f"{head}/0/NN/{tail}")
        for number, topic in enumerate(outputs.TYPES, 1):
            key = data_key(domain, self.name(topic), outputs.TYPES[topic], outputs.type_hash(topic))
            qos = _LATCHED if topic in outputs.LATCHED else _VOLATILE
            name = self.name(topic).replace("/", "%")
            kind, kind_hash = key.split("/")[-2:]
            token = f"{head}/{number}/{PUBLISHER}/{tail}/{name}/{kind}/{kind_hash}/{qos}"
            self._declare(session, token)
            self._publishers[topic] = _Topic(session, key, token, latched=topic in outputs.LATCHED)

    def name(self, topic: str) -> str:
        """Return the full name of a topic."""
        return f"{self._prefix}/{topic}"

    def publish(self, messages_by_topic: Mapping[str, bytes]) -> None:
        """Publish messages in CDR by topic, see `pipeline.io.recording.outputs`."""
        for topic, payload in messages_by_topic.items():
            self._publishers[topic].put(payload)

    def _declare(self, session: Any, token: str) -> None:  # noqa: ANN401
        self._tokens.append(session.liveliness().declare_token(token))


class _Topic:
    """A published topic. Its messages have a sequence number, a time and a publisher id, as those of
    rmw_zenoh."""

    def __init__(self, session: Any, key: str, token: str, *, latched: bool) -> None:  # noqa: ANN401
        import zenoh
        from zenoh import ext

        self._gid = hashlib.sha256(token.encode()).digest()[:16]
        self._sequence = 0
        self._publisher = ext.declare_advanced_publisher(
            session,
            key,
            encoding="application/cdr",
            # A slow subscriber must not delay the map.
            congestion_control=zenoh.CongestionControl.DROP,
            cache=ext.CacheConfig(1) if latched else None,
            publisher_detection=latched,
        )

    def put(self, payload: bytes) -> None:
        self._sequence += 1
        head = struct.pack("<qqB", self._sequence, time.time_ns(), len(self._gid))
        self._publisher.put(payload, attachment=head + self._gid)
