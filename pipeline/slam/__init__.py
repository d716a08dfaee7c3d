"""SLAM: the path of the robot and the landmarks from which it is estimated (Eq. 5-7)."""

from pipeline.slam.fastslam import FastSlam
from pipeline.slam.keyframe_graph import KeyframeGraph, Loop
from pipeline.slam.motion import Motion
from pipeline.slam.particle_ancestry import Genealogy
from pipeline.slam.state import SlamState

__all__ = [
    "FastSlam",
    "Genealogy",
    "KeyframeGraph",
    "Loop",
    "Motion",
    "SlamState",
]
