"""What people chose to see in the scene."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from app.scene import colours
from pipeline.errors import ParameterError

COLOUR_BY = ("verdict", "stage", "cluster", "height", "eccentricity")
LABEL_BY = ("eccentricity", "verdict", "DBH", "none")
# In the order of their keys, 1 to 9 and 0.
LAYERS = {
    "ground": "Ground",
    "raw": "Raw scan",
    "filtered": "Filtered",
    "clusters": "Clusters",
    "fits": "Fitted circles",
    "labels": "Labels",
    "gathered": "Accumulated map",
    "trees": "Trees",
    "truth": "Ground truth",
    "errors": "Errors (10 times as long)",
    "particles": "Particles",
    "path": "Path",
    "odometry": "Path by odometry",
    "voxels": "Voxels",
    "way": "Way and obstacles",
}
# Off until somebody asks for them: they cost time to draw, or cover what lies below.
OFF_AT_FIRST = ("odometry", "voxels", "gathered", "errors")
# What a layer is drawn in while people colour by verdict; those that are not named have many colours.
COLOURS = {
    "ground": colours.GROUND,
    "raw": colours.RAW,
    "filtered": colours.FILTERED,
    "voxels": colours.VOXELS,
    "clusters": colours.TREE,
    "fits": colours.TREE,
    "particles": colours.PARTICLES,
    "path": colours.PATH,
    "odometry": colours.ODOMETRY,
    "trees": colours.TREE,
    "truth": colours.TRUTH,
    "errors": colours.ERROR,
    "way": colours.PATH,
}
CHOICES = {"colour_by": COLOUR_BY, "label_by": LABEL_BY}


@dataclass(slots=True)
class View:
    """What is chosen; shared by all browsers that look at the scene."""

    colour_by: str = COLOUR_BY[0]
    label_by: str = LABEL_BY[0]
    follow: bool = True
    layers: dict[str, bool] = field(
        default_factory=lambda: {name: name not in OFF_AT_FIRST for name in LAYERS}
    )

    def choose(self, name: str, value: str | bool) -> None:
        """Switch a layer or following, or choose by what is coloured or labelled.

        Raises:
            ParameterError: There is no such choice, or the value is none of it.
        """
        if name in CHOICES:
            if value not in CHOICES[name]:
                allowed = ", ".join(CHOICES[name])
                raise ParameterError(f"{value!r} is no choice", where=name, remedy=f"Choose one of {allowed}")
            setattr(self, name, value)
        elif not isinstance(value, bool) or not (name in LAYERS or name == "follow"):
            raise ParameterError("there is no such layer or choice", where=f"{name} = {value}"[:100])
        elif name == "follow":
            self.follow = value
        else:
            self.layers[name] = value

    def as_plain(self) -> dict[str, Any]:
        """For the page: the layers in their order with title, colour and whether they are seen, and the
        choices."""
        layers = [
            {"name": name, "title": title, "on": self.layers[name], "colour": _hex(COLOURS.get(name))}
            for name, title in LAYERS.items()
        ]
        choices = {name: {"value": getattr(self, name), "of": list(of)} for name, of in CHOICES.items()}
        return {"layers": layers, "follow": self.follow, **choices}


def _hex(colour: colours.Rgb | None) -> str | None:
    return None if colour is None else "#{:02x}{:02x}{:02x}".format(*colour)
