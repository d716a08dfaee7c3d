"""Recordings of our own: records in, an MCAP of standard ROS 2 messages out."""

from pipeline.io.recording.mcap_writer import write_recording

__all__ = ["write_recording"]
