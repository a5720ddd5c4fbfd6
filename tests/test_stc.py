"""The geometry of spanning tree coverage: corners, and the way around a tree."""

import networkx as nx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.algorithms.stc import (
    AWAY,
    BEFORE,
    BEHIND,
    OPPOSITE,
    SPAN,
    Corner,
    Tree,
    located,
    number,
    row_and_column,
    sub_cell,
)
from protocol.grid import EAST, NORTH, SOUTH, STEPS, WEST, Cell, sub_cells

HOME = number((100, 100))
CORNERS = range(4)


def after(at: Cell, exit_: int) -> Cell:
    return at[0] + STEPS[exit_][0], at[1] + STEPS[exit_][1]


def beside(cell: int, direction: int) -> int:
    return number(after(row_and_column(cell), direction))


# Numbers and corners.


@given(st.tuples(st.integers(0, 10**6), st.integers(0, 10**6)))
def test_each_sub_cell_is_one_corner_of_one_cell(position: Cell) -> None:
    cell, corner = located(position)
    assert row_and_column(cell) == (position[0] // 2, position[1] // 2)
    assert number(row_and_column(cell)) == cell
    assert sub_cell(cell, corner) == position


def test_the_four_corners_are_the_four_sub_cells() -> None:
    corners = [sub_cell(HOME, corner) for corner in CORNERS]
    assert sorted(corners) == sorted(sub_cells((100, 100)))
    assert corners[NORTH] == (200, 201)
    assert corners[EAST] == (201, 201)
    assert corners[SOUTH] == (201, 200)
    assert corners[WEST] == (200, 200)


@pytest.mark.parametrize("corner", CORNERS)
def test_moves_between_corners(corner: int) -> None:
    """As the table of the module has them."""
    at = sub_cell(HOME, corner)
    assert (BEFORE[corner], BEHIND[corner], OPPOSITE[corner]) == tuple(
        (corner + turn) % 4 for turn in (-1, 1, 2)
    )
    assert HOME + AWAY[corner] == beside(HOME, corner)
    assert after(at, BEFORE[corner]) == sub_cell(HOME, BEFORE[corner])
    assert after(at, corner) == sub_cell(beside(HOME, corner), BEHIND[corner])
    assert after(at, OPPOSITE[corner]) == sub_cell(HOME, BEHIND[corner])
    assert after(at, BEHIND[corner]) == sub_cell(beside(HOME, BEHIND[corner]), BEFORE[corner])


def test_no_neighbour_is_taken_for_a_cell_of_another_row() -> None:
    edge = number((3, 0))
    assert row_and_column(edge + AWAY[WEST]) == (2, SPAN - 1)
    assert edge + AWAY[NORTH] == number((2, 0))


# Trees.


@st.composite
def trees(draw: st.DrawFn) -> Tree:
    """Trees of up to 16 cells, as crowded as they come."""
    tree = Tree()
    tree.root(HOME)
    cells = [HOME]
    for _ in range(draw(st.integers(0, 15))):
        cell, direction = draw(st.sampled_from(cells)), draw(st.integers(0, 3))
        if cell + AWAY[direction] not in tree:
            cells.append(tree.join(cell, direction))
    return tree


def corners_of(tree: Tree) -> set[Corner]:
    return {(cell, corner) for cell in tree.edges for corner in CORNERS}


@given(trees(), st.data())
def test_the_way_around_passes_each_sub_cell_once(tree: Tree, data: st.DataObject) -> None:
    start = at = data.draw(st.sampled_from(sorted(corners_of(tree))))
    passed: list[Corner] = []
    while not passed or at != start:
        passed.append(at)
        exit_, *to = tree.ahead(*at)
        assert after(sub_cell(*at), exit_) == sub_cell(*to)
        at = (to[0], to[1])
        assert len(passed) <= 4 * len(tree.edges)
    assert len(passed) == len(set(passed))
    assert set(passed) == corners_of(tree)


@given(trees())
def test_the_tree_lies_on_the_left(tree: Tree) -> None:
    """Whoever crosses a tree edge has it on the left, and comes back on its other side."""
    for cell, corner in corners_of(tree):
        exit_, to, _ = tree.ahead(cell, corner)
        if to != cell:
            assert tree.edges[cell] >> exit_ & 1
            row, col = sub_cell(cell, corner)
            left = after((row, col), BEFORE[exit_])
            assert located(left) == (cell, BEFORE[corner])


@given(trees())
def test_back_leads_where_ahead_came_from(tree: Tree) -> None:
    for at in corners_of(tree):
        exit_, *to = tree.ahead(*at)
        assert tree.back(to[0], to[1]) == (OPPOSITE[exit_], *at)
        exit_, *to = tree.back(*at)
        assert tree.ahead(to[0], to[1]) == (OPPOSITE[exit_], *at)


@given(trees(), st.data())
def test_a_leaf_that_is_cut_off_leaves_no_trace(tree: Tree, data: st.DataObject) -> None:
    free = [
        (cell, direction)
        for cell in tree.edges
        for direction in range(4)
        if cell + AWAY[direction] not in tree
    ]
    cell, direction = data.draw(st.sampled_from(sorted(free)))
    before = dict(tree.edges)
    leaf = tree.join(cell, direction)
    assert leaf in tree
    assert leaf == beside(cell, direction)
    assert tree.edges[leaf] == 1 << OPPOSITE[direction]
    assert tree.cut(cell, direction) == leaf
    assert leaf not in tree
    assert tree.edges == before


def graph_of(tree: Tree, closed: set[Corner]) -> "nx.Graph[Cell]":
    """Return the sub-cells of a tree's cells, and which of them are next to each other."""
    free = {sub_cell(*corner) for corner in corners_of(tree) - closed}
    graph: nx.Graph[Cell] = nx.Graph()
    graph.add_nodes_from(free)
    graph.add_edges_from(
        (at, after(at, exit_)) for at in free for exit_ in range(4) if after(at, exit_) in free
    )
    return graph


@given(trees(), st.data())
def test_a_way_is_a_shortest_one(tree: Tree, data: st.DataObject) -> None:
    """Within the cells of the tree, across its edges or not, and through nothing closed."""
    corners = sorted(corners_of(tree))
    start = data.draw(st.sampled_from(corners))
    targets = data.draw(st.sets(st.sampled_from(corners), max_size=3))
    closed = data.draw(st.sets(st.sampled_from(corners), max_size=8)) - {start}
    way = tree.way(start, targets, closed)
    lengths = nx.single_source_shortest_path_length(graph_of(tree, closed), sub_cell(*start))
    reached = [lengths[sub_cell(*to)] for to in targets if sub_cell(*to) in lengths]
    if not reached:
        assert way is None
        return
    assert way is not None
    assert len(way) == min(reached)
    at = start
    for exit_, cell, corner in way:
        assert after(sub_cell(*at), exit_) == sub_cell(cell, corner)
        at = (cell, corner)
        assert at not in closed
        assert cell in tree
    assert at in targets
