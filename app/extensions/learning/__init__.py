"""The extension `learning`: training of the random forest that classifies columns, with annotations."""

from __future__ import annotations

from typing import TYPE_CHECKING

from app.extension import Extension, page_folder

if TYPE_CHECKING:
    from fastapi import FastAPI

#: Annotated trees and other objects that a training needs.
LEAST_TREES, LEAST_OTHERS = 10, 5


def _add_routes(app: FastAPI) -> None:
    """Add the training and its routes to a dashboard."""
    from app.extensions.learning.page import Learning
    from app.extensions.learning.routes import router

    dashboard, settings = app.state.dashboard, app.state.settings
    app.state.learning = learning = Learning(
        dashboard.store, settings.folder, lambda state: dashboard.live.publish("learning", state)
    )
    app.state.closing.append(learning.close)
    app.include_router(router)


EXTENSION = Extension(
    help="training of the classifier with annotations: stemmap train, and Learn in the tab Annotate",
    commands={"train": "app.extensions.learning.train"},
    web=_add_routes,
    page=page_folder("learning"),
)
