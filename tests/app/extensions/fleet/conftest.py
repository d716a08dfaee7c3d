"""The router and the robots of the live tests."""

from tests.app.robot.conftest import drive, robots, router

__all__ = ["drive", "robots", "router"]
