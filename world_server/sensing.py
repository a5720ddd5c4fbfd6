"""Sensing on grids: what a robot perceives of the cells around it. The rest never reaches it.

Each mode gives bytes, one a cell: ``.`` free, ``#`` blocked, ``?`` not sensed.

    ahead           one coarse cell: the neighbour of the robot's own in the direction of its gaze
    three           three of them: to the left, ahead, to the right (Agmon et al. 2008, Sec. 4.1)
    radius          a square of sub-cells around the robot, row by row; those within the range
    line-of-sight   the same; those that no obstacle hides

A coarse cell is sensed as free if all of it is. A robot finds its own coarse cell by its position;
where it is mistaken about that it looks at the wrong one.
"""

from collections.abc import Callable
from math import floor

from protocol.grid import STEPS, Cell, Grid
from protocol.line_of_sight import gaps_to, is_clear
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
    reach = floor(range_cells)
    side = 2 * reach + 1
    offsets = [
        (down, right) for down in range(-reach, reach + 1) for right in range(-reach, reach + 1)
    ]
    near = [down * down + right * right <= range_cells * range_cells for down, right in offsets]
    lines = [gaps_to(*offset) if hidden else () for offset in offsets]

    def look(place: int, position: Cell, gaze: int | None) -> bytes:  # noqa: ARG001  a See
        row, col = grid.position(place)
        seen = bytearray(side * side)
        for index, (down, right) in enumerate(offsets):
            if not near[index] or not is_clear(grid, row, col, lines[index]):
                seen[index] = 63  # ?
            else:
                seen[index] = 46 if grid.is_free(row + down, col + right) else 35  # . or #
        return bytes(seen)

    return look, side
