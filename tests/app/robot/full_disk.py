"""A live run that records where files may grow to a size alone: `full_disk.py RUN OUT BYTES`.

Says as JSON, for each status that the worker tells, the scan that stands and what it says of the recording.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from contextlib import closing
from pathlib import Path

from app.robot.recorder import Recorder
from app.worker.protocol import Begin, Open
from pipeline.config import Parameters
from pipeline.io.readers.container import Message
from pipeline.io.readers.mcap_file import McapFile
from pipeline.io.readers.topics import POINT_CLOUD
from tests.app.robot.conftest import SCANS, until
from tests.app.robot.test_live_session import URI, announce, stage


class _Topics:
    """What `announce` asks for."""

    def __init__(self, topics: list[object]) -> None:
        self.topics = topics


def main(run: str, out: str, most: int) -> None:
    """Map all scans of the run, whatever becomes of its recording."""
    with closing(McapFile(Path(run))) as container:
        kinds = {c.number: c for c in container.channels}
        messages = list(container.messages(list(kinds), None, {}))
    refused_s: list[float] = []
    refuse = Recorder._end_with

    def noted(recording: Recorder, error: OSError) -> None:
        refused_s.append(time.monotonic())
        refuse(recording, error)

    setattr(Recorder, "_end_with", noted)  # noqa: B010 - the type checker takes it for something else
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))  # Python gets an error for it, and no signal
    with stage() as on:
        on.commands.put(Open(URI, record=out))
        until(lambda: on.links)
        link = on.links[0]
        announce(link, _Topics(list(kinds.values())))
        until(lambda: link.channels)
        numbers = {channel.topic: channel.number for channel in link.channels}
        link.silence_s = 0.0
        sent, begun = 0, False
        said_s: list[float] = []
        for message in messages:
            channel = kinds[message.channel]
            if channel.topic not in numbers:
                continue
            put = Message(numbers[channel.topic], message.log_ns, message.payload)
            link.inbox.put(put, is_scan=channel.msgtype == POINT_CLOUD)
            sent += channel.msgtype == POINT_CLOUD
            if sent == 11 and not begun:
                until(on.opened)
                on.commands.put(Begin(1, Parameters().model_dump(), 1, True))
                begun = True
            if refused_s and not said_s and on.status.recording.startswith("not recording"):
                said_s.append(time.monotonic())
            time.sleep(0.002)
        until(lambda: on.shown and on.shown[-1] == SCANS - 1)
        until(lambda: on.status.recording.startswith("not recording"))
        after_s = (said_s or [time.monotonic()])[0] - refused_s[0]
        told = {"shown": len(on.shown), "recording": on.status.recording, "said_after_s": after_s}
        print(json.dumps(told), flush=True)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]))
