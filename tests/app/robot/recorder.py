"""A live run that records until it is killed: `python -m tests.app.robot.recorder RUN.mcap OUT.mcap`.

Says the number of each message once the recording has it, with the time at which it had it.
"""

from __future__ import annotations

import sys
import time
from contextlib import closing
from pathlib import Path

from app.robot.recorder import Recorder
from pipeline.io.readers.container import Message
from pipeline.io.readers.mcap_file import McapFile


def main(run: str, out: str) -> None:
    """Record the run's messages again and again, at about 6 MB/s."""
    with closing(McapFile(Path(run))) as container:
        topics = container.channels
        messages = list(container.messages([c.number for c in topics], None, {}))
    recording = Recorder(Path(out))
    ordered = sorted(topics, key=lambda c: c.topic != "/velodyne_points")
    numbers = {channel.number: k for k, channel in enumerate(ordered, 1)}
    recording.begin(ordered, {"uri": "test", "topics": [c.topic for c in ordered]}, "")
    count = 0
    while True:
        for message in messages:
            count += 1
            recording.add(Message(numbers[message.channel], count, message.payload))
            print(count, time.monotonic(), flush=True)
            time.sleep(0.016)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
