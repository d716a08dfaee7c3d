"""Hesai data packets: layout and angles of the models, and decoding of a sweep into a Scan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import SourceError
from pipeline.io.readers.scan_columns import clean_scan
from pipeline.types.records import Bool, Float, Int, Scan, Sensor

_TURN = 36_000  # 0.01 degrees
#: Number of echoes of a shot by the return mode, in as many blocks of one azimuth; other modes have one.
_ECHOES = {0x39: 2, 0x3A: 2, 0x3B: 2, 0x3C: 2, 0x3D: 3}
#: Echoes of one shot nearer than this are one surface [m]; of these the last block is taken.
ONE_SURFACE = 0.1
_RPM = 600  # of a packet without a speed


class HesaiPacketError(Exception):
    """There are no packets, or they are of a model whose angles are not in this module."""


@dataclass(frozen=True, slots=True)
class HesaiModel:
    """Layout of the packets and angles of a model by its user manual.

    Attributes:
        name: Name of the model.
        elevation: Elevation of each channel [degrees].
        azimuth: Azimuth of each channel relative to the block, clockwise [degrees].
        blocks: Blocks of a packet.
        head: Bytes before the first block.
        mark: Bytes of a block before its azimuth.
        unit: Bytes of a channel: distance (2), reflectivity (1) and reserved ones.
        mode, speed: Positions of the return mode and of the speed of the motor [rpm] after the last block.
        tail: Bytes after the last block; a sequence number of 4 bytes may follow.
        azimuth_step: Step between shots at 10 Hz [degrees].
        range_max: Maximum range [m].
    """

    name: str
    elevation: tuple[float, ...]
    azimuth: tuple[float, ...]
    blocks: int
    head: int
    mark: int
    unit: int
    mode: int
    speed: int
    tail: int
    azimuth_step: float
    range_max: float

    @property
    def channels(self) -> int:
        """Number of channels."""
        return len(self.elevation)

    @property
    def block(self) -> int:
        """Bytes of a block."""
        return self.mark + 2 + self.unit * self.channels

    @property
    def body(self) -> int:
        """Bytes up to the end of the last block."""
        return self.head + self.blocks * self.block

    @property
    def sensor(self) -> Sensor:
        """The sensor; its range sigma is measured in the first scan."""
        steps = np.abs(np.diff(self.elevation))
        ring_step, azimuth_step = np.radians(np.median(steps)), np.radians(self.azimuth_step)
        return Sensor(
            f"Hesai {self.name}",
            self.channels,
            float(ring_step),
            float(azimuth_step),
            range_max=self.range_max,
        )


#: Elevations of Pandar64, of which 40P has a part; the channels between 2 and -6 degrees are side by side.
_E64: tuple[float, ...] = (14.882, 11.032, 8.059, 5.057, 3.04, 2.028)
_E64 += (1.86, 1.688, 1.522, 1.351, 1.184, 1.013, 0.846, 0.675, 0.508, 0.337, 0.169, 0.0)
_E64 += (-0.169, -0.337, -0.508, -0.675, -0.845, -1.013, -1.184, -1.351, -1.522, -1.688, -1.86, -2.028)
_E64 += (-2.198, -2.365, -2.536, -2.7, -2.873, -3.04, -3.21, -3.375, -3.548, -3.712, -3.884, -4.05)
_E64 += (-4.221, -4.385, -4.558, -4.72, -4.892, -5.057, -5.229, -5.391, -5.565, -5.726, -5.898, -6.061)
_E64 += (-7.063, -8.059, -9.06, -10.045, -11.032, -12.006, -12.974, -13.93, -18.889, -24.897)
_E40 = (*_E64[:6], *_E64[7:54:2], *_E64[54:])
_SIDE = 1.042
_A64 = 6 * (-_SIDE,) + 8 * (_SIDE, 3.125, 5.208, -5.208, -3.125, -_SIDE) + 10 * (-_SIDE,)
_A40 = 6 * (-_SIDE,) + 8 * (3.125, -5.208, -_SIDE) + 10 * (-_SIDE,)
#: Elevations and azimuths of PandarQT, from below; those above the horizon mirror those below it.
_EQT: tuple[float, ...] = (
    52.121,
    49.785,
    47.577,
    45.477,
    43.465,
    41.528,
    39.653,
    37.831,
    36.055,
    34.32,
    32.619,
    30.95,
)
_EQT += (29.308, 27.69, 26.094, 24.517, 22.964, 21.42, 19.889, 18.372, 16.865, 15.368, 13.88, 12.399)
_EQT += (10.925, 9.457, 7.994, 6.535, 5.079, 3.626, 2.175, 0.725)
_AQT: tuple[float, ...] = (
    8.736,
    8.314,
    7.964,
    7.669,
    7.417,
    7.198,
    7.007,
    6.838,
    6.688,
    6.554,
    6.434,
    6.326,
    6.228,
    6.14,
)
_AQT += (6.059, 5.987, -5.27, -5.216, -5.167, -5.123, -5.083, -5.047, -5.016, -4.988, -4.963, -4.942)
_AQT += (-4.924, -4.91, -4.898, -4.889, -4.884, -4.881, 5.493, 5.496, 5.502, 5.512, 5.525, 5.541, 5.561)
_AQT += (5.584, 5.611, 5.642, 5.676, 5.716, 5.759, 5.808, 5.862, 5.921, -5.33, -5.396, -5.469, -5.55)
_AQT += (-5.64, -5.74, -5.85, -5.974, -6.113, -6.269, -6.447, -6.651, -6.887, -7.163, -7.493, -7.892)


def _steps(highest: float, step: float, number: int) -> tuple[float, ...]:
    """Return elevations from the highest downwards in equal steps [degrees]."""
    return tuple(round(highest - step * k, 3) for k in range(number))


def _xt(name: str, elevation: tuple[float, ...], blocks: int, range_max: float) -> HesaiModel:
    """Return a model of the series PandarXT."""
    azimuth = len(elevation) * (0.0,)
    return HesaiModel(name, elevation, azimuth, blocks, 12, 0, 4, 10, 11, 24, 0.18, range_max)


_PANDAR_40P = HesaiModel("Pandar40P", _E40, _A40, 10, 0, 2, 3, 14, 8, 22, 0.2, 200.0)
_PANDAR_64 = HesaiModel("Pandar64", _E64, _A64, 6, 8, 0, 3, 14, 8, 22, 0.2, 200.0)
#: Models with a header, by the numbers of channels and blocks in it.
_MODELS = {
    (64, 6): _PANDAR_64,
    (64, 4): HesaiModel(
        "PandarQT", (*(-e for e in _EQT), *reversed(_EQT)), _AQT, 4, 12, 0, 4, 16, 10, 24, 0.6, 60.0
    ),
    (16, 8): _xt("PandarXT-16", _steps(15.0, 2.0, 16), 8, 120.0),
    (32, 8): _xt("PandarXT-32", _steps(15.0, 1.0, 32), 8, 120.0),
    (32, 6): _xt("XT32M2X", _steps(19.5, 1.3, 32), 6, 300.0),
}
MODELS = (_PANDAR_40P, *_MODELS.values())


def model_of(packet: bytes) -> HesaiModel | None:
    """Return the model of a data packet; None for other packets, and for models that are not in MODELS."""
    if packet[:2] == b"\xff\xee":
        model: HesaiModel | None = _PANDAR_40P
    elif packet[:2] == b"\xee\xff" and len(packet) > 12:
        # The older header begins with the number of channels, the newer one with the version.
        short = packet[2] in (20, 40, 64)
        model = _MODELS.get((packet[2], packet[3]) if short else (packet[6], packet[7]))
        if model is not None and (model.head == 8) is not short:
            return None
    else:
        return None
    fits = model is not None and len(packet) - model.body - model.tail in (0, 4)
    return model if fits else None


def other_model(packet: bytes) -> str:
    """Return the name of the model of a Hesai packet that `model_of` does not know; "" for other packets."""
    if packet[:2] != b"\xee\xff" or len(packet) < 12:
        return ""
    named = {(1, 128): "Pandar128 or OT128", (3, 128): "QT128", (4, 128): "AT128"}
    name = named.get((packet[2], packet[6]), f"model with {packet[6]} channels")
    return f"Hesai {name} (packets of version {packet[2]}.{packet[3]})"


def refuse(packet: bytes) -> None:
    """Raise a SourceError that names the model of a Hesai packet which `model_of` does not know; nothing for
    other packets."""
    name = other_model(packet)
    if name:
        raise SourceError(
            f"packets of a {name}, which cannot be decoded: its angles are in a file of the device",
            remedy="Play them through hesai_ros_driver with this file, and record its PointCloud2. "
            f"Decoded are {', '.join(model.name for model in MODELS)}.",
        )


def decode_hesai(
    stamp_ns: int, stamps_ns: Sequence[int], packets: Sequence[bytes]
) -> tuple[Scan, HesaiModel]:
    """Return the scan of the packets of one sweep, and the model. The frame is that of the maker's driver: y
    along azimuth 0, z up. The scan may have no points. Rings are the channels from below.

    Args:
        stamp_ns: Stamp of the scan [ns].
        stamps_ns: Time of arrival of each packet [ns]. The last shot is that of the last packet; the times
            of the others follow from their azimuths and the speed of the motor.
        packets: Packets in the order of time; those of another model than the first are left out.

    Raises:
        HesaiPacketError: There is no packet of a known model.
    """
    model = next((found for each in packets if (found := model_of(each)) is not None), None)
    if model is None:
        raise HesaiPacketError("no packets of a known model")
    kept = [k for k, each in enumerate(packets) if model_of(each) is model]
    # A sequence number after the tail is not needed.
    length = model.body + model.tail
    raw = np.frombuffer(b"".join(packets[k][:length] for k in kept), np.uint8).reshape(-1, length)
    blocks = raw[:, model.head : model.body].reshape(-1, model.block)
    azimuth = blocks[:, [model.mark, model.mark + 1]].astype(np.int64) @ (1, 256)
    units = blocks[:, model.mark + 2 :].reshape(len(blocks), model.channels, model.unit)
    # Pandar40P has no header; its unit is 4 mm as that of all others.
    unit_m = 0.001 * raw[0, 5 if model.head == 8 else 9] if model.head else 0.004
    reach = unit_m * (units[:, :, 0] + 256.0 * units[:, :, 1])
    echoes = _ECHOES.get(int(raw[0, model.body + model.mode]), 1)
    sound = _echoes_to_keep(reach, azimuth, echoes)
    late = stamps_ns[kept[-1]] - stamp_ns
    at = model.body + model.speed
    rpm = int(raw[-1, at]) + 256 * int(raw[-1, at + 1])
    offset = late - _before_last(azimuth) * (1e9 / (6.0 * (rpm or _RPM) * 100.0))
    row, channel = np.nonzero(sound)
    scan = clean_scan(
        stamp_ns,
        _points(model, azimuth[row], channel, reach[row, channel]),
        reflectance=units[row, channel, 2],
        ring=np.argsort(np.argsort(model.elevation))[channel],
        offset_ns=np.clip(offset, -2e9, 2e9)[row],
    )
    return scan, model


class HesaiDecoder:
    """Decodes the packets of one sensor, one sweep at a time, see `pipeline.io.readers.message_formats`."""

    def is_data(self, packet: bytes) -> bool:
        """Return whether the bytes are a data packet of a known model."""
        return model_of(packet) is not None

    def refuse(self, packet: bytes) -> None:
        """Raise a SourceError that names the model, see `refuse`."""
        refuse(packet)

    def decode(
        self, stamp_ns: int, stamps_ns: Sequence[int], packets: Sequence[bytes]
    ) -> tuple[Scan, Sensor]:
        """Return the scan and the sensor, see `decode_hesai`."""
        scan, model = decode_hesai(stamp_ns, stamps_ns, packets)
        return scan, model.sensor


def _echoes_to_keep(reach: Float, azimuth: Int, echoes: int) -> Bool:
    """Return which returns are points, shape (B, C): those with a range; of echoes of one surface the last.

    Args:
        reach: Ranges, 0 without a return, shape (B, C) for B blocks and C channels [m].
        azimuth: Azimuth of each block.
        echoes: Blocks of one shot.
    """
    sound = reach > 0.0
    for apart in range(1, echoes):
        same = (azimuth[:-apart] == azimuth[apart:]) if apart < len(azimuth) else np.zeros(0, np.bool_)
        near = sound[apart:] & (np.abs(reach[:-apart] - reach[apart:]) < ONE_SURFACE)
        sound[:-apart] &= ~(near & same[:, None])
    return sound


def _before_last(azimuth: Int) -> Float:
    """Return how far the sensor turned from each block to the last one [0.01 degrees]; small steps back are
    none."""
    step = np.diff(azimuth) % _TURN
    step[step > _TURN // 2] = 0
    turned = np.concatenate([np.zeros(1, np.int64), np.cumsum(step)])
    left: Float = (turned[-1] - turned).astype(np.float64)
    return left


def _points(model: HesaiModel, azimuth: Int, channel: Int, reach: Float) -> NDArray[np.float64]:
    """Return points, shape (N, 3) [m], of azimuths of blocks [0.01 degrees], channels and ranges [m]."""
    elevation = np.radians(np.array(model.elevation))[channel]
    bearing = np.radians(0.01 * azimuth + np.array(model.azimuth)[channel])
    level = reach * np.cos(elevation)
    points: NDArray[np.float64] = np.stack(
        [level * np.sin(bearing), level * np.cos(bearing), reach * np.sin(elevation)], axis=1
    )
    return points
