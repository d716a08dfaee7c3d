"""Layers of the scene, and which of them are visible: one list for viser, the page and the keys."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

from app.scene import colours
from pipeline.errors import ParameterError

COLOUR_BY = ("verdict", "stage", "cluster", "height", "eccentricity")
LABEL_BY = ("eccentricity", "verdict", "DBH", "none")


class Layer(NamedTuple):
    """A layer of the scene.

    Attributes:
        title: Name on the page.
        colour: Colour while the scene is coloured by verdict; None for several colours.
        on: Whether it is visible at the start. Layers that are slow or cover others are not.
    """

    title: str
    colour: colours.Rgb | None
    on: bool = True


# In the order of their keys, 1 to 9 and 0.
LAYERS = {
    "ground": Layer("Ground", colours.GROUND),
    "raw": Layer("Raw scan", colours.RAW),
    "filtered": Layer("Filtered", colours.FILTERED),
    "clusters": Layer("Clusters", colours.TREE),
    "fits": Layer("Fitted circles", colours.TREE),
    "labels": Layer("Labels", None),
    "gathered": Layer("Accumulated map", None, on=False),
    "trees": Layer("Trees", colours.TREE),
    "truth": Layer("Ground truth", colours.TRUTH),
    "errors": Layer("Errors (10 times as long)", colours.ERROR, on=False),
    "particles": Layer("Particles", colours.PARTICLES),
    "path": Layer("Path", colours.PATH),
    "odometry": Layer("Path by odometry", colours.ODOMETRY, on=False),
    "voxels": Layer("Voxels", colours.VOXELS, on=False),
    "way": Layer("Path ahead and obstacles", colours.PATH),
}
CHOICES = {"colour_by": COLOUR_BY, "label_by": LABEL_BY}


@dataclass(slots=True)
class ViewSettings:
    """Visible layers, colouring, labels and following; shared by all browsers."""

    colour_by: str = COLOUR_BY[0]
    label_by: str = LABEL_BY[0]
    follow: bool = True
    layers: dict[str, bool] = field(
        default_factory=lambda: {name: layer.on for name, layer in LAYERS.items()}
    )

    def choose(self, name: str, value: str | bool) -> None:
        """Set one choice of the view.

        Args:
            name: Name of a layer, "follow", "colour_by" or "label_by".
            value: Visibility or following as bool; for colours and labels the name of the choice.

        Raises:
            ParameterError: There is no such choice, or the value is not one of it.
        """
        if name in CHOICES:
            if value not in CHOICES[name]:
                allowed = ", ".join(CHOICES[name])
                raise ParameterError(
                    f"{value!r} is not one of the choices", where=name, remedy=f"Choose one of {allowed}"
                )
            setattr(self, name, value)
        elif not isinstance(value, bool) or not (name in LAYERS or name == "follow"):
            raise ParameterError("there is no such layer or choice", where=f"{name} = {value}"[:100])
        elif name == "follow":
            self.follow = value
        else:
            self.layers[name] = value

    def as_plain(self) -> dict[str, Any]:
        """Return the layers in order with title, colour and visibility, and the choices, for the page."""
        layers = [
            {"name": name, "title": layer.title, "on": self.layers[name], "colour": _hex(layer.colour)}
            for name, layer in LAYERS.items()
        ]
        choices = {name: {"value": getattr(self, name), "of": list(of)} for name, of in CHOICES.items()}
        return {"layers": layers, "follow": self.follow, **choices}


def _hex(colour: colours.Rgb | None) -> str | None:
    return None if colour is None else "#{:02x}{:02x}{:02x}".format(*colour)
