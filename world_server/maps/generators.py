"""Generated graphs: trees, grids, random graphs and caves.

Every function is pure: the same arguments, with a random source in the same state, give the same
graph. In trees the vertices are numbered so that a parent comes before its children, and edges are
listed by child; so port 0 of every vertex but the root leads to its parent, and vertex 0 is the
place to start from.
"""

import math
from bisect import bisect_right
from collections import deque
from heapq import heapify, heappop, heappush
from random import Random

from protocol.graph import PortGraph
from world_server.maps.generated_caves import cave

__all__ = [
    "cave",
    "complete",
    "cycle",
    "grid",
    "hash_tree",
    "long_tree",
    "nary_tree",
    "path",
    "random_graph",
    "random_tree",
    "star",
    "wide_tree",
]

HASH_MULTIPLIER = 2654435761
"""Knuth's multiplicative hash constant: the prime next to 2**32 divided by the golden ratio."""


def nary_tree(branching: int, radius: int) -> PortGraph:
    """Build the complete tree in which every inner vertex has the same number of children.

    Args:
        branching: Children of each inner vertex, at least 1.
        radius: Edges from the root to each leaf, at least 0.

    Returns:
        The tree; children of ``v`` are ``branching * v + 1`` to ``branching * v + branching``.

    Raises:
        ValueError: If an argument is too small.

    Paper:
        Brass et al., Sec. V: the N-ary trees.
    """
    _at_least("branching", branching, 1)
    _at_least("radius", radius, 0)
    vertices = sum(branching**level for level in range(radius + 1))
    return _tree([(vertex - 1) // branching for vertex in range(1, vertices)])


def hash_tree(edges: int) -> PortGraph:
    """Build an irregular tree that needs no random numbers, so that any language gives it alike.

    Args:
        edges: Number of edges, at least 0.

    Returns:
        The tree; the parent of ``v`` is a multiplicative hash of ``v``, modulo ``v``.

    Raises:
        ValueError: If ``edges`` is negative.
    """
    _at_least("edges", edges, 0)
    return _tree([HASH_MULTIPLIER * vertex % 2**32 % vertex for vertex in range(1, edges + 1)])


def random_tree(vertices: int, rng: Random) -> PortGraph:
    """Draw a labelled tree uniformly, then number it breadth first from its vertex 0.

    Args:
        vertices: Number of vertices, at least 1.
        rng: Source of the Pruefer sequence.

    Returns:
        The tree, expected depth of order ``sqrt(vertices)``.

    Raises:
        ValueError: If ``vertices`` is less than 1.
    """
    _at_least("vertices", vertices, 1)
    if vertices == 1:
        return _tree([])
    sequence = [rng.randrange(vertices) for _ in range(vertices - 2)]
    missing = [1] * vertices
    for vertex in sequence:
        missing[vertex] += 1
    leaves = [vertex for vertex, degree in enumerate(missing) if degree == 1]
    heapify(leaves)
    neighbours: list[list[int]] = [[] for _ in range(vertices)]

    def join(u: int, v: int) -> None:
        neighbours[u].append(v)
        neighbours[v].append(u)

    for vertex in sequence:
        join(heappop(leaves), vertex)
        missing[vertex] -= 1
        if missing[vertex] == 1:
            heappush(leaves, vertex)
    join(heappop(leaves), heappop(leaves))
    parents: list[int] = []
    number = {0: 0}
    queue = deque([0])
    while queue:
        vertex = queue.popleft()
        for neighbour in neighbours[vertex]:
            if neighbour not in number:
                number[neighbour] = len(number)
                parents.append(number[vertex])
                queue.append(neighbour)
    return _tree(parents)


def wide_tree(edges: int, rng: Random) -> PortGraph:
    """Grow a uniform random recursive tree: each new vertex picks its parent among all before it.

    Args:
        edges: Number of edges, at least 0.
        rng: Source of the parents.

    Returns:
        The tree, expected depth of order ``log(edges)``.

    Raises:
        ValueError: If ``edges`` is negative.

    Paper:
        Brass et al., Sec. V: the wide trees, as far as its text tells how they were made.
    """
    _at_least("edges", edges, 0)
    return _tree(_recursive_parents(edges + 1, rng))


def long_tree(edges: int, rng: Random) -> PortGraph:
    """Grow a tree along one path: the tip gets one to four children, one of them the next tip.

    Args:
        edges: Number of edges, at least 0.
        rng: Source of the numbers of children and of the next tips.

    Returns:
        The tree, about ``0.4 * edges`` deep.

    Raises:
        ValueError: If ``edges`` is negative.

    Paper:
        Brass et al., Sec. V: the long trees. Their generator is not given; this one comes close to
        the times reported.
    """
    _at_least("edges", edges, 0)
    parents: list[int] = []
    tip = 0
    while len(parents) < edges:
        children = min(rng.randint(1, 4), edges - len(parents))
        first = len(parents) + 1
        parents += [tip] * children
        tip = rng.randrange(first, first + children)
    return _tree(parents)


def random_graph(vertices: int, edges: int, rng: Random) -> PortGraph:
    """Draw a connected graph: a random recursive tree and extra edges chosen uniformly.

    Args:
        vertices: Number of vertices, at least 1.
        edges: Number of edges, no loops and no parallels.
        rng: Source of the tree and of the extra edges.

    Returns:
        The graph; the edges of the tree come first.

    Raises:
        ValueError: If no connected simple graph has so many vertices and edges.
    """
    _at_least("vertices", vertices, 1)
    pairs = vertices * (vertices - 1) // 2
    if not vertices - 1 <= edges <= pairs:
        raise ValueError(
            f"edges: found {edges}, expected {vertices - 1} to {pairs} for {vertices} vertices"
        )
    parents = _recursive_parents(vertices, rng)
    ends = list(zip(parents, range(1, vertices), strict=True))
    # Pair (u, v) with u < v has the number v(v-1)/2 + u, and these grow with v: so the numbers of
    # the tree edges are sorted. Drawing among the others by rank costs no list of all pairs.
    taken = [v * (v - 1) // 2 + u for u, v in ends]
    free_before = [number - rank for rank, number in enumerate(taken)]
    for rank in rng.sample(range(pairs - len(ends)), edges - len(ends)):
        number = rank + bisect_right(free_before, rank)
        v = (1 + math.isqrt(8 * number + 1)) // 2
        ends.append((number - v * (v - 1) // 2, v))
    return PortGraph(_numbers(vertices), ends)


def grid(rows: int, columns: int) -> PortGraph:
    """Build the rectangular grid graph, with positions.

    Args:
        rows: Number of rows, at least 1.
        columns: Number of columns, at least 1.

    Returns:
        The grid; vertices row by row, all horizontal edges row by row, then all vertical ones.

    Raises:
        ValueError: If an argument is less than 1.
    """
    _at_least("rows", rows, 1)
    _at_least("columns", columns, 1)
    cells = [(row, column) for row in range(rows) for column in range(columns)]
    across = [
        (row * columns + column, row * columns + column + 1)
        for row, column in cells
        if column + 1 < columns
    ]
    down = [
        (row * columns + column, (row + 1) * columns + column)
        for row, column in cells
        if row + 1 < rows
    ]
    positions = [(float(column), float(-row)) for row, column in cells]
    return PortGraph(_numbers(rows * columns), across + down, positions=positions)


def complete(vertices: int) -> PortGraph:
    """Build the graph in which every two vertices are joined.

    Args:
        vertices: Number of vertices, at least 1.

    Returns:
        The graph; edges ``(i, j)`` with ``i < j`` in lexicographic order.

    Raises:
        ValueError: If ``vertices`` is less than 1.
    """
    _at_least("vertices", vertices, 1)
    ends = [(i, j) for i in range(vertices) for j in range(i + 1, vertices)]
    return PortGraph(_numbers(vertices), ends)


def cycle(vertices: int) -> PortGraph:
    """Build a cycle; of two vertices it is a pair of parallel edges, of one a self-loop.

    Args:
        vertices: Number of vertices, at least 1.

    Returns:
        The cycle; the last edge leads from the last vertex back to vertex 0.

    Raises:
        ValueError: If ``vertices`` is less than 1.
    """
    _at_least("vertices", vertices, 1)
    return PortGraph(_numbers(vertices), [(v, (v + 1) % vertices) for v in range(vertices)])


def star(leaves: int) -> PortGraph:
    """Build a star with vertex 0 in the middle.

    Args:
        leaves: Number of leaves, at least 0.

    Returns:
        The star, a tree with ``leaves`` edges.

    Raises:
        ValueError: If ``leaves`` is negative.
    """
    _at_least("leaves", leaves, 0)
    return _tree([0] * leaves)


def path(vertices: int) -> PortGraph:
    """Build a path with vertex 0 at one end.

    Args:
        vertices: Number of vertices, at least 1.

    Returns:
        The path, a tree with ``vertices - 1`` edges.

    Raises:
        ValueError: If ``vertices`` is less than 1.
    """
    _at_least("vertices", vertices, 1)
    return _tree(list(range(vertices - 1)))


def _tree(parents: list[int]) -> PortGraph:
    """Build a tree from the parents of vertices 1, 2, ..., each smaller than its child."""
    ends = [(parent, child) for child, parent in enumerate(parents, start=1)]
    return PortGraph(_numbers(len(parents) + 1), ends)


def _recursive_parents(vertices: int, rng: Random) -> list[int]:
    """Return the parents of vertices 1, 2, ... in a uniform random recursive tree."""
    return [rng.randrange(vertex) for vertex in range(1, vertices)]


def _numbers(vertices: int) -> list[str]:
    """Name vertices by their numbers."""
    return [str(vertex) for vertex in range(vertices)]


def _at_least(parameter: str, found: int, least: int) -> None:
    """Refuse an argument that is too small."""
    if found < least:
        raise ValueError(f"{parameter}: found {found}, expected at least {least}")
