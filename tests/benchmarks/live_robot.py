"""A robot that sends a recording over Zenoh in real time: `live_robot.py PORT RUN NAME`.

Payloads are sent as stored in the file, so that the cost is small compared with what is measured. The robot
starts at a line on stdin, and prints at the end how many scans it sent.
"""

from __future__ import annotations

import json
import struct
import sys
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import zenoh
from zenoh import ext

from app.robot.zenoh import ADMIN, PUBLISHER, configuration, data_key
from pipeline.io.readers.mcap_file import McapFile
from pipeline.io.readers.topics import POINT_CLOUD

_HASH = "RIHS01_0"


class Topic:
    """One topic, announced and numbered as by rmw_zenoh."""

    def __init__(self, session: Any, robot: str, number: int, topic: str, msgtype: str) -> None:
        name = f"/{robot}{topic}"
        key = data_key(0, name, msgtype, _HASH)
        kind = key.split("/")[-2]
        head = f"{ADMIN}/0/{session.info.zid()}/0/{number}/{PUBLISHER}/%/%{robot}/driver"
        self._token = session.liveliness().declare_token(
            f"{head}/{name.replace('/', '%')}/{kind}/{_HASH}/::,10:,:,:,,"
        )
        latched = topic.endswith("tf_static")
        self._publisher = ext.declare_advanced_publisher(
            session,
            key,
            congestion_control=zenoh.CongestionControl.BLOCK,
            cache=ext.CacheConfig(1) if latched else None,
            publisher_detection=latched,
        )
        self._gid = struct.pack("<QQ", number, id(self))
        self._sequence = 0

    def put(self, payload: bytes) -> None:
        """Send a message."""
        self._sequence += 1
        head = struct.pack("<QQB", self._sequence, time.time_ns(), len(self._gid))
        self._publisher.put(payload, attachment=head + self._gid)


def main(port: str, run: str, robot: str) -> None:
    """Send a whole recording once."""
    with closing(McapFile(Path(run))) as container:
        channels = {c.number: c for c in container.channels}
        messages = list(container.messages(list(channels), None, {}))
    with zenoh.open(zenoh.Config.from_json5(configuration(f"tcp/127.0.0.1:{port}"))) as session:
        topics = {n: Topic(session, robot, n, c.topic, c.msgtype) for n, c in channels.items()}
        print(json.dumps({"ready": True}), flush=True)
        sys.stdin.readline()
        began, first, sent = time.monotonic(), messages[0].log_ns, 0
        for message in messages:
            time.sleep(max(0.0, began + (message.log_ns - first) * 1e-9 - time.monotonic()))
            topics[message.channel].put(message.payload)
            sent += channels[message.channel].msgtype == POINT_CLOUD
        took = time.monotonic() - began
        print(json.dumps({"sent": sent, "seconds": took}), flush=True)
        sys.stdin.readline()


if __name__ == "__main__":
    main(*sys.argv[1:4])
