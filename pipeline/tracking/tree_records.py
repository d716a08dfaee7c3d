"""The trees of a table of tracks, as people are told of them (Table 2)."""

from __future__ import annotations

import numpy as np

from pipeline.config.stages import Tracking
from pipeline.tracking.observation import Telling, table_figures
from pipeline.tracking.track_table import TrackTable
from pipeline.types.records import Trees

SHARED_SIGMA = 0.01  # m; bark and taper: the views of one trunk share part of their error
SHARED_COVARIANCE = SHARED_SIGMA**2 * np.eye(2)


def trees_of(tracks: TrackTable, parameters: Tracking) -> Trees:
    """The trees, none of whose columns is one of the table's."""
    t = tracks
    coverage, dbh, dbh_sigma, eccentricity, confirmed = table_figures(t.as_rows(), telling_of(parameters))
    return Trees(
        number=t.number.copy(),
        position=t.x[:, :2].copy(),
        covariance=t.P[:, :2, :2] + SHARED_COVARIANCE,
        velocity=t.x[:, 2:].copy(),
        dbh=dbh,
        dbh_sigma=dbh_sigma,
        eccentricity=eccentricity,
        observations=t.hits.copy(),
        coverage=coverage,
        first_seen_ns=t.first_ns.copy(),
        last_seen_ns=t.stamp_ns.copy(),
        confirmed=confirmed,
        sides=t.sides.copy(),
    )


def telling_of(parameters: Tracking) -> Telling:
    """What the figures of a tree hang on beside its track."""
    p = parameters
    return Telling(p.hits_to_confirm, float(np.radians(p.dbh_arc_min)), p.out_of_round, p.taper_sigma)
