"""The record that describes which source is mapped and how: the same one for a run that is opened, replayed,
shared, tuned or learned from, so that all of them compute the same run."""

from __future__ import annotations

from collections.abc import Mapping
from math import degrees, radians
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from pipeline.geometry.poses import Pose3
from pipeline.io.readers.base import SourceOptions

Role = Literal["scan", "odometry", "imu", "gnss", "pose", "camera"]
LONGEST_URI = 4096
LARGEST_SEED = 2**63 - 1

Uri = Annotated[str, Meta(max_length=LONGEST_URI)]
TopicName = Annotated[str, Meta(max_length=256)]
Seed = Annotated[int, Meta(ge=0, le=LARGEST_SEED)]
_Number = Annotated[float, Meta(ge=-1000.0, le=1000.0)]
Mount = tuple[_Number, _Number, _Number, _Number, _Number, _Number]
_Value = bool | int | float | Annotated[str, Meta(max_length=100)]


class SourceRequest(msgspec.Struct, frozen=True):
    """A source and every choice that decides how it is mapped.

    Attributes:
        uri: Path or address of the source, as the user wrote it.
        odometry: "auto", "wheels", "kiss-icp", "static", or "file:" and a path (see `app.sources.opening`).
        seed: Random seed of the mapping and of a simulated source.
        topics: Topic name by role, where the user chose one; other topics are found by type.
        mount: Pose of the LiDAR on the robot: x, y, z [m], roll, pitch, yaw [rad]. None uses the pose that
            the source declares.
        preset: Name of the parameter preset; empty for the preset that suits the source.
        parameters: Parameter values by dotted name that differ from the preset.
    """

    uri: Uri
    odometry: Uri = "auto"
    seed: Seed = 0
    topics: dict[str, TopicName] = {}
    mount: Mount | None = None
    preset: Annotated[str, Meta(max_length=100)] = ""
    parameters: dict[str, _Value] = {}

    def request(self) -> SourceRequest:
        """Return these fields as a plain `SourceRequest`, without the fields of a subclass."""
        names = SourceRequest.__struct_fields__
        return SourceRequest(**{name: getattr(self, name) for name in names})

    def options(self) -> SourceOptions:
        """Return the options with which the readers open the source."""
        mounted = None if self.mount is None else Pose3.from_euler(self.mount[:3], *self.mount[3:])
        return SourceOptions(dict(self.topics), mounted, self.seed)

    def kept_choices(self) -> dict[str, Any] | None:
        """Return topics and mounting as JSON for the store and run.json; None where neither was chosen."""
        if not self.topics and self.mount is None:
            return None
        return {"topics": dict(self.topics), "mount": None if self.mount is None else list(self.mount)}

    def for_page(self) -> dict[str, Any]:
        """Return the fields as `POST /api/open` takes them: the mounting angles are degrees."""
        mount = None if self.mount is None else [*self.mount[:3], *map(degrees, self.mount[3:])]
        return {
            "uri": self.uri,
            "odometry": self.odometry,
            "seed": self.seed,
            "topics": dict(self.topics),
            "mount": None if mount is None else [round(value, 9) + 0.0 for value in mount],
        }


class _KeptChoices(msgspec.Struct, frozen=True):
    """Topics and mounting as `SourceRequest.kept_choices` writes them."""

    topics: dict[Role, TopicName] = {}
    mount: Mount | None = None


def request_of_kept(
    uri: str,
    *,
    odometry: str,
    seed: int,
    choices: object,
    preset: str = "",
    parameters: Mapping[str, Any] | None = None,
) -> SourceRequest:
    """Return the request of a run that was kept in the store or in run.json.

    Args:
        uri, odometry, seed, preset, parameters: As in `SourceRequest`.
        choices: From `SourceRequest.kept_choices`. Damaged choices are left out.
    """
    kept = _KeptChoices()
    if choices is not None:
        try:
            kept = msgspec.convert(choices, _KeptChoices, strict=False)
        except msgspec.ValidationError:
            kept = _KeptChoices()
    topics = {str(role): name for role, name in kept.topics.items()}
    return SourceRequest(uri, odometry, seed, topics, kept.mount, preset, dict(parameters or {}))


def request_of_options(uri: str, options: SourceOptions, odometry: str = "auto") -> SourceRequest:
    """Return the request of a run that a command opened with reader options.

    Args:
        uri: URI of the source.
        options: Topics, mounting and seed.
        odometry: Choice of the odometry.
    """
    mounted = options.T_base_lidar
    mount = None if mounted is None else mount_of(mounted)
    return SourceRequest(uri, odometry, options.seed, dict(options.topics), mount)


def mount_of(pose: Pose3) -> Mount:
    """Return x, y, z [m], roll, pitch, yaw [rad] of a pose."""
    x, y, z = map(float, pose.t)
    roll, pitch, yaw = map(float, pose.euler())
    return (x, y, z, roll, pitch, yaw)


def mount_of_degrees(mount: tuple[float, float, float, float, float, float] | None) -> Mount | None:
    """Return a mounting whose angles are given in degrees, with angles in radians."""
    if mount is None:
        return None
    x, y, z, roll, pitch, yaw = mount
    return (x, y, z, radians(roll), radians(pitch), radians(yaw))
