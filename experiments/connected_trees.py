"""The trees of the experiments on connected coverage, as what they are made of.

So a run can be told to another process in a few numbers, and the tree is made where it is needed.
"""

from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from agents.planning.rooted_tree import (
    RootedTree,
    perfect_tree,
    spanning_tree,
    vertices_of_perfect,
    without,
)
from protocol.seeds import spawn
from world_server.maps.readers import read_graph


class Perfect(NamedTuple):
    """A perfect tree."""

    arity: int
    height: int

    def made(self) -> RootedTree:
        """Return the tree."""
        return perfect_tree(self.arity, self.height)


class Holes(NamedTuple):
    """A perfect tree less the vertices of some height, with all below, whose place in their level fits.

    Attributes:
        whole: the perfect tree.
        at: the height of what is cut off.
        every, rest: cut where the place leaves this rest when divided by ``every``.
    """

    whole: Perfect
    at: int
    every: int
    rest: int

    def made(self) -> RootedTree:
        """Return the tree."""
        level = _level(self.whole, self.at)
        gone = [vertex for i, vertex in enumerate(level) if i % self.every == self.rest]
        return without(self.whole.made(), gone)


class Cut(NamedTuple):
    """A perfect tree less some vertices of some height at random, with all below (Sec. 4.4).

    Attributes:
        whole: the perfect tree.
        at: the height of what is cut off.
        cuts: how many.
        case: which of the random choices.
    """

    whole: Perfect
    at: int
    cuts: int
    case: int

    def made(self) -> RootedTree:
        """Return the tree."""
        rng = spawn(0, "paper-connected", *self.whole, self.at, self.cuts, self.case)
        return without(self.whole.made(), rng.sample(_level(self.whole, self.at), self.cuts))


class Office(NamedTuple):
    """A corridor of so many steps, and rooms to both sides of each but the last."""

    steps: int

    def made(self) -> RootedTree:
        """Return the tree; the rooms come first."""
        children: list[tuple[int, ...]] = []
        for step in range(self.steps):
            children += [(3 * step + 1, 3 * step + 2, 3 * step + 3), (), ()]
        return RootedTree([*children, ()])


class Place(NamedTuple):
    """The breadth-first tree of a graph, from its first vertex, as far as one gets from there."""

    path: str

    def made(self) -> RootedTree:
        """Return the tree."""
        return spanning_tree(read_graph(Path(self.path)).component(0), 0).tree


AnyTree = Perfect | Holes | Cut | Office | Place


def _level(whole: Perfect, height: int) -> range:
    """Return the vertices of a height in a perfect tree."""
    depth = whole.height - height
    return range(
        vertices_of_perfect(whole.arity, depth - 1), vertices_of_perfect(whole.arity, depth)
    )


@lru_cache(maxsize=2)
def tree_of(tree: AnyTree) -> RootedTree:
    """Make a tree; those made last are kept."""
    return tree.made()
