"""Camera picture of the current scan for the page. The worker finds the picture, a child process decodes and
scales it, and recent pictures are kept for other browsers."""

from __future__ import annotations

import asyncio
import time
from collections import OrderedDict
from typing import Any

import numpy as np

from app.batch.tree_pictures import stem_corners
from app.common.draw_picture import Drawing, draw_safely
from app.common.timers import RequestQueue
from app.dashboard.payload import clusters_payload
from app.dashboard.selection import NoStoryError, WorkerClient
from app.worker.protocol import CameraPicture
from pipeline.geometry.poses import Pose2, interpolate
from pipeline.types.camera import Camera
from pipeline.types.records import Float, Frame, Path, Trees

#: All browsers together get so many pictures a second at most.
_PAUSE_S = 0.3
_MOST_WAITING = 100  # the browsers of all roles
_MOST_KEPT = 8


class CameraView:
    """Camera pictures of the shown run.

    Args:
        worker_client: Requests the pictures from the worker.
    """

    def __init__(self, worker_client: WorkerClient) -> None:
        self._client = worker_client
        self._kept: OrderedDict[int, bytes] = OrderedDict()
        self._queue = RequestQueue(_PAUSE_S, _MOST_WAITING)
        # Number of the run: simulated runs have pictures of equal times. It differs after a restart as well.
        self._of = time.time_ns() // 1_000_000

    def forget(self) -> None:
        """Remove the pictures and use another number of the run, because another run begins."""
        self._kept.clear()
        self._of += 1

    def jpeg(self, stamp_ns: int) -> bytes | None:
        """Return the picture with a stamp that `look` returned as JPEG; None if it is not among the 8 newest
        any more."""
        return self._kept.get(stamp_ns)

    async def look(self, frame: Frame, path: Path | None) -> dict[str, Any]:
        """Return the description of the camera picture nearest to a scan as a dict of JSON values; `jpeg`
        returns the picture of this `stamp_ns`. Calls wait for one another, so that there are at most about
        three pictures per second.

        The keys are `index` of the scan; `of`, a number of the run; `stamp_ns`, the time of the picture as a
        string; `later_ms`, this time minus that of the scan; `marks`, the result of `marks_of`, empty if the
        camera is unknown; `why`, the reason why it is unknown, else ""; and `received`, see `CameraPicture`.

        Args:
            frame: Results of the scan.
            path: Path of the run, from which the pose of the robot at the time of the picture is
                interpolated; None assumes no motion.

        Raises:
            NoStoryError: There is no picture, it cannot be decoded, or another run was opened; the message
                has the reason.
            WorkerBusyError: The worker did not answer in time.
            TooManyRequestsError: Too many calls wait.
            StemmapError: No process that decodes it can be started.
        """
        async with self._queue.turn():
            of = self._of
            found = await self._client.camera(frame.stamp_ns)
            self._check(of)
            picture = found.picture
            if picture.stamp_ns not in self._kept:
                content = await asyncio.to_thread(draw_safely, Drawing.of(picture))
                if content is None:
                    raise NoStoryError(
                        "this picture cannot be decoded", remedy="It is damaged, or of an unknown encoding"
                    )
                self._check(of)
                self._kept[picture.stamp_ns] = content
            self._kept.move_to_end(picture.stamp_ns)  # the page asks for it next
            while len(self._kept) > _MOST_KEPT:
                self._kept.popitem(last=False)
        camera, moved = found.camera, motion(path, frame.stamp_ns, picture.stamp_ns)
        return {
            "index": frame.index,
            "of": of,
            "stamp_ns": str(picture.stamp_ns),  # more digits than a number of JavaScript has
            "later_ms": round((picture.stamp_ns - frame.stamp_ns) / 1e6),
            "marks": [] if camera is None else await asyncio.to_thread(marks_of, frame, camera, moved),
            "why": found.why,
            "received": found.received,
        }

    async def tree(self, number: int, trees: Trees, path: Path | None) -> bytes:
        """Return the part of a camera picture that shows a tree best, as JPEG, with a frame around its stem.
        Calls wait for one another and for those of `look`.

        Args:
            number: Number of the tree.
            trees: Trees of the map.
            path: Path of the run; None before the first scan.

        Raises:
            NoStoryError: No picture shows the tree, or it cannot be decoded.
            WorkerBusyError: The worker did not answer in time.
            TooManyRequestsError: Too many calls wait.
            StemmapError: No process that decodes it can be started.
        """
        async with self._queue.turn():
            found = await self._client.tree_picture(number)
            content = await asyncio.to_thread(drawn_tree, found, number, trees, path)
        if content is None:
            raise NoStoryError(f"no picture shows tree {number}", remedy="Select another")
        return content

    def _check(self, of: int) -> None:
        """Check that run number `of` is still shown.

        Raises:
            NoStoryError: Another run was opened.
        """
        if of != self._of:
            raise NoStoryError("another run was opened", remedy="Its picture comes with its first scan")


# Share of the picture around the frame of a tree that is shown, in heights of the frame.
_MARGIN = 0.6


def drawn_tree(found: CameraPicture, number: int, trees: Trees, path: Path | None) -> bytes | None:
    """Return the part of a picture around a tree as JPEG, with a frame around the stem. None if the tree is
    not in `trees` or not in the picture, the camera is unknown, the path has fewer than two poses, or the
    picture cannot be decoded. Raises StemmapError if no process can be started.

    Args:
        found: The picture with its camera.
        number: Number of the tree.
        trees: Trees of the map.
        path: Path of the run.
    """
    rows = np.flatnonzero(trees.number == number)
    camera, picture = found.camera, found.picture
    if camera is None or path is None or len(path.stamp_ns) < 2 or not len(rows):
        return None
    row = int(rows[0])
    x, y = _pose_at(path, picture.stamp_ns).inverse().apply(trees.position[row])
    box = _box(camera, stem_corners(float(x), float(y), float(trees.dbh[row])))
    if box is None:
        return None
    left, top = box["left"] * camera.width, box["top"] * camera.height
    right, bottom = left + box["width"] * camera.width, top + box["height"] * camera.height
    margin = _MARGIN * (bottom - top)
    region = (
        max(0.0, left - margin),
        max(0.0, top - margin),
        min(float(camera.width), right + margin),
        min(float(camera.height), bottom + margin),
    )
    return draw_safely(Drawing.of(picture, (left, top, right, bottom), f"tree {number}", region))


FARTHEST, NEAREST = 25.0, 0.5  # m; trees farther away are only a few pixels wide
MOST = 150


def marks_of(frame: Frame, camera: Camera, moved: Pose2) -> list[dict[str, Any]]:
    """Return boxes around the clusters and trees in a picture as a list of dicts with `kind` ("tree" or
    "cluster"), `number` of the tree or row of the cluster, `verdict`, `distance_m`, and the box, see `_box`.
    Only the MOST nearest objects have a box; clusters come before trees, and distant objects before near
    ones, so that near trees are rendered last.

    The tilt of the robot is not known here, so the boxes of trees are slightly too high or too low on a
    slope.

    Args:
        frame: Results of the scan.
        camera: Camera of the picture.
        moved: T_scan_picture of the base, because the picture was taken at another time.
    """
    found = [*_trees(frame, camera, moved), *_clusters(frame, camera, moved)]
    nearest = sorted(found, key=lambda mark: float(mark["distance_m"]))[:MOST]
    # Later boxes are drawn over earlier ones and receive the click.
    return sorted(nearest, key=lambda mark: (mark["kind"] == "tree", -float(mark["distance_m"])))


def _trees(frame: Frame, camera: Camera, moved: Pose2) -> list[dict[str, Any]]:
    """Return a list of dicts, a box for each confirmed tree in view at more than NEAREST and less than
    FARTHEST. Arguments and keys as in `marks_of`."""
    trees = frame.trees
    marks = []
    places = (frame.estimate.T_map_base @ moved).inverse().apply(trees.position)
    for row in np.flatnonzero(trees.confirmed):
        x, y = places[row]
        reach = float(np.hypot(x, y))
        if not NEAREST < reach < FARTHEST:
            continue
        box = _box(camera, stem_corners(float(x), float(y), float(trees.dbh[row])))
        if box is not None:
            number = int(trees.number[row])
            marks.append({"kind": "tree", "number": number, "verdict": "tree", "distance_m": reach, **box})
    return marks


def _clusters(frame: Frame, camera: Camera, moved: Pose2) -> list[dict[str, Any]]:
    """Return a list of dicts, a box for each cluster with points of which none is behind or close to the
    camera plane, at any distance; arguments and keys as in `marks_of`."""
    verdicts = clusters_payload(frame)["verdict"]
    points = frame.filtered.astype(np.float64) + frame.sensor_offset
    points[:, :2] = moved.inverse().apply(points[:, :2])
    order = np.argsort(frame.labels, kind="stable")
    labels = frame.labels[order]
    marks = []
    for number, verdict in enumerate(verdicts):
        first, last = np.searchsorted(labels, [number, number + 1])
        members = points[order[first:last]]
        box = _box(camera, members) if len(members) else None
        if box is not None:
            reach = float(np.hypot(*members[:, :2].mean(axis=0)))
            marks.append(
                {"kind": "cluster", "number": number, "verdict": verdict, "distance_m": reach, **box}
            )
    return marks


def _box(camera: Camera, points: Float) -> dict[str, float] | None:
    """Return the box around points of the base frame, shape (N, 3), N >= 1 [m], as a dict with "left", "top",
    "width" and "height", shares of the size of the picture from 0 to 1, clipped to the picture. None if the
    box is outside of the picture, or a point is at most NEAREST in front of the camera plane."""
    pixels, depth = camera.project(points)
    if not (depth > NEAREST).all():
        return None
    size = np.array([camera.width, camera.height])
    low, high = pixels.min(axis=0) / size, pixels.max(axis=0) / size
    if (high <= 0.0).any() or (low >= 1.0).any():
        return None
    low, high = np.clip(low, 0.0, 1.0), np.clip(high, 0.0, 1.0)
    left, top, width, height = (round(float(v), 4) for v in (*low, *(high - low)))
    return {"left": left, "top": top, "width": width, "height": height}


#: Time at an end of the path over which the velocity is averaged for extrapolation [ns]. Over a shorter time,
#: corrections of single poses would appear as velocity.
_STEADY_NS = 500_000_000


def motion(path: Path | None, from_ns: int, to_ns: int) -> Pose2:
    """Return `T_from_to` of the base between two times; the identity if the path has fewer than two poses.

    Within the path, poses are interpolated; outside, the velocities at its end are extrapolated.

    Args:
        path: Path of the run, or None.
        from_ns, to_ns: The times [ns].
    """
    if path is None or len(path.stamp_ns) < 2:
        return Pose2()
    return _pose_at(path, from_ns).inverse() @ _pose_at(path, to_ns)


def _pose_at(path: Path, stamp_ns: int) -> Pose2:
    """Return `T_map_base` at a time [ns]: interpolated within the path, and extrapolated with the mean
    velocity over _STEADY_NS at its ends. The path has at least two poses."""
    stamps = path.stamp_ns
    first, last = 0, len(stamps) - 1
    if stamp_ns <= stamps[first]:
        last = max(1, int(np.searchsorted(stamps, stamps[first] + _STEADY_NS, side="right")) - 1)
    elif stamp_ns >= stamps[last]:
        first = min(last - 1, int(np.searchsorted(stamps, stamps[last] - _STEADY_NS)))
    else:
        last = int(np.searchsorted(stamps, stamp_ns))
        first = last - 1
    begin, end = (Pose2(*(float(axis[k]) for axis in (path.x, path.y, path.yaw))) for k in (first, last))
    part = float(stamp_ns - stamps[first]) / float(max(1, stamps[last] - stamps[first]))
    if part < 0.0 or part > 1.0:
        return _held(begin, end, part)
    return interpolate(begin, end, part)


def _held(begin: Pose2, end: Pose2, part: float) -> Pose2:
    """Return the pose that continues the motion between two poses with constant velocities: before `begin`
    (part < 0) or beyond `end` (part > 1).

    Args:
        begin, end: The poses.
        part: Time as a fraction of the time between the poses.
    """
    moved = begin.inverse() @ end
    rest = part if part < 0.0 else part - 1.0
    turn = rest * moved.yaw
    start = begin if part < 0.0 else end
    # Half the turn is made halfway: the chord of the arc of constant velocities (midpoint rule).
    along = Pose2(0.0, 0.0, 0.5 * turn - 0.5 * moved.yaw).apply(np.array([[rest * moved.x, rest * moved.y]]))[
        0
    ]
    return start @ Pose2(float(along[0]), float(along[1]), turn)
