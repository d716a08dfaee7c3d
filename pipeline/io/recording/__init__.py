"""Recordings: MCAP files of standard ROS 2 messages."""
