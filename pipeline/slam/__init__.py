"""SLAM: the path of the robot and the landmarks that it was found by (Eq. 5-7)."""

from pipeline.slam.back_end import BackEnd, BackEndState
from pipeline.slam.fastslam import FastSlam
from pipeline.slam.loop_correction import Loop
from pipeline.slam.motion import Motion
from pipeline.slam.particle_ancestry import Genealogy
from pipeline.slam.pose_graph import GraphState, Smoother
from pipeline.slam.state import SlamState

__all__ = [
    "BackEnd",
    "BackEndState",
    "FastSlam",
    "Genealogy",
    "GraphState",
    "Loop",
    "Motion",
    "SlamState",
    "Smoother",
]
