"""How fast a connected team can cover a tree at all: a lower bound, and the exact optimum.

The model is that of `agents.algorithms.connected_rule`: in a tick each robot stays or crosses one edge,
the vertices with robots are connected at every tick, and all robots start and end at the root.
"""

from collections.abc import Iterator
from functools import cache
from itertools import product

from agents.planning.rooted_tree import NOWHERE, RootedTree

MOST_VERTICES = 12
"""The number of states grows by the power of the vertices; more of them than this take too long."""


def lower_bound(tree: RootedTree, team_size: int) -> int:
    """Return a number of ticks that no plan can do with less.

    For every depth d it is 2 d + ceil((2 E + 2 I) / k), with E the number of vertices below depth d,
    and I that of the vertices at depth d or below that have children. The largest depth gives twice
    the height. A single robot crosses 2 (n - 1) edges.

    Proof:
        A *robot-tick* is what one robot does in one tick; T ticks have k T of them. For each vertex but
        the root, the first crossing of its edge down and the last one up are *useful*; of several at
        once, one of them, whichever. All other crossings, and all stays, are *waste*. Let k > 1.

        Let v have children, and let t be the tick in which robots first go from v to any of them, say
        to u. If v is occupied after that tick, the robot there stayed, or it came down, not for the
        first time, as v was occupied before; from a child it did not come, as none had been entered.
        So its robot-tick is waste. If v is not occupied, all robots are in the subtree of u, as they
        are connected; so all k went from v to u in this tick, and k - 1 of these crossings are waste.

        Let s be the tick in which robots last come up to v from any child; s > t. Backwards in time
        the same holds: a robot that is at v before that tick stays or goes up, not for the last
        time; or all k come up from one child. So v has two robot-ticks of waste, in ticks t and s.

        None of them is counted for two vertices. A stay at v counts for v alone. A crossing from p down
        to its child v counts for v only if v was occupied before, and for p only in the tick in
        which v is first entered. A crossing up from v to p counts for v only if another follows, and
        for p only in the tick of the last one.

        So k T is at least 2 (n - 1) + 2 I: this is d = 0. No robot is at depth d in the first d ticks
        or the last d. So the crossings of all edges below depth d, and the waste of all vertices at
        depth d or below, fall into T - 2 d ticks.
    """
    if team_size == 1:
        return 2 * (len(tree) - 1)
    needed = [0] * (tree.height + 1)
    for vertex, children in enumerate(tree.children):
        needed[tree.height - tree.heights[vertex]] += 2 * len(children) + 2 * bool(children)
    bound = work = 0
    for depth in range(tree.height, -1, -1):
        work += needed[depth]
        bound = max(bound, 2 * depth + -(-work // team_size))
    return bound


def optimum(tree: RootedTree, team_size: int) -> int:
    """Return the least number of ticks in which a connected team covers a small tree.

    A search by breadth over states: how many robots are where, and what was visited. Robots are
    interchangeable. A state that another one dominates is dropped: one with the same places, reached no
    later, that has visited at least the same.

    Args:
        tree: what is to be covered, of at most `MOST_VERTICES` vertices.
        team_size: number of robots; with more than four or five it takes long.

    Raises:
        ValueError: If the tree is too large, or there is no robot.
    """
    if len(tree) > MOST_VERTICES:
        raise ValueError(f"a tree of {len(tree)} vertices; expected at most {MOST_VERTICES}")
    if team_size < 1:
        raise ValueError("a team has at least one robot")
    return _Search(tree).ticks((tree.root,) * team_size)


Places = tuple[int, ...]
"""The vertices of all robots, ascending; a set of vertices is an integer with a bit for each."""


class _Search:
    """The states of teams on one tree."""

    def __init__(self, tree: RootedTree) -> None:
        self.parents = tree.parents
        self.ways = [
            [vertex, *tree.children[vertex], *([parent] if parent != NOWHERE else [])]
            for vertex, parent in enumerate(tree.parents)
        ]
        self.next_places = cache(self._next_places)

    def ticks(self, start: Places) -> int:
        """Return the ticks from a start to the first return with everything visited."""
        everything = (1 << len(self.parents)) - 1
        first = (start, 1 << start[0])
        best: dict[Places, list[int]] = {start: [first[1]]}
        level, ticks = [first], 0
        while (start, everything) not in level:
            fresh: dict[tuple[Places, int], None] = {}
            for places, visited in level:
                for after, occupied in self.next_places(places):
                    if add(best.setdefault(after, []), visited | occupied):
                        fresh[after, visited | occupied] = None
            level = [state for state in fresh if state[1] in best[state[0]]]
            ticks += 1
        return ticks

    def _next_places(self, places: Places) -> list[tuple[Places, int]]:
        """Return all connected places of the next tick, and the vertices that they occupy."""
        return [
            (after, sum(1 << vertex for vertex in occupied))
            for after in {tuple(sorted(goals)) for goals in self._goals(places)}
            if is_connected(self.parents, occupied := set(after))
        ]

    def _goals(self, places: Places) -> Iterator[Places]:
        return product(*map(self.ways.__getitem__, places))


def is_connected(parents: tuple[int, ...], occupied: set[int]) -> bool:
    """Tell whether vertices of a tree form one subtree: only one of them has no parent there."""
    return sum(parents[vertex] not in occupied for vertex in occupied) == 1


def add(maximal: list[int], visited: int) -> bool:
    """Add a set to those of which none is part of another; return whether it was no part of any."""
    if any(visited & ~other == 0 for other in maximal):
        return False
    maximal[:] = [other for other in maximal if other & ~visited]
    maximal.append(visited)
    return True
