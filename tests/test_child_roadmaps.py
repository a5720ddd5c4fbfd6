"""Roadmaps of children around a parent: all is covered, step by step, evenly."""

from itertools import pairwise
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.planning.child_roadmaps import Roadmaps, child_roadmaps, distances
from protocol.grid import Grid

Drawn = tuple[Grid, set[int], set[int], int]
"""A grid, a zone on it, vertices to cover, and where the parent stands."""


@st.composite
def zones(draw: st.DrawFn) -> Drawn:
    rows, cols = draw(st.integers(1, 12)), draw(st.integers(1, 12))
    rng = Random(draw(st.integers(0, 2**32)))
    density = draw(st.sampled_from((0, 0.1, 0.3)))
    grid = Grid(rows, cols, bytes(rng.random() < density for _ in range(rows * cols)))
    free = {grid.place(*cell) for cell in grid.free_cells()} or {0}
    parent = rng.choice(sorted(free))
    zone = set(distances(free, parent, grid.stride))
    share = draw(st.sampled_from((1, 0.9, 0.5, 0)))
    return grid, zone, {vertex for vertex in zone if rng.random() < share}, parent


def roadmaps(text: str, children: int, parent: tuple[int, int] = (0, 0)) -> Roadmaps:
    """Cover all free cells of a small map."""
    grid = Grid.of_text(text)
    free = {grid.place(*cell) for cell in grid.free_cells()}
    return child_roadmaps(free, free, grid.place(*parent), children, grid.stride)


@given(zones(), st.integers(1, 30))
def test_every_vertex_is_on_a_walk_and_walks_stay_in_the_zone(drawn: Drawn, children: int) -> None:
    grid, zone, vertices, parent = drawn
    found = child_roadmaps(vertices, zone, parent, children, grid.stride)
    assert len(found.walks) <= children
    assert all(found.walks)
    places = [place for walk in found.walks for place in walk]
    assert vertices <= set(places) <= zone
    assert found.redundant == len(places) - len(vertices)
    assert found.steps == max([len(walk) - 1 for walk in found.walks], default=0)
    for walk in found.walks:
        assert all(abs(one - other) in (1, grid.stride) for one, other in pairwise(walk))


@given(zones(), st.integers(1, 30))
def test_walks_begin_and_end_with_vertices_that_nobody_else_covers(
    drawn: Drawn, children: int
) -> None:
    grid, zone, vertices, parent = drawn
    walks = child_roadmaps(vertices, zone, parent, children, grid.stride).walks
    places = [place for walk in walks for place in walk]
    for walk in walks:
        assert places.count(walk[-1]) == 1
        assert places.count(walk[0]) == 1
        assert {walk[0], walk[-1]} <= vertices


@given(st.integers(1, 10), st.integers(1, 10), st.integers(1, 30))
def test_coarse_cells_alone_cost_no_redundant_step_and_are_shared_evenly(
    rows: int, cols: int, children: int
) -> None:
    text = "\n".join(["." * 2 * cols] * 2 * rows)
    found = roadmaps(text, children)
    assert found.redundant == 0
    if children == 1:
        assert found.steps == 4 * rows * cols - 1


def test_even_parts_where_no_start_is_far() -> None:
    # 8 x 8 vertices: 64, and 4 children.
    text = "\n".join(["." * 8] * 8)
    found = roadmaps(text, 4, (3, 3))
    assert len(found.walks) == 4
    assert found.steps <= 18


def test_pairs_beyond_the_coarse_grid_are_branched_out_to_and_single_vertices_cost_a_step() -> None:
    """Reference: Sec. 3.4, Fig. 2."""
    # The walk ends where the pair does: nothing is visited twice, here or beside the coarse cell.
    assert roadmaps("..\n..\n..", 1) == Roadmaps([[1, 0, 3, 6, 7, 4]], 0)
    # Two spurs above the way around three coarse cells: it can end on one, but not on both.
    text = "##.#.#\n##.#.#\n......\n......"
    assert roadmaps(text, 1, (2, 0)).redundant == 2


@pytest.mark.parametrize("children", [1, 2, 3])
def test_pieces_apart_are_reached_over_covered_vertices(children: int) -> None:
    grid = Grid(2, 9, bytes(18))
    zone = {grid.place(*cell) for cell in grid.free_cells()}
    vertices = {place for place in zone if place % grid.stride not in {3, 4, 5}}
    found = child_roadmaps(vertices, zone, grid.place(0, 4), children, grid.stride)
    assert vertices <= {place for walk in found.walks for place in walk}
    # Between the pieces are three columns. One child crosses them once; two need not.
    assert found.redundant == (3 if children == 1 else 0)


def test_nothing_to_cover() -> None:
    assert child_roadmaps(set(), {0}, 0, 3, 2) == Roadmaps([], 0)
    assert Roadmaps([], 0).steps == 0
