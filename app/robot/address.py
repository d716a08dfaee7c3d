"""The address of a live source: `zenoh:tcp/host:7447?robot=NAME&domain=0&scan=/topic`,
`zenoh:tls/host:7447?ca=ca.pem&cert=me.pem&key=me-key.pem`, `dds:?domain=0&interface=192.168.1.10`, or
`velodyne:0.0.0.0:2368?from=192.168.1.201`."""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import ClassVar
from urllib.parse import parse_qsl

from pipeline.errors import SourceError

#: Value of `?robot=` for all robots, each with a dashboard.
ALL_ROBOTS = "*"
#: Value of `?robot=` for the robot without a namespace (ROS's root namespace).
ROOT = "/"
SCHEME, VELODYNE, DDS = "zenoh:", "velodyne:", "dds:"
_ENDPOINT = re.compile(r"(tcp|tls|quic)/(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+):([0-9]{1,5})")
_FILES = ("ca", "cert", "key")
_TOPICS = ("scan", "odometry", "imu", "gnss", "pose", "camera")
_OPTIONS = ("robot", "domain", *_TOPICS, *_FILES)
_DDS_OPTIONS = ("domain", "interface", "peer", "robot", *_TOPICS)
#: Network interfaces (IPv4 address or name) and hosts, without characters that could change a configuration.
_INTERFACE = re.compile(r"[A-Za-z][A-Za-z0-9._-]{0,14}|[0-9]{1,3}(\.[0-9]{1,3}){3}")
_HOST = re.compile(r"[A-Za-z0-9][A-Za-z0-9.-]{0,252}")
_DDS_REMEDY = "An address looks like dds:?domain=0&interface=192.168.1.10, with &peer=HOST where needed."
_VELODYNE_REMEDY = (
    "Name where to listen and the sensor's own address: velodyne:0.0.0.0:2368?from=192.168.1.201"
)
_REMEDY = "An address looks like zenoh:tcp/192.168.1.5:7447, with ?robot=NAME or &domain=0 where needed."


@dataclass(frozen=True, slots=True, kw_only=True)
class Address:
    """Address of a live source.

    Attributes:
        kind: Name of such sources for the user.
        uri: As the user wrote it.
        domain: ROS_DOMAIN_ID.
        robot: Namespace whose topics are read, ROOT for none; "" for all topics, or for the first robot that
            sends scans.
        topics: Dict from each role for which the user named a topic to this topic.
    """

    kind: ClassVar[str]
    uri: str
    domain: int = 0
    robot: str = ""
    topics: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class ZenohAddress(Address):
    """Address of a robot behind a Zenoh router.

    Attributes:
        endpoint: Router that is connected, e.g. "tcp/192.168.1.5:7447".
        files: Certificates: "ca" of the authority of the router, "cert" and "key" of this machine.
    """

    kind: ClassVar[str] = "ROS 2 over Zenoh"
    endpoint: str
    files: dict[str, str] = field(default_factory=dict)


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


@dataclass(frozen=True, slots=True, kw_only=True)
class VelodyneAddress(Address):
    """Address at which the packets of a sensor arrive.

    Attributes:
        host, port: To listen on.
        sender: Address of the sensor; "" accepts only packets of this machine.
    """

    kind: ClassVar[str] = "Velodyne sensor"
    host: str
    port: int
    sender: str


def is_live(uri: str) -> bool:
    """Return whether a URI is the address of a live source: whether it begins with one of the three schemes,
    in any case. It is not checked further."""
    return uri.lower().startswith((SCHEME, VELODYNE, DDS))


def parse_address(uri: str) -> Address:
    """Return the address that a URI describes. Nothing is connected.

    Raises:
        SourceError: The address is invalid or has an unknown option, a certificate file does not exist, or
            plain DDS is not installed.
    """
    if uri.lower().startswith(DDS):
        return _dds(uri)
    return _velodyne(uri) if uri.lower().startswith(VELODYNE) else _zenoh(uri)


def _dds(uri: str) -> DdsAddress:
    """Parse an address of plain DDS; errors as in `parse_address`. The robot "/" becomes "": all topics.
    `peer` is a list of hosts separated by commas."""
    place, _, query = uri[len(DDS) :].partition("?")
    if place:
        raise SourceError("plain DDS has no address, only options after ?", where=uri, remedy=_DDS_REMEDY)
    options = _known(uri, query, _DDS_OPTIONS)
    interface = options.get("interface", "")
    peers = tuple(peer for peer in options.get("peer", "").split(",") if peer)
    if (interface and not _INTERFACE.fullmatch(interface)) or not all(map(_HOST.fullmatch, peers)):
        raise SourceError("the interface or a peer is invalid", where=uri, remedy=_DDS_REMEDY)
    if find_spec("cyclonedds") is None:
        remedy = "Install it with: uv sync --extra dds"
        raise SourceError("plain DDS needs cyclonedds", where=uri, remedy=remedy)
    return DdsAddress(
        uri=uri,
        domain=_domain(uri, options),
        robot=options.get("robot", "").strip("/"),
        topics=_topics(options),
        interface=interface,
        peers=peers,
    )


def _velodyne(uri: str) -> VelodyneAddress:
    """Parse an address of a Velodyne sensor. Without a sender (option `from`), only a loopback address is
    accepted.

    Raises:
        SourceError: Host or sender is not an IPv4 address, the port is not from 1 to 65535, there is another
            option than `from`, or the sender is missing.
    """
    place, _, query = uri[len(VELODYNE) :].partition("?")
    host, _, port = place.rpartition(":")
    options = dict(parse_qsl(query, keep_blank_values=True))
    sender = options.pop("from", "")
    try:
        own = ipaddress.IPv4Address(host)
        if sender:
            ipaddress.IPv4Address(sender)
        if options or not (port.isascii() and port.isdigit() and 0 < int(port) < 1 << 16):
            raise ValueError
    except ValueError:
        raise SourceError(
            "this is not the address of a Velodyne sensor", where=uri, remedy=_VELODYNE_REMEDY
        ) from None
    if not sender and not own.is_loopback:
        raise SourceError(
            "the address of the sensor is missing: other hosts could send packets",
            where=uri,
            remedy=_VELODYNE_REMEDY,
        )
    return VelodyneAddress(uri=uri, host=host, port=int(port), sender=sender)


def _zenoh(uri: str) -> ZenohAddress:
    """Parse an address of a Zenoh router; errors as in `parse_address`. An empty robot is none, "/" is the
    robot without a namespace."""
    endpoint, _, query = uri[len(SCHEME) :].partition("?")
    found = _ENDPOINT.fullmatch(endpoint)
    if found is None or not 0 < int(found.group(3)) < 1 << 16:
        raise SourceError("this is not the address of a Zenoh router", where=uri, remedy=_REMEDY)
    options = _known(uri, query, _OPTIONS)
    files = _files(uri, endpoint, {name: options[name] for name in _FILES if options.get(name)})
    named = options.get("robot", "")
    robot = named.strip("/") or (ROOT if named else "")
    return ZenohAddress(
        uri=uri,
        domain=_domain(uri, options),
        robot=robot,
        topics=_topics(options),
        endpoint=endpoint,
        files=files,
    )


def _known(uri: str, query: str, names: tuple[str, ...]) -> dict[str, str]:
    """Return a dict from the names of the options of an address to their values, also empty ones; of a
    repeated option the last value counts.

    Args:
        uri: The address, for errors.
        query: Text of the options, "NAME=VALUE" separated by "&".
        names: Permitted names.

    Raises:
        SourceError: An option is unknown.
    """
    options = dict(parse_qsl(query, keep_blank_values=True))
    unknown = sorted(options.keys() - set(names))
    if unknown:
        remedy = f"Options are {', '.join(names)}."
        raise SourceError(f"there is no option {unknown[0]!r}", where=uri, remedy=remedy)
    return options


def _domain(uri: str, options: dict[str, str]) -> int:
    """Return the ROS domain of the options, by default 0; SourceError unless it is 0 to 232."""
    domain = options.get("domain", "0")
    if not (domain.isascii() and domain.isdigit() and int(domain) <= 232):
        raise SourceError(f"{domain!r} is not a ROS domain", where=uri, remedy="Give a number from 0 to 232.")
    return int(domain)


def _topics(options: dict[str, str]) -> dict[str, str]:
    """Return a dict from each role for which the user named a topic to this topic."""
    return {role: options[role] for role in _TOPICS if options.get(role)}


def _files(uri: str, endpoint: str, named: dict[str, str]) -> dict[str, str]:
    """Return a dict from the roles of the certificates to their absolute paths.

    Args:
        uri: The address, for errors.
        endpoint: Endpoint of the router.
        named: Dict from the roles "ca", "cert" and "key", as far as they are given, to paths; "~" is the home
            folder. An empty dict is valid for every endpoint.

    Raises:
        SourceError: A file is missing, "cert" or "key" is given without the other, or the endpoint is not
            encrypted.
    """
    if named and endpoint.startswith("tcp/"):
        raise SourceError(
            "certificates need an encrypted connection", where=uri, remedy="Write tls/ in place of tcp/"
        )
    if ("cert" in named) != ("key" in named):
        raise SourceError(
            "a certificate and its key belong together", where=uri, remedy="Give cert= and key="
        )
    paths = {name: Path(place).expanduser().absolute() for name, place in named.items()}
    for path in paths.values():
        if not path.is_file():
            raise SourceError("there is no such file", where=str(path), remedy="Name a file in PEM format")
    return {name: str(path) for name, path in paths.items()}
