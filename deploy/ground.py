"""The ground of a run: the graph or grid that a scenario names, and where on it the robots start."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from msgspec import Struct

from protocol.errors import ScenarioError
from protocol.graph import PortGraph
from protocol.grid import Cell, Grid, sub_cells
from protocol.scenario import (
    Cave,
    LongTree,
    NaryTree,
    RandomGraph,
    RandomObstacles,
    RandomTree,
    Rectangles,
    Rooms,
    Scenario,
    Warehouse,
    WideTree,
)
from protocol.section import Start
from protocol.seeds import spawn
from world_server.maps import GridFile, generated_grids, generators, read_map

Ground = PortGraph | Grid


class Started(Struct, frozen=True):
    """A ground on which the robots have a place to start.

    Attributes:
        ground: the graph, reduced to the component of the start, or the grid.
        starts: start place of each robot.
        to_cover: how many places can be reached from there.
        notes: what the user should know, a line each.
    """

    ground: Ground
    starts: tuple[int, ...]
    to_cover: int
    notes: tuple[str, ...] = ()


def ground_of(scenario: Scenario) -> tuple[Ground, tuple[str, ...]]:
    """Read or generate the whole ground, and say what the user should know of it.

    A grid stays one unless the scenario says ``world.ground = "graph"``.

    Raises:
        ScenarioError: If a generator's parameters do not fit, or the map is not what is asked for.
        MapError: If the map cannot be read.
    """
    world = scenario.world
    ground: Ground
    notes: tuple[str, ...] = ()
    if world.map is None:
        ground = _generated(scenario)
    else:
        found = read_map(Path(world.map), cell_m=world.cell_m, resolution_m=world.resolution_m)
        if isinstance(found, GridFile):
            ground, notes = found.grid, found.notes
        else:
            ground = found
    if isinstance(ground, Grid):
        return (graph_of(ground) if world.ground == "graph" else ground), notes
    if world.ground == "grid":
        raise ScenarioError("field `world.ground`: found 'grid'; the map is a graph")
    for field, value in (("cell_m", world.cell_m), ("resolution_m", world.resolution_m)):
        if value is not None:
            raise ScenarioError(f"field `world.{field}`: found {value!r}, which is for grids only")
    return ground, notes


def graph_of(grid: Grid) -> PortGraph:
    """Return the free sub-cells as vertices, called ``"row,column"``, and an edge between neighbours.

    Those of the largest part come first, row by row. Edges are as long as a sub-cell is wide.
    """
    parts = parts_of(grid.free_cells(), grid.reachable)
    number = {cell: vertex for vertex, cell in enumerate(cell for part in parts for cell in part)}
    ends = [
        (vertex, number[beside])
        for (row, col), vertex in number.items()
        for beside in ((row, col + 1), (row + 1, col))
        if beside in number
    ]
    return PortGraph(
        [f"{row},{col}" for row, col in number],
        ends,
        [grid.cell_m] * len(ends),
        [(float(col), -float(row)) for row, col in number],
    )


def _generated(scenario: Scenario) -> Ground:
    """Generate the ground, sub-cells as wide as the scenario says.

    Raises:
        ScenarioError: If the parameters do not fit.
    """
    world = scenario.world
    try:
        ground = _drawn_by_generator(scenario)
    except ValueError as error:
        raise ScenarioError(f"field `world.generate`: {error}") from None
    if isinstance(ground, Grid):
        if world.resolution_m is not None:
            raise ScenarioError(
                f"field `world.resolution_m`: found {world.resolution_m}, which is for map files "
                "only; expected `world.cell_m`"
            )
        if world.cell_m is not None:
            ground = Grid(ground.rows, ground.cols, ground.cells(), world.cell_m)
    return ground


def _drawn_by_generator(scenario: Scenario) -> Ground:
    """Generate the ground.

    Raises:
        ValueError: If the parameters do not fit.
    """
    rng = spawn(scenario.seed, "world")
    match scenario.world.generate:
        case NaryTree(branching=branching, radius=radius):
            return generators.nary_tree(branching, radius)
        case RandomTree(vertices=vertices):
            return generators.random_tree(vertices, rng)
        case WideTree(edges=edges):
            return generators.wide_tree(edges, rng)
        case LongTree(edges=edges):
            return generators.long_tree(edges, rng)
        case RandomGraph(vertices=vertices, edges=edges):
            return generators.random_graph(vertices, edges, rng)
        case Cave(vertices=vertices, loops=loops):
            return generators.cave(vertices, loops, rng)
        case RandomObstacles(rows=rows, cols=cols, obstacles=obstacles):
            return generated_grids.random_obstacles(rows, cols, obstacles, rng)
        case Rooms(rows=rows, cols=cols):
            return generated_grids.rooms(rows, cols, rng)
        case Warehouse(rows=rows, cols=cols):
            return generated_grids.warehouse(rows, cols)
        case Rectangles(rows=rows, cols=cols, ratio=ratio):
            return generated_grids.rectangles(rows, cols, ratio, rng)
        case None:
            raise AssertionError("a scenario has a map or a generator")


def starts_on(
    ground: Ground, scenario: Scenario, *, cells: bool, together: bool = False
) -> Started:
    """Find the start of each robot.

    Args:
        ground: the whole of it.
        scenario: says where they start.
        cells: whether the algorithm covers complete coarse cells only.
        together: whether all start on one sub-cell of a grid where the scenario does not say it.

    Raises:
        ScenarioError: If a robot cannot start there.
    """
    if isinstance(ground, Grid):
        return _on_grid(ground, scenario, cells=cells, together=together)
    return _on_graph(ground, scenario)


def place_of(ground: Ground, name: Start, field: str) -> int:
    """Return the number of the vertex or sub-cell that a field of the scenario names.

    Raises:
        ScenarioError: If there is no such place.
    """
    if isinstance(ground, Grid):
        return ground.place(*_sub_cell(ground, name, field, cells=False))
    return _vertex(ground, name, field)


# Graphs.


def _on_graph(whole: PortGraph, scenario: Scenario) -> Started:
    starts = _vertices(scenario, whole)
    graph = whole.component(starts[0])
    if graph is whole:
        return Started(graph, starts, len(graph.names))
    distance = whole.distances(starts[0])
    for robot, start in enumerate(starts):
        if distance[start] < 0:
            raise ScenarioError(
                f"field `world.starts[{robot}]`: vertex {whole.names[start]!r} cannot be reached "
                f"from {whole.names[starts[0]]!r}; expected one component"
            )
    starts = tuple(graph.vertex(whole.names[start]) for start in starts)
    note = (
        f"the map has several components; playing the one of {graph.names[starts[0]]!r}: "
        f"{len(graph.names)} of {len(whole.names)} vertices"
    )
    return Started(graph, starts, len(graph.names), (note,))


def _vertices(scenario: Scenario, graph: PortGraph) -> tuple[int, ...]:
    world = scenario.world
    if isinstance(world.starts, tuple):
        return tuple(
            _vertex(graph, name, f"world.starts[{robot}]")
            for robot, name in enumerate(world.starts)
        )
    start = 0 if world.start is None else _vertex(graph, world.start, "world.start")
    return (start,) * scenario.team.robots


def _vertex(graph: PortGraph, name: Start, field: str) -> int:
    called = f"{name[0]},{name[1]}" if isinstance(name, tuple) else str(name)
    try:
        return graph.vertex(called)
    except KeyError:
        some = ", ".join(map(repr, graph.names[:3]))
        raise ScenarioError(
            f"field `{field}`: found {name!r}, expected the name of a vertex, such as {some}"
        ) from None


# Grids.


def _on_grid(grid: Grid, scenario: Scenario, *, cells: bool, together: bool) -> Started:
    world, robots = scenario.world, scenario.team.robots
    if isinstance(world.starts, tuple):
        starts = [
            _sub_cell(grid, start, f"world.starts[{robot}]", cells=cells)
            for robot, start in enumerate(world.starts)
        ]
    elif world.start is not None:
        starts = [_sub_cell(grid, world.start, "world.start", cells=cells)] * robots
    elif together and world.starts is None:
        starts = _drawn(grid, scenario, 1, cells=cells) * robots
    else:
        starts = _drawn(grid, scenario, robots, cells=cells)
    one_each = cells or world.bodies == "block"
    if one_each and len(set(starts)) < robots:
        field = "world.start" if world.start is not None else "world.starts"
        twice = next(start for start in starts if starts.count(start) > 1)
        raise ScenarioError(
            f"field `{field}`: several robots start on sub-cell {list(twice)}; expected one each"
        )
    reached = reach_of(grid, starts, cells=cells)
    whole = 4 * len(grid.complete_cells()) if cells else len(grid.free_cells())
    notes = []
    if len(reached) < whole:
        kind = "sub-cells of complete coarse cells" if cells else "free sub-cells"
        notes.append(f"{len(reached)} of {whole} {kind} can be reached from the starts")
    return Started(grid, tuple(grid.place(*start) for start in starts), len(reached), tuple(notes))


def reach_of(grid: Grid, starts: Sequence[Cell], *, cells: bool) -> set[Cell]:
    """Return the sub-cells that robots can reach: all, or those of complete coarse cells only."""
    if not cells:
        return grid.reachable(starts)
    coarse = grid.reachable_cells((row // 2, col // 2) for row, col in starts)
    return {sub_cell for cell in coarse for sub_cell in sub_cells(cell)}


def _drawn(grid: Grid, scenario: Scenario, robots: int, *, cells: bool) -> list[Cell]:
    """Draw a start for each robot, no two alike, in the largest part of the grid that holds them.

    A team that no part holds starts in several: the largest, and the next ones as far as needed.
    """
    if cells:
        parts = parts_of(grid.complete_cells(), grid.reachable_cells)
    else:
        parts = parts_of(grid.free_cells(), grid.reachable)
    among: list[Cell] = []
    for part in parts:
        if len(among) >= robots:
            break
        among += (one for cell in part for one in (sub_cells(cell) if cells else (cell,)))
    if len(among) < robots:
        kind = "sub-cells of complete coarse cells" if cells else "free sub-cells"
        raise ScenarioError(f"field `team.robots`: found {robots}; there are {len(among)} {kind}")
    return spawn(scenario.seed, "starts").sample(among, robots)


def parts_of(
    cells: Iterable[Cell], reachable: Callable[[Sequence[Cell]], set[Cell]]
) -> list[list[Cell]]:
    """Divide cells into those that can be reached from each other; the largest part comes first."""
    seen: set[Cell] = set()
    parts: list[list[Cell]] = []
    for cell in cells:
        if cell not in seen:
            part = reachable([cell])
            parts.append(sorted(part))
            seen |= part
    return sorted(parts, key=len, reverse=True)


def _sub_cell(grid: Grid, start: Start, field: str, *, cells: bool) -> Cell:
    found = start if isinstance(start, tuple) else _read(str(start))
    expected = f"[row, column] within {grid.rows} x {grid.cols} sub-cells"
    if found is None or not (0 <= found[0] < grid.rows and 0 <= found[1] < grid.cols):
        shown = list(start) if isinstance(start, tuple) else repr(start)
        raise ScenarioError(f"field `{field}`: found {shown}, expected {expected}")
    if not grid.is_free(*found):
        raise ScenarioError(f"field `{field}`: sub-cell {list(found)} is blocked")
    if cells and not grid.is_complete(found[0] // 2, found[1] // 2):
        raise ScenarioError(
            f"field `{field}`: sub-cell {list(found)} lies in a coarse cell that is partly blocked; "
            f"expected one in a free coarse cell (2 x 2, aligned to even rows and columns)"
        )
    return found


def _read(text: str) -> Cell | None:
    """Read a sub-cell written as ``"row, column"``."""
    parts = text.strip("[] ").split(",")
    if len(parts) == 2 and all(part.strip().isdecimal() for part in parts):
        return int(parts[0]), int(parts[1])
    return None
