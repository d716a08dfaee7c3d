"""Packets of Ouster, made by the library of its makers, as recordings and captures: points, times, losses."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from pipeline.errors import SourceError
from pipeline.io.readers.base import SourceOptions
from pipeline.types.records import Imu, Scan
from tests.pipeline.io.conftest import Opened
from tests.pipeline.io.recordings import START_NS, Author, Write, write_recording

core = pytest.importorskip("ouster.sdk.core")

TURN_NS = 100_000_000
PACKET = "ouster_ros/msg/PacketMsg"
RNG19, LEGACY = "RNG19_RFL8_SIG16_NIR16", "LEGACY"
PROFILES = (LEGACY, RNG19, f"{RNG19}_DUAL", "RNG15_RFL8_NIR8", "FUSA_RNG15_RFL8_NIR8_DUAL")


def sensor(
    profile: str = RNG19, rings: int = 64, columns: int = 512, number: int = 123, port: int = 7502
) -> Any:
    """Metadata of a sensor with evenly spaced rings, from above."""
    mode = {512: core.LidarMode._512x10, 1024: core.LidarMode._1024x10, 2048: core.LidarMode._2048x10}
    data = json.loads(core.SensorInfo.from_default(mode[columns]).to_json_string())
    data["beam_intrinsics"]["beam_altitude_angles"] = np.linspace(22.0, -22.0, rings).tolist()
    data["beam_intrinsics"]["beam_azimuth_angles"] = [(3.0, 1.0, -1.0, -3.0)[k % 4] for k in range(rings)]
    data["lidar_data_format"] |= {
        "pixels_per_column": rings,
        "pixel_shift_by_row": rings * [0],
        "udp_profile_lidar": profile,
    }
    data["config_params"] |= {"udp_port_lidar": port, "udp_port_imu": port + 1}
    data["sensor_info"] = data.get("sensor_info", {}) | {"prod_sn": str(number), "prod_line": "OS-1-64"}
    info = core.SensorInfo(json.dumps(data))
    info.sn, info.init_id = number, 7
    return info


def turn(info: Any, k: int, init: int = 7) -> tuple[Any, list[bytes]]:
    """A turn of the sensor in a round room whose radius is different in each turn, and its packets."""
    made = core.LidarFrame(info)
    columns = np.arange(made.w)
    reach = 8000 + 104 * k + (columns % 97) * 40 + np.arange(made.h)[:, None] * 16
    reach[:, columns % 50 == 0] = 0  # no return
    made.field("RANGE")[:] = reach
    if "RANGE2" in made.fields:
        made.field("RANGE2")[:] = np.where(columns % 3 == 0, reach + 3200, reach + 16 * (reach > 0))
    if "SIGNAL" in made.fields:
        made.field("SIGNAL")[:] = 77
    made.timestamp[:] = START_NS + k * TURN_NS + columns * (TURN_NS // made.w)
    made.measurement_id[:], made.status[:], made.frame_id = columns, 1, 40 + k
    layout = core.PacketFormat(info)
    return made, [p.buf.tobytes() for p in core.frame_to_packets(made, layout, init, info.sn)]


def expected(info: Any, made: Any) -> tuple[Any, Any, Any]:
    """Points, times after the first column and rings from below, by the library, column by column."""
    points, times, rings = [], [], []
    for name in [n for n in ("RANGE", "RANGE2") if n in made.fields]:
        reach = made.field(name)
        keep = reach > 0
        if name == "RANGE2":
            keep &= np.abs(reach.astype(int) - made.field("RANGE").astype(int)) >= 100
        column, ring = np.nonzero(keep.T)
        points.append(core.XYZLut(info)(reach)[ring, column])
        times.append(made.timestamp[column].astype(np.int64) - int(made.timestamp[0]))
        rings.append(made.h - 1 - ring)
    return np.concatenate(points), np.concatenate(times), np.concatenate(rings)


def imu_packet(at_ns: int) -> bytes:
    """A packet of the IMU of the older profile: 1 g upwards, turning by 90 degrees/s."""
    return struct.pack("<QQQffffff", at_ns, at_ns, at_ns, 0.0, 0.0, 1.0, 0.0, 0.0, 90.0)


Packets = list[tuple[int, bytes]]  # time of recording [ns] and packet


def spread(k: int, packets: list[bytes]) -> Packets:
    """Packets of turn k in even distances."""
    return [(START_NS + k * TURN_NS + (n + 1) * TURN_NS // len(packets), p) for n, p in enumerate(packets)]


def fill_with(
    packets: Packets,
    info: Any,
    *,
    kind: str = PACKET,
    metadata_ns: int | None = START_NS,
    imu: Packets = [],  # noqa: B006
    more: bytes = b"",
    name: str = "/ouster",
) -> Any:
    """A function that writes packets, and the metadata at a time (None for none)."""

    def fill(author: Author, write: Write) -> None:
        author.store.register(get_types_from_msg("uint8[] buf", kind))
        rows = [(at, f"{name}/lidar_packets", p + more) for at, p in packets]
        rows += [(at, f"{name}/imu_packets", p + more) for at, p in imu]
        if metadata_ns is not None:
            rows.append((metadata_ns, f"{name}/metadata", info.to_json_string().encode()))
        for at_ns, topic, content in sorted(rows, key=lambda row: row[0]):
            if topic.endswith("metadata"):
                write(topic, "std_msgs/msg/String", at_ns, author.make("String", content.decode()))
            else:
                made = author.store.types[kind](np.frombuffer(content, np.uint8))
                write(topic, kind, at_ns, made)

    return fill


def scans_of(source: Any) -> list[Scan]:
    return [record for record in source.records() if isinstance(record, Scan)]


def drive(info: Any, turns: int = 4) -> tuple[list[Any], Packets]:
    made = [turn(info, k) for k in range(turns)]
    return [frame for frame, _ in made], [row for k, (_, p) in enumerate(made) for row in spread(k, p)]


def assert_same(scan: Scan, info: Any, made: Any) -> None:
    points, times, rings = expected(info, made)
    assert scan.stamp_ns == int(made.timestamp[0])
    assert scan.ring is not None
    assert scan.offset_ns is not None
    np.testing.assert_allclose(scan.points, points, atol=1e-5)
    assert scan.offset_ns.tolist() == times.tolist()
    assert scan.ring.tolist() == rings.tolist()


@pytest.mark.slow_after(2)
@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize(("container", "more"), [("bag", b"\0"), ("mcap", b""), ("db3", b"")])
def test_points_times_and_rings_are_those_of_the_library(
    container: str, more: bytes, profile: str, tmp_path: Path, opened: Opened
):
    info = sensor(profile)
    frames, packets = drive(info)
    source = opened(write_recording(container, tmp_path, fill_with(packets, info, more=more)))
    scans = scans_of(source)
    assert len(scans) == len(frames) == source.description.scans
    for scan, made in zip(scans, frames, strict=True):
        assert_same(scan, info, made)
    assert source.losses == {}
    assert source.description.sensor.rings == 64
    (read,) = (topic for topic in source.description.topics if topic.read_as == "scan")
    assert (read.family, read.times[:12]) == ("Ouster", "field t in n")


@pytest.mark.slow_after(2)
@pytest.mark.parametrize(("rings", "columns"), [(32, 1024), (128, 1024), (64, 2048), (16, 512)])
def test_models_with_other_rings_and_columns(rings: int, columns: int, tmp_path: Path, opened: Opened):
    info = sensor(RNG19, rings, columns)
    frames, packets = drive(info, 2)
    source = opened(write_recording("mcap", tmp_path, fill_with(packets, info)))
    for scan, made in zip(scans_of(source), frames, strict=True):
        assert_same(scan, info, made)


@pytest.mark.parametrize("kind", ["ouster_sensor_msgs/msg/PacketMsg", "ouster_msgs/msg/PacketMsg"])
def test_other_names_of_the_message_and_metadata_at_the_end(kind: str, tmp_path: Path, opened: Opened):
    info = sensor()
    frames, packets = drive(info)
    fill = fill_with(packets, info, kind=kind, metadata_ns=packets[-1][0] + 1)
    assert len(scans_of(opened(write_recording("mcap", tmp_path, fill)))) == len(frames)


def test_readings_of_the_imu_have_si_units(tmp_path: Path, opened: Opened):
    info = sensor()
    _, packets = drive(info)
    imu = [(START_NS + k * 10_000_000 + 1000, imu_packet(START_NS + k * 10_000_000)) for k in range(40)]
    source = opened(write_recording("mcap", tmp_path, fill_with(packets, info, imu=imu)))
    assert source.description.has_imu
    readings = [record for record in source.records() if isinstance(record, Imu)]
    assert len(readings) == 40
    np.testing.assert_allclose(readings[3].linear_acceleration, [0.0, 0.0, 9.80665], atol=1e-5)
    np.testing.assert_allclose(readings[3].angular_velocity, [0.0, 0.0, np.pi / 2], atol=1e-6)
    assert readings[3].orientation is None
    assert readings[3].stamp_ns == START_NS + 30_000_000


def test_lost_packets_leave_a_gap_and_are_counted_except_at_both_ends(tmp_path: Path, opened: Opened):
    info = sensor()
    frames, packets = drive(info)
    each = len(packets) // 4
    kept = packets[9 : each + 3] + packets[each + 5 : -11]
    source = opened(write_recording("mcap", tmp_path, fill_with(kept, info)))
    scans = scans_of(source)
    assert source.losses == {"packets of the LiDAR that were lost: its scans have gaps": 2}
    assert len(scans) == 4
    points, times, _ = expected(info, frames[1])
    column = times // (TURN_NS // 512)
    keep = (column < 3 * 16) | (column >= 5 * 16)
    np.testing.assert_allclose(scans[1].points, points[keep], atol=1e-5)
    # The stamp of the first one is that of its first column.
    assert scans[0].stamp_ns == START_NS + 9 * 16 * (TURN_NS // 512)


def test_a_scan_whose_first_packets_are_lost_has_the_right_times(tmp_path: Path, opened: Opened):
    info = sensor()
    frames, packets = drive(info)
    each = len(packets) // 4
    source = opened(write_recording("mcap", tmp_path, fill_with(packets[:each] + packets[each + 4 :], info)))
    second = scans_of(source)[1]
    points, times, _ = expected(info, frames[1])
    late = times // (TURN_NS // 512) >= 4 * 16
    assert second.offset_ns is not None
    np.testing.assert_allclose(second.points, points[late], atol=1e-5)
    assert (second.stamp_ns + second.offset_ns.astype(np.int64)).tolist() == (
        int(frames[1].timestamp[0]) + times[late]
    ).tolist()


def test_packets_that_arrive_mixed_are_put_in_their_turn(tmp_path: Path, opened: Opened):
    info = sensor()
    frames, packets = drive(info)
    each = len(packets) // 4
    contents = [p for _, p in packets]
    for at in (each - 1, each + 7, 2 * each - 2):
        contents[at], contents[at + 1] = contents[at + 1], contents[at]
    mixed = [(at, p) for (at, _), p in zip(packets, contents, strict=True)]
    source = opened(write_recording("mcap", tmp_path, fill_with(mixed, info)))
    for scan, made in zip(scans_of(source), frames, strict=True):
        assert_same(scan, info, made)
    assert source.losses == {}


def test_packets_of_another_sensor_and_damaged_ones_are_counted(tmp_path: Path, opened: Opened):
    info, other = sensor(), sensor(number=999)
    _, packets = drive(info)
    strange = [(packets[70][0], p) for p in turn(other, 1)[1][:5]] + [(packets[90][0], packets[90][1][:600])]
    fill = fill_with(sorted([*packets, *strange], key=lambda row: row[0]), info)
    source = opened(write_recording("mcap", tmp_path, fill))
    assert len(scans_of(source)) == 4
    assert source.losses == {"packets of another sensor, or damaged": 6}


def test_a_sensor_that_was_set_up_again_and_one_that_restarts_are_read_on(tmp_path: Path, opened: Opened):
    info = sensor()
    made = [turn(info, 5), turn(info, 6), turn(info, 7, init=9), turn(info, 8, init=9)]
    packets = [row for k, (_, p) in enumerate(made) for row in spread(k + 5, p)]
    layout = core.PacketFormat(info)
    for k in (9, 10):  # numbers of turns begin again
        frame, _ = turn(info, k)
        frame.frame_id = k - 9
        again = [p.buf.tobytes() for p in core.frame_to_packets(frame, layout, 9, info.sn)]
        packets += spread(k, again)
    source = opened(write_recording("mcap", tmp_path, fill_with(packets, info)))
    assert len(scans_of(source)) == 6
    assert source.losses == {}


def test_metadata_may_stand_beside_the_recording(tmp_path: Path, opened: Opened):
    info = sensor()
    frames, packets = drive(info)
    path = write_recording("mcap", tmp_path, fill_with(packets, info, metadata_ns=None))
    with pytest.raises(SourceError, match="the metadata of the sensor are missing") as caught:
        opened(path)
    assert "ouster-cli" in str(caught.value.remedy)
    assert "metadata" in str(caught.value.remedy)
    (tmp_path / "other.json").write_text("{}")
    (tmp_path / f"{path.stem}.json").write_text(info.to_json_string())
    assert len(scans_of(opened(path))) == len(frames)


def test_metadata_of_another_setting_are_refused_with_the_sizes(tmp_path: Path, opened: Opened):
    info = sensor()
    _, packets = drive(info)
    fill = fill_with(packets, sensor(rings=128))
    with pytest.raises(SourceError, match="another setting than the packets"):
        opened(write_recording("mcap", tmp_path, fill))


def test_damaged_metadata_are_refused_with_the_reason(tmp_path: Path, opened: Opened):
    info = sensor()
    _, packets = drive(info)
    path = write_recording("mcap", tmp_path, fill_with(packets, info, metadata_ns=None))
    (tmp_path / f"{path.stem}.json").write_text(info.to_json_string()[:1900])
    with pytest.raises(SourceError, match="metadata of the Ouster cannot be read"):
        opened(path)


def test_decoded_clouds_are_preferred_and_packets_are_read_when_named(tmp_path: Path, opened: Opened):
    info = sensor()
    frames, packets = drive(info)
    kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4"), ("ring", "<u2")]
    table = np.ones(500, np.dtype([(n, np.dtype(k)) for n, k in kinds]))
    table["t"] = np.linspace(0, TURN_NS, 500)

    def fill(author: Author, write: Write) -> None:
        fill_with(packets, info)(author, write)
        for k in range(4):
            at_ns = START_NS + k * TURN_NS
            write("/ouster/points", "sensor_msgs/msg/PointCloud2", at_ns, author.cloud(at_ns, table))

    path = write_recording("mcap", tmp_path, fill)
    assert {len(scan.points) for scan in scans_of(opened(path))} == {500}
    named = opened(path, SourceOptions(topics={"scan": "/ouster/lidar_packets"}))
    assert_same(scans_of(named)[0], info, frames[0])


def test_without_the_library_a_recording_is_refused_with_its_extra(
    tmp_path: Path, opened: Opened, monkeypatch: pytest.MonkeyPatch
):
    info = sensor()
    _, packets = drive(info)
    path = write_recording("mcap", tmp_path, fill_with(packets, info))
    monkeypatch.setitem(__import__("sys").modules, "ouster.sdk", None)
    with pytest.raises(SourceError, match="ouster-sdk") as caught:
        opened(path)
    assert "pip install 'stemmap[ouster]'" in str(caught.value.remedy)


# --- captures --------------------------------------------------------------------------------------


def capture(path: Path, packets: Packets, imu: Packets = [], port: int = 7502, size: int = 1480) -> Path:  # noqa: B006
    """A pcap of UDP packets, in fragments of IPv4 as older firmware sends them."""
    rows = sorted([(at, port, p) for at, p in packets] + [(at, port + 1, p) for at, p in imu])
    out = [struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 1 << 18, 1)]
    for number, (at_ns, to, content) in enumerate(rows):
        whole = struct.pack(">HHHH", 7502, to, len(content) + 8, 0) + content
        for at in range(0, len(whole), size):
            part = whole[at : at + size]
            flags = at // 8 | (0x2000 if at + size < len(whole) else 0)
            head = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(part), number & 0xFFFF, flags, 64, 17, 0)
            packet = 12 * b"\1" + b"\x08\0" + head + bytes([10, 0, 0, 1, 10, 0, 0, 2]) + part
            out.append(struct.pack("<IIII", at_ns // 10**9, at_ns % 10**9 // 1000, len(packet), len(packet)))
            out.append(packet)
    path.write_bytes(b"".join(out))
    return path


@pytest.mark.slow_after(2)
@pytest.mark.parametrize("profile", [LEGACY, RNG19])
@pytest.mark.parametrize("size", [1480, 65_000])
@pytest.mark.parametrize("port", [7502, 9000])
def test_a_capture_has_the_scans_of_the_recording(
    port: int, size: int, profile: str, tmp_path: Path, opened: Opened
):
    info = sensor(profile, port=port)
    frames, packets = drive(info)
    imu = [(START_NS + k * 10_000_000 + 1000, imu_packet(START_NS + k * 10_000_000)) for k in range(40)]
    path = capture(tmp_path / "drive.pcap", packets, imu, port, size)
    (tmp_path / "OS-1-64_123.json").write_text(info.to_json_string())
    source = opened(path)
    scans = scans_of(source)
    for scan, made in zip(scans, frames, strict=True):
        assert_same(scan, info, made)
    assert source.description.kind == "capture (pcap) with packets of Ouster"
    assert source.description.has_imu
    assert source.losses == {}


def test_a_capture_without_metadata_is_refused_with_where_to_get_them(tmp_path: Path, opened: Opened):
    path = capture(tmp_path / "drive.pcap", drive(sensor())[1])
    with pytest.raises(SourceError, match="the metadata of the sensor are missing") as caught:
        opened(path)
    assert "ouster-cli" in str(caught.value.remedy)


def test_a_cut_capture_is_read_to_its_end(tmp_path: Path, opened: Opened):
    info = sensor()
    path = capture(tmp_path / "drive.pcap", drive(info)[1])
    path.write_bytes(path.read_bytes()[: int(0.6 * path.stat().st_size)])
    (tmp_path / "drive.json").write_text(info.to_json_string())
    assert len(scans_of(opened(path))) == 3
