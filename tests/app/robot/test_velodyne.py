"""A Velodyne sensor heard live: its packets become the sweeps that a capture of them has."""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager

from hypothesis import given
from hypothesis import strategies as st

from app.robot.link import SKIPPED
from app.robot.velodyne import NO_DATA, OTHERS, Sweeps
from pipeline.io.readers.topics import VELODYNE_SCAN, standard_types
from pipeline.io.readers.velodyne import PACKET_BYTES, is_data_packet
from pipeline.types.records import Record, Scan
from tests.app.robot.conftest import free_port, listening, until

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 1_327_000


def packet(azimuth: int, product: int = 0x22) -> bytes:
    """A VLP-16's packet that begins at an azimuth [0.01 degrees], all returns 10 m away."""
    blocks = b""
    for k in range(12):
        blocks += struct.pack("<HH", 0xEEFF, (azimuth + 40 * k) % 36000)
        blocks += struct.pack("<HB", 5000, 100) * 32
    made = blocks + struct.pack("<IBB", 0, 0x37, product)
    assert is_data_packet(made)
    return made


def turn(packets: int = 75) -> list[bytes]:
    """One turn in steps of 4.8 degrees."""
    return [packet((480 * k) % 36000) for k in range(packets)]


def counts_of(message: bytes) -> int:
    store = standard_types("cdr")
    decoded = store.deserialize_cdr(message, VELODYNE_SCAN)
    return len(decoded.packets)  # type: ignore[attr-defined]


def test_a_turn_is_a_sweep():
    sweeps = Sweeps()
    found = [sweeps.add(START_NS + k * PERIOD_NS, each) for k, each in enumerate(turn() * 3)]
    ended = [(k, message) for k, message in enumerate(found) if message is not None]
    assert [k for k, _ in ended] == [75, 150]
    assert [counts_of(message) for _, message in ended] == [75, 75]
    rest = sweeps.end()
    assert rest is not None
    assert counts_of(rest) == 75
    assert sweeps.end() is None


@given(st.lists(st.integers(0, 35999), max_size=80))
def test_no_packet_is_lost_whatever_the_sensor_does(azimuths: list[int]):
    sweeps = Sweeps()
    made = [sweeps.add(START_NS + k * PERIOD_NS, packet(each)) for k, each in enumerate(azimuths)]
    ended = [message for message in (*made, sweeps.end()) if message is not None]
    assert sum(map(counts_of, ended)) == len(azimuths)


def test_a_silence_ends_a_sweep():
    sweeps = Sweeps()
    assert sweeps.add(START_NS, packet(0)) is None
    assert not sweeps.is_stale(START_NS + 1)
    ended = sweeps.add(START_NS + 10**9, packet(480))
    assert ended is not None
    assert counts_of(ended) == 1


@contextmanager
def sensor(port: int, packets: list[bytes], own: str = "127.0.0.1") -> Iterator[None]:
    """Sends packets over and over at the rate of a VLP-16."""
    stop = threading.Event()

    def send() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            out.bind((own, 0))
            while not stop.is_set():
                for each in packets:
                    out.sendto(each, ("127.0.0.1", port))
                    time.sleep(PERIOD_NS * 1e-9)

    sending = threading.Thread(target=send)
    sending.start()
    try:
        yield
    finally:
        stop.set()
        sending.join()


def test_a_sensor_is_heard_over_the_network_and_lost():
    packets = turn() * 4
    port = free_port()
    with closing(listening(f"velodyne:127.0.0.1:{port}")) as source:
        until(lambda: not source.listen() and "no data packet" in source.waiting_for())
        scans: list[Record] = []
        with sensor(port, [*packets, b"x" * PACKET_BYTES, b"short"]):
            until(source.listen)
            known = source.description
            assert (known.kind, known.sensor.name, known.has_odometry) == ("Velodyne sensor", "VLP-16", False)

            def enough() -> bool:
                scans.extend(source.take())
                return len(scans) >= 15

            until(enough)
            until(lambda: source.waiting_for() == "")
        assert all(isinstance(record, Scan) for record in scans)
        # A machine that is slow at its first packets drops sweeps, which are counted; nothing else is lost.
        assert source.losses.keys() - {SKIPPED} == {NO_DATA}
        until(lambda: not source.take() and "the sensor sends no scans any more" in source.notices())


def test_packets_of_another_sender_are_refused_and_counted():
    port = free_port()
    with closing(listening(f"velodyne:127.0.0.1:{port}?from=127.0.0.9")) as source:
        until(lambda: "no data packet" in source.waiting_for())
        with sensor(port, turn()):
            until(lambda: not source.listen() and source.losses.get(OTHERS, 0) > 20)
            until(lambda: "packets of other senders were refused" in source.waiting_for())
        assert source._link.scans == 0


def test_a_port_in_use_is_said():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        with closing(listening(f"velodyne:127.0.0.1:{port}")) as source:
            until(lambda: f"cannot listen on 127.0.0.1:{port}" in source.waiting_for())
