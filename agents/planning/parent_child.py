"""The plan of a parent robot and its children: stops of the parent, walks around them, every move.

The parent visits its stops one after another (`order`). At each of them the children cover what is in
sight and not covered before (`child_roadmaps`), and then all go on together (`following`). Every move
of every robot is planned: robots that do nothing but carry out `Plan.moves`, a tick each, cover all,
and no child ever moves unless the parent sees it when the tick begins.

A plan can be made at any time for the rest: from what is covered, and where the robots are that live.

Two counts of steps. The *paper's* adds for each stop

    coordination   moves of the child that is farthest from the parent back to it, moves of the parent
                   from stop to stop, one for each child more than fit into the line of sight one
                   behind the other, and moves to the farthest start
    coverage       moves of the longest walk

The *schedule's* counts ticks. Children go back while others still cover, and set out while the parent
waits for others, which saves ticks; a child that does not see the parent while that is off its vertex
waits for a tick, which the paper leaves out.

Paper:
    The parent-child paper, Sec. 3.3 to 3.5 and 5. Departures: a vertex in sight of a stop to which no
    way leads that stays in sight is left to another stop, if need be to an *extra* one; a stop around
    which nothing is left to cover is not visited.
"""

from collections.abc import Collection, Sequence
from collections.abc import Set as AbstractSet
from typing import NamedTuple

from agents.planning.child_roadmaps import child_roadmaps, distances
from agents.planning.following import STAY, Task, Team, Zones, shortest_path, way_down
from agents.planning.order import visiting_order
from protocol.grid import Cell

__all__ = ["STAY", "PaperSteps", "Plan", "Stop", "Zones", "plan_team"]


class PaperSteps(NamedTuple):
    """Steps as the paper counts them.

    Attributes:
        gather: of the farthest child back to the parent, before the team leaves for this stop; at the
            first one with what it takes to fetch children that are out of sight.
        leg: of the parent to this stop.
        queue: for children that do not fit into the line of sight one behind the other.
        spread: of the farthest child to the start of its walk.
        coverage: of the longest walk.
        redundant: steps of all children together that cover nothing.
    """

    gather: int
    leg: int
    queue: int
    spread: int
    coverage: int
    redundant: int

    @property
    def coordination(self) -> int:
        """All but coverage."""
        return self.gather + self.leg + self.queue + self.spread


class Stop(NamedTuple):
    """A stop of the parent.

    Attributes:
        cell: where it stands.
        is_extra: whether it was not among the stops asked for.
        covers: the vertices that are covered from here, the paper's C(t), row by row.
        walks: for each child the vertices on its walk, from the start of it; none if it is idle.
        arrived: tick before which the parent is here (the team has made so many ticks by then).
        started: the same, of all children at the starts of their walks.
        covered: the same, of the last vertex covered.
        steps: as the paper counts them.
    """

    cell: Cell
    is_extra: bool
    covers: tuple[Cell, ...]
    walks: tuple[tuple[Cell, ...], ...]
    arrived: int
    started: int
    covered: int
    steps: PaperSteps


class Plan(NamedTuple):
    """A plan for a parent and its children.

    Attributes:
        stops: in visiting order.
        starts: where the robots stand at first, the parent first.
        moves: for each robot, the parent first, a byte each tick: its exit (`protocol.grid.STEPS`), or
            `STAY`. All are equally long.
        order: the stops asked for in visiting order, also those around which nothing is left to cover
            when their turn comes, which are passed over.
    """

    stops: tuple[Stop, ...]
    starts: tuple[Cell, ...]
    moves: tuple[bytes, ...]
    order: tuple[Cell, ...]

    @property
    def coverage_steps(self) -> int:
        """As the paper counts them."""
        return sum(stop.steps.coverage for stop in self.stops)

    @property
    def coordination_steps(self) -> int:
        """As the paper counts them."""
        return sum(stop.steps.coordination for stop in self.stops)

    @property
    def redundant_steps(self) -> int:
        """Steps of all children on their walks that cover nothing."""
        return sum(stop.steps.redundant for stop in self.stops)

    @property
    def schedule_steps(self) -> int:
        """Ticks of the schedule."""
        return len(self.moves[0])

    @property
    def schedule_coverage_steps(self) -> int:
        """Ticks from the starts of all walks to the last vertex covered."""
        return sum(stop.covered - stop.started for stop in self.stops)


def plan_team(
    zones: Zones,
    stops: Sequence[Cell],
    *,
    parent: Cell,
    children: Sequence[Cell],
    covered: Collection[Cell] = (),
    in_file: int,
) -> Plan:
    """Plan for a team, from where it stands, all that is left to cover.

    Args:
        zones: the map, and who sees whom on it.
        stops: where the parent may stand; those around which nothing is left are left out.
        parent: where it stands.
        children: where they stand, those that live; at least one. They need not be in sight.
        covered: vertices that need not be covered any more.
        in_file: how many children fit into the line of sight one behind the other: the paper's
            r_los / d, rounded down.

    Returns:
        A plan that covers all free cells that can be reached and are not covered.

    Raises:
        ValueError: If there is no child, or one that cannot be reached.
    """
    if not children:
        raise ValueError("a parent without children covers nothing")
    grid = zones.grid
    left = {grid.place(*cell) for cell in grid.reachable([parent])}
    left.difference_update(grid.place(*cell) for cell in covered)
    asked = [grid.place(*stop) for stop in stops]
    useful = [stop for stop in asked if not left.isdisjoint(zones.zone(stop))]
    extra = _extra_stops(zones, left, useful)
    places = [grid.place(*child) for child in children]
    planned = _Planned(zones, Team(zones, grid.place(*parent), places))
    order = visiting_order(grid, planned.team.parent, [*useful, *extra])
    for stop in order:
        covers = left & zones.zone(stop)
        if covers:
            planned.visit(stop, covers, in_file, is_extra=stop in extra)
            left -= covers
    return Plan(
        tuple(planned.stops),
        (parent, *children),
        tuple(bytes(moves) for moves in planned.team.moves),
        tuple(grid.position(stop) for stop in order if stop not in extra),
    )


def _extra_stops(zones: Zones, left: set[int], stops: Sequence[int]) -> set[int]:
    """Return further stops, so that each vertex is in the zone of one."""
    unseen = left.difference(*(zones.zone(stop) for stop in stops))
    extra = set()
    while unseen:
        stop = min(unseen)
        extra.add(stop)
        unseen -= zones.zone(stop)
    return extra


class _Planned:
    """A plan that grows stop by stop.

    Attributes:
        team: the robots, where they are by now.
        stops: those visited.
    """

    def __init__(self, zones: Zones, team: Team) -> None:
        """Begin with a team; first of all the parent picks up children out of its zone."""
        team.pick_up()
        self.team = team
        self.stops: list[Stop] = []
        self._zones = zones
        self._grid = zones.grid
        self._tasks: list[Task] | None = None
        zone = zones.zone(team.parent)
        far = distances(zone, team.parent, self._grid.stride)
        self._gather = team.ticks + max(far[child] for child in team.children)

    def visit(self, vertex: int, covers: AbstractSet[int], in_file: int, *, is_extra: bool) -> None:
        """Go to a stop with all children, and cover some of its zone."""
        team, stride, position = self.team, self._grid.stride, self._grid.position
        path = shortest_path(self._grid, team.parent, {vertex})
        team.follow(path, self._tasks)
        arrived = team.ticks
        zone = self._zones.zone(vertex)
        ways = distances(zone, vertex, stride)
        children = len(team.children)
        maps = child_roadmaps(covers, zone, vertex, children, stride)
        walks = self._given(maps.walks, zone)
        self._tasks = [
            self._task(place, walk, zone, ways)
            for place, walk in zip(team.children, walks, strict=True)
        ]
        started, done = team.cover(self._tasks, own=vertex in covers)
        leg = len(path) - 1
        steps = PaperSteps(
            gather=self._gather,
            leg=leg,
            queue=max(0, children - in_file) if leg else 0,
            spread=max(ways[walk[0]] for walk in maps.walks),
            coverage=maps.steps,
            redundant=maps.redundant,
        )
        self._gather = max(ways[walk[-1]] for walk in maps.walks)
        cells = tuple(tuple(map(position, walk)) for walk in walks)
        told = tuple(map(position, sorted(covers)))
        self.stops.append(
            Stop(position(vertex), is_extra, told, cells, arrived, started, done, steps)
        )

    def _given(self, walks: Sequence[list[int]], zone: AbstractSet[int]) -> list[list[int]]:
        """Give walks to children, the longest first, each to the nearest one without."""
        places = self.team.children
        stride = self._grid.stride
        ways = {place: distances(zone, place, stride) for place in set(places)}
        given: list[list[int]] = [[] for _ in places]
        free = set(range(len(places)))
        for walk in sorted(walks, key=len, reverse=True):
            child = min(free, key=lambda one: (ways[places[one]][walk[0]], one))
            given[child] = walk
            free.remove(child)
        return given

    def _task(
        self, place: int, walk: list[int], zone: AbstractSet[int], ways: dict[int, int]
    ) -> Task:
        """Return the way from a place to the start of a walk, along it, and to the parent."""
        stride = self._grid.stride
        if not walk:
            return Task(way_down(ways, place, stride), 0, 0)
        there = way_down(distances(zone, walk[0], stride), place, stride)
        back = way_down(ways, walk[-1], stride)
        return Task([*there, *walk[1:], *back], start=len(there), end=len(there) + len(walk) - 1)
