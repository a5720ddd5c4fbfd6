"""Generated grids: scattered obstacles, an office, a warehouse, rectangles.

Sizes are in coarse cells, and what is blocked are whole coarse cells; the grid that comes out has
two by two sub-cells for each. Only `rectangles` draws sub-cells. Every function is pure: the same
arguments, with a random source in the same state, give the same grid. In all of them the free coarse
cells (of `rectangles` the free sub-cells) are connected.
"""

from collections import deque
from collections.abc import Iterator
from random import Random

from protocol.grid import STEPS, Cell, Grid

ROOM_LEAST = 3
"""Least side of a room."""
ROOM_MOST = 9
"""Longest side of a room that a coin may leave undivided."""
RACK_LENGTH = 8
"""Cells of a rack from one cross aisle of a warehouse to the next."""
SIDE_MOST = 8
"""Longest side of one of `rectangles`."""
RATIO_MOST = 0.75
"""Largest part of the area that `rectangles` block; beyond, nearly all are rejected."""

_Floor = list[bytearray]
"""A row of bytes for each row of coarse cells, 1 where one is blocked."""


def random_obstacles(rows: int, cols: int, obstacles: int, rng: Random) -> Grid:
    """Block coarse cells one after another, drawn uniformly among those that cut nothing off.

    A cell that would cut the free cells in two is passed over, and drawn again once all others
    have had their turn.

    Args:
        rows: Coarse cells from top to bottom, at least 1.
        cols: Coarse cells from left to right, at least 1.
        obstacles: Coarse cells to block, fewer than there are.
        rng: Source of the order in which cells are tried.

    Returns:
        The grid; its free coarse cells are connected.

    Raises:
        ValueError: If a size is too small, or ``obstacles`` leaves no cell or is negative.

    Paper:
        Agmon et al. 2008, Sec. 3.3.2: 40 to 160 obstacles added at random to 20 x 30 coarse cells
        without disconnecting them. How they are drawn is not given.
    """
    floor = _empty(rows, cols)
    if not 0 <= obstacles < rows * cols:
        raise ValueError(f"obstacles: found {obstacles}, expected 0 to {rows * cols - 1}")
    left = obstacles
    candidates = [(row, col) for row in range(rows) for col in range(cols)]
    passed_over: dict[Cell, list[Cell]] = {}
    while left:
        # Of two connected cells or more at least two can go: so each round blocks some.
        rng.shuffle(candidates)
        for cell in candidates:
            # What a cell would cut off is there until the last of it, a neighbour, is blocked.
            neighbours = _free_neighbours(floor, cell)
            if not left or passed_over.get(cell) == neighbours:
                continue
            if _cuts(floor, cell, neighbours):
                passed_over[cell] = neighbours
            else:
                floor[cell[0]][cell[1]] = 1
                left -= 1
        candidates = [cell for cell in candidates if not _is_blocked(floor, *cell)]
    return _grid(floor)


def rooms(rows: int, cols: int, rng: Random) -> Grid:
    """Build the floor of an office: rooms behind walls with doors, and furniture in the rooms.

    Rooms come about by recursive division. A wall is one coarse cell thick and has a door, a long
    wall two, each one or two cells wide.

    Args:
        rows: Coarse cells from top to bottom, at least 1.
        cols: Coarse cells from left to right, at least 1.
        rng: Source of walls, doors and furniture.

    Returns:
        The grid; its free coarse cells are connected.

    Raises:
        ValueError: If a size is too small.
    """
    floor = _empty(rows, cols)
    todo = [(0, 0, rows, cols)]
    while todo:
        room = todo.pop()
        halves = _divide(floor, room, rng)
        if halves:
            todo += halves
        else:
            _furnish(floor, room, rng)
    return _grid(floor)


def warehouse(rows: int, cols: int) -> Grid:
    """Build the floor of a warehouse: rows of racks, with aisles between them and all around.

    Args:
        rows: Coarse cells from top to bottom, at least 1.
        cols: Coarse cells from left to right, at least 1.

    Returns:
        The grid: racks one coarse cell deep and up to `RACK_LENGTH` long, aisles one cell wide.

    Raises:
        ValueError: If a size is too small.
    """
    floor = _empty(rows, cols)
    for row in range(1, rows - 1, 2):
        for col in range(1, cols - 1):
            floor[row][col] = col % (RACK_LENGTH + 1) != 0
    return _grid(floor)


def rectangles(rows: int, cols: int, ratio: float, rng: Random) -> Grid:
    """Block rectangles one after another until they fill a part of the area.

    They may overlap. One that would cut the free sub-cells in two is rejected.

    Args:
        rows: Sub-cells from top to bottom, at least 1.
        cols: Sub-cells from left to right, at least 1.
        ratio: Part of the area that is blocked at least, 0 to `RATIO_MOST`; the last rectangle may
            block more, and one sub-cell always stays free.
        rng: Source of sides and places.

    Returns:
        The grid; its free sub-cells are connected.

    Raises:
        ValueError: If a size is too small, or the ratio is out of range.

    Paper:
        The parent-child paper, Sec. 5: "we added obstacles in different sizes" up to 20 and 35 %. How
        they are drawn is not given; here sides are uniform from 1 to `SIDE_MOST`.
    """
    floor = _empty(rows, cols)
    if not 0 <= ratio <= RATIO_MOST:
        raise ValueError(f"ratio: found {ratio:g}, expected 0 to {RATIO_MOST:g}")
    blocked, enough = 0, min(ratio * rows * cols, rows * cols - 1)
    while blocked < enough:
        height, width = rng.randint(1, min(SIDE_MOST, rows)), rng.randint(1, min(SIDE_MOST, cols))
        top, left = rng.randint(0, rows - height), rng.randint(0, cols - width)
        blocked += _block(floor, top, left, height, width, rows * cols - blocked)
    return Grid(rows, cols, b"".join(floor))


def _block(floor: _Floor, top: int, left: int, height: int, width: int, free: int) -> int:
    """Block a rectangle unless it cuts something off or leaves nothing; return what it took."""
    inside = [
        (row, col)
        for row in range(top, top + height)
        for col in range(left, left + width)
        if not floor[row][col]
    ]
    if len(inside) == free:
        return 0
    arcs = _arcs(floor, top, left, height, width)
    for row, col in inside:
        floor[row][col] = 1
    if arcs > 1:
        ring = _ring(top, left, height, width)
        beside = [cell for cell, touches in ring if touches and not _is_blocked(floor, *cell)]
        if _are_apart(floor, beside):
            for row, col in inside:
                floor[row][col] = 0
            return 0
    return len(inside)


_Room = tuple[int, int, int, int]
"""Top, left, and the first row and column behind it."""


def _divide(floor: _Floor, room: _Room, rng: Random) -> list[_Room]:
    """Build a wall across a room; return the two rooms there are now, none if it stays whole."""
    top, left, bottom, right = room
    height, width = bottom - top, right - left
    if max(height, width) < 2 * ROOM_LEAST + 1:
        return []
    if max(height, width) <= ROOM_MOST and rng.random() < 0.5:
        return []
    across = height > width or (height == width and rng.random() < 0.5)
    near, far = (top, bottom) if across else (left, right)
    # A wall must not end in a door.
    places = [
        at
        for at in range(near + ROOM_LEAST, far - ROOM_LEAST)
        if all(_is_blocked(floor, *end) for end in _ends(room, at, across=across))
    ]
    if not places:
        return []
    at = rng.choice(places)
    wall = (
        [(at, col) for col in range(left, right)]
        if across
        else [(row, at) for row in range(top, bottom)]
    )
    for row, col in wall:
        floor[row][col] = 1
    for _ in range(2 if len(wall) > ROOM_MOST else 1):
        wide = min(rng.randint(1, 2), len(wall))
        first = rng.randint(0, len(wall) - wide)
        for row, col in wall[first : first + wide]:
            floor[row][col] = 0
    if across:
        return [(top, left, at, right), (at + 1, left, bottom, right)]
    return [(top, left, bottom, at), (top, at + 1, bottom, right)]


def _ends(room: _Room, at: int, *, across: bool) -> tuple[Cell, Cell]:
    """Return the cells that a wall at row or column ``at`` would run into."""
    top, left, bottom, right = room
    return ((at, left - 1), (at, right)) if across else ((top - 1, at), (bottom, at))


def _furnish(floor: _Floor, room: _Room, rng: Random) -> None:
    """Put rectangles into a room wherever they cut nothing off."""
    top, left, bottom, right = room
    for _ in range((bottom - top) * (right - left) // 12):
        height, width = rng.choice(((1, 1), (1, 2), (2, 1), (1, 3), (3, 1), (2, 2)))
        if bottom - top < height or right - left < width:
            continue
        row = rng.randint(top, bottom - height)
        col = rng.randint(left, right - width)
        cells = [(row + down, col + over) for down in range(height) for over in range(width)]
        if (
            not any(floor[row][col] for row, col in cells)
            and _arcs(floor, row, col, height, width) == 1
        ):
            for row, col in cells:
                floor[row][col] = 1


def _free_neighbours(floor: _Floor, cell: Cell) -> list[Cell]:
    around = [(cell[0] + down, cell[1] + right) for down, right in STEPS]
    return [neighbour for neighbour in around if not _is_blocked(floor, *neighbour)]


def _cuts(floor: _Floor, cell: Cell, neighbours: list[Cell]) -> bool:
    """Tell whether blocking a free cell would cut the free cells in two, or leave none."""
    arcs = _arcs(floor, *cell, 1, 1)
    if arcs <= 1:
        return arcs == 0  # only the last free cell of all has no free neighbour
    # The cell parts its surroundings; they may still meet somewhere else.
    floor[cell[0]][cell[1]] = 1
    apart = _are_apart(floor, neighbours)
    floor[cell[0]][cell[1]] = 0
    return apart


def _are_apart(floor: _Floor, cells: list[Cell]) -> bool:
    """Tell whether not all of some free cells are connected.

    Searches from all of them take turns, so that a small part that is cut off costs little, however
    large the other is.
    """
    owner = {cell: search for search, cell in enumerate(cells)}
    fronts = [deque([cell]) for cell in cells]
    parts = list(range(len(cells)))  # searches that have met are one part, under one number
    while len(set(parts)) > 1:
        for part in range(len(parts)):
            if part not in parts:
                continue
            if not fronts[part]:
                return True
            for step in _free_neighbours(floor, fronts[part].popleft()):
                if step not in owner:
                    owner[step] = part
                    fronts[part].append(step)
                elif (other := parts[owner[step]]) != part:
                    fronts[part] += fronts[other]
                    parts = [part if number == other else number for number in parts]
    return False


def _arcs(floor: _Floor, row: int, col: int, height: int, width: int) -> int:
    """Count the stretches of free cells around a rectangle that touch one of its sides.

    If there is one, blocking the rectangle cuts nothing off: whoever went through it can go around.
    """
    ring = list(_ring(row, col, height, width))
    free = [not _is_blocked(floor, *cell) for cell, _ in ring]
    if all(free):
        return 1
    start = free.index(False)
    arcs, touches = 0, False
    for index in range(start, start + len(ring) + 1):
        at = index % len(ring)
        if free[at]:
            touches = touches or ring[at][1]
        else:
            arcs += touches
            touches = False
    return arcs


def _ring(row: int, col: int, height: int, width: int) -> Iterator[tuple[Cell, bool]]:
    """Walk around a rectangle; yield each cell, and whether it touches a side of it."""
    top, left, bottom, right = row - 1, col - 1, row + height, col + width
    for at in range(left, right):
        yield (top, at), at != left
    for at in range(top, bottom):
        yield (at, right), at != top
    for at in range(right, left, -1):
        yield (bottom, at), at != right
    for at in range(bottom, top, -1):
        yield (at, left), at != bottom


def _is_blocked(floor: _Floor, row: int, col: int) -> bool:
    """Tell whether a coarse cell is blocked or lies outside."""
    return not (0 <= row < len(floor) and 0 <= col < len(floor[0])) or floor[row][col] != 0


def _empty(rows: int, cols: int) -> _Floor:
    for name, found in (("rows", rows), ("cols", cols)):
        if found < 1:
            raise ValueError(f"{name}: found {found}, expected at least 1")
    return [bytearray(cols) for _ in range(rows)]


def _grid(floor: _Floor) -> Grid:
    """Split each coarse cell into its four sub-cells."""
    doubled = (bytes(bit for bit in row for _ in range(2)) for row in floor)
    return Grid(2 * len(floor), 2 * len(floor[0]), b"".join(row * 2 for row in doubled))
