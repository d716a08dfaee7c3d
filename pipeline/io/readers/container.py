"""What a recording of stamped messages is, whichever of the three file formats holds it."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Protocol

from pipeline.errors import SourceError


@dataclass(frozen=True, slots=True)
class Channel:
    """One publisher's messages of one topic.

    Attributes:
        number: The file's own number of it.
        topic: e.g. "/velodyne_points".
        msgtype: In the ROS 2 spelling, e.g. "sensor_msgs/msg/PointCloud2".
        encoding: "cdr" (ROS 2) or "ros1".
        definition: The text of the message's definition, "" when the file has none.
        definition_format: "ros2msg", "ros1msg", "ros2idl" or "".
        count: Number of messages.
    """

    number: int
    topic: str
    msgtype: str
    encoding: str
    definition: str
    definition_format: str
    count: int


@dataclass(frozen=True, slots=True)
class Message:
    """One message as it was recorded: its channel's number, when it was written, its bytes."""

    channel: int
    log_ns: int
    payload: bytes


class Container(Protocol):
    """A recording that can be read from any time. Nothing is decoded here."""

    @property
    def kind(self) -> str:
        """The format in words, e.g. "ROS 2 MCAP"."""

    @property
    def channels(self) -> list[Channel]:
        """All channels."""

    def tail_ns(self, numbers: Collection[int]) -> int:
        """A time from which on reading meets the last message of these channels, soon after."""

    @property
    def damage(self) -> dict[str, int]:
        """What could not be read when the file was opened, by reason."""

    def messages(
        self, numbers: Collection[int], start_ns: int | None, losses: dict[str, int]
    ) -> Iterator[Message]:
        """Yield the messages of these channels in the order of writing, from `start_ns` on.

        Parts that cannot be read are counted in `losses` and left out.
        """

    def attachment(self, name: str, limit: int) -> bytes | None:
        """The bytes of a file attached to the recording, None when there is none of this name.

        Raises:
            SourceError: It is longer than `limit` bytes or damaged.
        """

    def close(self) -> None:
        """Close the file; safe to call twice."""


def count_loss(losses: dict[str, int], reason: str, number: int = 1) -> None:
    """Add to the losses of one reason."""
    losses[reason] = losses.get(reason, 0) + number


def ros2_type_name(name: str) -> str:
    """Spell a message type as ROS 2 does: "sensor_msgs/Imu" becomes "sensor_msgs/msg/Imu"."""
    parts = [part for part in name.split("/") if part]
    return "/".join([parts[0], "msg", parts[1]]) if len(parts) == 2 else "/".join(parts)


def damaged(what: str, path: object) -> SourceError:
    """The error for a file that cannot be read at all."""
    return SourceError(what, where=str(path), remedy="Copy the file again, or record it again.")
