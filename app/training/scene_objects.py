"""Furniture: what stands along streets and in parks, built of solids, each with the class of its points.

Shapes and sizes are drawn wide on purpose: the decision trees shall learn what a thing is, not how
large it is in one town.
"""

from __future__ import annotations

import numpy as np

from pipeline.simulation.primitives import Solids, SolidsBuilder
from pipeline.simulation.scene_objects import person
from pipeline.simulation.terrain import Terrain
from pipeline.types.records import Float

# Classes of SemanticKITTI, so that simulated clouds are labelled as real ones are.
VEHICLE, PERSON, BUILDING, FENCE, FOLIAGE, TRUNK, GROUND, POLE, SIGN = 10, 30, 50, 51, 70, 71, 72, 80, 81


class Furniture:
    """Collects things; each place is x, y [m] on the terrain.

    Attributes:
        classes: Of each owner of solids.
        trunks: Owner, x and y of each trunk at breast height.
    """

    def __init__(self, terrain: Terrain, rng: np.random.Generator) -> None:
        self._terrain, self._rng = terrain, rng
        self.builder = SolidsBuilder()
        self._persons: list[Solids] = []
        self.classes: list[int] = []
        self.trunks: list[tuple[int, float, float]] = []

    def solids(self) -> Solids:
        """All of it."""
        solids = self.builder.build()
        for one in self._persons:
            solids = solids.join(one)
        return solids

    def tree(self, x: float, y: float) -> None:
        """A trunk, mostly with a crown, at times with branches, further stems, ivy, shrubs at its foot or a
        stake."""
        rng = self._rng
        radius = 0.5 * float(rng.uniform(0.08, 0.2) if rng.random() < 0.35 else rng.uniform(0.15, 0.7))
        height = float(np.clip(5.0 + 30.0 * radius, 3.0, 12.0) * rng.uniform(0.8, 1.2))
        lowest, highest = ((0.5, 1.5), (1.2, 3.0), (2.5, 5.0))[int(rng.integers(0, 3))]
        base = float(min(rng.uniform(lowest, highest), 0.75 * height))
        lean = np.tan(np.radians(rng.choice([1.5, 4.0, 9.0], p=[0.6, 0.3, 0.1]) * rng.standard_normal(2)))
        foot = self.foot(x, y)
        start, end = (
            foot - np.array([*(1.6 * lean), 0.3]),
            foot + np.array([*((height - 1.3) * lean), height]),
        )
        owner = self.owner(TRUNK)
        self.builder.cone(owner, start, end, (1.1 * radius, 0.35 * radius), roughness=0.02 * radius)
        self.trunks.append((owner, x, y))
        for _ in range(int(rng.integers(0, 6)) if rng.random() < 0.5 else 0):
            at = float(rng.uniform(0.8, base + 0.5))
            self._branch(owner, start + (end - start) * (at / height))
        if rng.random() < 0.93:
            self._crown(start + (end - start) * (base / height), height - base, float(rng.uniform(0.8, 3.5)))
        if rng.random() < 0.12:
            self._further_stems(owner, foot, radius, 0.7 * height)
        if rng.random() < 0.12:
            self._ivy(start, end, radius)
        for _ in range(int(rng.integers(1, 4)) if rng.random() < 0.35 else 0):
            angle, away = rng.uniform(0.0, 2.0 * np.pi), float(rng.uniform(0.0, 0.9))
            x_beside, y_beside = x + away * np.cos(angle), y + away * np.sin(angle)
            self.shrub(x_beside, y_beside, float(rng.uniform(0.2, 0.8)), float(rng.uniform(0.3, 1.6)))
        if rng.random() < 0.1:
            angle = rng.uniform(0.0, 2.0 * np.pi)
            self.post(x + 0.45 * np.cos(angle), y + 0.45 * np.sin(angle), 0.04, float(rng.uniform(1.2, 2.2)))

    def post(self, x: float, y: float, radius: float, height: float) -> None:
        """A bare upright post: stake, bollard, mast of a line."""
        self._pole(self.owner(POLE), x, y, radius, height)

    def lamp(self, x: float, y: float) -> None:
        """A lamp post with a thicker base and an arm or a head."""
        rng, owner = self._rng, self.owner(POLE)
        radius, height = float(rng.uniform(0.04, 0.12)), float(rng.uniform(3.0, 9.0))
        self._pole(owner, x, y, radius, height)
        if rng.random() < 0.6:
            self._pole(owner, x, y, 1.5 * radius, float(rng.uniform(0.3, 1.4)))
        top, angle = self.foot(x, y) + np.array([0.0, 0.0, height]), rng.uniform(0.0, 2.0 * np.pi)
        arm = rng.uniform(0.3, 2.0) * np.array([np.cos(angle), np.sin(angle), 0.1])
        self.builder.cone(owner, top, top + arm, (0.04, 0.04), reflectivity=0.6)
        self.builder.ellipsoid(owner, top + arm, rng.uniform(0.1, 0.3, 3), reflectivity=0.6)

    def sign(self, x: float, y: float) -> None:
        """A thin post with a plate, a box of lights, or two of them."""
        rng, owner, plate = self._rng, self.owner(POLE), self.owner(SIGN)
        height, yaw = float(rng.uniform(1.2, 4.0)), float(rng.uniform(0.0, np.pi))
        self._pole(owner, x, y, float(rng.uniform(0.02, 0.06)), height)
        hangs = height
        for _ in range(int(rng.integers(1, 4))):
            half = np.array([rng.uniform(0.1, 0.6), rng.uniform(0.01, 0.12), rng.uniform(0.1, 0.5)])
            centre = self.foot(x, y) + np.array([0.0, 0.0, max(hangs - half[2], 0.4 + half[2])])
            self.builder.box(plate, centre, half, yaw=yaw, reflectivity=0.8)
            hangs -= 2.0 * half[2] + float(rng.uniform(0.0, 0.5))

    def shrub(self, x: float, y: float, radius: float, height: float) -> None:
        """Porous blobs and thin stems; tall ones are no different from small crowns on the ground."""
        rng, owner = self._rng, self.owner(FOLIAGE)
        foot = self.foot(x, y)
        dense = float(rng.uniform(0.1, 0.45))
        for _ in range(int(rng.integers(2, 6))):
            half = np.array([radius, radius, 0.5 * height]) * rng.uniform(0.4, 0.8, 3)
            shift = (radius - half[:2].max()) * rng.uniform(-1.0, 1.0, 2)
            centre = foot + np.array(
                [*shift, rng.uniform(0.6 * half[2], max(height - half[2], 0.7 * half[2]))]
            )
            self.builder.ellipsoid(owner, centre, half, yaw=rng.uniform(0.0, np.pi), free_path=dense)
        for _ in range(int(rng.integers(0, 7))):
            end = foot + np.array([*(0.6 * radius * rng.uniform(-1.0, 1.0, 2)), 0.8 * height])
            self.builder.cone(owner, foot - np.array([0.0, 0.0, 0.1]), end, (rng.uniform(0.01, 0.03), 0.005))

    def hedge(self, start: Float, end: Float) -> None:
        """A row of dense foliage from one place to another, (2,) [m] each, with rough or flat top."""
        rng, owner = self._rng, self.owner(FOLIAGE)
        height, half = float(rng.uniform(0.6, 2.6)), float(rng.uniform(0.25, 0.6))
        dense, rough = float(rng.uniform(0.05, 0.25)), float(rng.uniform(0.02, 0.3))
        length = float(np.hypot(*(end - start)))
        for along in np.arange(0.0, length, 0.7 * half):
            place = start + (end - start) * (along / max(length, 0.1)) + 0.3 * rough * rng.standard_normal(2)
            top = height * (1.0 + rough * rng.uniform(-1.0, 1.0))
            foot = self.foot(float(place[0]), float(place[1]))
            size = [half * rng.uniform(0.8, 1.2), half * rng.uniform(0.8, 1.2), 0.55 * top]
            self.builder.ellipsoid(owner, foot + np.array([0.0, 0.0, 0.5 * top]), size, free_path=dense)

    def fence(self, start: Float, end: Float) -> None:
        """Posts, with rails, with slats or with neither between them."""
        rng, owner = self._rng, self.owner(FENCE)
        height, length = float(rng.uniform(0.8, 1.9)), float(np.hypot(*(end - start)))
        apart, radius = float(rng.uniform(1.2, 3.0)), float(rng.uniform(0.025, 0.07))
        kind = int(rng.integers(0, 3))
        way = (end - start) / max(length, 0.1)
        for along in np.arange(0.0, length, apart):
            x, y = start + along * way
            self._pole(owner, x, y, radius, height)
        if kind == 1:
            for part in (0.4, 0.85):
                a, b = (
                    self.foot(*start) + np.array([0, 0, part * height]),
                    self.foot(*end) + np.array([0, 0, part * height]),
                )
                self.builder.cone(owner, a, b, (0.03, 0.03))
        elif kind == 2:
            for along in np.arange(0.0, length, rng.uniform(0.12, 0.25)):
                x, y = start + along * way
                self._pole(owner, x, y, 0.025, 0.95 * height)

    def wall(self, start: Float, end: Float, height: float, thickness: float) -> None:
        """A wall, or the face of a house."""
        middle, way = 0.5 * (start + end), end - start
        half = [0.5 * float(np.hypot(*way)), 0.5 * thickness, 0.5 * height + 0.3]
        centre = self.foot(*middle) + np.array([0.0, 0.0, 0.5 * height])
        yaw = float(np.arctan2(way[1], way[0]))
        self.builder.box(self.owner(BUILDING), centre, half, yaw=yaw)
        if height > 2.5 and self._rng.random() < 0.5:
            side = 0.5 * thickness + 0.08
            pipe = start + way * self._rng.random() + side * np.array([way[1], -way[0]]) / np.hypot(*way)
            self._pole(self.owner(POLE), float(pipe[0]), float(pipe[1]), 0.05, height)

    def car(self, x: float, y: float, yaw: float) -> None:
        """A parked car or van."""
        rng, owner = self._rng, self.owner(VEHICLE)
        foot, long, van = self.foot(x, y), float(rng.uniform(1.8, 2.6)), rng.random() < 0.25
        top = rng.uniform(1.8, 2.4) if van else rng.uniform(0.85, 1.05)
        body = [long, 0.88, 0.5 * (top - 0.3)]
        self.builder.box(owner, foot + np.array([0, 0, 0.5 * (top + 0.3)]), body, yaw=yaw)
        if not van:
            cabin = [0.55 * long, 0.75, 0.28]
            self.builder.box(owner, foot + np.array([0, 0, top + 0.28]), cabin, yaw=yaw)
        c, s = np.cos(yaw), np.sin(yaw)
        for ahead in (-0.62 * long, 0.62 * long):
            for side in (-0.85, 0.85):
                at = foot + np.array([c * ahead - s * side, s * ahead + c * side, 0.3])
                self.builder.ellipsoid(owner, at, [0.31, 0.1, 0.31], yaw=yaw)

    def motorcycle(self, x: float, y: float, yaw: float) -> None:
        """A motorcycle or a bicycle on its stand."""
        rng, owner = self._rng, self.owner(VEHICLE)
        foot, way = self.foot(x, y), np.array([np.cos(yaw), np.sin(yaw), 0.0])
        thick = float(rng.uniform(0.02, 0.2))
        for ahead in (-0.65, 0.65):
            self.builder.ellipsoid(
                owner, foot + ahead * way + np.array([0, 0, 0.32]), [0.32, 0.06, 0.32], yaw=yaw
            )
        self.builder.ellipsoid(owner, foot + np.array([0, 0, 0.65]), [0.6, thick, 0.12 + thick], yaw=yaw)
        front = foot + 0.55 * way
        self.builder.cone(
            owner, front + np.array([0, 0, 0.3]), front - 0.2 * way + np.array([0, 0, 1.05]), (0.04, 0.04)
        )
        across = 0.35 * np.array([-way[1], way[0], 0.0])
        bar = front - 0.2 * way + np.array([0, 0, 1.05])
        self.builder.cone(owner, bar - across, bar + across, (0.02, 0.02))
        if rng.random() < 0.5:
            self.builder.box(owner, foot - 0.7 * way + np.array([0, 0, 1.0]), [0.22, 0.22, 0.2], yaw=yaw)

    def bin(self, x: float, y: float) -> None:
        """A bin or a switch box."""
        rng = self._rng
        half = np.array([rng.uniform(0.2, 0.6), rng.uniform(0.2, 0.4), rng.uniform(0.4, 0.8)])
        centre = self.foot(x, y) + np.array([0.0, 0.0, half[2]])
        self.builder.box(self.owner(VEHICLE), centre, half, yaw=rng.uniform(0.0, np.pi))

    def drum(self, x: float, y: float) -> None:
        """A round thing as wide as a trunk: a barrel, an advertising column, a thick bollard."""
        rng, owner = self._rng, self.owner(VEHICLE)
        radius, height = float(rng.uniform(0.12, 0.6)), float(rng.uniform(0.6, 2.8))
        foot, top = self.foot(x, y), self.foot(x, y) + np.array([0.0, 0.0, height])
        self.builder.cone(
            owner, foot - np.array([0.0, 0.0, 0.2]), top, (radius, radius * float(rng.uniform(0.7, 1.1)))
        )
        self.builder.ellipsoid(owner, top, [radius, radius, 0.1])

    def person(self, x: float, y: float) -> None:
        """Somebody who stands there."""
        stride = float(self._rng.uniform(-0.3, 0.3))
        body = person(self.owner(PERSON), stride)
        self._persons.append(body.placed(self.foot(x, y), float(self._rng.uniform(0.0, 6.3))))

    def crown(self, x: float, y: float) -> None:
        """Foliage that hangs over from a tree nobody sees."""
        base = float(self._rng.uniform(1.0, 3.5))
        self._crown(self.foot(x, y) + np.array([0.0, 0.0, base]), float(self._rng.uniform(2.0, 5.0)), 2.0)

    def _crown(self, base: Float, depth: float, width: float) -> None:
        rng, owner = self._rng, self.owner(FOLIAGE)
        path = float(rng.choice([rng.uniform(0.15, 0.5), rng.uniform(0.5, 1.5)]))
        for _ in range(int(rng.integers(4, 12))):
            half = np.array([width, width, 0.5 * depth]) * rng.uniform(0.25, 0.65, 3)
            out = max(width - half[:2].max(), 0.0) * rng.uniform(-1.0, 1.0, 2)
            up = rng.uniform(0.7 * half[2], max(depth - half[2], half[2]))
            self.builder.ellipsoid(
                owner,
                base + np.array([*out, up]),
                half,
                yaw=rng.uniform(0.0, np.pi),
                free_path=path,
                reflectivity=0.5,
            )

    def _further_stems(self, owner: int, foot: Float, radius: float, height: float) -> None:
        """One to three more stems that part from the trunk at its foot."""
        rng = self._rng
        for _ in range(int(rng.integers(1, 4))):
            angle, lean = rng.uniform(0.0, 2.0 * np.pi), np.tan(np.radians(rng.uniform(3.0, 15.0)))
            way = np.array([np.cos(angle), np.sin(angle), 0.0])
            start = foot + rng.uniform(0.0, 1.5) * radius * way - np.array([0.0, 0.0, 0.3])
            end = start + height * (lean * way + np.array([0.0, 0.0, 1.0]))
            thick = float(rng.uniform(0.5, 0.9)) * radius
            self.builder.cone(owner, start, end, (thick, 0.35 * thick), roughness=0.02 * thick)

    def _ivy(self, start: Float, end: Float, radius: float) -> None:
        """Leaves that climb a trunk to some height."""
        rng, owner = self._rng, self.owner(FOLIAGE)
        thick, top = radius + float(rng.uniform(0.05, 0.2)), float(rng.uniform(0.2, 0.6))
        for part in np.arange(0.05, top, 0.08):
            half = [thick * rng.uniform(0.8, 1.2), thick * rng.uniform(0.8, 1.2), rng.uniform(0.3, 0.6)]
            self.builder.ellipsoid(
                owner, start + part * (end - start), half, free_path=float(rng.uniform(0.05, 0.25))
            )

    def _branch(self, owner: int, start: Float) -> None:
        rng = self._rng
        angle, rise = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-0.1, 1.0)
        way = rng.uniform(0.4, 1.5) * np.array([np.cos(angle), np.sin(angle), rise])
        self.builder.cone(owner, start, start + way, (rng.uniform(0.01, 0.03), 0.004))
        if rng.random() < 0.5:
            half = rng.uniform(0.1, 0.35, 3)
            self.builder.ellipsoid(self.owner(FOLIAGE), start + way, half, free_path=0.3)

    def _pole(self, owner: int, x: float, y: float, radius: float, height: float) -> None:
        foot = self.foot(float(x), float(y))
        lean = 0.01 * height * self._rng.standard_normal(2)
        top = foot + np.array([*lean, height])
        self.builder.cone(
            owner, foot - np.array([0.0, 0.0, 0.3]), top, (radius, 0.8 * radius), reflectivity=0.6
        )

    def foot(self, x: float, y: float) -> Float:
        """On the ground at x, y [m], shape (3,)."""
        return np.array([x, y, self._terrain.height(np.array([x]), np.array([y]))[0]])

    def owner(self, kind: int) -> int:
        """The number of a new thing of a class, for its solids."""
        self.classes.append(kind)
        return len(self.classes) - 1
