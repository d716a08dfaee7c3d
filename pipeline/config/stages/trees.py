"""The parameters of the trees: what is gathered, tracked and judged over many scans."""

from __future__ import annotations

from typing import Literal

from pipeline.config.declare import Stage, choice, count, name, number


class Gathering(Stage):
    """Gathering: what all scans together say of each place; the verdict on a tree is taken there."""

    method: Literal["none", "columns"] = choice(
        "columns",
        "Verdict on a tree",
        "By the columns that the scans gathered over height, or none: by the number of hits alone.",
    )
    range_max: float = number(
        25.0, "Gathered within", "m", 1.0, 100.0, 1.0, "Returns farther away are not gathered."
    )
    every: int = count(
        4,
        "Gather every so many scans",
        "",
        1,
        100,
        "Of so many scans one is gathered (the first ten all are); the scans between show the same trunks.",
    )
    voxels_log2: int = count(
        19,
        "Memory",
        "",
        12,
        24,
        "Room for 2 to this power voxels; when full, the oldest half is forgotten.",
    )
    tree_share: float = number(
        0.4, "Votes for a tree", "", 0.0, 1.0, 0.05, "A column is a tree from this share of the votes on."
    )
    forest: str = name(
        "package",
        "Decision trees",
        r"^(package|[0-9a-f]{16})$",
        "Those that vote: of the package, or the name of some that were learned from annotations.",
    )


class Tracking(Stage):
    """Tracking: a Kalman filter per tree (Eq. 10) and merging."""

    engine: Literal["compiled", "filterpy"] = choice(
        "compiled", "Kalman engine", "Our compiled filter or filterpy's; both give the same numbers."
    )
    velocity_sigma: float = number(
        0.0,
        "Velocity sigma",
        "m/s",
        0.0,
        5.0,
        0.01,
        "Velocity that a new tree may have; 0 keeps trees still.",
    )
    acceleration_sigma: float = number(
        0.0, "Acceleration sigma", "m/s²", 0.0, 5.0, 0.001, "How much a tree's velocity may wander."
    )
    gate: float = number(
        4.0, "Gate", "sigma", 0.5, 20.0, 0.1, "A detection farther from a tree than this starts another."
    )
    distance_max: float = number(
        0.6, "Association reach", "m", 0.05, 10.0, 0.05, "No detection joins a tree farther away than this."
    )
    proximity_radius: float = number(
        0.4, "Proximity radius", "m", 0.0, 10.0, 0.05, "Trees nearer to one another than this are one tree."
    )
    hits_to_confirm: int = count(
        3,
        "Hits to confirm",
        "",
        1,
        200,
        "A tree is shown and exported when it was seen so often, or stands out of what was gathered.",
    )
    misses_per_hit: int = count(
        1, "Misses per hit", "", 1, 100, "So many misses in free view undo one hit; without hits a tree goes."
    )
    dbh_arc_min: float = number(
        180.0, "Arc for a DBH", "deg", 0.0, 360.0, 10.0, "A diameter is told from this much of the trunk on."
    )
    breast_height: float = number(
        1.3,
        "Breast height",
        "m",
        0.1,
        5.0,
        0.05,
        "Height above the ground that a tree's diameter is told for.",
    )
    out_of_round: float = number(
        0.025,
        "Out of round",
        "",
        0.0,
        0.2,
        0.005,
        "How far stems are not round, as a part of the diameter; its sigma stays above this part.",
    )
    taper_sigma: float = number(
        0.02,
        "Taper sigma",
        "m/m",
        0.0,
        0.1,
        0.005,
        "How differently stems swell or taper, of the diameter per metre that views lie off breast height.",
    )


class Evaluation(Stage):
    """Evaluation: how the map is compared with the ground truth."""

    match_distance: float = number(
        0.5, "Match distance", "m", 0.05, 5.0, 0.05, "A tree farther from its truth than this is no match."
    )
    reach: float = number(
        10.0, "Reach", "m", 1.0, 200.0, 0.5, "Truth farther than this from the whole path is not asked for."
    )
