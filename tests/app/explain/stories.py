"""Example stories."""

from __future__ import annotations

from typing import Any

import msgspec

from app.explain.records import (
    CheckResult,
    Circle,
    ClusterStory,
    ColumnStory,
    FeatureEffect,
    History,
    TreeStory,
)

TOO_LONG = CheckResult(
    "eccentricity", "", 99.0, "at most", 60.0, "detection.e_max", "Eccentricity max", True, "too long"
)
GATHERED = ColumnStory(
    verdict="tree",
    distance=0.1,
    votes={"tree": 0.9, "pole": 0.1},
    tree_share=0.45,
    tree_in_free_air=None,
    by_votes=True,
    present=9,
    absent=1,
    absent_lately=0,
    viewed=4.0,
    effects=[FeatureEffect("tilt", 0.01, 0.2)],
)


def cluster_story(**fields: Any) -> ClusterStory:
    story = ClusterStory(
        scan=231,
        cluster=4,
        time_s=23.1,
        verdict="too long",
        checks=[
            CheckResult(
                "eccentricity", "", 99.0, "at most", 60.0, "detection.e_max", "Eccentricity max", True, "x"
            )
        ],
        size=3,
        eccentricity=99.0,
        position=(3.0, 4.0),
        distance=5.0,
        sensor_sigma=0.02,
        points=[(0.1, 0.0), (0.3, 0.4), (0.0, 0.0)],
        residual=[0.01, -0.01, 0.0],
        circle=Circle(0.2, 0.01, 90.0, 0.0, 1.57, (0.01, 0.02), 1.3, (0.02, 0.01, 0.5)),
        axes=[(0.1, 0.0), (0.0, 0.01)],
        tree=12,
        column=GATHERED,
    )
    return msgspec.structs.replace(story, **fields)


def tree_story(number: int) -> TreeStory:
    return TreeStory(
        tree=number,
        scan=231,
        time_s=23.1,
        confirmed=True,
        position=(1.0, 2.0),
        ellipse=(0.02, 0.01, 0.3),
        dbh=0.3,
        dbh_sigma=0.01,
        coverage_deg=200.0,
        dbh_arc_deg=180.0,
        sides=[True] * 20 + [False] * 16,
        eccentricity=5.0,
        observations=40,
        first_seen_s=0.5,
        last_seen_s=23.0,
        cluster=None,
        column=None,
        points=[(0.15, 0.0, 1.3)],
        history=History([0.5], [1.0], [2.0], [0.02], [0.01], [0.3], [0.3], [0.01]),
        extensions={"lines": {"height": 14.0}},
    )
