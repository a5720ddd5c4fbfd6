"""Line of sight between sub-cells: one rule for the world, for agents and for verdicts.

The straight line between the middles of two cells is clear if it crosses the inside of no blocked
cell and does not squeeze between two blocked cells that touch at a corner. What lies outside the grid
is blocked. All in integers.
"""

from functools import lru_cache

from protocol.grid import Cell, Grid

Gap = tuple[Cell, ...]
"""Cells, as offsets, of which one at least must be free for a line to pass."""


def in_sight(grid: Grid, one: Cell, other: Cell) -> bool:
    """Tell whether the straight line between two free sub-cells is clear."""
    row, col = one
    at = row * grid.stride + col
    cells, corners = _steps_to(other[0] - row, other[1] - col, grid.stride)
    blocked = grid.blocked
    for step in cells:
        if blocked[at + step]:
            return False
    return not any(blocked[at + near] and blocked[at + far] for near, far in corners)


@lru_cache(maxsize=1 << 16)
def _steps_to(
    down: int, right: int, stride: int
) -> tuple[tuple[int, ...], tuple[tuple[int, int], ...]]:
    """Return what `gaps_to` returns in numbers of places: the cells, and the pairs at corners.

    All of it lies between the ends of the line, so that none is off a grid that holds both.
    """
    places = [[row * stride + col for row, col in gap] for gap in gaps_to(down, right)]
    cells = tuple(gap[0] for gap in places if len(gap) == 1)
    return cells, tuple((gap[0], gap[1]) for gap in places if len(gap) == 2)


def gaps_to(down: int, right: int) -> tuple[Gap, ...]:
    """Return what the line from the middle of a cell to that of another passes, its ends left out.

    A cell whose inside it crosses must be free; where it passes a corner between two cells one of
    them must be. In integers: the sides of a cell are two units.

    Args:
        down: rows from the one cell to the other.
        right: columns from the one cell to the other.
    """
    gaps: list[Gap] = []
    steps_down, steps_right = abs(down), abs(right)
    sign_down, sign_right = (down > 0) - (down < 0), (right > 0) - (right < 0)
    row = col = 0
    while (row, col) != (steps_down, steps_right):
        # Which side of the present cell does the line leave by? Compare the next crossings.
        to_row = (2 * row + 1) * steps_right
        to_col = (2 * col + 1) * steps_down
        if to_row == to_col:
            gaps.append(
                (
                    (sign_down * (row + 1), sign_right * col),
                    (sign_down * row, sign_right * (col + 1)),
                )
            )
            row, col = row + 1, col + 1
        elif to_row < to_col:
            row += 1
        else:
            col += 1
        if (row, col) != (steps_down, steps_right):
            gaps.append(((sign_down * row, sign_right * col),))
    return tuple(gaps)
