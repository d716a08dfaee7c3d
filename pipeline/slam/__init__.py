"""SLAM: the path of the robot and the landmarks that it was found by (Eq. 5-7)."""

from pipeline.slam.fastslam import FastSlam
from pipeline.slam.motion import Motion
from pipeline.slam.state import SlamState

__all__ = ["FastSlam", "Motion", "SlamState"]
