"""The ledger of a grid: what can be counted in a trace, and whether the trace is possible at all.

Each place has four darts, one for each exit: dart ``4 * place + exit``. One that leads against a
blocked cell leads back to its own place, with itself as the entry.

Rules of counting, besides those of `base_ledger`: a robot that came back by the exit that it took has
not moved. A start is one visit, and so is each arrival in another sub-cell. Of parents and children
(``team.parents``) only children visit.

Where motion is not exact the trace is held to what is possible:

- Other bodies in the way (``world.bodies = "block"``): whoever wanted to go to a free sub-cell may come
  back. Who stood there is not checked.
- Drift: whoever wanted to go to a free sub-cell may end in another free one, as far away as an error
  can be: `SIGMAS` standard deviations, or any distance where errors add up.
"""

from array import array
from collections.abc import Sequence
from math import floor, inf

from deploy.verdict.base_ledger import BaseLedger, Track, speeds_of
from protocol.grid import Cell, Grid
from protocol.scenario import Scenario

SIGMAS = 8.6
"""No draw of a normal distribution from 53 random bits is further out: sqrt(2 * 53 * ln 2) = 8.57."""


class Steady:
    """How long a move takes where all take as long."""

    __slots__ = ("_duration",)

    def __init__(self, duration: float) -> None:
        self._duration = duration

    def __getitem__(self, dart: int) -> float:
        """Return the duration, whatever the dart."""
        return self._duration


class GridLedger(BaseLedger):
    """Counts what a trace on a grid tells.

    Attributes:
        grid: the grid that the robots move on.
    """

    __slots__ = ("_blocks", "_parents", "_reach", "grid")

    unit = "sub-cell"
    units = "sub-cells"

    def __init__(self, grid: Grid, starts: Sequence[int], scenario: Scenario | None = None) -> None:
        """Open the ledger; see `BaseLedger`."""
        self.grid = grid
        far, back = _darts(grid)
        speeds = speeds_of(scenario, len(starts))
        super().__init__(
            starts,
            scenario,
            first_dart=range(0, len(far) + 1, 4),
            far=far,
            back=back,
            durations=[Steady(1.0 if speed is None else grid.cell_m / speed) for speed in speeds],
        )
        self._parents = 0 if scenario is None else scenario.team.parents or 0
        if self._parents:
            self.first_visits.clear()
            for robot in range(self._parents, len(self.starts)):
                self.first_visits.setdefault(self.starts[robot], (robot, 0.0))
        self._blocks = scenario is not None and scenario.world.bodies == "block"
        # How far from the sub-cell that it meant a robot may end, rows and columns.
        self._reach = 0.0
        if scenario is not None and scenario.sensing.drift:
            sensing = scenario.sensing
            self._reach = floor(0.5 + SIGMAS * sensing.drift) if sensing.reset else inf

    def name(self, place: int) -> Cell:
        """Return row and column of a place."""
        return self.grid.position(place)

    def _cross(self, robot: int, track: Track, dart: int, time: float) -> None:
        """Book an arrival."""
        place = track.place
        if place == dart >> 2:
            return  # it came back
        track.moves += 1
        if place not in self.first_visits and robot >= self._parents:
            self.first_visits[place] = (robot, time)
            self.coverage_time = time
        if place == track.start:
            track.returned_at = time

    def _diverted(self, track: Track, place: int, entry: int | None) -> bool:
        dart, meant = track.dart, track.place
        left = dart >> 2
        if dart < 0 or meant == left or not (self._blocks or self._reach):
            return False
        if not 0 <= place < len(self.grid) or self.grid.blocked[place]:
            return False
        came_back = self._blocks and place == left
        if entry != track.entry and not (came_back and entry == dart & 3):
            return False
        if not (came_back and entry == dart & 3):
            (row, col), (meant_row, meant_col) = self.name(place), self.name(meant)
            if max(abs(row - meant_row), abs(col - meant_col)) > self._reach:
                return False
        track.place, track.entry = place, entry
        return True

    # What the trace tells, so far.

    @property
    def lost(self) -> dict[int, tuple[float, int | None]]:
        """For each lost robot: when, and the place where its body lies: where it stood or left from."""
        return {
            robot: (loss.time, loss.place if loss.dart is None else loss.dart >> 2)
            for robot, loss in self.losses.items()
        }

    @property
    def visits(self) -> int:
        """The starts, and all arrivals in another sub-cell."""
        return sum(1 + track.moves for track in self.robots[self._parents :])

    @property
    def visits_extra(self) -> int:
        """How many visits were no first ones."""
        return self.visits - len(self.first_visits)


def _darts(grid: Grid) -> tuple["array[int]", bytearray]:
    """Return where each dart leads, and the entry there."""
    blocked, places = grid.blocked, len(grid)
    far, back = array("i", bytes(4 * places * array("i").itemsize)), bytearray(4 * places)
    for exit_, step in enumerate((-grid.stride, 1, grid.stride, -1)):
        # Whether the sub-cell behind this exit is blocked, by place; beyond the border it is.
        walls = blocked[step:] + blocked[:step]
        far[exit_::4] = array(
            "i", [place if wall else place + step for place, wall in enumerate(walls)]
        )
        back[exit_::4] = walls.translate(bytes([(exit_ + 2) % 4, exit_, *bytes(254)]))
    return far, back
