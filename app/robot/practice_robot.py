"""A robot for practice: a Zenoh router on this machine that sends a recording at its own pace."""

from __future__ import annotations

import json
import re
import time
from contextlib import closing
from pathlib import Path
from typing import Any

from app.robot.topics import NAME, OWN, SCAN_TYPES
from app.robot.zenoh import ADMIN, PUBLISHER, data_key
from pipeline.errors import SourceError, StemmapError
from pipeline.io.readers.container import Channel
from pipeline.io.readers.mcap_file import McapFile
from pipeline.io.readers.topics import is_fixed

_MSGTYPE = re.compile(r"[A-Za-z][A-Za-z0-9_]*/msg/[A-Za-z][A-Za-z0-9_]*")
_HASH = "RIHS01_0"  # of the message types; stemmap does not compare it
_POLL_S = 0.1
_FIXED = 100  # messages of a topic of fixed transforms
_OTHERS_S = 0.5  # until the other topics are subscribed to as well


def send(file: Path, port: int) -> int:
    """Wait until somebody subscribes to the scans, then send the messages of ROS 2 topics, except those of
    stemmap, at the pace of the recording, and return the number of scans. What it waits for is printed.

    Args:
        file: Recording of ROS 2 topics as MCAP.
        port: Port of this machine on which it listens, at least 1.

    Raises:
        SourceError: The recording cannot be read, or has no scans that can be sent.
        StemmapError: The port cannot be used.
    """
    import zenoh
    from zenoh import ext

    settings = {
        "mode": "router",
        "listen": {"endpoints": [f"tcp/127.0.0.1:{port}"]},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
    }
    with closing(McapFile(file)) as container:
        channels = {channel.number: channel for channel in container.channels if _is_sent(channel)}
        scans = {number for number, channel in channels.items() if channel.msgtype in SCAN_TYPES}
        if not scans:
            raise SourceError(
                "the recording has no ROS 2 topic with scans",
                where=str(file),
                remedy=f"Name a recording with messages of {' or '.join(SCAN_TYPES)} in CDR",
            )
        try:
            session = zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))
        except zenoh.ZError as error:
            raise StemmapError(
                f"port {port} cannot be used: {error}", remedy="Choose another one with --port"
            ) from None
        with session:
            tokens = []
            publishers: dict[int, Any] = {}
            listeners: list[Any] = []  # zenoh declares the type of `matching_status` wrongly
            for number, channel in channels.items():
                key = data_key(0, channel.topic, channel.msgtype, _HASH)
                node = f"{ADMIN}/0/{session.info.zid()}/0/{number}/{PUBLISHER}/%/%/driver"
                topic = f"{channel.topic.replace('/', '%')}/{key.split('/')[-2]}/{_HASH}/::,10:,:,:,,"
                tokens.append(session.liveliness().declare_token(f"{node}/{topic}"))
                publishers[number] = ext.declare_advanced_publisher(
                    session,
                    key,
                    congestion_control=zenoh.CongestionControl.BLOCK,
                    # Fixed transforms are sent once; who subscribes later gets them too, as from a robot.
                    cache=ext.CacheConfig(_FIXED) if is_fixed(channel.topic) else None,
                    publisher_detection=is_fixed(channel.topic),
                )
                if number in scans:
                    listeners.append(session.declare_publisher(key))
            address = f"zenoh:tcp/127.0.0.1:{port}"
            print(f"The robot waits. Open it with: uv run stemmap {address}", flush=True)  # noqa: T201
            while not any(listener.matching_status.matching for listener in listeners):
                time.sleep(_POLL_S)
            time.sleep(_OTHERS_S)
            begun, first_ns, sent = time.monotonic(), None, 0
            for message in container.messages(list(channels), None, {}):
                first_ns = message.log_ns if first_ns is None else first_ns
                time.sleep(max(0.0, begun + 1e-9 * (message.log_ns - first_ns) - time.monotonic()))
                publishers[message.channel].put(message.payload)
                sent += message.channel in scans
            return sent


def _is_sent(channel: Channel) -> bool:
    """Return whether a channel has messages of a ROS 2 topic that a live run can choose."""
    return bool(
        channel.count
        and channel.encoding in ("cdr", "")
        and _MSGTYPE.fullmatch(channel.msgtype)
        and NAME.fullmatch(channel.topic)
        and OWN not in channel.topic.split("/")[:-1]
    )
