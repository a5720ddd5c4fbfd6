"""Grids: places that robots of one size cover, cell by cell.

A *sub-cell* has the size of a robot; a *coarse cell* is two by two of them, aligned to the corner of
the grid, and is complete if none of its four is blocked (Agmon et al. 2008, Sec. 4.1). Rows grow
downwards, row 0 is the top; what lies outside is blocked.
"""

from collections.abc import Callable, Iterable, Iterator

Cell = tuple[int, int]
"""Row and column, of a sub-cell or of a coarse cell."""

NORTH, EAST, SOUTH, WEST = range(4)
"""The exits of every sub-cell; also the directions that a sensor can look in."""

STEPS: tuple[Cell, ...] = ((-1, 0), (0, 1), (1, 0), (0, -1))
"""What each exit adds to row and column."""


class Grid:
    """Which sub-cells are blocked.

    A place is the number of a sub-cell, ``row * stride + column``. One more column and one more row
    of blocked cells stand behind the last ones, so that a step off any edge of the grid lands on a
    blocked cell (off the top or the left by way of negative indices).

    Attributes:
        rows, cols: sub-cells.
        cell_m: side of a sub-cell, metres.
        stride: places a row, ``cols + 1``.
        blocked: one byte a place, 1 where it is blocked; ``(rows + 1) * stride`` of them.
    """

    __slots__ = ("blocked", "cell_m", "cols", "rows", "stride")

    def __init__(self, rows: int, cols: int, blocked: bytes, cell_m: float = 1.0) -> None:
        """Take over a grid.

        Args:
            rows: sub-cells from top to bottom, at least one.
            cols: sub-cells from left to right, at least one.
            blocked: ``rows * cols`` bytes, row by row; not 0 where the sub-cell is blocked.
            cell_m: side of a sub-cell, metres.

        Raises:
            ValueError: If ``blocked`` has another size, or there are no cells.
        """
        if rows < 1 or cols < 1 or len(blocked) != rows * cols:
            raise ValueError(f"{len(blocked)} bytes for {rows} x {cols} sub-cells")
        self.rows = rows
        self.cols = cols
        self.cell_m = cell_m
        self.stride = cols + 1
        plain = blocked.translate(_TO_BITS)
        lines = [plain[at : at + cols] for at in range(0, len(plain), cols)]
        self.blocked = b"\1".join((*lines, b"\1" * self.stride))

    @classmethod
    def of_text(cls, text: str, cell_m: float = 1.0) -> "Grid":
        """Build a grid from rows of ``.`` (free) and other characters (blocked); for tests."""
        lines = text.split()
        blocked = bytes(character != "." for line in lines for character in line)
        return cls(len(lines), len(lines[0]), blocked, cell_m)

    def __len__(self) -> int:
        """Return the number of places, those of the border included."""
        return len(self.blocked)

    def __eq__(self, other: object) -> bool:
        """Tell whether two grids are the same."""
        if not isinstance(other, Grid):
            return NotImplemented
        return (self.cols, self.cell_m, self.blocked) == (other.cols, other.cell_m, other.blocked)

    def __hash__(self) -> int:
        return hash((self.cols, self.blocked))

    def cells(self) -> bytes:
        """Return ``rows * cols`` bytes, row by row, as the constructor takes them."""
        ends = range(0, self.rows * self.stride, self.stride)
        return b"".join(self.blocked[at : at + self.cols] for at in ends)

    def place(self, row: int, col: int) -> int:
        """Return the number of a sub-cell within the grid."""
        return row * self.stride + col

    def position(self, place: int) -> Cell:
        """Return row and column of a place."""
        return divmod(place, self.stride)

    def is_free(self, row: int, col: int) -> bool:
        """Tell whether a sub-cell lies within the grid and is not blocked."""
        inside = 0 <= row < self.rows and 0 <= col < self.cols
        return inside and not self.blocked[row * self.stride + col]

    def is_complete(self, row: int, col: int) -> bool:
        """Tell whether a coarse cell lies within the grid and none of its sub-cells is blocked."""
        row, col = 2 * row, 2 * col
        if not (0 <= row < self.rows - 1 and 0 <= col < self.cols - 1):
            return False
        at = row * self.stride + col
        blocked = self.blocked
        below = at + self.stride
        return not (blocked[at] or blocked[at + 1] or blocked[below] or blocked[below + 1])

    def free_cells(self) -> list[Cell]:
        """Return all free sub-cells, row by row."""
        return [divmod(place, self.stride) for place, bit in enumerate(self.blocked) if not bit]

    def complete_cells(self) -> list[Cell]:
        """Return all complete coarse cells, row by row."""
        rows, cols = range(self.rows // 2), range(self.cols // 2)
        return [(row, col) for row in rows for col in cols if self.is_complete(row, col)]

    def reachable(self, starts: Iterable[Cell]) -> set[Cell]:
        """Return the sub-cells that can be reached from some sub-cells, step by step."""
        return _flood(starts, self.is_free)

    def reachable_cells(self, starts: Iterable[Cell]) -> set[Cell]:
        """Return the complete coarse cells that can be reached from some complete coarse cells."""
        return _flood(starts, self.is_complete)


def sub_cells(cell: Cell) -> Iterator[Cell]:
    """Yield the four sub-cells of a coarse cell."""
    row, col = 2 * cell[0], 2 * cell[1]
    yield from ((row, col), (row, col + 1), (row + 1, col), (row + 1, col + 1))


_TO_BITS = bytes([0, *[1] * 255])


def _flood(starts: Iterable[Cell], is_open: Callable[[int, int], bool]) -> set[Cell]:
    reached = {start for start in starts if is_open(*start)}
    ahead = list(reached)
    while ahead:
        row, col = ahead.pop()
        for down, right in STEPS:
            cell = (row + down, col + right)
            if cell not in reached and is_open(*cell):
                reached.add(cell)
                ahead.append(cell)
    return reached
