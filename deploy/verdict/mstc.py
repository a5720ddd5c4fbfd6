"""The claims of offline coverage.

Agmon, Hazon, Kaminka 2008, "The giving tree", Sec. 3.1: complete, not redundant, robust, and Theorem 1.
What the robots were to do is planned once more from the journal's opening; what they did is judged by
where they went.
"""

import msgspec

from agents.algorithms.mstc import Options
from agents.planning.splits import nb_mstc, opt_mstc
from agents.planning.team import TeamPlan, team_plan
from deploy.verdict.coverage import coverage_of
from deploy.verdict.grid_ledger import GridLedger
from deploy.verdict.guarantees import Guarantee, Share, Status
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
        claims = (
            ("no sub-cell visited twice", "Sec. 3.1, NB", self._not_redundant(status)),
            ("covered in the planned time", "Sec. 3.1", self._as_planned(plans, status)),
            ("NB takes at most twice as long as Opt", "Theorem 1", _theorem_1(plans)),
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

    def _as_planned(self, plans: list[TeamPlan], status: Status) -> Finding:
        planned = max(plan.moves for plan in plans)
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


def _theorem_1(plans: list[TeamPlan]) -> Finding:
    nb = max(nb_mstc(plan.gaps).moves for plan in plans)
    opt = max(opt_mstc(plan.gaps).moves for plan in plans)
    return nb <= 2 * opt, f"of this tour NB takes {nb} moves, Opt {opt}"
