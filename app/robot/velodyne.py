"""A Velodyne sensor without ROS: UDP packets of one sender, joined to sweeps."""

from __future__ import annotations

import socket
import time
from collections.abc import Sequence
from typing import Any

from app.robot.link import Inbox, Link
from app.robot.topics import Publisher
from app.sources.live_address import VelodyneAddress
from pipeline.io.readers.base import count_loss
from pipeline.io.readers.container import Channel, Message
from pipeline.io.readers.topics import VELODYNE_SCAN, standard_types
from pipeline.io.readers.velodyne import GAP_NS, PACKET_BYTES, PRODUCT, Rotation, is_data_packet
from pipeline.types.units import SECOND_NS

#: The fastest sensor (VLS-128, dual return) sends fewer packets in the slowest turn.
MOST_PACKETS = 4000
FRAME = "velodyne"


class Sweeps:
    """Joins the packets of one sensor to sweeps of one rotation. A sweep has the time of its last packet."""

    def __init__(self) -> None:
        self._packets: list[tuple[int, bytes]] = []
        self._rotation = Rotation()

    def add(self, stamp_ns: int, packet: bytes) -> bytes | None:
        """Add a data packet; return the sweep that it ends as velodyne_msgs/VelodyneScan in CDR, else None.
        The packet belongs to the next sweep. A sweep of MOST_PACKETS ends too.

        Args:
            stamp_ns: Time of arrival, not before that of the packet before [ns].
            packet: Data packet of 1206 bytes, see `is_data_packet`.
        """
        begins = self._rotation.begins(packet[2] + 256 * packet[3], stamp_ns)
        ended = self.end() if begins or len(self._packets) >= MOST_PACKETS else None
        self._packets.append((stamp_ns, packet))
        return ended

    def is_stale(self, now_ns: int) -> bool:
        """Return whether the time since the last packet is so long that the sweep is complete; `now_ns` is
        the present time [ns]."""
        return bool(self._packets) and now_ns - self._packets[-1][0] > GAP_NS

    def end(self) -> bytes | None:
        """End the sweep and return it as a message; None if there is no packet."""
        packets, self._packets = self._packets, []
        return _message(packets) if packets else None


def _message(packets: list[tuple[int, bytes]]) -> bytes:
    """Return packets (time [ns], bytes) as velodyne_msgs/VelodyneScan in CDR, with the time of the last
    one."""
    import numpy as np

    store: Any = standard_types("cdr")
    packet_type = store.types["velodyne_msgs/msg/VelodynePacket"]
    header = store.types["std_msgs/msg/Header"](stamp=_time(store, packets[-1][0]), frame_id=FRAME)
    scan = store.types[VELODYNE_SCAN](
        header=header,
        packets=[
            packet_type(stamp=_time(store, stamp_ns), data=np.frombuffer(data, np.uint8, PACKET_BYTES))
            for stamp_ns, data in packets
        ],
    )
    return bytes(store.serialize_cdr(scan, VELODYNE_SCAN))


def _time(store: Any, stamp_ns: int) -> Any:  # noqa: ANN401
    """Return a time [ns] as builtin_interfaces/Time."""
    return store.types["builtin_interfaces/msg/Time"](sec=stamp_ns // SECOND_NS, nanosec=stamp_ns % SECOND_NS)


TOPIC = "/velodyne_packets"
#: The kernel buffers a second of the fastest sensor's packets while Python is busy.
_RECEIVE_BUFFER = 8 << 20
_WAIT_S = 0.05
#: After this silence the sensor counts as gone [s].
_LOST_S = 3.0

OTHERS = "packets of other senders"
NO_DATA = "packets that are no data packets of a known sensor"
OTHER_SENSOR = "packets of other sensors"


class VelodyneLink(Link):
    """Receiver of the packets of a sensor, with the interface of a robot with one topic. It begins to listen
    in a thread at once.

    Args:
        address: Address on which it listens, and address of the sender.
        inbox: Inbox to which the sweeps are added.
    """

    def __init__(self, address: VelodyneAddress, inbox: Inbox) -> None:
        super().__init__(inbox, "velodyne")
        self._address = address
        self._sweeps = Sweeps()
        self._product: int | None = None
        self._number: int | None = None
        self.thread.start()

    @property
    def place(self) -> str:
        """Description of the connection for the user."""
        sender = self._address.sender or "this machine"
        return f"listening on {self._address.host}:{self._address.port} to {sender}"

    @property
    def nothing(self) -> str:
        """Reason why there are no scans, as text for the user."""
        refused = self.losses.get(OTHERS, 0)
        others = f"; {refused} packets of other senders were refused" if refused else ""
        return f"no data packet of a known sensor came{others}"

    def subscribe(self, channels: Sequence[Channel]) -> None:
        """Put sweeps into the inbox from now on, under the number of the first channel."""
        self._number = channels[0].number

    def failure(self, error: Exception) -> str:
        """Return the reason why the port cannot be used."""
        reason = (error.strerror if isinstance(error, OSError) else "") or repr(error)
        return f"cannot listen on {self._address.host}:{self._address.port}: {reason}"

    def receive(self) -> None:
        """Receive packets until `close`; raises OSError if the address or port cannot be used."""
        with self._bound() as listening:
            self.problem = ""
            while not self.closing.is_set():
                try:
                    packet, (sender, _port) = listening.recvfrom(PACKET_BYTES + 1)
                except TimeoutError:
                    self._pause()
                else:
                    self._take(packet, sender)

    def _bound(self) -> socket.socket:
        """Return a bound UDP socket, whose reads raise TimeoutError after _WAIT_S; OSError if the address or
        port cannot be used."""
        listening = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
            listening.bind((self._address.host, self._address.port))
            listening.settimeout(_WAIT_S)
        except OSError:
            listening.close()
            raise
        return listening

    def _pause(self) -> None:
        """Complete the sweep if its last packet is older than GAP_NS, and withdraw the topic if no packet
        arrived for _LOST_S."""
        if self._sweeps.is_stale(self.times.now_ns()):
            self._hand_over(self._sweeps.end())
        silence_s = self.silence_s
        if silence_s is not None and silence_s > _LOST_S:
            self.withdraw(TOPIC)

    def _take(self, packet: bytes, sender: str) -> None:
        """Process a packet. Packets of other senders or sensors, and those that are no data packets, are
        dropped and counted in `losses`; the first data packet decides the model of the sensor."""
        wanted = self._address.sender or "127.0.0.1"
        if sender != wanted:
            count_loss(self.losses, OTHERS)
            return
        if not is_data_packet(packet):
            count_loss(self.losses, NO_DATA)
            return
        if self._product is None:
            self._product = packet[PRODUCT]
        if packet[PRODUCT] != self._product:
            count_loss(self.losses, OTHER_SENSOR)
            return
        self.heard_s = time.monotonic()
        self.announce(TOPIC, Publisher("", TOPIC, VELODYNE_SCAN))
        self._hand_over(self._sweeps.add(self.times.now_ns(), packet))

    def _hand_over(self, sweep: bytes | None) -> None:
        """Count a sweep and put it into the inbox; nothing for None, or before `subscribe`."""
        if sweep is None or self._number is None:
            return
        self.scans += 1
        self.inbox.put(Message(self._number, self.times.next_ns(), sweep), is_scan=True)
