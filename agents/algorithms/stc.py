"""Spanning tree coverage: the geometry of circumnavigating a tree of coarse cells.

Gabriely and Rimon's walk, as Agmon et al. 2008 use it: a robot drives on the right side of the tree's
edges, so that the tree stays on its left and it passes every sub-cell of the tree's cells once.

A coarse cell is one number (`number`), its neighbours are `AWAY` from it. Its four sub-cells are its
*corners*; each has the number of the direction in which it leaves the cell by a tree edge:

    corner      NORTH        EAST         SOUTH        WEST
    sub-cell    north-east   south-east   south-west   north-west

With directions counted clockwise from north, all arithmetic is modulo 4:

    next corner, counter-clockwise   corner - 1, by the exit of that number
    across the edge ahead            corner + 1 of the neighbour, by the exit ``corner``
    the corner before, clockwise     corner + 1, by the exit ``corner + 2``
    back across the edge behind      corner - 1 of the neighbour, by the exit ``corner + 1``
"""

from collections import deque
from collections.abc import Collection

from protocol.grid import Cell

SPAN = 1 << 20
"""No grid has so many coarse cells a row."""

AWAY = (-SPAN, 1, SPAN, -1)
"""What each direction adds to the number of a coarse cell."""

_CORNERS = ((3, 0), (2, 1))  # by parity of row and column

BEFORE = (3, 0, 1, 2)
"""A corner less one, modulo 4: the next one, counter-clockwise."""

BEHIND = (1, 2, 3, 0)
"""A corner more one, modulo 4."""

OPPOSITE = (2, 3, 0, 1)


def number(cell: Cell) -> int:
    """Return the number of a coarse cell given by row and column."""
    return cell[0] * SPAN + cell[1]


def row_and_column(cell: int) -> Cell:
    """Return row and column of a coarse cell."""
    return divmod(cell, SPAN)


def located(position: Cell) -> tuple[int, int]:
    """Return the coarse cell, and the corner in it, of a sub-cell given by row and column."""
    row, col = position
    return (row >> 1) * SPAN + (col >> 1), _CORNERS[row & 1][col & 1]


def sub_cell(cell: int, corner: int) -> Cell:
    """Return row and column of the sub-cell at a corner of a coarse cell."""
    row, col = divmod(cell, SPAN)
    return 2 * row + (corner in (1, 2)), 2 * col + (corner in (0, 1))


Corner = tuple[int, int]
"""A sub-cell: its coarse cell, and which corner of it."""


class Tree:
    """A spanning tree of coarse cells, and the way around it.

    Attributes:
        edges: for each cell of the tree one bit for each direction in which it has an edge.
    """

    __slots__ = ("edges",)

    def __init__(self) -> None:
        self.edges: dict[int, int] = {}

    def __contains__(self, cell: int) -> bool:
        """Tell whether the tree holds a cell."""
        return cell in self.edges

    def root(self, cell: int) -> None:
        """Begin the tree with a cell."""
        self.edges[cell] = 0

    def join(self, cell: int, direction: int) -> int:
        """Add the edge from a cell of the tree to its neighbour, and return that neighbour."""
        neighbour = cell + AWAY[direction]
        self.edges[cell] |= 1 << direction
        self.edges[neighbour] = self.edges.get(neighbour, 0) | 1 << OPPOSITE[direction]
        return neighbour

    def cut(self, cell: int, direction: int) -> int:
        """Remove the edge to a leaf, and that leaf; return it."""
        leaf = cell + AWAY[direction]
        self.edges[cell] &= ~(1 << direction)
        del self.edges[leaf]
        return leaf

    def way(
        self, start: Corner, targets: Collection[Corner], closed: Collection[Corner]
    ) -> list[tuple[int, int, int]] | None:
        """Return a shortest way from one corner to one of ``targets``, within the tree's cells.

        Args:
            start: where it begins.
            targets: where it may end.
            closed: corners that it must not lead through.

        Returns:
            Exit, cell and corner of each move; ``None`` if there is no such way.
        """
        came: dict[Corner, tuple[Corner, int]] = {start: (start, 0)}
        ahead = deque([start])
        while ahead:
            at = ahead.popleft()
            if at in targets:
                way: list[tuple[int, int, int]] = []
                while at != start:
                    before, exit_ = came[at]
                    way.append((exit_, *at))
                    at = before
                return way[::-1]
            cell, corner = at
            behind, before_ = BEHIND[corner], BEFORE[corner]
            for exit_, to in (
                (before_, (cell, before_)),
                (OPPOSITE[corner], (cell, behind)),
                (corner, (cell + AWAY[corner], behind)),
                (behind, (cell + AWAY[behind], before_)),
            ):
                if to[0] in self.edges and to not in came and to not in closed:
                    came[to] = (at, exit_)
                    ahead.append(to)
        return None

    def ahead(self, cell: int, corner: int) -> tuple[int, int, int]:
        """Return the exit to the next sub-cell on the way around, its cell and its corner."""
        if self.edges[cell] >> corner & 1:
            return corner, cell + AWAY[corner], BEHIND[corner]
        return BEFORE[corner], cell, BEFORE[corner]

    def back(self, cell: int, corner: int) -> tuple[int, int, int]:
        """Return the exit to the sub-cell before on the way around, its cell and its corner."""
        behind = BEHIND[corner]
        if self.edges[cell] >> behind & 1:
            return behind, cell + AWAY[behind], BEFORE[corner]
        return OPPOSITE[corner], cell, behind
