"""The parameters of each stage. The defaults are the preset `forest`."""

from pipeline.config.stages.pose import Relocalisation, Slam
from pipeline.config.stages.safety import Obstacles
from pipeline.config.stages.scan import Acquisition, Clustering, Detection, Filters, Ground, Shape
from pipeline.config.stages.trees import Evaluation, Gathering, Tracking

__all__ = [
    "Acquisition",
    "Clustering",
    "Detection",
    "Evaluation",
    "Filters",
    "Gathering",
    "Ground",
    "Obstacles",
    "Relocalisation",
    "Shape",
    "Slam",
    "Tracking",
]
