"""A plan as every robot of a team makes it for itself: the same from the same map, starts and seed.

A robot plans for the connected part of the map that it starts in, with those that start there too.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

from agents.algorithms.stc import Tree, located, number
from agents.planning.create_tree import grow_forest
from agents.planning.splits import SPLITS
from agents.planning.tour import Places, circumnavigate
from agents.planning.trees import TREES, component
from agents.planning.walks import open_walks
from protocol.grid import Cell, Grid
from protocol.seeds import spawn

CREATE_TREE = "create-tree"


class Kind(NamedTuple):
    """How to plan: names as `canopy plan` spells them."""

    tree: str
    split: str
    distance: str
    alpha: float


class TeamPlan(NamedTuple):
    """Who covers what of one part of the map.

    Attributes:
        tree: the spanning tree.
        order: robots as the tour meets them, the lowest first.
        parts: for each robot the sub-cells of the tour that it is to cover, one behind the other.
        walks: for each robot the way on which it covers them, from its start.
        gaps: moves along the tour from each robot of ``order`` to the next one.
        moves: coverage time.
    """

    tree: Tree
    order: tuple[int, ...]
    parts: dict[int, list[Cell]]
    walks: dict[int, list[Cell]]
    gaps: tuple[int, ...]
    moves: int


def tree_of(kind: Kind, cells: Sequence[int], starts: Sequence[Cell], seed: int) -> Tree:
    """Return the spanning tree of a plan.

    Args:
        kind: which tree.
        cells: the coarse cells to span, connected.
        starts: sub-cell of each robot, in one of them.
        seed: of what is drawn.
    """
    if kind.tree != CREATE_TREE:
        return TREES[kind.tree](cells, spawn(seed, "tree"))
    from agents.planning.bridges import (  # noqa: PLC0415  numpy, which other trees need not pay for
        Bridges,
        best_of_tries,
    )

    forest = grow_forest(cells, [located(start)[0] for start in starts], kind.distance)
    bridges = Bridges(forest, starts)
    tries = 1 if bridges.subtrees == 1 else max(1, round(float(len(starts) ** kind.alpha)))
    return bridges.join(best_of_tries(bridges, tries, spawn(seed, "bridges")).bridge_set)


def team_plan(
    rows: int,
    cols: int,
    blocked: bytes,
    starts: tuple[Cell, ...],
    kind: Kind,
    seed: int,
    robot: int,
) -> TeamPlan:
    """Plan for all that start in the same part of the map as ``robot``, the lowest of them.

    Args:
        rows: of sub-cells.
        cols: of sub-cells.
        blocked: the sub-cells, as `protocol.grid.Grid` takes them.
        starts: sub-cell of each robot of the team, in complete coarse cells, no two alike.
        kind: how to plan.
        seed: of what is drawn.
        robot: whose part.
    """
    grid = Grid(rows, cols, blocked)
    whole = [number(cell) for cell in grid.complete_cells()]
    cells = component(whole, located(starts[robot])[0])
    inside = set(cells)
    members = tuple(one for one, start in enumerate(starts) if located(start)[0] in inside)
    return _planned(tuple(cells), starts, members, kind, seed)


@lru_cache(maxsize=16)
def _planned(
    cells: tuple[int, ...],
    starts: tuple[Cell, ...],
    members: tuple[int, ...],
    kind: Kind,
    seed: int,
) -> TeamPlan:
    """Plan for one part of a map; robots in one process, and the verdict, share what is found."""
    own_starts = [starts[one] for one in members]
    tree = tree_of(kind, cells, own_starts, seed)
    tour = circumnavigate(tree, own_starts[0])
    places = Places(tour, own_starts)
    split = SPLITS[kind.split](places.gaps)
    walks = open_walks(tour, places, split)
    parts = {}
    for index, at, back, ahead in zip(
        places.order, places.at, split.back, split.ahead, strict=True
    ):
        stretch = range(at - back, at + ahead + 1)
        parts[members[index]] = [tour[step % len(tour)] for step in stretch]
    return TeamPlan(
        tree,
        tuple(members[index] for index in places.order),
        parts,
        {members[index]: walk for index, walk in enumerate(walks)},
        tuple(places.gaps),
        split.moves,
    )
