"""What a robot senses on a grid: each mode against a slow one, and the geometry of lines of sight."""

from itertools import combinations_with_replacement, product
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.grid import EAST, NORTH, SOUTH, STEPS, WEST, Cell, Grid
from protocol.line_of_sight import in_sight
from tests.conftest import shared
from tests.instances import read_instance
from tests.play import grids, line_is_clear, scenario_of
from world_server.terrain import GridTerrain

GAZES = (None, NORTH, EAST, SOUTH, WEST)


def senses(grid: Grid, **sensing: Any) -> GridTerrain:
    return GridTerrain(grid, scenario_of(1, sensing=sensing))


def sees(terrain: GridTerrain, cell: Cell, gaze: int | None = None) -> bytes:
    """Return what a robot sees that knows where it is."""
    assert terrain.see is not None
    return terrain.see(terrain.grid.place(*cell), cell, gaze)


# Coarse cells.


def coarse_mark(grid: Grid, row: int, col: int) -> bytes:
    """Return how the coarse cell looks whose upper left sub-cell is at ``row``, ``col``."""
    four = product((row, row + 1), (col, col + 1))
    return b"." if all(grid.is_free(*cell) for cell in four) else b"#"


def expected_coarse(grid: Grid, stands: Cell, believes: Cell, gaze: int | None, mode: str) -> bytes:
    """Return what a robot sees that stands on one sub-cell and takes it for another."""
    if gaze is None:
        return b"?" if mode == "ahead" else b"???"
    marks = []
    for turn in (0,) if mode == "ahead" else (-1, 0, 1):
        down, right = STEPS[(gaze + turn) % 4]
        # The coarse cell that it means to look at, by the numbers of its own map ...
        row, col = 2 * (believes[0] // 2 + down), 2 * (believes[1] // 2 + right)
        # ... and where its sensor points to, seen from where it really is.
        marks.append(
            coarse_mark(grid, row + stands[0] - believes[0], col + stands[1] - believes[1])
        )
    return b"".join(marks)


@settings(max_examples=60)
@given(grids(), st.sampled_from(["ahead", "three"]), st.sampled_from(["known", "odometry"]))
def test_coarse_cells_are_sensed_as_the_naive_model_says(
    grid: Grid, mode: str, position: str
) -> None:
    terrain = senses(grid, mode=mode, position=position)
    assert terrain.window == 0
    for cell, gaze in product(grid.free_cells(), GAZES):
        assert sees(terrain, cell, gaze) == expected_coarse(grid, cell, cell, gaze, mode)


@given(grids(), st.sampled_from(["ahead", "three"]), st.data())
def test_a_robot_that_is_mistaken_about_its_place_looks_at_the_wrong_cell(
    grid: Grid, mode: str, data: st.DataObject
) -> None:
    terrain = senses(grid, mode=mode, position="odometry", drift=0.3)
    assert terrain.see is not None
    stands = data.draw(st.sampled_from(grid.free_cells()))
    error = st.integers(-5, 5)
    believes = (stands[0] + data.draw(error), stands[1] + data.draw(error))
    for gaze in GAZES:
        found = terrain.see(grid.place(*stands), believes, gaze)
        assert found == expected_coarse(grid, stands, believes, gaze, mode)


def test_what_a_mistaken_robot_takes_for_a_coarse_cell_need_not_be_one() -> None:
    grid = Grid.of_text("""
        ......
        ......
        ....#.
        ......
    """)
    terrain = senses(grid, mode="ahead", position="odometry")
    assert terrain.see is not None
    place = grid.place(0, 2)
    assert terrain.see(place, (0, 2), SOUTH) == b"."  # rows 2 and 3, columns 2 and 3
    assert terrain.see(place, (0, 3), SOUTH) == b"."  # columns 1 and 2
    assert terrain.see(place, (1, 2), SOUTH) == b"."  # rows 1 and 2
    assert terrain.see(place, (-1, 1), EAST) == b"#"  # rows -1 and 0, which is off the grid
    assert terrain.see(grid.place(0, 3), (0, 2), SOUTH) == b"#"  # columns 3 and 4
    assert terrain.see(grid.place(0, 3), (0, 3), SOUTH) == b"."


def test_left_ahead_and_right_come_in_this_order() -> None:
    grid = Grid.of_text("""
        ##..##
        ##..##
        ......
        ......
        ......
        ......
    """)
    terrain = senses(grid, mode="three")
    assert [sees(terrain, (2, 2), gaze) for gaze in GAZES] == [
        b"???",
        b"...",
        b"...",
        b"...",
        b"...",
    ]
    assert [sees(terrain, (3, 1), gaze) for gaze in GAZES[1:]] == [b"##.", b"#..", b"..#", b".##"]


def test_a_coarse_cell_that_is_cut_off_by_the_border_is_blocked() -> None:
    grid = Grid.of_text("...\n...\n...")
    terrain = senses(grid, mode="ahead")
    assert [sees(terrain, (0, 0), gaze) for gaze in GAZES[1:]] == [b"#"] * 4
    assert sees(terrain, (0, 2), WEST) == b"."  # from the odd column back to the whole cell
    assert sees(terrain, (2, 0), NORTH) == b"."
    assert [sees(terrain, (2, 2), gaze) for gaze in GAZES[1:]] == [b"#"] * 4


@settings(max_examples=50)
@given(grids(), st.sampled_from(["ahead", "three"]), st.data())
def test_nothing_but_the_cells_looked_at_reaches_a_robot(
    grid: Grid, mode: str, data: st.DataObject
) -> None:
    """Change everything else: it sees the same."""
    row, col = stands = data.draw(st.sampled_from(grid.free_cells()))
    gaze = data.draw(st.sampled_from(GAZES[1:]))
    turns = (0,) if mode == "ahead" else (-1, 0, 1)
    steps = [STEPS[(gaze + turn) % 4] for turn in turns]
    coarse = {(row // 2 + down, col // 2 + right) for down, right in steps}
    changed = bytearray(grid.cells())
    for index in range(len(changed)):
        cell = divmod(index, grid.cols)
        if (cell[0] // 2, cell[1] // 2) not in coarse and cell != stands:
            changed[index] = not changed[index]
    other = Grid(grid.rows, grid.cols, bytes(changed), grid.cell_m)
    found = [sees(senses(one, mode=mode), stands, gaze) for one in (grid, other)]
    assert found[0] == found[1]


# Squares of sub-cells.


def expected_square(grid: Grid, cell: Cell, squared: float, *, hidden: bool) -> list[str]:
    """Return what a robot sees up to the root of ``squared`` sub-cells, row by row."""
    reach = max(reach for reach in range(20) if reach * reach <= squared)
    lines = []
    for row in range(cell[0] - reach, cell[0] + reach + 1):
        line = ""
        for col in range(cell[1] - reach, cell[1] + reach + 1):
            sensed = (row - cell[0]) ** 2 + (col - cell[1]) ** 2 <= squared
            if hidden and sensed:
                sensed = line_is_clear(grid, cell, (row, col))
            mark = "." if grid.is_free(row, col) else "#"
            line += mark if sensed else "?"
        lines.append(line)
    return lines


def as_lines(seen: bytes, side: int) -> list[str]:
    assert len(seen) == side * side
    text = seen.decode()
    return [text[at : at + side] for at in range(0, len(text), side)]


SQUARED = (0.5, 1.0, 2.0, 4.0, 5.0, 6.25, 9.0, 13.0, 16.0)
"""Squares of ranges, in sub-cells."""


@given(grids(), st.sampled_from(SQUARED), st.sampled_from(GAZES), st.data())
def test_a_radius_is_sensed_as_the_naive_model_says(
    grid: Grid, squared: float, gaze: int | None, data: st.DataObject
) -> None:
    range_m = (squared + 1e-6) ** 0.5 * grid.cell_m
    terrain = senses(grid, mode="radius", range_m=range_m)
    cell = data.draw(st.sampled_from(grid.free_cells()))
    seen = as_lines(sees(terrain, cell, gaze), terrain.window)
    assert seen == expected_square(grid, cell, squared, hidden=False)


@settings(max_examples=60)
@given(grids(marks="....#"), st.sampled_from(SQUARED), st.sampled_from(GAZES), st.data())
def test_a_line_of_sight_is_sensed_as_the_naive_model_says(
    grid: Grid, squared: float, gaze: int | None, data: st.DataObject
) -> None:
    range_m = (squared + 1e-6) ** 0.5 * grid.cell_m
    terrain = senses(grid, mode="line-of-sight", range_m=range_m)
    cell = data.draw(st.sampled_from(grid.free_cells()))
    seen = as_lines(sees(terrain, cell, gaze), terrain.window)
    assert seen == expected_square(grid, cell, squared, hidden=True)


@settings(max_examples=50)
@given(grids(), st.sampled_from(["radius", "line-of-sight"]), st.data())
def test_nothing_beyond_the_range_reaches_a_robot(
    grid: Grid, mode: str, data: st.DataObject
) -> None:
    """Change everything beyond: it sees the same."""
    row, col = stands = data.draw(st.sampled_from(grid.free_cells()))
    changed = bytearray(grid.cells())
    for index in range(len(changed)):
        cell = divmod(index, grid.cols)
        if (cell[0] - row) ** 2 + (cell[1] - col) ** 2 > 4:
            changed[index] = not changed[index]
    other = Grid(grid.rows, grid.cols, bytes(changed), grid.cell_m)
    range_m = 2 * grid.cell_m
    found = [sees(senses(one, mode=mode, range_m=range_m), stands) for one in (grid, other)]
    assert found[0] == found[1]


@settings(max_examples=40)
@given(grids(), st.sampled_from(["radius", "line-of-sight"]), st.data())
def test_a_square_is_seen_from_where_a_robot_really_is(
    grid: Grid, mode: str, data: st.DataObject
) -> None:
    terrain = senses(grid, mode=mode, range_m=2 * grid.cell_m, position="odometry")
    assert terrain.see is not None
    cell = data.draw(st.sampled_from(grid.free_cells()))
    mistaken = terrain.see(grid.place(*cell), (cell[0] + 1, cell[1] - 3), None)
    assert mistaken == sees(terrain, cell)


def test_a_square_by_hand() -> None:
    grid = Grid.of_text("""
        .....
        ..#..
        .....
    """)
    near = senses(grid, mode="radius", range_m=2.0)
    assert near.window == 5
    assert as_lines(sees(near, (2, 2)), 5) == ["??.??", "?.#.?", ".....", "?###?", "??#??"]
    sight = senses(grid, mode="line-of-sight", range_m=2.0)
    assert as_lines(sees(sight, (2, 2)), 5) == ["?????", "?.#.?", ".....", "?###?", "?????"]


@pytest.mark.parametrize(
    ("range_m", "cell_m", "side"),
    # 0.3 / 0.1 is a little less than 3 in floats, and so are these others
    [(0.3, 0.1, 7), (0.6, 0.2, 7), (0.7, 0.1, 15), (0.29, 0.1, 5), (0.05, 0.1, 1), (1.5, 0.5, 7)],
)
def test_a_range_that_is_a_multiple_of_a_sub_cell_reaches_as_far(
    range_m: float, cell_m: float, side: int
) -> None:
    grid = Grid(1, 40, bytes(40), cell_m)
    terrain = senses(grid, mode="radius", range_m=range_m)
    assert terrain.window == side
    middle = as_lines(sees(terrain, (0, 20)), side)[side // 2]
    assert middle == "." * side


# Lines of sight.


@given(grids(marks="..#"), st.data())
def test_lines_of_sight_are_those_of_exact_geometry_both_ways(
    grid: Grid, data: st.DataObject
) -> None:
    cells = st.sampled_from(grid.free_cells())
    one, other = data.draw(cells), data.draw(cells)
    found = in_sight(grid, one, other)
    assert found == line_is_clear(grid, one, other)
    assert found == in_sight(grid, other, one)


def test_every_line_within_a_small_square_is_that_of_exact_geometry() -> None:
    """Each obstacle alone, and each pair of them, between one corner and every cell."""
    side = 5
    cells = [(row, col) for row in range(side) for col in range(side)]
    for one, other in combinations_with_replacement(cells[1:], 2):
        grid = Grid(side, side, bytes(cell in (one, other) for cell in cells))
        for target in cells[1:]:
            if target not in (one, other):
                found = in_sight(grid, (0, 0), target)
                assert found == line_is_clear(grid, (0, 0), target), (one, other, target)


@pytest.mark.parametrize(
    ("rows", "clear"),
    [
        (["A.", ".B"], True),
        (["A#", ".B"], True),  # past one corner
        (["A.", "#B"], True),
        (["A#", "#B"], False),  # between two obstacles that touch at a corner
        (["#B", "A#"], False),
        (["A##", "#.#", "##B"], False),  # both corners on the way are closed
        (["A.#", "#..", "##B"], True),
        (["A#.", "..#", "..B"], True),
        (["A..", ".#.", "..B"], False),  # through the inside of one
        (["A.", "..", ".B"], True),
        (["A#", "..", "#B"], True),  # 2 down and 1 across: by the two cells in the middle
        (["A.", "#.", ".B"], False),
        (["A.", ".#", ".B"], False),
        (["A#..", "..#B"], False),
        (["A...", "...B"], True),
        (["A.#.", "...B"], True),
        (["A..B"], True),
        (["A.#B"], False),
        (["A", ".", "#", "B"], False),
        (["AB"], True),
        # 3 across and 1 down: it passes the corner in the middle
        (["A.#.", ".#.B"], False),
    ],
)
def test_lines_of_sight_by_hand(rows: list[str], clear: bool) -> None:
    text = "\n".join(rows).replace("A", ".").replace("B", ".")
    ends = {
        mark: (r, row.index(mark)) for r, row in enumerate(rows) for mark in "AB" if mark in row
    }
    grid = Grid.of_text(text)
    for one, other in (("A", "B"), ("B", "A")):
        assert in_sight(grid, ends[one], ends[other]) is clear
        assert line_is_clear(grid, ends[one], ends[other]) is clear


@pytest.mark.parametrize("name", ["los_10x10", "los_60x60_20pct_seed0"])
def test_as_many_cells_are_in_sight_as_others_have_counted(name: str) -> None:
    """Counts that were made by an implementation of somebody else."""
    instance = read_instance(shared("spec", "instances", f"{name}.txt"))
    grid = Grid.of_text("\n".join(instance.rows))
    for squared in map(int, instance.others["radii"]):
        reach = range(-6, 7)
        near = [(r, c) for r, c in product(reach, reach) if r * r + c * c <= squared]
        counts = []
        for row, col in sorted(instance.free):
            around = [(row + down, col + right) for down, right in near]
            seen = [cell for cell in around if grid.is_free(*cell)]
            counts.append(sum(in_sight(grid, (row, col), cell) for cell in seen))
        expected = instance.expected(str(squared))
        assert (max(counts), sum(counts)) == (expected["maxLOS"], expected["sumLOS"])
