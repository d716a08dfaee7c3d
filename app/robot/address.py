"""The address of a live source: `zenoh:tcp/host:7447?robot=NAME&domain=0&scan=/topic`,
`zenoh:tls/host:7447?ca=ca.pem&cert=me.pem&key=me-key.pem`, `dds:?domain=0&interface=192.168.1.10`, or
`velodyne:0.0.0.0:2368?from=192.168.1.201`."""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import parse_qsl

from pipeline.errors import SourceError

#: As `?robot=`: not one robot, but all of them, a dashboard each.
ALL_ROBOTS = "*"
#: As `?robot=`: the robot without a namespace, which is ROS's root namespace.
ROOT = "/"
SCHEME, VELODYNE, DDS = "zenoh:", "velodyne:", "dds:"
_ENDPOINT = re.compile(r"(tcp|tls|quic)/(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+):([0-9]{1,5})")
_FILES = ("ca", "cert", "key")
_TOPICS = ("scan", "odometry", "imu", "gnss", "pose", "camera")
_OPTIONS = ("robot", "domain", "mapped", *_TOPICS, *_FILES)
_DDS_OPTIONS = ("domain", "interface", "peer", "robot", *_TOPICS)
#: An IPv4 address or name of a network interface, and hosts: nothing that could say more in a configuration.
_INTERFACE = re.compile(r"[A-Za-z][A-Za-z0-9._-]{0,14}|[0-9]{1,3}(\.[0-9]{1,3}){3}")
_HOST = re.compile(r"[A-Za-z0-9][A-Za-z0-9.-]{0,252}")
_DDS_REMEDY = "An address looks like dds:?domain=0&interface=192.168.1.10, with &peer=HOST where needed."
_VELODYNE_REMEDY = (
    "Name where to listen and the sensor's own address: velodyne:0.0.0.0:2368?from=192.168.1.201"
)
_REMEDY = "An address looks like zenoh:tcp/192.168.1.5:7447, with ?robot=NAME or &domain=0 where needed."


@dataclass(frozen=True, slots=True)
class ZenohAddress:
    """Where a robot is to be heard.

    Attributes:
        uri: As the user wrote it.
        endpoint: The one that is connected, e.g. "tcp/192.168.1.5:7447".
        domain: ROS_DOMAIN_ID.
        robot: Its namespace, ROOT for none, "" for the first one that sends scans.
        topics: Topic by role where the user names it.
        mapped_there: Whether the robots map by themselves, and their results alone are heard.
        files: Of a connection with certificates: "ca" of the router's authority, "cert" and "key" our own.
    """

    uri: str
    endpoint: str
    domain: int = 0
    robot: str = ""
    topics: dict[str, str] = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)
    mapped_there: bool = False


@dataclass(frozen=True, slots=True)
class DdsAddress:
    """Where a robot without a router is to be heard.

    Attributes:
        uri: As the user wrote it.
        domain: ROS_DOMAIN_ID.
        interface: Own network interface, by name or address; "" stays on this machine.
        peers: Hosts that are asked though the network passes no multicast on.
        robot: Topics below `/robot/` are read, "" for all.
        topics: Topic by role where the user names it.
    """

    uri: str
    domain: int = 0
    interface: str = ""
    peers: tuple[str, ...] = ()
    robot: str = ""
    topics: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class VelodyneAddress:
    """Where a sensor's packets come in.

    Attributes:
        uri: As the user wrote it.
        host, port: To listen on.
        sender: The sensor's address; "" takes this machine's own packets alone.
    """

    uri: str
    host: str
    port: int
    sender: str
    robot: str = ""
    domain: int = 0
    topics: dict[str, str] = field(default_factory=dict)


def is_live(uri: str) -> bool:
    """Whether a source is a live one."""
    return uri.lower().startswith((SCHEME, VELODYNE, DDS))


def parse_address(uri: str) -> ZenohAddress | VelodyneAddress | DdsAddress:
    """Read an address.

    Raises:
        SourceError: It is none, or has an option that does not exist.
    """
    if uri.lower().startswith(DDS):
        return _dds(uri)
    return _velodyne(uri) if uri.lower().startswith(VELODYNE) else _zenoh(uri)


def _dds(uri: str) -> DdsAddress:
    place, _, query = uri[len(DDS) :].partition("?")
    if place:
        raise SourceError("plain DDS has no address, only options after ?", where=uri, remedy=_DDS_REMEDY)
    options = _known(uri, query, _DDS_OPTIONS)
    interface = options.get("interface", "")
    peers = tuple(peer for peer in options.get("peer", "").split(",") if peer)
    if (interface and not _INTERFACE.fullmatch(interface)) or not all(map(_HOST.fullmatch, peers)):
        raise SourceError("this is no interface or peer", where=uri, remedy=_DDS_REMEDY)
    if find_spec("cyclonedds") is None:
        remedy = "Install it with: uv sync --extra dds"
        raise SourceError("plain DDS needs cyclonedds", where=uri, remedy=remedy)
    robot = options.get("robot", "").strip("/")
    return DdsAddress(uri, _domain(uri, options), interface, peers, robot, _topics(options))


def _velodyne(uri: str) -> VelodyneAddress:
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
            "this is no address of a Velodyne sensor", where=uri, remedy=_VELODYNE_REMEDY
        ) from None
    if not sender and not own.is_loopback:
        raise SourceError("anybody could send there", where=uri, remedy=_VELODYNE_REMEDY)
    return VelodyneAddress(uri, host, int(port), sender)


def _zenoh(uri: str) -> ZenohAddress:
    endpoint, _, query = uri[len(SCHEME) :].partition("?")
    found = _ENDPOINT.fullmatch(endpoint)
    if found is None or not 0 < int(found.group(3)) < 1 << 16:
        raise SourceError("this is no address of a Zenoh router", where=uri, remedy=_REMEDY)
    options = _known(uri, query, _OPTIONS)
    domain, topics = _domain(uri, options), _topics(options)
    mapped = options.get("mapped", "here")
    if mapped not in ("here", "robot"):
        remedy = "mapped=robot shows what robots publish of their own maps; mapped=here is usual."
        raise SourceError(f"{mapped!r} is no place where maps are made", where=uri, remedy=remedy)
    files = _files(uri, endpoint, {name: options[name] for name in _FILES if options.get(name)})
    asked = options.get("robot", "")
    robot = asked.strip("/") or (ROOT if asked else "")
    return ZenohAddress(uri, endpoint, domain, robot, topics, files, mapped == "robot")


def _known(uri: str, query: str, names: tuple[str, ...]) -> dict[str, str]:
    """The options of an address, all of them known ones."""
    options = dict(parse_qsl(query, keep_blank_values=True))
    unknown = sorted(options.keys() - set(names))
    if unknown:
        remedy = f"Options are {', '.join(names)}."
        raise SourceError(f"there is no option {unknown[0]!r}", where=uri, remedy=remedy)
    return options


def _domain(uri: str, options: dict[str, str]) -> int:
    domain = options.get("domain", "0")
    if not (domain.isascii() and domain.isdigit() and int(domain) <= 232):
        raise SourceError(f"{domain!r} is no ROS domain", where=uri, remedy="Give a number from 0 to 232.")
    return int(domain)


def _topics(options: dict[str, str]) -> dict[str, str]:
    """Topic by role where the user names it."""
    return {role: options[role] for role in _TOPICS if options.get(role)}


def _files(uri: str, endpoint: str, named: dict[str, str]) -> dict[str, str]:
    """The files of certificates by what they are, with their whole paths."""
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
