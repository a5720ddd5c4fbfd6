"""Who sees whom on a whole grid, by the rule of `protocol.line_of_sight`, all cells at once."""

import numpy as np
import numpy.typing as npt

from protocol.grid import Cell, Grid
from protocol.line_of_sight import gaps_to

Cells = npt.NDArray[np.bool_]
"""One truth a sub-cell, [rows, cols]."""


class Sights:
    """Which free sub-cells each free sub-cell sees, itself included, up to a distance.

    Attributes:
        offsets: half of the offsets in reach, (0, 0) left out: rows below, or columns to the right.
            Sight is symmetric, so that the other half follows.
        clear: [offset, rows, cols], whether a cell sees that at the offset; both are free then.
    """

    def __init__(self, grid: Grid, squared: int) -> None:
        """Look from every cell.

        Args:
            grid: what hides what.
            squared: largest squared distance that is seen, sub-cells; it is seen itself.
        """
        reach = 0
        while (reach + 1) ** 2 <= squared:
            reach += 1
        self._rows, self._cols, self._reach = grid.rows, grid.cols, reach
        cells = np.frombuffer(grid.cells(), np.uint8).reshape(grid.rows, grid.cols)
        # A border of blocked cells as wide as the sight: what lies outside is blocked.
        self._free: Cells = np.pad(cells == 0, reach)
        self.offsets: list[Cell] = [
            (down, right)
            for down in range(reach + 1)
            for right in range(-reach, reach + 1)
            if (down, right) > (0, 0) and down * down + right * right <= squared
        ]
        self._numbers = {offset: index for index, offset in enumerate(self.offsets)}
        self.clear: Cells = np.empty((len(self.offsets), grid.rows, grid.cols), np.bool_)
        for index, (down, right) in enumerate(self.offsets):
            seen = self.clear[index]
            np.logical_and(self._shifted(0, 0), self._shifted(down, right), out=seen)
            for one, *others in gaps_to(down, right):
                passable = self._shifted(*one)
                for other in others:
                    passable = passable | self._shifted(*other)
                seen &= passable

    def _shifted(self, down: int, right: int) -> Cells:
        """Return, at every cell, whether that at an offset is free."""
        top, left = self._reach + down, self._reach + right
        return self._free[top : top + self._rows, left : left + self._cols]

    def sees(self, one: Cell, other: Cell) -> bool:
        """Tell whether two cells of the grid are free, in reach, and see each other."""
        if one == other:
            return bool(self._shifted(0, 0)[one])
        first, last = sorted((one, other))
        index = self._numbers.get((last[0] - first[0], last[1] - first[1]))
        return index is not None and bool(self.clear[index][first])

    def seen(self, cell: Cell) -> list[Cell]:
        """Return the cells that a free cell sees, row by row, itself included."""
        row, col = cell
        near = [(down, right) for down, right in self.offsets]
        near += [(-down, -right) for down, right in self.offsets]
        found = [
            (row + down, col + right)
            for down, right in near
            if 0 <= row + down < self._rows
            and 0 <= col + right < self._cols
            and self.sees(cell, (row + down, col + right))
        ]
        return sorted([*found, cell]) if self._shifted(0, 0)[cell] else []

    def count(self) -> npt.NDArray[np.int32]:
        """Return how many cells each cell sees, itself included; 0 where it is blocked."""
        rows, cols = self._rows, self._cols
        counts = self._shifted(0, 0).astype(np.int32)
        for (down, right), seen in zip(self.offsets, self.clear, strict=True):
            counts += seen
            ahead = seen[: max(0, rows - down), max(0, -right) : max(0, cols - max(0, right))]
            counts[down:, max(0, right) : max(0, cols + min(0, right))] += ahead
        return counts

    @property
    def max(self) -> int:
        """The largest number of cells that a cell sees."""
        return int(self.count().max())

    @property
    def sum(self) -> int:
        """How many ordered pairs of cells see each other, each cell itself included."""
        return int(self.count().sum())
