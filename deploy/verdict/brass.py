"""The claims of MR-DFS.

Brass, Cabrera-Mora, Gasparri, Xiao 2011, "Multi-Robot Tree and Graph Exploration", Sec. IV and VI.

Symbols: e edges, r radius (hops from the start to the farthest vertex), k robots, T exploration
time (makespan), f = C(k + r, k - 1) - k, which bounds the total excess multiplicity (Lemma 5).

The paper assumes one start, blank devices, moves in time-steps and, but for Sec. VI, no losses. A
claim is judged where its assumptions hold; for ``variant = "paper"`` as printed, also where it is
known to be false. Where they do not hold the answer is ``None`` and the reason. The corrected
variant promises more: with losses, or on the tags of an earlier run, it explores in *epochs*, and
each of these is bounded as the paper bounds a run.

Departures:

- Lemma 2 is false on general graphs (docs/findings.md) and therefore judged on trees only. To
  *finish* is to arrive at the start for the last time: the corrected variant then waits for others.
- Theorem 2 is judged in its exact form, T <= (2e + 2f) / k, which the proof gives.
- Asynchronous moves (event clock), which the paper leaves open: Lemma 1, completeness and 2e moves
  per robot hold, and on trees the bounds on the total excess. Bounds on T do not.
- Where a loss is not heard everywhere (``heartbeat = "reach"``) the corrected variant has to guess
  who is alive, and may take more epochs than there are losses: that breaks no bound.
- Where devices fail, the corrected variant believes what it remembers as well. It still covers all if
  no wrong mark went unnoticed, and Lemma 1 and 2e moves hold in each epoch: they need no marks but a
  robot's own. Bounds that come of sharing the work assume sound devices; of the printed variant, which
  remembers no marks, nothing is said then (Sec. VI). Where devices may fail and, besides, not all hear
  of losses or there are tags of an earlier run, each robot explores for itself, in one epoch.
"""

from math import comb

from deploy.verdict.guarantees import WRONG_TAGS, Guarantee, Status
from deploy.verdict.ledger import Ledger, reachable
from protocol.faults import TAG_WORDS
from protocol.scenario import Scenario
from protocol.trace import Observer

Finding = tuple[bool | None, str]
"""Whether a claim holds, and the detail."""

BROKEN_FOR_GOOD = ("Lemma 1", "Lemma 5 and proof of Theorem 2")
"""Claims that no later event can mend."""

UNFINISHED: Finding = (False, "robots have not finished")


class Brass:
    """Judges a run of ``mr-dfs``; the ledger counts all it needs."""

    observe: Observer | None = None

    def __init__(self, scenario: Scenario, ledger: Ledger) -> None:
        """Take note of what is played; nothing is judged before `report`."""
        graph, start = ledger.graph, ledger.starts[0]
        options = scenario.algorithm_options
        self._ledger = ledger
        self._k = len(ledger.starts)
        vertices, self._e = reachable(graph, ledger.starts)
        self._r = max(graph.distances(start))
        self._is_tree = self._e == vertices - 1
        self._one_start = len(set(ledger.starts)) == 1
        self._lockstep = scenario.clock.mode == "lockstep"
        self._blank = scenario.bookkeeping.fresh
        self._tree_version = options.get("version", "graph") == "tree"
        self._remembers = options.get("variant", "corrected") == "corrected"
        self._corrected = self._remembers and not self._tree_version
        all_hear = scenario.radio.heartbeat != "reach"
        devices_fail = any(fault.word in TAG_WORDS for fault in scenario.faults)
        self._for_itself = self._corrected and devices_fail and not (all_hear and self._blank)
        self._guesses = self._corrected and not all_hear and not devices_fail

    def complete(self) -> bool:
        """Tell whether every edge was traversed."""
        return len(self._ledger.first_crossings) == self._e

    def shares(self) -> None:
        """Count as everybody does."""

    def report(self, status: Status) -> list[Guarantee]:
        """Judge every claim."""
        claims = (
            ("every edge traversed", "Theorem 1 and Remark 1", self._every_edge()),
            ("survivors back at the start", "Sec. IV-A", self._back_at_the_start(status)),
            ("each robot uses each edge once each way", "Lemma 1", self._once_each_way()),
            ("all robots finish at the same step", "Lemma 2", self._finish_together()),
            ("at most 2e steps", "Theorem 1", self._never_worse_than_one()),
            ("bounded excess multiplicity", "Lemma 5 and proof of Theorem 2", self._excess()),
            ("T <= min(2e, (2e + 2f)/k)", "Theorem 2", self._tree_bound()),
            ("two robots: T <= e + r", "Theorem 3", self._two_robots()),
            ("T >= max(e/k, 2r), on trees max(2e/k, 2r)", "Sec. IV-A", self._lower_bound()),
            ("succeeds while one robot is left", "Sec. VI", self._survives_losses()),
        )
        judged = []
        for name, number, (found, why) in claims:
            holds, detail = found, why
            if status == "unfinished" and found is False and number not in BROKEN_FOR_GOOD:
                holds, detail = None, f"not over yet: {why}"
            judged.append(Guarantee(name, f"Brass et al. 2011, {number}", holds, detail))
        return judged

    # What stands in the way of a claim.

    def _outside(
        self,
        *,
        lockstep: bool = False,
        tree: bool = False,
        lossless: bool = False,
        sound: bool = False,
    ) -> str | None:
        """Return why a claim with these assumptions says nothing about this run, if so."""
        if not self._one_start:
            return "the robots start at different vertices"
        if self._tree_version and not self._is_tree:
            return "Algorithm 2 is for trees, and this is none"
        if not self._blank and (lossless or not self._corrected):
            return "the run started on the tags of an earlier one"
        if tree and not self._is_tree:
            return "only on trees"
        if lockstep and not self._lockstep:
            return "only under the lockstep clock"
        if lossless and self._ledger.losses:
            return "robots were lost"
        if not self._ledger.survivors:
            return "no robot survived"
        if sound and self._for_itself:
            return (
                "where devices may fail, and losses are not heard or tags are old, none shares work"
            )
        if sound or not self._remembers:
            return self._devices_failed()
        return None

    def _devices_failed(self) -> str | None:
        """Return what the devices did, if one failed."""
        failed = len(self._ledger.tag_faults)
        return f"failures of devices: {failed}" if failed else None

    @property
    def _epochs_max(self) -> int:
        """How many epochs there can be: one, one more for each loss, and one for old tags."""
        if not self._corrected or self._for_itself:
            return 1
        return 1 + len(self._ledger.losses) + (not self._blank)

    def _in_epochs(self) -> str:
        return f" in each of at most {self._epochs_max} epochs" if self._epochs_max > 1 else ""

    def _unless_guessed(self, *, holds: bool, detail: str) -> Finding:
        """Excuse a bound that was passed where nobody can know how many epochs it takes."""
        if holds or not self._guesses:
            return holds, detail
        return None, f'{detail}; heartbeat "reach" may take more epochs than there are losses'

    # The claims.

    def _every_edge(self) -> Finding:
        holds = self.complete()
        detail = f"{len(self._ledger.first_crossings)} of {self._e} edges traversed"
        reason = self._outside() or (WRONG_TAGS if self._ledger.wrong_tags else None)
        if not holds and reason is not None:
            return None, f"{detail}; {reason}"
        return holds, detail

    def _back_at_the_start(self, status: Status) -> Finding:
        ledger, names = self._ledger, self._ledger.graph.names
        if not ledger.survivors:
            return None, "no robot survived"
        away = []
        for robot in self._not_back():
            place = ledger.place(robot)
            where = "on its way" if place is None else f"at {names[place]}"
            has = "has not stopped" if ledger.robots[robot].alive else "stopped"
            away.append(f"robot {robot} {has}, {where}")
        if away:
            failed = None if self._remembers else self._devices_failed()
            reasons = [] if failed is None else [failed]
            return None if failed else False, "; ".join([*away, f"the run is {status}", *reasons])
        return True, f"all {len(ledger.survivors)} stopped there"

    def _once_each_way(self) -> Finding:
        reason = self._outside()
        if reason is not None:
            return None, reason
        times, robot, edge = self._ledger.most_used()
        detail = f"most uses {times}, allowed once{self._in_epochs()}"
        if times > 1:
            names, (u, v) = self._ledger.graph.names, self._ledger.graph.ends[edge]
            detail += f"; robot {robot} on edge {names[u]} - {names[v]}"
        return self._unless_guessed(holds=times <= self._epochs_max, detail=detail)

    def _finish_together(self) -> Finding:
        reason = self._outside(lockstep=True, tree=True, lossless=True, sound=True)
        if self._one_start and not self._is_tree:
            reason = "only on trees: false on general graphs, see docs/findings.md"
        finishes = sorted(
            {self._ledger.robots[robot].returned_at for robot in self._ledger.survivors}
        )
        if not finishes:
            return None, "no robot survived"
        detail = f"last arrivals at the start at {finishes[0]:g}"
        if len(finishes) > 1:
            detail += f" to {finishes[-1]:g}"
        if reason is not None:
            return None, f"{reason}; {detail}"
        return UNFINISHED if self._ledger.alive else (len(finishes) == 1, detail)

    def _never_worse_than_one(self) -> Finding:
        reason = self._outside()
        if reason is not None:
            return None, reason
        if self._ledger.alive:
            return UNFINISHED
        found: float = max(track.moves for track in self._ledger.robots)
        what = f"at most {found} moves a robot"
        if self._lockstep and not self._ledger.tag_faults:  # they may keep a robot that waits late
            found = self._makespan()
            what = f"T = {found:g}"
        limit = 2 * self._e
        return self._unless_guessed(
            holds=found <= limit * self._epochs_max,
            detail=f"{what}, allowed 2e = {limit}{self._in_epochs()}",
        )

    def _excess(self) -> Finding:
        reason = self._outside(tree=True, lossless=True, sound=True)
        if reason is not None:
            return None, reason
        found, limit = self._ledger.excess, self._excess_max()
        detail = f"excess {found}, allowed {limit}"
        holds = found <= limit
        if self._k == 2:
            steps, steps_max = self._ledger.steps, 2 * (self._e + self._r)
            holds = holds and steps <= steps_max
            detail += f"; {steps} moves, allowed 2(e + r) = {steps_max}"
        return self._unless_guessed(holds=holds, detail=detail)

    def _tree_bound(self) -> Finding:
        reason = self._outside(lockstep=True, tree=True, lossless=True, sound=True)
        if reason is not None:
            return None, reason
        if self._ledger.alive:
            return UNFINISHED
        # The sum over all robots, so that whole numbers are compared.
        limit = min(2 * self._e * self._k, 2 * self._e + 2 * self._excess_max())
        found = self._makespan()
        return found * self._k <= limit, f"T = {found:g}, allowed {limit / self._k:g}"

    def _two_robots(self) -> Finding:
        reason = self._outside(lockstep=True, tree=True, lossless=True, sound=True)
        if self._k != 2:
            reason = f"for two robots; the team has {self._k}"
        if reason is not None:
            return None, reason
        if self._ledger.alive:
            return UNFINISHED
        found, limit = self._makespan(), self._e + self._r
        return found <= limit, f"T = {found:g}, allowed {limit}"

    def _lower_bound(self) -> Finding:
        """Judge the run rather than the algorithm: no team can be faster."""
        reason = self._outside(lockstep=True, lossless=True)
        if reason is None and (self._not_back() or not self.complete()):
            reason = "the run is not complete"
        if reason is not None:
            return None, reason
        found = self._makespan()
        work = 2 * self._e if self._is_tree else self._e
        limit = max(work / self._k, 2 * self._r)
        holds = found * self._k >= work and found >= 2 * self._r
        return holds, f"T = {found:g}, at least {limit:g}"

    def _survives_losses(self) -> Finding:
        lost, left = len(self._ledger.losses), len(self._ledger.survivors)
        reason = self._outside() if lost else "no robot was lost"
        if reason is not None:
            return None, reason
        detail = f"{lost} of {self._k} robots lost, {left} left; "
        detail += f"{len(self._ledger.first_crossings)} of {self._e} edges traversed"
        if self._ledger.alive:
            detail += "; robots have not finished"
        if not self.complete() and self._ledger.wrong_tags:
            return None, f"{detail}; {WRONG_TAGS}"
        return self.complete() and not self._ledger.alive, detail

    # What the claims are made of.

    def _not_back(self) -> list[int]:
        """Return the survivors that did not stop at their start."""
        ledger = self._ledger
        return [
            robot
            for robot in ledger.survivors
            if ledger.robots[robot].alive or ledger.place(robot) != ledger.starts[robot]
        ]

    def _makespan(self) -> float:
        makespan = self._ledger.makespan
        assert makespan is not None, "asked for while robots are alive"
        return makespan

    def _excess_max(self) -> int:
        """Return f, or what k robots and e edges allow anyway if that is less."""
        return min(comb(self._k + self._r, self._k - 1) - self._k, (self._k - 1) * self._e)
