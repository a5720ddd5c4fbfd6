"""The ledger of a graph: what can be counted in a trace, and whether the trace is possible at all.

Rules of counting, besides those of `base_ledger`: a *dart* is an edge in one direction; a self-loop has
two, like any edge. A robot crosses an edge when it arrives at its far end.
"""

from collections.abc import Iterable, Sequence
from itertools import accumulate

from deploy.verdict.base_ledger import BaseLedger, Track, speeds_of
from protocol.graph import PortGraph
from protocol.scenario import Scenario


class Ledger(BaseLedger):
    """Counts what a trace on a graph tells.

    Attributes:
        graph: the port graph that the robots walk on.
        first_crossings: for each traversed edge the robot that crossed it first, and when.
    """

    __slots__ = ("_edge", "first_crossings", "graph")

    unit = "vertex"
    units = "vertices"

    def __init__(
        self, graph: PortGraph, starts: Sequence[int], scenario: Scenario | None = None
    ) -> None:
        """Open the ledger; see `BaseLedger`."""
        self.graph = graph
        self._edge = [edge for ports in graph.edge_at for edge in ports]
        speeds = speeds_of(scenario, len(starts))
        at_speed = {speed: self._durations(speed) for speed in set(speeds)}
        super().__init__(
            starts,
            scenario,
            first_dart=(0, *accumulate(map(len, graph.far))),
            far=[vertex for ports in graph.far for vertex in ports],
            back=[port for ports in graph.back for port in ports],
            durations=[at_speed[speed] for speed in speeds],
        )
        self.first_crossings: dict[int, tuple[int, float]] = {}

    def _durations(self, speed: float | None) -> list[float]:
        """Return how long each dart takes at a speed; ``None``: one tick each."""
        if speed is None:
            return [1.0] * len(self._edge)
        return [(self.graph.lengths[edge] or 1.0) / speed for edge in self._edge]

    def name(self, place: int) -> str:
        """Return the name of a vertex."""
        return self.graph.names[place]

    def _cross(self, robot: int, track: Track, dart: int, time: float) -> None:
        """Book an arrival."""
        place = track.place
        track.moves += 1
        uses = track.uses
        uses[dart] = uses.get(dart, 0) + 1
        if place not in self.first_visits:
            self.first_visits[place] = (robot, time)
            self.coverage_time = time
        edge = self._edge[dart]
        if edge not in self.first_crossings:
            self.first_crossings[edge] = (robot, time)
        if place == track.start:
            track.returned_at = time

    # What the trace tells, so far.

    @property
    def lost(self) -> dict[int, tuple[float, int | None, int | None]]:
        """For each lost robot: when, the vertex where it stood, the edge that it was on."""
        return {
            robot: (loss.time, loss.place, None if loss.dart is None else self._edge[loss.dart])
            for robot, loss in self.losses.items()
        }

    @property
    def excess(self) -> int:
        """Sum over the edges of the robots that crossed it, beyond the first (the papers' mu)."""
        users = (len({self._edge[dart] for dart in track.uses}) for track in self.robots)
        return sum(users) - len(self.first_crossings)

    def most_used(self) -> tuple[int, int, int]:
        """Return the most crossings of one edge in one direction by one robot, the robot, the edge.

        Zeros where nobody moved.
        """
        most = (0, 0, 0)
        for robot, track in enumerate(self.robots):
            for dart, times in track.uses.items():
                if times > most[0]:
                    most = (times, robot, self._edge[dart])
        return most


def reached(graph: PortGraph, starts: Iterable[int]) -> set[int]:
    """Return the vertices that can be reached from the starts."""
    found: set[int] = set()
    for start in dict.fromkeys(starts):
        if start not in found:
            hops = graph.distances(start)
            found.update(vertex for vertex, distance in enumerate(hops) if distance >= 0)
    return found


def reachable(graph: PortGraph, starts: Iterable[int]) -> tuple[int, int]:
    """Return how many vertices, and how many edges, can be reached from the starts."""
    found = reached(graph, starts)
    return len(found), sum(u in found for u, _ in graph.ends)
