"""Roadmaps of child robots: who covers what of the vertices in sight of a parent that stands still.

Vertices are places of a `protocol.grid.Grid`. All is done with *rings*, closed walks that meet none of
their vertices twice, counter-clockwise: a coarse cell is one, and so is the way around a tree of
coarse cells. Where two rings lie side by side, an edge of each opposite the other, they join to one
ring, just as a tree edge joins what lies around it.

    1  the coarse cells (2 x 2, aligned) that lie within the vertices; a subtree for each child begins
       with one of the nearest to the parent
    2  they grow all in parallel: from the tip into the neighbour whose smallest Manhattan distance to
       the other tips is largest, else, branching out, from where it is nearest to the root
    3  beyond the coarse grid: squares of four vertices that no subtree holds are rings too; all join
       that lie side by side, and pairs of vertices beside an edge of a ring are put into it
    4  vertices that still are left, and rings that lie apart, hang on the ring by branches that are
       walked out and back, if need be over other vertices in sight: the redundant steps
    5  NB_MSTC: each child goes from its start up to the next child's; moves at either end of a part
       that cover nothing are left out

Paper:
    The parent-child paper, Sec. 3.4. It leaves open where leftover vertices are put in, and how pieces
    of the vertices that do not touch are reached. Departure: there children start in the cells that
    their subtrees began with, next to each other around the parent, and connections between subtrees
    are chosen to even out what follows each; here they start wherever on the ring the moves to the
    farthest start and along the longest part are the fewest together. With 5 children and 2.5 m on
    maps of 60 x 60 with 20 % obstacles that halves the coverage steps (1222 to 640, with 24 connections
    drawn for each parent), and saves a fifth of all.
"""

from collections import Counter, deque
from collections.abc import Iterator, Sequence
from collections.abc import Set as AbstractSet
from itertools import pairwise
from typing import NamedTuple

from agents.planning.trees import Sets


class Roadmaps(NamedTuple):
    """What the children do around one parent.

    Attributes:
        walks: a walk for each child that has one, vertex by vertex from its start; the others have
            nothing to cover. None is empty.
        redundant: steps that cover nothing.
    """

    walks: list[list[int]]
    redundant: int

    @property
    def steps(self) -> int:
        """Moves of the longest walk."""
        return max(map(len, self.walks), default=1) - 1


def child_roadmaps(
    vertices: AbstractSet[int], zone: AbstractSet[int], parent: int, children: int, stride: int
) -> Roadmaps:
    """Share vertices among children.

    Args:
        vertices: what to cover; part of the zone.
        zone: where children may go, connected: vertices in sight of the parent, itself among them.
        parent: where the parent stands.
        children: how many children there are, at least one.
        stride: places in a row of the grid.
    """
    if not vertices:
        return Roadmaps([], 0)
    distance = distances(zone, parent, stride)
    rings = _Rings(vertices, stride)
    _grow(rings, _roots(rings, distance, children))
    rings.absorb()
    start = min(vertices, key=lambda vertex: (distance[vertex], vertex))
    walk = _closed_walk(rings, vertices, zone, start)
    return _shared(walk, vertices, _cuts(walk, distance, parent, children))


def distances(zone: AbstractSet[int], start: int, stride: int) -> dict[int, int]:
    """Return the moves from a place to all places of a zone that can be reached, nearest first."""
    found = {start: 0}
    ahead = [start]
    for place in ahead:
        far = found[place] + 1
        for to in (place - stride, place + 1, place + stride, place - 1):
            if to in zone and to not in found:
                found[to] = far
                ahead.append(to)
    return found


class _Rings:
    """Rings that cover vertices, and vertices that are on none.

    Attributes:
        stride: places in a row.
        next: the vertex that follows each on its ring.
        left: vertices on no ring.
        ids: which vertices are on one ring.
    """

    def __init__(self, vertices: AbstractSet[int], stride: int) -> None:
        """Begin without rings."""
        self.stride = stride
        self.next: dict[int, int] = {}
        self.left = set(vertices)
        self.ids = Sets(vertices)

    def is_square(self, corner: int) -> bool:
        """Tell whether four vertices, of which ``corner`` is the north-western, are on no ring."""
        left, below = self.left, corner + self.stride
        return corner in left and corner + 1 in left and below in left and below + 1 in left

    def add_square(self, corner: int) -> None:
        """Make four vertices a ring."""
        ring = (corner, corner + self.stride, corner + self.stride + 1, corner + 1)
        for at, vertex in enumerate(ring):
            self.next[vertex] = ring[(at + 1) % 4]
            self.left.remove(vertex)
            self.ids.unite(corner, vertex)

    def add_squares(self) -> None:
        """Make all squares rings, those of the coarse grid first."""
        corners = sorted(self.left)
        aligned = [corner for corner in corners if is_aligned(corner, self.stride)]
        for corner in (*aligned, *corners):
            if self.is_square(corner):
                self.add_square(corner)

    def join(self, one: int, beside: int) -> bool:
        """Join the rings of two adjacent vertices behind ``one`` and before ``beside``, if they fit.

        The edge that leaves ``one`` and that which leads to ``beside`` must lie side by side.
        """
        after = self.next.get(one)
        if after is None:
            return False
        before = after + beside - one
        if self.next.get(before) != beside or self.ids.find(one) == self.ids.find(beside):
            return False
        self.next[one], self.next[before] = beside, after
        self.ids.unite(one, beside)
        return True

    def absorb(self) -> None:
        """Join all rings that lie side by side, and put squares and pairs that are left into them."""
        self.add_squares()
        ahead = deque(self.next)
        while ahead:
            one = ahead.popleft()
            after = self.next[one]
            for side in _sides(after - one, self.stride):
                beside, beyond = one + side, after + side
                if beside in self.left and beyond in self.left:
                    self.next.update({one: beside, beside: beyond, beyond: after})
                    self.left -= {beside, beyond}
                    self.ids.unite(one, beside)
                    self.ids.unite(one, beyond)
                    ahead += (one, beside, beyond)
                    break
                if self.join(one, beside):
                    ahead += (one, beyond)
                    break

    def ring(self, vertex: int) -> Iterator[int]:
        """Yield the ring of a vertex, beginning with it; of a vertex on no ring itself alone."""
        at = vertex
        while True:
            yield at
            at = self.next.get(at, vertex)
            if at == vertex:
                return


def is_aligned(corner: int, stride: int) -> bool:
    """Tell whether a place is the north-western one of its coarse cell."""
    row, col = divmod(corner, stride)
    return not (row % 2 or col % 2)


def _sides(step: int, stride: int) -> tuple[int, int]:
    """Return the steps to both sides of an edge."""
    return (stride, -stride) if step in (1, -1) else (1, -1)


def _roots(rings: _Rings, distance: dict[int, int], children: int) -> list[int]:
    """Return a coarse cell for each child, the nearest ones to the parent."""
    stride = rings.stride
    near: list[tuple[int, int]] = []
    for corner in rings.left:
        if is_aligned(corner, stride) and rings.is_square(corner):
            cell = (corner, corner + 1, corner + stride, corner + stride + 1)
            near.append((min(distance[vertex] for vertex in cell), corner))
    return [corner for _, corner in sorted(near)[:children]]


def _grow(rings: _Rings, roots: Sequence[int]) -> None:
    """Grow a subtree from each root, all in parallel, until there is no room."""
    stride = rings.stride
    for root in roots:
        rings.add_square(root)
    tips = [divmod(root, stride) for root in roots]
    subtrees = [[root] for root in roots]
    growing = list(range(len(roots)))
    walking = set(growing)
    while growing:
        for subtree in list(growing):
            cells = subtrees[subtree]
            if subtree in walking:
                to = _way_on(rings, cells[-1], tips[:subtree] + tips[subtree + 1 :])
                if to is not None:
                    _extend(rings, cells[-1], to)
                    cells.append(to)
                    tips[subtree] = divmod(to, stride)
                    continue
                walking.remove(subtree)
            if not _branch(rings, cells):
                growing.remove(subtree)


def _way_on(rings: _Rings, tip: int, others: Sequence[tuple[int, int]]) -> int | None:
    """Return the free neighbour of a tip that is farthest from the nearest other tip."""
    best, most = None, -1
    for to in _neighbours(tip, rings.stride):
        if is_aligned(to, rings.stride) and rings.is_square(to):
            row, col = divmod(to, rings.stride)
            least = min((abs(row - r) + abs(col - c) for r, c in others), default=0)
            if least > most:
                best, most = to, least
    return best


def _branch(rings: _Rings, cells: list[int]) -> bool:
    """Let a subtree grow by a cell, as near to the beginning of ``cells`` as possible."""
    while cells:
        for to in _neighbours(cells[0], rings.stride):
            if is_aligned(to, rings.stride) and rings.is_square(to):
                _extend(rings, cells[0], to)
                cells.append(to)
                return True
        # No cell ever becomes free, so there will be no room here later.
        cells.pop(0)
    return False


def _neighbours(corner: int, stride: int) -> tuple[int, int, int, int]:
    """Return the cells north, east, south and west of a cell, by their corners."""
    return corner - 2 * stride, corner + 2, corner + 2 * stride, corner - 2


def _extend(rings: _Rings, cell: int, to: int) -> None:
    """Join a free cell to the ring of its neighbour."""
    stride = rings.stride
    rings.add_square(to)
    # The vertex from which the ring leaves the cell on this side, and the one beside it.
    ways = {
        -2 * stride: (cell + 1, cell + 1 - stride),
        2: (cell + stride + 1, cell + stride + 2),
        2 * stride: (cell + stride, cell + 2 * stride),
        -2: (cell, cell - 1),
    }
    joined = rings.join(*ways[to - cell])
    assert joined, "between neighbours of a tree nothing else lies"


def _closed_walk(
    rings: _Rings, vertices: AbstractSet[int], zone: AbstractSet[int], start: int
) -> list[int]:
    """Go once around the ring of the start, and around all that hangs on it.

    Returns:
        A closed walk over all vertices; the last one lies beside the first, or is the only one.
    """
    hanging = _hang(rings, vertices, zone, start)
    walk: list[int] = []
    to_come = list(rings.ring(start))[::-1]
    while to_come:
        walk.append(at := to_come.pop())
        for branch in reversed(hanging.pop(at, [])):
            around = list(rings.ring(branch))
            to_come += [at, *around[:1] * (len(around) > 1), *reversed(around)]
    # Around a single vertex the walk has come back to it by now.
    return walk if len(walk) == 1 or walk[-1] != walk[0] else walk[:-1]


def _hang(
    rings: _Rings, vertices: AbstractSet[int], zone: AbstractSet[int], start: int
) -> dict[int, list[int]]:
    """Find the branches that lead from the ring of the start to all other vertices.

    Returns:
        The vertices that hang on a vertex; one on a ring stands for that ring.
    """
    stride = rings.stride
    hanging: dict[int, list[int]] = {}
    ring = list(rings.ring(start))
    waiting = set(vertices).difference(ring)
    reached: list[int] = []
    ahead = deque(ring)

    def hang(at: int, to: int) -> None:
        hanging.setdefault(at, []).append(to)
        around = list(rings.ring(to))
        waiting.difference_update(around)
        ahead.extend(around)

    while waiting:
        while ahead:
            reached.append(at := ahead.popleft())
            for to in (at - stride, at + 1, at + stride, at - 1):
                if to in waiting:
                    hang(at, to)
        if waiting:
            for at, to in pairwise(_way(zone, reached, waiting, stride)):
                hang(at, to)
    return hanging


def _way(
    zone: AbstractSet[int], starts: Sequence[int], targets: AbstractSet[int], stride: int
) -> list[int]:
    """Return a shortest way through a zone from one of some vertices to one of others."""
    came = dict.fromkeys(starts, -1)
    ahead = list(starts)
    for at in ahead:
        if at in targets:
            way = [at]
            while came[way[-1]] >= 0:
                way.append(came[way[-1]])
            return way[::-1]
        for to in (at - stride, at + 1, at + stride, at - 1):
            if to in zone and to not in came:
                came[to] = at
                ahead.append(to)
    raise ValueError("the zone is not connected")


def _shared(walk: Sequence[int], vertices: AbstractSet[int], cuts: Sequence[int]) -> Roadmaps:
    """Cut a closed walk, and leave out what covers nothing at either end of a part.

    Args:
        walk: the walk.
        vertices: what it covers.
        cuts: ascending positions where parts begin, at least one.
    """
    around = [*walk[cuts[0] :], *walk[: cuts[0]]]
    visits = Counter(walk)
    walks = []
    for first, end in pairwise([*(cut - cuts[0] for cut in cuts), len(walk)]):
        part = deque(around[first:end])
        for take, at in ((part.pop, -1), (part.popleft, 0)):
            while part and (part[at] not in vertices or visits[part[at]] > 1):
                visits[take()] -= 1
        if part:
            walks.append(list(part))
    return Roadmaps(walks, sum(map(len, walks)) - len(vertices))


def _cuts(walk: Sequence[int], distance: dict[int, int], parent: int, children: int) -> list[int]:
    """Choose where on a closed walk the children begin.

    The fewest moves to the farthest start and along the longest part together.
    """
    far = [distance[vertex] if vertex != parent else len(walk) for vertex in walk]
    least = -(-len(walk) // children)
    best: tuple[int, list[int]] = (3 * len(walk), [0])
    for limit in sorted(set(far)):
        if limit + least - 1 >= best[0]:
            break
        # The last place up to each position, twice around, where a part may begin.
        doors: list[int] = []
        for at, moves in enumerate([*far, *far]):
            doors.append(at if moves <= limit else (doors[-1] if at else -1))
        low, high = least, best[0] - limit
        while low <= high:
            middle = (low + high) // 2
            cuts = _cuts_within(doors, middle, children)
            if cuts is None:
                low = middle + 1
            else:
                best, high = (limit + middle - 1, cuts), middle - 1
    return best[1]


def _cuts_within(doors: Sequence[int], longest: int, most: int) -> list[int] | None:
    """Cut a closed walk into parts of at most so many vertices; ``None`` if that takes too many.

    Args:
        doors: for each position, twice around, the last one up to it where a part may begin.
        longest: vertices of a part at most.
        most: parts at most.
    """
    length = len(doors) // 2
    if longest >= length:
        first = doors[length - 1]
        return [first] if first >= 0 else None
    for first in range(longest):
        if doors[first] != first:
            continue
        cuts = [first]
        while len(cuts) < most and cuts[-1] + longest < first + length:
            cuts.append(doors[cuts[-1] + longest])
            if cuts[-1] <= cuts[-2]:
                break
        if cuts[-1] + longest >= first + length:
            return sorted(cut % length for cut in cuts)
    return None
