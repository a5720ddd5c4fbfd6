"""Where to draw the vertices of a graph that has no positions, or only topology.

Small graphs are laid out by stress majorization: the distance of two vertices on paper is brought
near their distance in hops, with weights that make close pairs count most. Bushy trees are drawn
on rings around vertex 0, where every subtree keeps a sector of its own. Large graphs get the same
stress, but only between neighbours and between each vertex and a few pivots, so that time and
memory stay linear. All of it is deterministic.

Paper:
    Gansner, Koren, North 2004 (stress majorization); Brandes, Pich 2006 (pivot MDS). Departure:
    the sparse stress counts each pivot as itself, not for the region around it.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from protocol.graph import PortGraph

Array = NDArray[np.float64]
Position = tuple[float, float]

DENSE_MOST = 1500
"""Vertices up to which all pairs are compared."""
PIVOTS = 60
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
LONG = 4.0
"""Hops across, by the root of the number of vertices, from which on a graph is drawn winding."""
WINDING = 0.8
"""Power of the hops that a winding drawing aims at: 1 would pull long passages straight, and leave
most of the page empty and the stations too small to see."""
CROWDED = 120
"""Leaves on the outermost ring from which on every other one is moved out."""
STAGGER = 0.2
LANDSCAPE = 1.4
"""Width by height that the components of a graph are packed into."""


def layout(graph: PortGraph) -> list[Position]:
    """Return a position for each vertex: the graph's own, or a computed one in units of hops.

    Args:
        graph: Any graph; its components are laid out side by side.

    Returns:
        ``(x, y)`` of each vertex, y upwards.
    """
    if graph.positions is not None:
        return list(graph.positions)
    placed = np.zeros((len(graph.names), 2))
    parts = [(members, _component(graph, members)) for members in _components(graph)]
    for (members, points), corner in zip(
        parts, _pack([points for _, points in parts]), strict=True
    ):
        placed[members] = points - points.min(axis=0) + corner
    return [(float(x), float(y)) for x, y in placed]


def _components(graph: PortGraph) -> list[list[int]]:
    """Return the vertices of each component, the largest component first."""
    seen: set[int] = set()
    components: list[list[int]] = []
    for vertex in range(len(graph.names)):
        if vertex not in seen:
            # Not PortGraph.distances: that takes linear time for each of many small components.
            members = [vertex]
            seen.add(vertex)
            for member in members:
                for neighbour in graph.far[member]:
                    if neighbour not in seen:
                        seen.add(neighbour)
                        members.append(neighbour)
            components.append(sorted(members))
    return sorted(components, key=len, reverse=True)


def _pack(parts: Sequence[Array]) -> list[Array]:
    """Return the lower left corner of each part, in rows of about equal width, top row first."""
    margin = 1.0
    sizes = [points.max(axis=0) - points.min(axis=0) + margin for points in parts]
    area = sum(float(width * height) for width, height in sizes)
    row_width = max([math.sqrt(LANDSCAPE * area), *(float(width) for width, _ in sizes)])
    corners: list[Array] = []
    x = top = depth = 0.0
    for width, height in sizes:
        if x > 0 and x + width > row_width + 1e-9:
            x, top, depth = 0.0, top - depth, 0.0
        corners.append(np.array([x, top - height]))
        x += float(width)
        depth = max(depth, float(height))
    return corners


def _component(graph: PortGraph, members: Sequence[int]) -> Array:
    """Lay out one component."""
    if len(members) == 1:
        return np.zeros((1, 2))
    number = {vertex: index for index, vertex in enumerate(members)}
    adjacent = [
        sorted({number[v] for v in graph.far[vertex]} - {number[vertex]}) for vertex in members
    ]
    depth = _hops(adjacent, 0)
    edges = sum(map(len, adjacent)) // 2
    is_tree = edges == len(adjacent) - 1
    # Rings suit trees that branch everywhere; others leave half of the page empty.
    is_bushy = max(depth) <= math.log2(len(adjacent))
    if is_tree and (is_bushy or len(adjacent) > DENSE_MOST):
        return _rings(adjacent, depth)
    points = _pivot_mds(adjacent)
    points = _stress(adjacent, points) if len(adjacent) <= DENSE_MOST else _sparse(adjacent, points)
    return _level(points)


def _hops(adjacent: Sequence[Sequence[int]], start: int) -> list[int]:
    """Return the distance in hops of every vertex of a connected graph from ``start``."""
    distance = [-1] * len(adjacent)
    distance[start] = 0
    order = [start]
    for vertex in order:
        following = distance[vertex] + 1
        for neighbour in adjacent[vertex]:
            if distance[neighbour] < 0:
                distance[neighbour] = following
                order.append(neighbour)
    return distance


def _rings(adjacent: Sequence[Sequence[int]], depth: Sequence[int]) -> Array:
    """Draw a tree around vertex 0: a ring for each depth, to each leaf an equal angle."""
    order = sorted(range(len(adjacent)), key=depth.__getitem__)
    leaves = [0] * len(adjacent)
    for vertex in reversed(order):
        children = [child for child in adjacent[vertex] if depth[child] > depth[vertex]]
        leaves[vertex] = sum(leaves[child] for child in children) or 1
    outermost = max(depth)
    is_crowded = depth.count(outermost) > CROWDED
    first = [0] * len(adjacent)
    points = np.zeros((len(adjacent), 2))
    for vertex in order:
        angle = 2 * math.pi * (first[vertex] + leaves[vertex] / 2) / leaves[0]
        radius: float = depth[vertex]
        if depth[vertex] == outermost and is_crowded:
            radius += STAGGER * (round(first[vertex]) % 2)
        points[vertex] = radius * math.cos(angle), radius * math.sin(angle)
        from_leaf = first[vertex]
        for child in adjacent[vertex]:
            if depth[child] > depth[vertex]:
                first[child] = from_leaf
                from_leaf += leaves[child]
    return points


def _pivots(adjacent: Sequence[Sequence[int]]) -> tuple[list[int], Array]:
    """Choose vertices far from each other; return them and each one's row of distances."""
    pivots = [0]
    rows = [_hops(adjacent, 0)]
    nearest = np.array(rows[0])
    while len(pivots) < min(PIVOTS, len(adjacent)):
        pivots.append(int(nearest.argmax()))
        rows.append(_hops(adjacent, pivots[-1]))
        nearest = np.minimum(nearest, rows[-1])
    return pivots, np.array(rows, dtype=np.float64)


def _pivot_mds(adjacent: Sequence[Sequence[int]]) -> Array:
    """Project hop distances from the pivots to the plane; a little off, so that none coincide."""
    _, rows = _pivots(adjacent)
    squares = rows.T**2
    centred = squares - squares.mean(axis=0) - squares.mean(axis=1, keepdims=True) + squares.mean()
    _, vectors = np.linalg.eigh(centred.T @ centred)
    axes = vectors[:, : -min(3, vectors.shape[1] + 1) : -1]
    points = np.zeros((len(adjacent), 2))
    points[:, : axes.shape[1]] = -0.5 * centred @ axes
    # Scale to hops: the stress below would take many steps to do only that.
    drawn = math.sqrt(float((points**2).sum()) / len(adjacent)) or 1.0
    points *= math.sqrt(float(rows.mean()) ** 2 / 2 + 0.1) / drawn
    angles = GOLDEN_ANGLE * np.arange(len(adjacent))
    return points + 0.15 * np.column_stack([np.cos(angles), np.sin(angles)])


def _stress(adjacent: Sequence[Sequence[int]], points: Array) -> Array:
    """Bring the distances of all pairs near their hops, weights ``hops ** -2``."""
    count = len(adjacent)
    wanted = np.array([_hops(adjacent, vertex) for vertex in range(count)], dtype=np.float64)
    has_sides = max(map(len, adjacent)) > 2
    if has_sides and wanted.max() > LONG * math.sqrt(count):
        wanted **= WINDING
    np.fill_diagonal(wanted, 1.0)
    weights = wanted**-2.0
    np.fill_diagonal(weights, 0.0)
    laplacian = np.diag(weights.sum(axis=1)) - weights
    # Adding a constant makes the Laplacian invertible and does not touch centred points.
    inverse = np.linalg.inv(laplacian + 1.0 / count)
    pull = weights * wanted
    last = math.inf
    for _ in range(400):
        squares = (points**2).sum(axis=1)
        drawn = squares[:, None] + squares[None, :] - 2 * points @ points.T
        drawn = np.sqrt(np.maximum(drawn, 1e-12))
        stress = float((weights * (drawn - wanted) ** 2).sum())
        if last - stress < 2e-5 * last:
            break
        last = stress
        ratio = pull / drawn
        points = inverse @ (ratio.sum(axis=1, keepdims=True) * points - ratio @ points)
    return points


def _sparse(adjacent: Sequence[Sequence[int]], points: Array) -> Array:
    """As `_stress`, but only between neighbours and between each vertex and the pivots."""
    pivots, rows = _pivots(adjacent)
    tails = np.repeat(np.arange(len(adjacent)), [len(row) for row in adjacent])
    heads = np.array([head for row in adjacent for head in row])
    degree = np.bincount(tails, minlength=len(adjacent)).astype(np.float64)
    safe = np.maximum(rows.T, 1.0)
    weights = np.where(rows.T > 0, safe**-2.0, 0.0)
    total = weights.sum(axis=1) + degree
    for _ in range(60):
        offset = points[:, None, :] - points[pivots][None, :, :]
        drawn = np.sqrt((offset**2).sum(axis=2) + 1e-9)
        target = points[pivots][None, :, :] + offset * (safe / drawn)[:, :, None]
        aim = (weights[:, :, None] * target).sum(axis=1)
        along = points[tails] - points[heads]
        wanted = points[heads] + along / np.sqrt((along**2).sum(axis=1) + 1e-9)[:, None]
        for axis in (0, 1):
            aim[:, axis] += np.bincount(tails, wanted[:, axis], minlength=len(adjacent))
        # Half a step: all vertices move at once, and full steps would swing to and fro.
        points = 0.5 * points + 0.5 * aim / total[:, None]
    return points


def _level(points: Array) -> Array:
    """Turn the longer extent of a drawing to the horizontal, with vertex 0 on the left."""
    centred = points - points.mean(axis=0)
    _, vectors = np.linalg.eigh(centred.T @ centred)
    turned: Array = centred @ vectors[:, ::-1]
    signs = np.where(turned[0] > 0, -1.0, 1.0)
    turned *= signs
    return turned
