"""A live run that records until it is killed: `python -m tests.app.robot.recorder RUN.mcap OUT.mcap [slow]`.

Says the number of each message once the recording has it, with the time at which it had it. With "slow", the
messages go through a live source whose mapping takes half a second for each scan.
"""

from __future__ import annotations

import sys
import threading
import time
from contextlib import closing
from pathlib import Path

from app.robot.recorder import Recorder
from pipeline.io.readers.container import Channel, Message
from pipeline.io.readers.mcap_file import McapFile
from pipeline.io.readers.topics import POINT_CLOUD
from pipeline.types.records import Scan

_PER_SCAN_S = 0.5  # five times as long as a robot needs at 10 Hz


class _SlowRun:
    """A live source that records what it gets, and mapping that does not keep up.

    Args:
        topics: Topics of the robot.
        recording: The recording.
    """

    def __init__(self, topics: list[Channel], recording: Recorder) -> None:
        # Here, because these imports take seconds, which the other half of the runs does not need.
        from app.robot.source import LiveSource
        from app.sources.live_address import parse_address
        from pipeline.io.readers import SourceOptions
        from tests.app.robot.test_live_session import URI, FakeLink, announce

        links: list[FakeLink] = []

        def connect(address: object, inbox: object) -> FakeLink:
            links.append(FakeLink(address, inbox))  # type: ignore[arg-type]
            return links[0]

        self.topics = topics
        self.source = LiveSource(parse_address(URI), SourceOptions(), connect)
        self.source.start(recording)
        while not links:
            time.sleep(0.01)
        self.link = links[0]
        announce(self.link, self)
        while not self.link.channels:
            time.sleep(0.01)
        self.channels = {channel.topic: channel for channel in self.link.channels}
        threading.Thread(target=self._map, daemon=True).start()

    def _map(self) -> None:
        while True:
            if self.source.listen() and any(isinstance(record, Scan) for record in self.source.take()):
                time.sleep(_PER_SCAN_S)
            time.sleep(0.001)


def main(run: str, out: str, pace: str = "") -> None:
    """Record the run's messages again and again, at about 6 MB/s."""
    with closing(McapFile(Path(run))) as container:
        topics = container.channels
        messages = list(container.messages([c.number for c in topics], None, {}))
    recording = Recorder(Path(out))
    kinds = {channel.number: channel for channel in topics}
    ordered = sorted(topics, key=lambda c: c.topic != "/velodyne_points")
    numbers = {channel.number: k for k, channel in enumerate(ordered, 1)}
    slow = _SlowRun(topics, recording) if pace == "slow" else None
    if slow is None:
        recording.begin(ordered, {"uri": "test", "topics": [c.topic for c in ordered]}, "")
    count = 0
    while True:
        for message in messages:
            channel = kinds[message.channel]
            if slow is None:
                count += 1
                recording.add(Message(numbers[message.channel], count, message.payload))
            elif channel.topic in slow.channels:
                count += 1
                given = Message(slow.channels[channel.topic].number, count, message.payload)
                slow.link.inbox.put(given, is_scan=channel.msgtype == POINT_CLOUD)
            else:
                continue
            print(count, time.monotonic(), flush=True)
            time.sleep(0.016)


if __name__ == "__main__":
    main(*sys.argv[1:])
