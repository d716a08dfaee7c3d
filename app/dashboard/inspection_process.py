"""The child process that inspects files and robots: `python -m app.dashboard.inspection_process`.

`app.sources.opening.ask` starts it and asks one of `QUESTIONS`.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict
from math import degrees
from pathlib import Path
from typing import Any

import msgspec

from app.common.child_process import ParentConnection, run_child
from app.robot.link import CountingInbox, Heard
from app.robot.source import link_for
from app.robot.topics import Choice, Publisher, choose, countable
from app.sources.live_address import is_live, parse_address
from app.sources.one_step import is_one_step, open_one_step
from app.sources.opening import MEMORY_LIMIT, open_source
from app.sources.request import LONGEST_URI, SourceRequest, with_odometry
from app.sources.topic_details import topic_details
from pipeline.errors import SourceError
from pipeline.io.readers.base import RecordedTopic
from pipeline.io.readers.topics import TYPES_BY_ROLE
from pipeline.odometry.synchroniser import steps

HYPOTHESES = 1_000_000


def recording(question: dict[str, Any]) -> dict[str, Any]:
    """Return {"kind": format} of a recording, detected from its contents.

    Args:
        question: The key "path" has the path.

    Raises:
        SourceError: The recording cannot be read.
    """
    path = question["path"]
    with closing(open_one_step(path) or open_source(path)) as source:
        return {"kind": source.description.kind}


def first_scan(question: dict[str, Any]) -> dict[str, Any]:
    """Return {"stamp_ns": time of the first scan [ns]} of a source, read as a `SourceRequest` chooses.

    Args:
        question: `request` has the fields of the `SourceRequest`.

    Raises:
        SourceError: There is no scan, or it cannot be read.
    """
    request = msgspec.convert(question["request"], SourceRequest)
    with closing(open_source(request.uri, request.options())) as source:
        moving, chosen = with_odometry(source, request.odometry)
        step = next(steps(moving.records(), odometry=chosen.steps), None)
        if step is None:
            raise SourceError("there is no scan in it", where=request.uri, remedy="Choose another source")
        return {"stamp_ns": step.scan.stamp_ns}


def inside(question: dict[str, Any]) -> dict[str, Any]:
    """Return the topics of a recording or a live robot with their roles, and the mounting of the LiDAR, as
    JSON values; see `recorded` and `heard`.

    Args:
        question: The key "path" has the path of the recording or the address of the robot.

    Raises:
        SourceError: The recording or the robot cannot be read.
    """
    return (heard if is_live(question["path"]) else recorded)(question["path"])


def finished(question: dict[str, Any]) -> dict[str, Any]:
    """Return the run in a folder that `stemmap map` wrote as a dict of JSON values. Long strings are cut.

    The keys are `uri`, `kind`, `source` (digest), `odometry`, `seed`, `chosen`, `scans` (number), `time_s`,
    `distance_m`, `lost` (see `lost_share`), `trees` (number of trees that are not rejected), `rejected`
    (number) and `preset`; `parameters`, a dict from dotted names to values; `scores` (see `score_payload`;
    None if unknown); and `map`, a dict with `trees` (see `trees_payload`, each also with `review`, the state
    of its review), `path` (see `thinned`) and `truth` (None). Rejected trees are left out.

    Args:
        question: The key "path" has the folder.

    Raises:
        StemmapError: The files of the folder cannot be read or are damaged.
    """

    from app.batch.run_folder import damaged_record, read_run
    from app.batch.summary import driven, lost_share
    from app.dashboard.payload import trees_payload
    from app.dashboard.run_recorder import thinned

    run = read_run(Path(question["path"]))
    record = run.record
    try:
        scans, time_s = int(record.get("scans") or 0), float(record.get("duration_s") or 0.0)
        lost = lost_share(record.get("health", {}).get("scans", {}))
    except (ValueError, TypeError, AttributeError, OverflowError):
        raise damaged_record(Path(question["path"])) from None
    trees = [{**tree, "review": run.reviews[tree["number"]]} for tree in trees_payload(run.trees, 0)]
    return {
        "uri": run.uri,
        "kind": str(record["source"].get("kind", ""))[:200],
        "source": str(record["source"].get("sha256") or "")[:200],
        "odometry": str(record.get("odometry") or "auto")[:LONGEST_URI],
        "seed": run.seed,
        "chosen": record.get("chosen"),
        "scans": scans,
        "time_s": time_s,
        "distance_m": driven(run.path)[1],
        "lost": lost,
        "trees": len(trees),
        "rejected": len(run.rejected.number),
        "preset": str(record.get("preset", ""))[:100],
        "parameters": run.parameters.flat(),
        "scores": _scores(record.get("evaluation")),
        "map": {"trees": trees, "path": thinned(run.path), "truth": None},
    }


def export(question: dict[str, Any]) -> dict[str, Any]:
    """Export a run to a file for geographic information systems; return {"file": its path}.

    Args:
        question: The key "path" has the folder of the run, "suffix" the suffix of a format of
            `app.batch.export.WRITERS`, and "folder" the empty folder of the file.

    Raises:
        StemmapError, OSError: See `app.batch.export.export_run`.
    """
    from app.batch.export import WRITERS, export_one_file, read_for_export

    run = read_for_export(Path(question["path"]))
    return {"file": str(export_one_file(run, question["suffix"], WRITERS, Path(question["folder"])))}


def layer(question: dict[str, Any]) -> dict[str, Any]:
    """Write the trees or the path of a run as GeoJSON; return {"file": its path}.

    Args:
        question: The key "path" has the folder of the run, "layer" is "trees" or "path", and "folder" has the
            empty folder of the file.

    Raises:
        StemmapError, OSError: See `app.batch.export.read_for_export`.
    """
    from app.batch.export import path_geojson, read_for_export, trees_geojson

    run, name = read_for_export(Path(question["path"])), question["layer"]
    file = Path(question["folder"]) / f"{name}.geojson"
    file.write_text(trees_geojson(run) if name == "trees" else path_geojson(run), encoding="utf-8")
    return {"file": str(file)}


def alignment(question: dict[str, Any]) -> dict[str, Any]:
    """Match two maps by their stems. Return a dict with `pose`, [x [m], y [m], yaw [rad]] of the map `local`
    in the frame of `reference`, or None if there is no match; `reason`, why there is none, else ""; and
    `stems`, the number of matched stems.

    Args:
        question: The keys "local" and "reference" have the maps: for each stem a list of x, y, sigma of the
            position, DBH and sigma of the DBH [m]; None for an unknown DBH.
    """
    import numpy as np

    from pipeline.config import preset
    from pipeline.loop_closure.stem_matching import MapStems, find_constellation

    def stems(rows: list[list[float | None]]) -> MapStems:
        columns = np.array(rows, np.float64).reshape(-1, 5)
        return MapStems(columns[:, :2], columns[:, 2], columns[:, 3], columns[:, 4])

    match = find_constellation(
        stems(question["local"]),
        stems(question["reference"]),
        preset("forest").relocalisation,
        hypotheses=HYPOTHESES,
    )
    pose = match.pose
    return {
        "pose": None if pose is None else [pose.x, pose.y, pose.yaw],
        "reason": match.reason or "",
        "stems": len(match.local),
    }


QUESTIONS: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
    "recording": recording,
    "first_scan": first_scan,
    "inside": inside,
    "finished": finished,
    "export": export,
    "layer": layer,
    "alignment": alignment,
}


def answer(parent: ParentConnection) -> None:
    """Receive one question of the parent process and send its answer, a dict. Its `ask` is a name of
    QUESTIONS, or names a function of an extension as "module:function". Exceptions, also that of an unknown
    question, are raised and end the process."""
    question = parent.receive(dict)
    module, _, name = question["ask"].rpartition(":")
    function = getattr(importlib.import_module(module), name) if module else QUESTIONS[name]
    parent.send(function(question))


def _scores(evaluation: object) -> dict[str, Any] | None:
    """Return the dict of `score_payload` for the scores of run.json; None if there are none or they are
    damaged."""
    from app.dashboard.scores import score_payload
    from pipeline.evaluation import MapScores

    try:
        return score_payload(msgspec.convert(evaluation, MapScores))
    except msgspec.ValidationError:
        return None


#: Longest wait for the topics of a robot, and wait after the last new one [s]. With COUNT_S, an answer takes
#: at most 8 s.
LISTEN_S, SETTLE_S = 5.0, 1.5
#: Time for which messages are counted [s].
COUNT_S = 3.0
_LOOK_S = 0.05
MOST_TOPICS = 500
_ROLES = {kind: role for role, kinds in reversed(TYPES_BY_ROLE.items()) for kind in kinds}


def recorded(uri: str) -> dict[str, Any]:
    """Return the description of a file, folder or simulated run as a dict: `kind`, the format; `topics`, a
    list of at most MOST_TOPICS dicts with the fields of `RecordedTopic` and `details`; `mount`, [x, y, z [m],
    roll, pitch, yaw [deg]] of the LiDAR on the robot (None if there are no topics); and `warnings`, at most
    20 strings, with what is missing.

    Raises:
        SourceError: The source cannot be read, or is no drive.
    """
    if is_one_step(uri):
        raise SourceError("it has no topics", where=uri, remedy="Open it as it is")
    with closing(open_source(uri)) as source:
        about = source.description
        known = about.start_ns is not None and about.end_ns is not None
        seconds = 1e-9 * ((about.end_ns or 0) - (about.start_ns or 0)) if known else 0.0
        shown = about.topics[:MOST_TOPICS]
        topics = [
            {
                **asdict(topic),
                "rate_hz": topic.rate_hz or _rate(topic.messages, seconds),
                "details": topic_details(topic),
            }
            for topic in shown
        ]
        mounted = about.T_base_lidar
        place = [*map(float, mounted.t), *map(degrees, mounted.euler())]
        return {
            "kind": about.kind,
            "topics": topics,
            "mount": [round(number, 3) + 0.0 for number in place] if about.topics else None,
            "warnings": [*about.warnings, *(f"Missing: {text}" for text in about.missing)][:20],
        }


def heard(uri: str) -> dict[str, Any]:
    """Return the topics of a live robot, at most MOST_TOPICS, in the form of `recorded`: see `_counted`; the
    kind is "live" and `mount` None. The role of a topic is that in which a run of this address would read it,
    see `choose`; without any if a topic that the address names has another type, which is a warning. It waits
    for topics, up to LISTEN_S or 1.5 s after the last new one, then counts messages of the usable topics for
    COUNT_S. Without topics, also because there is no connection, the list is empty and there is a warning.

    Raises:
        SourceError: The address is invalid.
    """
    address, inbox = parse_address(uri), CountingInbox()
    make_link = link_for(address)
    with closing(make_link(address, inbox)) as link:
        begun = changed = time.monotonic()
        known = link.publishers()
        while (now := time.monotonic()) < begun + LISTEN_S and not (known and now > changed + SETTLE_S):
            time.sleep(_LOOK_S)
            if (there := link.publishers()) != known:
                known, changed = there, now
        listened = countable(known, MOST_TOPICS)
        if listened:
            link.subscribe(listened)
            time.sleep(COUNT_S)
        numbers = {channel.number for channel in listened}
        warnings = [] if known else [f"no topic was announced within {LISTEN_S:.0f} s"]
        try:
            read = _roles_read(choose(known, address.robot, address.topics, uri), address.topics.get("pose"))
        except SourceError as error:
            read, warnings = {}, [str(error)]
        topics = [
            _counted(each, inbox.heard(k), k in numbers, read.get(each.topic, ""))
            for k, each in enumerate(known[:MOST_TOPICS])
        ]
        return {"kind": "live", "topics": topics, "mount": None, "warnings": warnings}


def _roles_read(choice: Choice | None, pose: str | None) -> dict[str, str]:
    """Return a dict from the topics that are read to their roles; `pose` is the one that is named for it."""
    channels = () if choice is None else choice.channels
    roles = {c.topic: "pose" if c.topic == pose else _ROLES.get(c.msgtype, "transforms") for c in channels}
    return roles | {c.topic: "camera" for c in (choice.camera if choice else ())}


def _counted(publisher: Publisher, heard: Heard, listened: bool, role: str) -> dict[str, Any]:
    """Return the description of a topic as a dict: the fields of a `RecordedTopic`, of which `messages` is
    the number of counted messages (None if they were not counted) and `why_not`, also of a topic that is
    read, whether it is silent; `seconds`, the time of counting [s]; and `rate_hz`.

    Args:
        publisher: The topic.
        heard: Number and times of the messages of the topic.
        listened: Whether its messages were counted.
        role: Role in which it is read; "" if it is not.
    """
    why = ""
    if listened and not heard.messages and not publisher.topic.endswith("tf_static"):
        why = f"silent for {COUNT_S:g} s"
    fits = _ROLES.get(publisher.msgtype, "")
    topic = RecordedTopic(publisher.topic, publisher.msgtype, 0, role, fits, why)
    counted = heard.messages if listened else None
    return {**asdict(topic), "details": [], "messages": counted, "seconds": COUNT_S, "rate_hz": heard.rate_hz}


def _rate(messages: int, seconds: float) -> float | None:
    """Return the mean rate of messages [Hz], one decimal; None with fewer than two or without a duration."""
    return round((messages - 1) / seconds, 1) if seconds > 0.0 and messages > 1 else None


if __name__ == "__main__":
    run_child(answer, memory_limit=MEMORY_LIMIT)
