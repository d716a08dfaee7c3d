"""A Velodyne sensor's UDP packets, from one sender alone."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Sequence

from app.robot.address import VelodyneAddress
from app.robot.inbox import ArrivalTimes, Inbox
from app.robot.ros_graph import Publisher
from app.robot.sweeps import Sweeps
from pipeline.io.readers.base import count_loss
from pipeline.io.readers.container import Channel, Message
from pipeline.io.readers.ros_messages import VELODYNE_SCAN
from pipeline.io.readers.velodyne import PACKET_BYTES, PRODUCT, is_data_packet

TOPIC = "/velodyne_packets"
#: The kernel keeps a second of the fastest sensor's packets while Python is busy.
_RECEIVE_BUFFER = 8 << 20
_WAIT_S = 0.05
#: A sender that is silent for so long is lost.
_LOST_S = 3.0
_RETRY_S = 1.0

OTHERS = "packets of other senders"
NO_DATA = "packets that are no data packets of a known sensor"
OTHER_SENSOR = "packets of other sensors"


class VelodyneLink:
    """Listens in a thread of its own. What the rest sees is a robot with one topic of packets.

    Args:
        address: Where to listen, and to whom.
        inbox: For the sweeps.

    Attributes:
        problem, losses, scans, version: As of `ZenohLink`.
    """

    session = None

    def __init__(self, address: VelodyneAddress, inbox: Inbox) -> None:
        self.problem = "not listening yet"
        self.losses: dict[str, int] = {}
        self.scans = self.version = 0
        self._address, self._inbox = address, inbox
        self._times = ArrivalTimes()
        self._sweeps = Sweeps()
        self._product: int | None = None
        self._heard_s: float | None = None
        self._there = False
        self._number: int | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="velodyne", daemon=True)
        self._thread.start()

    @property
    def place(self) -> str:
        """Where it listens, in words."""
        sender = self._address.sender or "this machine"
        return f"listening on {self._address.host}:{self._address.port} to {sender}"

    @property
    def nothing(self) -> str:
        """Why there is nothing, in words."""
        refused = self.losses.get(OTHERS, 0)
        others = f"; {refused} packets of other senders were refused" if refused else ""
        return f"no data packet of a known sensor came{others}"

    @property
    def silence_s(self) -> float | None:
        """Seconds since the last packet came, None before the first."""
        return None if self._heard_s is None else time.monotonic() - self._heard_s

    def publishers(self) -> list[Publisher]:
        """The sensor, while it sends."""
        return [Publisher("", TOPIC, VELODYNE_SCAN)] if self._there else []

    def robots(self) -> list[str]:
        """The sensor has no name."""
        return [""] if self._there else []

    def subscribe(self, channels: Sequence[Channel]) -> None:
        """From now on sweeps go into the inbox."""
        self._number = channels[0].number

    def close(self) -> None:
        """Stop listening."""
        self._closing.set()
        self._thread.join(timeout=2.0)

    def _listen(self) -> None:
        while not self._closing.is_set():
            try:
                with self._bound() as listening:
                    self.problem = ""
                    self._receive(listening)
            except OSError as error:
                where = f"{self._address.host}:{self._address.port}"
                self.problem = f"cannot listen on {where}: {error.strerror or error}"
                self._closing.wait(_RETRY_S)

    def _bound(self) -> socket.socket:
        listening = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
            listening.bind((self._address.host, self._address.port))
            listening.settimeout(_WAIT_S)
        except OSError:
            listening.close()
            raise
        return listening

    def _receive(self, listening: socket.socket) -> None:
        while not self._closing.is_set():
            try:
                packet, (sender, _port) = listening.recvfrom(PACKET_BYTES + 1)
            except TimeoutError:
                self._pause()
                continue
            self._take(packet, sender)

    def _pause(self) -> None:
        """No packet for a while: the sweep is over, and after long the sensor is gone."""
        if self._sweeps.is_stale(self._times.now_ns()):
            self._hand_over(self._sweeps.end())
        silence_s = self.silence_s
        if self._there and silence_s is not None and silence_s > _LOST_S:
            self._there = False
            self.version += 1

    def _take(self, packet: bytes, sender: str) -> None:
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
        self._heard_s = time.monotonic()
        if not self._there:
            self._there = True
            self.version += 1
        self._hand_over(self._sweeps.add(self._times.now_ns(), packet))

    def _hand_over(self, sweep: bytes | None) -> None:
        if sweep is None or self._number is None:
            return
        self.scans += 1
        self._inbox.put(Message(self._number, self._times.next_ns(), sweep), is_scan=True)
