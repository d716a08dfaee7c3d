"""A Zenoh session to one router: tokens in, messages in. Only the given endpoint is connected."""

from __future__ import annotations

import contextlib
import json
import struct
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any

from app.robot.address import ROOT, ZenohAddress
from app.robot.choosing import PICTURE_TYPES, SCAN_TYPES
from app.robot.inbox import ArrivalTimes, Inbox
from app.robot.ros_graph import ADMIN, MOST_ENDPOINTS, Publisher, RosGraph, data_key
from pipeline.io.readers.base import count_loss
from pipeline.io.readers.container import Channel, Message

#: Largest message that is put together from its parts; a cloud of 2 million points is smaller.
MESSAGE_LIMIT = 64 << 20
_RETRY_S = 1.0
_ATTACHMENT = struct.Struct("<QQB")

LOST_SCANS = "scans lost on the way from the robot"
TOO_LARGE = "messages larger than 64 MB"
TOO_MANY = f"topics that came up when {MOST_ENDPOINTS:,} were there already"


#: What Zenoh calls the files of certificates.
_TLS = {"ca": "root_ca_certificate", "cert": "connect_certificate", "key": "connect_private_key"}


def configuration(endpoint: str, files: Mapping[str, str] | None = None) -> str:
    """The session's configuration as JSON: a client of one router that listens and scouts nowhere.

    Args:
        endpoint: Of the router.
        files: Of certificates, by what they are, see `ZenohAddress`.
    """
    tls: dict[str, Any] = {_TLS[name]: path for name, path in (files or {}).items()}
    if "connect_certificate" in tls:
        tls["enable_mtls"] = True
    return json.dumps(
        {
            "mode": "client",
            "connect": {"endpoints": [endpoint]},
            "listen": {"endpoints": []},
            "timestamping": {"enabled": True},  # what is latched must have a time
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
            "transport": {
                "link": {"rx": {"max_message_size": MESSAGE_LIMIT}, **({"tls": tls} if tls else {})},
                "shared_memory": {"enabled": False},
            },
        }
    )


class ZenohLink:
    """Connects in a thread of its own, again and again until it works; zenoh itself comes back later.

    Args:
        address: Of the router.
        inbox: For what comes.

    Attributes:
        problem: Why there is no connection, "" when there is one.
        losses: What was lost before the inbox, by reason.
        scans: How many came.
        version: Counts what changed among the publishers.
    """

    def __init__(self, address: ZenohAddress, inbox: Inbox) -> None:
        self.problem = "not connected yet"
        self.losses: dict[str, int] = {}
        self.scans = 0
        self.version = 0
        self._address, self._inbox = address, inbox
        self._graph = RosGraph()
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._session: Any = None
        self._kept: list[Any] = []
        self._sequences: dict[int, tuple[bytes, int]] = {}
        self._times = ArrivalTimes()
        self._heard_s: float | None = None
        self._thread = threading.Thread(target=self._connect, name="zenoh", daemon=True)
        self._thread.start()

    @property
    def place(self) -> str:
        """Where it is connected, in words."""
        return f"connected to {self._address.endpoint}"

    @property
    def nothing(self) -> str:
        """Why there is nothing, in words."""
        if self.robots() and not self._address.robot and not self._address.topics:
            return "a robot is there, its topics are counted"
        robot = self._address.robot
        wanted = "a robot without a namespace" if robot == ROOT else f"robot {robot}" if robot else "a robot"
        others = [robot or "(no namespace)" for robot in self.robots()]
        there = f" (there are: {', '.join(others[:10])})" if others else ""
        return f"no scans of {wanted} are announced in ROS domain {self._address.domain}{there}"

    @property
    def silence_s(self) -> float | None:
        """Seconds since the last scan came, None before the first."""
        return None if self._heard_s is None else time.monotonic() - self._heard_s

    def publishers(self) -> list[Publisher]:
        """All publishers that are alive."""
        with self._lock:
            return self._graph.publishers()

    def robots(self) -> list[str]:
        """The namespaces from which scans are published."""
        with self._lock:
            return self._graph.robots(SCAN_TYPES)

    @property
    def session(self) -> Any:  # noqa: ANN401 - zenoh is imported where it is used
        """The session, None before there is one."""
        return self._session

    def subscribe(self, channels: Sequence[Channel]) -> None:
        """Listen to these topics; latched ones tell what they said before."""
        import zenoh
        from zenoh import ext

        for channel in channels:
            key = data_key(self._address.domain, channel.topic, channel.msgtype)

            def take(sample: zenoh.Sample, channel: Channel = channel) -> None:
                self._take(sample, channel)

            latched = channel.topic.endswith("tf_static")
            history = ext.HistoryConfig(detect_late_publishers=True, max_samples=100) if latched else None
            self._kept.append(ext.declare_advanced_subscriber(self._session, key, take, history=history))

    def close(self) -> None:
        """Leave the router."""
        self._closing.set()
        self._thread.join(timeout=2.0)
        with self._lock:
            session, self._session = self._session, None
        if session is not None:
            with contextlib.suppress(Exception):  # a session that is broken already is as good as closed
                session.close()

    def _connect(self) -> None:
        import zenoh

        while not self._closing.is_set():
            try:
                config = configuration(self._address.endpoint, self._address.files)
                session: Any = zenoh.open(zenoh.Config.from_json5(config))
            except Exception as error:  # zenoh has one class for all, and does not promise it
                self.problem = f"no connection to {self._address.endpoint}: {_short(error)}"
                self._closing.wait(_RETRY_S)
                continue
            with self._lock:
                closing = self._closing.is_set()
                self._session = None if closing else session
            if closing:  # nobody waited for it any more
                session.close()
                return
            self._kept.append(
                session.liveliness().declare_subscriber(
                    f"{ADMIN}/{self._address.domain}/**", self._note_token, history=True
                )
            )
            self.problem = ""
            return

    def _note_token(self, sample: Any) -> None:  # noqa: ANN401
        import zenoh

        with self._lock:
            self.version += 1
            if sample.kind == zenoh.SampleKind.DELETE:
                self._graph.remove(str(sample.key_expr))
            elif not self._graph.add(str(sample.key_expr)):
                count_loss(self.losses, TOO_MANY)

    def _take(self, sample: Any, channel: Channel) -> None:  # noqa: ANN401
        payload, attachment = sample.payload, sample.attachment
        is_scan = channel.msgtype in SCAN_TYPES
        size = len(payload)
        with self._lock:
            if is_scan:
                self._heard_s = time.monotonic()
                self.scans += 1
                self._count_gap(channel.number, b"" if attachment is None else attachment.to_bytes())
            if size > MESSAGE_LIMIT:
                count_loss(self.losses, TOO_LARGE)
                return
            arrival_ns = self._times.next_ns()
            if channel.msgtype not in PICTURE_TYPES:
                self._inbox.put(Message(channel.number, arrival_ns, payload.to_bytes()), is_scan=is_scan)
            elif self._inbox.wants_picture(arrival_ns, size):
                self._inbox.put_picture(Message(channel.number, arrival_ns, payload.to_bytes()))

    def _count_gap(self, number: int, attachment: bytes) -> None:
        """rmw_zenoh numbers what a publisher sends; a hole in the numbers is what got lost."""
        if len(attachment) < _ATTACHMENT.size:
            return
        sequence, _stamp, _length = _ATTACHMENT.unpack_from(attachment)
        gid = attachment[_ATTACHMENT.size :]
        known = self._sequences.get(number)
        self._sequences[number] = (gid, sequence)
        if known is not None and known[0] == gid and sequence > known[1] + 1:
            count_loss(self.losses, LOST_SCANS, sequence - known[1] - 1)


def _short(error: Exception) -> str:
    """The first line of what a library says, without the places in its source."""
    first = str(error).partition("\n")[0].partition(" at ")[0].rstrip("!; ")
    return first[:200] or type(error).__name__
