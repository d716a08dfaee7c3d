"""What connects to a robot: one class for each way in which it can be heard."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

from app.robot.address import DdsAddress, VelodyneAddress, ZenohAddress
from app.robot.dds_link import DdsLink
from app.robot.inbox import Inbox
from app.robot.ros_graph import Publisher
from app.robot.velodyne_link import VelodyneLink
from app.robot.zenoh_link import ZenohLink
from pipeline.io.readers.container import Channel

KIND, VELODYNE_KIND, DDS_KIND = "ROS 2 over Zenoh", "Velodyne sensor", "ROS 2 over DDS"


class Link(Protocol):
    """What a source needs of `ZenohLink`."""

    problem: str
    losses: dict[str, int]
    scans: int
    version: int

    @property
    def session(self) -> Any: ...  # noqa: ANN401
    @property
    def place(self) -> str: ...
    @property
    def nothing(self) -> str: ...
    @property
    def silence_s(self) -> float | None: ...
    def publishers(self) -> list[Publisher]: ...
    def robots(self) -> list[str]: ...
    def subscribe(self, channels: Sequence[Channel]) -> None: ...
    def close(self) -> None: ...


MakeLink = Callable[[Any, Inbox], Link]


def link_for(address: ZenohAddress | VelodyneAddress | DdsAddress) -> tuple[MakeLink, str]:
    """What connects to an address, given it and an inbox; and the kind of such a source for people."""
    if isinstance(address, VelodyneAddress):
        return VelodyneLink, VELODYNE_KIND
    return (DdsLink, DDS_KIND) if isinstance(address, DdsAddress) else (ZenohLink, KIND)
