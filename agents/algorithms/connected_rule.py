"""NCOCTA and COCTA: the rule by which a team covers a known tree and stays connected.

Sinay, Agmon, Maksimov, Kraus, Peleg 2017, "Maintaining Communication in Multi-Robot Tree Coverage",
Algorithms 1 and 2. This is the rule alone, without any world: what the team knows (`Team`), and who
goes where next (`next_moves`).

Assumes: a tree that all robots know; all robots start at its root; lockstep; two robots reach each
other at the same vertex or at adjacent ones, and messages travel along such links. While the team is
connected all know where all are, so each robot computes the moves of all and makes its own.

Words: a vertex is *explored* when its whole subtree has been visited, and *finished* when besides no
robot is strictly below it. The height of a vertex is that of the tree (the paper's H) less its depth.
At *split heights* (h_1 > ... > h_m) one robot stays and the others spread over the children. Above the
*top split* h_1 the team moves together; below it the robots leave a trail, one at each vertex that they
pass. NCOCTA goes to the next child when the last one is finished. COCTA sends no more robots into a
subtree than it has unfinished vertices; the others *drip* into the next one.

Claims:

- Connected at every tick (Lemma 4.1); in the end every vertex is visited and all are back at the root.
- The run ends (Lemma 4.2) if the team has `robots_needed`, or there is no split. A smaller team may
  come to a stand: `next_moves` then has none, and it is not `Team.over`.
- NCOCTA takes E_H ticks on a perfect tree (Lemmas 4.3 and 4.4), `perfect_tree_ticks`, if each split
  height is one below the last, as in the formula; where heights are left out, at most that.
- COCTA is never slower than NCOCTA with the same split heights (Sec. 4.3).

Departures from the paper:

- One tick. The paper's figures come out only where a robot may cross several edges in one iteration of
  its loop. Here each robot crosses at most one: first all that go up, from the lowest vertices to the
  highest, then all that go down, from the highest to the lowest. A guard may leave in the tick in which
  another robot arrives to take its place. The times of NCOCTA are then those that the paper proves.
- Alg. 2, above the top split, sends all robots of a vertex down. But with COCTA some may be elsewhere:
  behind in a subtree that the first have left, or on their way. As printed the team then falls apart.
  Here one robot stays as long as anyone is neither here nor in the subtree that the others go to.
- "Split the rest equally" (Alg. 1 and 2): one by one to the child with the fewest robots in its
  subtree, in order where they are equal. If remainders went round robin, COCTA could be slower than
  NCOCTA.
- The logarithm in the number of splits (Sec. 4.1) is rounded down, as the paper's examples need it.
- More robots may take longer with COCTA, as they allow a split that hurts. So `choose_splits` can also
  try what the team is large enough for, on the tree itself.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from heapq import heapify, heappop, heapreplace
from itertools import islice
from math import inf
from typing import Literal

from protocol.graph import PortGraph

Variant = Literal["ncocta", "cocta"]

Splits = Literal["paper", "best"] | Sequence[int]
"""Split heights: by the paper's formula, the fastest of those that were tried, or as given."""

Moves = dict[int, int]
"""Where each robot goes in this tick; a robot that is absent stays."""

NOWHERE = -1
"""The parent of the root."""


# The tree.


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


def tree_of_graph(graph: PortGraph, root: int) -> RootedTree:
    """Return a graph that is a tree, seen from its root; children are explored in the order of ports.

    Raises:
        ValueError: If the graph is no tree.
    """
    children: list[list[int]] = [[] for _ in graph.far]
    entry = {root: -1}
    found = [root]
    for vertex in found:
        for port, (far, back) in enumerate(graph.ways[vertex]):
            if port != entry[vertex]:
                if far in entry:
                    raise ValueError(f"no tree: the edge from {vertex} to {far} closes a cycle")
                entry[far] = back
                children[vertex].append(far)
                found.append(far)
    return RootedTree(children, root)


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


# What the team knows.


class Team:
    """The state of a team: where its robots are, and what is explored. Every robot keeps a copy.

    Everything is kept up to date move by move, so a tick costs no more than the robots' places, and
    their ancestors when a vertex is finished, however large the tree is.

    Attributes:
        tree: what they cover.
        team_size: the paper's k.
        drips: whether they follow COCTA, not NCOCTA.
        splits: the split heights, descending.
        top_split: the first of them (h_1); 0 without splits, as no vertex with children is so low.
        at: the vertex of each robot.
        robots_at: the robots at each vertex that has any, ascending.
        inside: number of robots in the subtree of each vertex.
        pending: for each vertex how many of itself and its children are not visited and explored,
            respectively; 0 when it is explored itself.
        next_child: for each vertex the place of its first child that is not explored.
        unfinished: number of vertices in the subtree of each vertex that are not finished.
        finished: whether each vertex is.
        visited: whether a robot has been at each vertex.
    """

    __slots__ = (
        "at",
        "drips",
        "finished",
        "inside",
        "next_child",
        "pending",
        "robots_at",
        "splits",
        "team_size",
        "top_split",
        "tree",
        "unfinished",
        "visited",
    )

    def __init__(
        self, tree: RootedTree, team_size: int, variant: Variant, splits: Sequence[int] = ()
    ) -> None:
        """Put all robots at the root.

        Args:
            tree: what they are to cover.
            team_size: number of robots.
            variant: ``"ncocta"`` (Alg. 1) or ``"cocta"`` (Alg. 2).
            splits: the split heights, for instance from `choose_splits`.

        Raises:
            ValueError: If there is no robot, or as `checked_splits` does.
        """
        if team_size < 1:
            raise ValueError("a team has at least one robot")
        self.tree = tree
        self.team_size = team_size
        self.drips = variant == "cocta"
        self.splits = checked_splits(tree, splits)
        self.top_split = self.splits[0] if self.splits else 0
        self.at = [tree.root] * team_size
        self.robots_at = {tree.root: list(range(team_size))}
        self.inside = [0] * len(tree)
        self.inside[tree.root] = team_size
        self.pending = [1 + len(children) for children in tree.children]
        self.next_child = [0] * len(tree)
        self.unfinished = [1] * len(tree)
        for vertex in sorted(range(len(tree)), key=tree.upwards.__getitem__)[:-1]:
            self.unfinished[tree.parents[vertex]] += self.unfinished[vertex]
        self.finished = bytearray(len(tree))
        self.visited = bytearray(len(tree))
        for vertex in self._visit(tree.root):
            self._judge(vertex)

    @property
    def over(self) -> bool:
        """Whether all is covered and all robots are back at the root."""
        return bool(self.finished[self.tree.root])

    def open_children(self, vertex: int) -> Iterator[int]:
        """Yield the children of a vertex that are not explored, in order."""
        children = self.tree.children[vertex]
        for place in range(self.next_child[vertex], len(children)):
            if self.pending[children[place]]:
                yield children[place]

    def apply(self, moves: Moves) -> None:
        """Let robots move, all at once.

        Raises:
            ValueError: If a move follows no edge; nothing has then moved.
        """
        parents = self.tree.parents
        for robot, to in moves.items():
            along_an_edge = parents[to] == self.at[robot] or parents[self.at[robot]] == to
            if to == NOWHERE or not along_an_edge:
                raise ValueError(f"robot {robot} cannot go from {self.at[robot]} to {to}")
        changed = set()
        for robot, to in moves.items():
            vertex = self.at[robot]
            down = parents[to] == vertex
            if down:
                self.inside[to] += 1
            else:
                self.inside[vertex] -= 1
            changed.add(vertex if down else to)
            self._leave(robot)
            self.at[robot] = to
            self.robots_at.setdefault(to, []).append(robot)
            if not self.visited[to]:
                changed.update(self._visit(to))
        for vertex in set(moves.values()):
            self.robots_at[vertex].sort()
        for vertex in changed:
            self._judge(vertex)

    def _leave(self, robot: int) -> None:
        there = self.robots_at[self.at[robot]]
        there.remove(robot)
        if not there:
            del self.robots_at[self.at[robot]]

    def _visit(self, vertex: int) -> list[int]:
        """Take a vertex for visited; return what is thereby explored."""
        self.visited[vertex] = 1
        self.pending[vertex] -= 1
        explored = []
        while not self.pending[vertex]:
            explored.append(vertex)
            vertex = self.tree.parents[vertex]
            if vertex == NOWHERE:
                break
            self.pending[vertex] -= 1
            children = self.tree.children[vertex]
            place = self.next_child[vertex]
            while place < len(children) and not self.pending[children[place]]:
                place += 1
            self.next_child[vertex] = place
        return explored

    def _judge(self, vertex: int) -> None:
        """See whether a vertex is finished, and count anew above it if that is news."""
        here = len(self.robots_at.get(vertex, ()))
        finished = not self.pending[vertex] and self.inside[vertex] == here
        if finished != self.finished[vertex]:
            self.finished[vertex] = finished
            by = -1 if finished else 1
            while vertex != NOWHERE:
                self.unfinished[vertex] += by
                vertex = self.tree.parents[vertex]


# The rule.


def next_moves(team: Team) -> Moves:
    """Return where each robot goes in this tick. The team stays as it is: see `Team.apply`.

    Of the robots at a vertex those with the highest ids go, and those with the lowest stay. A robot
    that arrives in this tick does not go on, but counts where it is.

    Paper:
        Sinay et al. 2017, Alg. 1 (NCOCTA) and Alg. 2 (COCTA). Departures: see the top.
    """
    tick = Tick(team)
    lowest_first = sorted(team.robots_at, key=team.tree.upwards.__getitem__)
    for vertex in lowest_first:
        if vertex != team.tree.root:
            tick.go_up(vertex)
    for vertex in reversed(lowest_first):
        tick.go_down(vertex)
    return tick.moves


class Tick:
    """One tick in the making: the rule for one vertex after another, while the team stays as it is.

    Attributes:
        moves: those made so far.
        left: the robots at each vertex that have not moved yet, without those that arrived.
        arrived: how many robots have arrived at each vertex.
        gone_up: how many have left each vertex, and thereby its subtree.
        just_finished: how many vertices of each subtree are finished since the tick began.
    """

    __slots__ = ("arrived", "gone_up", "just_finished", "left", "moves", "team")

    def __init__(self, team: Team) -> None:
        self.team = team
        self.moves: Moves = {}
        self.left = {vertex: len(robots) for vertex, robots in team.robots_at.items()}
        self.arrived: Counter[int] = Counter()
        self.gone_up: Counter[int] = Counter()
        self.just_finished: Counter[int] = Counter()

    # What is so at this moment of the tick.

    def guard(self, vertex: int) -> int:
        """Return how many must stay: one, unless another has just arrived to take its place."""
        return 0 if self.arrived[vertex] else 1

    def robots_in(self, vertex: int) -> int:
        """Return the number of robots in a subtree that none has entered in this tick."""
        return self.team.inside[vertex] - self.gone_up[vertex]

    def room(self, vertex: int) -> float:
        """Return how many more robots may go into a subtree: as many as it has work for (COCTA)."""
        if not self.team.drips:
            return inf
        work = self.team.unfinished[vertex] - self.just_finished[vertex]
        return max(0, work - self.robots_in(vertex))

    def is_split(self, vertex: int) -> bool:
        """Tell whether the robots spread here over all children (h(v) = h_i for some i)."""
        return self.team.tree.heights[vertex] in self.team.splits

    # Up, from the lowest to the highest.

    def go_up(self, vertex: int) -> None:
        """Send robots to the parent: all if the vertex is finished; else all but a guard, if any."""
        team = self.team
        spare = self.left[vertex] - self.guard(vertex)
        if team.pending[vertex]:
            if team.drips and self.is_split(vertex):
                self.rise(vertex, self.surplus(vertex, spare))
        elif not team.drips and self.is_split(vertex):
            # Those who arrive in this tick have finished it, but here all wait to move on together.
            if team.finished[vertex]:
                self.rise(vertex, self.left[vertex])
        elif self.is_finished(vertex):
            self.rise(vertex, self.left[vertex])
        else:
            self.rise(vertex, spare)

    def is_finished(self, vertex: int) -> bool:
        """Tell whether a vertex is explored and all robots in its subtree are at it by now."""
        team = self.team
        here = len(team.robots_at.get(vertex, ())) + self.arrived[vertex]
        return not team.pending[vertex] and team.inside[vertex] == here

    def surplus(self, vertex: int, spare: int) -> int:
        """Return how many of the spare robots no child has work for (Alg. 2, at a split)."""
        for child in self.team.open_children(vertex):
            if spare <= 0:
                break
            spare -= int(min(spare, self.room(child)))
        return max(0, spare)

    def rise(self, vertex: int, number: int) -> None:
        """Move robots to the parent."""
        if number:
            parent = self.team.tree.parents[vertex]
            self.move(vertex, parent, number)
            self.gone_up[vertex] += number
            if self.team.drips and self.is_finished(parent):
                while parent != NOWHERE:
                    self.just_finished[parent] += 1
                    parent = self.team.tree.parents[parent]

    # Down, from the highest to the lowest.

    def go_down(self, vertex: int) -> None:
        """Send robots to children that are not explored."""
        team = self.team
        if not team.pending[vertex] or not self.left[vertex]:
            return
        spare = self.left[vertex] - self.guard(vertex)
        if self.is_split(vertex):
            self.spread(vertex, spare)
        elif team.tree.heights[vertex] < team.top_split:
            self.fill(vertex, spare)
        else:
            child = next(team.open_children(vertex))
            together = spare if self.others_elsewhere(vertex, child) else self.left[vertex]
            self.fill(vertex, together if together <= self.room(child) else spare)

    def others_elsewhere(self, vertex: int, child: int) -> bool:
        """Tell whether a robot is neither here nor in the subtree that the others go to.

        The paper's proof has all robots here (Lemma 4.1), which COCTA does not keep.
        """
        here = len(self.team.robots_at[vertex]) - self.gone_up[vertex] + self.arrived[vertex]
        return here + self.robots_in(child) < self.team.team_size

    def fill(self, vertex: int, number: int) -> None:
        """Move robots to the first open child, and those it has no work for to the next ones."""
        for child in self.team.open_children(vertex):
            if number <= 0:
                break
            share = int(min(number, self.room(child)))
            self.move(vertex, child, share)
            number -= share

    def spread(self, vertex: int, number: int) -> None:
        """Move robots one by one to the open child with the fewest robots in its subtree."""
        if number <= 0:
            return
        counts: list[tuple[int, int, int]] = []
        empty = 0
        for place, child in enumerate(self.team.open_children(vertex)):
            if self.room(child):
                counts.append((self.robots_in(child), place, child))
                empty += not counts[-1][0]
            if empty == number:
                break  # each goes to an empty one: no other child can get any
        heapify(counts)
        shares: Counter[int] = Counter()
        for _ in range(number):
            if not counts:
                break
            count, place, child = counts[0]
            shares[child] += 1
            if shares[child] < self.room(child):
                heapreplace(counts, (count + 1, place, child))
            else:
                heappop(counts)
        for child in self.team.open_children(vertex):
            if not shares:
                break
            self.move(vertex, child, shares.pop(child, 0))

    def move(self, vertex: int, to: int, number: int) -> None:
        """Move those with the highest ids of the robots that are left at a vertex."""
        last = self.left[vertex]
        for robot in self.team.robots_at[vertex][last - number : last]:
            self.moves[robot] = to
        self.left[vertex] = last - number
        self.arrived[to] += number


def ticks_taken(team: Team, limit: int) -> int | None:
    """Move a team until its run is over; return the number of ticks.

    Returns:
        None if it was not over after ``limit`` ticks, or none could move any more.
    """
    for tick in range(limit):
        if team.over:
            return tick
        moves = next_moves(team)
        if not moves:
            return None
        team.apply(moves)
    return limit if team.over else None


# Where the team splits.

MOST_SPLITS = 4096
"""How many sets of split heights are looked at, at most, before they are tried."""


def choose_splits(
    tree: RootedTree, team_size: int, variant: Variant, splits: Splits, effort: int = 100_000
) -> tuple[int, ...]:
    """Return the split heights for a team, descending.

    Args:
        tree: what they are to cover.
        team_size: number of robots.
        variant: ``"ncocta"`` or ``"cocta"``.
        splits: ``"paper"``, ``"best"``, or the heights themselves.
        effort: how many ticks may be played, in all, to find the best.

    Raises:
        ValueError: If a given height is not in 1..H, or given twice.
    """
    if splits == "paper":
        return paper_splits(tree.arity, tree.height, team_size)
    if splits == "best":
        return fastest_splits(tree, team_size, variant, effort)
    assert not isinstance(splits, str), splits
    return checked_splits(tree, splits)


def checked_splits(tree: RootedTree, splits: Iterable[int]) -> tuple[int, ...]:
    """Return split heights in descending order.

    Raises:
        ValueError: If one is not in 1..H, or given twice.
    """
    descending = tuple(sorted(splits, reverse=True))
    if len(set(descending)) < len(descending):
        raise ValueError(f"a split height is given twice: {[*descending]}")
    if descending and not 1 <= descending[-1] <= descending[0] <= tree.height:
        raise ValueError(f"split heights are in 1..{tree.height}, not {[*descending]}")
    return descending


def paper_splits(arity: int, height: int, team_size: int) -> tuple[int, ...]:
    """Return the split heights by the paper's formula, for as many splits as the team allows.

    Where the highest would be above the root, the lowest is lowered, and if that is not enough there
    are fewer of them. On a tree that is not perfect ``arity`` is the largest number of children; on a
    path nothing is to be split.

    Paper:
        Sinay et al. 2017, Sec. 4.2, Eq. (1), with the lowest height of Lemma 4.5 as in Sec. 4.3.
    """
    if arity < 2:
        return ()
    number = 0
    while robots_needed(arity, _printed_splits(arity, number + 1)) <= team_size:
        number += 1
    number = min(number, height)
    if not number:
        return ()
    lowest = min(_printed_splits(arity, number)[-1], height - number + 1)
    return tuple(range(lowest + number - 1, lowest - 1, -1))


def _printed_splits(arity: int, number: int) -> tuple[int, ...]:
    """Return h_1, ..., h_m for m splits: h_m = floor(log_N m) + m + 4, and h_i = h_m + m - i."""
    logarithm = 0
    while arity ** (logarithm + 1) <= number:
        logarithm += 1
    lowest = logarithm + number + 4
    return tuple(range(lowest + number - 1, lowest - 1, -1))


def robots_needed(arity: int, splits: Sequence[int]) -> int:
    """Return how many robots make up a trail from each split to the leaves: then the run ends.

    Paper:
        Sinay et al. 2017, Sec. 4.1: 1 + N h_1 + the sum over i > 1 of (N^i - N^(i-1)) h_i.
    """
    if not splits:
        return 1
    needed = 1 + arity * splits[0]
    for i, height in enumerate(splits[1:], 2):
        needed += (arity**i - arity ** (i - 1)) * height
    return needed


def perfect_tree_ticks(arity: int, height: int, splits: Sequence[int]) -> int:
    """Return the ticks that NCOCTA takes on a perfect tree, with at least `robots_needed`.

    Paper:
        Sinay et al. 2017, Lemma 4.3 and the recursion for Lemma 4.4 (E_H), for any split heights.
    """
    if not splits:
        return _there_and_back(arity, height)
    lower = splits[-1]
    ticks: int = vertices_of_perfect(arity, lower - 1) + lower
    for upper in splits[-2::-1]:
        # Into one child; from there, all together, to each vertex of the lower split height.
        between = upper - 1 - lower
        ticks = 2 + _there_and_back(arity, between) + arity**between * ticks
        lower = upper
    subtrees: int = arity ** (height - lower)
    return _there_and_back(arity, height - lower) + subtrees * ticks


def _there_and_back(arity: int, height: int) -> int:
    return 2 * (vertices_of_perfect(arity, height) - 1)


def fastest_splits(
    tree: RootedTree, team_size: int, variant: Variant, effort: int
) -> tuple[int, ...]:
    """Return the fastest of the split heights that were tried on a tree.

    Those of the paper come first, then others in the order in which they are promising: by the time
    of NCOCTA on the perfect tree. Each is played to its end, or until it is no faster.
    """
    best = paper_splits(tree.arity, tree.height, team_size)
    limit = effort
    sets = sorted(
        islice(allowed_splits(tree, team_size), MOST_SPLITS),
        key=lambda splits: (perfect_tree_ticks(tree.arity, tree.height, splits), splits),
    )
    for splits in dict.fromkeys((best, *sets)):
        if effort <= 0:
            break
        ticks = ticks_taken(Team(tree, team_size, variant, splits), min(limit, effort))
        if ticks is not None:
            best, limit = splits, ticks - 1
        effort -= limit
    return best


def allowed_splits(
    tree: RootedTree, team_size: int, above: tuple[int, ...] = ()
) -> Iterator[tuple[int, ...]]:
    """Yield the sets of split heights for which a team is large enough, and that there be none."""
    yield above
    if tree.arity < 2:
        return
    for height in range(above[-1] - 1 if above else tree.height, 0, -1):
        splits = (*above, height)
        if robots_needed(tree.arity, splits) <= team_size:
            yield from allowed_splits(tree, team_size, splits)
