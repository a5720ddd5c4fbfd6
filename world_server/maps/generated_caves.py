"""Generated caves: what a survey of a natural cave looks like, as a graph with positions in metres.

Passages wind, keep to the strike of the rock, throw off side passages, and end in nothing, in a
fork or in a chamber; none runs into another. Loops are added at the end, where two passages that
are far apart on foot pass close to each other.
"""

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from random import Random

from protocol.graph import PortGraph

CELL_M = 12.0
"""Side of a cell of the spatial index; no leg of a passage is longer."""
CLEARANCE_M = 3.2
"""Least distance between stations that are not joined by a leg, until space runs out."""
LOOP_RULES = ((9.0, 10, 6), (12.0, 8, 5), (15.0, 6, 3), (20.0, 4, 1), (30.0, 3, 0))
"""Reach in metres, least detour in hops and least hops to another loop: best rule first."""

Point = tuple[float, float]


@dataclass
class _Passage:
    """A passage that is still growing.

    Attributes:
        tip: The station at its end.
        heading: Direction of growth in radians.
        legs: Legs still to come.
        leg_m: Usual length of a leg.
        bend: Change of heading from leg to leg, in radians.
        main: Whether it may end in a fork or a chamber, and has sides.
    """

    tip: int
    heading: float
    legs: int
    leg_m: float
    bend: float
    main: bool


class _Cave:
    """A cave while it grows: stations, legs and where they are."""

    def __init__(self) -> None:
        self.points: list[Point] = [(0.0, 0.0)]
        self.ends: list[tuple[int, int]] = []
        self.neighbours: list[list[int]] = [[]]
        self._stations: dict[tuple[int, int], list[int]] = defaultdict(list)
        self._legs: dict[tuple[int, int], list[int]] = defaultdict(list)
        self._stations[0, 0].append(0)

    def add(self, parent: int, point: Point) -> int:
        """Add a station at the end of a leg from ``parent`` and return its number."""
        station = len(self.points)
        self.points.append(point)
        self.neighbours.append([])
        self._stations[_cell(point)].append(station)
        self.join(parent, station)
        return station

    def join(self, u: int, v: int) -> None:
        """Add a leg between two stations."""
        self._legs[_cell(_middle(self.points[u], self.points[v]))].append(len(self.ends))
        self.ends.append((u, v))
        self.neighbours[u].append(v)
        self.neighbours[v].append(u)

    def near(self, point: Point, reach_m: float) -> Iterator[int]:
        """Give the stations within ``reach_m`` of ``point``, and some more."""
        for cell in _cells(point, reach_m):
            yield from self._stations.get(cell, ())

    def fits(self, parent: int, point: Point, clearance_m: float) -> bool:
        """Tell whether a leg from ``parent`` to a new station at ``point`` keeps its distance."""
        start = self.points[parent]
        return (
            all(
                math.dist(point, self.points[station]) >= clearance_m
                for station in self.near(point, clearance_m)
                if station != parent
            )
            and all(
                _distance_to_leg(point, self.points[u], self.points[v]) >= 0.8 * clearance_m
                for u, v in self._legs_near(point)
                if parent not in {u, v}
            )
            and self.is_clear(start, point, {parent}, 0.6 * clearance_m)
        )

    def is_clear(self, start: Point, end: Point, joined: set[int], clearance_m: float) -> bool:
        """Tell whether a leg would cross no leg and pass no station, except those it joins."""
        middle = _middle(start, end)
        for u, v in self._legs_near(middle):
            if joined.isdisjoint((u, v)) and _cross(start, end, self.points[u], self.points[v]):
                return False
        return all(
            station in joined or _distance_to_leg(self.points[station], start, end) >= clearance_m
            for station in self.near(middle, math.dist(start, end) / 2 + clearance_m)
        )

    def hops(self, start: int, most: int) -> dict[int, int]:
        """Return the stations at most ``most`` hops from ``start``, with their distance."""
        found = {start: 0}
        level = [start]
        for distance in range(1, most + 1):
            following: list[int] = []
            for station in level:
                for neighbour in self.neighbours[station]:
                    if neighbour not in found:
                        found[neighbour] = distance
                        following.append(neighbour)
            level = following
        return found

    def _legs_near(self, point: Point) -> Iterator[tuple[int, int]]:
        # A leg lies within half of the longest leg (loops: 30 m) around its middle.
        for cell in _cells(point, 2.5 * CELL_M):
            for edge in self._legs.get(cell, ()):
                yield self.ends[edge]


def cave(vertices: int, loops: int, rng: Random) -> PortGraph:
    """Grow a cave that starts at its entrance, vertex 0.

    Args:
        vertices: Number of survey stations, at least 1.
        loops: Number of independent cycles, at most ``vertices // 6``.
        rng: Source of everything that is random.

    Returns:
        A connected graph without parallels and self-loops, with positions and lengths in metres,
        rounded to centimetres. Legs are listed as they were found, those that close loops last.

    Raises:
        ValueError: If an argument is out of range.
    """
    if vertices < 1:
        raise ValueError(f"vertices: found {vertices}, expected at least 1")
    if not 0 <= loops <= vertices // 6:
        raise ValueError(
            f"loops: found {loops}, expected 0 to {vertices // 6} for {vertices} vertices"
        )
    grown = _Cave()
    _grow(grown, vertices, rng)
    _close_loops(grown, loops, rng)
    lengths = [round(math.dist(grown.points[u], grown.points[v]), 2) for u, v in grown.ends]
    return PortGraph([str(v) for v in range(vertices)], grown.ends, lengths, grown.points)


def _grow(grown: _Cave, vertices: int, rng: Random) -> None:
    """Let passages grow until there are ``vertices`` stations."""
    strike = rng.uniform(0, math.pi)
    clearance_m = CLEARANCE_M
    failures = 0
    growing = [_passage(0, strike + rng.uniform(-0.4, 0.4), rng, main=True)]
    while len(grown.points) < vertices:
        if not growing:
            wall = rng.randrange(len(grown.points))
            if len(grown.neighbours[wall]) <= 2:
                heading = rng.uniform(-math.pi, math.pi)
                growing.append(_passage(wall, heading, rng, main=rng.random() < 0.6))
            failures += 1
            if failures % 200 == 0:
                clearance_m *= 0.8  # the plane is infinite, but the legs are not
            continue
        index = rng.randrange(len(growing))
        passage = growing[index]
        station = _advance(grown, passage, strike, clearance_m, rng)
        if station is None:
            growing.pop(index)
            continue
        failures = 0
        passage.tip = station
        passage.legs -= 1
        if passage.main and rng.random() < 0.09:
            side = passage.heading + rng.choice((-1, 1)) * rng.uniform(1.0, 1.9)
            growing.append(_passage(station, side, rng, main=rng.random() < 0.3))
        if passage.legs == 0:
            growing.pop(index)
            if passage.main:
                growing += _end(passage, rng)


def _passage(tip: int, heading: float, rng: Random, *, main: bool) -> _Passage:
    """Begin a passage at a station: a long one, or a short side passage."""
    return _Passage(
        tip=tip,
        heading=heading,
        legs=rng.randint(9, 22) if main else rng.randint(1, 7),
        leg_m=rng.uniform(4.5, 7.5) if main else rng.uniform(3.6, 5.0),
        bend=0.0,
        main=main,
    )


def _advance(
    grown: _Cave, passage: _Passage, strike: float, clearance_m: float, rng: Random
) -> int | None:
    """Grow a passage by a leg; return the new station, or None where there is no room."""
    passage.bend = 0.75 * passage.bend + rng.gauss(0, 0.2)
    heading = passage.heading + passage.bend + 0.12 * math.sin(2 * (strike - passage.heading))
    leg_m = min(CELL_M, max(clearance_m, passage.leg_m * math.exp(rng.gauss(0, 0.22))))
    x, y = grown.points[passage.tip]
    for turn in (0.0, 0.35, -0.35, 0.75, -0.75, 1.15, -1.15):
        direction = heading + turn
        point = (
            round(x + leg_m * math.cos(direction), 2),
            round(y + leg_m * math.sin(direction), 2),
        )
        if grown.fits(passage.tip, point, clearance_m):
            passage.heading = direction
            return grown.add(passage.tip, point)
    return None


def _end(passage: _Passage, rng: Random) -> list[_Passage]:
    """Return what begins where a main passage ends: nothing, a fork or the ways of a chamber."""
    kind = rng.random()
    if kind < 0.15:
        return []
    if kind < 0.55:
        spread = rng.uniform(0.5, 1.1)
        turns = [spread, spread - rng.uniform(1.4, 1.9)]
        return [_passage(passage.tip, passage.heading + t, rng, main=True) for t in turns]
    ways = rng.randint(3, 5)
    first = rng.uniform(-0.2, 0.2) - 2.0
    begun: list[_Passage] = []
    for way in range(ways):
        heading = passage.heading + first + 4.0 * way / (ways - 1)
        begun.append(_passage(passage.tip, heading, rng, main=way % 2 == 1))
    return begun


def _close_loops(grown: _Cave, loops: int, rng: Random) -> None:
    """Join passages that are close in space and far on foot, the better places first."""
    missing = loops
    joined: list[int] = []
    order = list(range(len(grown.points)))
    for reach_m, detour, apart in LOOP_RULES:
        rng.shuffle(order)
        for u in order:
            if not missing:
                return
            around = grown.hops(u, max(detour, apart))
            if any(around.get(station, apart + 1) <= apart for station in joined):
                continue
            start = grown.points[u]
            by_distance = sorted(
                (math.dist(start, grown.points[v]), v) for v in grown.near(start, reach_m)
            )
            for distance, v in by_distance:
                if distance > reach_m:
                    break
                if around.get(v, detour + 1) <= detour:
                    continue
                if grown.is_clear(start, grown.points[v], {u, v}, 0.5 * CLEARANCE_M):
                    grown.join(u, v)
                    joined += [u, v]
                    missing -= 1
                    break
    # A cave too small for real loops: any legs that are not there yet, shortest first.
    pairs = sorted(
        (math.dist(grown.points[u], grown.points[v]), u, v)
        for v in range(len(grown.points) if missing else 0)
        for u in range(v)
        if v not in grown.neighbours[u]
    )
    for _, u, v in pairs[:missing]:
        grown.join(u, v)


def _cell(point: Point) -> tuple[int, int]:
    """Return the cell of the spatial index that holds a point."""
    return math.floor(point[0] / CELL_M), math.floor(point[1] / CELL_M)


def _cells(point: Point, reach_m: float) -> Iterator[tuple[int, int]]:
    """Give all cells that hold points within ``reach_m`` of ``point``."""
    column, row = _cell((point[0] - reach_m, point[1] - reach_m))
    last_column, last_row = _cell((point[0] + reach_m, point[1] + reach_m))
    for c in range(column, last_column + 1):
        for r in range(row, last_row + 1):
            yield c, r


def _middle(a: Point, b: Point) -> Point:
    """Return the point halfway between two points."""
    return (a[0] + b[0]) / 2, (a[1] + b[1]) / 2


def _distance_to_leg(point: Point, a: Point, b: Point) -> float:
    """Return the distance of ``point`` from the straight leg between ``a`` and ``b``."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    along = ((point[0] - a[0]) * dx + (point[1] - a[1]) * dy) / (dx * dx + dy * dy)
    along = min(1.0, max(0.0, along))
    return math.dist(point, (a[0] + along * dx, a[1] + along * dy))


def _cross(a: Point, b: Point, c: Point, d: Point) -> bool:
    """Tell whether the legs ``ab`` and ``cd``, which share no end, cross."""
    return _turn(a, b, c) * _turn(a, b, d) < 0 and _turn(c, d, a) * _turn(c, d, b) < 0


def _turn(a: Point, b: Point, c: Point) -> float:
    """Return twice the signed area of a triangle: positive if it turns left."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
