"""Writes a live run while it goes on: the messages of the robot and the results of mapping them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from mcap.writer import CompressionType, Writer

from pipeline.io.readers.container import Channel, Message
from pipeline.io.readers.live import NAME, PARAMETERS, SKIPPED, VERSION
from pipeline.io.recording import messages, outputs
from pipeline.io.recording.quality_of_service import BAG_METADATA, offered_qos_profiles

#: Small, because a crash loses the last chunk.
CHUNK_SIZE = 256 << 10
_TEXT = "std_msgs/msg/String"


class Stream(Protocol):
    """Sink of the bytes."""

    def write(self, data: bytes) -> int: ...
    def tell(self) -> int: ...


class LiveWriter:
    """Writer of one recording of a live run, in the ROS 2 profile of MCAP.

    The robot's messages are written in their order of arrival, with their times of arrival as log times. A
    channel names those that the mapping did not use, so that a replay can repeat the live map.

    Args:
        stream: Of a new file.
        channels: Of the robot; they keep their numbers.
        header: What else determines the run, as JSON values: address, topics, seed.
        robot: Its namespace, "" for none.
    """

    def __init__(
        self, stream: Stream, channels: Sequence[Channel], header: Mapping[str, Any], robot: str
    ) -> None:
        self._writer = Writer(stream, chunk_size=CHUNK_SIZE, compression=CompressionType.LZ4)
        self._writer.start(profile="ros2", library="stemmap")
        content = {"version": VERSION, **header}
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
        self._skipped = self._channel(SKIPPED, _TEXT)
        self._sequence: dict[int, int] = {}
        self._last_ns = 0

    def add(self, message: Message) -> None:
        """Write a message of the robot.

        Raises:
            OSError: The disk refuses.
        """
        self._last_ns = message.log_ns
        self._write(self._numbers[message.channel], message.payload)

    def add_outputs(self, messages_by_topic: Mapping[str, bytes]) -> None:
        """Write results of the mapping, at the time of the last message of the robot.

        Raises:
            OSError: The disk refuses.
        """
        for topic, payload in messages_by_topic.items():
            self._write(self._outputs[topic], payload)

    def add_parameters(self, revision: int, from_scan: int, values: Mapping[str, Any]) -> None:
        """Write the parameters that apply from a mapped scan onwards.

        Raises:
            OSError: The disk refuses.
        """
        text = json.dumps({"revision": revision, "from_scan": from_scan, "values": values})
        self._write(self._parameters, messages.text(text))

    def add_skipped(self, times_by_topic: Mapping[str, Sequence[int]]) -> None:
        """Write which messages the mapping did not use: log times [ns] by topic.

        Raises:
            OSError: The disk refuses.
        """
        self._write(self._skipped, messages.text(json.dumps(times_by_topic)))

    def flush(self) -> None:
        """End the present chunk, so that the system has all messages.

        Raises:
            OSError: The disk refuses.
        """
        # The library ends a chunk when it is full or the file ends, and has no public method for it.
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
