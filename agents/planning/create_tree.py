"""Create_Tree, first stage: a subtree for each robot, grown away from the others.

One cycle after another each subtree grows by the first of these that it can:

    walk        its main path goes on from its tip, to the neighbour whose smallest distance to the
                other tips is largest (of equals the first: north, south, east, west)
    hilling     a hill of two cells is put into the main path, as near to the tip as possible: an edge
                a - b becomes a - a' - b' - b (of a vertical edge east before west, of a horizontal one
                north before south); the tip stays
    branching   a cell is added as near to the root as possible, counted along the subtree

The first, walking, never works again once it has failed, and the same holds for a hill on an edge and
for branching at a cell, as no cell ever becomes free. So each fails but once, and growing takes time
linear in the cells, times the robots for the distances.

Paper:
    Agmon et al. 2008, Sec. 3.2 (Algorithm 1, lines 1 to 10; Fig. 4) and 3.2.1. The paper leaves open
    the order of directions and edges. Robots that start in the same coarse cell share a subtree, which
    grows once a cycle; subtrees take turns by the lowest number of their robots.
"""

from collections import deque
from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple

from agents.algorithms.stc import AWAY, OPPOSITE, Tree, row_and_column
from protocol.grid import EAST, NORTH, SOUTH, WEST, Cell

ORDER = (NORTH, SOUTH, EAST, WEST)
SIDES = ((EAST, WEST), (NORTH, SOUTH), (EAST, WEST), (NORTH, SOUTH))
"""Where to put a hill, by the direction of the edge."""

Choose = Callable[[int, Sequence[int], Sequence[int]], int]
"""Takes a tip, at least two directions in which it can go on, and the other tips, at least one;
returns one of the directions."""


class Forest(NamedTuple):
    """What has grown.

    Attributes:
        tree: all subtrees; each is a component of its own.
        roots: coarse start cell of each subtree, no two alike.
        owner: subtree of each cell.
        growths: how often a subtree walked, was hilled, and branched.
    """

    tree: Tree
    roots: tuple[int, ...]
    owner: dict[int, int]
    growths: tuple[int, int, int]

    @property
    def sizes(self) -> list[int]:
        """Cells of each subtree."""
        sizes = [0] * len(self.roots)
        for subtree in self.owner.values():
            sizes[subtree] += 1
        return sizes


def grow_forest(cells: Collection[int], starts: Sequence[int], distance: str) -> Forest:
    """Grow a subtree from each distinct start until all cells have one.

    Args:
        cells: connected coarse cells.
        starts: coarse start cell of each robot, by robot.
        distance: how far apart tips are, a key of `DISTANCES`.

    Raises:
        KeyError: If there is no such distance, or a start is not among the cells.
        ValueError: If the cells are not connected.
    """
    roots = tuple(dict.fromkeys(starts))
    vacant = set(cells)
    choose = DISTANCES[distance](frozenset(cells))
    for root in roots:
        vacant.remove(root)
    tree = Tree()
    owner = {root: subtree for subtree, root in enumerate(roots)}
    tips = list(roots)
    growing = [_Subtree(subtree, root, tree, vacant, tips) for subtree, root in enumerate(roots)]
    growths = [0, 0, 0]
    while vacant:
        for subtree in growing:
            if (growth := subtree.grow(choose)) is not None:
                growths[growth.how] += 1
                owner.update(dict.fromkeys(growth.cells, subtree.index))
        growing = [subtree for subtree in growing if not subtree.is_grown]
        if vacant and not growing:
            raise ValueError(f"{len(vacant)} cells are not connected with a start")
    return Forest(tree, roots, owner, (growths[0], growths[1], growths[2]))


WALKED, HILLED, BRANCHED = range(3)


class _Growth(NamedTuple):
    how: int
    cells: tuple[int, ...]


class _Subtree:
    """A subtree that grows.

    Attributes:
        index: which one of the forest.
        is_grown: whether it will never grow again.
    """

    def __init__(
        self, index: int, root: int, tree: Tree, vacant: set[int], tips: list[int]
    ) -> None:
        """Begin with a root; ``tree``, ``vacant`` and ``tips`` are shared by the forest."""
        self.index = index
        self.is_grown = False
        self._tree = tree
        self._vacant = vacant
        self._tips = tips
        self._walks = True
        # Edges of the main path on which a hill may still find room: an end and the direction away
        # from the root, the edge at the tip last.
        self._edges: list[tuple[int, int]] = []
        # Cells at which a branch may still find room, breadth first, each with the direction of its
        # parent. The subtree is whole but for branches when they are looked at first.
        self._ahead = deque([(root, -1)])
        tree.root(root)

    def grow(self, choose: Choose) -> _Growth | None:
        """Grow by one or two cells; return ``None`` if there is no room."""
        if self._walks:
            if (growth := self._walk(choose)) is not None:
                return growth
            self._walks = False
        growth = self._hill() or self._branch()
        self.is_grown = growth is None
        return growth

    def _walk(self, choose: Choose) -> _Growth | None:
        tip = self._tips[self.index]
        ways = [way for way in ORDER if tip + AWAY[way] in self._vacant]
        if not ways:
            return None
        others = self._tips[: self.index] + self._tips[self.index + 1 :]
        way = choose(tip, ways, others) if len(ways) > 1 and others else ways[0]
        self._edges.append((tip, way))
        self._tips[self.index] = to = self._add(tip, way)
        return _Growth(WALKED, (to,))

    def _hill(self) -> _Growth | None:
        edges = self._tree.edges
        while self._edges:
            near, way = self._edges.pop()
            far = near + AWAY[way]
            for side in SIDES[way]:
                beside_near, beside_far = near + AWAY[side], far + AWAY[side]
                if beside_near in self._vacant and beside_far in self._vacant:
                    edges[near] &= ~(1 << way)
                    edges[far] &= ~(1 << OPPOSITE[way])
                    self._add(near, side)
                    self._add(beside_near, way)
                    self._tree.join(beside_far, OPPOSITE[side])
                    self._edges += ((near, side), (beside_near, way), (beside_far, OPPOSITE[side]))
                    return _Growth(HILLED, (beside_near, beside_far))
        return None

    def _branch(self) -> _Growth | None:
        edges = self._tree.edges
        while self._ahead:
            cell, parent = self._ahead[0]
            for way in ORDER:
                if cell + AWAY[way] in self._vacant:
                    return _Growth(BRANCHED, (self._add(cell, way),))
            self._ahead.popleft()
            self._ahead.extend(
                (cell + AWAY[way], OPPOSITE[way])
                for way in ORDER
                if edges[cell] >> way & 1 and way != parent
            )
        return None

    def _add(self, cell: int, way: int) -> int:
        to = self._tree.join(cell, way)
        self._vacant.remove(to)
        return to


# Distances.


def _by_position(apart: Callable[[int, int], int]) -> Callable[[Collection[int]], Choose]:
    """Return what chooses by a distance that depends on differences of rows and columns only."""

    def choose(tip: int, ways: Sequence[int], others: Sequence[int]) -> int:
        positions: list[Cell] = [row_and_column(other) for other in others]
        best_way, best = -1, -1
        for way in ways:
            row, col = row_and_column(tip + AWAY[way])
            least = min([apart(row - r, col - c) for r, c in positions])
            if least > best:
                best_way, best = way, least
        return best_way

    return lambda _: choose


def _manhattan(rows: int, cols: int) -> int:
    return abs(rows) + abs(cols)


def _euclid_squared(rows: int, cols: int) -> int:
    return rows * rows + cols * cols


def _by_shortest_path(cells: Collection[int]) -> Choose:
    """Return what chooses by the length of a shortest path over all cells, taken or not.

    A path is never shorter than the Manhattan distance, and as short if it never turns back. So
    where such a path leads to the tip that is nearest by Manhattan distance, that distance is what is
    asked for. Else paths are searched for.
    """
    leads = _Lines(cells).lead
    searched = _by_search(cells)

    def choose(tip: int, ways: Sequence[int], others: Sequence[int]) -> int:
        positions = [row_and_column(other) for other in others]
        best_way, best = -1, -1
        for way in ways:
            row, col = row_and_column(tip + AWAY[way])
            least, r, c = min([(abs(row - r) + abs(col - c), r, c) for r, c in positions])
            if not leads(row, col, r, c):
                return searched(tip, ways, others)
            if least > best:
                best_way, best = way, least
        return best_way

    return choose


class _Lines:
    """The rows of a map as bits, to find paths that never turn back."""

    def __init__(self, cells: Collection[int]) -> None:
        positions = [row_and_column(cell) for cell in cells]
        rows, self._cols = (1 + max(axis) for axis in zip(*positions, strict=True))
        # A bit for each cell: from west to east the higher, and the other way round.
        self._eastward, self._westward = [0] * rows, [0] * rows
        for row, col in positions:
            self._eastward[row] |= 1 << col
            self._westward[row] |= 1 << self._cols - 1 - col

    def lead(self, row: int, col: int, to_row: int, to_col: int) -> bool:
        """Tell whether a path as short as the Manhattan distance leads from cell to cell."""
        if to_row < row:
            row, col, to_row, to_col = to_row, to_col, row, col
        lines = self._eastward
        if to_col < col:
            lines, col, to_col = self._westward, self._cols - 1 - col, self._cols - 1 - to_col
        reached = 1 << col
        for line in lines[row : to_row + 1]:
            # Onto this row from the one above, then along it: adding carries each bit to the end of
            # its run of free cells.
            reached &= line
            reached |= (line + reached ^ line) & line
        return bool(reached >> to_col & 1)


def _by_search(cells: Collection[int]) -> Choose:
    """Return what chooses by the length of a shortest path, found by searching.

    A neighbour of the tip is one nearer to a cell if a shortest path from the tip leads over it, else
    one farther. So one search from the tip answers for all its neighbours: with the nearest tip
    ``d`` away, a neighbour has ``d - 1`` if it is on the way to one of those, else ``d`` if it is on
    the way to one at ``d + 1``, else ``d + 1``.
    """

    def choose(tip: int, ways: Sequence[int], others: Sequence[int]) -> int:
        targets = set(others)
        seen = {tip}
        # Cells at one distance, with the first directions of the shortest paths there, as bits.
        ring = {tip + AWAY[way]: 1 << way for way in ORDER if tip + AWAY[way] in cells}
        nearest: int | None = None
        while ring:
            seen.update(ring)
            hit = 0
            for cell in targets.intersection(ring):
                hit |= ring[cell]
            if nearest is not None:
                return _first_off(ways, nearest, hit)
            if hit:
                nearest = hit
            wider: dict[int, int] = {}
            for cell, bits in ring.items():
                for away in AWAY:
                    to = cell + away
                    if to in cells and to not in seen:
                        wider[to] = wider.get(to, 0) | bits
            ring = wider
        return _first_off(ways, nearest or 0, 0)

    return choose


def _first_off(ways: Sequence[int], nearest: int, next_nearest: int) -> int:
    """Return the first way that leads nearest to no tip, or at least not to a nearest one."""
    for bits in (nearest | next_nearest, nearest):
        for way in ways:
            if not bits >> way & 1:
                return way
    return ways[0]


DISTANCES: dict[str, Callable[[Collection[int]], Choose]] = {
    "manhattan": _by_position(_manhattan),
    "euclid": _by_position(_euclid_squared),
    "shortest-path": _by_shortest_path,
}
"""How far apart tips are; each takes the cells of the map."""
