"""Motion: where a robot gets to when it leaves a place, and what it senses there.

A graph with opaque passages: a robot senses how many ports its vertex has and learns the far end of
one only by going (Brass et al. 2011, Sec. I). Other terrains offer the same three methods.
"""

from collections.abc import Callable

from protocol.errors import ExitError
from protocol.graph import PortGraph


class GraphTerrain:
    """Motion along the edges of a port graph.

    Attributes:
        graph: the graph; its vertices are the places.
    """

    def __init__(self, graph: PortGraph) -> None:
        self.graph = graph
        self._ways = graph.ways
        self._degrees = list(map(len, graph.ways))

    def __len__(self) -> int:
        """Return the number of places."""
        return len(self._ways)

    @property
    def sense(self) -> Callable[[int], int]:
        """What a robot senses at a place: the number of its ports."""
        return self._degrees.__getitem__  # without a Python call: it is on the path of each step

    def leave(self, place: int, exit_: int) -> tuple[int, int]:
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
