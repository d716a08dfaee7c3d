"""The pose graph: all keyframes and landmarks of a run, estimated together (GTSAM's iSAM2)."""

from pipeline.slam.pose_graph.graph_slam import GraphSlam
from pipeline.slam.pose_graph.smoother import Smoother
from pipeline.slam.pose_graph.state import GraphState

__all__ = ["GraphSlam", "GraphState", "Smoother"]
