"""Steering on grids: what keeps a robot from getting where it wanted to go.

Other bodies: a robot takes up the sub-cell that it stands on, and from the moment it leaves also the
one that it goes to. Who wants to go to a sub-cell that another takes up bumps: it comes back by the
exit it took, in the time that the move takes. Remains of a lost robot stay where it stood or left
from.

Drift: each move ends with an error, along and across, drawn from the robot's own stream. An error of
more than half a sub-cell ends in another sub-cell than the one meant; walls keep a robot from ending
inside them, and its error from growing into them.
"""

from typing import Protocol

from protocol.grid import STEPS
from protocol.scenario import Scenario
from protocol.seeds import spawn
from world_server.state import SteeringState, put_back, states_of
from world_server.terrain import GridTerrain, Terrain, Way


class Walker(Protocol):
    """What steering needs to know of a body."""

    robot: int
    place: int
    destination: Way


def steering_of(scenario: Scenario, terrain: Terrain, starts: tuple[int, ...]) -> "Steering | None":
    """Return what comes between a robot and where it wants to go; ``None``: nothing."""
    exact = scenario.sensing.position == "known" and scenario.world.bodies == "pass"
    if exact or not isinstance(terrain, GridTerrain):
        return None
    return Steering(scenario, terrain, starts)


class Steering:
    """Motion with other bodies in the way, and with errors.

    Attributes:
        believed: where each robot takes itself to be, if it adds up its own moves.
    """

    def __init__(self, scenario: Scenario, terrain: GridTerrain, starts: tuple[int, ...]) -> None:
        self._grid = terrain.grid
        self._leave = terrain.leave
        self._blocks = scenario.world.bodies == "block"
        self._drift, self._reset = scenario.sensing.drift, scenario.sensing.reset
        drawn = range(len(starts)) if self._drift else ()
        self._streams = [spawn(scenario.seed, "drift", robot) for robot in drawn]
        self._errors = [(0.0, 0.0)] * len(starts)
        self._bodies_at: dict[int, int] = {}
        adds_up = scenario.sensing.position == "odometry"
        self.believed = [terrain.position(start) for start in starts] if adds_up else None
        for start in starts:
            self._take(start)

    def leave(self, body: Walker, exit_: int) -> Way:
        """Let a body set out; return where it will arrive, and the entry there.

        Raises:
            ExitError: If there is no such exit.
        """
        here = body.place
        to, entry = self._leave(here, exit_)
        if to == here:
            return to, exit_
        if self._drift:
            to = self._slip(body.robot, to)
        if to != here:  # else it slipped back without noticing
            if self._blocks and to in self._bodies_at:
                return here, exit_
            self._take(to)
        if self.believed is not None:
            down, right = STEPS[exit_]
            row, col = self.believed[body.robot]
            self.believed[body.robot] = (row + down, col + right)
        return to, entry

    def arrived(self, body: Walker, left: int) -> None:
        """Let a body that left from ``left`` arrive."""
        if body.place != left:
            self._yield(left)

    def lost(self, body: Walker) -> None:
        """Let a body that was on its way be lost: it lies where it left from."""
        if body.destination[0] != body.place:
            self._yield(body.destination[0])

    def state(self) -> SteeringState:
        """Return what determines how it goes on."""
        believed = None if self.believed is None else list(self.believed)
        streams = states_of(self._streams)
        return SteeringState(list(self._errors), dict(self._bodies_at), believed, streams)

    def restore(self, state: SteeringState) -> None:
        """Go on as another did of which this was the state."""
        self._errors = list(state.errors)
        self._bodies_at = dict(state.bodies_at)
        if self.believed is not None and state.believed is not None:
            self.believed[:] = state.believed  # in place: the world holds it too
        put_back(self._streams, state.streams)

    def _slip(self, robot: int, meant: int) -> int:
        """Draw the error of a move; return the sub-cell that it ends in."""
        stream = self._streams[robot]
        down, right = self._errors[robot]
        down += stream.gauss(0.0, self._drift)
        right += stream.gauss(0.0, self._drift)
        cells_down, cells_right = round(down), round(right)
        row, col = self._grid.position(meant)
        if not self._grid.is_free(row + cells_down, col + cells_right):
            cells_down = cells_right = 0  # a wall guides it
            down, right = max(-0.5, min(down, 0.5)), max(-0.5, min(right, 0.5))
        down, right = down - cells_down, right - cells_right
        self._errors[robot] = (0.0, 0.0) if self._reset else (down, right)
        return self._grid.place(row + cells_down, col + cells_right)

    def _take(self, place: int) -> None:
        self._bodies_at[place] = self._bodies_at.get(place, 0) + 1

    def _yield(self, place: int) -> None:
        self._bodies_at[place] -= 1
        if not self._bodies_at[place]:
            del self._bodies_at[place]
