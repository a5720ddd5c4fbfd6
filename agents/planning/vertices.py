"""Vertices of a grid: which of them see each other, and where a parent has to stand to see all.

A vertex is a free cell. Two see each other if their squared distance is at most a limit, and the line
between them is clear (`protocol.line_of_sight`).

Paper:
    The parent-child paper, Sec. 3.3. A vertex is in sight below r_los, so the limit is the largest
    whole number below (r_los / d) squared. Candidates for a parent vertex lie within f = 2 r_los of
    some parent vertex chosen before; the paper's Eq. 5 asks for all, which soon leaves none. Where no
    vertex that is not covered lies so near, all of those are candidates.
"""

from collections.abc import Iterable, Iterator
from fractions import Fraction
from math import ceil, floor, isqrt
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from protocol.grid import Cell, Grid
from protocol.line_of_sight import gaps_to

Mask = npt.NDArray[np.bool_]
Numbers = npt.NDArray[np.int64]


class Reach(NamedTuple):
    """How far a parent sees.

    Attributes:
        limit: the largest squared distance in cells that is in sight.
        near: the largest squared distance in cells within f = 2 r_los, for the next parent vertex.
        in_file: children that fit into the line of sight one behind the other: r_los / d, rounded down.
    """

    limit: int
    near: int
    in_file: int

    @classmethod
    def of_lengths(cls, r_los_m: float, spacing_m: float) -> "Reach":
        """Take a radius and the spacing of vertices, exactly as they are written in decimals."""
        ratio = Fraction(str(r_los_m)) / Fraction(str(spacing_m))
        return cls(ceil(ratio * ratio) - 1, floor(4 * ratio * ratio), floor(ratio))

    @classmethod
    def of_limit(cls, limit: int) -> "Reach":
        """Take the limit; the radius is the least one that has it, rounded up to a whole square."""
        return cls(limit, 4 * (limit + 1), isqrt(limit + 1))


class Views:
    """What is in sight of each cell, ready to be looked up.

    Attributes:
        grid: the map.
        limit: the largest squared distance in sight.
    """

    def __init__(self, grid: Grid, limit: int) -> None:
        """Look from every vertex in every direction.

        Args:
            grid: the map.
            limit: at least 1, so that neighbours see each other.

        Raises:
            ValueError: If the limit is below 1.
        """
        if limit < 1:
            raise ValueError(f"found a squared radius of {limit}, expected at least 1")
        self.grid = grid
        self.limit = limit
        ahead = _ahead(grid, limit)
        # Row by row: the mirrored half, the cell itself, the other half.
        behind = [(-down, -right) for down, right in reversed(ahead)]
        self._offsets: Numbers = np.array([*behind, (0, 0), *ahead], dtype=np.int64)
        self._seen: Mask = np.zeros((len(self._offsets), grid.rows, grid.cols), dtype=np.bool_)
        middle = len(ahead)
        self._seen[middle] = _free(grid)
        for at, (here, there, clear) in enumerate(_looks(grid, ahead), start=1):
            self._seen[middle + at][here] = clear
            self._seen[middle - at][there] = clear

    @property
    def free(self) -> Mask:
        """The vertices."""
        free: Mask = self._seen[len(self._offsets) // 2]
        return free

    def seen(self, cell: Cell) -> list[Cell]:
        """Return the cells in sight of a vertex, itself included, row by row."""
        rows, cols = self.seen_from(cell)
        return list(zip(rows.tolist(), cols.tolist(), strict=True))

    def seen_from(self, cell: Cell) -> tuple[Numbers, Numbers]:
        """Return the rows and the columns of the cells in sight of a vertex."""
        offsets = self._offsets[self._seen[:, cell[0], cell[1]]]
        return offsets[:, 0] + cell[0], offsets[:, 1] + cell[1]

    def weights(self, values: Numbers) -> Numbers:
        """Return for each cell the sum of the values of the cells in its sight."""
        rows, cols = values.shape
        sums = np.zeros_like(values)
        for (down, right), seen in zip(self._offsets.tolist(), self._seen, strict=True):
            here, there = _overlap(rows, cols, down, right)
            sums[here] += seen[here] * values[there]
        return sums


def counts_in_sight(grid: Grid, limit: int) -> Numbers:
    """Return how many cells each cell sees, itself included; 0 where it is blocked.

    It keeps none of them, so that it needs no more memory far than near.

    Args:
        grid: the map.
        limit: the largest squared distance in sight.
    """
    counts = _free(grid).astype(np.int64)
    for here, there, clear in _looks(grid, _ahead(grid, limit)):
        counts[here] += clear
        counts[there] += clear
    return counts


def _free(grid: Grid) -> Mask:
    cells = np.frombuffer(grid.cells(), dtype=np.uint8).reshape(grid.rows, grid.cols)
    free: Mask = cells == 0
    return free


def _ahead(grid: Grid, limit: int) -> list[Cell]:
    """Return half of the offsets in sight, row by row: what is seen at them sees back."""
    # No two cells of the grid are farther apart than it is long.
    rows, cols = (min(isqrt(limit), length - 1) for length in (grid.rows, grid.cols))
    return [
        (down, right)
        for down in range(rows + 1)
        for right in range(-cols, cols + 1)
        if (down, right) > (0, 0) and down * down + right * right <= limit
    ]


def _looks(
    grid: Grid, offsets: Iterable[Cell]
) -> Iterator[tuple[tuple[slice, slice], tuple[slice, slice], Mask]]:
    """Yield for each offset the cells it stays on the grid from, where it leads, and who sees whom."""
    free = _free(grid)
    for down, right in offsets:
        here, there = _overlap(grid.rows, grid.cols, down, right)
        clear = free[here] & free[there]
        for cell, *others in gaps_to(down, right):
            passable = _shifted(free, here, cell)
            for other in others:
                passable = passable | _shifted(free, here, other)
            clear &= passable
        yield here, there, clear


class Choice(NamedTuple):
    """What is to be covered, and from where.

    Attributes:
        reach: how far a parent sees.
        sights: who sees whom.
        vertices: how many there are, the paper's P.
        parents: where a parent has to stand to see them all, in the order chosen; the paper's Q many.
        los_max, los_sum: vertices in sight of a vertex, itself included: the most, and of all together.
    """

    reach: Reach
    sights: Views
    vertices: int
    parents: list[Cell]
    los_max: int
    los_sum: int


def choose(grid: Grid, reach: Reach, start: Cell | None = None) -> Choice:
    """Choose where a parent has to stand to see one connected part of a grid.

    Args:
        grid: the map; at least one cell is free.
        reach: how far a parent sees; neighbours at least.
        start: a free cell of the part; ``None``: the largest part, of equals the first row by row.
    """
    sights = Views(grid, reach.limit)
    part = np.zeros_like(sights.free)
    rows, cols = zip(*(grid.reachable([start]) if start else _largest(grid)), strict=True)
    part[list(rows), list(cols)] = True
    counts = counts_in_sight(grid, reach.limit)[part]
    return Choice(
        reach,
        sights,
        int(part.sum()),
        parent_vertices(sights, reach.near, part),
        int(counts.max()),
        int(counts.sum()),
    )


def _largest(grid: Grid) -> set[Cell]:
    """Return the largest connected part of a grid."""
    seen: set[Cell] = set()
    best: set[Cell] = set()
    for cell in grid.free_cells():
        if cell not in seen:
            part = grid.reachable([cell])
            seen |= part
            best = max(best, part, key=len)
    return best


def parent_vertices(sights: Views, near: int, part: Mask) -> list[Cell]:
    """Choose vertices from which all are seen, by the paper's greedy rule.

    Args:
        sights: who sees whom.
        near: the largest squared distance to a parent vertex chosen before.
        part: the vertices to see: connected parts as a whole, as nobody sees from one into another.

    Returns:
        The vertices in the order chosen.
    """
    return _Choice(sights, near, part).all()


class _Choice:
    """The vertices left to see, and what each vertex is worth.

    Attributes:
        weights: what a parent there would be worth, w(v).
    """

    def __init__(self, sights: Views, near: int, part: Mask) -> None:
        self._sights = sights
        self._most = near
        self._left = part.copy()
        self._rows, self._cols = part.shape
        self._near = np.zeros_like(part)
        # Neighbours left of each vertex, within a border of one cell.
        self._neighbours = np.zeros((self._rows + 2, self._cols + 2), dtype=np.int64)
        for row, col in np.argwhere(part).tolist():
            self._neighbours[row : row + 3, col : col + 3] += 1
        self._neighbours[1:-1, 1:-1] -= part
        values = (self._neighbours[1:-1, 1:-1] - 9) ** 2
        self._values: Numbers = np.where(part, values, 0)
        self.weights = sights.weights(self._values)

    def all(self) -> list[Cell]:
        """Choose until nothing is left."""
        chosen: list[Cell] = []
        while self._left.any():
            candidates = self._left & self._near
            if not candidates.any():
                candidates = self._left
            # Of equals the first, row by row.
            best = int(np.where(candidates, self.weights, -1).argmax())
            chosen.append(divmod(best, self._cols))
            self.choose(chosen[-1])
        return chosen

    def choose(self, cell: Cell) -> None:
        """Cover what a vertex sees."""
        rows, cols = self._sights.seen_from(cell)
        new = self._left[rows, cols]
        rows, cols = rows[new], cols[new]
        self._left[rows, cols] = False
        for row, col in zip(rows.tolist(), cols.tolist(), strict=True):
            self._neighbours[row : row + 3, col : col + 3] -= 1
            self._neighbours[row + 1, col + 1] += 1
        # Only what was seen now, and what lies beside it, has another value.
        top, bottom = max(0, int(rows.min()) - 1), int(rows.max()) + 2
        west, east = max(0, int(cols.min()) - 1), int(cols.max()) + 2
        around = slice(top, bottom), slice(west, east)
        counts = self._neighbours[1:-1, 1:-1][around]
        values = np.where(self._left[around], (counts - 9) ** 2, 0)
        changes = values - self._values[around]
        self._values[around] = values
        for row, col in np.argwhere(changes).tolist():
            seen = self._sights.seen_from((row + top, col + west))
            self.weights[seen] += changes[row, col]
        self._draw_near(cell)

    def _draw_near(self, cell: Cell) -> None:
        """Let all cells within f of a chosen vertex be candidates."""
        most, (middle, col) = self._most, cell
        far = isqrt(most)
        for row in range(max(0, middle - far), min(self._rows, middle + far + 1)):
            right = isqrt(most - (row - middle) ** 2)
            self._near[row, max(0, col - right) : col + right + 1] = True


def _overlap(
    rows: int, cols: int, down: int, right: int
) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Return the cells from which an offset stays on the grid, and the cells that it leads to."""
    here = (
        slice(max(0, -down), rows - max(0, down)),
        slice(max(0, -right), cols - max(0, right)),
    )
    there = slice(max(0, down), rows + min(0, down)), slice(max(0, right), cols + min(0, right))
    return here, there


def _shifted(cells: Mask, here: tuple[slice, slice], offset: Cell) -> Mask:
    """Return what stands at an offset from some cells, on the grid from all of them."""
    rows, cols = here
    down, right = offset
    return cells[rows.start + down : rows.stop + down, cols.start + right : cols.stop + right]
