"""Routes of the training of decision trees with annotations."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter
from starlette.responses import Response

from app.extensions.learning.page import Learning
from app.web.responses import json_reply
from app.web.routes.access import Dash, of_app
from pipeline.errors import StemmapError

router = APIRouter(prefix="/api")
Trainer = Annotated[Learning, of_app("learning")]


@router.get("/learning")
async def learning_state(learning: Trainer, dashboard: Dash) -> Response:
    """GET /api/learning: return the numbers of annotations that a training can use, and its progress, see
    `Learning.known`."""
    in_force = dashboard.parameters.parameters.classification.forest
    return json_reply(await learning.known(in_force))


@router.post("/learning")
async def start_learning(learning: Trainer, dashboard: Dash) -> Response:
    """POST /api/learning: start to train new decision trees with all annotations, and return the progress,
    with 202. They are not used before `POST /api/learning/use`. 409 while a training runs or without a data
    folder."""
    await learning.begin(dashboard.parameters.parameters)
    return json_reply(learning.as_plain(), 202)


@router.delete("/learning")
async def stop_learning(learning: Trainer) -> Response:
    """Stop the training, or discard its result, and return the progress; the decision trees in force stay,
    and so does the file of trained ones."""
    await learning.forget()
    return json_reply(learning.as_plain())


@router.post("/learning/use")
async def use_learned(learning: Trainer, dashboard: Dash) -> Response:
    """POST /api/learning/use: classify with the new decision trees, as a change of parameters; return the
    progress of the training. 409 if there are none."""
    learned = learning.learned
    if learned is None:
        raise StemmapError("no decision trees were trained", remedy="Train them first")
    await dashboard.change_parameters({"classification.forest": learned["name"]})
    return json_reply(learning.as_plain())
