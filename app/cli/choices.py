"""Flags that several commands share: parameters, seed, odometry."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.errors import ParameterError

if TYPE_CHECKING:
    from pipeline.config import Parameters
    from pipeline.io.readers import SourceOptions

SOURCE_HELP = (
    "a recording (.mcap, .db3, .bag, .pcap, .zip of Victoria Park), a folder of scans (.bin, .pcd, .ply, "
    ".npy, .npz, .las, .laz) or of TreeManagerState_<i>.csv stems, "
    "a whole cloud (.laz, .las, .e57, .ply, .npy, .npz), "
    "a robot that is heard live (zenoh:tcp/host:7447, dds:?domain=0, velodyne:ADDRESS:PORT?from=SENSOR), "
    "or a simulated run such as sim:stand"
)


def program() -> str:
    """What to type before the words of a command, so that a line that is printed can be pasted."""
    return "uv run stemmap" if os.environ.get("UV_RUN_RECURSION_DEPTH") else "stemmap"


def plain(text: str) -> str:
    """Text from a file without what would steer a terminal."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def add_parameter_flags(parser: argparse.ArgumentParser) -> None:
    """--preset, --config and --set."""
    parser.add_argument(
        "--preset", metavar="NAME", help="parameters to start from (default: what suits the source)"
    )
    parser.add_argument("--config", metavar="FILE", type=Path, help="TOML file laid over the preset")
    parser.add_argument(
        "--set",
        metavar="STAGE.NAME=VALUE",
        dest="assignments",
        action="append",
        default=[],
        help="one value laid over both; may be given again; `stemmap params` lists them",
    )


def add_force_flag(parser: argparse.ArgumentParser) -> None:
    """--force."""
    parser.add_argument(
        "--force", action="store_true", help="write over the map of another source that stands in the folder"
    )


def add_run_flags(parser: argparse.ArgumentParser) -> None:
    """--seed and --odometry."""
    parser.add_argument(
        "--seed", type=seed, default=0, metavar="N", help="of every random number (default: 0)"
    )
    parser.add_argument(
        "--odometry",
        type=_odometry,
        metavar="auto|wheels|kiss-icp|static|file:POSES",
        default="auto",
        help="auto: what the source has, else kiss-icp; wheels: it must have some; kiss-icp: scans are laid "
        "over one another; static: the robot stands still; file:poses.txt: poses of the LiDAR (TUM, KITTI)",
    )


def add_source_flags(parser: argparse.ArgumentParser) -> None:
    """--topic and --mount."""
    parser.add_argument(
        "--topic",
        metavar="ROLE=NAME",
        dest="topics",
        type=_topic,
        action="append",
        default=[],
        help="topic of a recording for scan, odometry, imu, gnss, pose (another SLAM's) or camera, "
        "in place of the fullest one",
    )
    parser.add_argument(
        "--mount",
        metavar="X,Y,Z,ROLL,PITCH,YAW",
        type=_mount,
        help="where the LiDAR stands on the robot, in metres and degrees (default: what the source says)",
    )


def add_live_flags(parser: argparse.ArgumentParser) -> None:
    """--record and --publish."""
    parser.add_argument(
        "--record",
        metavar="FILE.mcap",
        nargs="?",
        const="",
        help="record a live run, with its results, to be replayed; without a name into the data folder",
    )
    parser.add_argument(
        "--publish",
        action="store_true",
        help="send pose, path and trees of a live run to the robot's network, for RViz and Foxglove",
    )


def recording_place(arguments: argparse.Namespace, *sources: str) -> str:
    """The file that --record means, "" where nothing is recorded.

    Raises:
        ParameterError: One of the sources is no live one.
    """
    import time

    from app.robot.address import is_live, parse_address

    asked = arguments.record is not None or arguments.publish
    if asked and not all(is_live(uri) for uri in sources):
        raise ParameterError(
            "--record and --publish are of a robot that is heard live", remedy="Leave them away"
        )
    if asked and any(getattr(parse_address(uri), "mapped_there", False) for uri in sources):
        raise ParameterError(
            "a robot that maps by itself records and publishes by itself",
            remedy="Leave --record and --publish away, or give them to `stemmap map` on the robot",
        )
    if arguments.publish and not all(uri.lower().startswith("zenoh:") for uri in sources):
        raise ParameterError(
            "results are published over Zenoh alone; a sensor and plain DDS are only heard",
            remedy="Leave --publish away",
        )
    if arguments.record is None:
        return ""
    if arguments.record:
        return str(Path(arguments.record).expanduser().absolute())
    from app.common.settings import from_environment, recordings_place

    return str(recordings_place(from_environment(), time.time()))


def says_parameters(arguments: argparse.Namespace) -> bool:
    """Whether the command line says anything about the parameters."""
    return bool(arguments.preset or arguments.config or arguments.assignments)


def _odometry(text: str) -> str:
    if text in ("auto", "wheels", "kiss-icp", "static") or (text.startswith("file:") and len(text) > 5):
        return text
    raise argparse.ArgumentTypeError(f"{text!r} is not auto, wheels, kiss-icp, static or file:poses.txt")


def _topic(text: str) -> tuple[str, str]:
    role, equals, name = text.partition("=")
    if not (equals and name and role in ("scan", "odometry", "imu", "gnss", "pose", "camera")):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not scan=NAME, odometry=NAME, imu=NAME, gnss=NAME, pose=NAME or camera=NAME"
        )
    return role, name


def _mount(text: str) -> tuple[float, ...]:
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != 6 or not all(abs(number) <= 360.0 for number in numbers):
        raise argparse.ArgumentTypeError(f"{text!r} is not six numbers x,y,z,roll,pitch,yaw")
    return numbers


def source_options(arguments: argparse.Namespace) -> SourceOptions:
    """What the flags say about the source."""
    from math import radians

    from pipeline.geometry.poses import Pose3
    from pipeline.io.readers import SourceOptions

    mount = arguments.mount
    return SourceOptions(
        topics=dict(arguments.topics),
        T_base_lidar=None if mount is None else Pose3.from_euler(mount[:3], *map(radians, mount[3:])),
        seed=arguments.seed,
        as_live=getattr(arguments, "as_live", False),
    )


def source(text: str) -> str:
    """A source from the command line; an empty word is a slip of a script, not the current folder."""
    if not text.strip():
        raise argparse.ArgumentTypeError("the source is empty")
    return text


def seed(text: str) -> int:
    """A seed from a flag: a whole number that is not negative."""
    try:
        value = int(text)
    except ValueError:
        value = -1
    if not 0 <= value < 1 << 63:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0 on")
    return value


def chosen_parameters(
    arguments: argparse.Namespace, suggested: str, present: Parameters | None = None
) -> tuple[str, Parameters]:
    """The name of the preset and the parameters that the flags ask for.

    Args:
        arguments: Parsed, with the flags of `add_parameter_flags`.
        suggested: The preset that suits the source, where none is named.
        present: What stands for the suggested preset, of a map that is continued.

    Raises:
        ParameterError: A name, value or file does not fit.
        StemmapError: The decision trees that are named are not here.
    """
    from pipeline.config import assign, from_toml, preset

    name = arguments.preset or suggested
    parameters = present if present is not None and not arguments.preset else preset(name)
    if arguments.config is not None:
        try:
            text = arguments.config.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            reason = getattr(error, "strerror", None) or "it is not text"
            raise ParameterError(
                f"cannot read the file of parameters: {reason}", where=str(arguments.config)
            ) from None
        parameters = from_toml(text, parameters, str(arguments.config))
    parameters = assign(parameters, arguments.assignments)
    if parameters.classification.forest != "package":
        from app.training.learned_forests import kept_forests

        kept_forests().check(parameters)
    return name, parameters
