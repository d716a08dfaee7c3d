"""How routes reach the dashboard."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends
from starlette.requests import HTTPConnection

from app.dashboard.dashboard import Dashboard


def _dashboard(connection: HTTPConnection) -> Dashboard:
    dashboard: Dashboard = connection.app.state.dashboard
    return dashboard


Dash = Annotated[Dashboard, Depends(_dashboard)]
