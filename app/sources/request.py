"""The record that describes which source is mapped and how: the same one for a run that is opened, replayed,
shared, tuned or learned from, so that all of them compute the same run; and the selection of its motion: its
own odometry, LiDAR odometry, a file, or none."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import degrees, radians
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from pipeline.errors import SourceError
from pipeline.geometry.poses import Pose3
from pipeline.io.readers import Source
from pipeline.io.readers.base import SourceDescription, SourceOptions
from pipeline.odometry.odometry_override import (
    FileOdometry,
    OdometryEstimator,
    OdometryOverride,
)
from pipeline.odometry.synchroniser import OdometryChoice

Role = Literal["scan", "odometry", "imu", "gnss", "pose", "camera"]
LONGEST_URI = 4096
LARGEST_SEED = 2**63 - 1

Uri = Annotated[str, Meta(max_length=LONGEST_URI)]
TopicName = Annotated[str, Meta(max_length=256)]
Seed = Annotated[int, Meta(ge=0, le=LARGEST_SEED)]
_Number = Annotated[float, Meta(ge=-1000.0, le=1000.0)]
Mount = tuple[_Number, _Number, _Number, _Number, _Number, _Number]
FormChoice = Literal["auto", "scan", "cloud"]
UnitChoice = Literal["auto", "m", "cm", "mm", "ft", "us-ft"]
UpChoice = Literal["auto", "z", "y", "-y", "x", "-x", "-z"]
_Value = bool | int | float | Annotated[str, Meta(max_length=100)]


class SourceRequest(msgspec.Struct, frozen=True):
    """A source and every choice that decides how it is mapped.

    Attributes:
        uri: Path or address of the source, as the user wrote it.
        odometry: "auto", "wheels", "lidar", "static", or "file:" and a path, see `choose_odometry`.
        seed: Random seed of the mapping and of a simulated source.
        topics: Dict from each role for which the user chose a topic to its name; other topics are chosen by
            type.
        mount: Pose of the LiDAR on the robot: x, y, z [m], roll, pitch, yaw [rad]. None uses the pose that
            the source declares.
        preset: Name of the parameter preset; empty for the preset that suits the source.
        parameters: Dict from dotted names to the parameter values that differ from the preset.
        form, unit, up: Of a file of points, see `SourceOptions`.
    """

    uri: Uri
    odometry: Uri = "auto"
    seed: Seed = 0
    topics: dict[str, TopicName] = {}
    mount: Mount | None = None
    preset: Annotated[str, Meta(max_length=100)] = ""
    parameters: dict[str, _Value] = {}
    form: FormChoice = "auto"
    unit: UnitChoice = "auto"
    up: UpChoice = "auto"

    def request(self) -> SourceRequest:
        """Return these fields as a plain `SourceRequest`, without the fields of a subclass."""
        names = SourceRequest.__struct_fields__
        return SourceRequest(**{name: getattr(self, name) for name in names})

    def options(self) -> SourceOptions:
        """Return the options with which the readers open the source."""
        mounted = None if self.mount is None else Pose3.from_euler(self.mount[:3], *self.mount[3:])
        return SourceOptions(
            dict(self.topics), mounted, self.seed, form=self.form, unit=self.unit, up=self.up
        )

    def _points_choices(self) -> dict[str, str]:
        """Return the fields `form`, `unit` and `up` that are not "auto"."""
        chosen = {"form": self.form, "unit": self.unit, "up": self.up}
        return {name: value for name, value in chosen.items() if value != "auto"}

    def kept_choices(self) -> dict[str, Any] | None:
        """Return a dict for the store and run.json with `topics`, a dict from roles to names, `mount`, [x, y,
        z [m], roll, pitch, yaw [rad]] or None, and those of `form`, `unit` and `up` that were chosen; None if
        nothing was chosen."""
        of_points = self._points_choices()
        if not self.topics and self.mount is None and not of_points:
            return None
        mount = None if self.mount is None else list(self.mount)
        return {"topics": dict(self.topics), "mount": mount, **of_points}

    def for_page(self) -> dict[str, Any]:
        """Return a dict as `POST /api/open` takes it: `uri`, `odometry`, `seed`, `topics`, `mount`, [x, y, z
        [m], roll, pitch, yaw [deg]] or None, and those of `form`, `unit` and `up` that were chosen. Preset
        and parameters are left out."""
        mount = None if self.mount is None else [*self.mount[:3], *map(degrees, self.mount[3:])]
        return {
            "uri": self.uri,
            "odometry": self.odometry,
            "seed": self.seed,
            "topics": dict(self.topics),
            "mount": None if mount is None else [round(value, 9) + 0.0 for value in mount],
            **self._points_choices(),
        }


class _KeptChoices(msgspec.Struct, frozen=True):
    """Choices as `SourceRequest.kept_choices` writes them."""

    topics: dict[Role, TopicName] = {}
    mount: Mount | None = None
    form: FormChoice = "auto"
    unit: UnitChoice = "auto"
    up: UpChoice = "auto"


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
        choices: From `SourceRequest.kept_choices`, None for none. If they are damaged, all of them are left
            out.
    """
    kept = _KeptChoices()
    if choices is not None:
        try:
            kept = msgspec.convert(choices, _KeptChoices, strict=False)
        except msgspec.ValidationError:
            kept = _KeptChoices()
    topics = {str(role): name for role, name in kept.topics.items()}
    return SourceRequest(
        uri,
        odometry,
        seed,
        topics,
        kept.mount,
        preset,
        dict(parameters or {}),
        form=kept.form,
        unit=kept.unit,
        up=kept.up,
    )


def mount_of_degrees(mount: tuple[float, float, float, float, float, float] | None) -> Mount | None:
    """Return a mounting (x, y, z [m], roll, pitch, yaw [rad]) from one whose angles are in degrees; None for
    None."""
    if mount is None:
        return None
    x, y, z, roll, pitch, yaw = mount
    return (x, y, z, radians(roll), radians(pitch), radians(yaw))


FILE = "file:"
Method = Literal["source", "lidar", "static", "file"]


@dataclass(frozen=True, slots=True)
class ChosenOdometry:
    """Selected source of motion.

    Attributes:
        method: "source" uses the odometry of the source itself.
        words: Description and reason for people.
        warning: Warning for people, or "".
    """

    method: Method
    words: str
    warning: str = ""

    @property
    def steps(self) -> OdometryChoice:
        """The choice for the synchroniser: "static" for the method "static", else "auto"."""
        return "static" if self.method == "static" else "auto"


def choose_odometry(known: SourceDescription, choice: str) -> ChosenOdometry:
    """Return the source of motion for a choice of the user.

    "auto", and any unknown choice, selects the odometry of the source; without it, registration of the scans
    (LiDAR odometry); and where that is impossible, for example with a planar laser, no motion, with a
    warning. A pose file is not opened here.

    Args:
        known: Description of the source.
        choice: "auto", "wheels", "lidar", "static", or "file:" and a path.

    Raises:
        SourceError: "wheels" is chosen and the source has no odometry, or "lidar" and its scans cannot be
            registered.
    """
    if choice.startswith(FILE):
        return ChosenOdometry("file", f"poses from {choice.removeprefix(FILE)}, as requested")
    if choice == "static":
        warning = "the odometry is ignored (static): the robot is mapped without motion"
        return ChosenOdometry("static", "none, as requested: the robot is mapped without motion", warning)
    if choice == "wheels" and not known.has_odometry:
        raise SourceError(
            "the source has no odometry",
            where=known.uri,
            remedy="--odometry lidar computes the motion from the scans; --odometry static assumes none",
        )
    obstacle = _no_matching(known)
    if choice == "lidar":
        if obstacle:
            raise SourceError(f"LiDAR odometry is not possible: {obstacle}", where=known.uri)
        wheels = ", started from the wheel odometry" if known.has_odometry else ""
        return ChosenOdometry("lidar", f"registration of the scans{wheels}, as requested")
    if known.has_odometry:
        gnss = f"; GNSS {known.gnss}" if known.gnss else ""
        gnss += f"; other SLAM: {known.other_slam}" if known.other_slam else ""
        return ChosenOdometry(
            "source", f"the source's own{', as requested' if choice == 'wheels' else ''}{gnss}"
        )
    if obstacle:
        warning = f"the source has no odometry, and {obstacle}: the robot is mapped without motion"
        return ChosenOdometry("static", f"none: {obstacle}", warning)
    return ChosenOdometry("lidar", "registration of the scans, because the source has no odometry")


def _no_matching(known: SourceDescription) -> str:
    """Return why LiDAR odometry is not available for a source: it has detected stems, scans of a planar
    laser, or only one scan; else ""."""
    if known.preset == "stems":
        return "detected stems are not scans"
    if known.sensor.rings == 1:
        return "scans of a planar laser cannot be registered"
    return "there is only one scan" if known.scans == 1 else ""


def motion_of(known: SourceDescription, choice: str, chosen: ChosenOdometry) -> OdometryEstimator | None:
    """Return the estimator of the motion; None if the source provides the motion or there is none.

    Args:
        known: Description of the source.
        choice: As in `choose_odometry`.
        chosen: Result of `choose_odometry`.

    Raises:
        SourceError: A pose file cannot be read.
    """
    if chosen.method == "lidar":
        from pipeline.odometry.lidar_odometry import LidarOdometry  # the web process starts without Numba

        return LidarOdometry(known.T_base_lidar, known.sensor)
    if chosen.method == "file":
        return FileOdometry(Path(choice.removeprefix(FILE)).expanduser(), known.T_base_lidar)
    return None


def with_odometry(source: Source, choice: str) -> tuple[Source, ChosenOdometry]:
    """Return the source with the selected motion, and the selection. The source itself is returned if it
    provides the motion or there is none; otherwise a wrapper that closes it, whose digest also covers a pose
    file.

    Args:
        source: The source.
        choice: As in `choose_odometry`.

    Raises:
        SourceError: The choice is not available for this source, or a pose file cannot be read.
    """
    from pipeline.io.readers.base import digest_of

    known = source.description
    chosen = choose_odometry(known, choice)
    motion = motion_of(known, choice, chosen)
    if motion is None:
        return source, chosen
    digest = digest_of([Path(choice.removeprefix(FILE)).expanduser()]) if chosen.method == "file" else ""
    return OdometryOverride(source, motion, digest), chosen
