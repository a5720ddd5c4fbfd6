"""Create_Tree, second stage: bridges that make one tree of the subtrees.

A bridge is an edge between two subtrees; a bridge set joins all subtrees to one tree. How far apart
robots stand on the tour of that tree is found without going around it: the tour is spliced from those
of the subtrees. A bridge cuts the tour of either subtree behind the sub-cell from which it leaves:
there the tour crosses to the other one, and goes on behind the cut there. Between two cuts or robots
it is a piece of the tour of one subtree, whose length is a difference of two positions. No two
bridges cut at the same place, so sorting finds the pieces for any bridge set.

Many bridge sets are evaluated at once: each step is taken for all of them by numpy.

Paper:
    Agmon et al. 2008, Sec. 3.2 (Algorithm 1, lines 11 to 18; Theorem 3). The paper goes around the
    whole tree for each set, O(N); splicing takes O(k log k).
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agents.algorithms.stc import AWAY, OPPOSITE, Tree, located, row_and_column, sub_cell
from agents.planning.create_tree import Forest
from agents.planning.splits import opt_mstc
from agents.planning.tour import circumnavigate
from agents.planning.trees import edges_of
from protocol.grid import Cell
from protocol.seeds import Stream

Numbers = npt.NDArray[np.int64]

CHUNK = 1 << 20
"""Numbers in one array of a batch of bridge sets, about."""


class Bridges:
    """All bridges of a forest, and what their sets are worth.

    Attributes:
        ends: subtrees that each bridge joins, ``(bridges, 2)``.
    """

    def __init__(self, forest: Forest, starts: Sequence[Cell]) -> None:
        """Find the bridges, and go around each subtree once.

        Args:
            forest: the subtrees.
            starts: sub-cell of each robot, no two alike, all on the forest.
        """
        self._forest = forest
        self._edges = [
            (cell, way)
            for cell, way in edges_of(sorted(forest.owner))
            if forest.owner[cell] != forest.owner[cell + AWAY[way]]
        ]
        # All sub-cells in one row, subtree by subtree. Keys are twice the position, and a cut has one
        # more: it comes after a robot in the sub-cell before it.
        position: dict[Cell, int] = {}
        firsts = [0]
        for root in forest.roots:
            tour = circumnavigate(forest.tree, sub_cell(root, 0))
            position.update(zip(tour, range(firsts[-1], firsts[-1] + len(tour)), strict=True))
            firsts.append(len(position))
        self._lengths = np.diff(firsts)
        self._robot_keys = np.array([2 * position[start] for start in starts], dtype=np.int64)
        self._robot_trees = np.array(
            [forest.owner[located(start)[0]] for start in starts], dtype=np.int64
        )
        owners, keys = [], []
        for cell, way in self._edges:
            to = cell + AWAY[way]
            owners.append((forest.owner[cell], forest.owner[to]))
            near, far = sub_cell(cell, way), sub_cell(to, OPPOSITE[way])
            keys.append((2 * position[near] + 1, 2 * position[far] + 1))
        self.ends: Numbers = np.array(owners, dtype=np.int64).reshape(-1, 2)
        self._keys: Numbers = np.array(keys, dtype=np.int64).reshape(-1, 2)

    def __len__(self) -> int:
        """Return the number of bridges."""
        return len(self._edges)

    @property
    def subtrees(self) -> int:
        """How many subtrees there are to join."""
        return len(self._forest.roots)

    def cells(self) -> list[tuple[Cell, Cell]]:
        """Return the coarse cells that each bridge joins, by row and column."""
        return [
            (row_and_column(cell), row_and_column(cell + AWAY[way])) for cell, way in self._edges
        ]

    def join(self, bridge_set: Sequence[int] | Numbers) -> Tree:
        """Return the tree that a bridge set makes of the subtrees."""
        tree = Tree()
        tree.edges.update(self._forest.tree.edges)
        for bridge in bridge_set:
            tree.join(*self._edges[int(bridge)])
        return tree

    def gaps(self, sets: Numbers) -> Numbers:
        """Return how far apart robots are on the tours of joined trees.

        Args:
            sets: ``(sets, subtrees - 1)`` bridges; each row is a bridge set.

        Returns:
            ``(sets, robots)`` moves from each robot to the next one, in the order of the tour,
            beginning with robot 0.
        """
        robots = len(self._robot_keys)
        count = len(sets)
        # Stops: first the robots, then the cuts, the two of a bridge side by side.
        keys = np.empty((count, robots + 2 * sets.shape[1]), dtype=np.int64)
        trees = np.empty_like(keys)
        keys[:, :robots], trees[:, :robots] = self._robot_keys, self._robot_trees
        keys[:, robots:] = self._keys[sets].reshape(count, -1)
        trees[:, robots:] = self.ends[sets].reshape(count, -1)
        rows = np.arange(count)[:, None]
        stops = np.argsort(keys, axis=1)
        keys, trees = keys[rows, stops], trees[rows, stops]

        # The next stop on the tour of the same subtree, and the moves there.
        places = np.arange(keys.shape[1])
        is_last = np.ones(keys.shape, dtype=np.bool_)
        is_last[:, :-1] = trees[:, 1:] != trees[:, :-1]
        is_first = np.roll(is_last, 1, axis=1)
        first = np.maximum.accumulate(np.where(is_first, places, 0), axis=1)
        next_ = np.where(is_last, first, places + 1)
        moves = (keys[rows, next_] >> 1) - (keys >> 1) + np.where(is_last, self._lengths[trees], 0)

        # From a cut the tour goes on behind the cut on the other side of the bridge. To come there
        # takes one move, as it takes to go on without a bridge.
        rank = np.empty_like(stops)
        rank[rows, stops] = places
        other_side = np.arange(keys.shape[1])
        other_side[robots:] = robots + (np.arange(2 * sets.shape[1]) ^ 1)
        reached = stops[rows, next_]
        is_robot = reached < robots
        goes_on = rank[rows, other_side[reached]]

        found = np.zeros((count, robots), dtype=np.int64)
        line = np.arange(count)
        at = line * keys.shape[1]
        goes_on = (goes_on + at[:, None]).ravel()
        moves, is_robot = moves.ravel(), is_robot.ravel()
        at += rank[:, 0]
        robot = line * robots
        flat = found.reshape(-1)
        for step in range(keys.shape[1]):
            flat[robot] += moves[at]
            if step < keys.shape[1] - 1:
                robot += is_robot[at]
                at = goes_on[at]
        return found


class Best(NamedTuple):
    """What was found among bridge sets.

    Attributes:
        bridge_set: the first one with the smallest largest gap.
        d_max: that gap.
        sets: how many bridge sets were looked at.
    """

    bridge_set: tuple[int, ...]
    d_max: int
    sets: int


def best_of_tries(
    bridges: Bridges, tries: int, rng: Stream, say: Callable[[str], object] = lambda _: None
) -> Best:
    """Draw bridge sets and keep the one with the smallest largest gap; of equals the first.

    A set is what is left of all bridges, shuffled, after Kruskal's algorithm. That depends on the
    order only in which bridges between the same two subtrees come first, and which of them does:
    so pairs of subtrees are drawn, and then one bridge of each. A pair of ``m`` bridges comes after
    an exponentially distributed time of rate ``m``.

    Args:
        bridges: all of them.
        tries: sets to draw, at least 1.
        rng: source of the sets.
        say: is told now and then how far it is.
    """
    joints = bridges.subtrees - 1
    draws = np.random.default_rng(rng.getrandbits(64))
    order = np.lexsort((bridges.ends.max(axis=1), bridges.ends.min(axis=1)))
    pairs, firsts, counts = np.unique(
        np.sort(bridges.ends[order], axis=1), axis=0, return_index=True, return_counts=True
    )
    most = max(1, CHUNK // max(bridges.subtrees, len(pairs), 2 * joints + 1))
    best: Best | None = None
    for done in range(0, tries, most):
        count = min(most, tries - done)
        chosen = _pairs(draws.exponential(size=(count, len(pairs))) / counts, pairs, joints)
        within = (draws.random(chosen.shape) * counts[chosen]).astype(np.int64)
        sets = order[firsts[chosen] + within]
        largest = bridges.gaps(sets).max(axis=1)
        at = int(largest.argmin())
        if best is None or largest[at] < best.d_max:
            best = Best(tuple(sets[at].tolist()), int(largest[at]), tries)
        if done + count < tries:
            say(f"{done + count} of {tries} bridge sets, largest gap {best.d_max}")
    assert best is not None, "there is at least one try"
    return best


def _pairs(times: npt.NDArray[np.float64], pairs: Numbers, joints: int) -> Numbers:
    """Return the pairs that join all subtrees, earlier ones first, for each row of times."""
    count = len(times)
    chosen = np.zeros((count, joints), dtype=np.int64)
    joined = np.zeros(count, dtype=np.int64)
    label = np.tile(np.arange(joints + 1), (count, 1))
    line = np.arange(count)
    for pair in np.argsort(times, axis=1).T:
        one, other = label[line, pairs[pair, 0]], label[line, pairs[pair, 1]]
        new = np.flatnonzero(one != other)
        if not len(new):
            continue
        chosen[new, joined[new]] = pair[new]
        joined[new] += 1
        if joined.min() == joints:
            break
        part = label[new]
        label[new] = np.where(part == one[new, None], other[new, None], part)
    return chosen


# All bridge sets.


class Whole(NamedTuple):
    """What all bridge sets come to.

    Attributes:
        best: the best of them.
        d_max_worst: the largest gap of the worst.
        opt_best: the least coverage time of Opt_MSTC with any of them.
    """

    best: Best
    d_max_worst: int
    opt_best: int


def best_of_all(bridges: Bridges, most: int) -> Whole | None:
    """Evaluate all bridge sets; return ``None`` if there are more than ``most``."""
    ends = [(int(one), int(other)) for one, other in bridges.ends]
    if count_spanning_sets(bridges.subtrees, ends) > most:
        return None
    joints = bridges.subtrees - 1
    listed = list(spanning_sets(bridges.subtrees, ends))
    sets = np.array(listed, dtype=np.int64).reshape(len(listed), joints)
    most_at_once = max(1, CHUNK // (2 * joints + 1))
    gaps = np.concatenate(
        [bridges.gaps(sets[at : at + most_at_once]) for at in range(0, len(sets), most_at_once)]
    )
    largest = gaps.max(axis=1)
    at = int(largest.argmin())
    best = Best(tuple(sets[at].tolist()), int(largest[at]), len(sets))
    opt = best.d_max
    distinct = np.unique(gaps, axis=0)
    for gap_list in distinct[np.argsort(distinct.max(axis=1))].tolist():
        if max(gap_list) // 2 >= opt:  # NB, the largest gap less one, is at most twice Opt
            break
        opt = min(opt, opt_mstc(gap_list).moves)
    return Whole(best, int(largest.max()), opt)


def count_spanning_sets(nodes: int, edges: Sequence[tuple[int, int]]) -> int:
    """Count the sets of edges that make a tree of all nodes (Kirchhoff's matrix-tree theorem).

    Args:
        nodes: how many there are, numbered from 0.
        edges: two different nodes each; several may join the same two.
    """
    matrix = [[0] * nodes for _ in range(nodes)]
    for one, other in edges:
        matrix[one][one] += 1
        matrix[other][other] += 1
        matrix[one][other] -= 1
        matrix[other][one] -= 1
    # The determinant without the last node, in whole numbers (Bareiss).
    sign, before = 1, 1
    size = nodes - 1
    for step in range(size):
        pivot = next((row for row in range(step, size) if matrix[row][step]), None)
        if pivot is None:
            return 0
        if pivot != step:
            matrix[step], matrix[pivot] = matrix[pivot], matrix[step]
            sign = -sign
        for row in range(step + 1, size):
            for col in range(step + 1, size):
                product = matrix[row][col] * matrix[step][step]
                product -= matrix[row][step] * matrix[step][col]
                matrix[row][col] = product // before
        before = matrix[step][step]
    return sign * before


def spanning_sets(nodes: int, edges: Sequence[tuple[int, int]]) -> Iterator[tuple[int, ...]]:
    """Yield all sets of edges that make a tree of all nodes, as numbers of edges, in order."""

    def extend(labels: list[int], begin: int, chosen: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
        if len(chosen) == nodes - 1:
            yield chosen
            return
        for at in range(begin, len(edges)):
            one, other = (labels[node] for node in edges[at])
            if one == other:
                continue
            if not _connect(labels, edges[at:]):
                return
            merged = [other if label == one else label for label in labels]
            yield from extend(merged, at + 1, (*chosen, at))

    yield from extend(list(range(nodes)), 0, ())


def _connect(labels: Sequence[int], edges: Sequence[tuple[int, int]]) -> bool:
    """Tell whether edges connect all nodes, those of one label being connected already."""
    labels = list(labels)
    for one, other in edges:
        if labels[one] != labels[other]:
            old, new = labels[one], labels[other]
            labels = [new if label == old else label for label in labels]
    return len(set(labels)) == 1
