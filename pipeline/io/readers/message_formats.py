"""Formats of messages of LiDARs, beside those of Velodyne, and of readings of a pose in another frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pipeline.geometry.poses import Float
    from pipeline.io.readers.base import SourceOptions
    from pipeline.io.readers.container import Container, Message
    from pipeline.io.readers.ros_records import RecordDecoder
    from pipeline.types.records import PoseMeasurement, Scan, Sensor


class SweepDecoder(Protocol):
    """Decodes the packets of one sensor, one sweep at a time."""

    def is_data(self, packet: bytes) -> bool:
        """Return whether a packet is a data packet of a known model."""

    def refuse(self, packet: bytes) -> None:
        """Raise a SourceError that names the model of a packet that cannot be decoded, if it is known."""

    def decode(
        self, stamp_ns: int, stamps_ns: Sequence[int], packets: Sequence[bytes]
    ) -> tuple[Scan, Sensor]:
        """Return the scan of the packets of a sweep, which may have no points, and the sensor except for its
        range sigma.

        Args:
            stamp_ns: Stamp of the scan [ns].
            stamps_ns: Time of arrival of each packet [ns].
            packets: Data packets in the order of time.

        Raises:
            Exception: There is no packet, or they cannot be decoded.
        """


@dataclass(frozen=True, slots=True)
class MessageFormat:
    """Packets or scans of a maker in ROS messages.

    Attributes:
        words: Name for the user.
        msgtypes: Types of the messages.
        sweeps: Returns a decoder of messages with the packets of one sweep; None if a message has one packet.
        recording: Function of a recording, its file or folder, the choices of the user and the recording as
            the user wrote it. It returns the recording with clouds in place of packets, or as it is if it has
            none that shall be decoded; None if it does not decode them.
        columns: Function of a message with all points of a scan, its encoding and its stamp [ns]. It returns
            the frame and a dict from names to columns, see `scan_of`; it raises any exception for a damaged
            one. None for packets.
        driver: Driver that makes clouds of packets which are not decoded, or not of live robots.
        refusal: Why it cannot be used, as the remedy of an error; "" if it can.
    """

    words: str
    msgtypes: tuple[str, ...]
    sweeps: Callable[[], SweepDecoder] | None = None
    recording: Callable[[Container, Path, SourceOptions, str], Container] | None = None
    columns: Callable[[bytes, str, int], tuple[str, dict[str, NDArray[np.generic]]]] | None = None
    driver: str = ""
    refusal: str = ""


class UnusableReadingError(ValueError):
    """A reading cannot be used; the message gives the reason, which is counted."""


class MeasuredFrame(Protocol):
    """Pose of the frame of some readings in the map frame."""

    @property
    def summary(self) -> str:
        """How the readings are used, as text for the user."""

    @property
    def yaw_sigma(self) -> float:
        """Standard deviation of the rotation of the frame [rad]."""

    def measurement(self, reading: Any) -> PoseMeasurement | None:  # noqa: ANN401
        """Return a reading as measurement in the map; None if it does not count."""


@dataclass(frozen=True, slots=True)
class ReadingFormat:
    """A kind of readings of the position or the pose in another frame.

    Attributes:
        role: Role of their topic, see `TYPES_BY_ROLE`.
        field: Field of `SourceDescription` that describes the use of the readings.
        messages, title, plural, short, unknown: For people: name of the messages, of the kind, plural, short
            plural, and what a short drive does not determine.
        read: Function of a decoder, a message and its time [ns] that returns the reading, None if the message
            has none, and the name of its frame. It may raise any exception for a damaged message.
        align: Function of readings, times [ns] and poses of the odometry, and distance of the sensor from the
            base [m] that returns the frame and "", or None and the reason.
        stretch: Distance from the start for the first fit, and for the last one [m].
        early: Whether a recording uses the first good fit, as a live run does, or the last one.
        refusal: Why it cannot be used, for people; "" if it can.
    """

    role: str
    field: str
    messages: str
    title: str
    plural: str
    short: str
    unknown: str
    read: Callable[[RecordDecoder, Message, int], tuple[Any, str]]
    align: Callable[[Sequence[Any], Sequence[int], Float, float], tuple[MeasuredFrame | None, str]]
    stretch: tuple[float, float]
    early: bool
    refusal: str = ""
