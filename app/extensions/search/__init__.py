"""The extension `search`: which parameters give the best map. Grids of parameter sets (`stemmap evaluate
--param-grid`), the search (`stemmap tune`, and in the tab Tune), and the sensitivity of the score to one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from app.extension import Extension, page_folder

if TYPE_CHECKING:
    from fastapi import FastAPI


def results_in(folder: Path | None) -> Path | None:
    """Return the folder of stored results in a data folder; None without a data folder."""
    return folder and folder / "results"


def _add_routes(app: FastAPI) -> None:
    """Add the search and the sensitivity of parameters to a dashboard; both end when its run is left."""
    from app.extensions.search.page import Sensitivity, TuneSearch
    from app.extensions.search.routes import router

    dashboard = app.state.dashboard
    kept = results_in(dashboard.store.folder)
    app.state.sensitivity = Sensitivity(lambda state: dashboard.live.publish("sensitivity", state), kept=kept)
    app.state.search = TuneSearch(lambda state: dashboard.live.publish("search", state))
    dashboard.leaving += [app.state.sensitivity.leave, app.state.search.leave]
    app.include_router(router)


EXTENSION = Extension(
    help="search of parameters: grids, stemmap tune, and the search and sensitivity in the tab Tune",
    commands={"tune": "app.extensions.search.tune"},
    takes={"evaluate": "app.extensions.search.grid_command"},
    web=_add_routes,
    page=page_folder("search"),
)
