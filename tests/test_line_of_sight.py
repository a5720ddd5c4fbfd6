"""The rule of sight, and all that makes it quick, against the words of the rule."""

import subprocess
import sys
from itertools import product
from random import Random
from typing import Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.grid import Cell, Grid
from protocol.line_of_sight import gaps_to, in_sight
from protocol.scenario import SensingSection
from tests.play import grids
from world_server.radio import RadiusRadio
from world_server.sensing import seer


def sees(grid: Grid, one: Cell, other: Cell) -> bool:
    """Tell whether a line passes all of its gaps, one by one; what is off the grid is blocked."""
    gaps = gaps_to(other[0] - one[0], other[1] - one[1])
    return all(any(grid.is_free(one[0] + r, one[1] + c) for r, c in gap) for gap in gaps)


def square(grid: Grid, cell: Cell, range_cells: float, *, hidden: bool) -> bytes:
    """Return what a robot senses around a sub-cell, looking at one after another."""
    reach = range(-int(range_cells), int(range_cells) + 1)
    marks = bytearray()
    for down, right in product(reach, repeat=2):
        other = cell[0] + down, cell[1] + right
        if down**2 + right**2 > range_cells**2 or (hidden and not sees(grid, cell, other)):
            marks += b"?"
        else:
            marks += b"." if grid.is_free(*other) else b"#"
    return bytes(marks)


MODES: tuple[Literal["radius", "line-of-sight"], ...] = ("radius", "line-of-sight")
RANGES = (0.5, 1.0, 1.5, 2.0, 3.2, 5.0, 6.5, 8.0)


@given(
    grids(rows_max=16, cols_max=16, marks="......#"),
    st.sampled_from(RANGES),
    st.booleans(),
    st.data(),
)
def test_a_square_is_sensed_as_cell_by_cell(
    grid: Grid, range_cells: float, hidden: bool, data: st.DataObject
) -> None:
    range_m = range_cells * grid.cell_m
    see, side = seer(grid, SensingSection(mode=MODES[hidden], range_m=range_m))
    assert side == 2 * int(range_cells) + 1
    cells = st.sampled_from(grid.free_cells())
    for cell in data.draw(st.lists(cells, min_size=1, max_size=4)):
        expected = square(grid, cell, range_cells, hidden=hidden)
        # Again, as it is remembered then.
        for gaze in (None, 1):
            assert see(grid.place(*cell), cell, gaze) == expected


@pytest.mark.parametrize(("side", "range_cells", "ratio"), [(60, 20.0, 0.1), (100, 40.0, 0.02)])
def test_a_far_sight_is_sensed_as_cell_by_cell(side: int, range_cells: float, ratio: float) -> None:
    rng = Random(side)
    grid = Grid(side, side, bytes([0, *(rng.random() < ratio for _ in range(side * side - 1))]))
    see, _ = seer(grid, SensingSection(mode="line-of-sight", range_m=range_cells))
    for cell in ((0, 0), *rng.sample(grid.free_cells(), 3)):
        seen = see(grid.place(*cell), cell, None)
        assert seen == square(grid, cell, range_cells, hidden=True)


class At:
    """A robot that stands somewhere."""

    left_at = float("inf")

    def __init__(self, place: int) -> None:
        self.place = place


@settings(max_examples=60)
@given(grids(), st.sampled_from(RANGES), st.booleans())
def test_a_radio_remembers_right(grid: Grid, range_cells: float, line_of_sight: bool) -> None:
    radio = RadiusRadio(grid, range_cells * grid.cell_m, line_of_sight=line_of_sight)
    cells = grid.free_cells()[:12]
    for _, one, other in product(range(2), cells, cells):
        near = (one[0] - other[0]) ** 2 + (one[1] - other[1]) ** 2 <= range_cells**2
        expected = near and (not line_of_sight or sees(grid, one, other))
        assert radio.hears(At(grid.place(*one)), At(grid.place(*other)), 0.0) == expected


@given(grids())
def test_sight_is_symmetric_and_by_its_gaps(grid: Grid) -> None:
    for one, other in product(grid.free_cells()[:20], repeat=2):
        found = in_sight(grid, one, other)
        assert found == in_sight(grid, other, one)
        assert found == sees(grid, one, other)


def test_a_line_passes_one_corner_and_does_not_squeeze_between_two() -> None:
    assert in_sight(Grid.of_text(".. #."), (0, 0), (1, 1))
    assert not in_sight(Grid.of_text(".# #."), (0, 0), (1, 1))


def test_the_world_looks_and_listens_without_numpy() -> None:
    code = "import sys, world_server.sensing, world_server.radio; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
