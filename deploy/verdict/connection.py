"""Whether a team is connected: counted as robots come and go, not searched for at each instant.

Robots reach each other at the same vertex or at adjacent ones; so a team is connected if the vertices
with robots are. On a tree they are if and only if there is one more of them than of edges between
them, and both numbers are kept up to date. On a graph with cycles that test is made with the robots'
spanning tree: if it says yes, so it is; else it is searched for.
"""

from collections import deque
from collections.abc import Iterator

from protocol.graph import PortGraph

NOWHERE = -1

Pair = tuple[int, int]
"""The ends of an edge, ascending. Parallel edges are one: a robot is as near on each of them."""


class Occupied:
    """The vertices that have robots.

    Attributes:
        robots: number of robots at each vertex that has any.
        depths: edges of the spanning tree from the root to each vertex; -1 where it does not lead.
    """

    __slots__ = ("_below", "_far", "_is_tree", "_links", "_parents", "depths", "robots")

    def __init__(self, graph: PortGraph, root: int, *, deep: bool = False) -> None:
        """Begin without robots.

        Args:
            graph: where they go.
            root: where they all start.
            deep: whether the spanning tree is searched depth first, not breadth first.
        """
        self.robots: dict[int, int] = {}
        self._far = graph.far
        self._is_tree = graph.is_tree()
        self._parents, self.depths = _spanning_tree(graph, root, deep=deep)
        self._links = 0  # edges of the spanning tree with robots at both ends
        self._below = [0] * len(self._parents)  # children there that have robots

    def add(self, vertex: int) -> None:
        """Count one robot more."""
        count = self.robots.get(vertex, 0)
        self.robots[vertex] = count + 1
        if not count:
            self._turn(vertex, 1)

    def remove(self, vertex: int) -> None:
        """Count one robot less."""
        count = self.robots[vertex]
        if count > 1:
            self.robots[vertex] = count - 1
        else:
            del self.robots[vertex]
            self._turn(vertex, -1)

    def _turn(self, vertex: int, by: int) -> None:
        parent = self._parents[vertex]
        self._links += by * self._below[vertex]
        if parent != NOWHERE:
            self._below[parent] += by
            if parent in self.robots:
                self._links += by

    def connected(self) -> bool:
        """Tell whether all robots are connected; so they are if there is none."""
        if len(self.robots) - self._links <= 1:
            return True
        return not self._is_tree and len(self.topmost_part()) == len(self.robots)

    def topmost_part(self) -> set[int]:
        """Return the vertices that are connected to the highest one that has robots."""
        top = min(self.robots, key=lambda vertex: (self.depths[vertex], vertex))
        found, ahead = {top}, [top]
        while ahead:
            for far in self._far[ahead.pop()]:
                if far in self.robots and far not in found:
                    found.add(far)
                    ahead.append(far)
        return found

    def span(self) -> tuple[int, int]:
        """Return the depths of the highest robot and of the lowest one; there is one at least."""
        depths = [self.depths[vertex] for vertex in self.robots]
        return min(depths), max(depths)


def _spanning_tree(graph: PortGraph, root: int, *, deep: bool) -> tuple[list[int], list[int]]:
    """Return parents and depths of the tree that a search finds in the order of ports."""
    parents, depths = [NOWHERE] * len(graph.far), [-1] * len(graph.far)
    depths[root] = 0
    ahead = deque([(root, iter(graph.far[root]))])
    while ahead:
        vertex, ways = ahead[-1] if deep else ahead[0]
        far = next((far for far in ways if depths[far] < 0), NOWHERE)
        if far == NOWHERE:
            ahead.pop() if deep else ahead.popleft()
        else:
            parents[far], depths[far] = vertex, depths[vertex] + 1
            ahead.append((far, iter(graph.far[far])))
    return parents, depths


class Contact:
    """Who has left whom behind: edges with robots on them, and whether somebody stands at an end.

    Attributes:
        standing: number of robots that stand at each vertex where any does.
        on_edge: number of robots on each edge, by its ends, where there are any.
    """

    __slots__ = ("_doubtful", "_edges_at", "on_edge", "standing")

    def __init__(self) -> None:
        self.standing: dict[int, int] = {}
        self.on_edge: dict[Pair, int] = {}
        self._edges_at: dict[int, set[Pair]] = {}  # those of `on_edge`
        self._doubtful: set[int] = set()  # vertices that somebody left since they were looked at

    def stand(self, vertex: int) -> None:
        """Let one robot more stand at a vertex."""
        self.standing[vertex] = self.standing.get(vertex, 0) + 1

    def leave(self, vertex: int) -> None:
        """Let one robot less stand at a vertex."""
        self.standing[vertex] -= 1
        if not self.standing[vertex]:
            del self.standing[vertex]
        self._doubtful.add(vertex)

    def set_out(self, ends: Pair) -> None:
        """Let one robot more be on an edge."""
        self.on_edge[ends] = self.on_edge.get(ends, 0) + 1
        for end in ends:
            self._edges_at.setdefault(end, set()).add(ends)

    def arrive(self, ends: Pair) -> None:
        """Let one robot less be on an edge."""
        self.on_edge[ends] -= 1
        if not self.on_edge[ends]:
            del self.on_edge[ends]
            for end in ends:
                self._edges_at[end].discard(ends)

    def forsaken(self, living: int) -> Pair | None:
        """Return an edge whose robots have nobody at its ends, while not all robots are on it.

        Only what changed since the last call is looked at: an edge is forsaken when somebody leaves.
        """
        found = next((edge for edge in self._doubtful_edges() if self.on_edge[edge] < living), None)
        self._doubtful.clear()
        return found

    def _doubtful_edges(self) -> Iterator[Pair]:
        for vertex in sorted(self._doubtful):
            if vertex not in self.standing:
                for edge in sorted(self._edges_at.get(vertex, ())):
                    if edge[0] not in self.standing and edge[1] not in self.standing:
                        yield edge
