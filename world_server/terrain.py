"""Motion and sensing: where a robot gets to when it leaves a place, and what it perceives there.

On a graph with opaque passages a robot senses how many ports its vertex has, and learns the far end
of one only by going (Brass et al. 2011, Sec. I). On a grid it steps north, east, south or west, and
senses cells around it; who steps against a blocked cell comes back by the exit it took.
"""

from collections.abc import Callable, Collection, Sequence
from zlib import compress

from protocol.errors import ExitError
from protocol.graph import PortGraph
from protocol.grid import EAST, NORTH, SOUTH, WEST, Cell, Grid
from protocol.messages import KnownGraph, KnownMap
from protocol.scenario import Scenario
from world_server.sensing import See, seer

Way = tuple[int, int]
"""The place that an exit leads to, and the port by which one arrives there."""


class GraphTerrain:
    """Motion along the edges of a port graph.

    Attributes:
        graph: the graph; its vertices are the places.
        see: what a robot sees besides ports: nothing.
    """

    see: See | None = None
    window = 0
    stride = 1

    def __init__(self, graph: PortGraph) -> None:
        self.graph = graph
        self._ways = graph.ways
        self._degrees = list(map(len, graph.ways))
        self._known: KnownGraph | None = None

    def __len__(self) -> int:
        """Return the number of places."""
        return len(self._ways)

    @property
    def sense(self) -> Callable[[int], int]:
        """What a robot senses at a place: the number of its ports."""
        return self._degrees.__getitem__  # without a Python call: it is on the path of each step

    def leave(self, place: int, exit_: int) -> Way:
        """Return where ``exit_`` of ``place`` leads: the place, and the entry there.

        Raises:
            ExitError: If there is no such exit.
        """
        ways = self._ways[place]
        if 0 <= exit_ < len(ways):
            return ways[exit_]
        raise ExitError(
            f"exit {exit_} at a place with {len(ways)} ports; expected 0 to {len(ways) - 1}"
        )

    def length(self, place: int, exit_: int) -> float | None:
        """Return the length of the edge behind ``exit_`` of ``place``; ``None``: not known."""
        return self.graph.lengths[self.graph.edge_at[place][exit_]]

    def position(self, place: int) -> Cell:
        """Refuse: the vertices of a graph have no position."""
        raise TypeError(f"vertex {place} has no row and column")

    def neighbours(self, place: int) -> Collection[int]:
        """Return the places one edge away."""
        return self.graph.far[place]

    def known_graph(self, starts: tuple[int, ...]) -> KnownGraph:
        """Return what robots that know the map are told: all of it, and where each of them starts."""
        if self._known is None:  # it is long, and the same for all
            self._known = KnownGraph.of(len(self), self.graph.ends, starts)
        return self._known


class GridTerrain:
    """Motion from sub-cell to sub-cell.

    Attributes:
        grid: which sub-cells are blocked.
        see: what a robot sees.
        window: side of the square of sub-cells that it sees; 0 where it sees coarse cells.
        stride: places a row, as of the grid.
    """

    def __init__(self, grid: Grid, scenario: Scenario) -> None:
        self.grid = grid
        self.see, self.window = seer(grid, scenario.sensing)
        self.stride = grid.stride
        self._blocked = grid.blocked
        step_of = {NORTH: -grid.stride, EAST: 1, SOUTH: grid.stride, WEST: -1}
        self._exits = tuple((step_of[exit_], (exit_ + 2) % 4) for exit_ in range(4))

    def __len__(self) -> int:
        """Return the number of places."""
        return len(self._blocked)

    @property
    def sense(self) -> Callable[[int], int]:
        """The number of ports, four everywhere."""
        return _four

    def leave(self, place: int, exit_: int) -> Way:
        """Return where ``exit_`` of ``place`` leads: the place, and the entry there.

        Who bumps against a blocked cell comes back to ``place`` by ``exit_``.

        Raises:
            ExitError: If there is no such exit.
        """
        if not 0 <= exit_ < 4:
            raise ExitError(f"exit {exit_} on a grid; expected 0 (north), 1, 2 or 3 (west)")
        step, entry = self._exits[exit_]
        to = place + step
        return (place, exit_) if self._blocked[to] else (to, entry)

    def length(self, place: int, exit_: int) -> float | None:  # noqa: ARG002  as on a graph
        """Return the side of a sub-cell, metres."""
        return self.grid.cell_m

    def position(self, place: int) -> Cell:
        """Return row and column of a place."""
        return self.grid.position(place)

    def neighbours(self, place: int) -> Collection[int]:
        """Return the places one move away."""
        return {place + step for step, _ in self._exits if not self._blocked[place + step]}

    def known_map(self, starts: Sequence[int]) -> KnownMap:
        """Return what robots that know the map are told: all of it, and where each of them starts."""
        grid = self.grid
        packed = compress(grid.cells())
        return KnownMap(grid.rows, grid.cols, packed, tuple(map(grid.position, starts)))


def _four(place: int) -> int:  # noqa: ARG001  as on a graph
    return 4


Terrain = GraphTerrain | GridTerrain


def terrain_of(ground: PortGraph | Grid, scenario: Scenario) -> Terrain:
    """Build the terrain of a graph or a grid."""
    if isinstance(ground, Grid):
        return GridTerrain(ground, scenario)
    return GraphTerrain(ground)
