"""What people chose to see in the scene."""

from __future__ import annotations

from dataclasses import dataclass, field

COLOUR_BY = ("verdict", "stage", "cluster", "height", "eccentricity")
LABEL_BY = ("eccentricity", "verdict", "DBH", "none")
LAYERS = {
    "raw": "Raw scan",
    "filtered": "Filtered",
    "clusters": "Clusters",
    "fits": "Fitted circles",
    "labels": "Labels",
    "particles": "Particles",
    "path": "Path",
    "odometry": "Path by odometry",
    "trees": "Trees",
    "truth": "Ground truth",
}


@dataclass(slots=True)
class View:
    """The choices of the Layers panel; shared by all browsers that look at the scene."""

    colour_by: str = COLOUR_BY[0]
    label_by: str = LABEL_BY[0]
    follow: bool = True
    layers: dict[str, bool] = field(default_factory=lambda: {name: name != "odometry" for name in LAYERS})
