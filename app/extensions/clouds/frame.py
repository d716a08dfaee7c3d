"""The map of a whole cloud as a frame: the cloud, the candidates for stems, and the trees."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from app.extensions.clouds.inventory import PlotMap
from app.extensions.clouds.terrain_raster import TerrainRaster
from pipeline.classification.column_extraction import BREAST
from pipeline.geometry.poses import Pose2
from pipeline.types.records import (
    Clusters,
    Detections,
    Float,
    Frame,
    HeightMap,
    Int32,
    PoseEstimate,
    Verdict,
    no_detections,
)


def frame_of(plot: PlotMap) -> Frame:
    """Return a map of a cloud as a frame. The pose is the middle of the plot with yaw 0 and `base_z` the
    ground there; points and clusters are relative to it. `filtered` has the thinned points, `raw` none. The
    label of a point is the row of the candidate to whose crown or stem it belongs, -1 if there is none."""
    middle = plot.ground.low + 0.5 * plot.ground.cell * np.array(plot.ground.height.shape)
    base_z = float(plot.ground.at(middle[:1], middle[1:])[0])
    points = (plot.whole[:, :3] - np.append(middle, base_z)).astype(np.float32)
    labels = np.append(plot.tree_candidate, -1).astype(np.int32)[plot.crowns.tree]
    clusters = _clusters_of(plot, middle, base_z, labels)
    return Frame(
        index=0,
        stamp_ns=0,
        raw=np.zeros((0, 3), np.float32),
        filtered=points,
        labels=labels,
        clusters=clusters,
        detections=_detections_of(clusters),
        estimate=PoseEstimate(
            T_map_base=Pose2(float(middle[0]), float(middle[1]), 0.0),
            covariance=np.zeros((3, 3)),
            particles=np.zeros((0, 3)),
            weights=np.zeros(0),
            n_eff=0.0,
            landmarks=np.zeros((0, 2)),
        ),
        T_odom_base=Pose2(),
        sensor_offset=np.zeros(3),
        trees=plot.trees,
        counts=plot.counts,
        warnings=plot.warnings,
        ground=_height_map(plot.ground),
        base_z=base_z,
        of_drive=False,
    )


def _clusters_of(plot: PlotMap, middle: Float, base_z: float, labels: Int32) -> Clusters:
    """Return the candidates as clusters; eccentricity, covariance and `radius_sigma` are NaN. A candidate
    without a circle has the extent of a thin box at breast height.

    Args:
        plot: The map.
        middle, base_z: Origin of the frame of the clusters: x, y, shape (2,), and z in the map [m].
        labels: Row of the candidate of each thinned point, shape (N,), -1 for none.
    """
    stems, n = plot.stems, len(plot.stems)
    nan = np.full(n, np.nan)
    foot = plot.ground.at(plot.place[:, 0], plot.place[:, 1]) - base_z
    # A candidate without a circle is shown as a thin box at breast height.
    low = np.nan_to_num(stems["first"], nan=BREAST - 1.0)
    radius = np.maximum(stems["radius"], 0.0)  # a line through circles of another height may end before
    width = 2.0 * np.nan_to_num(radius, nan=0.1)
    height = np.nan_to_num(stems["last"] - stems["first"], nan=1.0)
    size = np.maximum(np.bincount(labels[labels >= 0], minlength=n), np.nan_to_num(stems["points"]))
    return Clusters(
        size=size.astype(np.int64),
        centroid=np.column_stack([plot.place - middle, foot + low + 0.5 * height]),
        eccentricity=nan,
        centre=plot.place - middle,
        covariance=np.tile(np.eye(2) * np.nan, (n, 1, 1)),
        radius=radius,
        radius_sigma=nan,
        radial_std=stems["scatter"].copy(),
        arc=stems["coverage"].copy(),
        extent=np.column_stack([width, width, height]),
        hidden=np.zeros(n, np.bool_),
        cut=np.zeros(n, np.bool_),
        verdict=plot.verdict,
    )


def _detections_of(clusters: Clusters) -> Detections:
    """Return the trees among the clusters as detections."""
    rows = np.flatnonzero(clusters.verdict == Verdict.TREE)
    return replace(
        no_detections(),
        cluster=rows,
        centre=clusters.centre[rows],
        covariance=clusters.covariance[rows],
        radius=clusters.radius[rows],
        radius_sigma=clusters.radius_sigma[rows],
        arc=clusters.arc[rows],
        eccentricity=clusters.eccentricity[rows],
    )


def _height_map(ground: TerrainRaster) -> HeightMap:
    """Return the visible ground as a height map whose cells begin at multiples of the cell size. Standard
    deviations are NaN, and each cell has one view."""
    cell = ground.cell
    first = np.floor(ground.low / cell).astype(np.int64)
    place = np.argwhere(np.ones(np.array(ground.height.shape) + 1, np.bool_)) + first
    centre = ((place + 0.5) * cell).astype(np.float64)
    there = np.floor((centre - ground.low) / cell).astype(np.int64)
    inside = np.flatnonzero(((there >= 0) & (there < ground.seen.shape)).all(axis=1))
    inside = inside[ground.seen[tuple(there[inside].T)]]
    place, centre = place[inside], centre[inside]
    return HeightMap(
        cell=cell,
        place=place.astype(np.int32),
        height=ground.at(centre[:, 0], centre[:, 1]).astype(np.float32),
        sigma=np.full(len(place), np.nan, np.float32),
        views=np.ones(len(place), np.int32),
    )
