"""Stand figures of one plot with standard errors, and of several plots together."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import numpy as np

from app.extensions.stand.parameters import Stand
from pipeline.geometry.poses import Float
from pipeline.types.records import Bool

FEW_TREES = 10
HECTARE = 1e4  # m^2
REINEKE = 1.605
INCH_10 = 25.4  # cm
# Share of the value below which a standard error is "not known": it does not include the trees that the map
# lacks, which would then be its larger part.
NEGLIGIBLE = 0.001
# Probability of as many trees outside of the observed part, if the parts are alike, below which they are not:
# three standard deviations of a normal distribution, one-sided.
UNLIKE = 0.00135
# The same for the gaps of a whole observed area: a 95 % interval, because trees of the gaps were found
# although they do not count as observed, so that those that were not found would add to them.
UNLIKE_GAPS = 0.025
# Share of trees without a diameter above which the errors of basal area, volume and diameters are not known.
# A diameter is reported up to a certain standard deviation, which grows with the diameter, so that the trees
# without one are not drawn at random. With this share, the sum of basal areas is 9 % too small if those trees
# have 1.5 times the mean basal area of the others: 1 - 1 / (0.8 + 0.2 * 1.5). The same share is used for
# heights: the tops of short trees are hidden more often than those of tall ones.
UNMEASURED = 0.2
# Share of the trees that a map of stands with undergrowth lacks: 5 of about 420 in `sim:wild`
# (docs/results.md).
MISSED = 0.01
FAR = 40.0  # standard deviations, beyond which a normal distribution is 0 or 1 in double precision


class Estimate(NamedTuple):
    """A stand parameter with its standard error; NaN where unknown."""

    value: float = math.nan
    se: float = math.nan


class DiameterClass(NamedTuple):
    """One class of diameters: limits [cm], number of trees, stems [1/ha] and basal area [m^2/ha]."""

    low: float
    high: float
    trees: int
    n_ha: Estimate
    g_ha: Estimate


@dataclass(frozen=True, slots=True, eq=False)
class PlotTrees:
    """The trees of a plot; columns of length T.

    Attributes:
        position: Positions x, y in the map, shape (T, 2) [m].
        dbh, dbh_sigma: Diameters at breast height and their standard deviations [m]; NaN where unknown.
        volume, volume_sigma: Volumes of the stems [m^3], NaN where unknown; None if there is no volume
            formula.
        volume_shared: Part of `volume_sigma` by the error that all diameters share [m^3], or None.
        height, height_sigma: Heights and their standard deviations [m], NaN where unknown; None if no tree
            has one.
        by_tape: Whether a person measured the diameter, so that it has no part of the error that the
            diameters of the map share; None if no tree is measured so.
        added: Whether a person added the tree because the map lacks it; None if no tree is.
        confirmed: Whether a person stated that it is a tree; None if no person did of any.
    """

    position: Float
    dbh: Float
    dbh_sigma: Float
    volume: Float | None = None
    volume_sigma: Float | None = None
    volume_shared: Float | None = None
    height: Float | None = None
    height_sigma: Float | None = None
    by_tape: Bool | None = None
    added: Bool | None = None
    confirmed: Bool | None = None

    @property
    def of_map(self) -> Bool:
        """Whether the tree is one of the map, shape (T,)."""
        return np.ones(len(self.dbh), np.bool_) if self.added is None else ~self.added

    def shared(self, common: float) -> Float:
        """Return the part of `dbh_sigma` that is one error of all trees, at most `common`, shape (T,) [m]; 0
        where `dbh_sigma` is unknown."""
        shared = np.minimum(np.nan_to_num(self.dbh_sigma), common)
        return shared if self.by_tape is None else np.where(self.by_tape, 0.0, shared)

    def counting(self, error: float) -> Float:
        """Return the relative counting error of each tree, shape (T,): `error`, and for trees that a person
        confirmed, measured by tape or added at most MISSED, because they are not false."""
        known = np.zeros(len(self.dbh), np.bool_)
        for stated in (self.confirmed, self.by_tape, self.added):
            known |= False if stated is None else stated
        return np.where(known, min(MISSED, error), error)

    def where(self, keep: Bool) -> PlotTrees:
        """Return the rows for which `keep`, shape (T,), is true."""
        kept: dict[str, Any] = {}
        for each in fields(self):
            column = getattr(self, each.name)
            kept[each.name] = None if column is None else column[keep]
        return PlotTrees(**kept)


@dataclass(frozen=True, slots=True, eq=False)
class StandFigures:
    """Stand parameters of a plot.

    Attributes:
        area, seen: Area of the plot and its observed part [m^2].
        trees: Number of trees of at least the minimum diameter in the observed part.
        without_dbh: Number of these trees without a diameter; they count with the mean basal area of the
            others.
        with_height: Number of these trees with a height.
        with_volume: Number of these trees with a volume; None if there is no volume formula.
        detection: Mean probability that a tree in the observed part is found; its error is NaN if it is
            assumed.
        values: Dict from the names in FIGURES, which has their units, to estimates. Names that end in
            `_plain` refer to the whole area, without any correction; `_corrected` are corrected for the
            probability of detection; the others refer to the observed area.
        counting: Dict from some of these names to the part of the standard error that is the counting error.
            It is one error of all plots of a map.
        classes: Diameter classes, from the minimum diameter upwards; per hectare of observed area. Empty, and
            `trees` and the other numbers of trees 0, if nothing was observed.
        warnings: Messages for the user.
    """

    area: float
    seen: float
    trees: int
    without_dbh: int
    with_height: int
    with_volume: int | None
    detection: Estimate
    values: Mapping[str, Estimate]
    counting: Mapping[str, float] = field(default_factory=dict)
    classes: tuple[DiameterClass, ...] = ()
    warnings: tuple[str, ...] = field(default=())


#: Title and unit of each figure.
FIGURES = {
    "n_ha": ("Stems per hectare", "1/ha"),
    "n_ha_plain": ("Stems per hectare of the whole area", "1/ha"),
    "n_ha_corrected": ("Stems per hectare, corrected for detection", "1/ha"),
    "g_ha": ("Basal area", "m2/ha"),
    "g_ha_plain": ("Basal area on the whole area", "m2/ha"),
    "g_ha_corrected": ("Basal area, corrected for detection", "m2/ha"),
    "v_ha": ("Stem volume", "m3/ha"),
    "v_ha_corrected": ("Stem volume, corrected for detection", "m3/ha"),
    "dg_cm": ("Quadratic mean diameter", "cm"),
    "mean_dbh_cm": ("Mean diameter", "cm"),
    "dominant_dbh_cm": ("Dominant diameter (100 thickest per hectare)", "cm"),
    "mean_height_m": ("Mean height", "m"),
    "lorey_height_m": ("Lorey's mean height (weighted by basal area)", "m"),
    "sdi": ("Stand density index (Reineke)", "1/ha"),
    "nearest_neighbour_m": ("Distance to the nearest neighbour", "m"),
    "clark_evans": ("Clark-Evans index", ""),
}


def stand_figures(
    trees: PlotTrees,
    outside: PlotTrees,
    *,
    area: float,
    seen: float,
    perimeter: float,
    detection: tuple[float, float],
    parameters: Stand,
) -> StandFigures:
    """Return the stand parameters of a plot.

    Standard errors are those of this plot, not of the stand around it: they contain the errors of the
    diameters, of which all trees share a part (`Stand.dbh_shared_sigma`), the counting error
    (`Stand.count_error`) of false and missed trees, the trees of the part that was not observed, and, of
    corrected parameters, the trees that were not detected. A plot that is observed completely, with certain
    detection, exact diameters of all trees and no counting error, has standard errors of 0, except for the
    parameters of the spatial pattern. The counting error is a share of the stems, and the same share of basal
    area, volume and stand density index, because false trees rarely have a diameter and count with the mean
    basal area. Of trees that people confirmed, measured by tape or added it is MISSED, because only missed
    trees remain.

    Args:
        trees: Trees in the observed part, of any diameter.
        outside: Trees in the rest of the plot, which count only in the `_plain` values; added ones do not
            count.
        area: Area of the plot [m^2].
        seen: Area of the observed part of the plot [m^2].
        perimeter: Length of the border of the observed part [m], for the edge correction of the Clark-Evans
            index.
        detection: Mean probability of detection in the observed part and its standard error; NaN if unknown.
            With an unknown error or a probability below 1, standard errors of stems, basal area and volume
            that are below NEGLIGIBLE of the value are NaN: nothing that is known limits them. It is that of
            the trees of the map. A tree that a person added is one of those that the map was estimated to
            lack, and takes the place of one of them.
        parameters: Limits of diameters and classes.

    Returns:
        The stand parameters. Trees thinner than the minimum diameter do not count; those without a diameter
        do. Unknown parameters are NaN: all if no area was observed; the corrected ones if the probability is
        NaN or not above 0; basal areas and volumes if there are trees, but none has a diameter or a volume;
        volumes without a formula; figures of diameters if no tree has a diameter; those of heights if no tree
        has a height, Lorey's also if none of these has a diameter; and those of the pattern for fewer than
        two trees. `_plain` figures have no standard error. In `v_ha`, trees without a volume
        count with the mean volume by basal area of the others.

    Raises:
        ValueError: The plot has no area.
    """
    warnings = []
    counted = ~(trees.dbh < parameters.dbh_min)  # trees without a diameter count
    kept = trees.where(counted)
    n, missing = len(kept.dbh), int(np.count_nonzero(np.isnan(kept.dbh)))
    if area <= 0.0:
        raise ValueError("a plot has no area")
    if seen <= 0.0:
        warnings.append("no part of the plot was observed: it has no figures and counts in no mean")
    elif n == 0:
        warnings.append("the plot has no trees")
    elif n < FEW_TREES:
        warnings.append(f"only {n} {'tree' if n == 1 else 'trees'}: the figures are uncertain")
    if 0 < n == missing:
        warnings.append("no tree has a diameter: basal area and figures of diameters are not known")
    elif missing:
        warnings.append(
            f"{missing} of {n} trees have no diameter: they count with the mean basal area of the others, "
            "and figures of diameters are those of the others; both are wrong if the others are thinner or "
            "thicker"
        )
    heights = 0 if kept.height is None else int(np.count_nonzero(np.isfinite(kept.height)))
    without_height = UNMEASURED * n < n - heights
    if 0 < heights < n:
        warnings.append(
            f"mean heights are those of {heights} of {n} trees, and wrong if the others are shorter or taller"
            + ("; their errors are not known" if without_height else "")
        )
    volumes = None if kept.volume is None else int(np.count_nonzero(np.isfinite(kept.volume)))
    if volumes is not None and volumes < n:
        warnings.append(
            f"volume of {volumes} of {n} trees: the others have no height, no diameter or a negative volume"
            + ("; they count with the mean volume by basal area" if volumes else "")
        )
    if 0.0 < seen < 0.5 * area:
        warnings.append(f"only {100.0 * seen / area:.0f} % of the plot was observed")
    p, p_se = detection
    values = dict.fromkeys(FIGURES, Estimate())
    if seen <= 0.0:
        return StandFigures(area, 0.0, 0, 0, 0, volumes, Estimate(p, p_se), values, warnings=tuple(warnings))
    outside = outside.where(outside.of_map)  # an added tree counts in the observed part only
    every = np.concatenate([kept.dbh, outside.dbh[~(outside.dbh < parameters.dbh_min)]])
    plain, _ = _basal_areas(PlotTrees(np.zeros((len(every), 2)), every, np.zeros(len(every))), 0.0)
    values["n_ha_plain"] = Estimate(HECTARE * len(every) / area)
    values["g_ha_plain"] = Estimate(HECTARE * float(plain.sum()) / area)
    share = min(seen / area, 1.0)
    common = parameters.dbh_shared_sigma
    basal, basal_var = _basal_areas(kept, common)
    unsure = _variance_of_number(trees, parameters.dbh_min, math.inf, common)
    found = kept.of_map
    lacking = _lacking(found, p)
    standing = np.where(found, 1.0 + lacking / max(int(found.sum()), 1), 1.0)
    uncounted, counting = kept.counting(parameters.count_error), {}
    totals = [
        ("n_ha", np.ones(n), unsure),
        ("g_ha", basal, basal_var + unsure * _basal_area(parameters.dbh_min) ** 2),
    ]
    if kept.volume is not None and kept.volume_sigma is not None and (volumes or not n):
        totals.append(("v_ha", *_volumes(kept.volume, kept.volume_sigma, kept.volume_shared, basal)))
    for name, weights, variance in totals:
        total, squares = float(weights.sum()), float(np.square(weights).sum())
        wrong = float(uncounted @ weights)
        counting[name] = HECTARE / seen * wrong
        se = math.sqrt((1.0 - share) * squares + variance + wrong**2)
        assumed = math.isnan(p_se)
        # This figure takes all trees in view as found: where that is not certain, 0 is no error of it.
        values[name] = _scaled(HECTARE / seen, total, se, assumed or p < 1.0)
        if p > 0.0:
            of_map, wrong = weights[found], float(uncounted @ (standing * weights))
            counting[f"{name}_corrected"] = HECTARE / seen * wrong
            fit = 0.0 if assumed else float(of_map.sum()) * p_se / p
            detected = (1.0 - share * p) * float(np.square(of_map).sum()) + variance + fit**2
            rest = (1.0 - share) * float(np.square(weights[~found]).sum())
            spread = math.sqrt(detected / p**2 + rest + wrong**2)
            values[f"{name}_corrected"] = _scaled(HECTARE / seen, float(standing @ weights), spread, assumed)
    if _is_unlike(n, len(every) - n, share, UNLIKE):
        warnings.append(
            f"the plot has {len(every)} trees, but its observed part leads to {n / share:.0f}: it is not "
            "like the rest, and the errors of stems, basal area and volume are not known"
        )
        values = _without_errors(values)
    known = share * (n / (n + lacking) if n else 1.0)
    values.update(_diameter_figures(kept, known, seen, parameters))
    if n:
        density, se = values["sdi"]
        counting["sdi"] = density * float(uncounted.mean())
        values["sdi"] = Estimate(density, math.hypot(se, counting["sdi"]))
    if UNMEASURED * n < missing < n:
        warnings.append(
            "more than a fifth of the trees have no diameter: the errors of basal area, volume and diameters "
            "are not known"
        )
        values = _without_errors(values, _OF_DIAMETERS)
    values.update(_height_figures(kept, known, parameters.dbh_shared_sigma))
    values.update(_pattern(kept.position, seen, perimeter))
    classes = _as_known(_classes(kept, trees, share, seen, parameters), values)
    return StandFigures(
        area,
        seen,
        n,
        missing,
        heights,
        volumes,
        Estimate(p, p_se),
        values,
        counting,
        classes,
        tuple(warnings),
    )


def compared_with_gaps(
    figures: StandFigures, gaps: PlotTrees, extent: float, parameters: Stand
) -> StandFigures:
    """Return the stand parameters of a whole observed area; without the standard errors of stems, basal area
    and volume, and with a warning, if more trees stand in its gaps than chance explains. Then trees were
    found where the area does not count as observed, and the area is not like the stand.

    Args:
        figures: Stand parameters of the observed area.
        gaps: Trees outside of the observed area and inside of its convex hull; added ones do not count.
        extent: Area of the convex hull [m^2].
        parameters: Limits of diameters.
    """
    share = min(figures.seen / extent, 1.0)
    outside = int(np.count_nonzero(gaps.of_map & ~(gaps.dbh < parameters.dbh_min)))
    if not _is_unlike(figures.trees, outside, share, UNLIKE_GAPS):
        return figures
    expected = figures.trees * (1.0 - share) / share
    text = (
        f"{outside} trees of the map stand in gaps of the observed area, where {expected:.0f} are expected: "
        "the area is not like the stand, stems, basal area and volume may be far too small, and their errors "
        "are not known"
    )
    values = _without_errors(dict(figures.values))
    classes = _as_known(figures.classes, values)
    return replace(figures, values=values, classes=classes, warnings=(*figures.warnings, text))


_OF_AREA = ("n_ha", "g_ha", "v_ha", "n_ha_corrected", "g_ha_corrected", "v_ha_corrected")
_OF_DIAMETERS = (
    "g_ha", "v_ha", "g_ha_corrected", "v_ha_corrected", "dg_cm", "mean_dbh_cm", "dominant_dbh_cm", "sdi",
)  # fmt: skip


def _without_errors(values: dict[str, Estimate], names: Sequence[str] = _OF_AREA) -> dict[str, Estimate]:
    """Return figures without the standard errors of some, by default of stems, basal area and volume."""
    return values | {name: Estimate(values[name].value, math.nan) for name in names}


def _as_known(classes: Sequence[DiameterClass], values: Mapping[str, Estimate]) -> tuple[DiameterClass, ...]:
    """Return diameter classes without the standard errors of stems or basal area that are not known of the
    whole plot."""
    stems, basal = (math.isnan(values[name].se) for name in ("n_ha", "g_ha"))
    return tuple(
        each._replace(
            n_ha=Estimate(each.n_ha.value) if stems else each.n_ha,
            g_ha=Estimate(each.g_ha.value) if basal else each.g_ha,
        )
        for each in classes
    )


def _lacking(found: Bool, p: float) -> float:
    """Return how many trees are estimated to stand in the observed part besides those that are known, with a
    probability of detection p; `found` is whether each known tree is one of the map. 0 for an unknown p."""
    missed = np.count_nonzero(found) * (1.0 / p - 1.0) if p > 0.0 else 0.0
    return max(missed - np.count_nonzero(~found), 0.0)


def _is_unlike(inside: int, outside: int, share: float, least: float) -> bool:
    """Return whether more trees were found outside of the observed share of a plot than chance explains: as
    many have a probability below `least`.

    Trees that stand at random are in either part in proportion to its area (binomial distribution). Those
    outside that were not found would only add to them.
    """
    from scipy.stats import binom

    return share < 1.0 and bool(binom.sf(outside - 1, inside + outside, 1.0 - share) < least)


def _scaled(scale: float, total: float, se: float, assumed: bool) -> Estimate:
    """Return a total and its standard error per hectare. The error is NaN if it is NEGLIGIBLE and `assumed`,
    i.e. trees may be missing although every tree counts as found."""
    return Estimate(scale * total, math.nan if assumed and se <= NEGLIGIBLE * total else scale * se)


def combined(plots: Mapping[str, StandFigures]) -> dict[str, Estimate]:
    """Return a dict from the names in FIGURES to means over plots, with the standard error of the variation
    between plots (ratio estimator), at least that of the errors of the plots: a few plots can be alike by
    chance. The counting error is added to it: all plots share it, so that it neither varies between them nor
    decreases with their number. The weights are the observed areas, for `_plain` names the whole areas. The
    error is NaN for one plot, and if that of a plot of several trees is: what makes it unknown, as many trees
    without a diameter, biases the mean too. Plots in which a value is NaN do not count; if all are NaN, so is
    the mean."""
    result = {}
    for name in FIGURES:
        is_plain = name.endswith("_plain")
        rows = [
            (f.area if is_plain else f.seen, *f.values[name], f.counting.get(name, 0.0), f.trees)
            for f in plots.values()
            if math.isfinite(f.values[name].value)
        ]
        if not rows:
            result[name] = Estimate()
            continue
        weight, value, se, counting, trees = np.array(rows).T
        is_unknown = not is_plain and bool((np.isnan(se) & (trees > 1)).any())
        own = np.maximum(np.square(np.nan_to_num(se)) - np.square(counting), 0.0)
        share = weight / weight.sum()
        mean, k = float(share @ value), len(rows)
        within = float(np.square(share) @ own)
        between = k / max(k - 1, 1) * float(np.square(share * (value - mean)).sum())
        error = math.sqrt(max(between, within) + float(share @ counting) ** 2)
        result[name] = Estimate(mean, math.nan if k == 1 or is_unknown else error)
    return result


def _basal_area(dbh: float) -> float:
    return 0.25 * math.pi * dbh**2


def _variance_of_sum(sigma: Float, shared: Float) -> float:
    """Return the variance of the sum of values with standard deviations `sigma`, shape (T,), of which the
    parts `shared`, at most `sigma`, are one error of all."""
    return float(np.square(sigma).sum() - np.square(shared).sum() + shared.sum() ** 2)


def _basal_areas(trees: PlotTrees, common: float) -> tuple[Float, float]:
    """Return the basal area of each tree, shape (T,) [m^2], and the variance of their sum [m^4], with the
    error `common` of all diameters [m]. A tree without a diameter has the mean, with the variance among the
    others (of a single one its square) and that of their mean, which is one error of all such trees. Both are
    NaN if no tree has a diameter. An unknown standard deviation of a diameter counts as 0."""
    d, sigma = trees.dbh, np.nan_to_num(trees.dbh_sigma)
    known = np.isfinite(d)
    if not len(d):
        return np.zeros(0), 0.0
    if not known.any():
        return np.full(len(d), math.nan), math.nan
    basal = 0.25 * math.pi * np.square(d)
    by_dbh = 0.5 * math.pi * d
    error, shared = by_dbh * sigma, by_dbh * trees.shared(common)
    mean, missing = float(basal[known].mean()), int(np.count_nonzero(~known))
    spread = float(basal[known].var(ddof=1)) if known.sum() > 1 else mean**2
    # The mean that a tree without a diameter has contains the shared error, too.
    of_all = np.where(known, shared, float(shared[known].mean()))
    own = float((np.square(error) - np.square(shared))[known].sum())
    own += spread * (missing + missing**2 / int(known.sum()))
    return np.where(known, basal, mean), own + float(of_all.sum()) ** 2


def _volumes(volume: Float, sigma: Float, shared: Float | None, basal: Float) -> tuple[Float, float]:
    """Return the volume of each tree, shape (T,) [m^3], and the variance of their sum [m^6].

    It is a ratio estimator: a tree without a volume has the ratio of volume to basal area of the others, with
    the variance of this ratio among them (of a single one its square). At least one tree has a volume, unless
    there are no trees.

    Args:
        volume, sigma, shared: Volumes and parts of their errors, see PlotTrees.
        basal: Basal area of each tree, shape (T,) [m^2].
    """
    known = np.isfinite(volume)
    if not known.any():
        return np.zeros(len(known)), 0.0
    sigma = sigma[known]
    common = np.zeros(len(sigma)) if shared is None else np.minimum(shared[known], sigma)
    measured, missing = float(basal[known].sum()), basal[~known]
    ratio = float(volume[known].sum()) / measured
    spread = float((volume[known] / basal[known]).var(ddof=1)) if len(sigma) > 1 else ratio**2
    variance = _variance_of_sum(sigma, common) * (float(basal.sum()) / measured) ** 2
    variance += spread * (float(np.square(missing).sum()) + float(missing.sum()) ** 2 / len(sigma))
    return np.where(known, volume, ratio * basal), variance


def _variance_of_number(trees: PlotTrees, low: float, high: float, common: float) -> float:
    """Return the variance of the number of trees with diameters from `low` to `high` [m] by the errors of
    diameters, of which `common` [m] is shared; trees without a diameter or its standard deviation add
    nothing."""
    from scipy.stats import norm

    known = np.isfinite(trees.dbh) & (trees.dbh_sigma > 0.0)
    sigma, shared = trees.dbh_sigma[known], trees.shared(common)[known]
    above, beyond = (np.clip((trees.dbh[known] - limit) / sigma, -FAR, FAR) for limit in (low, high))
    p = norm.cdf(above) - norm.cdf(beyond)
    # Change of the expected number by the shared error.
    slope = norm.pdf(above) - norm.pdf(beyond)
    return _variance_of_sum(np.sqrt(p * (1.0 - p)), slope * shared / sigma)


def _diameter_figures(trees: PlotTrees, found: float, seen: float, parameters: Stand) -> dict[str, Estimate]:
    """Return a dict from "dg_cm", "mean_dbh_cm", "dominant_dbh_cm" and "sdi" to estimates; empty if no tree
    has a diameter. The trees with a diameter stand for all: the thickest per hectare are the same share of
    them. The standard errors contain the jackknife over them, reduced by their share of all trees, of which
    the share `found` was found and observed, and the errors of the diameters. `seen` is the observed area
    [m^2]."""
    known = np.isfinite(trees.dbh)
    d, sigma = 100.0 * trees.dbh[known], 100.0 * np.nan_to_num(trees.dbh_sigma[known])
    if not len(d):
        return {}
    measured = len(d) / len(trees.dbh)
    shared = 100.0 * trees.shared(parameters.dbh_shared_sigma)[known]
    thickest = min(measured * parameters.dominant_per_ha * seen / HECTARE, float(len(d)))
    stems = HECTARE * len(trees.dbh) / seen

    def dominant(values: Float) -> tuple[float, Float]:
        order = np.argsort(-values, kind="stable")
        weight = np.zeros(len(values))
        weight[order] = np.clip(min(thickest, len(values)) - np.arange(len(values)), 0.0, 1.0)
        weight /= weight.sum()
        figure = math.sqrt(float(weight @ np.square(values)))
        return figure, weight * values / figure

    def quadratic(values: Float) -> tuple[float, Float]:
        figure = math.sqrt(float(np.square(values).mean()))
        return figure, values / (len(values) * figure)

    def mean(values: Float) -> tuple[float, Float]:
        return float(values.mean()), np.full(len(values), 1.0 / len(values))

    def density(values: Float) -> tuple[float, Float]:
        dg, slope = quadratic(values)
        figure = float(stems * len(values) / len(d) * (dg / INCH_10) ** REINEKE)
        return figure, REINEKE * figure / dg * slope

    figures = {"dg_cm": quadratic, "mean_dbh_cm": mean, "dominant_dbh_cm": dominant, "sdi": density}
    return {name: _with_error(figure, d, sigma, shared, measured * found) for name, figure in figures.items()}


def _height_figures(trees: PlotTrees, found: float, common: float) -> dict[str, Estimate]:
    """Return a dict from "mean_height_m" and "lorey_height_m" to estimates, without those that no tree has
    the measurements for. Errors as in `_diameter_figures`, NaN if more than UNMEASURED of the trees lack the
    measurements; `common` is the shared error of diameters [m]."""
    if trees.height is None or trees.height_sigma is None:
        return {}
    h = np.stack([trees.height, trees.dbh], axis=1)
    sigma = np.nan_to_num(np.stack([trees.height_sigma, trees.dbh_sigma], axis=1))
    shared = np.stack([np.zeros(len(h)), trees.shared(common)], axis=1)

    def mean(values: Float) -> tuple[float, Float]:
        return float(values.mean()), np.full(values.shape, 1.0 / len(values))

    def lorey(values: Float) -> tuple[float, Float]:
        height, d = values.T
        squares = float(np.square(d).sum())
        figure = float(np.square(d) @ height) / squares
        return figure, np.stack([np.square(d), 2.0 * d * (height - figure)], axis=1) / squares

    result = {}
    for name, figure, columns in (("mean_height_m", mean, 1), ("lorey_height_m", lorey, 2)):
        known = np.isfinite(h[:, :columns]).all(axis=1)
        if known.any():
            measured, error, of_all = (each[known, :columns] for each in (h, sigma, shared))
            estimate = _with_error(figure, measured, error, of_all, found * float(known.mean()))
            is_known = known.mean() >= 1.0 - UNMEASURED
            result[name] = estimate if is_known else Estimate(estimate.value, math.nan)
    return result


def _with_error(
    figure: Callable[[Float], tuple[float, Float]], d: Float, sigma: Float, shared: Float, found: float
) -> Estimate:
    """Return a stand parameter with its standard error, which is NaN for a single tree of an incomplete plot.

    Args:
        figure: Function of the measurements, in the shape of `d`, that returns the stand parameter and its
            derivatives with respect to the measurements, in this shape.
        d, sigma: Measurements and their standard deviations, shape (N,) or (N, K) for N trees, N at least 1.
        shared: Part of `sigma` that is one error of all measurements, in the same shape.
        found: Share of all trees that was found, observed and measured.
    """
    n = len(d)
    value, slope = figure(d)
    measured = _variance_of_sum(slope * sigma, slope * shared)
    sampled = 0.0
    if n > 1 and found < 1.0:
        without = np.array([figure(np.delete(d, k, axis=0))[0] for k in range(n)])
        sampled = (1.0 - found) * (n - 1) / n * float(np.square(without - without.mean()).sum())
    return Estimate(value, math.sqrt(measured + sampled) if n > 1 or found >= 1.0 else math.nan)


def _pattern(position: Float, area: float, perimeter: float) -> dict[str, Estimate]:
    """Return a dict from names to estimates: "nearest_neighbour_m", the mean distance to the nearest
    neighbour [m], and "clark_evans", the index with the edge correction of Donnelly (1978): 1 for random
    positions, less for clusters, more for regular ones. The error of the index is that of random positions.
    Empty for fewer than two trees.

    Args:
        position: Positions of the trees, shape (N, 2) [m].
        area, perimeter: Observed area [m^2] and the length of its border [m].
    """
    from scipy.spatial import cKDTree

    n = len(position)
    if n < 2:
        return {}
    nearest = cKDTree(position).query(position, k=2)[0][:, 1]
    mean = float(nearest.mean())
    expected = 0.5 * math.sqrt(area / n) + (0.0514 + 0.041 / math.sqrt(n)) * perimeter / n
    spread = math.sqrt(0.0703 * area / n**2 + 0.037 * perimeter * math.sqrt(area / n**5))
    return {
        "nearest_neighbour_m": Estimate(mean, float(nearest.std(ddof=1)) / math.sqrt(n)),
        "clark_evans": Estimate(mean / expected, spread / expected),
    }


def _classes(
    trees: PlotTrees, every: PlotTrees, share: float, seen: float, parameters: Stand
) -> list[DiameterClass]:
    """Return the diameter classes from that of the minimum diameter to that of the thickest tree, empty ones
    included; none if no tree has a diameter. The first class begins at the minimum diameter, which makes it
    narrower unless that is a multiple of the width. Trees without a diameter are left out. The standard
    errors contain the missed trees (MISSED), the part of the plot out of sight and the errors of the
    diameters, by which trees belong to another class.

    Args:
        trees: Trees of the observed part from the minimum diameter.
        every: Trees of the observed part, also thinner ones, some of which may belong to the first class.
        share: Share of the plot that was observed.
        seen: Observed area [m^2].
        parameters: Minimum diameter and width of a class.
    """
    known = trees.where(np.isfinite(trees.dbh))
    if not len(known.dbh):
        return []
    width, common = parameters.class_width, parameters.dbh_shared_sigma
    first = math.floor(parameters.dbh_min / width + 1e-9)
    of = np.maximum(np.floor(known.dbh / width + 1e-9).astype(int), first)
    scale, rest = HECTARE / seen, 1.0 - share
    rows = []
    for k in range(first, int(of.max()) + 1):
        low, high = max(k * width, parameters.dbh_min), (k + 1) * width
        inside = known.where(of == k)
        basal, variance = _basal_areas(inside, common)
        # Of the false trees, 15 of 17 have no diameter (docs/results.md), so that no class has them.
        uncounted = np.minimum(inside.counting(parameters.count_error), MISSED)
        unsure = _variance_of_number(every, low, high, common)
        n_se = math.sqrt(rest * len(basal) + unsure + float(uncounted.sum()) ** 2)
        middle = _basal_area(0.5 * (low + high))
        variance += unsure * middle**2 + float(uncounted @ basal) ** 2
        g_se = math.sqrt(rest * float(np.square(basal).sum()) + variance)
        if not len(basal) and n_se <= NEGLIGIBLE:  # nothing tells how many the map lacks
            n_se = g_se = math.nan
        rows.append(
            DiameterClass(
                round(100.0 * low, 6),
                round(100.0 * high, 6),
                len(basal),
                Estimate(scale * len(basal), scale * n_se),
                Estimate(scale * float(basal.sum()), scale * g_se),
            )
        )
    return rows
