import subprocess
import sys
from itertools import product

from hypothesis import given
from hypothesis import strategies as st

from protocol.grid import Grid
from protocol.line_of_sight import in_sight
from protocol.sights import Sights


@st.composite
def grids(draw):
    rows, cols = draw(st.integers(1, 8)), draw(st.integers(1, 8))
    return Grid(
        rows, cols, bytes(draw(st.lists(st.booleans(), min_size=rows * cols, max_size=rows * cols)))
    )


@given(grids(), st.integers(0, 60))
def test_all_sights_at_once_are_those_of_pairs(grid, squared):
    sights = Sights(grid, squared)
    free = grid.free_cells()
    counts = sights.count()
    for one in free:
        seen = [
            other
            for other in free
            if (one[0] - other[0]) ** 2 + (one[1] - other[1]) ** 2 <= squared
            and in_sight(grid, one, other)
        ]
        assert sights.seen(one) == seen
        assert counts[one] == len(seen)
    assert sights.sum == counts.sum()


@given(grids())
def test_sight_is_symmetric(grid):
    for one, other in product(grid.free_cells(), repeat=2):
        assert in_sight(grid, one, other) == in_sight(grid, other, one)


def test_a_line_passes_one_corner_and_does_not_squeeze_between_two():
    assert in_sight(Grid.of_text(".. #."), (0, 0), (1, 1))
    assert not in_sight(Grid.of_text(".# #."), (0, 0), (1, 1))


def test_a_pair_needs_no_numpy():
    code = "import sys, protocol.line_of_sight; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
