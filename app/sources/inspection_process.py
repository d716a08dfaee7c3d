"""The child process that inspects files and robots from outside: `python -m app.sources.inspection_process`.

`app.sources.opening.ask` starts it and asks one of `QUESTIONS`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict
from math import degrees, radians
from pathlib import Path
from typing import Any

import msgspec

from app.common.child_process import ParentConnection, run_child
from app.robot.address import is_live, parse_address
from app.robot.link import CountingInbox, Heard
from app.robot.source import link_for
from app.robot.topics import Publisher, countable
from app.sources.opening import MEMORY_LIMIT, is_cloud, open_cloud, open_source
from app.sources.request import LONGEST_URI, SourceRequest, with_odometry
from app.sources.topic_details import topic_details
from pipeline.errors import SourceError, StemmapError
from pipeline.io.readers.base import RecordedTopic
from pipeline.io.readers.topics import TYPES_BY_ROLE
from pipeline.odometry.synchroniser import steps

HYPOTHESES = 1_000_000


def recording(question: dict[str, Any]) -> dict[str, Any]:
    """Return {"kind": format} of a recording, detected from its contents; that of a whole cloud begins with
    "whole cloud, ".

    Args:
        question: The key "path" has the path.

    Raises:
        SourceError: The recording cannot be read.
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
    import numpy as np

    from app.batch.run_folder import damaged_record, read_run
    from app.batch.summary import lost_share
    from app.dashboard.payload import trees_payload
    from app.dashboard.run_recorder import thinned

    run = read_run(Path(question["path"]))
    record = run.record
    try:
        scans, time_s = int(record.get("scans") or 0), float(record.get("duration_s") or 0.0)
        lost = lost_share(record.get("health", {}).get("scans", {}))
    except (ValueError, TypeError, AttributeError, OverflowError):
        raise damaged_record(Path(question["path"])) from None
    path_xy = np.stack([run.path.x, run.path.y], axis=1)
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
        "distance_m": float(np.hypot(*np.diff(path_xy, axis=0).T).sum()) if len(path_xy) else 0.0,
        "lost": lost,
        "trees": len(trees),
        "rejected": run.rejected,
        "preset": str(record.get("preset", ""))[:100],
        "parameters": run.parameters.flat(),
        "scores": _scores(record.get("evaluation")),
        "map": {"trees": trees, "path": thinned(path_xy), "truth": None},
    }


def plots(question: dict[str, Any]) -> dict[str, Any]:
    """Return {"plots": [...]}, a list of a dict for each plot of a GIS file, with `name` and `polygons`.
    `polygons` are the coordinates of a GeoJSON MultiPolygon in the frame of the map of a run [m], rounded to
    1 mm, without the last corner of each ring, which repeats the first.

    Args:
        question: The key "path" has the file, "run" the folder of the run, and "crs" the reference system of
            a file without one, "local" or "".

    Raises:
        StemmapError: See `app.batch.run_edits.read_plots`.
    """
    import shapely

    from app.batch.run_edits import read_plots

    found = read_plots(Path(question["path"]), Path(question["run"]), crs=question["crs"] or None)
    rows = []
    for plot in found:
        parts = getattr(plot.shape, "geoms", [plot.shape])
        rings = [[part.exterior, *part.interiors] for part in parts]
        corners = [[shapely.get_coordinates(ring)[:-1].round(3).tolist() for ring in part] for part in rings]
        rows.append({"name": plot.name, "polygons": corners})
    return {"plots": rows}


def georeference(question: dict[str, Any]) -> dict[str, Any]:
    """Return the reference system of a map as a dict: `frame`, see `app.batch.georeference.MapFrame.record`,
    and `points`, a list of the fields of each `ControlPoint` ([] for methods without control points). Nothing
    is written.

    Args:
        question: The key "path" has the folder of the run, "crs" the reference system, and "how" is
            "control", with the control points as `points` or in the CSV file `table` ("" for none), and
            `point_sigma` [m]; "gnss", with the time of the first scan as `start_ns`; or "hand", with the
            position of the origin as `east`, `north` and `z` [m] and `turn_deg`.

    Raises:
        StemmapError: See `app.batch.georeference`.
    """
    from app.batch import georeference as geo

    folder, crs, how = Path(question["path"]), geo.projected(question["crs"]), question["how"]
    points: list[geo.ControlPoint] = []
    if how == "control":
        points = [geo.ControlPoint(**point) for point in question["points"]]
        if question["table"]:
            points = geo.read_control_points(Path(question["table"]), crs)
        frame = geo.by_control_points(folder, points, crs, question["point_sigma"])
    elif how == "gnss":
        frame = geo.by_gnss(folder, crs, question["start_ns"])
    else:
        east, north, z = (question[name] for name in ("east", "north", "z"))
        frame = geo.by_hand(folder, crs, east, north, radians(question["turn_deg"]), z)
    return {"frame": frame.record(), "points": [asdict(point) for point in points]}


def cloud(question: dict[str, Any]) -> dict[str, Any]:
    """Write the cloud of a run to a file; return {}.

    Args:
        question: The key "path" has the folder of the run, and "file" the .laz file.

    Raises:
        StemmapError: See `app.batch.mapped_cloud.write_cloud`.
    """
    from app.batch.mapped_cloud import write_cloud

    write_cloud(Path(question["path"]), Path(question["file"]))
    return {}


def report(question: dict[str, Any]) -> dict[str, Any]:
    """Write the report of a run to a file; return {}.

    Args:
        question: The key "path" has the folder of the run, "file" the .html or .pdf file, "language" the
            language of the report, "plots" a list of [name, GeoJSON geometry] in the coordinates of the files
            of the run, and "parameters" the values of `Stand`.

    Raises:
        StemmapError, OSError: See `app.batch.report`.
    """
    import shapely

    from app.batch.report import report_page, write_report
    from pipeline.config.stages import Stand
    from pipeline.stand.plots import SamplePlot

    page = report_page(
        Path(question["path"]),
        language=question["language"],
        plots=[SamplePlot(name, shapely.geometry.shape(shape)) for name, shape in question["plots"]],
        parameters=Stand.model_validate(question["parameters"]),
    )
    write_report(page, Path(question["file"]))
    return {}


def visits(question: dict[str, Any]) -> dict[str, Any]:
    """Return the comparison of two visits of a stand, aligned by their stems if possible, else compared as if
    their frames were equal.

    Args:
        question: `paths` are two folders of runs or tables of trees, the earlier one first, `names` their
            names for errors; `same_frame` states whether their frames are equal.

    Returns:
        A dict with `how`, how the visits were aligned, or why they were not; `aligned`, whether they are
        aligned or share their frame; `pose`, [x [m], y [m], yaw [rad]] of the later visit in the frame of the
        earlier one; `rows`, see `app.batch.revisit.rows_of`; `csv`, the rows as CSV text; `places_b`, a dict
        from the number (as text) of each tree of the later visit to its position [x, y] [m] in the frame of
        the earlier one; and `record`, see `comparison_record`.

    Raises:
        StemmapError: The files of a visit cannot be read; the error names the visit by its name.
    """
    from app.batch.revisit import compare, comparison_csv, comparison_record, read_visit, rows_of

    read = []
    for path, name in zip(question["paths"], question["names"], strict=True):
        try:
            read.append(read_visit(Path(path), may_be_empty=True))
        except StemmapError as error:
            raise StemmapError(error.what, where=name, remedy=error.remedy) from None
    a, b = read
    how, aligned = "same recording", True
    try:
        found = compare(a, b, same_frame=question["same_frame"])
        if not question["same_frame"]:
            how = f"aligned by {found.stems} stems"
    except StemmapError as error:
        found, how, aligned = compare(a, b, same_frame=True), f"not aligned: {error.what}", False
    rows, places = rows_of(a, b, found), found.T_a_b.apply(b.trees.position)
    return {
        "how": how,
        "aligned": aligned,
        "pose": [found.T_a_b.x, found.T_a_b.y, found.T_a_b.yaw],
        "rows": rows,
        "csv": comparison_csv(rows),
        "places_b": {
            str(number): place
            for number, place in zip(b.trees.number.tolist(), places.round(3).tolist(), strict=True)
        },
        "record": comparison_record(a, b, found),
    }


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
    "plots": plots,
    "georeference": georeference,
    "cloud": cloud,
    "report": report,
    "visits": visits,
    "alignment": alignment,
}


def answer(parent: ParentConnection) -> None:
    """Receive one question of the parent process and send its answer, a dict. Exceptions, also that of an
    unknown question, are raised and end the process."""
    question = parent.receive(dict)
    parent.send(QUESTIONS[question["ask"]](question))


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
        SourceError: The source cannot be read, or is a whole cloud.
    """
    if is_cloud(uri):
        raise SourceError("a whole cloud has no topics", where=uri, remedy="Open it as it is")
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
    kind is "live" and `mount` None. It waits for topics, up to LISTEN_S or 1.5 s after the last new one, then
    counts messages of the usable topics for COUNT_S. Without topics, also because there is no connection, the
    list is empty and there is a warning.

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
    """Return the description of a topic as a dict: the fields of a `RecordedTopic`, of which `messages` is
    the number of counted messages (None if they were not counted); `seconds`, the time of counting [s]; and
    `rate_hz`.

    Args:
        publisher: The topic.
        heard: Number and times of the messages of the topic.
        listened: Whether its messages were counted.
    """
    why = ""
    if listened and not heard.messages and not publisher.topic.endswith("tf_static"):
        why = f"silent for {COUNT_S:g} s"
    topic = RecordedTopic(publisher.topic, publisher.msgtype, 0, "", _ROLES.get(publisher.msgtype, ""), why)
    counted = heard.messages if listened else None
    return {**asdict(topic), "details": [], "messages": counted, "seconds": COUNT_S, "rate_hz": heard.rate_hz}


def _rate(messages: int, seconds: float) -> float | None:
    """Return the mean rate of messages [Hz], one decimal; None with fewer than two or without a duration."""
    return round((messages - 1) / seconds, 1) if seconds > 0.0 and messages > 1 else None


if __name__ == "__main__":
    run_child(answer, memory_limit=MEMORY_LIMIT)
