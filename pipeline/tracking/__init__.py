"""Tracking: a Kalman filter per tree (Eq. 10) on the data association of SLAM, and attributes of trees."""

from pipeline.tracking.tracker import Tracker

__all__ = ["Tracker"]
