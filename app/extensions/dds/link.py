"""ROS 2 over plain DDS, by CycloneDDS (an extra): topics by discovery, messages as CDR bytes."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from rosbags.interfaces import Nodetype

from app.extensions.dds.address import DdsAddress
from app.robot.link import LOST_SCANS, MESSAGE_LIMIT, Inbox, Link, first_line
from app.robot.topics import NAME, PICTURE_TYPES, SCAN_TYPES, TYPE, Publisher
from pipeline.io.readers.base import count_loss
from pipeline.io.readers.container import Channel
from pipeline.io.readers.topics import standard_types

_STRING = "string"


@cache
def idl_type(msgtype: str) -> Any:  # noqa: ANN401 - cyclonedds is an extra, and imported where it is used
    """Return the IDL structure of a message, under the name that ROS 2 gives it on the network.

    Args:
        msgtype: In the ROS 2 spelling, e.g. "sensor_msgs/msg/PointCloud2".

    Returns:
        A class of cyclonedds, named e.g. "sensor_msgs.msg.dds_.PointCloud2_".

    Raises:
        KeyError: rosbags does not know the type.
    """
    from cyclonedds.idl import make_idl_struct

    package, _, name = msgtype.split("/")
    store = standard_types("cdr")
    # rosbags 0.9 has the older name.
    fields = getattr(store, "fielddefs" if hasattr(store, "fielddefs") else "FIELDDEFS")[msgtype][1]
    members = {field: _kind(kind) for field, kind in fields}
    return make_idl_struct(f"{name}_", f"{package}.msg.dds_.{name}_", members)


def _kind(described: Any) -> Any:  # noqa: ANN401 - as rosbags describes a field
    """Return the type of a field for `make_idl_struct`: a Python type or one of `cyclonedds.idl.types`, that
    of `idl_type` for a message, or an array or sequence of such a type.

    Args:
        described: The field as rosbags describes it: kind of node, and its details.
    """
    from cyclonedds.idl import types

    node, detail = described
    if node == Nodetype.BASE:
        plain = {"bool": bool, _STRING: str, "byte": types.uint8, "octet": types.uint8, "char": types.uint8}
        return plain.get(detail[0]) or getattr(types, detail[0])
    if node == Nodetype.NAME:
        return idl_type(detail)
    inner, length = detail
    if node == Nodetype.ARRAY:
        return types.array[_kind(inner), length]
    return types.sequence[_kind(inner), length] if length else types.sequence[_kind(inner)]


_PREFIX, _LONGEST = "rt/", 256


@dataclass(frozen=True, slots=True)
class Offer(Publisher):
    """What a writer announces about itself.

    Attributes:
        reliable: Whether it repeats lost messages.
        latched: Whether it repeats its last messages for late subscribers.
    """

    reliable: bool
    latched: bool


def offer_of(topic: str, type_name: str, robot: str, *, reliable: bool, latched: bool) -> Offer | None:
    """Return the offer of a writer; None if its topic is not a topic of ROS, its type is not a ROS message,
    or a name is longer than 256 characters.

    Args:
        topic: Name of the topic on the network.
        type_name: Name of the type on the network.
        robot: Name of the robot of the topics below `/robot/`; other topics are of no robot (""). "" for all
            topics as those of one robot.
        reliable, latched: See `Offer`.
    """
    if len(topic) > _LONGEST or len(type_name) > _LONGEST or not topic.startswith(_PREFIX):
        return None
    name, kind = topic[len(_PREFIX) - 1 :], TYPE.fullmatch(type_name)
    if kind is None or not NAME.fullmatch(name):
        return None
    owner = robot if robot and name.startswith(f"/{robot}/") else ""
    return Offer(owner, name, f"{kind[1]}/msg/{kind[2]}", reliable, latched)


def common_offer(alive: Iterable[Publisher], topic: str, msgtype: str) -> Offer | None:
    """Return the offer that all writers of a topic satisfy: `reliable` if all writers are reliable, `latched`
    if all are reliable and latched; None if there is no writer of this topic and type."""
    there = [o for o in alive if isinstance(o, Offer) and (o.topic, o.msgtype) == (topic, msgtype)]
    if not there:
        return None
    reliable = all(offer.reliable for offer in there)
    return replace(there[0], reliable=reliable, latched=reliable and all(offer.latched for offer in there))


_WAIT_NS = 50_000_000
#: Samples that wait in CycloneDDS while Python is busy: two seconds of scans, few of the large pictures (the
#: rate limit drops most of them), and far more of other messages.
_SCAN_DEPTH, _PICTURE_DEPTH, _DEPTH = 20, 4, 5000
OVERRUN = "times that more messages came at once than CycloneDDS keeps"
PICTURE_OVERRUN = "times that more pictures came at once than CycloneDDS keeps"
OWN_CONFIGURATION = "CYCLONEDDS_URI"


def configuration(address: DdsAddress) -> str:
    """Return the configuration of CycloneDDS as XML: one interface, by default the loopback of this machine,
    and the peers, by default none or, on the loopback, this machine."""
    named = address.interface or "127.0.0.1"
    by = "address" if named[0].isdigit() else "name"
    peers = address.peers or (() if address.interface else ("127.0.0.1",))
    known = "".join(f'<Peer address="{peer}"/>' for peer in peers)
    return (
        '<CycloneDDS><Domain Id="any">'
        f'<General><Interfaces><NetworkInterface {by}="{named}"/></Interfaces></General>'
        "<Discovery><ParticipantIndex>auto</ParticipantIndex>"
        f"<MaxAutoParticipantIndex>30</MaxAutoParticipantIndex><Peers>{known}</Peers></Discovery>"
        "<Internal>"
        f"<MaxSampleSize>{MESSAGE_LIMIT} B</MaxSampleSize>"
        '<SocketReceiveBufferSize min="default" max="8MB"/>'
        "</Internal></Domain></CycloneDDS>"
    )


class DdsLink(Link):
    """Participant in a DDS domain. It begins to join in a thread at once.

    Args:
        address: Address of the domain.
        inbox: Inbox to which the messages are added.
    """

    def __init__(self, address: DdsAddress, inbox: Inbox) -> None:
        super().__init__(inbox, "dds")
        self._address = address
        self._channels: Sequence[Channel] = ()
        self.thread.start()

    @property
    def place(self) -> str:
        """Description of the domain for the user."""
        return f"in DDS domain {self._address.domain} on {self._address.interface or 'this machine'}"

    @property
    def nothing(self) -> str:
        """Reason why no scan topic is chosen, as text for the user."""
        wanted = f" below /{self._address.robot}" if self._address.robot else ""
        others = sorted({p.topic for p in self.publishers()})[:10]
        there = f" (there are: {', '.join(others)})" if others else ""
        elsewhere = "" if self._address.interface else "; interface=ADDRESS listens on a network"
        return f"no scans{wanted} are announced{there}{elsewhere}"

    def subscribe(self, channels: Sequence[Channel]) -> None:
        """Receive the messages of these channels, in place of those of an earlier call, see
        `Link.subscribe`."""
        self._channels = tuple(channels)

    def failure(self, error: Exception) -> str:
        """Return the reason why the domain cannot be joined."""
        return f"cannot take part in DDS domain {self._address.domain}: {first_line(error)}"

    def receive(self) -> None:
        """Join the domain and receive messages until `close`; the errors of cyclonedds are raised. If the
        environment has OWN_CONFIGURATION and the address no interface, that replaces `configuration`."""
        from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
        from cyclonedds.core import WaitSet
        from cyclonedds.domain import Domain, DomainParticipant

        number = self._address.domain
        own = not self._address.interface and os.environ.get(OWN_CONFIGURATION)
        domain = None if own else Domain(number, configuration(self._address))
        participant = DomainParticipant(number)
        announced = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)
        waiting = WaitSet(participant)
        readers: dict[int, _Reader] = {}
        with self.lock:  # writers of an earlier participant may have ended
            self.alive.clear()
            self.version += 1
        self.problem = ""
        while not self.closing.is_set():
            self._note(announced)
            self._adjust(participant, waiting, readers)
            waiting.wait(_WAIT_NS)
            for reader in readers.values():
                self._take(reader)
        readers.clear()
        del waiting, announced, participant, domain  # in this order; that leaves the network

    def _note(self, announced: Any) -> None:  # noqa: ANN401
        """Process the next announcements and withdrawals of writers, at most 100."""
        from cyclonedds.core import InstanceState

        for found in announced.take(100):
            if found.sample_info.instance_state == InstanceState.Alive:
                self.announce(str(found.key), _offer(found, self._address.robot))
            else:
                self.withdraw(str(found.key))

    def _adjust(self, participant: Any, waiting: Any, readers: dict[int, _Reader]) -> None:  # noqa: ANN401
        """Create and replace readers, so that each channel has one that requests no more than all writers of
        its topic offer. The reader of a topic without writers stays.

        Args:
            participant: Participant of cyclonedds.
            waiting: WaitSet to which new readers are attached.
            readers: Readers by number of the channel, modified.
        """
        for channel in self._channels:
            with self.lock:
                offer = common_offer(self.alive.values(), channel.topic, channel.msgtype)
            known = readers.get(channel.number)
            if offer is None or (known is not None and known.offer == offer):
                continue
            if known is not None:
                waiting.detach(known.ready)
                self._take(known)
            readers[channel.number] = _Reader(participant, channel, offer, self._note_lost)
            waiting.attach(readers[channel.number].ready)

    def _note_lost(self, channel: Channel, number: int) -> None:
        """Count messages that the network lost; only scans are counted."""
        if channel.msgtype in SCAN_TYPES:
            with self.lock:
                count_loss(self.losses, LOST_SCANS, number)

    def _take(self, reader: _Reader) -> None:
        """Put the messages of a reader into the inbox; count an overrun if its queue was full."""
        payloads = reader.take()
        if len(payloads) >= reader.depth:
            with self.lock:
                is_picture = reader.channel.msgtype in PICTURE_TYPES
                count_loss(self.losses, PICTURE_OVERRUN if is_picture else OVERRUN)
        for payload in payloads:
            self.take(reader.channel, payload, len(payload))


def _offer(found: Any, robot: str) -> Offer | None:  # noqa: ANN401
    """Return the offer of a writer that cyclonedds announced; None if it is no topic of ROS. `robot` is as in
    `offer_of`."""
    from cyclonedds.core import Policy

    reliable = isinstance(found.qos[Policy.Reliability], Policy.Reliability.Reliable)
    latched = found.qos[Policy.Durability] in (Policy.Durability.TransientLocal, Policy.Durability.Persistent)
    topic, kind = found.topic_name or "", found.type_name or ""
    return offer_of(topic, kind, robot, reliable=reliable, latched=latched)


class _Sample:
    """Replaces the class of a message, so that its bytes are not decoded."""

    def __init__(self, payload: bytes) -> None:
        self.payload = payload
        self.sample_info: Any = None

    @classmethod
    def deserialize(cls, payload: bytes) -> _Sample:
        return cls(payload)

    @classmethod
    def deserialize_key(cls, payload: bytes) -> _Sample:
        del payload
        return cls(b"")


class _Reader:
    """A DataReader of one channel; it requests earlier messages where the writers keep them (/tf_static).

    Args:
        participant: Participant of cyclonedds.
        channel: The channel.
        offer: Result of `common_offer` for the topic.
        lost: Called with the channel and a number of lost messages, in a thread of cyclonedds.
    """

    def __init__(self, participant: Any, channel: Channel, offer: Offer, lost: Any) -> None:  # noqa: ANN401
        from cyclonedds.core import (
            InstanceState,
            Listener,
            Policy,
            Qos,
            ReadCondition,
            SampleState,
            ViewState,
        )
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic
        from cyclonedds.util import duration

        self.channel, self.offer = channel, offer
        self.depth = _DEPTH
        if channel.msgtype in (*SCAN_TYPES, *PICTURE_TYPES):
            self.depth = _SCAN_DEPTH if channel.msgtype in SCAN_TYPES else _PICTURE_DEPTH
        policies = [
            Policy.Reliability.Reliable(duration(milliseconds=100))
            if offer.reliable
            else Policy.Reliability.BestEffort,
            Policy.Durability.TransientLocal if offer.latched else Policy.Durability.Volatile,
            Policy.History.KeepLast(self.depth),
            Policy.TypeConsistency.AllowTypeCoercion(),
        ]
        topic: Any = Topic(participant, f"rt{channel.topic}", idl_type(channel.msgtype))
        topic.data_type = _Sample

        def on_lost(reader: Any, status: Any) -> None:  # noqa: ANN401
            del reader
            lost(channel, int(status.total_count_change))

        listener = Listener(on_sample_lost=on_lost)
        self._reader: Any = DataReader(participant, topic, Qos(*policies), listener)
        self.ready = ReadCondition(self._reader, SampleState.Any | ViewState.Any | InstanceState.Any)

    def take(self) -> list[bytes]:
        """Return the messages that arrived since the last call, in CDR; [] if there is none. Does not wait.
        At most `depth` messages are kept between two calls: a result of that length means that older ones may
        have been overwritten."""
        found = self._reader.take(self.depth)
        return [sample.payload for sample in found if isinstance(sample, _Sample)]
