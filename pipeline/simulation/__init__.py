"""Simulated runs: scenes, a robot that drives through them, and the readings of its sensors.

The same scenario and seed give the same bytes. World and map are the same frame: the first true pose of the
robot is the origin, x points ahead, y to the left, z up.
"""
