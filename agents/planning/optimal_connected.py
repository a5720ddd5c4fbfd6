"""How fast a connected team can cover a tree at all: a lower bound, and the exact optimum.

The model is that of `agents.algorithms.connected_rule`: in a tick each robot stays or crosses one edge,
the vertices with robots are connected at every tick, and all robots start and end at the root.
"""

from collections.abc import Iterator
from functools import cache
from itertools import product

from agents.algorithms.connected_rule import trails
from agents.planning.rooted_tree import NOWHERE, RootedTree

MOST_VERTICES = 12
"""The number of states grows by the power of the vertices; more of them than this take too long."""


def lower_bound(tree: RootedTree, team_size: int) -> int:
    """Return a number of ticks that no plan can do with less.

    The *trail* of a vertex is the longest way down from it, in vertices, itself included. For every
    depth d the bound is 2 d + ceil(W / k); the largest depth gives twice the height. W is the sum of

    - 2 min(k, trail) over all vertices below depth d,
    - 2 for each vertex at depth d that has children, and whose trail is at most k,
    - 2 for d = 0 if the trail of the root is longer, and k > 1.

    Proof:
        W counts *robot-ticks*: what one robot does in one tick. No robot is at depth d in the first d
        ticks or the last d, so k (T - 2 d) of them are left for what happens at depth d and below.

        First term. When a robot is at the lowest leaf below v, all k are in the subtree of v, or else,
        as they are connected, the whole trail from v to that leaf is occupied. So min(k, trail)
        robots or more have gone down to v by then, and go up from it later.

        Second term. Let t be the tick in which robots first go from v to a child, say to u. If v is
        occupied afterwards, that robot stayed or came from above, as no child had been entered:
        neither is in the first term. If v is not occupied, all robots are in the subtree of u; so all
        k went there in this tick, and the first term has but trail(u) < k of these crossings. In the
        same way backwards in time: a robot stays at v or goes up, or all k come up, in the tick in
        which robots last come up to v, which is later than t.

        Third term. At first all robots are at one vertex x, the root. Either one of them stays, which
        is in no other term; or all k go down to the same child, as they are connected, and the same
        is asked again; or, below the root, one goes up. A child with a trail shorter than k, as a
        leaf has, is entered by more robots than the first term counts. If one goes up from x, whose
        trail is at least k and whose lowest leaf is not visited yet, it has to come down to x again,
        as all k must be below at once. So there is one robot-tick more, a stay or a crossing down;
        and backwards in time one more, a stay or a crossing up. If both are a stay in the same tick,
        all k stay in it.
    """
    longest = trails(tree)
    needed = [0] * (tree.height + 1)
    tops = [0] * (tree.height + 1)
    for vertex, trail in enumerate(longest):
        depth = tree.height - tree.heights[vertex]
        needed[depth] += 2 * min(team_size, trail)
        tops[depth] += 2 * (1 < trail <= team_size)
    if longest[tree.root] > team_size > 1:
        tops[0] = 2
    bound = below = 0
    for depth in range(tree.height, -1, -1):
        bound = max(bound, 2 * depth + -(-(below + tops[depth]) // team_size))
        below += needed[depth]
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
