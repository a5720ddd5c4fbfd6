"""What `canopy map` says of a graph or of a grid."""

from collections.abc import Iterator
from math import inf
from pathlib import Path

import numpy as np
import numpy.typing as npt
from msgspec import Struct
from msgspec.structs import replace

from agents.planning.vertices import Reach, counts_in_sight
from protocol.errors import InputError
from protocol.graph import PortGraph
from protocol.grid import Grid
from world_server.maps import GridFile


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


class GridFacts(Struct, frozen=True):
    """A grid in numbers.

    Attributes:
        file: where it stands.
        kind: ``"grid"``.
        format: of the file: ``movingai``, ``ros``, ``image`` or ``text``.
        rows, cols: sub-cells.
        resolution_m: side of a pixel or character of the file, metres.
        cell_m: side of a sub-cell, metres.
        width_m, height_m: what the sub-cells span.
        free, blocked: sub-cells.
        components: connected components of the free sub-cells, by their sides.
        largest: sub-cells in the largest of them.
        complete: coarse cells without a blocked sub-cell.
        partial: coarse cells with free and blocked sub-cells.
        coarse_components: connected components of the complete coarse cells, by their sides.
        coarse_largest: coarse cells in the largest of them.
        notes: what the user should know of how the file was taken.
        los_m: how far one looks, where that was asked for: what is that far is out of sight.
        vertices: free sub-cells as vertices of a parent and its children (their P).
        los_max, los_sum: vertices in line of sight of a vertex, itself included: the most, and of all
            together.
    """

    file: str
    kind: str
    format: str
    rows: int
    cols: int
    resolution_m: float
    cell_m: float
    width_m: float
    height_m: float
    free: int
    blocked: int
    components: int
    largest: int
    complete: int
    partial: int
    coarse_components: int
    coarse_largest: int
    notes: tuple[str, ...]
    los_m: float | None = None
    vertices: int | None = None
    los_max: int | None = None
    los_sum: int | None = None


def facts_of(
    file: Path, found: PortGraph | GridFile, los_m: float | None = None
) -> MapFacts | GridFacts:
    """Measure a graph or a grid.

    Args:
        file: where it stands.
        found: what was read from it.
        los_m: how far to look on a grid, metres; ``None``: do not ask who sees whom.

    Raises:
        InputError: If one cannot look that far, or on a graph.
    """
    if isinstance(found, GridFile):
        facts = _grid_facts(file, found)
        return facts if los_m is None else replace(facts, **_sight_facts(found.grid, los_m))
    if los_m is not None:
        raise InputError(f"--los {los_m:g}: {file} is a graph, expected a grid")
    return _graph_facts(file, found)


def _graph_facts(file: Path, graph: PortGraph) -> MapFacts:
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


def _grid_facts(file: Path, found: GridFile) -> GridFacts:
    grid = found.grid
    rows, cols = grid.rows, grid.cols
    free = np.frombuffer(grid.cells(), np.uint8).reshape(rows, cols) == 0
    aligned = free[: rows // 2 * 2, : cols // 2 * 2]
    quarters = aligned.reshape(rows // 2, 2, cols // 2, 2).sum(axis=(1, 3))
    areas, coarse_areas = _areas(free), _areas(quarters == 4)
    return GridFacts(
        str(file),
        "grid",
        found.kind,
        rows,
        cols,
        found.resolution_m,
        grid.cell_m,
        cols * grid.cell_m,
        rows * grid.cell_m,
        sum(areas),
        rows * cols - sum(areas),
        len(areas),
        max(areas),
        sum(coarse_areas),
        int(np.count_nonzero((quarters > 0) & (quarters < 4))),
        len(coarse_areas),
        max(coarse_areas, default=0),
        found.notes,
    )


def _sight_facts(grid: Grid, los_m: float) -> dict[str, float]:
    """Return the fields that say who sees whom."""
    if not grid.cell_m < los_m < inf:
        raise InputError(
            f"--los {los_m:g}: expected a length above {grid.cell_m:g}, the side of a sub-cell"
        )
    counts = counts_in_sight(grid, Reach.of_lengths(los_m, grid.cell_m).limit)
    return {
        "los_m": los_m,
        "vertices": int(np.count_nonzero(counts)),
        "los_max": int(counts.max()),
        "los_sum": int(counts.sum()),
    }


def _areas(free: npt.NDArray[np.bool_]) -> list[int]:
    """Count the cells of each connected component, joined by sides.

    Runs of free cells are joined with those that they touch in the row below: there are fewer runs
    than cells, and numpy finds them and what they touch.
    """
    rows, cols = free.shape
    stride = cols + 1
    line = np.zeros(rows * stride + 1, np.int8)
    line[1:].reshape(rows, stride)[:, :cols] = free  # blocked columns part the rows
    change = np.diff(line)
    starts, ends = np.flatnonzero(change > 0), np.flatnonzero(change < 0)
    first = np.searchsorted(ends, starts + stride, side="right")
    behind = np.searchsorted(starts, ends + stride, side="left")
    root = list(range(len(starts)))

    def find(run: int) -> int:
        while root[run] != run:
            root[run] = root[root[run]]
            run = root[run]
        return run

    for run, (low, high) in enumerate(zip(first.tolist(), behind.tolist(), strict=True)):
        for below in range(low, high):
            root[find(below)] = find(run)
    areas = [0] * len(starts)
    for run, cells in enumerate((ends - starts).tolist()):
        areas[find(run)] += cells
    return [cells for cells in areas if cells]


def describe(facts: MapFacts | GridFacts) -> Iterator[str]:
    """Say the facts in lines for people."""
    yield from _describe_grid(facts) if isinstance(facts, GridFacts) else _describe_graph(facts)


def _describe_graph(facts: MapFacts) -> Iterator[str]:
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


def _describe_grid(facts: GridFacts) -> Iterator[str]:
    yield (
        f"{facts.file}: grid ({facts.format}), {facts.rows} rows x {facts.cols} columns of "
        f"sub-cells, {facts.width_m:g} m wide, {facts.height_m:g} m high"
    )
    yield f"  sub-cells of {facts.cell_m:g} m, from a resolution of {facts.resolution_m:g} m"
    yield (
        f"  {facts.free} free sub-cells in {_parts(facts.components)}, the largest of "
        f"{facts.largest}; {facts.blocked} blocked"
    )
    yield (
        f"  {facts.complete} complete coarse cells in {_parts(facts.coarse_components)}, the "
        f"largest of {facts.coarse_largest}; {facts.partial} partial"
        if facts.complete
        else f"  no complete coarse cells; {facts.partial} partial"
    )
    if facts.los_m is not None:
        yield (
            f"  line of sight below {facts.los_m:g} m: {facts.vertices} vertices, one sees "
            f"{facts.los_max} at most, all together {facts.los_sum}, each itself among them"
        )
    for note in facts.notes:
        yield f"  note: {note}"


def _parts(components: int) -> str:
    return "1 component" if components == 1 else f"{components} components"
