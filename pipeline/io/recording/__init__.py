"""Recordings: MCAP files of standard ROS 2 messages."""

from pipeline.io.recording.mcap_writer import write_recording

__all__ = ["write_recording"]
