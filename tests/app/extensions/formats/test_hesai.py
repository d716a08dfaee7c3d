"""Hesai packets: two real recordings against clouds of their makers, made packets of all models."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import get_types_from_msg
from scipy.spatial import cKDTree

from app.extension import VARIABLE
from app.extensions.formats.hesai import MODELS, HesaiModel, decode_hesai, model_of
from pipeline.errors import SourceError
from pipeline.io.readers.base import Source
from pipeline.io.readers.point_files import open_table, read_columns
from pipeline.io.readers.sensor_families import HESAI_SCANS
from pipeline.types.records import Scan
from tests.pipeline.io.conftest import Opened
from tests.pipeline.io.recordings import START_NS, Author, Write, write_recording
from tests.pipeline.io.test_mounting import assert_not_levelled

IDS = [model.name for model in MODELS]
by_model = pytest.mark.parametrize("model", MODELS, ids=IDS)


def packet(
    model: HesaiModel,
    azimuths: Sequence[float],
    ranges: Sequence[float],
    mode: int = 0x37,
    sequence: bool = True,
) -> bytes:
    """A packet with one range [m] per block in all channels, azimuths in degrees."""
    head = b""
    if model.head == 8:
        head = bytes([0xEE, 0xFF, model.channels, model.blocks, 0, 4, 0, 0])
    elif model.head == 12:
        version = {"PandarQT": (3, 1)}.get(model.name, (6, 1))
        head = bytes([0xEE, 0xFF, *version, 0, 0, model.channels, model.blocks, 0, 4, 2, 1])
    body = b""
    for azimuth, reach in zip(azimuths, ranges, strict=True):
        channel = struct.pack("<HB", round(reach / 0.004), 77) + bytes(model.unit - 3)
        mark = b"\xff\xee" if model.mark else b""
        body += mark + struct.pack("<H", round(100 * azimuth) % 36000) + model.channels * channel
    tail = bytearray(model.tail)
    tail[model.mode] = mode
    tail[model.speed : model.speed + 2] = struct.pack("<H", 600)
    return head + body + bytes(tail) + (b"\x01\0\0\0" if sequence else b"")


def turn(model: HesaiModel, reach: float = 10.0, echo: float | None = None) -> list[bytes]:
    """Packets of a turn from azimuth 0, in steps of one degree; with the range of a first echo, in pairs."""
    shots = np.arange(360 // model.blocks * model.blocks)
    if echo is None:
        rows = [[(k, reach) for k in block] for block in shots.reshape(-1, model.blocks)]
        return [packet(model, [k for k, _ in row], [r for _, r in row]) for row in rows]
    pairs = [(k, r) for k in shots for r in (echo, reach)][: 2 * len(shots) // model.blocks * model.blocks]
    rows = [pairs[at : at + model.blocks] for at in range(0, len(pairs), model.blocks)]
    return [packet(model, [k for k, _ in row], [r for _, r in row], 0x39) for row in rows]


def decoded(packets: list[bytes]) -> Scan:
    """The scan of packets that arrive one after the other within 100 ms; the stamp is that of the last."""
    stamps = [START_NS - (len(packets) - 1 - k) * 100_000_000 // len(packets) for k in range(len(packets))]
    return decode_hesai(START_NS, stamps, packets)[0]


@by_model
def test_each_channel_has_its_direction(model: HesaiModel):
    packets = turn(model)
    scan = decoded(packets)
    assert scan.ring is not None
    assert len(scan.points) == len(packets) * model.blocks * model.channels
    for channel in (0, model.channels // 2, model.channels - 1):
        ring = sorted(model.elevation).index(model.elevation[channel])
        x, y, z = scan.points[scan.ring == ring][90].astype(np.float64)
        assert np.hypot(np.hypot(x, y), z) == pytest.approx(10.0, abs=1e-4)
        assert np.degrees(np.arcsin(z / 10.0)) == pytest.approx(model.elevation[channel], abs=0.001)
        # Clockwise from y, as compasses count.
        assert np.degrees(np.arctan2(x, y)) == pytest.approx(90.0 + model.azimuth[channel], abs=0.001)
    assert scan.reflectance is not None
    assert scan.reflectance.tolist() == [77.0] * len(scan.points)


@by_model
def test_times_follow_the_turn_to_the_last_packet(model: HesaiModel):
    scan = decoded(turn(model))
    assert scan.offset_ns is not None
    assert scan.offset_ns[-1] == 0
    shots = len(scan.points) // model.channels
    # 600 turns per minute: a degree takes 278 us.
    assert scan.offset_ns[0] == pytest.approx(-(shots - 1) / 3600.0 * 1e9, abs=2)


@by_model
def test_two_echoes_of_one_surface_are_one_point_and_two_surfaces_are_two(model: HesaiModel):
    single = len(decoded(turn(model)).points)
    assert abs(len(decoded(turn(model, 10.0, 10.0)).points) - single) <= 12 * model.channels
    near = decoded(turn(model, 10.0, 10.05))
    assert len(near.points) == len(decoded(turn(model, 10.0, 10.0)).points)
    np.testing.assert_allclose(np.linalg.norm(near.points, axis=1), 10.0, atol=1e-3)
    assert len(decoded(turn(model, 10.0, 12.0)).points) == 2 * len(near.points)


@by_model
def test_packets_with_and_without_a_sequence_number_are_known(model: HesaiModel):
    blocks = list(range(model.blocks))
    for sequence in (True, False):
        made = packet(model, blocks, [5.0] * model.blocks, sequence=sequence)
        assert model_of(made) is model
        assert model_of(made[:-1]) is None
        assert model_of(made + b"\0") is None


@given(st.binary(max_size=1500))
def test_other_bytes_are_no_packets(content: bytes):
    assert model_of(content) is None


@given(data=st.data())
def test_damaged_bytes_give_a_scan_of_finite_points(data: st.DataObject):
    model = data.draw(st.sampled_from(MODELS))
    made = bytearray(packet(model, list(range(model.blocks)), [5.0] * model.blocks))
    for _ in range(data.draw(st.integers(0, 40))):
        made[data.draw(st.integers(13, len(made) - 1))] = data.draw(st.integers(0, 255))
    if model_of(bytes(made)) is model:
        scan = decoded([bytes(made)] * 3)
        assert np.isfinite(scan.points).all()


# --- recordings ------------------------------------------------------------------------------------


def fill_with(kind: str, packets: list[bytes], scans: int = 3) -> Any:
    """A function that writes some sweeps of packets as messages of a type."""

    def fill(author: Author, write: Write) -> None:
        package, time = kind.partition("/")[0], "time" if author.kind == "bag" else "builtin_interfaces/Time"
        text = f"{time} stamp\nuint8[1500] data\nuint32 size"
        author.store.register(get_types_from_msg(text, f"{package}/msg/PandarPacket"))
        scan = get_types_from_msg(f"std_msgs/Header header\n{package}/PandarPacket[] packets", kind)
        author.store.register({kind: scan[kind]})
        make = author.store.types[f"{package}/msg/PandarPacket"]
        for k in range(scans):
            stamp_ns = START_NS + k * 100_000_000
            messages = []
            for n, each in enumerate(packets):
                at_ns = stamp_ns + n * 100_000_000 // len(packets)
                stamp = author.make("Time", at_ns // 10**9, at_ns % 10**9)
                content = np.frombuffer(each.ljust(1500, b"\0"), np.uint8)
                messages.append(make(stamp, content, len(each)))
            message = author.store.types[kind](author.header(stamp_ns, "hesai"), messages)
            write("/pandar_packets", kind, stamp_ns + 100_000_000, message)

    return fill


def scans_of(source: Source) -> list[Scan]:
    return [record for record in source.records() if isinstance(record, Scan)]


@by_model
@pytest.mark.parametrize(("container", "kind"), [("bag", HESAI_SCANS[1]), ("mcap", HESAI_SCANS[0])])
def test_packets_in_a_recording_are_scans_with_rings_from_below(
    container: str, kind: str, model: HesaiModel, tmp_path: Path, opened: Opened
):
    source = opened(write_recording(container, tmp_path, fill_with(kind, turn(model))))
    sensor = source.description.sensor
    assert sensor.name == f"Hesai {model.name}"
    assert sensor.rings == model.channels
    scans = scans_of(source)
    assert [scan.stamp_ns for scan in scans] == [START_NS + k * 100_000_000 for k in range(3)]
    first = scans[0]
    assert first.ring is not None
    assert first.offset_ns is not None
    low, high = (first.points[first.ring == ring, 2].mean() for ring in (0, model.channels - 1))
    assert low < high
    # The stamp is that of the first packet; the last one comes almost a turn later.
    assert first.offset_ns.min() == pytest.approx(0, abs=4_000_000)
    assert first.offset_ns.max() == pytest.approx(100_000_000, rel=0.05)


def test_damaged_packets_are_counted(tmp_path: Path, opened: Opened):
    packets = turn(MODELS[0])
    packets[3] = packets[3][:600]
    source = opened(write_recording("db3", tmp_path, fill_with(HESAI_SCANS[0], packets)))
    assert len(scans_of(source)) == 3
    assert source.losses == {"packets that are no data packets": 3}


@pytest.mark.parametrize(
    ("head", "name"),
    [
        ((4, 3, 0, 0, 128, 2), "AT128"),
        ((1, 4, 0, 0, 128, 2), "Pandar128 or OT128"),
        ((9, 9, 0, 0, 7, 7), "7 ch"),
    ],
)
def test_a_model_without_a_table_is_refused_with_its_driver(
    head: tuple[int, ...], name: str, tmp_path: Path, opened: Opened
):
    made = bytes([0xEE, 0xFF, *head]) + bytes(1100)
    with pytest.raises(SourceError, match=name) as caught:
        opened(write_recording("mcap", tmp_path, fill_with(HESAI_SCANS[0], [made] * 9)))
    assert "hesai_ros_driver" in str(caught.value.remedy)
    assert "/pandar_packets" in str(caught.value.where)


@pytest.mark.parametrize(
    ("msgtype", "maker", "driver"),
    [
        ("rslidar_msgs/msg/RslidarScan", "RoboSense", "rslidar_sdk"),
        ("rslidar_msg/msg/RslidarPacket", "RoboSense", "rslidar_sdk"),
        ("hesai_ros_driver/msg/UdpFrame", "Hesai", "hesai_ros_driver"),
    ],
)
def test_packets_of_another_maker_are_refused_with_their_driver(
    msgtype: str, maker: str, driver: str, tmp_path: Path, opened: Opened
):
    def fill(author: Author, write: Write) -> None:
        author.store.register(get_types_from_msg("uint8[] data", msgtype))
        write("/packets", msgtype, START_NS, author.store.types[msgtype](np.zeros(9, np.uint8)))

    with pytest.raises(SourceError, match=f"/packets has raw packets of {maker},") as caught:
        opened(write_recording("mcap", tmp_path, fill))
    assert driver in str(caught.value.remedy)


@pytest.mark.parametrize("folder", ["xt32", "40p"])
def test_a_real_recording_agrees_with_the_cloud_of_its_makers(folder: str, shared_data: Path, opened: Opened):
    here = shared_data / "hesai" / folder
    columns = read_columns(open_table(next(here.glob("*.pcd"))), {})
    reference = np.stack([columns[axis] for axis in "xyz"], axis=1)
    source = opened(next(path for path in here.iterdir() if path.is_dir()))
    assert source.description.sensor.rings == {"xt32": 32, "40p": 40}[folder]
    found = []
    for scan in scans_of(source):
        away = cKDTree(scan.points).query(reference)[0]
        found.append((float(np.sqrt(np.mean(away**2))), len(scan.points) / len(reference)))
    rms, share = min(found)
    assert rms < 0.005
    assert share == pytest.approx(1.0, abs=0.001)


def test_packets_in_a_recording_need_the_extension(
    tmp_path: Path, opened: Opened, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv(VARIABLE, "")
    with pytest.raises(SourceError, match="The extension formats is switched off"):
        opened(write_recording("mcap", tmp_path, fill_with(HESAI_SCANS[0], turn(MODELS[0]))))


@pytest.mark.parametrize("folder", ["xt32", "40p"])
def test_no_lidar_is_levelled_by_the_things_in_a_room(folder: str, shared_data: Path, opened: Opened):
    here = shared_data / "hesai" / folder
    inside = [path for path in here.iterdir() if path.is_dir()]
    assert_not_levelled(opened(inside[0] if inside else here))
