"""The claims of parent and child robots: children move in line of sight of a parent, and cover all.

The parent-child paper, Sec. 3. Its robots are not lost; what becomes of a team with losses is ours.

Who is in sight of whom is judged by code of the verdict's own (`deploy.verdict.sight`), below r_los. A
robot on its way is where it left from. The lowest parent that is neither lost nor has stopped commands:
a message of one byte for itself and one for each child, an exit, or something else for no move.

The plan is made once more from the map and the starts, as the robots made it. Without losses, and if
every move takes one tick, the run has to be that plan, move for move in number and tick for tick.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

from msgspec import Struct

from deploy.verdict.base_ledger import in_words
from deploy.verdict.coverage import coverage_of
from deploy.verdict.grid_ledger import GridLedger
from deploy.verdict.guarantees import Guarantee, Share, Status
from deploy.verdict.sight import Looks
from protocol.grid import Cell
from protocol.messages import AnyRequest, Move, Stop, Wait, WaitForNews
from protocol.scenario import Scenario
from protocol.trace import Event

if TYPE_CHECKING:
    from agents.planning.parent_child import Plan

STAYS = 3
"""A parent that waits so often at a vertex at which children cover something has made a stop there."""

Finding = tuple[bool | None, str]
"""Whether a claim holds, and the detail."""


class PlannedSteps(Struct, frozen=True, kw_only=True):
    """The plan that a team carried out, in numbers.

    Attributes:
        stops: vertices at which the parent stands while children cover.
        coverage_steps, coordination_steps, redundant_steps: as the paper counts them
            (`agents.planning.parent_child`).
        schedule_steps: ticks of the plan.
    """

    stops: int
    coverage_steps: int
    coordination_steps: int
    redundant_steps: int
    schedule_steps: int


class Trail(NamedTuple):
    """Where the commanding parent went.

    Attributes:
        way: its sub-cells, one after another.
        stops: of the plan, those where it was; after losses, where it stayed while children covered.
        reach: how far it sees, sub-cells.
    """

    way: list[Cell]
    stops: list[Cell]
    reach: float


class ParentChild:
    """Judges a run of ``parent-child``.

    Attributes:
        parents: how many robots are parents: the first ones.
    """

    def __init__(self, scenario: Scenario, ledger: GridLedger) -> None:
        """Take note of what is played."""
        self._scenario = scenario
        self._ledger = ledger
        parents, robots_m = scenario.team.parents, scenario.sensing.robots_m
        assert parents is not None
        assert robots_m is not None
        self.parents, self._radius_m = parents, robots_m
        self._looks = Looks(ledger.grid, robots_m)
        self._at = list(ledger.starts)
        self._living = set(range(parents))  # parents that are neither lost nor have stopped
        # The newest command: its number, where it was given, and for each robot a byte. By child:
        # the number of the one that it carried out last.
        self._command = 0, ledger.starts[0], b""
        self._obeyed = [0] * len(self._at)
        self._moves = 0
        self._unseen = 0
        self._untold = 0
        self._first_unseen = self._first_untold = ""
        # Vertices that no parent has seen; where parents have stood.
        self._hidden = {place for place, wall in enumerate(ledger.grid.blocked) if not wall}
        self._stood: set[int] = set()
        for start in ledger.starts[:parents]:
            self._stand(start)
        # For the picture: the way of the commander, and by place how often it stayed there, and how
        # often a child set out to a vertex that no child had visited.
        self._way = [ledger.starts[0]]
        self._stays: dict[int, int] = {}
        self._gains: dict[int, int] = {}
        self._visited = set(ledger.starts[parents:])

    # One pass.

    def observe(self, event: Event) -> None:
        """Take in the next event of the trace, after the ledger."""
        robot, place, what = event.robot, event.place, event.what
        if not 0 <= robot < len(self._at):
            return
        if place is not None and 0 <= place < len(self._ledger.grid):
            self._at[robot] = place
        if robot >= self.parents:
            if type(what) is Move:
                self._judge_move(event, what)
            return
        if isinstance(what, str):
            self._living.discard(robot)
            return
        if place is not None:
            self._stand(place)
        if robot == min(self._living, default=None):
            self._lead(self._at[robot], what)
        if type(what) is Stop:
            self._living.discard(robot)

    def _stand(self, place: int) -> None:
        """Let a parent see what is in sight of a place."""
        if place in self._stood or not 0 <= place < len(self._ledger.grid):
            return
        self._stood.add(place)
        grid, hidden = self._ledger.grid, self._hidden
        row, col = grid.position(place)
        for down, right in self._looks.near:
            if 0 <= row + down < grid.rows and 0 <= col + right < grid.cols:
                other = grid.place(row + down, col + right)
                if other in hidden and self._looks.is_clear(place, down, right):
                    hidden.remove(other)

    def _lead(self, at: int, what: AnyRequest) -> None:
        """Take note of what the commander does."""
        if self._way[-1] != at:
            self._way.append(at)
        if type(what) is Wait or type(what) is WaitForNews:
            self._stays[at] = self._stays.get(at, 0) + 1
        for message in what.messages:
            if len(message) == 1 + len(self._at) - self.parents:
                self._command = self._command[0] + 1, at, message

    def _is_told(self, child: int, exit_: int) -> bool:
        """Tell whether the newest command was for this move, in sight, and not carried out before.

        The child stands now where it stood then.
        """
        number, given_at, message = self._command
        is_new = number > self._obeyed[child]
        self._obeyed[child] = number
        told = is_new and message[1 + child - self.parents] == exit_
        return told and self._looks.sees(given_at, self._at[child])

    def _judge_move(self, event: Event, move: Move) -> None:
        robot, at = event.robot, self._at[event.robot]
        where = f"robot {robot} at {in_words(self._ledger.name(at))}, t={event.time:g}"
        self._moves += 1
        if not any(self._looks.sees(self._at[parent], at) for parent in self._living):
            self._unseen += 1
            self._first_unseen = self._first_unseen or where
        if not self._is_told(robot, move.exit):
            self._untold += 1
            self._first_untold = self._first_untold or where
        grid = self._ledger.grid
        to = at + (-grid.stride, 1, grid.stride, -1)[move.exit % 4]
        if to not in self._visited and not grid.blocked[to]:
            self._visited.add(to)
            stop = self._way[-1]
            self._gains[stop] = self._gains.get(stop, 0) + 1

    # What came of it.

    def complete(self) -> bool:
        """Ask for nothing but that every vertex is covered."""
        return True

    def shares(self) -> list[Share] | None:
        """Let everything be counted as for every algorithm."""
        return None

    def trail(self) -> Trail:
        """Return where the commander went, and stayed."""
        way = list(map(self._ledger.grid.position, self._way))
        if self._ledger.losses or self.plan is None:
            stayed = (place for place, often in self._stays.items() if often >= STAYS)
            stops = [self._ledger.grid.position(at) for at in stayed if self._gains.get(at)]
        else:
            been = set(way)
            stops = [stop.cell for stop in self.plan.stops if stop.cell in been]
        reach = self._radius_m / self._ledger.grid.cell_m
        return Trail(way, stops, reach)

    @cached_property
    def plan(self) -> "Plan | None":
        """The plan from the starts; ``None`` if there is none."""
        from agents.algorithms.parent_child import first_plan  # brings numpy

        grid, ledger = self._ledger.grid, self._ledger
        starts = tuple(map(ledger.name, ledger.starts))
        cells = round(self._radius_m / grid.cell_m, 9)
        try:
            return first_plan(grid.rows, grid.cols, grid.cells(), starts, self.parents, cells)
        except ValueError:
            return None

    def steps(self) -> PlannedSteps | None:
        """Return what the plan comes to; ``None`` after losses, when it was not carried out."""
        if self._ledger.losses or self.plan is None:
            return None
        return PlannedSteps(
            stops=len(self.plan.stops),
            coverage_steps=self.plan.coverage_steps,
            coordination_steps=self.plan.coordination_steps,
            redundant_steps=self.plan.redundant_steps,
            schedule_steps=self.plan.schedule_steps,
        )

    # The claims.

    def report(self, status: Status) -> list[Guarantee]:
        """Judge every claim."""
        claims = (
            ("every vertex seen by a parent", "Eq. 3", self._all_seen(status)),
            ("no child moves out of sight", "Sec. 3.1", self._in_sight()),
            ("children do as they are told", "Sec. 3.1", self._obedient()),
            ("covered in the planned time", "Sec. 5", self._as_planned(status)),
        )
        found = [Guarantee(name, f"Parent-child paper, {at}", *told) for name, at, told in claims]
        robust = self._robust(status)
        return [*found, Guarantee("covered with losses", "Canopy: beyond the paper", *robust)]

    def _all_seen(self, status: Status) -> Finding:
        coverage = coverage_of(self._scenario, self._ledger)
        to_see = set(coverage.missing).union(self._ledger.first_visits)
        hidden = len(to_see & self._hidden)
        detail = f"{len(to_see) - hidden} of {len(to_see)} in sight of where a parent stood"
        if hidden and coverage.hindered:
            return None, f"{detail}; {coverage.hindered}"
        if hidden and status == "unfinished":
            return None, f"{detail} so far"
        return not hidden, detail

    def _in_sight(self) -> Finding:
        detail = f"{self._moves} moves of children, all in sight of a parent"
        if self._unseen:
            detail = f"{self._unseen} of {self._moves} moves of children out of sight, the first: "
            detail += self._first_unseen
        return not self._unseen, detail

    def _obedient(self) -> Finding:
        detail = f"{self._moves} moves of children, each commanded in sight"
        if self._untold:
            detail = f"{self._untold} of {self._moves} moves of children without a command in sight"
            detail += f", the first: {self._first_untold}"
        return not self._untold, detail

    def _as_planned(self, status: Status) -> Finding:
        ledger = self._ledger
        if ledger.losses:
            return None, "robots were lost, whose vertices others cover"
        if self.plan is None:
            return None, "there is no plan"
        planned = self.plan.schedule_steps
        if self._scenario.clock.mode != "lockstep":
            return None, f"moves take different times; planned {planned} ticks"
        if status == "unfinished":
            return None, f"planned {planned} ticks; the run is not over"
        if ledger.makespan is None:
            return False, f"planned {planned} ticks, but the run stalled"
        detail = f"makespan {ledger.makespan:g}, planned {planned} ticks"
        odd = _first_odd(self.plan, self.parents, [track.moves for track in ledger.robots])
        return ledger.makespan == planned and not odd, detail + odd

    def _robust(self, status: Status) -> Finding:
        ledger = self._ledger
        lost, left = len(ledger.losses), len(ledger.survivors)
        if not lost:
            return None, "no robot was lost"
        coverage = coverage_of(self._scenario, ledger)
        detail = f"{lost} of {lost + left} robots lost; "
        detail += f"{coverage.covered} of {coverage.to_cover} sub-cells covered"
        if coverage.missing and coverage.hindered:
            return None, f"{detail}; {coverage.hindered}"
        if coverage.missing and status == "unfinished":
            return None, f"{detail} so far"
        return not coverage.missing, detail


def _first_odd(plan: "Plan", parents: int, moves: Sequence[int]) -> str:
    """Name the first robot that made more or fewer moves than planned, if one did."""
    planned = [sum(move < 4 for move in robot) for robot in plan.moves]
    planned = [planned[0]] * parents + planned[1:]  # parents that stand by make the same moves
    for robot, (found, expected) in enumerate(zip(moves, planned, strict=True)):
        if found != expected:
            return f"; robot {robot} made {found} moves, planned {expected}"
    return ""
