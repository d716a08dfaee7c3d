"""Choices of which one needs a package that is not installed by itself."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Annotated, Literal

from pydantic import AfterValidator


def _has_its_extra(method: str) -> str:
    if method == "graph" and find_spec("gtsam") is None:
        raise ValueError(
            "slam.method = graph needs GTSAM, which is not installed. Install the extra: "
            "pip install 'stemmap[graph]', or in a clone `uv sync --extra graph`"
        )
    return method


SlamMethod = Annotated[Literal["fastslam1", "fastslam2", "graph"], AfterValidator(_has_its_extra)]
