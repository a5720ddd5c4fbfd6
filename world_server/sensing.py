"""Sensing on grids: what a robot perceives of the cells around it. The rest never reaches it.

Each mode gives bytes, one a cell: ``.`` free, ``#`` blocked, ``?`` not sensed.

    ahead           one coarse cell: the neighbour of the robot's own in the direction of its gaze
    three           three of them: to the left, ahead, to the right (Agmon et al. 2008, Sec. 4.1)
    radius          a square of sub-cells around the robot, row by row; those within the range
    line-of-sight   the same; those that no obstacle hides

A coarse cell is sensed as free if all of it is. A robot finds its own coarse cell by its position;
where it is mistaken about that it looks at the wrong one.
"""

from collections.abc import Callable, Iterable
from functools import lru_cache, reduce
from itertools import compress
from math import floor
from operator import or_

from protocol.grid import STEPS, Cell, Grid
from protocol.line_of_sight import gaps_to
from protocol.scenario import SensingSection

See = Callable[[int, Cell, int | None], bytes]
"""What is seen from a place, by a robot that takes it for a position, in a direction (or none)."""


def seer(grid: Grid, sensing: SensingSection) -> tuple[See, int]:
    """Return what a robot sees on ``grid``, and the side of the square that it sees, sub-cells."""
    if sensing.mode in ("radius", "line-of-sight"):
        assert sensing.range_m is not None
        return _square(grid, in_sub_cells(sensing.range_m, grid), hidden=sensing.mode != "radius")
    mistaken = sensing.position == "odometry"
    look = _relative(grid) if mistaken else _absolute(grid)
    if sensing.mode == "ahead":
        return look, 0

    def three(place: int, position: Cell, gaze: int | None) -> bytes:
        if gaze is None:
            return b"???"
        sides = ((gaze + 3) % 4, gaze, (gaze + 1) % 4)
        return b"".join(look(place, position, side) for side in sides)

    return three, 0


def in_sub_cells(length_m: float, grid: Grid) -> float:
    """Return a length in sides of a sub-cell, less rounding: 0.3 m are three of 0.1 m."""
    return round(length_m / grid.cell_m, 9)


def _absolute(grid: Grid) -> See:
    """Look at coarse cells by their own numbers: for robots that know where they are."""
    rows, cols = grid.rows // 2, grid.cols // 2
    # A border of blocked cells, as in `Grid`; twice, for the sub-cells of an odd last row or column.
    stride = cols + 2
    seen = [b"#"] * ((rows + 2) * stride)
    for row, col in grid.complete_cells():
        seen[row * stride + col] = b"."
    step = [down * stride + right for down, right in STEPS]

    def look(place: int, position: Cell, gaze: int | None) -> bytes:  # noqa: ARG001  a See
        if gaze is None:
            return b"?"
        return seen[(position[0] >> 1) * stride + (position[1] >> 1) + step[gaze]]

    return look


def _relative(grid: Grid) -> See:
    """Look at coarse cells where a robot believes them to be."""

    def look(place: int, position: Cell, gaze: int | None) -> bytes:
        if gaze is None:
            return b"?"
        row, col = grid.position(place)
        down, right = STEPS[gaze]
        row += 2 * down - position[0] % 2
        col += 2 * right - position[1] % 2
        free = all(grid.is_free(row + south, col + east) for south in (0, 1) for east in (0, 1))
        return b"." if free else b"#"

    return look


def _square(grid: Grid, range_cells: float, *, hidden: bool) -> tuple[See, int]:
    """Look at the sub-cells around a robot, all of them at once.

    A set of sub-cells of the square is an integer, a bit each, the first one highest. From the middle
    each obstacle hides the same ones, wherever the middle is: what is hidden is the union over the
    obstacles in the square.
    """
    reach = floor(range_cells)
    side = 2 * reach + 1
    area = side * side
    # No line gets beyond the first blocked cells off the grid, so that these need hide nothing.
    lines = _framed(grid, reach, b"?" if hidden else b"#")
    far, shadows, corners = _shadows(range_cells) if hidden else (_beyond(range_cells), [], [])
    digits = f"0{area}b"
    stride = grid.stride

    def seen(place: int) -> bytes:
        row, col = divmod(place, stride)
        marks = b"".join([line[col : col + side] for line in lines[row : row + side]])
        blocked = marks.translate(_BLOCKED)
        unseen = reduce(or_, compress(shadows, blocked), far)
        for one, other, behind in corners:
            if blocked[one] and blocked[other]:
                unseen |= behind
        # In bits ? has all those of . and of #, so that it covers them.
        veil = format(unseen, digits).encode().translate(_VEIL)
        return (int.from_bytes(marks) | int.from_bytes(veil)).to_bytes(area)

    remembered = lru_cache(maxsize=_CACHE_BYTES // (area + 200))(seen)

    def look(place: int, position: Cell, gaze: int | None) -> bytes:  # noqa: ARG001  a See
        return remembered(place)

    return look, side


_CACHE_BYTES = 1 << 23
"""About as much a world keeps of what is seen from the places looked from last."""

_BLOCKED = bytes(mark == ord("#") for mark in range(256))
_VEIL = bytes(ord("?") if mark == ord("1") else 0 for mark in range(256))


def _framed(grid: Grid, reach: int, beyond: bytes) -> list[bytes]:
    """Return the rows of a grid as marks, in a frame as wide as the reach: blocked, then others."""
    cells = grid.cells().translate(bytes([ord("."), *[ord("#")] * 255]))
    margin = (b"#" + beyond * reach)[:reach]
    starts = range(0, len(cells), grid.cols)
    rows = [margin[::-1] + cells[at : at + grid.cols] + margin for at in starts]
    rim = margin[::-1] + b"#" * grid.cols + margin
    outside = ([rim] + [beyond * len(rim)] * reach)[:reach]
    return [*outside[::-1], *rows, *outside]


@lru_cache(maxsize=4)
def _shadows(range_cells: float) -> tuple[int, list[int], list[tuple[int, int, int]]]:
    """Return what is hidden from the middle of a square.

    Returns:
        What is out of range; what each cell of the square hides if it is blocked; and what each two
        cells that touch at a corner hide if both are, with their numbers, where that is anything.
    """
    reach = floor(range_cells)
    side = 2 * reach + 1
    area, middle = side * side, reach * side + reach
    behind: list[list[int]] = [[] for _ in range(area)]
    behind_corner: dict[tuple[int, int], list[int]] = {}
    # An eighth of the square tells the rest: turned and mirrored, all is the same.
    turns = [(s * a, t * b) for a, b in ((side, 1), (1, side)) for s in (-1, 1) for t in (-1, 1)]
    for down in range(1, reach + 1):
        for right in range(down + 1):
            if down * down + right * right > range_cells * range_cells:
                break
            gaps = gaps_to(down, right)
            for row, col in turns:
                target = middle + down * row + right * col
                for (one, other), *more in gaps:
                    number = middle + one * row + other * col
                    if not more:
                        behind[number].append(target)
                    for one_more, other_more in more:
                        beside = middle + one_more * row + other_more * col
                        pair = min(number, beside), max(number, beside)
                        behind_corner.setdefault(pair, []).append(target)
    return (
        _beyond(range_cells),
        [_set_of(cells, area) for cells in behind],
        [(*pair, _set_of(cells, area)) for pair, cells in behind_corner.items()],
    )


def _beyond(range_cells: float) -> int:
    """Return the sub-cells of a square that are out of range."""
    reach = floor(range_cells)
    ahead = range(-reach, reach + 1)
    squares = [down * down + right * right for down in ahead for right in ahead]
    squared = range_cells * range_cells
    return _set_of([index for index, one in enumerate(squares) if one > squared], len(squares))


def _set_of(cells: Iterable[int], area: int) -> int:
    """Return a set of sub-cells of a square as an integer."""
    bits = bytearray(-(-area // 8))
    for cell in cells:
        bits[cell >> 3] |= 128 >> (cell & 7)
    return int.from_bytes(bits) >> (-area % 8)
