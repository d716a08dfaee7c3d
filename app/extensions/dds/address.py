"""Addresses of robots on plain DDS: `dds:?domain=0&interface=192.168.1.10`."""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib.util import find_spec
from typing import ClassVar

from app.robot.link import Inbox, Link
from app.sources.live_address import TOPICS, Address, domain_of, known_options, topics_of
from pipeline.errors import SourceError

_OPTIONS = ("domain", "interface", "peer", "robot", *TOPICS)
_REMEDY = "An address looks like dds:?domain=0&interface=192.168.1.10, with &peer=HOST where needed."
#: Network interfaces (IPv4 address or name) and hosts, without characters that could change a configuration.
_INTERFACE = re.compile(r"[A-Za-z][A-Za-z0-9._-]{0,14}|[0-9]{1,3}(\.[0-9]{1,3}){3}")
_HOST = re.compile(r"[A-Za-z0-9][A-Za-z0-9.-]{0,252}")


@dataclass(frozen=True, slots=True, kw_only=True)
class DdsAddress(Address):
    """Address of a robot on plain DDS, without a router.

    Attributes:
        interface: Network interface of this machine, by name or address; "" for loopback.
        peers: Hosts that are contacted where the network has no multicast.
    """

    kind: ClassVar[str] = "ROS 2 over DDS"
    interface: str = ""
    peers: tuple[str, ...] = ()


def parse(uri: str) -> DdsAddress:
    """Parse an address of plain DDS; errors as in `parse_address`. The robot "/" becomes "": all topics.
    `peer` is a list of hosts separated by commas."""
    place, _, query = uri.partition(":")[2].partition("?")
    if place:
        raise SourceError("plain DDS has no address, only options after ?", where=uri, remedy=_REMEDY)
    options = known_options(uri, query, _OPTIONS)
    interface = options.get("interface", "")
    peers = tuple(peer for peer in options.get("peer", "").split(",") if peer)
    if (interface and not _INTERFACE.fullmatch(interface)) or not all(map(_HOST.fullmatch, peers)):
        raise SourceError("the interface or a peer is invalid", where=uri, remedy=_REMEDY)
    if find_spec("cyclonedds") is None:
        remedy = "Install it with: uv sync --extra dds"
        raise SourceError("plain DDS needs cyclonedds", where=uri, remedy=remedy)
    return DdsAddress(
        uri=uri,
        domain=domain_of(uri, options),
        robot=options.get("robot", "").strip("/"),
        topics=topics_of(options),
        interface=interface,
        peers=peers,
    )


def connect(address: DdsAddress, inbox: Inbox) -> Link:
    """Return a new connection, which adds its messages to the inbox."""
    from app.extensions.dds.link import DdsLink

    return DdsLink(address, inbox)
