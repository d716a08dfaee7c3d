"""Inspection of files and robots from outside, in a child process with limits on time, memory and output.

`ask` starts `python -m app.sources.inspection`, which answers one of `QUESTIONS`. A damaged or hostile file
can affect only that process and not the server.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict
from math import degrees
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import msgspec

from app.common.child_process import ChildProcess, ParentConnection, ProtocolError, python_module, run_child
from app.robot.address import is_live, parse_address
from app.robot.link import CountingInbox, Heard
from app.robot.source import link_for
from app.robot.topics import Publisher, countable
from app.sources.opening import check_address, check_cloud, open_cloud, open_source
from app.sources.request import LONGEST_URI, SourceRequest, with_odometry
from pipeline.errors import SourceError, StemmapError
from pipeline.io.readers import check_existence
from pipeline.io.readers.base import RecordedTopic
from pipeline.io.readers.clouds import is_cloud
from pipeline.io.readers.topics import TYPES_BY_ROLE
from pipeline.odometry.synchroniser import steps

COMMAND = python_module("app.sources.inspection")
PATIENCE_S = 120.0
#: A large recording on a slow disk takes minutes to be opened.
OPENING_LIMIT_S = 300.0
LARGEST_ANSWER = 64 << 20
MEMORY_LIMIT = 8 << 30
_MOST_AT_ONCE = 2
# A semaphore belongs to the event loop of its first use.
_semaphores: WeakKeyDictionary[asyncio.AbstractEventLoop, asyncio.Semaphore] = WeakKeyDictionary()


class TookTooLongError(StemmapError):
    """The child process was ended because it took too long."""


class _Answer(msgspec.Struct, frozen=True):
    """Answer of the child process, or the error: what, where, remedy."""

    content: dict[str, Any] = {}
    error: tuple[str, str, str] | None = None


async def ask(
    question: dict[str, Any], *, patience_s: float = PATIENCE_S, command: Sequence[str] = COMMAND
) -> dict[str, Any]:
    """Return the answer of a child process to a question. At most two questions of an event loop are answered
    at the same time; further ones wait, without a time limit. A path that does not exist is refused without a
    process.

    Args:
        question: `ask` is a key of `QUESTIONS`, `path` the source; further values depend on the question.
        patience_s: Time limit of the answer [s].
        command: Program and arguments of the child process.

    Raises:
        SourceError: The source cannot be read; the error gives the reason.
        TookTooLongError: There was no answer in time.
        StemmapError: The process cannot be started.
    """
    path = question.get("path", "")
    if path:
        check_existence(path)  # at once: the child process needs seconds to start
    free = _semaphores.setdefault(asyncio.get_running_loop(), asyncio.Semaphore(_MOST_AT_ONCE))
    async with free, await ChildProcess.start(command, line_limit=LARGEST_ANSWER) as child:
        try:
            await child.send(question)
            answer = await child.receive(_Answer, patience_s)
        except ProtocolError:
            answer = None
        except TimeoutError:
            raise TookTooLongError("it takes too long to be read", where=path) from None
    if answer is None:
        raise SourceError(
            "it could not be read: the reader ended without an answer",
            where=path,
            remedy="The file is damaged, or this is a fault in stemmap; the terminal may show more",
        )
    if answer.error is not None:
        what, where, remedy = answer.error
        raise SourceError(what, where=where, remedy=remedy)
    return answer.content


async def check_source(request: SourceRequest) -> None:
    """Check that a source can be opened. A child process reads the first scan of a file, within 300 s, or the
    header and the first points of a whole cloud; of simulated runs and live robots only the address is
    checked.

    Raises:
        StemmapError: It cannot be opened; the error gives the reason.
    """
    if not check_address(request.uri):
        return
    if await asyncio.to_thread(is_cloud, request.uri):
        await asyncio.to_thread(check_cloud, request.uri)  # a copy of this process, which starts at once
    else:
        question = {"ask": "first_scan", "path": request.uri, "request": msgspec.to_builtins(request)}
        await ask(question, patience_s=OPENING_LIMIT_S)


# --- in the child process ----------------------------------------------------------------------------

HYPOTHESES = 1_000_000


def recording(question: dict[str, Any]) -> dict[str, Any]:
    """Return {"kind": format} of a recording, detected from its contents.

    Args:
        question: The key "path" has the path.

    Raises:
        SourceError: It cannot be read.
    """
    if is_cloud(question["path"]):
        return {"kind": f"whole cloud, {open_cloud(question['path']).description.kind}"}
    with closing(open_source(question["path"])) as source:
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
        step = next(steps(moving.records(None), odometry=chosen.steps), None)
        if step is None:
            raise SourceError("there is no scan in it", where=request.uri, remedy="Choose another source")
        return {"stamp_ns": step.scan.stamp_ns}


def inside(question: dict[str, Any]) -> dict[str, Any]:
    """Return the topics of a recording or a live robot with their roles, and the mounting of the LiDAR, as
    JSON values; see `recorded` and `heard`.

    Args:
        question: The key "path" has the path of the recording or the address of the robot.

    Raises:
        SourceError: It cannot be read.
    """
    return (heard if is_live(question["path"]) else recorded)(question["path"])


def finished(question: dict[str, Any]) -> dict[str, Any]:
    """Return map and figures of a folder that `stemmap map` wrote, as the store keeps them for a run. Long
    texts are cut.

    Args:
        question: The key "path" has the folder.

    Raises:
        StemmapError: The files of the folder cannot be read or are damaged.
    """
    import numpy as np

    from app.batch.run_folder import read_run, read_run_record
    from app.dashboard.payload import trees_payload
    from app.dashboard.run_recorder import thinned

    folder = Path(question["path"])
    run, record = read_run(folder), read_run_record(folder)
    path_xy = np.stack([run.path.x, run.path.y], axis=1)
    trees = trees_payload(run.trees, 0)
    return {
        "uri": run.uri,
        "kind": str(record["source"].get("kind", ""))[:200],
        "source": str(record["source"].get("sha256") or "")[:200],
        "odometry": str(record.get("odometry") or "auto")[:LONGEST_URI],
        "seed": run.seed,
        "chosen": record.get("chosen"),
        "scans": int(record.get("scans") or 0),
        "time_s": float(record.get("duration_s") or 0.0),
        "distance_m": float(np.hypot(*np.diff(path_xy, axis=0).T).sum()) if len(path_xy) else 0.0,
        "trees": len(trees),
        "preset": str(record.get("preset", ""))[:100],
        "parameters": run.parameters.flat(),
        "scores": _scores(record.get("evaluation")),
        "map": {"trees": trees, "path": thinned(path_xy), "truth": None},
    }


def alignment(question: dict[str, Any]) -> dict[str, Any]:
    """Return the pose [x, y, yaw] of one map in another, found by stem matching, or None; the reason if there
    is none; and the number of matched stems.

    Args:
        question: `local` and `reference` are the maps, with a row per stem: x, y, sigma, DBH and its sigma
            [m]; None for an unknown DBH.
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
    "alignment": alignment,
}


def answer(parent: ParentConnection) -> None:
    """Answer one question of the parent process. A StemmapError or lack of memory is sent as an error; other
    exceptions end the process."""
    question = parent.receive(dict)
    try:
        reply = _Answer(QUESTIONS[question["ask"]](question))
    except StemmapError as error:
        reply = _Answer(error=(error.what, error.where, error.remedy))
    except MemoryError:
        reply = _Answer(error=("it does not fit into the memory of this machine", "", ""))
    parent.send(reply)


def _scores(evaluation: object) -> dict[str, Any] | None:
    """Return the scores of run.json for the page; None if there are none or they are damaged."""
    from app.dashboard.scores import score_payload
    from pipeline.evaluation import MapScores

    try:
        return score_payload(msgspec.convert(evaluation, MapScores))
    except msgspec.ValidationError:
        return None


#: A robot's topics are listened for so long, and so long after the last new one.
LISTEN_S, SETTLE_S = 8.0, 1.5
#: So long they are counted.
COUNT_S = 3.0
_LOOK_S = 0.05
MOST_TOPICS = 500
_ROLES = {kind: role for role, kinds in reversed(TYPES_BY_ROLE.items()) for kind in kinds}


def recorded(uri: str) -> dict[str, Any]:
    """Return the contents of a file, folder or simulated run: format, at most MOST_TOPICS topics with their
    rates [Hz], mounting (x, y, z [m], roll, pitch, yaw [deg]; None without topics), and at most 20 warnings.

    Raises:
        SourceError: The source cannot be read, or is a whole cloud.
    """
    if is_cloud(uri):
        raise SourceError("a whole cloud has no topics", where=uri, remedy="Open it as it is")
    with closing(open_source(uri)) as source:
        about = source.description
        known = about.start_ns is not None and about.end_ns is not None
        seconds = 1e-9 * ((about.end_ns or 0) - (about.start_ns or 0)) if known else 0.0
        shown = about.topics[:MOST_TOPICS]
        topics = [{**asdict(topic), "rate_hz": _rate(topic.messages, seconds)} for topic in shown]
        mounted = about.T_base_lidar
        place = [*map(float, mounted.t), *map(degrees, mounted.euler())]
        return {
            "kind": about.kind,
            "topics": topics,
            "mount": [round(number, 3) + 0.0 for number in place] if about.topics else None,
            "warnings": list(about.warnings)[:20],
        }


def heard(uri: str) -> dict[str, Any]:
    """Return the topics of a live robot with the rates of the usable ones, in the form of `recorded`; at most
    MOST_TOPICS. It waits up to 8 s for topics, then counts messages for 3 s. Without topics the list is empty
    and there is a warning.

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
        topics = [_counted(each, inbox.heard(k), k in numbers) for k, each in enumerate(known[:MOST_TOPICS])]
        warnings = [] if topics else [f"no topic was announced within {LISTEN_S:.0f} s"]
        return {"kind": "live", "topics": topics, "mount": None, "warnings": warnings}


def _counted(publisher: Publisher, heard: Heard, listened: bool) -> dict[str, Any]:
    """Return the description of a topic for the page.

    Args:
        publisher: The topic.
        heard: Number and times of its messages.
        listened: Whether its messages were counted.
    """
    why = ""
    if listened and not heard.messages and not publisher.topic.endswith("tf_static"):
        why = f"silent for {COUNT_S:g} s"
    topic = RecordedTopic(publisher.topic, publisher.msgtype, 0, "", _ROLES.get(publisher.msgtype, ""), why)
    counted = heard.messages if listened else None
    return {**asdict(topic), "messages": counted, "seconds": COUNT_S, "rate_hz": heard.rate_hz}


def _rate(messages: int, seconds: float) -> float | None:
    """Return the mean rate of messages [Hz]; None with fewer than two or without a duration."""
    return round((messages - 1) / seconds, 1) if seconds > 0.0 and messages > 1 else None


if __name__ == "__main__":
    run_child(answer, memory_limit=MEMORY_LIMIT)
