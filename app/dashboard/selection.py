"""What is selected: one selection for all who look at the dashboard."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from app.explain.records import ClusterStory


@dataclass(frozen=True, slots=True)
class Selection:
    """A tree, a cluster with the tree that it is a view of, or nothing.

    Attributes:
        tree: Its number, None for none.
        cluster: The cluster as it was when it was selected, a standing picture of its scan.
    """

    tree: int | None = None
    cluster: ClusterStory | None = None

    @property
    def ring(self) -> tuple[float, float, float] | None:
        """Where the cluster stands in the map and how wide it is: x, y, radius [m]."""
        story = self.cluster
        if story is None:
            return None
        reach = max((x * x + y * y for x, y in story.points), default=0.0) ** 0.5
        return (*story.position, reach)

    def as_plain(self) -> dict[str, Any]:
        """For the browsers; the story itself is asked for by who wants to read it."""
        story = self.cluster
        if story is None:
            return {"tree": self.tree, "cluster": None}
        place = {"x": round(story.position[0], 4), "y": round(story.position[1], 4)}
        cluster = {"scan": story.scan, "cluster": story.cluster, "verdict": story.verdict, **place}
        return {"tree": self.tree, "cluster": cluster}
