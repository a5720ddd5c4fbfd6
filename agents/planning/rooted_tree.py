"""Rooted trees, as a team that covers one knows it: parents, children in order, heights."""

from collections import deque
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from protocol.graph import PortGraph

NOWHERE = -1
"""The parent of the root."""


class RootedTree:
    """A tree as all robots know it; vertices are numbered from 0 in any order.

    Attributes:
        root: where all robots start.
        children: those of each vertex, in the order in which they are explored.
        parents: that of each vertex; `NOWHERE` above the root.
        heights: of each vertex: the tree's height less the vertex's depth.
        height: of the tree: the largest depth (the paper's H).
        arity: the largest number of children (the paper's N).
        upwards: the place of each vertex in an order by height, then number.
    """

    __slots__ = ("arity", "children", "height", "heights", "parents", "root", "upwards")

    def __init__(self, children: Sequence[Sequence[int]], root: int = 0) -> None:
        """Take a tree by the children of each vertex.

        Raises:
            ValueError: If that is no tree with this root.
        """
        self.root = root
        self.children = tuple(map(tuple, children))
        parents = [NOWHERE] * len(self.children)
        depths = [-1] * len(self.children)
        if not 0 <= root < len(parents):
            raise ValueError(f"no vertex {root} among {len(parents)}: no root")
        depths[root] = 0
        found = [root]
        for vertex in found:
            for child in self.children[vertex]:
                if not 0 <= child < len(parents) or depths[child] >= 0:
                    raise ValueError(
                        f"vertex {child} below {vertex}: absent, or in the tree already"
                    )
                parents[child] = vertex
                depths[child] = depths[vertex] + 1
                found.append(child)
        if len(found) < len(parents):
            raise ValueError(f"vertex {depths.index(-1)} is not below the root {root}")
        self.parents = tuple(parents)
        self.height = max(depths)
        self.heights = tuple(self.height - depth for depth in depths)
        self.arity = max(map(len, self.children))
        upwards = [0] * len(parents)
        order = sorted(range(len(parents)), key=self.heights.__getitem__)
        for place, vertex in enumerate(order):
            upwards[vertex] = place
        self.upwards = tuple(upwards)

    def __len__(self) -> int:
        """Return the number of vertices (the paper's n)."""
        return len(self.parents)


def tree_of_parents(parents: Sequence[int | None]) -> RootedTree:
    """Return a tree by the parent of each vertex; children are explored in the order of their numbers.

    Args:
        parents: the parent of each vertex; ``None`` or `NOWHERE` for the root.

    Raises:
        ValueError: If there is not one root, or a vertex is not below it.
    """
    roots = [vertex for vertex, parent in enumerate(parents) if parent in (None, NOWHERE)]
    if len(roots) != 1:
        raise ValueError(f"a tree has one root, not {len(roots)}")
    children: list[list[int]] = [[] for _ in parents]
    for vertex, parent in enumerate(parents):
        if parent is not None and parent != NOWHERE:
            if not 0 <= parent < len(parents):
                raise ValueError(f"vertex {vertex} is below {parent}, which is no vertex")
            children[parent].append(vertex)
    return RootedTree(children, roots[0])


class Paths(NamedTuple):
    """A tree within a graph, and the ports by which one follows its edges.

    Attributes:
        tree: its vertices are those of the graph.
        up: for each vertex the port to its parent; `NOWHERE` at the root.
        down: for each vertex the port at its parent that leads to it; `NOWHERE` at the root.
    """

    tree: RootedTree
    up: tuple[int, ...]
    down: tuple[int, ...]

    def exit(self, vertex: int, to: int) -> int:
        """Return the port of a vertex that leads to its parent or to one of its children."""
        return self.up[vertex] if self.tree.parents[vertex] == to else self.down[to]


def spanning_tree(graph: PortGraph, root: int, *, deep: bool = False) -> Paths:
    """Return a spanning tree of a graph; children are in the order of ports.

    Args:
        graph: connected; of a tree all is returned.
        root: its root.
        deep: search depth first instead of breadth first.
    """
    up = [NOWHERE] * len(graph.names)
    down = list(up)
    children: list[list[int]] = [[] for _ in up]
    found = {root}
    ahead = deque([(root, iter(enumerate(graph.ways[root])))])
    while ahead:
        vertex, ways = ahead[-1] if deep else ahead[0]
        for port, (far, back) in ways:
            if far not in found:
                found.add(far)
                up[far], down[far] = back, port
                children[vertex].append(far)
                ahead.append((far, iter(enumerate(graph.ways[far]))))
                if deep:
                    break
        else:
            ahead.pop() if deep else ahead.popleft()
    return Paths(RootedTree(children, root), tuple(up), tuple(down))


def order_of(tree: RootedTree, usual: RootedTree) -> tuple[int, ...]:
    """Return the siblings of a tree whose order is not the usual one, in their order."""
    pairs = zip(tree.children, usual.children, strict=True)
    return tuple(child for children, before in pairs if children != before for child in children)


def reordered(tree: RootedTree, order: Sequence[int]) -> RootedTree:
    """Return a tree with some siblings in another order; `order_of` gives it back.

    Raises:
        ValueError: If something else than vertices below the root is in it, or one of them twice.
    """
    if not order:
        return tree
    below = set(range(len(tree))) - {tree.root}
    if len(below.intersection(order)) < len(order):
        raise ValueError("the order of siblings has an unknown vertex, the root, or one twice")
    place = {vertex: at for at, vertex in enumerate(order)}
    children = [sorted(each, key=lambda child: place.get(child, -1)) for each in tree.children]
    return RootedTree(children, tree.root)


def perfect_tree(arity: int, height: int) -> RootedTree:
    """Return the perfect N-ary tree; the children of v are N v + 1, ..., N v + N (Sec. 3)."""
    inner = vertices_of_perfect(arity, height - 1)
    below = [range(arity * v + 1, arity * v + arity + 1) for v in range(inner)]
    return RootedTree([*below, *[()] * arity**height])


def vertices_of_perfect(arity: int, height: int) -> int:
    """Return the number of vertices of the perfect tree; none if the height is -1."""
    return sum(arity**depth for depth in range(height + 1))


def without(tree: RootedTree, gone: Iterable[int]) -> RootedTree:
    """Return a tree less some vertices and all below them; the others keep their order (Sec. 4.4).

    Raises:
        ValueError: If the root is among them.
    """
    cut = set(gone)
    if tree.root in cut:
        raise ValueError("nothing is left of a tree without its root")
    kept = [tree.root]
    for vertex in kept:
        kept.extend(child for child in tree.children[vertex] if child not in cut)
    number = {vertex: place for place, vertex in enumerate(sorted(kept))}
    children = [
        [number[child] for child in tree.children[vertex] if child in number] for vertex in number
    ]
    return RootedTree(children, number[tree.root])
