"""The paper's own simulator of NCOCTA and COCTA, as far as its figures tell: counts changed in place.

Sinay et al. 2017, Algorithms 1 and 2. In each iteration of their loop the vertices that have robots
when it begins are gone through from the lowest to the highest. Robots move at once, and those that
arrive at a vertex whose turn is still to come move on with the others there. So a robot may cross
several edges in one tick: that is no model of robots, and stands here only to regenerate the paper's
curves.

Otherwise the rules are those of `agents.algorithms.connected_rule`, but for one: at a split, robots go
to the children one by one in turn, wherever others are already.
"""

from collections.abc import Sequence
from heapq import heapify, heappop
from math import inf

from agents.algorithms.connected_rule import Variant, checked_splits
from agents.planning.rooted_tree import NOWHERE, RootedTree


class InPlace:
    """A team, by the number of robots at each vertex.

    Attributes:
        here: number of robots at each vertex.
        inside: number of robots in the subtree of each vertex.
        pending: for each vertex how many of itself and its children are not visited and explored.
        unfinished: number of vertices in the subtree of each vertex that are not finished.
        finished: whether each vertex is.
    """

    def __init__(
        self, tree: RootedTree, team_size: int, variant: Variant, splits: Sequence[int] = ()
    ) -> None:
        """Put all robots at the root.

        Raises:
            ValueError: If the split heights are none of the tree.
        """
        self._tree = tree
        self._team_size = team_size
        self._drips = variant == "cocta"
        self._splits = checked_splits(tree, splits)
        self._top_split = self._splits[0] if self._splits else 0
        self._lowest_first = sorted(range(len(tree)), key=tree.upwards.__getitem__)
        self._occupied = {tree.root}
        self._visited = bytearray(len(tree))
        self.here = [0] * len(tree)
        self.inside = [0] * len(tree)
        self.here[tree.root] = self.inside[tree.root] = team_size
        self.pending = [1 + len(children) for children in tree.children]
        self.unfinished = [1] * len(tree)
        self.finished = bytearray(len(tree))
        for vertex in self._lowest_first[:-1]:
            self.unfinished[tree.parents[vertex]] += self.unfinished[vertex]
        self._visit(tree.root)

    @property
    def over(self) -> bool:
        """Whether all is covered and all robots are back at the root."""
        return bool(self.finished[self._tree.root])

    def tick(self) -> bool:
        """Go through the vertices that have robots; tell whether any moved."""
        ahead = [self._tree.upwards[vertex] for vertex in self._occupied]
        heapify(ahead)
        moved = False
        while ahead:
            moved |= self._process(self._lowest_first[heappop(ahead)])
        return moved

    def _process(self, vertex: int) -> bool:
        tree, here = self._tree, self.here[vertex]
        if self.finished[vertex]:
            return self._rise(vertex, here)
        spare = here - 1
        split = tree.heights[vertex] in self._splits
        if not self.pending[vertex]:
            return False if split and not self._drips else self._rise(vertex, spare)
        children = [child for child in tree.children[vertex] if self.pending[child]]
        if split:
            return self._deal(vertex, children, spare)
        if tree.heights[vertex] >= self._top_split:
            first = children[0]
            together = spare if here + self.inside[first] < self._team_size else here
            spare = together if together <= self._room(first) else spare
        return self._fill(vertex, children, spare)

    def _room(self, vertex: int) -> float:
        """Return how many more robots may go into a subtree."""
        return max(0, self.unfinished[vertex] - self.inside[vertex]) if self._drips else inf

    def _fill(self, vertex: int, children: Sequence[int], number: int) -> bool:
        """Move robots to the first child, and those it has no work for to the next ones."""
        left = number
        for child in children:
            share = int(min(left, self._room(child)))
            if share > 0:
                self._move(vertex, child, share)
                left -= share
        return left < number

    def _deal(self, vertex: int, children: Sequence[int], number: int) -> bool:
        """Move robots one by one to all children in turn, and what is left over to the parent."""
        rooms = dict(zip(children, map(self._room, children), strict=True))
        shares = dict.fromkeys(children, 0)
        left = number
        while left and rooms:
            for child in list(rooms):
                if not left:
                    break
                if shares[child] < rooms[child]:
                    shares[child] += 1
                    left -= 1
                else:
                    del rooms[child]
        for child, share in shares.items():
            if share:
                self._move(vertex, child, share)
        up = self._rise(vertex, left) if self._drips else False
        return up or left < number

    def _rise(self, vertex: int, number: int) -> bool:
        parent = self._tree.parents[vertex]
        if not number or parent == NOWHERE:
            return False
        self._move(vertex, parent, number)
        return True

    def _move(self, vertex: int, to: int, number: int) -> None:
        if to == self._tree.parents[vertex]:
            self.inside[vertex] -= number
        else:
            self.inside[to] += number
        self.here[vertex] -= number
        self.here[to] += number
        if not self.here[vertex]:
            self._occupied.remove(vertex)
        self._occupied.add(to)
        if not self._visited[to]:
            self._visit(to)
        self._judge(to)
        self._judge(vertex)

    def _visit(self, vertex: int) -> None:
        self._visited[vertex] = 1
        self.pending[vertex] -= 1
        while not self.pending[vertex]:
            self._judge(vertex)
            vertex = self._tree.parents[vertex]
            if vertex == NOWHERE:
                break
            self.pending[vertex] -= 1

    def _judge(self, vertex: int) -> None:
        """See whether a vertex is finished, and count anew above it if that is news."""
        finished = not self.pending[vertex] and self.inside[vertex] == self.here[vertex]
        if finished != self.finished[vertex]:
            self.finished[vertex] = finished
            by = -1 if finished else 1
            while vertex != NOWHERE:
                self.unfinished[vertex] += by
                vertex = self._tree.parents[vertex]


def inplace_ticks(
    tree: RootedTree, team_size: int, variant: Variant, splits: Sequence[int] = ()
) -> int | None:
    """Play a run to its end; return the number of ticks, or None if it comes to a stand."""
    team = InPlace(tree, team_size, variant, splits)
    ticks = 0
    while not team.over:
        if not team.tick():
            return None
        ticks += 1
    return ticks
