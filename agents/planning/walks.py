"""From the parts of a tour to walks of sub-cells.

A robot covers the smaller side of its part, comes back over its start, and covers the larger one. A
closed walk then leads home. On the way home a robot may leave its part, but enters only sub-cells that
are covered by then, so that closing walks changes no first visit and no coverage time.

Departure:
    Agmon et al. 2008 ends when all is covered; the way home is ours.
"""

from collections.abc import Mapping, Sequence
from heapq import heappop, heappush

from agents.planning.splits import Split
from agents.planning.tour import Places
from protocol.grid import STEPS, Cell

EFFORT = 2_000_000
"""Sub-cells looked at in search of ways home at most, shared by all robots. A robot that has used up
its share comes home by its own part."""


def open_walks(tour: Sequence[Cell], places: Places, split: Split) -> list[list[Cell]]:
    """Return the walk on which each robot covers its part, up to the last sub-cell of that.

    Args:
        tour: the sub-cells of the tour.
        places: where the robots stand on it.
        split: their parts.

    Returns:
        The walks by robot, each from its start; every two cells that follow each other are adjacent.
    """
    walks: list[list[Cell]] = [[] for _ in places.order]
    length = len(tour)
    for robot, at, back, ahead in zip(
        places.order, places.at, split.back, split.ahead, strict=True
    ):
        behind = range(at - 1, at - back - 1, -1)
        before = range(at + 1, at + ahead + 1)
        first, last = (behind, before) if back <= ahead else (before, behind)
        steps = [at, *first, *reversed(first[:-1]), *([at] if first else []), *last]
        walks[robot] = [tour[step % length] for step in steps]
    return walks


def closed_walks(walks: Sequence[Sequence[Cell]]) -> list[list[Cell]]:
    """Lead each robot home.

    Args:
        walks: by robot; no sub-cell belongs to two of them.

    Returns:
        The walks, each prolonged to its start.
    """
    covered = first_visits(walks)
    effort = EFFORT // len(walks)
    ways = []
    for walk in walks:
        way = _home(walk, covered, effort)
        if way is None:
            # Each sub-cell is met at most once from each of its neighbours.
            way = _home(walk, dict.fromkeys(walk, 0), 4 * len(walk) + 1)
        assert way is not None, "a robot can go back as it came"
        ways.append([*walk, *way])
    return ways


def first_visits(walks: Sequence[Sequence[Cell]]) -> dict[Cell, int]:
    """Return the time at which each sub-cell is first visited, if each move takes one."""
    visits: dict[Cell, int] = {}
    for walk in walks:
        for time, cell in enumerate(walk):
            if time < visits.get(cell, time + 1):
                visits[cell] = time
    return visits


def _home(walk: Sequence[Cell], covered: Mapping[Cell, int], effort: int) -> list[Cell] | None:
    """Find a short way from the end of a walk to its start (A*).

    Args:
        walk: leads from the start to the end.
        covered: since when each sub-cell may be entered.
        effort: how many sub-cells to look at.

    Returns:
        The sub-cells after the end of the walk; ``None`` if more effort was needed.
    """
    (row_home, col_home), end = walk[0], walk[-1]
    time = len(walk) - 1
    came = {end: (time, end)}
    # Estimated end, time (of equals the later first) and sub-cell.
    ahead = [(time, -time, end)]
    for _ in range(effort):
        if not ahead:
            break
        _, minus_time, cell = heappop(ahead)
        if cell == walk[0]:
            way = []
            while cell != end:
                way.append(cell)
                cell = came[cell][1]
            return way[::-1]
        row, col = cell
        time = 1 - minus_time
        for down, right in STEPS:
            to = row + down, col + right
            if covered.get(to, time + 1) <= time and (to not in came or time < came[to][0]):
                came[to] = (time, cell)
                left = abs(to[0] - row_home) + abs(to[1] - col_home)
                heappush(ahead, (time + left, -time, to))
    return None
