"""The claims of offline coverage.

Agmon, Hazon, Kaminka 2008, "The giving tree", Sec. 3.1: complete, not redundant, robust, and Theorem 1.
The spanning tree is planned once more from the journal's opening, as the robots did. The tour around
it, how far apart robots stand on it and how long NB, B and Opt take are found here in another way;
what the robots did is judged by where they went.
"""

from collections.abc import Sequence

import msgspec

from agents.algorithms.mstc import Options
from agents.algorithms.stc import row_and_column
from agents.planning.team import TeamPlan, team_plan
from deploy.verdict.coverage import coverage_of
from deploy.verdict.grid_ledger import GridLedger
from deploy.verdict.guarantees import Guarantee, Share, Status
from protocol.grid import EAST, NORTH, SOUTH, STEPS, WEST, Cell
from protocol.scenario import Scenario
from protocol.trace import Observer

Finding = tuple[bool | None, str]
"""Whether a claim holds, and the detail."""


class Mstc:
    """Judges a run of ``mstc``."""

    observe: Observer | None = None

    def __init__(self, scenario: Scenario, ledger: GridLedger) -> None:
        """Take note of what is played."""
        self._scenario = scenario
        self._ledger = ledger
        self._options = msgspec.convert(scenario.algorithm_options, Options)

    def complete(self) -> bool:
        """Ask for nothing but that every sub-cell is covered."""
        return True

    def shares(self) -> list[Share] | None:
        """Let everything be counted as for every algorithm."""
        return None

    def plans(self) -> list[TeamPlan]:
        """Return the plan of each part of the map in which robots start."""
        ledger, grid = self._ledger, self._ledger.grid
        found: list[TeamPlan] = []
        planned: set[int] = set()
        starts = tuple(map(ledger.name, ledger.starts))
        for robot in range(len(starts)):
            if robot not in planned:
                kind, seed = self._options.kind, self._scenario.seed
                plan = team_plan(grid.rows, grid.cols, grid.cells(), starts, kind, seed, robot)
                planned.update(plan.order)
                found.append(plan)
        return found

    def report(self, status: Status) -> list[Guarantee]:
        """Judge every claim."""
        plans = self.plans()
        starts = [self._ledger.name(start) for start in self._ledger.starts]
        gaps = [_gaps(plan, starts) for plan in plans]
        claims = (
            ("no sub-cell visited twice", "Sec. 3.1, NB", self._not_redundant(status)),
            ("covered in the planned time", "Sec. 3.1", self._as_planned(gaps, status)),
            ("NB takes at most twice as long as Opt", "Theorem 1", _theorem_1(gaps)),
            ("covered with up to k - 1 losses", "Sec. 3.1", self._robust(status)),
        )
        source = "Agmon et al. 2008, "
        return [Guarantee(name, source + place, *finding) for name, place, finding in claims]

    def _not_redundant(self, status: Status) -> Finding:
        if self._ledger.losses:
            return None, "robots were lost, whose parts are walked again"
        if self._options.split != "nb" or self._options.home:
            return None, "robots that go back, or home, come by what is covered"
        extra = self._ledger.visits_extra
        detail = f"visits beyond the first: {extra or 'none'}"
        return extra == 0, detail if status == "over" else f"{detail} so far"

    def _as_planned(self, gaps: list[list[int]], status: Status) -> Finding:
        planned = max(map({"nb": _nb, "b": _b, "opt": _opt}[self._options.split], gaps))
        found = self._ledger.coverage_time
        detail = f"coverage time {found:g}, planned {planned} moves"
        if self._ledger.losses:
            return None, f"robots were lost; {detail}"
        if self._scenario.clock.mode != "lockstep":
            return None, f"moves take different times; {detail}"
        if status != "over":
            return None, f"{detail}; the run is not over"
        return found == planned, detail

    def _robust(self, status: Status) -> Finding:
        ledger = self._ledger
        lost, left = len(ledger.losses), len(ledger.survivors)
        if not lost:
            return None, "no robot was lost"
        if not left:
            return None, "no robot survived"
        coverage = coverage_of(self._scenario, ledger)
        detail = f"{lost} of {lost + left} robots lost; "
        detail += f"{coverage.covered} of {coverage.to_cover} sub-cells covered"
        if coverage.missing and status == "unfinished":
            return None, f"{detail} so far"
        return not coverage.missing, detail


def _theorem_1(gaps: list[list[int]]) -> Finding:
    nb, opt = max(map(_nb, gaps)), max(map(_opt, gaps))
    return nb <= 2 * opt, f"of this tour NB takes {nb} moves, Opt {opt}"


# The tour, once more.


def _gaps(plan: TeamPlan, starts: Sequence[Cell]) -> list[int]:
    """Go around a tree with the left hand on it; return the moves from each robot to the next."""
    edges = set()
    for cell, bits in plan.tree.edges.items():
        row, col = row_and_column(cell)
        edges |= {(row, col, way) for way in range(4) if bits >> way & 1}
    robots = {starts[robot] for robot in plan.order}
    first = at = starts[plan.order[0]]
    gaps: list[int] = []
    moves = 0
    while True:
        row, col = at
        # North-east leads north, and so on clockwise; where no edge leads on, turn left in the cell.
        way = ((NORTH if col % 2 else WEST), (EAST if col % 2 else SOUTH))[row % 2]
        if (row // 2, col // 2, way) not in edges:
            way = (way - 1) % 4
        at = (row + STEPS[way][0], col + STEPS[way][1])
        moves += 1
        if at in robots:
            gaps.append(moves)
            moves = 0
        if at == first:
            return gaps


def _nb(gaps: Sequence[int]) -> int:
    return max(gaps) - 1


def _b(gaps: Sequence[int]) -> int:
    largest = max(gaps)
    if 2 * largest <= sum(gaps):
        return _nb(gaps)
    at = gaps.index(largest)
    return _least(gaps, {(at + step) % len(gaps) for step in range(3)})


def _opt(gaps: Sequence[int]) -> int:
    return _least(gaps, set(range(len(gaps))))


def _least(gaps: Sequence[int], shared: set[int]) -> int:
    """Return the shortest time in which robots cover the gaps, those of ``shared`` from both ends."""
    low, high = 0, _nb(gaps)
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if _fits(gaps, shared, middle) else (middle + 1, high)
    return low


def _fits(gaps: Sequence[int], shared: set[int], limit: int) -> bool:
    last = len(gaps) - 1
    for first in range(min(limit, gaps[last] - 1) + 1 if last in shared else 1):
        back = first
        for at, gap in enumerate(gaps):
            # Ahead before or after going back, whichever way more is covered in time.
            ahead = limit - 2 * back if 3 * back <= limit else (limit - back) // 2
            back = max(0, gap - 1 - ahead)
            if back and (at not in shared or back > limit):
                break
        else:
            if back <= first:
                return True
    return False
