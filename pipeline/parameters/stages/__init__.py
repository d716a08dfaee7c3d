"""The parameters of each stage. The defaults are the preset `forest`."""

from pipeline.parameters.stages.pose import Relocalisation, Slam
from pipeline.parameters.stages.safety import Obstacles
from pipeline.parameters.stages.scan import Acquisition, Clustering, Detection, Filters, Ground, Shape
from pipeline.parameters.stages.trees import Evaluation, Gathering, Tracking

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
