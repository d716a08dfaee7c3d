"""What a robot that maps by itself publishes, put together for the page of the fleet."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np

from pipeline.io.recording import outputs
from pipeline.types.clearance import Zone

#: What is looked at of a message: more trees or poses no page shows.
MOST_TREES, MOST_POSES = 5000, 400
_RATE_OVER = 20
#: The topics that are listened to.
TOPICS = (outputs.ODOMETRY, outputs.PATH, outputs.DETECTIONS, outputs.CLEARANCE, outputs.ZONE)
UNREADABLE = "messages that could not be read"


class Results:
    """The newest results of one robot.

    Args:
        unreadable: Messages that were left out before.

    Attributes:
        losses: Messages that were left out, by reason.
    """

    def __init__(self, unreadable: int = 0) -> None:
        self.losses: dict[str, int] = {UNREADABLE: unreadable} if unreadable else {}
        self._pose = [0.0, 0.0, 0.0]
        self._path: list[list[float]] = []
        self._trees: list[dict[str, Any]] = []
        self._ahead: float | None = None
        self._zone: str | None = None
        self._within = 0.0
        self._came_s: deque[float] = deque(maxlen=_RATE_OVER)

    def take(self, topic: str, payload: bytes, now_s: float) -> None:
        """Take a message of one of TOPICS; what cannot be read is counted."""
        try:
            message = outputs.store().deserialize_cdr(payload, outputs.TYPES[topic])
            self._take(topic, message, now_s)
        except Exception:  # whatever a stranger's bytes do to a decoder
            self.losses[UNREADABLE] = self.losses.get(UNREADABLE, 0) + 1

    def _take(self, topic: str, message: Any, now_s: float) -> None:  # noqa: ANN401
        match topic:
            case outputs.ODOMETRY:
                self._pose = _finite(*_placed(message.pose.pose))
                self._came_s.append(now_s)
            case outputs.PATH:
                step = max(1, -(-len(message.poses) // MOST_POSES))
                self._path = [_finite(*_placed(each.pose)[:2]) for each in message.poses[::-step][::-1]]
            case outputs.DETECTIONS:
                self._trees = [_tree(each) for each in message.detections[:MOST_TREES]]
            case outputs.CLEARANCE:
                ahead, (within,) = float(message.range), _finite(float(message.max_range))
                self._ahead = round(ahead, 3) if math.isfinite(ahead) else None
                self._within = within
            case outputs.ZONE:
                self._zone = Zone(int(message.data)).label

    def as_plain(self, now_s: float) -> dict[str, Any]:
        """For the page: how old the newest pose is, the figures, and the map as `shown_map` gives it."""
        path = np.array([*self._path, self._pose[:2]])
        steps = np.diff(path, axis=0)
        heard = self._came_s
        since = now_s - heard[-1] if heard else None
        rate = (len(heard) - 1) / max(heard[-1] - heard[0], 1e-3) if len(heard) > 1 else 0.0
        clearance = {
            "zone": self._zone,
            "ahead_m": self._ahead,
            "beside_m": None,
            "within_m": self._within,
        }
        return {
            "silence_s": since,
            "rate_hz": round(rate, 1),
            "distance_m": round(float(np.hypot(steps[:, 0], steps[:, 1]).sum()), 1),
            "clearance": clearance if self._zone is not None else None,
            "unreadable": self.losses.get(UNREADABLE, 0),
            "map": {"trees": self._trees, "path": self._path, "pose": self._pose},
        }


def _placed(pose: Any) -> tuple[float, float, float]:  # noqa: ANN401
    """x, y and yaw of a geometry_msgs/Pose."""
    q = pose.orientation
    yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
    return float(pose.position.x), float(pose.position.y), yaw


def _finite(*values: float) -> list[float]:
    """The values, to the millimetre.

    Raises:
        ValueError: One is no number.
    """
    if not all(math.isfinite(value) and abs(value) < 1e7 for value in values):
        raise ValueError("not a place")
    return [round(value, 3) for value in values]


def _tree(detection: Any) -> dict[str, Any]:  # noqa: ANN401
    """A tree of a vision_msgs/Detection3D, as the page has trees."""
    centre, width = detection.bbox.center.position, float(detection.bbox.size.x)
    x, y = _finite(float(centre.x), float(centre.y))
    covariance = np.asarray(detection.results[0].pose.covariance, np.float64)
    sigma = _finite(math.sqrt(max(float(max(covariance[0], covariance[7])), 0.0)))[0]
    return {
        "x": x,
        "y": y,
        "ellipse": [sigma, sigma, 0.0],
        "dbh_cm": round(100.0 * width, 1) if 0.0 < width < 10.0 else None,
        "sigma_dbh_cm": None,
    }
