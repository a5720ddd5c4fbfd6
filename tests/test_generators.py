"""Generated graphs: counts, connectedness, numbering, and the same graph from the same seed."""

import math
from collections import Counter
from collections.abc import Callable
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.graph import PortGraph
from world_server.maps import generators

SEEDS = st.integers(0, 2**32)


def content(graph: PortGraph) -> tuple[object, ...]:
    return graph.names, graph.ends, graph.lengths, graph.positions


def assert_tree_from_root(graph: PortGraph, edges: int) -> None:
    """Port 0 of each vertex but the root leads to a parent with a smaller number."""
    assert len(graph.ends) == edges
    assert graph.is_tree()
    assert all(u < v and v == child for child, (u, v) in enumerate(graph.ends, start=1))
    assert all(graph.far[v][0] < v for v in range(1, edges + 1))


def assert_simple_and_connected(graph: PortGraph, vertices: int, edges: int) -> None:
    assert (len(graph.names), len(graph.ends)) == (vertices, edges)
    assert len({frozenset(pair) for pair in graph.ends}) == edges
    assert all(u != v for u, v in graph.ends)
    assert -1 not in graph.distances(0)


# Trees -------------------------------------------------------------------------------------------


@given(st.integers(1, 7), st.integers(0, 3))
def test_nary_tree(branching: int, radius: int) -> None:
    graph = generators.nary_tree(branching, radius)
    assert_tree_from_root(graph, sum(branching**level for level in range(1, radius + 1)))
    depth = graph.distances(0)
    assert depth == sorted(depth)
    for vertex in range(len(graph.names)):
        children = graph.far[vertex][min(vertex, 1) :]
        first = branching * vertex + 1
        assert children == (
            tuple(range(first, first + branching)) if depth[vertex] < radius else ()
        )


def test_the_large_tree_of_the_paper() -> None:
    assert len(generators.nary_tree(7, 5).ends) == 19607


def test_hash_tree() -> None:
    graph = generators.hash_tree(1000)
    assert_tree_from_root(graph, 1000)
    assert [u for u, _ in graph.ends[:6]] == [2654435761 * v % 2**32 % v for v in range(1, 7)]
    assert generators.hash_tree(0).names == ("0",)


@given(st.integers(1, 60), SEEDS)
def test_random_tree_is_numbered_breadth_first(vertices: int, seed: int) -> None:
    graph = generators.random_tree(vertices, Random(seed))
    assert_tree_from_root(graph, vertices - 1)
    depth = graph.distances(0)
    assert depth == sorted(depth)


def test_random_tree_is_uniform() -> None:
    # Of the 16 labelled trees on 4 vertices 4 are stars. From vertex 0 there are four shapes: a
    # star from its centre (1 of 16) or a leaf (3), a path from an end (6) or from inside (6).
    rng = Random(1)
    seen = Counter(generators.random_tree(4, rng).ends for _ in range(4800))
    shapes: Counter[tuple[int, ...]] = Counter()
    for ends, count in seen.items():
        graph = PortGraph("abcd", ends)
        shapes[*sorted(graph.distances(0)), max(map(graph.degree, range(4)))] += count
    expected = {(0, 1, 1, 1, 3): 300, (0, 1, 2, 2, 3): 900, (0, 1, 2, 3, 2): 1800}
    expected[0, 1, 1, 2, 2] = 1800
    assert set(shapes) == set(expected)
    for shape, count in expected.items():
        assert abs(shapes[shape] - count) < 5 * math.sqrt(count)


@given(st.integers(0, 80), SEEDS)
def test_wide_and_long_trees(edges: int, seed: int) -> None:
    assert_tree_from_root(generators.wide_tree(edges, Random(seed)), edges)
    graph = generators.long_tree(edges, Random(seed))
    assert_tree_from_root(graph, edges)
    assert max(map(graph.degree, range(edges + 1))) <= 5
    inner = [v for v in range(edges + 1) if graph.degree(v) > (v > 0)]
    assert len({graph.distances(0)[v] for v in inner}) == len(inner)


def test_wide_is_wide_and_long_is_long() -> None:
    assert max(generators.wide_tree(1000, Random(1)).distances(0)) < 30
    assert 350 < max(generators.long_tree(1000, Random(1)).distances(0)) < 450


# Graphs ------------------------------------------------------------------------------------------


@given(st.integers(1, 25), st.floats(0, 1), SEEDS)
def test_random_graph(vertices: int, share: float, seed: int) -> None:
    most = vertices * (vertices - 1) // 2
    edges = vertices - 1 + round(share * (most - vertices + 1))
    graph = generators.random_graph(vertices, edges, Random(seed))
    assert_simple_and_connected(graph, vertices, edges)


def test_extra_edges_are_uniform() -> None:
    rng = Random(1)
    seen: Counter[tuple[int, int]] = Counter()
    for _ in range(3000):
        tree, extra = (g.ends for g in [generators.random_graph(4, 4, rng)] for g in (g, g))
        assert tree[:3] == extra[:3]
        seen[extra[3]] += 1
    # Pair (u, v), u < v, is free with probability 1 - 1/v, and then one of three free pairs.
    for (_, v), count in seen.items():
        expected = 3000 * (1 - 1 / v) / 3
        assert abs(count - expected) < 5 * math.sqrt(expected)
    assert sum(seen.values()) == 3000


@given(st.integers(1, 8), st.integers(1, 8))
def test_grid(rows: int, columns: int) -> None:
    graph = generators.grid(rows, columns)
    across = rows * (columns - 1)
    assert_simple_and_connected(graph, rows * columns, across + (rows - 1) * columns)
    assert all(v == u + 1 and u % columns < columns - 1 for u, v in graph.ends[:across])
    assert all(v == u + columns for u, v in graph.ends[across:])
    assert list(graph.ends[:across]) == sorted(graph.ends[:across])
    assert list(graph.ends[across:]) == sorted(graph.ends[across:])
    assert graph.positions is not None
    assert all(math.dist(graph.positions[u], graph.positions[v]) == 1 for u, v in graph.ends)


def test_small_named_graphs() -> None:
    assert generators.complete(4).ends == ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
    assert generators.cycle(3).ends == ((0, 1), (1, 2), (2, 0))
    assert generators.cycle(2).ends == ((0, 1), (1, 0))
    assert generators.cycle(1).far == ((0, 0),)
    assert generators.star(3).ends == ((0, 1), (0, 2), (0, 3))
    assert generators.path(3).ends == ((0, 1), (1, 2))
    for make in (generators.complete, generators.path):
        assert (make(1).names, make(1).ends) == (("0",), ())


@given(st.integers(1, 120), st.floats(0, 1), SEEDS)
def test_cave(vertices: int, share: float, seed: int) -> None:
    loops = round(share * (vertices // 6))
    graph = generators.cave(vertices, loops, Random(seed))
    assert_simple_and_connected(graph, vertices, vertices - 1 + loops)
    assert graph.positions is not None
    assert len(set(graph.positions)) == vertices
    for (u, v), length in zip(graph.ends, graph.lengths, strict=True):
        assert length == round(math.dist(graph.positions[u], graph.positions[v]), 2) > 0


def test_a_cave_looks_like_one() -> None:
    for seed in range(5):
        graph = generators.cave(180, 12, Random(seed))
        degrees = Counter(map(graph.degree, range(180)))
        assert max(graph.distances(0)) >= 25
        assert degrees[2] > 90
        assert degrees[1] >= 5
        assert max(degrees) >= 4
        tree, loops = graph.ends[:179], graph.ends[179:]
        assert crossings(graph, tree + loops) == 0
        bare = PortGraph(graph.names, tree)
        assert all(bare.distances(u)[v] >= 3 for u, v in loops)


def crossings(graph: PortGraph, ends: tuple[tuple[int, int], ...]) -> int:
    """Count the crossings of straight edges that share no vertex."""
    assert graph.positions is not None
    at = graph.positions

    def side(a: int, b: int, c: int) -> float:
        (ax, ay), (bx, by), (cx, cy) = at[a], at[b], at[c]
        return (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)

    return sum(
        side(a, b, c) * side(a, b, d) < 0 and side(c, d, a) * side(c, d, b) < 0
        for i, (a, b) in enumerate(ends)
        for c, d in ends[:i]
        if len({a, b, c, d}) == 4
    )


# Seeds and arguments -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "make",
    [
        lambda rng: generators.random_tree(50, rng),
        lambda rng: generators.wide_tree(50, rng),
        lambda rng: generators.long_tree(50, rng),
        lambda rng: generators.random_graph(30, 50, rng),
        lambda rng: generators.cave(60, 5, rng),
    ],
)
def test_the_seed_decides(make: Callable[[Random], PortGraph]) -> None:
    assert content(make(Random(7))) == content(make(Random(7)))
    assert content(make(Random(7))) != content(make(Random(8)))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: generators.nary_tree(0, 2), "branching: found 0, expected at least 1"),
        (lambda: generators.nary_tree(2, -1), "radius: found -1, expected at least 0"),
        (lambda: generators.hash_tree(-1), "edges: found -1, expected at least 0"),
        (lambda: generators.random_tree(0, Random(0)), "vertices: found 0, expected at least 1"),
        (lambda: generators.wide_tree(-1, Random(0)), "edges: found -1, expected at least 0"),
        (lambda: generators.long_tree(-1, Random(0)), "edges: found -1, expected at least 0"),
        (
            lambda: generators.random_graph(5, 3, Random(0)),
            "edges: found 3, expected 4 to 10 for 5 vertices",
        ),
        (
            lambda: generators.random_graph(5, 11, Random(0)),
            "edges: found 11, expected 4 to 10 for 5 vertices",
        ),
        (lambda: generators.cave(0, 0, Random(0)), "vertices: found 0, expected at least 1"),
        (
            lambda: generators.cave(12, 3, Random(0)),
            "loops: found 3, expected 0 to 2 for 12 vertices",
        ),
        (lambda: generators.grid(0, 2), "rows: found 0, expected at least 1"),
        (lambda: generators.grid(2, 0), "columns: found 0, expected at least 1"),
        (lambda: generators.complete(0), "vertices: found 0, expected at least 1"),
        (lambda: generators.cycle(0), "vertices: found 0, expected at least 1"),
        (lambda: generators.star(-1), "leaves: found -1, expected at least 0"),
        (lambda: generators.path(0), "vertices: found 0, expected at least 1"),
    ],
)
def test_arguments_out_of_range(call: Callable[[], PortGraph], message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}$"):
        call()
