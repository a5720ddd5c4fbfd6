"""The port graph: what a place with opaque passages is made of.

A vertex has ports 0..degree-1, numbered by incident edge in file order. Parallel edges are edges of
their own; a self-loop takes two ports of its vertex. A robot knows a vertex by its number and an
exit by its port; where a port leads it learns only by going.
"""

from collections.abc import Iterable, Sequence


class PortGraph:
    """An undirected multigraph whose edge ends are numbered locally.

    Attributes:
        names: name of each vertex, as in its file.
        ends: the two vertices of each edge, in file order.
        lengths: length of each edge; ``None`` where the file gives none.
        far: ``far[vertex][port]`` is the vertex behind that port.
        back: ``back[vertex][port]`` is the port by which one arrives there.
        ways: ``ways[vertex][port]`` is both.
        edge_at: ``edge_at[vertex][port]`` is the number of the edge.
        positions: ``(x, y)`` of each vertex for pictures, or ``None``.
    """

    __slots__ = ("back", "edge_at", "ends", "far", "lengths", "names", "positions", "ways")

    def __init__(
        self,
        names: Sequence[str],
        ends: Iterable[tuple[int, int]],
        lengths: Iterable[float | None] | None = None,
        positions: Sequence[tuple[float, float]] | None = None,
    ) -> None:
        self.names = tuple(names)
        self.ends = tuple(ends)
        self.lengths = (None,) * len(self.ends) if lengths is None else tuple(lengths)
        self.positions = None if positions is None else tuple(positions)
        if len(self.lengths) != len(self.ends):
            raise ValueError(f"{len(self.ends)} edges but {len(self.lengths)} lengths")
        far: list[list[int]] = [[] for _ in self.names]
        back: list[list[int]] = [[] for _ in self.names]
        edge_at: list[list[int]] = [[] for _ in self.names]
        for edge, (u, v) in enumerate(self.ends):
            port_u = len(far[u])
            port_v = len(far[v]) + (u == v)
            far[u].append(v)
            far[v].append(u)
            back[u].append(port_v)
            back[v].append(port_u)
            edge_at[u].append(edge)
            edge_at[v].append(edge)
        self.far = tuple(map(tuple, far))
        self.back = tuple(map(tuple, back))
        self.ways = tuple(map(tuple, map(zip, far, back)))
        self.edge_at = tuple(map(tuple, edge_at))

    def degree(self, vertex: int) -> int:
        """Return the number of ports of ``vertex``."""
        return len(self.far[vertex])

    def vertex(self, name: str) -> int:
        """Return the number of the vertex called ``name``.

        Raises:
            KeyError: If no vertex has that name.
        """
        try:
            return self.names.index(name)
        except ValueError:
            raise KeyError(name) from None

    def distances(self, start: int) -> list[int]:
        """Return the hop distance of each vertex from ``start``; -1 where it cannot be reached."""
        distance = [-1] * len(self.names)
        distance[start] = 0
        level = [start]
        while level:
            following: list[int] = []
            for vertex in level:
                for neighbour in self.far[vertex]:
                    if distance[neighbour] < 0:
                        distance[neighbour] = distance[vertex] + 1
                        following.append(neighbour)
            level = following
        return distance

    def component(self, start: int) -> "PortGraph":
        """Return the connected component of ``start``, vertices and edges in their old order."""
        distance = self.distances(start)
        kept = [vertex for vertex, hops in enumerate(distance) if hops >= 0]
        if len(kept) == len(self.names):
            return self
        number = {vertex: index for index, vertex in enumerate(kept)}
        edges = [edge for edge, (u, _) in enumerate(self.ends) if u in number]
        return PortGraph(
            [self.names[vertex] for vertex in kept],
            [(number[self.ends[edge][0]], number[self.ends[edge][1]]) for edge in edges],
            [self.lengths[edge] for edge in edges],
            None if self.positions is None else [self.positions[vertex] for vertex in kept],
        )

    def is_tree(self) -> bool:
        """Tell whether the graph is connected and has no cycle."""
        return len(self.ends) == len(self.names) - 1 and -1 not in self.distances(0)
