"""The claims of connected coverage: NCOCTA, COCTA, and what improves on them.

Sinay, Agmon, Maksimov, Kraus, Peleg 2017, "Maintaining Communication in Multi-Robot Tree Coverage".

Symbols: N arity, H height of the tree, k robots, h_1 > ... > h_m split heights, E_H the time of NCOCTA.

The team is connected if the places of all living robots are, at the end of each instant; a robot on
its way is where it left from, and one that has stopped, or was lost, is out of the team. The paper has
no losses. After one the team may be apart: it must be connected again within D + 1 moves, where D is
how many edges of the tree that the robots use the lowest living robot is below the highest vertex that
the team held before the losses began; one move more, as it may have been about to go up. D is taken,
and the moves are counted, from the instant of the last loss; or, where robots were under way or set
out in the same wave, from the instant when all those moves had ended. In lockstep a team that is
connected stays so from then on. On the event clock, where robots find together one by one, that is
asked of it after those moves, each taken for as long as the longest so far, those under way among
them, and one time unit more.

Departures:

- On the event clock, besides: a robot leaves only when contact is assured. While it is on an edge a
  living robot stands at an end of it, or all are on that edge.
- E_H is judged where each split height is one below the last, as in the formula.
- The time of a run is when the last robot came back to the root.
"""

from collections.abc import Sequence
from itertools import pairwise
from math import inf

from msgspec import Struct

from agents.algorithms.connected_rule import Team, ticks_taken
from agents.planning.rooted_tree import spanning_tree
from agents.registry import plain_name
from deploy.verdict.connection import Contact, Occupied, Pair
from deploy.verdict.guarantees import Guarantee, Status
from deploy.verdict.ledger import Ledger
from protocol.graph import PortGraph
from protocol.messages import Move, Stop
from protocol.scenario import Scenario
from protocol.trace import NOBODY, Event

VERTICES_MOST = 100_000
"""On larger trees NCOCTA is not played for comparison."""

SHOWN = 6
"""So many robots that were apart are named."""

Finding = tuple[bool | None, str]
"""Whether a claim holds, and the detail."""


class ConnectedPlan(Struct, frozen=True, kw_only=True):
    """The plan that a team carried out.

    Attributes:
        split_heights: h_1 > ... > h_m.
        load: how many robots a subtree takes, in sixteenths of its unfinished vertices; 0: as in COCTA.
        reordered: how many siblings are explored in another order than that of ports.
        tree: ``"given"``, or how the spanning tree was searched.
    """

    split_heights: list[int]
    load: int
    reordered: int
    tree: str


class Watch:
    """Follows the robots of a team, and judges at each instant whether they are connected.

    Attributes:
        fell_apart: when the team was first apart without excuse, and who; ``None`` if never.
        left_behind: on the event clock, when a robot was first without contact, and where.
        breaks: number of losses after which the team was apart.
        longest_apart: longest time for which it was apart.
        apart_since: since when it is; ``None`` if it is connected.
        excused: whether it may be, after a loss.
    """

    def __init__(
        self, graph: PortGraph, starts: Sequence[int], *, lockstep: bool, deep: bool = False
    ) -> None:
        """Put the robots at their starts.

        Args:
            graph: where they go.
            starts: where each starts.
            lockstep: whether all moves take one tick.
            deep: whether they use a depth-first spanning tree.
        """
        self._graph = graph
        self._lockstep = lockstep
        self._at = list(starts)
        self._living = set(range(len(starts)))
        self._occupied = Occupied(graph, starts[0], deep=deep)
        self._contact = Contact()
        for start in starts:
            self._occupied.add(start)
            self._contact.stand(start)
        self._on: dict[int, Pair] = {}  # the edge that each robot under way is on
        self._left_at: dict[int, float] = {}
        self._longest_move = 1.0 if lockstep else 0.0
        self._instant = 0.0
        self._wave = (0.0, -1, 0)
        self._loss_in_wave = False
        self._unsettled: set[int] = set()  # those that were under way at the last loss
        self._deadline_from = inf
        self._moves_allowed = 1
        self._top = 0  # depth of the highest robot when the losses began
        self._counted = False  # whether the last loss is among `breaks`
        self.fell_apart: str | None = None
        self.left_behind: str | None = None
        self.breaks = 0
        self.longest_apart = 0.0
        self.apart_since: float | None = None
        self.excused = False

    def observe(self, event: Event) -> None:
        """Take in the next event. What cannot be is left to the ledger to judge."""
        wave = (event.time, event.round, event.wave)
        if wave != self._wave:
            self._wave = wave
            self._end_wave()
            if event.time != self._instant:
                self._judge(event.time)
                self._instant = event.time
        robot, what = event.robot, event.what
        if robot == NOBODY or robot not in self._living:
            return
        place = event.place
        if place is not None and 0 <= place < len(self._graph.far):
            self._be_at(robot, place, event.time)
        elif not isinstance(what, str):
            return
        if isinstance(what, str):
            self._lose(robot)
        elif type(what) is Move:
            self._set_out(robot, what.exit, event.time)
        elif type(what) is Stop:
            self._drop(robot)

    def end(self, *, for_ever: bool) -> None:
        """Judge the last instant; ``for_ever``: the team stays as it is then."""
        self._end_wave()
        self._judge(inf if for_ever else self._instant)

    # What robots do.

    def _be_at(self, robot: int, place: int, time: float) -> None:
        ends = self._on.pop(robot, None)
        if ends is None and place == self._at[robot]:
            return
        if ends is None:
            self._contact.leave(self._at[robot])
        else:
            self._contact.arrive(ends)
            self._longest_move = max(self._longest_move, time - self._left_at[robot])
        self._contact.stand(place)
        if place != self._at[robot]:
            self._occupied.add(place)
            self._occupied.remove(self._at[robot])
            self._at[robot] = place
        self._settle(robot, time)

    def _set_out(self, robot: int, exit_: int, time: float) -> None:
        here = self._at[robot]
        if 0 <= exit_ < len(self._graph.far[here]):
            there = self._graph.far[here][exit_]
            ends = (min(here, there), max(here, there))
            self._on[robot] = ends
            self._left_at[robot] = time
            self._contact.leave(here)
            self._contact.set_out(ends)

    def _drop(self, robot: int) -> None:
        """Count a robot out."""
        self._living.remove(robot)
        self._occupied.remove(self._at[robot])
        ends = self._on.pop(robot, None)
        if ends is None:
            self._contact.leave(self._at[robot])
        else:
            self._contact.arrive(ends)

    def _lose(self, robot: int) -> None:
        if not self.excused:
            self._top = self._occupied.span()[0]
        self._drop(robot)
        self._loss_in_wave = True
        self._counted = False
        self.excused = True
        self._deadline_from = inf

    # When a loss must be made up for.

    def _end_wave(self) -> None:
        """Note who is under way now that a wave with a loss is over."""
        if self._loss_in_wave:
            self._loss_in_wave = False
            self._unsettled = set(self._on)
            self._if_settled(self._instant)

    def _settle(self, robot: int, time: float) -> None:
        if self._unsettled:
            self._unsettled.discard(robot)
            self._if_settled(time)

    def _if_settled(self, time: float) -> None:
        if not self._unsettled:
            self._deadline_from = time
            if self._living:
                highest, lowest = self._occupied.span()
                self._moves_allowed = lowest - min(highest, self._top) + 1

    def _deadline(self, now: float) -> float:
        """Return when the team has to be connected, by the moves made or under way until now."""
        if self._lockstep:
            return self._deadline_from + self._moves_allowed
        under_way = [now - self._left_at[robot] for robot in self._on]
        longest = max(self._longest_move, *under_way, 0.0)
        return self._deadline_from + longest * self._moves_allowed + 1.0

    # What is judged.

    def _judge(self, until: float) -> None:
        """Judge how the team was from the last instant on, until another one."""
        now = self._instant
        if self._occupied.connected():
            if self.apart_since is not None:
                self.longest_apart = max(self.longest_apart, now - self.apart_since)
                self.apart_since = None
            if self.excused and now >= (
                self._deadline_from if self._lockstep else self._deadline(now)
            ):
                self.excused = False
        else:
            self._judge_apart(now, until)
        if not self._lockstep and not self.excused:
            edge = self._contact.forsaken(len(self._living))
            if edge is not None and self.left_behind is None:
                names = " and ".join(self._graph.names[end] for end in edge)
                robots = sorted(robot for robot, ends in self._on.items() if ends == edge)
                self.left_behind = (
                    f"t={now:g}: {_listed(robots)} between {names}, with nobody there"
                )

    def _judge_apart(self, now: float, until: float) -> None:
        if self.apart_since is None:
            self.apart_since = now
        if self.excused and not self._counted:
            self._counted = True
            self.breaks += 1
        deadline = self._deadline(until)
        if self.fell_apart is None and (not self.excused or until > deadline):
            part = self._occupied.topmost_part()
            apart = sorted(robot for robot in self._living if self._at[robot] not in part)
            when = f"by t={deadline:g}, after a loss" if self.excused else f"at t={now:g}"
            self.fell_apart = f"not connected {when}: {_listed(apart)} apart from those further up"


class Sinay:
    """Judges a run of ``ncocta``, ``cocta`` or ``cocta-best``."""

    def __init__(self, scenario: Scenario, ledger: Ledger) -> None:
        """Take note of what is played."""
        graph, self._root = ledger.graph, ledger.starts[0]
        self._ledger = ledger
        self._algorithm = plain_name(scenario.algorithm)
        options = self._options = scenario.algorithm_options
        best = self._algorithm == "cocta-best"
        self._asked = options.get("splits", "best" if best else "paper")
        heights = options.get("heights")
        self._heights = tuple(heights) if isinstance(heights, list | tuple) else None
        self._lockstep = scenario.clock.mode == "lockstep"
        self._is_tree = graph.is_tree()
        deep = scenario.algorithm_options.get("tree") == "depth-first"
        self._watch = Watch(graph, ledger.starts, lockstep=self._lockstep, deep=deep)
        self.observe = self._watch.observe

    def plan(self) -> ConnectedPlan | None:
        """Return the plan, if it was made before the run."""
        if self._heights is None:
            return None
        order = self._options.get("order", ())
        return ConnectedPlan(
            split_heights=[*self._heights],
            load=int(str(self._options.get("load", 0))),
            reordered=len(order) if isinstance(order, list | tuple) else 0,
            tree=str(self._options.get("tree", "given")),
        )

    def complete(self) -> bool:
        """Ask for nothing but that every vertex is visited."""
        return True

    def shares(self) -> None:
        """Count as everybody does."""

    def report(self, status: Status) -> list[Guarantee]:
        """Judge every claim."""
        self._watch.end(for_ever=status == "stalled")
        claims = (
            ("the team is connected", "Lemma 4.1", self._connected(status)),
            ("nobody leaves without contact", "Sec. 3", self._contact()),
            ("survivors back at the start", "Lemma 4.2", self._back_at_the_start(status)),
            ("NCOCTA takes E_H ticks", "Lemmas 4.3 to 4.6", self._exact_time(status)),
            ("never slower than NCOCTA", "Sec. 4.3", self._not_slower(status)),
        )
        source = "Sinay et al. 2017, "
        return [Guarantee(name, source + place, *finding) for name, place, finding in claims]

    def _connected(self, status: Status) -> Finding:
        watch = self._watch
        losses = len(self._ledger.losses)
        if watch.fell_apart is not None:
            return False, watch.fell_apart
        if not losses:
            return True, "at every instant"
        detail = f"broken by {watch.breaks} of {losses} losses"
        if watch.breaks:
            detail += f", for at most {watch.longest_apart:g}"
        if watch.apart_since is not None and status == "unfinished":
            return None, f"{detail}; apart since t={watch.apart_since:g}"
        return True, detail

    def _contact(self) -> Finding:
        if self._lockstep:
            return None, "all moves take one tick"
        if self._watch.left_behind is None:
            return True, "somebody stood at an end of each edge that a robot was on"
        return False, self._watch.left_behind

    def _back_at_the_start(self, status: Status) -> Finding:
        ledger = self._ledger
        if not ledger.survivors:
            return None, "no robot survived"
        away = [
            robot
            for robot in ledger.survivors
            if ledger.robots[robot].alive or ledger.place(robot) != self._root
        ]
        if not away:
            return True, f"at {ledger.name(self._root)}, the last at t={self._time:g}"
        return None if status == "unfinished" else False, f"{_listed(away)} not stopped there"

    # Times.

    @property
    def _time(self) -> float:
        """When the last robot came back."""
        return max(track.returned_at for track in self._ledger.robots)

    def _unjudged(self, status: Status) -> str | None:
        """Return why a claim on the time of a run says nothing about this one, if so."""
        if not self._is_tree:
            return "only on trees"
        if not self._lockstep:
            return "only under the lockstep clock"
        if self._ledger.losses:
            return "robots were lost"
        if status != "over" or self._back_at_the_start(status)[0] is not True:
            return "the team is not back at the start"
        return None

    def _exact_time(self, status: Status) -> Finding:
        if self._algorithm != "ncocta":
            return None, "only NCOCTA"
        outside = self._unjudged(status)
        if outside is not None:
            return None, outside
        shape = _perfect(self._ledger.graph, self._root)
        if shape is None:
            return None, "only on perfect trees"
        arity, height = shape
        k, heights = len(self._ledger.starts), self._heights
        if heights is None:
            return None, "the plan is not known"
        if self._asked == "paper" and heights != _paper_heights(arity, height, k):
            formula = [*_paper_heights(arity, height, k)]
            return False, f"split heights {[*heights]}, by the formula {formula}"
        if any(upper - lower != 1 for upper, lower in pairwise(heights)):
            return None, f"split heights {[*heights]} are not one below the other"
        needed = _robots_for(arity, heights)
        if k < needed:
            return None, f"{k} robots; split heights {[*heights]} need {needed}"
        expected = _e_h(arity, height, heights)
        detail = f"{self._time:g} ticks, E_H = {expected} with split heights {[*heights]}"
        return self._time == expected, detail

    def _not_slower(self, status: Status) -> Finding:
        if self._algorithm == "ncocta":
            return None, "this is NCOCTA"
        outside = self._unjudged(status)
        if outside is not None:
            return None, outside
        graph, k = self._ledger.graph, len(self._ledger.starts)
        if len(graph.names) > VERTICES_MOST:
            return None, f"more than {VERTICES_MOST} vertices: NCOCTA was not played"
        heights = self._heights
        if heights is None:
            return None, "the plan is not known"
        if self._algorithm == "cocta-best" and self._asked != "best":
            return None, "the plan was given"
        tree = spanning_tree(graph, self._root).tree
        ticks = ticks_taken(Team(tree, k, "ncocta", heights), int(self._time))
        ncocta = "more, or comes to a stand" if ticks is None else f"{ticks}"
        detail = f"{self._time:g} ticks; NCOCTA with split heights {[*heights]}: {ncocta}"
        return ticks is None or ticks >= self._time, detail


# The times of NCOCTA, once more.


def _perfect(graph: PortGraph, root: int) -> tuple[int, int] | None:
    """Return arity and height of a tree, if it is perfect."""
    depths = graph.distances(root)
    height, arity = max(depths), graph.degree(root)
    for vertex, depth in enumerate(depths):
        below = graph.degree(vertex) - (depth > 0)
        if below != (arity if depth < height else 0):
            return None
    return arity, height


def _vertices(arity: int, height: int) -> int:
    """Return (N^height - 1) / (N - 1): the vertices above the leaves of a tree so high."""
    return sum(arity**depth for depth in range(height))


def _paper_heights(arity: int, height: int, k: int) -> tuple[int, ...]:
    """Return the split heights of the paper's formula (Sec. 4.2, Eq. 1), lowered where h_1 > H."""
    if arity < 2:
        return ()
    m = 0
    while 1 + arity ** (m + 1) * _lowest(arity, m + 1) + _vertices(arity, m + 1) - 1 <= k:
        m += 1
    m = min(m, height)
    if not m:
        return ()
    h_m = min(_lowest(arity, m), height + 1 - m)
    return tuple(h_m + m - i for i in range(1, m + 1))


def _lowest(arity: int, m: int) -> int:
    """Return h_m = floor(log_N m) + m + 4."""
    return max(power for power in range(m) if arity**power <= m) + m + 4


def _robots_for(arity: int, heights: Sequence[int]) -> int:
    """Return 1 + N h_1 + the sum over i > 1 of (N^i - N^(i-1)) h_i (Sec. 4.1)."""
    rest: int = sum((arity**i - arity ** (i - 1)) * h for i, h in enumerate(heights, 1) if i > 1)
    return 1 + (arity * heights[0] if heights else 0) + rest


def _e_h(arity: int, height: int, heights: Sequence[int]) -> int:
    """Return E_H (Lemmas 4.3 and 4.4); without splits, the time of one robot."""
    if not heights:
        return 2 * (_vertices(arity, height + 1) - 1)
    h_1, h_m, m = heights[0], heights[-1], len(heights)
    e_1 = _vertices(arity, h_m) + h_m + 2 * (m - 1)
    subtrees: int = arity ** (height - h_1)
    return subtrees * e_1 + 2 * (_vertices(arity, height - h_1 + 1) - 1)


def _listed(robots: Sequence[int]) -> str:
    more = f" and {len(robots) - SHOWN} more" if len(robots) > SHOWN else ""
    word = "robot" if len(robots) == 1 else "robots"
    return f"{word} {', '.join(map(str, robots[:SHOWN]))}{more}"
