"""The address of a live source: `zenoh:tcp/host:7447?robot=NAME&domain=0&scan=/topic`,
`zenoh:tls/host:7447?ca=ca.pem&cert=me.pem&key=me-key.pem`, `velodyne:0.0.0.0:2368?from=192.168.1.201`, or one
of an extension."""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import ClassVar
from urllib.parse import parse_qsl

from app.extension import all_extensions, switched_off
from pipeline.errors import SourceError

#: A longer time without a scan of a live source is reported [s]; a LiDAR of 5 Hz pauses for 0.2 s.
SILENT_S = 1.0
#: Value of `?robot=` for all robots, each with a dashboard.
ALL_ROBOTS = "*"
#: Value of `?robot=` for the robot without a namespace (ROS's root namespace).
ROOT = "/"
SCHEME, VELODYNE = "zenoh:", "velodyne:"
_ENDPOINT = re.compile(r"(tcp|tls|quic)/(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+):([0-9]{1,5})")
_FILES = ("ca", "cert", "key")
#: Roles for which an address may name a topic.
TOPICS = ("scan", "odometry", "imu", "gnss", "pose", "camera")
_OPTIONS = ("robot", "domain", *TOPICS, *_FILES)
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
    """Return whether a URI is the address of a live source: whether it begins with one of the schemes, in any
    case. It is not checked further. Raises SourceError if the extension of a scheme is switched off."""
    return uri.lower().startswith((SCHEME, VELODYNE)) or _module_of(uri) != ""


def extension_of(uri: str) -> ModuleType | None:
    """Return the module of the extension that reads a URI, see `app.extension.Extension.addresses`; None if
    there is none."""
    module = _module_of(uri)
    return import_module(module) if module else None


def _module_of(uri: str) -> str:
    """Return the name of the module of `extension_of`; "" for none. Raises SourceError if the extension is
    switched off."""
    scheme = uri.partition(":")[0].lower()
    for each in all_extensions():
        if each.extension is None or scheme not in each.extension.addresses:
            continue
        if not each.is_on:
            raise SourceError(
                "this kind of address needs an extension", where=uri, remedy=switched_off(each.name)
            )
        return each.extension.addresses[scheme]
    return ""


def parse_address(uri: str) -> Address:
    """Return the address that a URI describes. Nothing is connected.

    Raises:
        SourceError: The address is invalid or has an unknown option, a certificate file does not exist, or
            what an extension needs is not installed.
    """
    if (extension := extension_of(uri)) is not None:
        address: Address = extension.parse(uri)
        return address
    return _velodyne(uri) if uri.lower().startswith(VELODYNE) else _zenoh(uri)


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
    options = known_options(uri, query, _OPTIONS)
    files = _files(uri, endpoint, {name: options[name] for name in _FILES if options.get(name)})
    named = options.get("robot", "")
    robot = named.strip("/") or (ROOT if named else "")
    return ZenohAddress(
        uri=uri,
        domain=domain_of(uri, options),
        robot=robot,
        topics=topics_of(options),
        endpoint=endpoint,
        files=files,
    )


def known_options(uri: str, query: str, names: tuple[str, ...]) -> dict[str, str]:
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


def domain_of(uri: str, options: dict[str, str]) -> int:
    """Return the ROS domain of the options, by default 0; SourceError unless it is 0 to 232."""
    domain = options.get("domain", "0")
    if not (domain.isascii() and domain.isdigit() and int(domain) <= 232):
        raise SourceError(f"{domain!r} is not a ROS domain", where=uri, remedy="Give a number from 0 to 232.")
    return int(domain)


def topics_of(options: dict[str, str]) -> dict[str, str]:
    """Return a dict from each role for which the user named a topic to this topic."""
    return {role: options[role] for role in TOPICS if options.get(role)}


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
