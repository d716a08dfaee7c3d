"""The parameters of where the robot is: SLAM and coming back to a known place."""

from __future__ import annotations

from typing import Literal

from pipeline.config.declare import Stage, choice, count, number
from pipeline.config.optional_packages import SlamMethod


class Slam(Stage):
    """SLAM: FastSLAM with a map per particle (Eq. 5-7), or a pose graph."""

    method: SlamMethod = choice(
        "fastslam2", "Method", "FastSLAM by odometry (1.0), by the scan too (2.0), or a pose graph (extra)."
    )
    particles: int = count(100, "Particles", "", 1, 5000, "How many hypotheses of the path are kept.")
    noise_distance: float = number(
        0.03,
        "Position noise",
        "m/√m",
        0.0,
        1.0,
        0.005,
        "Error of the odometry after one metre; it grows with the root of the distance.",
    )
    noise_turn_distance: float = number(
        0.4,
        "Heading noise",
        "deg/√m",
        0.0,
        30.0,
        0.1,
        "Error of the heading after one metre; it grows with the root of the distance.",
    )
    noise_turn: float = number(
        2.0,
        "Turn noise",
        "deg/√rad",
        0.0,
        60.0,
        0.1,
        "Error of the heading after turning by one radian; it grows with the root of the turn.",
    )
    gate: float = number(
        3.5, "Gate", "sigma", 0.5, 20.0, 0.1, "A detection farther from a landmark than this is another tree."
    )
    distance_max: float = number(
        1.0, "Association reach", "m", 0.05, 20.0, 0.05, "No association over more than this distance."
    )
    hits_to_weigh: int = count(
        3, "Hits before it weighs", "", 1, 50, "A landmark seen fewer times does not weigh particles."
    )
    view_range: float = number(
        15.0,
        "View range",
        "m",
        0.0,
        100.0,
        0.5,
        "A landmark nearer than this, in free view and not detected, counts as missed; 0 is off.",
    )
    misses_per_hit: int = count(
        3,
        "Misses per hit",
        "",
        1,
        100,
        "So many misses undo one hit; a landmark without hits left is removed.",
    )
    miss_weight: float = number(
        0.0,
        "Weight of a miss",
        "",
        0.0,
        5.0,
        0.05,
        "What a well known landmark in free view that is not detected takes from a particle's log weight.",
    )
    weight_power: float = number(
        0.1,
        "Weight power",
        "",
        0.01,
        1.0,
        0.05,
        "Power of a scan's likelihood in the weights; 1 takes the views of one trunk as independent.",
    )
    looks: float = number(
        100.0,
        "Independent looks",
        "",
        1.0,
        10000.0,
        1.0,
        "Views of a trunk share their error: a landmark is never known better than by so many of them.",
    )
    merge_gate: float = number(
        1.0,
        "Merge gate",
        "sigma",
        0.0,
        10.0,
        0.1,
        "Two landmarks nearer than this, of which a scan sees one alone, become one; 0 is off.",
    )
    resample_below: float = number(
        0.5,
        "Resample below",
        "",
        0.0,
        1.0,
        0.05,
        "Resample when N_eff falls below this part of the particles.",
    )
    update_distance: float = number(
        0.0, "Update every", "m", 0.0, 10.0, 0.05, "Use a scan only after this much motion; 0 uses all."
    )


class Relocalisation(Stage):
    """Relocalisation: where a constellation of stems stands in a map that is known."""

    method: Literal["none", "constellation"] = choice(
        "constellation",
        "When lost",
        "Search the map for the stems around by the distances between them, or map on as if nothing were.",
    )
    stems_min: int = count(
        6, "Stems in agreement", "", 4, 100, "No pose is taken that fewer stems agree with."
    )
    slack: float = number(
        0.1, "Slack", "m", 0.0, 1.0, 0.01, "How far a map may be bent over a constellation (one sigma)."
    )
