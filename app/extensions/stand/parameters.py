"""Parameters of stand figures."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator

from pipeline.config.stages import Stage, choice, count, number


class Stand(Stage):
    """Stand figures of a finished map (`stemmap stand`). They do not affect the mapping, so they are not part
    of the parameters of a run."""

    dbh_min: float = number(0.07, "Minimum diameter", "m", 0.0, 1.0, 0.01)
    """Thinner trees do not count."""

    dbh_shared_sigma: float = number(0.005, "Shared DBH sigma", "m", 0.0, 0.05, 0.001)
    """Part of the standard deviation of a diameter that is one error of all trees of a map."""

    count_error: float = number(0.06, "Counting error", "", 0.0, 0.5, 0.01)
    """False and missed trees as a share of the stems: one error of all plots of a map."""

    class_width: float = number(0.04, "Class width", "m", 0.005, 0.5, 0.005)
    """Width of the diameter classes."""

    dominant_per_ha: float = number(100.0, "Dominant trees", "1/ha", 1.0, 1000.0, 10.0)
    """Number of the thickest trees per hectare that give the dominant diameter."""

    reach: float = number(15.0, "Reach", "m", 1.0, 30.0, 0.5)
    """An area counts as observed up to this distance from its nearest view."""

    views_min: int = count(2, "Minimum views", "", 1, 100)
    """Number of scans, half a metre of path apart, with a view of an observed cell."""

    correction: Literal["half_normal", "none"] = choice("half_normal", "Correction")
    """half_normal: detection probability over distance; none: every tree in view is found."""

    volume: str = Field(default="", title="Volume formula")
    """Stem volume in m3 of dbh_cm and height_m, with + - * / ^ ( ), exp, log and sqrt; empty: no volume."""

    @field_validator("volume")
    @classmethod
    def _readable(cls, text: str) -> str:
        """Return the text, which may be empty; FormulaError (a ValueError) if it is not a volume formula."""
        from app.extensions.stand.volume import VolumeFormula

        if text:
            VolumeFormula.parse(text)
        return text
