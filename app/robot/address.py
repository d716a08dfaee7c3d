"""The address of a live source: `zenoh:tcp/host:7447?robot=NAME&domain=0&scan=/topic`, or
`velodyne:0.0.0.0:2368?from=192.168.1.201`."""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass, field
from urllib.parse import parse_qsl

from pipeline.errors import SourceError

SCHEME, VELODYNE = "zenoh:", "velodyne:"
_ENDPOINT = re.compile(r"(tcp|tls|quic)/(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+):([0-9]{1,5})")
_OPTIONS = ("robot", "domain", "scan", "odometry", "imu")
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
        robot: Its namespace, "" for the first one that sends scans.
        topics: Topic by role where the user names it.
    """

    uri: str
    endpoint: str
    domain: int = 0
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
    return uri.lower().startswith((SCHEME, VELODYNE))


def parse_address(uri: str) -> ZenohAddress | VelodyneAddress:
    """Read an address.

    Raises:
        SourceError: It is none, or has an option that does not exist.
    """
    return _velodyne(uri) if uri.lower().startswith(VELODYNE) else _zenoh(uri)


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
    options = dict(parse_qsl(query, keep_blank_values=True))
    unknown = sorted(options.keys() - set(_OPTIONS))
    if unknown:
        raise SourceError(
            f"there is no option {unknown[0]!r}", where=uri, remedy=f"Options are {', '.join(_OPTIONS)}."
        )
    domain = options.get("domain", "0")
    if not (domain.isascii() and domain.isdigit() and int(domain) <= 232):
        raise SourceError(f"{domain!r} is no ROS domain", where=uri, remedy="Give a number from 0 to 232.")
    topics = {role: options[role] for role in ("scan", "odometry", "imu") if options.get(role)}
    return ZenohAddress(uri, endpoint, int(domain), options.get("robot", "").strip("/"), topics)
