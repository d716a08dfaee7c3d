"""Velodyne data packets (1206 bytes): decoding of packets into a Scan, for captures, ROS messages and UDP."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import velodyne_decoder
from numpy.typing import NDArray

from pipeline.io.readers.scan_columns import clean_scan
from pipeline.types.records import Bool, Int, Scan, Sensor

PACKET_BYTES = 1206
BLOCK_BYTES, BLOCKS = 100, 12
PRODUCT = 1205
#: VLP-32A and VLP-32B share a product number; the later one is assumed.
VLP_32 = 0x23


def _sensor(name: str, rings: int, ring_step: float, range_max: float) -> Sensor:
    return Sensor(name, rings, float(np.radians(ring_step)), float(np.radians(0.2)), 0.03, range_max)


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
    """Return whether the bytes are a data packet of a known sensor."""
    return len(packet) == PACKET_BYTES and bool(
        are_data_packets(np.frombuffer(packet, np.uint8), np.zeros(1, np.int64))[0]
    )


def are_data_packets(buffer: NDArray[np.uint8], at: Int) -> Bool:
    """Return which places of a buffer hold a data packet of a known sensor, shape (N,).

    The decoder accepts any 1206 bytes, so the flags and azimuths of the twelve blocks and the product number
    are checked before.

    Args:
        buffer: Bytes.
        at: First byte of each packet, shape (N,); 1206 bytes from there are in the buffer.
    """
    heads = buffer[at[:, None, None] + BLOCK_BYTES * np.arange(BLOCKS)[:, None] + np.arange(4)]
    azimuth = heads[..., 2].astype(np.int64) + 256 * heads[..., 3].astype(np.int64)
    sound = (heads[..., 0] == 0xFF) & (heads[..., 1] >= 0xBB) & (azimuth < 36000)
    return np.asarray(sound.all(axis=1) & np.isin(buffer[at + PRODUCT], list(SENSORS)))


class PacketDecoder:
    """Decodes the packets of one sensor, one sweep at a time."""

    def __init__(self) -> None:
        self._decoders: dict[int, velodyne_decoder.ScanDecoder] = {}

    def decode(self, stamp_ns: int, stamps_ns: Sequence[int], packets: Sequence[bytes]) -> Scan:
        """Decode the packets of one sweep; each must pass `is_data_packet`.

        Args:
            stamp_ns: Stamp of the scan.
            stamps_ns: Time of arrival of each packet; point times are relative to the last one.
            packets: In the order of time.

        Raises:
            PacketError: There are no packets, or the decoder refuses them.
        """
        if not packets:
            raise PacketError("no packets")
        vector = velodyne_decoder.PacketVector()
        try:
            for arrived, packet in zip(stamps_ns, packets, strict=True):
                vector.append(velodyne_decoder.VelodynePacket(arrived * 1e-9, packet))
            _stamp, table = self._decoder_of(packets[0][PRODUCT]).decode(vector, True)
        except Exception as error:  # the decoder raises whatever its C++ library throws
            raise PacketError(str(error)) from error
        return self._scan(stamp_ns, stamps_ns[-1] - stamp_ns, table)

    def _decoder_of(self, product: int) -> velodyne_decoder.ScanDecoder:
        """Return the decoder of a product number; it finds the model itself, except for VLP-32."""
        if product not in self._decoders:
            model = velodyne_decoder.Model.VLP32B if product == VLP_32 else None
            self._decoders[product] = velodyne_decoder.ScanDecoder(velodyne_decoder.Config(model=model))
        return self._decoders[product]

    def _scan(self, stamp_ns: int, late: int, table: NDArray[np.void]) -> Scan:
        points = np.stack([table["x"], table["y"], table["z"]], axis=1)
        with np.errstate(invalid="ignore"):
            offset = np.clip(np.nan_to_num(table["time"].astype(np.float64)) * 1e9 + late, -2e9, 2e9)
        return clean_scan(
            stamp_ns, points, reflectance=table["intensity"], ring=table["ring"], offset_ns=offset
        )
