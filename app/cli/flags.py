"""Flags and messages that several commands share."""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from app.common.text import COMPILING, count
from pipeline.errors import ParameterError, SourceError, StemmapError

if TYPE_CHECKING:
    from app.sources.request import SourceRequest
    from pipeline.config import Parameters
    from pipeline.types.records import Record

SOURCE_HELP = (
    "a recording (.mcap, .db3, .bag), a folder of scans (.bin, .pcd, .ply, "
    ".npy, .npz, .las, .laz), "
    "a whole cloud (.laz, .las, .ply, .npy, .npz), "
    "a live robot (zenoh:tcp/host:7447, velodyne:ADDRESS:PORT?from=SENSOR), "
    "or a simulated run such as sim:stand; `stemmap extensions` names what extensions read"
)


MOUNT = "X,Y,Z,ROLL,PITCH,YAW"
COMPILATION_S = 10.0  # interval of the messages on compilation, and of progress in a file


def program() -> str:
    """Return how the program is called here ("stemmap" or "uv run stemmap"), so that a printed command can be
    pasted."""
    return "uv run stemmap" if os.environ.get("UV_RUN_RECURSION_DEPTH") else "stemmap"


def plain(text: str) -> str:
    """Return text in which "?" replaces each character that is not printable, such as a line break, a tab or
    those that control a terminal."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def add_parameter_flags(parser: argparse.ArgumentParser) -> None:
    """Add --preset, --config and --set."""
    parser.add_argument(
        "--preset",
        metavar="NAME",
        help="named parameter set to start from (default: the one that suits the source)",
    )
    parser.add_argument(
        "--config", metavar="FILE", type=Path, help="TOML file whose values replace those of the preset"
    )
    add_set_flag(parser, "value of one parameter; may be repeated; `stemmap params` lists all")


def add_set_flag(parser: argparse.ArgumentParser, help_text: str) -> None:
    """Add --set to a parser. Each --set appends its text to `assignments`, a list that is empty by
    default."""
    parser.add_argument(
        "--set", metavar="STAGE.NAME=VALUE", dest="assignments", action="append", default=[], help=help_text
    )


def add_truth_flags(parser: argparse.ArgumentParser) -> None:
    """Add --truth and --dbh-unit to a parser. Each --truth appends its text `FILE` or `RUN=FILE` to `truths`,
    a list that is empty by default; see `files_of`."""
    parser.add_argument(
        "--truth",
        metavar="[RUN=]FILE",
        dest="truths",
        action="append",
        default=[],
        help="true trees (CSV) of a run, in the frame of its map; repeated for each run, in their order or "
        "with RUN= in front; one FILE serves all runs of `evaluate` (default: that of the source)",
    )
    add_dbh_unit_flag(parser)


def files_of(uris: list[str], truths: list[str]) -> dict[str, str]:
    """Return a dict from the URI of each run to its file with the true trees; runs without a file are
    missing.

    Args:
        uris: The runs in their order, held-out runs last.
        truths: `FILE` or `RUN=FILE`, where RUN is one of `uris`; a text that begins with none of them is a
            FILE. The files without a run belong to the remaining runs in their order; there must be one for
            each of these, or none.

    Raises:
        ParameterError: The number of files without a run is not that of the remaining runs, or a run has two
            files.
    """
    named: dict[str, str] = {}
    bare = []
    for text in truths:
        # The name of a run may contain =; the longest match is used.
        run = max((uri for uri in uris if text.startswith(f"{uri}=")), key=len, default=None)
        if run is None:
            bare.append(text)
        elif run in named:
            raise ParameterError("a run has two files of true trees", where=run, remedy="Give one")
        else:
            named[run] = text.removeprefix(f"{run}=")
    others = [uri for uri in uris if uri not in named]
    if bare and len(bare) != len(others):
        raise ParameterError(
            f"{count(len(bare), 'file')} of true trees for {count(len(others), 'run')}",
            where=bare[0],
            remedy="Name the run of each file: --truth RUN=FILE",
        )
    return {**named, **dict(zip(others, bare, strict=False))}


def add_dbh_unit_flag(parser: argparse.ArgumentParser) -> None:
    """Add --dbh-unit."""
    parser.add_argument(
        "--dbh-unit", choices=("m", "cm", "mm"), help="unit of a diameter column without unit"
    )


def add_force_flag(parser: argparse.ArgumentParser) -> None:
    """Add --force."""
    parser.add_argument(
        "--force", action="store_true", help="overwrite the map of another source in the folder"
    )


def refuse_to_overwrite(file: Path, *, force: bool) -> None:
    """Raise StemmapError if a file exists, unless `force`."""
    if file.exists() and not force:
        raise StemmapError("the file exists already", where=str(file), remedy="Name another, or add --force")


def add_run_flags(parser: argparse.ArgumentParser) -> None:
    """Add --seed and --odometry."""
    parser.add_argument("--seed", type=seed, default=0, metavar="N", help="random seed (default: 0)")
    parser.add_argument(
        "--odometry",
        type=_odometry,
        metavar="auto|wheels|lidar|static|file:POSES",
        default="auto",
        help="source of the motion. auto: odometry of the source, else lidar; wheels: odometry of the "
        "source; lidar: registration of the scans; static: no motion; "
        "file:poses.txt: LiDAR poses (TUM or KITTI)",
    )


#: Values of --as, --unit and --up, the choices of `app.sources.request` (not imported for a help text).
FORMS = ("auto", "scan", "cloud")
UNITS = ("auto", "m", "cm", "mm", "ft", "us-ft")
AXES = ("auto", "z", "y", "-y", "x", "-x", "-z")


def add_source_flags(parser: argparse.ArgumentParser) -> None:
    """Add --topic, --mount, --as, --unit and --up; values of the last three are `form`, `unit` and `up`."""
    parser.add_argument(
        "--topic",
        metavar="ROLE=NAME",
        dest="topics",
        type=_topic,
        action="append",
        default=[],
        help="topic of a recording for scan, odometry, imu, gnss, pose (of another SLAM) or camera "
        "(default: the one with the most messages)",
    )
    parser.add_argument(
        "--mount",
        metavar=MOUNT,
        type=numbers(MOUNT, 360.0),
        help="pose of the LiDAR on the robot, in metres and degrees (default: that of the source)",
    )
    parser.add_argument(
        "--as",
        dest="form",
        choices=FORMS,
        default="auto",
        help="whether a file of points is one scan or a whole cloud of a plot (auto: by what it holds)",
    )
    parser.add_argument(
        "--unit",
        choices=UNITS,
        default="auto",
        help="unit of the coordinates of a whole cloud (auto: by its reference system, else by its extent)",
    )
    parser.add_argument(
        "--up",
        choices=AXES,
        default="auto",
        help="axis of a whole cloud that points up; --up=-y for -y (auto: by its ground)",
    )


def refuse_one_step(arguments: argparse.Namespace) -> None:
    """Refuse a source that is mapped in one step, which commands for drives cannot use. Raises SourceError
    that names its extension if that is switched off."""
    from app.sources.one_step import is_one_step

    if is_one_step(arguments.source, source_request(arguments, arguments.source).options()):
        raise SourceError("it is no drive", where=arguments.source, remedy="Name another source")


def add_live_flags(parser: argparse.ArgumentParser) -> None:
    """Add `--record [FILE.mcap]` and `--publish`. The value `record` is None without the flag, "" for a
    name in the data folder, else the file name; `publish` is a bool."""
    parser.add_argument(
        "--record",
        metavar="FILE.mcap",
        nargs="?",
        const="",
        help="record a live run and its results; without a file name into the data folder",
    )
    parser.add_argument(
        "--publish",
        action="store_true",
        help="publish pose, path and trees of a live run on the robot's network, for RViz and Foxglove",
    )


def recording_place(arguments: argparse.Namespace, *sources: str) -> str:
    """Return the absolute path of the file of --record: the given one, or a name by the time in the data
    folder; "" without a recording. Nothing is created.

    Args:
        arguments: Parsed arguments with the flags of `add_live_flags`.
        sources: URIs of the sources.

    Raises:
        ParameterError: With --record or --publish a source is not live, or with --publish is not reached over
            Zenoh.
        StemmapError: --record has no file name, and there is no data folder or an environment variable of
            `app.common.settings` is invalid.
    """
    import time

    from app.sources.live_address import is_live

    is_requested = arguments.record is not None or arguments.publish
    if is_requested and not all(is_live(uri) for uri in sources):
        raise ParameterError("--record and --publish need a live robot", remedy="Remove them")
    if arguments.publish and not all(uri.lower().startswith("zenoh:") for uri in sources):
        raise ParameterError(
            "results can be published only over Zenoh",
            remedy="Remove --publish",
        )
    if arguments.record is None:
        return ""
    if arguments.record:
        return str(Path(arguments.record).expanduser().absolute())
    from app.common.settings import from_environment, recordings_place

    return str(recordings_place(from_environment(), time.time()))


def says_parameters(arguments: argparse.Namespace) -> bool:
    """Return whether the command line has a preset, a parameter file or values."""
    return bool(arguments.preset or arguments.config or arguments.assignments)


def _odometry(text: str) -> str:
    """Return the text if it is a choice of --odometry; raises argparse.ArgumentTypeError otherwise. The pose
    file of file:POSES need not exist."""
    if text in ("auto", "wheels", "lidar", "static") or (text.startswith("file:") and len(text) > 5):
        return text
    raise argparse.ArgumentTypeError(f"{text!r} is not auto, wheels, lidar, static or file:poses.txt")


def _topic(text: str) -> tuple[str, str]:
    """Parse ROLE=NAME as (role, name); raises argparse.ArgumentTypeError for an unknown role or an empty
    name."""
    role, equals, name = text.partition("=")
    if not (equals and name and role in ("scan", "odometry", "imu", "gnss", "pose", "camera")):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not scan=NAME, odometry=NAME, imu=NAME, gnss=NAME, pose=NAME or camera=NAME"
        )
    return role, name


def numbers(shape: str, largest: float = 1e8) -> Callable[[str], tuple[float, ...]]:
    """Return a parser of numbers with commas between them, for argparse; it raises ArgumentTypeError for
    other texts. An optional number that is not given is 0.

    Args:
        shape: Names of the numbers, the optional ones in brackets, such as "X,Y[,TURN]".
        largest: Largest magnitude of a number.
    """
    least, most = shape.partition("[")[0].count(",") + 1, shape.count(",") + 1

    def parse(text: str) -> tuple[float, ...]:
        values = tuple(map(_number, text.split(",")))
        if not least <= len(values) <= most or not all(abs(value) <= largest for value in values):
            raise argparse.ArgumentTypeError(
                f"{text!r} is not {shape}: numbers up to {largest:g} with commas between them"
            )
        return (*values, *[0.0] * (most - len(values)))

    return parse


def source_request(arguments: argparse.Namespace, uri: str) -> SourceRequest:
    """Return how a source is opened and mapped as the flags give it; --mount is converted to radians. Without
    the flag --odometry the odometry is "auto"."""
    from app.sources.request import SourceRequest, mount_of_degrees

    odometry = getattr(arguments, "odometry", "auto")
    return SourceRequest(
        uri,
        odometry,
        arguments.seed or 0,
        dict(arguments.topics),
        mount_of_degrees(arguments.mount),
        form=getattr(arguments, "form", "auto"),
        unit=getattr(arguments, "unit", "auto"),
        up=getattr(arguments, "up", "auto"),
    )


def source(text: str) -> str:
    """Return the word for a source; an empty word is an error and not the current folder.

    Raises:
        argparse.ArgumentTypeError: The word is empty.
    """
    if not text.strip():
        raise argparse.ArgumentTypeError("the source is empty")
    return text


def seed(text: str) -> int:
    """Parse a random seed: a whole number from 0 to 2^63 - 1; ArgumentTypeError for other texts."""
    return whole_number(0, (1 << 63) - 1)(text)


def whole_number(low: int, high: int) -> Callable[[str], int]:
    """Return a parser of whole numbers from low to high, both included and at least 0, for argparse; it
    raises ArgumentTypeError for other texts, also with a sign."""

    def parse(text: str) -> int:
        if text.isascii() and text.isdigit() and len(text) < 20 and low <= int(text) <= high:
            return int(text)
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from {low} to {high}")

    return parse


def positive_number(limit: float, quantity: str) -> Callable[[str], float]:
    """Return a parser of numbers above 0 and below a limit, for argparse; it raises ArgumentTypeError for
    other texts.

    Args:
        limit: Upper limit, not included.
        quantity: Name of the number in errors.
    """

    def parse(text: str) -> float:
        value = _number(text)
        if not 0.0 < value < limit:
            raise argparse.ArgumentTypeError(f"{text!r} is not a {quantity}")
        return value

    return parse


def share(text: str) -> float:
    """Parse a number from 0 to 1, both included; ArgumentTypeError for other texts."""
    value = _number(text)
    if not 0.0 <= value <= 1.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number from 0 to 1")
    return value


def _number(text: str) -> float:
    """Return the number of a text, NaN for other texts."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def print_warnings(texts: Iterable[str]) -> None:
    """Print warnings to standard error, without characters that steer a terminal."""
    for text in texts:
        print(f"warning: {plain(text)}", file=sys.stderr)


def chosen_parameters(
    arguments: argparse.Namespace, suggested: str, present: Parameters | None = None
) -> tuple[str, Parameters]:
    """Return the name of the preset and the parameters of the flags: the preset, with the values of --config
    and then of --set.

    Args:
        arguments: Parsed, with the flags of `add_parameter_flags`.
        suggested: Preset that suits the source, used where none is named.
        present: Parameters of an earlier run, which replace the suggested preset unless --preset is given;
            None without one.

    Raises:
        ParameterError: A name, value or file is invalid.
        StemmapError: The random forest that is named does not exist.
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
        from app.store.forests import kept_forests

        kept_forests().check(parameters)
    return name, parameters


def progress_bar(total: int | None, unit: str, title: str = "") -> Any:  # noqa: ANN401 - tqdm has no types
    """Return a progress bar of tqdm on standard error; a bar that shows nothing if that is no terminal.

    Args:
        total: Number of units; None if it is unknown.
        unit: What is counted.
        title: Text before the bar.
    """
    from tqdm import tqdm

    return tqdm(
        total=total, unit=unit, desc=title, file=sys.stderr, disable=not sys.stderr.isatty(), leave=False
    )


def with_progress(records: Iterator[Record], scans: int | None, title: str) -> Iterator[Record]:
    """Yield records, and show the number of scans among them, see `scan_progress`.

    Args:
        records: Records of a source.
        scans: Number of its scans; None if it is unknown.
        title: What is done.
    """
    from pipeline.types.records import Scan

    with scan_progress(scans, title) as bar:
        for record in records:
            yield record
            bar.update(isinstance(record, Scan))


def scan_progress(scans: int | None, title: str) -> Any:  # noqa: ANN401 - tqdm has no types
    """Return a progress bar of scans; lines at intervals of COMPILATION_S if standard error is no terminal.

    Args:
        scans: Number of scans; None if it is unknown.
        title: What is done.
    """
    return progress_bar(scans, "scan", title) if sys.stderr.isatty() else _ProgressLines(scans, title)


class _ProgressLines:
    """A progress bar for a file: lines such as "mapping: scan 120 of 406"."""

    def __init__(self, scans: int | None, title: str) -> None:
        self._title, self._of = title, "" if scans is None else f" of {scans}"
        self._done, self._told_at = 0, time.monotonic()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None: ...

    def update(self, scans: int) -> None:
        """Count scans, and print a line if the last one is older than COMPILATION_S."""
        self._done += scans
        if time.monotonic() < self._told_at + COMPILATION_S:
            return
        self._told_at = time.monotonic()
        print(f"{self._title}: scan {self._done}{self._of}", file=sys.stderr, flush=True)


@contextmanager
def compilation_notice() -> Iterator[None]:
    """Report on stderr, above a progress bar, that kernels are compiled inside the context: once at the first
    kernel, and then the share of the compiled kernels at intervals of COMPILATION_S."""
    from tqdm import tqdm

    from app.worker.numba_warmup import compiled_kernels
    from pipeline.jit import on_compiling

    reported_at: list[float] = []

    def report() -> None:
        now, text = time.monotonic(), COMPILING
        if reported_at:
            if now < reported_at[-1] + COMPILATION_S:
                return
            compiled, of_all = compiled_kernels()
            if compiled == of_all:
                return  # the last kernels are those of one kind of source, which are not counted
            text = f"{int(100.0 * compiled / of_all)} % of the kernels are compiled"
        reported_at.append(now)
        tqdm.write(text, file=sys.stderr)
        sys.stderr.flush()

    with on_compiling(report):
        yield
