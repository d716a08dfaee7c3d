"""Stands to learn from that hold many times more of what is no tree: a stand has four poles and one person
among fifty trees, too few to learn from what tells them."""

from __future__ import annotations

from dataclasses import fields, replace

from pipeline.simulation.scenarios import SCENARIOS, Scenario
from pipeline.simulation.uri import RunRequest, parse_uri

# Poles, persons who stand, bushes, boxes and persons who walk, instead of those that the scenario asks for.
FURNITURE = {"stand": (24, 6, 12, 5, 2), "slope": (24, 6, 12, 5, 2), "dense": (12, 4, 12, 2, 1)}


class FurnishedStand(RunRequest):
    """A simulated run as it was asked for, through a stand with more furniture."""

    @property
    def scenario(self) -> Scenario:
        """The scenario with its trees and the furniture."""
        scenario = replace(SCENARIOS[self.name], trees=self.trees)
        more = FURNITURE.get(self.name)
        if more is None:
            return scenario
        poles, standing, bushes, boxes, walking = more
        return replace(scenario, poles=poles, standing=standing, bushes=bushes, boxes=boxes, walking=walking)


def furnished_stand(uri: str) -> FurnishedStand:
    """Read what `parse_uri` reads; a scenario without an entry in FURNITURE stays as it is.

    Raises:
        UsageError: See `parse_uri`.
    """
    asked = parse_uri(uri)
    return FurnishedStand(**{f.name: getattr(asked, f.name) for f in fields(asked)})
