"""Tracking: a Kalman filter per tree (Eq. 10), what was gathered of it, and merging."""

from pipeline.tracking.tracker import Tracker

__all__ = ["Tracker"]
