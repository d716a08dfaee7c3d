"""Simulated runs: a stand, a robot that drives through it, and what its sensors give.

The same scenario and seed always give the same bytes. World and map are one frame: the first true
pose of the robot is the origin, x ahead, y left, z against gravity.
"""
