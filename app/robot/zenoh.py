"""ROS 2 over Zenoh: one session to one router. Publishers are found by the liveliness tokens of rmw_zenoh,
and results are published as rmw_zenoh publishes the topics of a node."""

from __future__ import annotations

import contextlib
import hashlib
import json
import struct
import time
from collections.abc import Mapping, Sequence
from typing import Any

from app.robot.link import LOST_SCANS, MESSAGE_LIMIT, Inbox, Link, first_line
from app.robot.topics import NAME, SCAN_TYPES, TYPE, Publisher
from app.sources.live_address import ROOT, ZenohAddress
from pipeline.io.readers.base import count_loss
from pipeline.io.readers.container import Channel
from pipeline.io.recording.messages import LATCHED, TYPES, type_hash

ADMIN = "@ros2_lv"
PUBLISHER = "MP"
_LONGEST_TOKEN = 1000


def publisher_of(token: str) -> Publisher | None:
    """Return the publisher that a liveliness token describes: robot (the namespace), topic and message type.
    None for tokens of other entities, for invalid names, without a type `<package>::msg::dds_::<name>_`, and
    for tokens that are too long.

    A token is `@ros2_lv/<domain>/<session>/<node>/<entity>/<kind>/<enclave>/<namespace>/<name>`, followed for
    an endpoint by `/<topic>/<type>/<hash>/<qos>`. A slash inside of a part is written `%`.
    """
    parts = token.split("/")
    if len(token) > _LONGEST_TOKEN or len(parts) != 13 or parts[0] != ADMIN or parts[5] != PUBLISHER:
        return None
    msgtype = TYPE.fullmatch(parts[10])
    topic = parts[9].replace("%", "/")
    namespace = parts[7].replace("%", "/")
    if msgtype is None or not NAME.fullmatch(topic) or not (namespace == "/" or NAME.fullmatch(namespace)):
        return None
    return Publisher(namespace.strip("/"), topic, f"{msgtype[1]}/msg/{msgtype[2]}")


def data_key(domain: int, topic: str, msgtype: str, type_hash: str = "*") -> str:
    """Return the key `DOMAIN/TOPIC/PACKAGE::msg::dds_::NAME_/HASH` of the messages of a topic.

    Args:
        domain: ROS_DOMAIN_ID.
        topic: Name of the topic; its leading slash is not part of the key.
        msgtype: Message type in the ROS 2 spelling, "PACKAGE/msg/NAME".
        type_hash: Hash of the type; "*" for any.
    """
    package, _, name = msgtype.split("/")
    return f"{domain}/{topic.lstrip('/')}/{package}::msg::dds_::{name}_/{type_hash}"


_WATCH_S = 1.0
_ATTACHMENT = struct.Struct("<QQB")
LOST_OTHERS = "other messages lost on the network"

#: Zenoh's names of the certificate files.
_TLS = {"ca": "root_ca_certificate", "cert": "connect_certificate", "key": "connect_private_key"}


def configuration(endpoint: str, files: Mapping[str, str] | None = None) -> str:
    """Return the configuration of the session as JSON: a client of one router that neither listens nor
    scouts.

    Args:
        endpoint: Endpoint of the router.
        files: Dict from roles to paths of certificates, see `ZenohAddress`.
    """
    tls: dict[str, Any] = {_TLS[name]: path for name, path in (files or {}).items()}
    if "connect_certificate" in tls:
        tls["enable_mtls"] = True
    return json.dumps(
        {
            "mode": "client",
            "connect": {"endpoints": [endpoint]},
            "listen": {"endpoints": []},
            "timestamping": {"enabled": True},  # latched messages need a time
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
            "transport": {
                "link": {"rx": {"max_message_size": MESSAGE_LIMIT}, **({"tls": tls} if tls else {})},
                "shared_memory": {"enabled": False},
            },
        }
    )


class ZenohLink(Link):
    """Connection to a router. It begins to connect in a thread at once.

    Args:
        address: Address of the router.
        inbox: Inbox to which the messages are added.
    """

    def __init__(self, address: ZenohAddress, inbox: Inbox) -> None:
        super().__init__(inbox, "zenoh")
        self._address = address
        self._channels: Sequence[Channel] = ()
        self._subscriptions: list[Any] = []
        self._sequences: dict[int, tuple[bytes, int]] = {}
        self.thread.start()

    @property
    def place(self) -> str:
        """Description of the connection for the user."""
        return f"connected to {self._address.endpoint}"

    @property
    def nothing(self) -> str:
        """Reason why no scan topic is chosen, as text for the user."""
        if self.robots() and not self._address.robot and not self._address.topics:
            return "a robot was found, its topics are being chosen"
        robot = self._address.robot
        wanted = "a robot without a namespace" if robot == ROOT else f"robot {robot}" if robot else "a robot"
        others = [robot or "(no namespace)" for robot in self.robots()]
        there = f" (there are: {', '.join(others[:10])})" if others else ""
        return f"no scans of {wanted} are announced in ROS domain {self._address.domain}{there}"

    def subscribe(self, channels: Sequence[Channel]) -> None:
        """Receive the messages of these channels in addition to those of earlier calls, as soon as there is a
        connection. Of fixed transforms (tf_static), the last messages before the subscription are received
        too."""
        self._channels = (*self._channels, *channels)
        if self.session is not None:
            self._subscriptions += [self._subscribe_to(channel) for channel in channels]

    def _subscribe_to(self, channel: Channel) -> Any:  # noqa: ANN401 - zenoh is imported where it is used
        """Return a subscription to a channel, which requires a session; publishers of fixed transforms
        (tf_static) repeat their last messages."""
        from zenoh import ext

        is_latched = channel.topic.endswith("tf_static")
        return ext.declare_advanced_subscriber(
            self.session,
            data_key(self._address.domain, channel.topic, channel.msgtype),
            lambda sample: self._take(sample, channel),
            history=ext.HistoryConfig(detect_late_publishers=True, max_samples=100) if is_latched else None,
        )

    def receive(self) -> None:
        """Connect, and update `problem` until `close`. Zenoh delivers the messages in its own threads and
        restores a lost connection. An exception means that the first connection failed, see `Link`."""
        try:
            self._connect()
            self._watch()
        finally:
            self._disconnect()

    def failure(self, error: Exception) -> str:
        """Return the reason why there is no connection."""
        why = first_line(error)
        if "Unable to connect" in why:  # it lists the addresses that were tried
            why = "no Zenoh router answers there. Is it running, is the address right, and is the network up?"
        return f"no connection to {self._address.endpoint}: {why}"

    def _connect(self) -> None:
        """Open the session, and subscribe to announcements and to all channels; raises the errors of
        zenoh."""
        import zenoh

        config = configuration(self._address.endpoint, self._address.files)
        session: Any = zenoh.open(zenoh.Config.from_json5(config))
        with self.lock:
            self.session = session
            self.alive.clear()
        if self.closing.is_set():
            return
        key = f"{ADMIN}/{self._address.domain}/**"
        self._subscriptions = [
            session.liveliness().declare_subscriber(key, self._note_token, history=True),
            *(self._subscribe_to(channel) for channel in self._channels),
        ]

    def _watch(self) -> None:
        """Set `problem` every _WATCH_S until `close`: "" if the router is connected. zenoh reconnects by
        itself."""
        while not self.closing.is_set():
            is_connected = bool(self.session.info.routers_zid())
            self.problem = "" if is_connected else f"no connection to {self._address.endpoint}"
            self.closing.wait(_WATCH_S)

    def _disconnect(self) -> None:
        """Close the session; its errors are ignored."""
        with self.lock:
            session, self.session = self.session, None
        if session is not None:
            with contextlib.suppress(Exception):  # a session that is broken needs no closing
                session.close()

    def _note_token(self, sample: Any) -> None:  # noqa: ANN401
        """Process the announcement or withdrawal of a publisher."""
        import zenoh

        token = str(sample.key_expr)
        if sample.kind == zenoh.SampleKind.DELETE:
            self.withdraw(token)
        else:
            self.announce(token, publisher_of(token))

    def _take(self, sample: Any, channel: Channel) -> None:  # noqa: ANN401
        """Put a message into the inbox, and count the messages lost before it."""
        if sample.attachment is not None:
            reason = LOST_SCANS if channel.msgtype in SCAN_TYPES else LOST_OTHERS
            with self.lock:
                self._count_gap(channel.number, bytes(sample.attachment), reason)
        self.take(channel, sample.payload, len(sample.payload))

    def _count_gap(self, number: int, attachment: bytes, reason: str) -> None:
        """Count lost messages. rmw_zenoh numbers the messages of a publisher, so a gap in the numbers is a
        loss. Another publisher, a smaller number and a short attachment count nothing.

        Args:
            number: Number of the channel.
            attachment: Attachment of a message with its number.
            reason: Reason under which losses are counted.
        """
        if len(attachment) < _ATTACHMENT.size:
            return
        sequence, _stamp, _length = _ATTACHMENT.unpack_from(attachment)
        gid = attachment[_ATTACHMENT.size :]
        known = self._sequences.get(number)
        self._sequences[number] = (gid, sequence)
        if known is not None and known[0] == gid and sequence > known[1] + 1:
            count_loss(self.losses, reason, sequence - known[1] - 1)


NODE = "stemmap"
# Reliability, durability (1 repeats the last message for late subscribers), history and depth.
_VOLATILE, _LATCHED = "::,10:,:,:,,", ":1:,1:,:,:,,"


class RosPublisher:
    """Publishes pose, path and trees below `/<robot>/stemmap/`; the topics are announced at once, as long as
    this object exists.

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
        for number, topic in enumerate(TYPES, 1):
            key = data_key(domain, self.name(topic), TYPES[topic], type_hash(topic))
            qos = _LATCHED if topic in LATCHED else _VOLATILE
            name = self.name(topic).replace("/", "%")
            kind, kind_hash = key.split("/")[-2:]
            token = f"{head}/{number}/{PUBLISHER}/{tail}/{name}/{kind}/{kind_hash}/{qos}"
            self._declare(session, token)
            self._publishers[topic] = _Topic(session, key, token, latched=topic in LATCHED)

    def name(self, topic: str) -> str:
        """Return the full name of a topic: `/<robot>/stemmap/<topic>`, or `/stemmap/<topic>` without a
        namespace."""
        return f"{self._prefix}/{topic}"

    def publish(self, messages_by_topic: Mapping[str, bytes]) -> None:
        """Publish messages, a dict from the topic to the message in CDR, see
        `pipeline.io.recording.messages`. It does not wait for slow subscribers; KeyError for an unknown
        topic."""
        for topic, payload in messages_by_topic.items():
            self._publishers[topic].put(payload)

    def _declare(self, session: Any, token: str) -> None:  # noqa: ANN401
        """Announce an entity by its liveliness token as long as this object exists."""
        self._tokens.append(session.liveliness().declare_token(token))


class _Topic:
    """A published topic. Its messages have a sequence number, a time and a publisher id, as those of
    rmw_zenoh.

    Args:
        session: Session of zenoh.
        key: Key of the messages.
        token: Liveliness token, from which the publisher id is derived.
        latched: Whether the last message is repeated for late subscribers.
    """

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
        """Publish a message in CDR with the next sequence number and the present time."""
        self._sequence += 1
        head = struct.pack("<qqB", self._sequence, time.time_ns(), len(self._gid))
        self._publisher.put(payload, attachment=head + self._gid)
