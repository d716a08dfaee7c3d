"""Velodyne captures: a real one, and cut or mixed copies of it."""

from __future__ import annotations

import shutil
import sqlite3
import struct
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import velodyne_decoder
from scipy.spatial import cKDTree

from app.extensions.formats.capture import find_packets
from app.extensions.formats.hesai import MODELS, HesaiModel
from app.robot.velodyne import Sweeps
from pipeline.errors import SourceError
from pipeline.io.readers import SourceOptions, open_source
from pipeline.io.readers.container import Channel, Message
from pipeline.io.readers.live import ArrivalReader
from pipeline.io.readers.point_files import open_table, read_columns
from pipeline.io.readers.sensor_families import HESAI_SCANS
from pipeline.io.readers.topics import VELODYNE_SCAN, standard_types
from pipeline.io.readers.velodyne import PACKET_BYTES, SENSORS, is_data_packet
from pipeline.types.records import Record, Scan
from tests.app.extensions.formats.test_hesai import decoded, turn
from tests.app.robot.test_velodyne import packet
from tests.pipeline.io.conftest import Opened
from tests.pipeline.io.test_mounting import mounted
from tests.pipeline.io.velodyne_drive import open_drive, packets_of, write_capture


def frames(capture: bytes) -> list[tuple[int, int, bytes]]:
    """Seconds, microseconds and frame of each packet of a little-endian capture."""
    found, at = [], 24
    while at < len(capture):
        seconds, fraction, length, _ = struct.unpack_from("<IIII", capture, at)
        found.append((seconds, fraction, capture[at + 16 : at + 16 + length]))
        at += 16 + length
    return found


def capture_of(packets: list[tuple[int, int, bytes]], order: str = "<", *, nano: bool = False) -> bytes:
    """A capture in either byte order, with micro- or nanoseconds."""
    head = struct.pack(order + "IHHIIII", 0xA1B23C4D if nano else 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)
    body = [
        struct.pack(order + "IIII", s, f * 1000 if nano else f, len(frame), len(frame)) + frame
        for s, f, frame in packets
    ]
    return head + b"".join(body)


@pytest.fixture(scope="module")
def real(shared_data: Path) -> Path:
    """The real capture."""
    return shared_data / "velodyne" / "vlp16.pcap"


def scans_of(opened: Opened, path: Path) -> list[Scan]:
    """All scans of a source."""
    return [record for record in opened(path).records() if isinstance(record, Scan)]


def test_the_real_capture_gives_four_scans_of_a_vlp_16(real: Path, opened: Opened):
    source = opened(real)
    scans = [record for record in source.records() if isinstance(record, Scan)]
    assert source.description.sensor.name == "VLP-16"
    assert source.description.scans == len(scans) == 4
    assert [source.description.start_ns, source.description.end_ns] == [scans[0].stamp_ns, scans[-1].stamp_ns]
    assert all(14_000 < len(scan.points) < 15_500 for scan in scans)
    assert np.all(np.diff([scan.stamp_ns for scan in scans]) > 99_000_000)
    assert source.losses == {}


def test_the_scans_agree_with_the_reference(real: Path, shared_data: Path, opened: Opened):
    columns = read_columns(open_table(shared_data / "velodyne" / "vlp16_reference.pcd"), {})
    reference = np.stack([columns[axis] for axis in "xyz"], axis=1)
    assert len(reference) == 14_831
    distances = [cKDTree(scan.points).query(reference)[0] for scan in scans_of(opened, real)]
    best = min(distances, key=lambda each: float(np.median(each)))
    assert np.mean(best < 0.02) > 0.97


def test_the_decoder_s_own_reader_finds_as_many_points(real: Path, opened: Opened):
    config = velodyne_decoder.Config(model=velodyne_decoder.Model.VLP16)
    expected = sum(len(points) for _, points in velodyne_decoder.read_pcap(str(real), config))
    assert sum(len(scan.points) for scan in scans_of(opened, real)) == expected


@pytest.mark.parametrize(("order", "nano"), [("<", False), (">", False), ("<", True), (">", True)])
def test_byte_order_and_unit_make_no_difference(
    order: str, nano: bool, real: Path, tmp_path: Path, opened: Opened
):
    path = tmp_path / "other.pcap"
    path.write_bytes(capture_of(frames(real.read_bytes()), order, nano=nano))
    for ours, theirs in zip(scans_of(opened, path), scans_of(opened, real), strict=True):
        assert ours.stamp_ns == theirs.stamp_ns
        np.testing.assert_array_equal(ours.points, theirs.points)


def test_packets_of_other_lengths_senders_and_garbage_are_counted(real: Path, tmp_path: Path, opened: Opened):
    packets = frames(real.read_bytes())
    seconds, fraction, frame = packets[10]
    short = frame[:38] + struct.pack(">H", 8 + 554) + frame[40 : 42 + 554]
    garbage = frame[:42] + bytes(1206)
    stranger = frame[:26] + bytes([10, 0, 0, 1]) + frame[30:]
    extra = (
        [(seconds, fraction, short)] * 2
        + [(seconds, fraction, garbage)] * 3
        + [(seconds, fraction, stranger)]
    )
    path = tmp_path / "mixed.pcap"
    path.write_bytes(capture_of(packets[:11] + extra + packets[11:]))
    source = opened(path)
    assert sum(len(scan.points) for scan in source.records() if isinstance(scan, Scan)) == sum(
        len(scan.points) for scan in scans_of(opened, real)
    )
    assert source.losses == {
        "packets to the LiDAR's port of another length": 2,
        "packets that are no data packets of a known sensor": 3,
        "packets of other senders": 1,
    }


def test_a_cut_capture_gives_what_is_whole(real: Path, tmp_path: Path, opened: Opened):
    path = tmp_path / "cut.pcap"
    path.write_bytes(real.read_bytes()[:400_000])
    source = opened(path)
    assert 2 <= len(list(source.records())) <= 3
    assert list(source.losses) == ["bytes at the end of a capture that was cut"]


def test_a_capture_of_other_traffic_is_refused(real: Path, tmp_path: Path, opened: Opened):
    path = tmp_path / "web.pcap"
    web = [
        (s, f, frame[:36] + struct.pack(">H", 80) + frame[38:600])
        for s, f, frame in frames(real.read_bytes())
    ]
    path.write_bytes(capture_of(web))
    with pytest.raises(SourceError, match="no data packets of a known LiDAR"):
        opened(path)


def udp(payload: bytes, port: int = 2368) -> bytes:
    """An Ethernet frame with a UDP packet."""
    length = 8 + len(payload)
    ip = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + length, 0, 0, 64, 17, 0, bytes(4), bytes(4))
    return bytes(12) + b"\x08\x00" + ip + struct.pack(">HHHH", port, port, length, 0) + payload


@pytest.mark.parametrize("nano", [False, True])
def test_packets_have_the_times_of_the_capture(nano: bool, tmp_path: Path):
    """1,764,000,000 s and parts of a second, exact to the unit of the capture."""
    times = [(1_764_000_000, 7), (1_764_000_000, 999_999), (1_764_000_003, 500_000)]
    packets = [(s, us, udp(packet(100 * k))) for k, (s, us) in enumerate(times)]
    path = tmp_path / "made.pcap"
    path.write_bytes(capture_of(packets, nano=nano))
    found, losses = find_packets(path)
    assert losses == {}
    assert found["stamp_ns"].tolist() == [s * 10**9 + us * 1000 for s, us in times]
    assert found["azimuth"].tolist() == [0, 100, 200]


def test_garbage_of_the_right_length_is_no_data_packet(real: Path):
    packet = frames(real.read_bytes())[0][2][42:]
    assert is_data_packet(packet)
    assert not is_data_packet(packet[:-1])
    assert not is_data_packet(bytes(1206))
    assert not is_data_packet(packet[:2] + b"\xff\xff" + packet[4:])
    assert not is_data_packet(packet[:-1] + b"\x00")


@pytest.mark.parametrize("product", sorted(SENSORS))
def test_every_model_that_names_itself_is_read_as_that_model(
    product: int, real: Path, tmp_path: Path, opened: Opened
):
    """No capture of the others is at hand: the real packets with another model's number in them."""
    named = [(s, f, frame[:-1] + bytes([product])) for s, f, frame in frames(real.read_bytes())]
    path = tmp_path / "other.pcap"
    path.write_bytes(capture_of(named))
    source = opened(path)
    scans = [record for record in source.records() if isinstance(record, Scan)]
    sensor = source.description.sensor
    assert sensor == replace(SENSORS[product], range_sigma=sensor.range_sigma)
    assert scans
    for scan in scans:
        assert np.isfinite(scan.points).all()
        assert scan.ring is not None
        assert 0 <= scan.ring.min() <= scan.ring.max() < SENSORS[product].rings


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)
def test_a_capture_of_hesai_is_read(model: HesaiModel, tmp_path: Path, opened: Opened):
    packets = turn(model)
    step_us = 100_000 // len(packets)
    times = [(1_764_000_000 + k * step_us // 10**6, k * step_us % 10**6) for k in range(3 * len(packets))]
    path = tmp_path / "hesai.pcap"
    path.write_bytes(
        capture_of([(s, us, udp(each)) for (s, us), each in zip(times, packets * 3, strict=True)])
    )
    source = opened(path)
    scans = [record for record in source.records() if isinstance(record, Scan)]
    assert source.description.kind == "Hesai capture (pcap)"
    assert source.description.sensor.name == f"Hesai {model.name}"
    assert source.losses == {}
    assert len(scans) == 3
    expected = decoded(packets)
    for scan in scans:
        np.testing.assert_array_equal(scan.points, expected.points)
        np.testing.assert_array_equal(scan.ring, expected.ring)


def test_a_real_recording_of_hesai_as_a_capture_has_the_same_scans(
    shared_data: Path, tmp_path: Path, opened: Opened
):
    folder = next(path for path in (shared_data / "hesai" / "xt32").iterdir() if path.is_dir())
    database = sqlite3.connect(next(folder.glob("*.db3")))
    store = standard_types("cdr")
    frames_of_packets = []
    for (payload,) in database.execute("select data from messages order by timestamp"):
        for each in store.deserialize_cdr(payload, HESAI_SCANS[0]).packets:  # type: ignore[attr-defined]
            content = each.data[: each.size].tobytes()
            frames_of_packets.append((each.stamp.sec, each.stamp.nanosec // 1000, udp(content)))
    database.close()
    path = tmp_path / "xt32.pcap"
    path.write_bytes(capture_of(frames_of_packets))
    of_capture = scans_of(opened, path)
    of_messages = scans_of(opened, folder)
    assert len(of_capture) == len(of_messages) == 4
    for ours, theirs in zip(of_capture, of_messages, strict=True):
        np.testing.assert_array_equal(ours.points, theirs.points)
        np.testing.assert_array_equal(ours.ring, theirs.ring)


@pytest.mark.parametrize(
    ("payload", "port", "name", "driver"),
    [
        (b"\x00" * 1300, 56301, "Livox", "livox_ros_driver2"),
        (b"\x05\x00" * 700, 57000, "Livox", "livox_ros_driver2"),
        (b"\x55\xaa\x05\x0a" + bytes(1244), 2368, "RoboSense", "rslidar_sdk"),
        (b"\x55\xaa\x05\x5a" + bytes(1244), 6699, "RoboSense", "rslidar_sdk"),
        (b"\xee\xff\x04\x03\x00\x00\x80\x02" + bytes(1110), 2368, "Hesai AT128", "hesai_ros_driver"),
    ],
)
def test_a_capture_of_another_maker_is_refused_by_name(
    payload: bytes, port: int, name: str, driver: str, tmp_path: Path, opened: Opened
):
    path = tmp_path / "other.pcap"
    path.write_bytes(capture_of([(1_764_000_000, k, udp(payload, port)) for k in range(50)]))
    with pytest.raises(SourceError, match=name) as caught:
        opened(path)
    assert driver in str(caught.value.remedy)


def test_packets_of_another_maker_beside_those_of_the_lidar_are_counted(
    real: Path, tmp_path: Path, opened: Opened
):
    packets = frames(real.read_bytes())
    other = [(s, f, udp(bytes(1400), 7502)) for s, f, _ in packets[:20]]
    path = tmp_path / "both.pcap"
    path.write_bytes(capture_of([*other, *packets]))
    source = opened(path)
    assert source.description.sensor.name == "VLP-16"
    assert source.losses == {"packets of Ouster": 20}


def test_contents_decide_before_the_name(shared_data: Path, tmp_path: Path):
    mislabelled = tmp_path / "capture.bag"
    shutil.copyfile(shared_data / "velodyne" / "vlp16.pcap", mislabelled)
    source = open_source(str(mislabelled))
    assert source.description.kind == "Velodyne capture (pcap)"
    source.close()


def test_a_newer_capture_is_told_how_to_convert(tmp_path: Path):
    path = tmp_path / "capture.pcap"
    path.write_bytes(b"\x0a\x0d\x0d\x0a" + bytes(100))
    with pytest.raises(SourceError, match="editcap"):
        open_source(str(path))


def test_a_packet_of_4_gb_is_refused(tmp_path: Path, opened: Opened):
    path = tmp_path / "long.pcap"
    path.write_bytes(struct.pack("<IHHIIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1) + b"\xff" * 64)
    with pytest.raises(SourceError):
        opened(path)


def test_a_tilted_sensor_is_levelled(tmp_path: Path, opened: Opened):
    true = mounted(0, 45)
    run = open_drive("sim:stand?duration=2", 0.02, true)
    write_capture(tmp_path / "drive.pcap", [packets_of(run, k) for k in range(2)])
    described = opened(tmp_path / "drive.pcap").description
    assert np.degrees(np.arccos(described.T_base_lidar.R[2] @ true.R[2])) < 6.0
    assert any("tilted by 4" in warning for warning in described.warnings)
    chosen = SourceOptions(T_base_lidar=mounted(0, 10))
    assert opened(tmp_path / "drive.pcap", chosen).description.T_base_lidar == chosen.T_base_lidar


@pytest.mark.parametrize("name", ["a.pcap", "a.zip"])
def test_foreign_contents_under_a_known_name_are_refused(name: str, tmp_path: Path, opened: Opened):
    (tmp_path / name).write_bytes(b"<html><body>404 not found</body></html>" * 50)
    with pytest.raises(SourceError, match="not those of a"):
        opened(tmp_path / name)


def test_packets_as_they_come_give_the_scans_of_their_capture(shared_data: Path):
    capture = shared_data / "velodyne" / "vlp16.pcap"
    packets, _ = find_packets(capture)
    content = capture.read_bytes()
    sweeps, messages = Sweeps(), []
    for offset, stamp_ns in zip(packets["offset"].tolist(), packets["stamp_ns"].tolist(), strict=True):
        messages.append(sweeps.add(stamp_ns, content[offset : offset + PACKET_BYTES]))
    messages.append(sweeps.end())
    reader = ArrivalReader("here", "live", [Channel(1, "/p", VELODYNE_SCAN, "cdr")], SourceOptions())
    records: list[Record] = []
    for k, message in enumerate(m for m in messages if m is not None):
        records += reader.add(Message(1, int(packets["stamp_ns"][0]) + k, message))
    records += reader.finish()
    ours = [record for record in records if isinstance(record, Scan)]
    with closing(open_source(str(capture))) as source:
        theirs = [record for record in source.records() if isinstance(record, Scan)]
    assert [scan.stamp_ns for scan in ours] == [scan.stamp_ns for scan in theirs]
    for mine, other in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(mine.points, other.points)
        np.testing.assert_array_equal(mine.ring, other.ring)
    assert reader.description is not None
    assert reader.description.sensor.name == "VLP-16"
