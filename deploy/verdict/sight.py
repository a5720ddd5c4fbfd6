"""Line of sight as a verdict sees it: by which side of a line the corners of cells lie on.

From one free cell another is in sight below a distance if the segment between their middles crosses
the inside of no blocked cell and does not squeeze between two blocked cells that touch at a corner.
Nothing is shared with the code by which the world and the robots look: that follows the line from cell
to cell. All in integers.
"""

from fractions import Fraction
from functools import lru_cache
from itertools import product
from math import isqrt
from typing import NamedTuple

from protocol.grid import Cell, Grid


class Obstructions(NamedTuple):
    """What can be in the way to a cell, as rows and columns from where one looks.

    Attributes:
        inside: cells whose inside the segment crosses, its ends left out.
        beside: the two cells at each corner that it passes between them.
    """

    inside: tuple[Cell, ...]
    beside: tuple[tuple[Cell, Cell], ...]


class Looks:
    """Who sees whom on a grid.

    Attributes:
        near: rows and columns from a cell to all that may be in its sight, itself included.
    """

    def __init__(self, grid: Grid, radius_m: float) -> None:
        """Look about on a grid.

        Args:
            grid: the grid.
            radius_m: cells at this distance or farther are out of sight.
        """
        self._grid = grid
        cells = Fraction(str(radius_m)) / Fraction(str(grid.cell_m))
        self._below = cells * cells
        reach = range(-isqrt(int(self._below)), isqrt(int(self._below)) + 1)
        self.near = [offset for offset in product(reach, reach) if self._is_near(*offset)]
        self._pairs: dict[tuple[int, int], bool] = {}

    def sees(self, one: int, other: int) -> bool:
        """Tell whether two free places see each other."""
        pair = (one, other)
        found = self._pairs.get(pair)
        if found is None:
            (row, col), (far_row, far_col) = map(self._grid.position, pair)
            down, right = far_row - row, far_col - col
            found = self._is_near(down, right) and self.is_clear(one, down, right)
            self._pairs[pair] = found
        return found

    def is_clear(self, place: int, down: int, right: int) -> bool:
        """Tell whether nothing is in the way from a place to another on the grid, near or far."""
        blocked, stride = self._grid.blocked, self._grid.stride
        inside, beside = _obstructions(down, right)
        return not any(blocked[place + row * stride + col] for row, col in inside) and not any(
            blocked[place + one[0] * stride + one[1]]
            and blocked[place + other[0] * stride + other[1]]
            for one, other in beside
        )

    def _is_near(self, down: int, right: int) -> bool:
        return down * down + right * right < self._below


@lru_cache(maxsize=1 << 14)
def _obstructions(down: int, right: int) -> Obstructions:
    """Return what can be in the way; all of it lies between the two cells."""

    def side(row: int, col: int) -> int:
        """Tell on which side of the line the upper left corner of a cell lies; 0: on the line."""
        return (2 * row - 1) * right - (2 * col - 1) * down

    rows = range(min(0, down), max(0, down) + 1)
    cols = range(min(0, right), max(0, right) + 1)
    inside = []
    for row, col in product(rows, cols):
        corners = [side(row + south, col + east) for south in (0, 1) for east in (0, 1)]
        if min(corners) < 0 < max(corners) and (row, col) not in ((0, 0), (down, right)):
            inside.append((row, col))
    beside = []
    for row, col in product(rows[1:], cols[1:]):
        if side(row, col) == 0:
            # Of the four cells at the corner the line crosses two; the others are these.
            falls = (down > 0) == (right > 0)
            one, other = (col, col - 1) if falls else (col - 1, col)
            beside.append(((row - 1, one), (row, other)))
    return Obstructions(tuple(inside), tuple(beside))
