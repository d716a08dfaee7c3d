"""Colours by meaning (Okabe-Ito, safe for colour-blind people) and colour ramps, as uint8 RGB; the layers of
the scene and the choices of a user among them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import ParameterError
from pipeline.types.records import Verdict

Colours = NDArray[np.uint8]
Rgb = tuple[int, int, int]

RAW: Rgb = (120, 126, 134)
FILTERED: Rgb = (86, 140, 190)
CLUSTERED: Rgb = (222, 184, 90)
TREE: Rgb = (0, 158, 115)
UNMEASURED: Rgb = (110, 170, 150)
POLE: Rgb = (213, 94, 0)
PERSON: Rgb = (204, 121, 167)
BUSH: Rgb = (153, 153, 51)
OTHER: Rgb = (136, 136, 136)
UNCERTAIN: Rgb = (240, 228, 66)
TRUTH: Rgb = (230, 159, 0)
# Translucent, because the background is light or dark.
GROUND: Rgb = (122, 115, 102)
GROUND_OPACITY = 0.35
PATH: Rgb = (150, 156, 164)
ODOMETRY: Rgb = (96, 101, 108)
ROBOT: Rgb = (214, 45, 45)
PARTICLES: Rgb = (235, 110, 110)
VOXELS: Rgb = (120, 120, 230)
ERROR: Rgb = (226, 59, 59)
SELECTION: Rgb = (86, 180, 233)

_VERDICTS: dict[Verdict, Rgb] = {
    Verdict.TREE: TREE,
    Verdict.POLE: POLE,
    Verdict.TOO_THIN: POLE,
    Verdict.PERSON: PERSON,
    Verdict.MOVING: PERSON,
    Verdict.BUSH: BUSH,
    Verdict.NOT_ROUND: BUSH,
    Verdict.TOO_FEW_POINTS: UNCERTAIN,
    Verdict.NO_ARC: UNCERTAIN,
    Verdict.AT_BORDER: UNCERTAIN,
    Verdict.HIDDEN: UNCERTAIN,
    Verdict.STUMP: OTHER,
}
_BY_VERDICT: Colours = np.array([_VERDICTS.get(verdict, OTHER) for verdict in Verdict], dtype=np.uint8)

# Twelve hues far apart, none of them the grey of noise.
_CATEGORIES: Colours = np.array(
    [
        (86, 180, 233), (230, 159, 0), (0, 158, 115), (240, 228, 66), (213, 94, 0), (204, 121, 167),
        (120, 120, 230), (150, 210, 110), (240, 140, 130), (70, 200, 200), (190, 150, 240), (200, 170, 120),
    ],
    dtype=np.uint8,
)  # fmt: skip

# Nine supports of a ramp from dark violet over green to yellow, evenly rising in lightness.
_RAMP = np.array(
    [
        (68, 20, 100), (70, 50, 126), (56, 88, 140), (40, 118, 142), (31, 148, 139), (55, 178, 120),
        (112, 206, 86), (180, 222, 44), (250, 231, 60),
    ],
    dtype=np.float64,
)  # fmt: skip


def by_verdict(verdicts: NDArray[np.integer]) -> Colours:
    """Return the colour of each verdict, uint8, shape (K, 3). Numbers outside of `Verdict` are clipped to it.

    Args:
        verdicts: Values of `Verdict`, shape (K,).
    """
    chosen: Colours = _BY_VERDICT[np.clip(verdicts, 0, len(_BY_VERDICT) - 1)]
    return chosen


def by_category(numbers: NDArray[np.integer]) -> Colours:
    """Return a colour for each integer, shape (K,), as uint8, shape (K, 3): one of 12 colours by the number
    modulo 12."""
    chosen: Colours = _CATEGORIES[np.asarray(numbers) % len(_CATEGORIES)]
    return chosen


def ramp(values: NDArray[np.floating], low: float, high: float) -> Colours:
    """Return colours from violet to yellow, uint8, shape (K, 3). Values outside of `low` to `high` are
    clipped; NaN counts as `high`.

    Args:
        values: Values, shape (K,).
        low, high: Values that are violet and yellow.
    """
    t = (np.nan_to_num(values, nan=high, posinf=high, neginf=low) - low) / max(high - low, 1e-9)
    place = np.clip(t, 0.0, 1.0) * (len(_RAMP) - 1)
    rgb = np.stack([np.interp(place, np.arange(len(_RAMP)), _RAMP[:, c]) for c in range(3)], axis=-1)
    return rgb.astype(np.uint8)


def of_points(cluster_colours: Colours, labels: NDArray[np.integer], noise: Rgb) -> Colours:
    """Return the colour of each point, uint8, shape (M, 3).

    Args:
        cluster_colours: Colour of each cluster, shape (K, 3).
        labels: Cluster of each point, -1 for none, shape (M,).
        noise: Colour of points without a cluster.
    """
    table = np.vstack([cluster_colours.reshape(-1, 3), np.array([noise], dtype=np.uint8)])
    chosen: Colours = table[labels]
    return chosen


def choose(first: NDArray[np.bool_], one: Rgb, other: Rgb) -> Colours:
    """Return one of two colours for each element, uint8, shape (N, 3).

    Args:
        first: Whether the element has the colour `one`, shape (N,).
        one, other: The colours.
    """
    return np.array([other, one], dtype=np.uint8)[first.astype(np.int64)]


def of_lines(each: NDArray[np.uint8]) -> Colours:
    """Return the colours that viser must get so that its client renders lines in the colours `each`, uint8,
    of the same shape.

    Its client treats the colours of lines as linear light and converts them to sRGB again.
    """
    c = each / 255.0
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return np.round(255.0 * linear).astype(np.uint8)


COLOUR_BY = ("verdict", "stage", "cluster", "height", "intensity", "eccentricity")
LABEL_BY = ("eccentricity", "verdict", "DBH", "none")


class Layer(NamedTuple):
    """A layer of the scene.

    Attributes:
        title: Name on the dashboard.
        colour: Colour while the scene is coloured by verdict; None for several colours.
        on: Whether it is visible at the start. Layers that are slow or cover others are not.
    """

    title: str
    colour: Rgb | None
    on: bool = True


# In the order of their keys, 1 to 9 and 0.
LAYERS = {
    "ground": Layer("Ground", GROUND),
    "raw": Layer("Raw scan", RAW),
    "filtered": Layer("Filtered", FILTERED),
    "clusters": Layer("Clusters", TREE),
    "fits": Layer("Fitted circles", TREE),
    "labels": Layer("Labels", None),
    "gathered": Layer("Accumulated map", None, on=False),
    "trees": Layer("Trees", TREE),
    "truth": Layer("Ground truth", TRUTH),
    "errors": Layer("Errors (10 times as long)", ERROR, on=False),
    "particles": Layer("Particles", PARTICLES),
    "path": Layer("Path", PATH),
    "odometry": Layer("Path by odometry", ODOMETRY, on=False),
    "voxels": Layer("Voxels", VOXELS, on=False),
    "way": Layer("Path ahead and obstacles", PATH),
}
# Scans of which the accumulated map shows the points, by the time before the current scan [s].
WINDOWS = {"whole run": None, "last 1 s": 1.0, "last 3 s": 3.0, "last 10 s": 10.0}
CHOICES = {"colour_by": COLOUR_BY, "label_by": LABEL_BY, "accumulated": tuple(WINDOWS)}


@dataclass(slots=True)
class ViewSettings:
    """Visible layers, colouring, labels and following; shared by all browsers."""

    colour_by: str = COLOUR_BY[0]
    label_by: str = LABEL_BY[0]
    accumulated: str = next(iter(WINDOWS))
    follow: bool = True
    layers: dict[str, bool] = field(
        default_factory=lambda: {name: layer.on for name, layer in LAYERS.items()}
    )

    def choose(self, name: str, value: str | bool) -> None:
        """Set one choice of the view.

        Args:
            name: Name of a layer, "follow", or a name in CHOICES.
            value: Visibility or following as bool; for CHOICES one of their values.

        Raises:
            ParameterError: There is no such choice, or the value is not one of it; nothing changes.
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
        """Return the state as a dict for the dashboard: `layers`, a list of dicts in the order of LAYERS with
        `name`, `title`, `on` and `colour` ("#rrggbb" or None); `follow`; and for each name in CHOICES a dict
        with `value` and `of`, the list of possible values; and `ramp`, the colours of `ramp` from its lower
        to its upper end."""
        layers = [
            {"name": name, "title": layer.title, "on": self.layers[name], "colour": _hex(layer.colour)}
            for name, layer in LAYERS.items()
        ]
        choices = {name: {"value": getattr(self, name), "of": list(of)} for name, of in CHOICES.items()}
        supports = ["#{:02x}{:02x}{:02x}".format(*map(int, rgb)) for rgb in _RAMP]
        return {"layers": layers, "follow": self.follow, **choices, "ramp": supports}


def _hex(colour: Rgb | None) -> str | None:
    """Return a colour as "#rrggbb"; None for None."""
    return None if colour is None else "#{:02x}{:02x}{:02x}".format(*colour)
