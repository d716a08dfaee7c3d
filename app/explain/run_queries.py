"""The stories of an opened run."""

from __future__ import annotations

import numpy as np

from app.explain.build import tell_cluster, tell_tree
from app.explain.records import ClusterStory, TreeStory
from app.worker.run import Run
from pipeline.errors import StemmapError
from pipeline.types.records import Frame


def cluster_story(run: Run | None, frame: Frame, cluster: int) -> ClusterStory:
    """See `Session.cluster_story`."""
    if run is None or not 0 <= cluster < len(frame.clusters.size):
        raise StemmapError(f"there is no cluster {cluster}", where=f"scan {frame.index}")
    parameters = run.parameters_at(frame.index)
    return tell_cluster(frame, cluster, parameters, run.source.description.sensor, run.start_ns)


def tree_story(run: Run | None, number: int) -> TreeStory:
    """See `Session.tree_story`."""
    frame = run.frame if run else None
    row = np.flatnonzero(frame.trees.number == number) if frame else np.zeros(0, np.int64)
    if run is None or frame is None or not len(row):
        raise StemmapError(
            f"tree {number} is not known at this time of the run", remedy="Play on, or select another"
        )
    parameters, sensor = run.parameters_at(frame.index), run.source.description.sensor
    return tell_tree(frame, int(row[0]), parameters, sensor, run.start_ns, run.history)
