"""Writes a live run as it goes: the robot's messages as they were taken in, and what came of them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from mcap.writer import CompressionType, Writer

from pipeline.io.readers.container import Channel, Message
from pipeline.io.readers.live import NAME, PARAMETERS, VERSION
from pipeline.io.recording import messages, outputs
from pipeline.io.recording.quality_of_service import BAG_METADATA, offered_qos_profiles

#: Small, so that little is lost with the last one.
CHUNK_SIZE = 256 << 10
_TEXT = "std_msgs/msg/String"


class Stream(Protocol):
    """Where the bytes go."""

    def write(self, data: bytes) -> int: ...
    def tell(self) -> int: ...


class LiveWriter:
    """One recording of a live run, in the profile of ROS 2.

    The robot's messages are written in the order in which the run took them, at their times of arrival,
    which is all that a replay needs for the same map. What a full queue let fall out is not in it.

    Args:
        stream: Of a new file.
        channels: Of the robot; they get the numbers that they have.
        told: What else the run hangs on, as JSON: address, topics, seed.
        robot: Its namespace, "" for none.
    """

    def __init__(
        self, stream: Stream, channels: Sequence[Channel], told: Mapping[str, Any], robot: str
    ) -> None:
        self._writer = Writer(stream, chunk_size=CHUNK_SIZE, compression=CompressionType.LZ4)
        self._writer.start(profile="ros2", library="stemmap")
        content = {"version": VERSION, **told}
        self._writer.add_attachment(0, 0, NAME, "application/json", json.dumps(content).encode())
        self._writer.add_metadata(*BAG_METADATA)
        self._schemas: dict[str, int] = {}
        self._numbers = {c.number: self._channel(c.topic, c.msgtype) for c in channels}
        prefix = f"/{robot}/stemmap" if robot else "/stemmap"
        self._outputs = {
            topic: self._channel(
                f"{prefix}/{topic}", kind, outputs.definition(topic), topic in outputs.LATCHED
            )
            for topic, kind in outputs.TYPES.items()
        }
        self._parameters = self._channel(PARAMETERS, _TEXT, latched=True)
        self._sequence: dict[int, int] = {}
        self._last_ns = 0

    def add(self, message: Message) -> None:
        """A message that the run takes in.

        Raises:
            OSError: The disk refuses.
        """
        self._last_ns = message.log_ns
        self._write(self._numbers[message.channel], message.payload)

    def add_outputs(self, messages_by_topic: Mapping[str, bytes]) -> None:
        """What came of the messages so far.

        Raises:
            OSError: The disk refuses.
        """
        for topic, payload in messages_by_topic.items():
            self._write(self._outputs[topic], payload)

    def add_parameters(self, revision: int, from_scan: int, values: Mapping[str, Any]) -> None:
        """With which parameters the scans from one on are mapped.

        Raises:
            OSError: The disk refuses.
        """
        text = json.dumps({"revision": revision, "from_scan": from_scan, "values": values})
        self._write(self._parameters, messages.text(text))

    def flush(self) -> None:
        """Hand all that waits to the system.

        Raises:
            OSError: The disk refuses.
        """
        # The library ends a chunk when it is full or the file ends, and has no public word for "now".
        self._writer._Writer__finalize_chunk()

    def finish(self) -> None:
        """Write the index.

        Raises:
            OSError: The disk refuses.
        """
        self._writer.finish()

    def _channel(self, topic: str, kind: str, definition: str = "", latched: bool = False) -> int:
        if kind not in self._schemas:
            text = definition or messages.definition(kind)
            self._schemas[kind] = int(self._writer.register_schema(kind, "ros2msg", text.encode()))
        latched = latched or topic.endswith("tf_static")
        profiles = {"offered_qos_profiles": offered_qos_profiles(latched)}
        return int(self._writer.register_channel(topic, "cdr", self._schemas[kind], profiles))

    def _write(self, channel: int, payload: bytes) -> None:
        number = self._sequence.get(channel, 0)
        self._sequence[channel] = number + 1
        self._writer.add_message(channel, self._last_ns, payload, self._last_ns, number)
