"""Several teams of a parent and its children, each with a part of the map to itself.

All robots are at one place at first. The vertices are divided into connected parts, one for each team,
and the children among the teams; every team goes to its part and covers it as `parent_child` plans
that for a team alone. Children move in sight of their own parent only, and no team does another's
work, though it may pass through others' parts on its way. The time is that of the slowest team.

A part grows from a *seed*: a vertex belongs to the seed that is nearest to it, in moves over free
places, less the *head start* of that seed. So parts are connected, and borders move when head starts
change.

    1  Seeds are drawn, far from each other. What a vertex takes is guessed from the plan of one team
       for everything: the ticks around each stop are shared by what is covered from it. Seeds move to
       the middles of their parts, and slow teams lose head start to fast ones, until that is even. This
       is done `DRAWS` times.
    2  The most even divisions are planned, borders move by what the plans say, and children change
       teams while that helps.

The search draws from a fixed stream, and is bounded by what it plans (`EFFORT`), not by time.

Paper:
    The parent-child paper, Sec. 6, names several teams as future work; all of this is ours.
"""

from collections.abc import Collection, Sequence
from collections.abc import Set as AbstractSet
from heapq import heapify, heappop, heappush
from itertools import pairwise
from math import sqrt
from typing import NamedTuple

import numpy as np

from agents.planning.child_roadmaps import distances
from agents.planning.parent_child import Plan, Zones, plan_team
from agents.planning.vertices import Choice, parent_vertices
from protocol.grid import Cell
from protocol.seeds import Stream, spawn

DRAWS = 6
"""Times that seeds are drawn."""
SETTLE = 12
"""Rounds in which seeds and borders move before anything is planned."""
PLANNED = 3
"""Divisions that are planned and made better."""
ROUNDS = 6
"""Rounds in which borders move by what plans say, before and after children change teams."""
EFFORT = 150_000
"""Vertices that are planned for, in all, for one number of teams: 60 x 60 some fifty times. What has
been begun is ended, so that large maps are planned for once."""
DAMPING = 0.7
"""Share of what would even out times at once if all neighbours were even."""

Time = tuple[int, int]
"""Of the slowest team: ticks of the schedule, and steps as the paper counts them."""


class TeamPart(NamedTuple):
    """A team, and what it does.

    Attributes:
        part: the vertices that it covers, row by row.
        children: how many it has.
        plan: for its parent and them.
    """

    part: tuple[Cell, ...]
    children: int
    plan: Plan

    @property
    def time(self) -> Time:
        """Ticks of its schedule, and steps as the paper counts them."""
        return self.plan.schedule_steps, self.plan.coverage_steps + self.plan.coordination_steps


def time_of(teams: Collection[TeamPart]) -> Time:
    """Return the largest of the teams' ticks, and the largest of their steps."""
    ticks, steps = zip(*(team.time for team in teams), strict=True)
    return max(ticks), max(steps)


class TeamsPlanner:
    """Plans for any number of teams on one map."""

    def __init__(self, chosen: Choice, start: Cell, *, children: int, in_file: int) -> None:
        """Take what all plans have in common.

        Args:
            chosen: what is to be covered, and from where one team would cover it.
            start: where all robots are, one of those vertices.
            children: how many there are in all, at least one.
            in_file: see `plan_team`.
        """
        views = chosen.sights
        self._chosen = chosen
        self._grid = views.grid
        self._start = start
        self._children = children
        self._in_file = in_file
        self._zones = Zones(views.grid, views.seen)
        place = views.grid.place
        self._whole = frozenset(place(*cell) for cell in views.grid.reachable([start]))
        self._cells = {place: views.grid.position(place) for place in self._whole}
        self._far = distances(self._whole, place(*start), views.grid.stride)
        self._known: dict[tuple[frozenset[int], int], TeamPart] = {}
        self._work: dict[int, dict[int, float]] = {}
        self._spent = 0

    @property
    def most_teams(self) -> int:
        """How many teams there can be: each has a child and a vertex."""
        return min(self._children, len(self._whole))

    def best(self) -> tuple[TeamPart, ...]:
        """Plan for as many teams as are fastest, of those numbers that are tried.

        These are the powers of two and `most_teams`, and numbers halfway between the fastest one so
        far and those tried beside it. Of equals it is the fewest teams.
        """
        numbers = {self.most_teams, *(1 << bit for bit in range(self.most_teams.bit_length()))}
        tried: dict[int, tuple[TeamPart, ...]] = {}
        while numbers:
            tried |= {teams: self.plan(teams) for teams in sorted(numbers)}
            best = min(tried, key=lambda teams: (time_of(tried[teams]), teams))
            numbers = {
                (fewer + more) // 2
                for fewer, more in pairwise(sorted(tried))
                if best in (fewer, more) and more - fewer > 1
            }
        return tried[best]

    def plan(self, teams: int) -> tuple[TeamPart, ...]:
        """Plan for a number of teams.

        Args:
            teams: from 1 to `most_teams`; one alone does what `plan_team` says.
        """
        if teams == 1:
            return (self._planned(self._whole, self._children),)
        self._known.clear()
        self._spent = 0
        share, more = divmod(self._children, teams)
        shares = [share + (team < more) for team in range(teams)]
        rng = spawn(teams, "teams")
        drawn = [self._settled(self._seeds(teams, rng), shares) for _ in range(DRAWS)]
        drawn.sort(key=lambda found: found[0])
        found: list[tuple[TeamPart, ...]] = []
        for _, division in drawn[:PLANNED]:
            if found and self._spent >= EFFORT:
                break
            found.append(self._searched(division, shares))
        return min(found, key=time_of)

    def _planned(self, part: frozenset[int], children: int) -> TeamPart:
        """Plan for one team."""
        key = part, children
        if key not in self._known:
            self._spent += len(part)
            cells = [self._cells[place] for place in sorted(part)]
            plan = plan_team(
                self._zones,
                self._stops(part),
                parent=self._start,
                children=[self._start] * children,
                covered=[self._cells[place] for place in self._whole - part],
                in_file=self._in_file,
            )
            self._known[key] = TeamPart(tuple(cells), children, plan)
        return self._known[key]

    def _stops(self, part: frozenset[int]) -> list[Cell]:
        """Choose where a parent has to stand to see a part."""
        if len(part) == len(self._whole):
            return self._chosen.parents
        mask = np.zeros_like(self._chosen.sights.free)
        rows, cols = zip(*(self._cells[place] for place in part), strict=True)
        mask[list(rows), list(cols)] = True
        return parent_vertices(self._chosen.sights, self._chosen.reach.near, mask)

    # What is guessed.

    def _seeds(self, teams: int, rng: Stream) -> list[int]:
        """Draw a seed for each team, each far from those before; the farthest from the start first."""
        stride = self._grid.stride
        vertices = sorted(self._whole)
        seeds = [rng.choice(vertices)]
        near = distances(self._whole, seeds[0], stride)
        while len(seeds) < teams:
            (seed,) = rng.choices(vertices, [near[vertex] ** 2 for vertex in vertices])
            seeds.append(seed)
            moves = distances(self._whole, seed, stride)
            near = {vertex: min(near[vertex], moves[vertex]) for vertex in vertices}
        return sorted(seeds, key=lambda seed: -self._far[seed])

    def _settled(self, seeds: Sequence[int], shares: Sequence[int]) -> tuple[float, "_Division"]:
        """Let seeds and borders move by what is guessed; return the best division and its time."""
        division = _Division(tuple(seeds), (0.0,) * len(seeds))
        found = []
        for turn in range(SETTLE):
            parts = self._parts(division)
            times = [
                self._guess(part, children) for part, children in zip(parts, shares, strict=True)
            ]
            found.append((max(times), division))
            if turn < SETTLE // 2:
                division = division._replace(seeds=tuple(map(self._middle, parts)))
            division = self._evened(division, parts, times)
        return min(found)

    def _guess(self, part: AbstractSet[int], children: int) -> float:
        """Guess how many ticks a team takes."""
        if children not in self._work:
            self._work[children] = self._shared_ticks(children)
        work = self._work[children]
        return min(self._far[vertex] for vertex in part) + sum(
            work[vertex] for vertex in sorted(part)
        )

    def _shared_ticks(self, children: int) -> dict[int, float]:
        """Return the ticks that one team for everything takes, shared by the vertices."""
        ticks: dict[int, float] = {}
        before = 0
        for stop in self._planned(self._whole, children).plan.stops:
            share = (stop.covered - before) / len(stop.covers)
            ticks.update(dict.fromkeys((self._grid.place(*cell) for cell in stop.covers), share))
            before = stop.covered
        return ticks

    # Parts.

    def _parts(self, division: "_Division") -> list[frozenset[int]]:
        """Return the part of each seed."""
        blocked, stride = self._grid.blocked, self._grid.stride
        owner = {seed: team for team, seed in enumerate(division.seeds)}
        ahead = [
            (-head, team, seed) for team, (seed, head) in enumerate(zip(*division, strict=True))
        ]
        heapify(ahead)
        while ahead:
            moves, team, at = heappop(ahead)
            for to in (at - stride, at + 1, at + stride, at - 1):
                if not blocked[to] and to not in owner:
                    owner[to] = team
                    heappush(ahead, (moves + 1, team, to))
        parts: list[set[int]] = [set() for _ in division.seeds]
        for vertex, team in owner.items():
            parts[team].add(vertex)
        return [frozenset(part) for part in parts]

    def _middle(self, part: AbstractSet[int]) -> int:
        """Return the vertex of a part that is nearest to its middle as the crow flies."""
        cells = [self._cells[vertex] for vertex in part]
        size = len(cells)
        row, col = sum(row for row, _ in cells), sum(col for _, col in cells)
        # In whole numbers: all is times the size of the part.
        _, middle = min(
            ((size * cell[0] - row) ** 2 + (size * cell[1] - col) ** 2, cell) for cell in cells
        )
        return self._grid.place(*middle)

    def _evened(
        self, division: "_Division", parts: Sequence[AbstractSet[int]], times: Sequence[float]
    ) -> "_Division":
        """Move borders, so that teams take about equally long.

        A head start that grows by one moves the border by half a vertex all along.
        """
        blocked, stride = self._grid.blocked, self._grid.stride
        mean = sum(times) / len(times)
        most = sqrt(len(self._whole) / len(parts))
        heads = []
        for head, part, ticks in zip(division.heads, parts, times, strict=True):
            border = sum(
                any(
                    not blocked[to] and to not in part
                    for to in (at - stride, at + 1, at + stride, at - 1)
                )
                for at in part
            )
            change = DAMPING * (mean - ticks) * len(part) / (max(1.0, ticks) * border)
            heads.append(head + max(-most, min(most, change)))
        return division._replace(heads=tuple(heads))

    # What is planned.

    def _searched(self, division: "_Division", shares: Sequence[int]) -> tuple[TeamPart, ...]:
        """Move borders and children by what plans say; return the best found."""
        best = self._bordered(division, shares)
        while self._spent < EFFORT:
            teams = self._exchanged(best.teams)
            if teams is best.teams:
                break
            again = self._bordered(best.division, [team.children for team in teams])
            if time_of(again.teams) >= time_of(teams):
                return teams
            best = again
        return best.teams

    def _bordered(self, division: "_Division", shares: Sequence[int]) -> "_Found":
        """Move borders; return the best found."""
        found: list[_Found] = []
        for _ in range(ROUNDS):
            parts = self._parts(division)
            teams = tuple(map(self._planned, parts, shares))
            found.append(_Found(teams, division))
            if self._spent >= EFFORT:
                break
            division = self._evened(division, parts, [team.time[0] for team in teams])
        return min(found, key=lambda one: time_of(one.teams))

    def _exchanged(self, teams: tuple[TeamPart, ...]) -> tuple[TeamPart, ...]:
        """Give the slowest team children of others while that helps."""
        place = self._grid.place
        while True:
            slowest = max(range(len(teams)), key=lambda at: teams[at].time)
            givers = [at for at, team in enumerate(teams) if at != slowest and team.children > 1]
            if not givers:
                return teams
            giver = min(givers, key=lambda at: teams[at].time)
            changed = list(teams)
            for at, more in ((slowest, 1), (giver, -1)):
                part = frozenset(place(*cell) for cell in teams[at].part)
                changed[at] = self._planned(part, teams[at].children + more)
            if time_of(changed) >= time_of(teams):
                return teams
            teams = tuple(changed)


class _Division(NamedTuple):
    """What the parts grow from.

    Attributes:
        seeds: one for each team, all different.
        heads: the head start of each, in moves.
    """

    seeds: tuple[int, ...]
    heads: tuple[float, ...]


class _Found(NamedTuple):
    """Plans, and the division they were made for."""

    teams: tuple[TeamPart, ...]
    division: _Division
