"""Motion: where a robot gets to when it leaves a place, and what it senses there.

A graph with opaque passages: a robot senses how many ports its vertex has and learns the far end of
one only by going (Brass et al. 2011, Sec. I). Other terrains offer the same three methods.
"""

from protocol.errors import ExitError
from protocol.graph import PortGraph


class GraphTerrain:
    """Motion along the edges of a port graph.

    Attributes:
        graph: the graph; its vertices are the places.
    """

    def __init__(self, graph: PortGraph) -> None:
        self.graph = graph
        self._far = graph.far
        self._back = graph.back

    def __len__(self) -> int:
        """Return the number of places."""
        return len(self._far)

    def sense(self, place: int) -> int:
        """Return what a robot senses at ``place``: the number of its ports."""
        return len(self._far[place])

    def leave(self, place: int, exit_: int) -> tuple[int, int]:
        """Return where ``exit_`` of ``place`` leads: the place, and the entry there.

        Raises:
            ExitError: If there is no such exit.
        """
        far = self._far[place]
        if 0 <= exit_ < len(far):
            return far[exit_], self._back[place][exit_]
        raise ExitError(f"exit {exit_} at a place with {len(far)} ports; expected 0 to {len(far) - 1}")

    def length(self, place: int, exit_: int) -> float | None:
        """Return the length of the edge behind ``exit_`` of ``place``; ``None``: not known."""
        return self.graph.lengths[self.graph.edge_at[place][exit_]]
