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
- The run ends (Lemma 4.2) if the team has `connected_splits.robots_needed`, or there is no split. A
  smaller team may come to a stand: `next_moves` then has none, and it is not `Team.over`.
- NCOCTA takes E_H ticks on a perfect tree (Lemmas 4.3 and 4.4), `connected_splits.perfect_tree_ticks`,
  if each split height is one below the last, as in the formula; where heights are left out, at most
  that.
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
- More robots may take longer with COCTA, as they allow a split that hurts. So
  `connected_splits.choose_splits` can also try what the team is large enough for, on the tree itself.

Beyond the paper: a *load* (`SparingTick`), for which `agents.planning.connected_best` looks.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from heapq import heapify, heappop, heapreplace
from math import inf
from typing import Literal

from agents.planning.rooted_tree import NOWHERE, RootedTree

Variant = Literal["ncocta", "cocta"]

Moves = dict[int, int]
"""Where each robot goes in this tick; a robot that is absent stays."""


# What the team knows.


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


class Team:
    """The state of a team: where its robots are, and what is explored. Every robot keeps a copy.

    Everything is kept up to date move by move, so a tick costs no more than the robots' places, and
    their ancestors when a vertex is finished, however large the tree is.

    Attributes:
        tree: what they cover.
        team_size: number of robots that are left; the paper's k.
        drips: whether they follow COCTA, not NCOCTA.
        splits: the split heights, descending.
        top_split: the first of them (h_1); 0 without splits, as no vertex with children is so low.
        load: how many robots a subtree takes, in sixteenths of its unfinished vertices; None: COCTA.
        trails: with a load: the vertices on the longest way down from each vertex, itself included.
        at: the vertex of each robot that is left, by ascending id.
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
        "load",
        "next_child",
        "pending",
        "robots_at",
        "splits",
        "team_size",
        "top_split",
        "trails",
        "tree",
        "unfinished",
        "visited",
    )

    def __init__(
        self,
        tree: RootedTree,
        team_size: int,
        variant: Variant,
        splits: Sequence[int] = (),
        *,
        at: Mapping[int, int] | None = None,
        visited: Iterable[int] = (),
        load: int | None = None,
    ) -> None:
        """Put all robots at the root, or wherever they are.

        Args:
            tree: what they are to cover.
            team_size: number of robots.
            variant: ``"ncocta"`` (Alg. 1) or ``"cocta"`` (Alg. 2).
            splits: the split heights, for instance from `choose_splits`.
            at: the vertex of each robot, by id; default: robots 0, 1, ... at the root.
            visited: vertices that were visited before.
            load: departs from COCTA: see `SparingTick`.

        Raises:
            ValueError: If there is no robot, or a load that is not COCTA's or none at all, or as
                `checked_splits` does.
        """
        if team_size < 1:
            raise ValueError("a team has at least one robot")
        if load is not None and (variant != "cocta" or load < 1):
            raise ValueError(f"a load is at least 1, and for COCTA: {load} for {variant}")
        self.tree = tree
        self.team_size = team_size
        self.drips = variant == "cocta"
        self.splits = checked_splits(tree, splits)
        self.top_split = self.splits[0] if self.splits else 0
        self.load = load
        self.trails = [] if load is None else trails(tree)
        everybody_at_root = dict.fromkeys(range(team_size), tree.root)
        self.at = everybody_at_root if at is None else dict(sorted(at.items()))
        self.robots_at: dict[int, list[int]] = {}
        self.inside = [0] * len(tree)
        for robot, vertex in sorted(self.at.items()):
            self.robots_at.setdefault(vertex, []).append(robot)
            self.inside[vertex] += 1
        self.pending = [1 + len(children) for children in tree.children]
        self.next_child = [0] * len(tree)
        self.visited = bytearray(len(tree))
        for vertex in {*visited, *self.robots_at}:
            self._visit(vertex)
        self.finished = bytearray(len(tree))
        self.unfinished = [1] * len(tree)
        for vertex in sorted(range(len(tree)), key=tree.upwards.__getitem__):
            here = len(self.robots_at.get(vertex, ()))
            if not self.pending[vertex] and self.inside[vertex] == here:
                self.finished[vertex] = 1
                self.unfinished[vertex] -= 1
            parent = tree.parents[vertex]
            if parent != NOWHERE:
                self.inside[parent] += self.inside[vertex]
                self.unfinished[parent] += self.unfinished[vertex]

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


def trails(tree: RootedTree) -> list[int]:
    """Return the number of vertices on the longest way down from each vertex, itself included."""
    longest = [1] * len(tree)
    for vertex in sorted(range(len(tree)), key=tree.upwards.__getitem__):
        parent = tree.parents[vertex]
        if parent != NOWHERE:
            longest[parent] = max(longest[parent], longest[vertex] + 1)
    return longest


# The rule.


def next_moves(team: Team) -> Moves:
    """Return where each robot goes in this tick. The team stays as it is: see `Team.apply`.

    Of the robots at a vertex those with the highest ids go, and those with the lowest stay. A robot
    that arrives in this tick does not go on, but counts where it is.

    Paper:
        Sinay et al. 2017, Alg. 1 (NCOCTA) and Alg. 2 (COCTA). Departures: see the top.
    """
    tick = Tick(team) if team.load is None else SparingTick(team)
    lowest_first = sorted(team.robots_at, key=team.tree.upwards.__getitem__)
    for vertex in lowest_first:
        if vertex != team.tree.root:
            tick.go_up(vertex)
    for vertex in reversed(lowest_first):
        tick.go_down(vertex)
    return tick.moves


class Tick:
    """One tick in the making: the rule for one vertex after another, while the team stays as it is.

    The cases of Alg. 1 and 2, and who does what (*guard*: all but one, or all if one has just arrived):

    ==================================  =====================================  =========
    v is finished                       all go up                              `go_up`
    explored, with robots below         guard, the rest goes up                `go_up`
    the same at a split, NCOCTA         all stay, until those below are back   `go_up`
    not explored, h(v) = h_i            guard, the rest spreads                `go_down`
    the same, COCTA, no work for some   these go up                            `go_up`
    not explored, h(v) < h_1            guard, the rest goes to the first      `go_down`
                                        child (COCTA: as many as it has work
                                        for, then to the next)
    not explored, h(v) > h_1            the same, and no guard if all robots   `go_down`
                                        are here or there
    ==================================  =====================================  =========

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


class SparingTick(Tick):
    """COCTA with a load: it sends fewer robots down, and all who have no work come up again.

    A subtree takes ``load`` sixteenths as many robots as it has unfinished vertices, but as many as it
    takes to reach its lowest leaf. One robot for each vertex, as in COCTA, would stand guard half of
    the time; of two that share three vertices, each guards while the other one visits. Who finds
    no work at a vertex goes up, not only at a split.

    Connected at every tick, from any configuration: the last robot of a vertex leaves it only as in
    COCTA. That the run ends is not known for a load: the robots might go up and down for ever.
    """

    __slots__ = ()

    def room(self, vertex: int) -> float:
        """Return how many more robots may go into a subtree."""
        team = self.team
        assert team.load is not None
        work = team.unfinished[vertex] - self.just_finished[vertex]
        most = max(min(work, team.trails[vertex]), -(-work * team.load // 16))
        return max(0, most - self.robots_in(vertex))

    def go_up(self, vertex: int) -> None:
        """Send robots to the parent, also those for whom there is no work here."""
        if not self.team.pending[vertex]:
            super().go_up(vertex)
        else:
            spare = self.left[vertex] - self.guard(vertex)
            self.rise(vertex, self.surplus(vertex, spare))


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
