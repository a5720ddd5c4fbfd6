"""What `canopy map` says of a graph."""

from collections.abc import Iterator
from pathlib import Path

from msgspec import Struct

from protocol.graph import PortGraph


class MapFacts(Struct, frozen=True):
    """A map in numbers.

    Attributes:
        file: where it stands.
        kind: ``"graph"``.
        vertices, edges: how many there are.
        start: name of the default start.
        degree_max: largest degree.
        leaves: vertices of degree 1.
        components: number of components, and the size of that of the start.
        reached: vertices in the component of the start.
        reached_edges: edges in it.
        radius: hops from the start to the farthest vertex in it (the papers' r).
        cycle_rank: edges beyond a spanning forest; 0 for a tree.
        length: sum of the known lengths; ``None`` if there are none.
    """

    file: str
    kind: str
    vertices: int
    edges: int
    start: str
    degree_max: int
    leaves: int
    components: int
    reached: int
    reached_edges: int
    radius: int
    cycle_rank: int
    length: float | None


def facts_of(file: Path, graph: PortGraph) -> MapFacts:
    """Measure a graph."""
    vertices, edges = len(graph.names), len(graph.ends)
    hops = graph.distances(0)
    components = _components(graph)
    known = [length for length in graph.lengths if length is not None]
    degrees = [graph.degree(vertex) for vertex in range(vertices)]
    return MapFacts(
        str(file),
        "graph",
        vertices,
        edges,
        graph.names[0],
        max(degrees),
        degrees.count(1),
        components,
        sum(distance >= 0 for distance in hops),
        sum(hops[u] >= 0 for u, _ in graph.ends),
        max(hops),
        edges - vertices + components,
        sum(known) if known else None,
    )


def _components(graph: PortGraph) -> int:
    seen = [False] * len(graph.names)
    count = 0
    for vertex in range(len(graph.names)):
        if not seen[vertex]:
            count += 1
            seen[vertex] = True
            stack = [vertex]
            while stack:
                for neighbour in graph.far[stack.pop()]:
                    if not seen[neighbour]:
                        seen[neighbour] = True
                        stack.append(neighbour)
    return count


def describe(facts: MapFacts) -> Iterator[str]:
    """Say the facts in lines for people."""
    tree = ", a tree" if facts.cycle_rank == 0 and facts.components == 1 else ""
    yield f"{facts.file}: graph, {facts.vertices} vertices, {facts.edges} edges{tree}"
    yield f"  start {facts.start!r} (the first of the file), radius {facts.radius} hops from there"
    yield f"  largest degree {facts.degree_max}, {facts.leaves} leaves, cycle rank {facts.cycle_rank}"
    if facts.length is not None:
        yield f"  total length {facts.length:g}"
    if facts.components > 1:
        yield (
            f"  {facts.components} components; a run from the start plays its own: "
            f"{facts.reached} vertices, {facts.reached_edges} edges"
        )
