"""Coordinated moves of a parent robot and its children, tick by tick, none ever left behind.

A child moves in a tick only if the parent sees it when the tick begins. So the parent goes on only
where it will see every child, now and on the whole way that the child has to go up to the parent
itself: then each child can go on, tick by tick, whatever the parent waits for. Children follow on the
parent's own path, in single file where it is narrow, at least one cell behind; they walk while the
parent walks, all of them at once if need be, as cells hold several. A child in the cell that the
parent has just left is in sight wherever it goes, so that the team always gets on.

While children cover vertices the parent stands still, but for one step off its vertex and back when a
child covers that.

Paper:
    The parent-child paper, Sec. 3.5 ("a chain of robots and, e.g., a leader-follower formation
    control") and 3.4 on the parent's own vertex. What the team does while somebody is out of sight is
    ours.
"""

from collections.abc import Callable, Iterable, Sequence
from collections.abc import Set as AbstractSet
from functools import lru_cache

from agents.planning.child_roadmaps import distances
from protocol.grid import Cell, Grid

STAY = 4
"""A tick without a move; the exits are 0 to 3."""


class Zones:
    """What is in sight, and where children can be sent, from each place of a grid.

    Attributes:
        grid: the map.
        seen: the places in sight of a place, itself among them.
        zone: those of them that can be reached without leaving sight.
    """

    def __init__(self, grid: Grid, see: Callable[[Cell], Iterable[Cell]]) -> None:
        """Take what tells the cells in sight of a cell, itself and its free neighbours among them."""
        self.grid = grid
        place, position = grid.place, grid.position

        @lru_cache(maxsize=512)
        def seen(at: int) -> frozenset[int]:
            return frozenset(place(*cell) for cell in see(position(at)))

        @lru_cache(maxsize=512)
        def zone(at: int) -> frozenset[int]:
            return frozenset(distances(seen(at), at, grid.stride))

        self.seen: Callable[[int], frozenset[int]] = seen
        self.zone: Callable[[int], frozenset[int]] = zone


class Task:
    """What a child does around a parent that stands still.

    Attributes:
        route: the places to go to, one a tick: first to the start of its walk, then along it, then
            back to the parent, whose place is the last one. Empty if the child is there already.
        start: after how many of them it is at the start of its walk.
        end: after how many of them it is done with it.
        done: how many it has gone to.
    """

    __slots__ = ("done", "end", "route", "start")

    def __init__(self, route: list[int], start: int, end: int) -> None:
        """Describe a task that has not begun."""
        self.route = route
        self.start = start
        self.end = end
        self.done = 0


class Team:
    """Where the robots stand, and how they came there.

    Attributes:
        parent: its place.
        children: place of each.
        moves: for each robot, the parent first, the exit by which it leaves in each tick, or `STAY`.
        walked: ticks that only brought children to the parent or the team to another place.
    """

    def __init__(self, zones: Zones, parent: int, children: Sequence[int]) -> None:
        """Begin with robots that stand still."""
        self._zones = zones
        self.parent = parent
        self.children = list(children)
        self.moves = [bytearray() for _ in range(1 + len(children))]
        self._exits = {0: STAY} | dict(zip(_steps(zones.grid.stride), range(4), strict=True))

    @property
    def ticks(self) -> int:
        """How many ticks there have been."""
        return len(self.moves[0])

    def pick_up(self) -> None:
        """Go to all children that are not in the parent's zone, the nearest first.

        Raises:
            ValueError: If one cannot be reached.
        """
        zone = self._zones.zone
        while lost := set(self.children) - zone(self.parent):
            path = shortest_path(self._zones.grid, self.parent, lost)
            met = next(at for at, place in enumerate(path) if path[-1] in zone(place))
            self.follow(path[: met + 1])

    def follow(self, path: Sequence[int], tasks: Sequence[Task] | None = None) -> None:
        """Go along a path, with all children in the parent's zone.

        Args:
            path: from the parent's place on.
            tasks: of the children, if they are on their ways back.
        """
        stride, zone = self._zones.grid.stride, self._zones.zone(self.parent)
        ways = distances(zone, self.parent, stride)
        files: list[tuple[int, list[int], int]] = []
        for child, place in enumerate(self.children):
            if place in zone:
                home = (
                    tasks[child].route[tasks[child].done :]
                    if tasks
                    else way_down(ways, place, stride)
                )
                # The last one is the parent's place at the path's beginning.
                files.append((child, [place, *home, *path[1:-1]], len(home)))
        gone = [0] * len(files)
        reached = 0
        while reached < len(path) - 1:
            seen = self._zones.seen(path[reached + 1])
            ahead = [
                min(at + 1, behind + reached)
                for at, (_, _, behind) in zip(gone, files, strict=True)
            ]
            goes = all(
                seen.issuperset(file[at : behind + reached + 1])
                for at, (_, file, behind) in zip(ahead, files, strict=True)
            )
            if not goes:
                ahead = [
                    max(at, min(at + 1, behind + reached - 1))
                    for at, (_, _, behind) in zip(gone, files, strict=True)
                ]
                assert ahead != gone, "a child beside the parent can follow it anywhere"
            reached += goes
            gone = ahead
            self._tick(
                path[reached],
                {child: file[at] for at, (child, file, _) in zip(gone, files, strict=True)},
            )

    def cover(self, tasks: Sequence[Task], *, own: bool) -> tuple[int, int]:
        """Let the children do their tasks, up to the ends of all walks; those done go back.

        Args:
            tasks: by child.
            own: whether the vertex on which the parent stands is to be covered.

        Returns:
            The ticks at which all children were at their starts, and done.
        """
        vertex = self.parent
        entries = [entry for task in tasks if (entry := _entry(task, vertex)) is not None]
        off = min(entries, default=0) if own else 0
        started = done = self.ticks
        while self.parent != vertex or any(task.done < task.end for task in tasks):
            if any(task.done < task.start for task in tasks):
                started = self.ticks + 1
            if any(task.done < task.end for task in tasks):
                done = self.ticks + 1
            seen = self._zones.seen(self.parent)
            places: dict[int, int] = {}
            parent = vertex
            for child, task in enumerate(tasks):
                # The parent's own place is entered on the way back only when the parent leaves it.
                if task.done < max(task.end, len(task.route) - 1) and self.children[child] in seen:
                    places[child] = task.route[task.done]
                    task.done += 1
            if off and any(task.done == off == _entry(task, vertex) for task in tasks):
                parent, off = self._beside(vertex, places, tasks), 0
            self._tick(parent, places)
        return started, done

    def _beside(self, vertex: int, places: dict[int, int], tasks: Sequence[Task]) -> int:
        """Return the place beside the parent's vertex from which those are seen who have to go on."""
        grid = self._zones.grid
        best, least = vertex, -1
        for step in _steps(grid.stride):
            if grid.blocked[vertex + step]:
                continue
            seen = self._zones.seen(vertex + step)
            hidden = max(
                (
                    task.end - task.done
                    for child, task in enumerate(tasks)
                    if places.get(child, self.children[child]) not in seen
                ),
                default=0,
            )
            if least < 0 or hidden < least:
                best, least = vertex + step, hidden
        return best

    def _tick(self, parent: int, children: dict[int, int]) -> None:
        """Move robots; children that are not named stay."""
        self.moves[0].append(self._exits[parent - self.parent])
        self.parent = parent
        for child, place in enumerate(self.children):
            to = children.get(child, place)
            self.moves[1 + child].append(self._exits[to - place])
            self.children[child] = to


def _entry(task: Task, vertex: int) -> int | None:
    """Return after how many moves a child covers a vertex on its walk, if it enters it."""
    for at in range(max(task.start, 1) - 1, task.end):
        if task.route[at] == vertex:
            return at + 1
    return None


def shortest_path(grid: Grid, start: int, targets: AbstractSet[int]) -> list[int]:
    """Return a shortest way over free places from a place to the nearest of others.

    Raises:
        ValueError: If there is none.
    """
    blocked, stride = grid.blocked, grid.stride
    came = {start: start}
    ahead = [start]
    for at in ahead:
        if at in targets:
            way = [at]
            while way[-1] != start:
                way.append(came[way[-1]])
            return way[::-1]
        for to in (at - stride, at + 1, at + stride, at - 1):
            if not blocked[to] and to not in came:
                came[to] = at
                ahead.append(to)
    raise ValueError(f"{grid.position(start)} is apart from {grid.position(min(targets))}")


def way_down(moves: dict[int, int], place: int, stride: int) -> list[int]:
    """Return a shortest way from a place to where its moves are counted from, itself left out."""
    way = []
    for left in range(moves[place] - 1, -1, -1):
        place = next(
            to
            for to in (place - stride, place + 1, place + stride, place - 1)
            if moves.get(to) == left
        )
        way.append(place)
    return way


def _steps(stride: int) -> tuple[int, int, int, int]:
    """Return what each exit adds to a place."""
    return -stride, 1, stride, -1
