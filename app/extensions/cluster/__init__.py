"""The extension `cluster`: many runs, on this machine or on others by Dask."""

from __future__ import annotations

from app.extension import Extension

_FLAG = "app.extensions.cluster.dask_flag"

EXTENSION = Extension(
    help="many runs: stemmap map FOLDER_OF_RUNS, and --dask ADDRESS for map, evaluate and tune",
    takes={"map": "app.extensions.cluster.map_command", "evaluate": _FLAG, "tune": _FLAG},
)
