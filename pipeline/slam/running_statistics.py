"""What the last scans told of the pose: fading means, and what is counted from scan to scan."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from pipeline.jit import compiled
from pipeline.slam.motion import Noise, Wheels
from pipeline.slam.rigid_shift_test import FAMILIAR, MANY
from pipeline.slam.scan_statistics import ScanTold

# Scans in a row that show another place. More than make a tree well known: what a bend or an end of leaves
# hid is new as well, and must have the time to become known before the robot is told lost. Trees of another
# place become known as soon, so that from then on the hits count: a few new ones outvote no map.
STRANGE_LOST, STRANGE_MISSED = 5, 15.0  # scans; hits of the known trees in free view that such a scan misses
FADING = 0.1  # of a fading mean is the newest scan
FADING_FOUND = 0.2
OVERRULED = 0.5  # of the distrust is left for six scans
FEWEST = 2.0  # trees; fewer say nothing about shares
EXPECTED = 100.0  # hits in free view that are missed in a known place where few are recognised by chance:
BY_CHANCE, STILL_BY_CHANCE = 0.15, 0.4  # share of those found that is so; of the scans after such a one
NEARBY = 3.0  # m without a known tree, after which a place is a known one no more
LEADING = 3.0  # well known trees tell the motion where there is no odometry, MANY where there is one,
LED = 20  # and are believed in that after so many scans;
LED_MOST, LED_AGAIN = 60, 2  # what counts for more, so that a doubt that comes and goes does not begin anew


@dataclass(frozen=True, slots=True)
class Recent:
    """Fading means over the last scans.

    Attributes:
        innovation: Normalised innovation squared a degree of freedom.
        found: Share of the well known landmarks in free view that were found.
        ambiguous: Share of the detections that have two likely landmarks.
        odometry: Largest disagreement with the odometry where that was not doubted anyway, fading [sigma].
        alone: Distance driven since two known trees were recognised in a scan [m].
        mapped: Whether any landmark is well known.
        distrust: 1 when the trees overruled the odometry, fading.
        strange: Scans in a row that miss nearly all known trees in free view, and recognise none or, in a
            place that was well known, few.
        missed: Most hits of known trees in free view that one of these scans missed.
        familiar: Fading share of the detections that are well known.
        led: Of scans in which trees told the motion as the odometry was doubted, LED_AGAIN for each; one less
            for each scan since then.
    """

    innovation: float = 1.0
    found: float = 1.0
    ambiguous: float = 0.0
    odometry: float = 0.0
    alone: float = 0.0
    mapped: bool = False
    distrust: float = 0.0
    strange: int = 0
    missed: float = 0.0
    familiar: float = 0.0
    led: int = 0

    @property
    def slipped(self) -> bool:
        """Whether the trees overruled the odometry in one of the last scans."""
        return self.distrust >= OVERRULED

    @property
    def trees_lead(self) -> bool:
        """Whether the trees have told the motion for long enough to be believed in that."""
        return self.led >= LED_AGAIN * LED

    def wheels(self, noise: Noise) -> Wheels:
        """How far an odometry of this noise may lie from what the trees say now."""
        return Wheels(noise, self.distrust, self.alone, self.familiar)


class Doubted(NamedTuple):
    """Whether the odometry is not believed: as it came, or by the trees, now or just before."""

    as_it_came: bool = False
    by_trees: bool = False


BELIEVED = Doubted()


def remembered(recent: Recent, scan: ScanTold, driven: float, doubted: Doubted = BELIEVED) -> Recent:
    """The fading means after one scan more, `driven` metres after the one before it."""
    expected, told = scan.found + scan.missed, math.isfinite(scan.innovation)
    strange = _strange(recent, scan, any(doubted) or recent.alone + driven < NEARBY)
    return Recent(
        innovation=_faded(recent.innovation, scan.innovation, FADING if told else 0),
        found=_faded(recent.found, scan.found / max(expected, 1e-9), FADING_FOUND if expected > 0 else 0),
        ambiguous=_faded(
            recent.ambiguous,
            scan.ambiguous / max(scan.detections, 1),
            FADING if scan.detections >= FEWEST else 0,
        ),
        odometry=max(0.0 if any(doubted) else scan.odometry, (1.0 - FADING) * recent.odometry),
        alone=driven_alone(recent.alone, scan.recognised, driven),
        mapped=recent.mapped or scan.recognised > 0.5,
        distrust=fading_distrust(recent.distrust),
        strange=strange,
        missed=max(recent.missed, scan.missed) if strange else 0.0,
        familiar=fading_familiar(recent.familiar, scan.recognised, scan.detections),
        led=_led(recent.led, scan, doubted),
    )


@compiled
def driven_alone(alone: float, recognised: float, driven: float) -> float:
    """The distance without two known trees after one scan more, see Recent."""
    return 0.0 if recognised >= FEWEST else alone + driven


@compiled
def fading_distrust(distrust: float) -> float:
    """The distrust after one scan more, see Recent."""
    return (1.0 - FADING) * distrust if distrust > 0.01 else 0.0


@compiled
def fading_familiar(familiar: float, recognised: float, detections: int) -> float:
    """The share of well known trees after one scan more, see Recent."""
    if detections < FEWEST:
        return familiar
    return familiar + FADING_FOUND * (recognised / detections - familiar)


def _led(before: int, scan: ScanTold, doubted: Doubted) -> int:
    """Counted while trees tell what the odometry does not; forgotten when it is right for long."""
    if not any(doubted):
        return max(before - 1, 0)
    leading = LEADING if doubted.as_it_came else MANY
    return min(before + LED_AGAIN, LED_MOST) if scan.recognised >= leading else 0


def _strange(recent: Recent, scan: ScanTold, here: bool) -> int:
    """Counted until a known tree is recognised; a scan that misses none in free view or sees nothing says
    nothing. In a place that is `here`, where known trees were seen last, or may be, a few of many are
    recognised by chance, and those of the new place once they were seen for long enough."""
    before = recent.strange
    told = scan.detections >= FEWEST and scan.missed >= STRANGE_MISSED
    share = scan.found / max(scan.found + scan.missed, 1e-9)
    if scan.recognised < 0.5 and scan.found == 0.0:
        return before + 1 if told else before
    if before:
        # What was recognised has no more hits than what was begun since the first of these scans, and more
        # is missed than one tree, which may have fallen.
        young = scan.found <= (min(before, STRANGE_LOST) + 2) * scan.recognised
        young = young and max(recent.missed, scan.missed) >= FEWEST * STRANGE_MISSED
        return before + 1 if told and (young or share < STILL_BY_CHANCE) else 0
    return int(
        told and here and recent.familiar >= FAMILIAR and scan.missed >= EXPECTED and share < BY_CHANCE
    )


def _faded(mean: float, value: float, newest: float) -> float:
    """The mean when the newest value has this part in it."""
    return mean + newest * (value - mean) if newest else mean
