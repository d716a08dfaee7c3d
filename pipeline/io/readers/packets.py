"""How messages of makers of LiDARs are read, beside those of Velodyne; `add_formats` adds them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pipeline.io.readers.base import SourceOptions
    from pipeline.io.readers.container import Container
    from pipeline.types.records import Scan, Sensor


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
class PacketFormat:
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
