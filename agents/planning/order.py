"""In which order to visit stops on a grid: a short open path over all of them from a given place.

Distances are those of shortest paths over free places. From each stop a search goes outwards until it
has met the nearest others; only these pairs have a distance, so that thousands of stops on a large
grid cost little. A path is built by always going on to the nearest stop not visited yet, and made
better while one of these does so:

    2-opt    a stretch is walked the other way round (or the whole end of the path)
    Or-opt   a stretch of up to three stops moves to another place, either way round

Then two stretches beside each other are swapped at random, again and again, and it is made better
from there; what does not pay is taken back. Edges between stops that know no distance of each other
may stay, but no new one is put in.

Paper:
    The parent-child paper, Sec. 3.3: "a standard heuristic" for the travelling salesman over distances
    by a distance transform. We leave the end of the path open, as the robots need not come back.
"""

from collections.abc import Sequence
from heapq import heappop, heappush
from itertools import pairwise

from protocol.grid import Grid
from protocol.seeds import Stream, spawn

NEAREST = 16
"""Stops whose distance each stop knows."""
SHIFTED = 3
"""Longest stretch that Or-opt moves."""

KICKS, MOST_KICKS = 10, 3000
"""Swaps at random for each stop, and in all."""
KICKED = 30
"""Longest two stretches that are swapped, together."""
LEAST_KICKED = 5
"""Nodes without which there are no two stretches."""

Distances = list[dict[int, int]]
"""For each stop the others that it knows a distance of, the nearest first."""


def visiting_order(grid: Grid, start: int, stops: Sequence[int]) -> list[int]:
    """Return stops in the order in which to visit them.

    Args:
        grid: the map.
        start: place where the path begins; it may be a stop.
        stops: places, all different, that can be reached from the start.
    """
    others = [stop for stop in stops if stop != start]
    nodes = [start, *others]
    known = near_distances(grid, nodes)
    path = _Path(_nearest_first(grid, nodes, known), known)
    path.improve(path.order[::-1])
    if len(nodes) > LEAST_KICKED:
        rng = spawn(len(nodes), "order")
        for _ in range(min(MOST_KICKS, KICKS * len(nodes))):
            path.kick(rng)
    found = [nodes[node] for node in path.order]
    return found if len(others) < len(stops) else found[1:]


def near_distances(grid: Grid, nodes: Sequence[int]) -> Distances:
    """Return the moves between each of some places and its `NEAREST` others, both ways."""
    names = {place: node for node, place in enumerate(nodes)}
    known: Distances = []
    wanted = min(NEAREST, len(nodes) - 1)
    for place in nodes:
        known.append(_search(grid, place, names, wanted))
    for node, found in enumerate(known):
        for other, moves in found.items():
            known[other].setdefault(node, moves)
    return [dict(sorted(found.items(), key=lambda pair: pair[::-1])) for found in known]


def _search(grid: Grid, place: int, names: dict[int, int], wanted: int) -> dict[int, int]:
    """Return the moves to the nearest named places, as many as are wanted."""
    blocked, stride = grid.blocked, grid.stride
    seen = {place}
    ring = [place]
    found: dict[int, int] = {}
    moves = 0
    while ring and len(found) < wanted:
        moves += 1
        wider = []
        for at in ring:
            for to in (at - stride, at + 1, at + stride, at - 1):
                if not blocked[to] and to not in seen:
                    seen.add(to)
                    wider.append(to)
        for to in wider:
            if to in names:
                found[names[to]] = moves
        ring = wider
    return found


def _nearest_first(grid: Grid, nodes: Sequence[int], known: Distances) -> list[int]:
    """Go on from node 0 to the nearest one not visited yet, again and again."""
    order = [0]
    left = set(range(1, len(nodes)))
    while left:
        at = order[-1]
        to = next((node for node in known[at] if node in left), None)
        if to is None:
            to = _beyond(known, at, left)
        if to is None:
            # The known distances do not lead out of here.
            names = {nodes[node]: node for node in left}
            to = min(_search(grid, nodes[at], names, 1))
        order.append(to)
        left.remove(to)
    return order


def _beyond(known: Distances, start: int, left: set[int]) -> int | None:
    """Return the nearest of some nodes over known distances."""
    done: set[int] = set()
    ahead = [(0, start)]
    while ahead:
        moves, node = heappop(ahead)
        if node in left:
            return node
        if node not in done:
            done.add(node)
            for to, more in known[node].items():
                if to not in done:
                    heappush(ahead, (moves + more, to))
    return None


class _Path:
    """An open path over all nodes that is made shorter; node 0 stays its beginning.

    Attributes:
        order: the nodes.
    """

    def __init__(self, order: list[int], known: Distances) -> None:
        """Take over a path."""
        self.order = order
        self._at = [0] * len(order)
        for at, node in enumerate(order):
            self._at[node] = at
        self._known = known
        # From where up to where it was changed since the last kick.
        self._dirty = [1, len(order)]

    def improve(self, touched: Sequence[int]) -> None:
        """Change the path at some nodes, and on from there, until no change makes it shorter."""
        todo = list(touched)
        waiting = set(todo)
        while todo:
            node = todo.pop()
            waiting.discard(node)
            while changed := self._changed(node):
                for other in changed:
                    if other not in waiting:
                        waiting.add(other)
                        todo.append(other)

    def kick(self, rng: Stream) -> None:
        """Swap two stretches that follow each other, improve, and keep that unless it is longer."""
        size = len(self.order)
        first = rng.randrange(1, size - 1)
        cuts = sorted(rng.sample(range(first, min(size, first + KICKED) + 1), 3))
        low, middle, high = cuts
        before = self.order.copy()
        self._dirty = [low, high]
        self._replace(low, before[middle:high] + before[low:middle])
        ends = (low - 1, low, low + high - middle - 1, low + high - middle, high - 1, high)
        self.improve([self.order[at] for at in ends if at < size])
        low, high = self._dirty
        if self._sum(self.order, low, high) > self._sum(before, low, high):
            self._replace(low, before[low:high])

    def _sum(self, order: Sequence[int], low: int, high: int) -> float:
        """Return the moves along a part of an order and into and out of it."""
        return sum(self._length(*pair) for pair in pairwise(order[low - 1 : high + 1]))

    def _changed(self, node: int) -> tuple[int, ...] | None:
        """Make the path shorter at a node; return the nodes that have other neighbours now."""
        return self._reverse_end(node) or self._reverse(node) or self._shift(node)

    def _length(self, one: int, other: int) -> float:
        """Return the known moves between neighbours on the path; one that is not known is long."""
        return self._known[one].get(other, 1 << 40)

    def _neighbour(self, at: int) -> int | None:
        return self.order[at] if 0 <= at < len(self.order) else None

    def _reverse_end(self, node: int) -> tuple[int, ...] | None:
        """Try to walk all behind a node the other way round."""
        order = self.order
        at = self._at[node] + 1
        new = self._known[node].get(order[-1])
        if at >= len(order) - 1 or new is None or new >= self._length(node, order[at]):
            return None
        touched = node, order[at], order[-1]
        self._replace(at, order[at:][::-1])
        return touched

    def _reverse(self, node: int) -> tuple[int, ...] | None:
        """Try 2-opt with each new edge from a node."""
        known = self._known
        at = self._at[node]
        for way in (1, -1):
            after = self._neighbour(at + way)
            if after is None:
                continue
            old = self._length(node, after)
            for other, new in known[node].items():
                if new >= old:
                    break
                beside = self._neighbour(self._at[other] + way)
                closing = None if beside is None else known[after].get(beside)
                if beside is None or closing is None:
                    continue
                if new + closing < old + self._length(other, beside):
                    low, high = sorted((at, self._at[other]))
                    first, end = (low + 1, high + 1) if way == 1 else (low, high)
                    self._replace(first, self.order[first:end][::-1])
                    return node, after, other, beside
        return None

    def _shift(self, node: int) -> tuple[int, ...] | None:
        """Try Or-opt with the stretches that have a node at one of their ends."""
        at = self._at[node]
        for length in range(1, SHIFTED + 1):
            for first in {at, at - length + 1}:
                end = first + length
                if first < 1 or end > len(self.order):
                    continue
                stretch = self.order[first:end]
                if (touched := self._shift_stretch(first, stretch, node)) is not None:
                    return touched
        return None

    def _shift_stretch(self, first: int, stretch: list[int], node: int) -> tuple[int, ...] | None:
        """Try to put a stretch elsewhere, ``node``, one of its ends, beside a near one."""
        known = self._known
        end = first + len(stretch)
        before, after = self.order[first - 1], self._neighbour(end)
        saved = self._length(before, stretch[0])
        if after is not None:
            bridged = known[before].get(after)
            if bridged is None:
                return None
            saved += self._length(stretch[-1], after) - bridged
        from_node = stretch if stretch[0] == node else stretch[::-1]
        for other, new in known[node].items():
            if new >= saved:
                break
            there = self._at[other]
            if first <= there < end:
                continue
            for way in (1, -1):
                added = self._added(from_node[-1], other, there + way)
                if added is None or first <= there + way < end or new + added >= saved:
                    continue
                self._move(first, from_node[::way], there + (way == 1))
                touched = (*stretch, before, after, other, self._neighbour(self._at[other] - way))
                return tuple(one for one in touched if one is not None)
        return None

    def _added(self, far: int, other: int, at: int) -> float | None:
        """Return what more an edge to a position takes from ``far`` than from ``other``."""
        if at == len(self.order):
            return 0
        beside = self._neighbour(at)
        closing = None if beside is None else self._known[far].get(beside)
        if beside is None or closing is None:
            return None
        return closing - self._length(other, beside)

    def _move(self, first: int, stretch: list[int], to: int) -> None:
        """Take the stretch at a position out, and put it, as given, before another position."""
        order, end = self.order, first + len(stretch)
        if to <= first:
            self._replace(to, stretch + order[to:first])
        else:
            self._replace(first, order[end:to] + stretch)

    def _replace(self, first: int, nodes: list[int]) -> None:
        """Let the path from a position on be as given."""
        end = first + len(nodes)
        self._dirty = [min(first, self._dirty[0]), max(end, self._dirty[1])]
        self.order[first:end] = nodes
        for at, node in enumerate(nodes, start=first):
            self._at[node] = at
