"""What somebody chose about a source (topics by role, where the LiDAR stands), as it is kept with a run."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from app.worker.protocol import Open
from pipeline.io.readers.base import SourceOptions

Role = Literal["scan", "odometry", "imu", "gnss", "pose", "camera"]
TopicName = Annotated[str, Meta(max_length=256)]
_Number = Annotated[float, Meta(ge=-1000.0, le=1000.0)]


class Chosen(msgspec.Struct, frozen=True):
    """As in `Open`: topic by role, and x, y, z [m], roll, pitch, yaw [rad] of the LiDAR on the robot."""

    topics: dict[Role, TopicName] = {}
    mount: tuple[_Number, _Number, _Number, _Number, _Number, _Number] | None = None


def plain_of(wanted: Open) -> dict[str, Any] | None:
    """As JSON; None where nothing was chosen."""
    if not wanted.topics and wanted.mount is None:
        return None
    return {"topics": dict(wanted.topics), "mount": None if wanted.mount is None else list(wanted.mount)}


def plain_of_options(options: SourceOptions) -> dict[str, Any] | None:
    """The same of a run without a browser."""
    placed = options.T_base_lidar
    mount = None if placed is None else (*map(float, placed.t), *map(float, placed.euler()))
    return plain_of(Open("", topics=dict(options.topics), mount=mount))


def chosen_again(wanted: Open, kept: object) -> Open:
    """The same with what was chosen; what is damaged was not chosen."""
    if kept is None:
        return wanted
    try:
        chosen = msgspec.convert(kept, Chosen, strict=False)
    except msgspec.ValidationError:
        return wanted
    topics = {str(role): name for role, name in chosen.topics.items()}
    return msgspec.structs.replace(wanted, topics=topics, mount=chosen.mount)
