"""Spanning trees of coarse cells, for coverage and to compare with.

Cells are numbers as in `agents.algorithms.stc`. Each function takes connected cells, row by row (the
order counts: the same cells, order and stream give the same tree), and returns a tree of all of them.

Paper:
    Agmon et al. 2008, Sec. 3.3.2 compares with "randomly generated" trees and does not say which.
"""

from collections import deque
from collections.abc import Callable, Collection, Iterable, Sequence

from agents.algorithms.stc import AWAY, OPPOSITE, Tree
from protocol.grid import EAST, SOUTH
from protocol.seeds import Stream

DIRECTIONS = range(4)


def random_tree(cells: Sequence[int], rng: Stream) -> Tree:
    """Draw one of all spanning trees, each equally likely (Wilson's loop-erased random walks).

    What hangs on the rest by one edge belongs to all of them; walks stay out of there.
    """
    neighbours = _neighbours(cells)
    peeled = _peel(neighbours)
    left = [cell for cell in cells if cell in neighbours]
    tree = Tree()
    tree.root(rng.choice(left))
    for cell in left:
        # Walk until the tree is met; a cell that is left again forgets its former exit, and so the
        # loops are gone.
        exits: dict[int, int] = {}
        at = cell
        while at not in tree:
            exits[at] = direction = rng.choice(neighbours[at])
            at += AWAY[direction]
        path = []
        at = cell
        while at not in tree:
            direction = exits[at]
            at += AWAY[direction]
            path.append((at, OPPOSITE[direction]))
        for to, direction in reversed(path):
            tree.join(to, direction)
    for to, direction in reversed(peeled):
        tree.join(to, direction)
    return tree


def depth_first_tree(cells: Sequence[int], rng: Stream) -> Tree:
    """Search depth first from a random cell, directions in random order at each."""
    free = set(cells)
    tree = Tree()
    root = rng.choice(cells)
    tree.root(root)
    path = [(root, _shuffled(rng))]
    while path:
        cell, directions = path[-1]
        if not directions:
            path.pop()
            continue
        direction = directions.pop()
        to = cell + AWAY[direction]
        if to in free and to not in tree:
            path.append((tree.join(cell, direction), _shuffled(rng)))
    return tree


def breadth_first_tree(cells: Sequence[int], rng: Stream) -> Tree:
    """Search breadth first from a random cell, directions in random order at each."""
    free = set(cells)
    tree = Tree()
    root = rng.choice(cells)
    tree.root(root)
    ahead = deque([root])
    while ahead:
        cell = ahead.popleft()
        for direction in _shuffled(rng):
            to = cell + AWAY[direction]
            if to in free and to not in tree:
                ahead.append(tree.join(cell, direction))
    return tree


def minimum_tree(cells: Sequence[int], rng: Stream) -> Tree:
    """Build the minimum spanning tree under random weights of the edges (Kruskal)."""
    edges = edges_of(cells)
    rng.shuffle(edges)
    tree = Tree()
    for cell in cells:
        tree.root(cell)
    sets = Sets(cells)
    for cell, direction in edges:
        if sets.unite(cell, cell + AWAY[direction]):
            tree.join(cell, direction)
    return tree


TREES: dict[str, Callable[[Sequence[int], Stream], Tree]] = {
    "random": random_tree,
    "depth-first": depth_first_tree,
    "breadth-first": breadth_first_tree,
    "minimum": minimum_tree,
}


class Sets:
    """Disjoint sets, to be united."""

    __slots__ = ("_parents",)

    def __init__(self, members: Iterable[int]) -> None:
        self._parents = {member: member for member in members}

    def find(self, member: int) -> int:
        """Return the name of the set that holds a member."""
        parents = self._parents
        while parents[member] != member:
            parents[member] = member = parents[parents[member]]
        return member

    def unite(self, one: int, other: int) -> bool:
        """Unite the sets of two members; tell whether they were different ones."""
        one, other = self.find(one), self.find(other)
        self._parents[one] = other
        return one != other


def edges_of(cells: Collection[int]) -> list[tuple[int, int]]:
    """Return all edges between cells: the western or northern end, and ``EAST`` or ``SOUTH``."""
    free = cells if isinstance(cells, set) else set(cells)
    return [
        (cell, direction)
        for cell in cells
        for direction in (EAST, SOUTH)
        if cell + AWAY[direction] in free
    ]


def component(cells: Collection[int], start: int) -> list[int]:
    """Return the cells that are connected with one of them, row by row."""
    left = set(cells) - {start}
    found = [start]
    for cell in found:
        for away in AWAY:
            if cell + away in left:
                left.remove(cell + away)
                found.append(cell + away)
    return sorted(found)


def _neighbours(cells: Sequence[int]) -> dict[int, list[int]]:
    """Return the directions in which each cell has a neighbour."""
    free = set(cells)
    return {cell: [way for way in DIRECTIONS if cell + AWAY[way] in free] for cell in cells}


def _peel(neighbours: dict[int, list[int]]) -> list[tuple[int, int]]:
    """Take away cells with one neighbour until none is left; each leaves from the other's view.

    Returns:
        For each of them, in the order of their going, the neighbour and the direction from there.
    """
    peeled = []
    ends = [cell for cell, ways in neighbours.items() if len(ways) == 1]
    for cell in ends:
        if not neighbours[cell]:
            break  # all is peeled but this one
        (way,) = neighbours.pop(cell)
        to = cell + AWAY[way]
        peeled.append((to, OPPOSITE[way]))
        neighbours[to].remove(OPPOSITE[way])
        if len(neighbours[to]) == 1:
            ends.append(to)
    return peeled


def _shuffled(rng: Stream) -> list[int]:
    directions = list(DIRECTIONS)
    rng.shuffle(directions)
    return directions
