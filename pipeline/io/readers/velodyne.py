"""Velodyne data packets (1206 bytes): decoding of packets into a Scan, for ROS messages and UDP."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.io.readers.scan_columns import clean_scan
from pipeline.types.records import Scan, Sensor

if TYPE_CHECKING:
    import velodyne_decoder

PACKET_BYTES = 1206
PRODUCT = 1205
#: Two flags and the azimuth of each of the twelve blocks of a packet.
_HEADS = struct.Struct("<" + 12 * "BBH96x" + "6x")
_TURN = 36_000  # 0.01 degrees
#: A longer silence between packets ends a sweep.
GAP_NS = 50_000_000
#: VLP-32A and VLP-32B share a product number; the later one is assumed.
VLP_32 = 0x23


def _sensor(name: str, rings: int, ring_step: float, range_max: float) -> Sensor:
    """Return a sensor with an azimuth step of 0.2 degrees; its range sigma is measured in the first scan.

    Args:
        name: Name.
        rings: Number of rings.
        ring_step: Step in elevation [degrees].
        range_max: Maximum range [m].
    """
    return Sensor(name, rings, float(np.radians(ring_step)), float(np.radians(0.2)), range_max=range_max)


#: Sensors by product number, the last byte of a packet. An HDL-64 does not send it.
SENSORS = {
    0x21: _sensor("HDL-32E", 32, 1.33, 100.0),
    0x22: _sensor("VLP-16", 16, 2.0, 100.0),
    VLP_32: _sensor("VLP-32", 32, 0.33, 200.0),
    0x24: _sensor("Puck Hi-Res", 16, 1.33, 100.0),
    0x28: _sensor("VLP-32C", 32, 0.33, 200.0),
    0xA1: _sensor("VLS-128", 128, 0.11, 245.0),
}


class PacketError(Exception):
    """There are no packets, or the decoder refuses them."""


def is_data_packet(packet: bytes) -> bool:
    """Return whether the bytes are a data packet of a known sensor.

    The length, the flags and azimuths of the twelve blocks, and the product number are checked.
    """
    if len(packet) != PACKET_BYTES or packet[PRODUCT] not in SENSORS:
        return False
    heads = _HEADS.unpack(packet)
    return set(heads[::3]) == {0xFF} and min(heads[1::3]) >= 0xBB and max(heads[2::3]) < _TURN


class Rotation:
    """Finds the packets of one sensor with which a sweep begins: after a full revolution, or after a pause of
    more than GAP_NS."""

    def __init__(self) -> None:
        """Begin before the first packet."""
        self._azimuth: int | None = None
        self._stamp_ns = self._turned = 0

    def begins(self, azimuth: int, stamp_ns: int) -> bool:
        """Process the next packet; return whether a sweep begins with it: after a full revolution, or a pause
        of more than GAP_NS. The result is False for the first packet.

        Args:
            azimuth: Azimuth of the first block of the packet [0.01 degrees].
            stamp_ns: Time of arrival of the packet [ns].
        """
        before = self._azimuth
        step = 0 if before is None else (azimuth - before) % _TURN
        self._turned += step if step < _TURN // 2 else 0  # a small step back is jitter of the motor
        paused = before is not None and stamp_ns - self._stamp_ns > GAP_NS
        self._azimuth, self._stamp_ns = azimuth, stamp_ns
        if self._turned < _TURN and not paused:
            return False
        self._turned = 0
        return True


class VelodyneDecoder:
    """Decodes the packets of one sensor, one sweep at a time."""

    def __init__(self) -> None:
        """Begin without decoders; each product number gets its own."""
        self._decoders: dict[int, velodyne_decoder.ScanDecoder] = {}

    def is_data(self, packet: bytes) -> bool:
        """Return whether the bytes are a data packet of a known sensor."""
        return is_data_packet(packet)

    def refuse(self, packet: bytes) -> None:
        """Return: models that cannot be decoded are not known by their packets."""

    def decode(
        self, stamp_ns: int, stamps_ns: Sequence[int], packets: Sequence[bytes]
    ) -> tuple[Scan, Sensor]:
        """Return the scan of the packets of one sweep, which may have no points, and the sensor except for
        its range sigma; each packet must pass `is_data_packet`, and all are of one sensor.

        Args:
            stamp_ns: Stamp of the scan [ns].
            stamps_ns: Time of arrival of each packet [ns]. The times of the points are derived from that of
                the last packet and clipped to 2 s before and after the stamp.
            packets: Packets in the order of time.

        Raises:
            PacketError: There are no packets, the numbers of stamps and packets differ, or the decoder
                refuses the packets.
        """
        import velodyne_decoder

        if not packets:
            raise PacketError("no packets")
        vector = velodyne_decoder.PacketVector()
        try:
            for arrived, packet in zip(stamps_ns, packets, strict=True):
                vector.append(velodyne_decoder.VelodynePacket(arrived * 1e-9, packet))
            _stamp, table = self._decoder_of(packets[0][PRODUCT]).decode(vector, True)
        except Exception as error:  # the decoder raises whatever its C++ library throws
            raise PacketError(str(error)) from error
        return self._scan(stamp_ns, stamps_ns[-1] - stamp_ns, table), SENSORS[packets[0][PRODUCT]]

    def _decoder_of(self, product: int) -> velodyne_decoder.ScanDecoder:
        """Return the decoder of a product number; it finds the model itself, except for VLP-32."""
        import velodyne_decoder

        if product not in self._decoders:
            model = velodyne_decoder.Model.VLP32B if product == VLP_32 else None
            self._decoders[product] = velodyne_decoder.ScanDecoder(velodyne_decoder.Config(model=model))
        return self._decoders[product]

    def _scan(self, stamp_ns: int, late: int, table: NDArray[np.void]) -> Scan:
        """Return the scan of a decoded table.

        Args:
            stamp_ns: Stamp of the scan [ns].
            late: Time of arrival of the last packet after the stamp [ns].
            table: Columns x, y, z [m], intensity, ring and time [s] relative to the last packet.
        """
        points = np.stack([table["x"], table["y"], table["z"]], axis=1)
        with np.errstate(invalid="ignore"):
            offset = np.clip(np.nan_to_num(table["time"].astype(np.float64)) * 1e9 + late, -2e9, 2e9)
        return clean_scan(
            stamp_ns, points, reflectance=table["intensity"], ring=table["ring"], offset_ns=offset
        )
