"""The ledger: what can be counted in a trace, and whether the trace is possible at all.

One pass, event by event; memory is bounded by the graph and the team, not by the length of the run.

Rules of counting:

- A robot that asked to move at ``t`` has crossed the edge if and only if its next event has the far
  end as its place and the port there as its entry. It arrived at the time of that event, as arrivals
  act in the instant in which they arrive; that holds for a robot lost in that instant, too. A robot
  lost on its way (no place) has not crossed.
- A *dart* is an edge in one direction: the number of a port among all ports of the graph. A self-loop
  has two, like any edge.
- Starts are visited at time 0 by the lowest robot there.

What a robot cannot do (`Ledger.violations`): be where it has not walked to, take a port that is not
there, arrive before or after its time, act out of turn, or act after it stopped or was lost.
"""

from collections.abc import Iterable, Mapping, Sequence
from itertools import accumulate
from math import inf

from msgspec import Struct

from protocol.graph import PortGraph
from protocol.messages import Move, Stop, Wait, WaitForNews
from protocol.scenario import Scenario
from protocol.trace import Event

ROUNDING = 1e-12
"""Relative slack for a move with jitter: the bounds of the jitter are rounded, like its draws."""


class Loss(Struct, frozen=True, gc=False):
    """How a robot was lost.

    Attributes:
        time: virtual time.
        cause: ``"killed"``, ``"refused"`` or ``"failed"``.
        place: where its body stands; ``None`` if it was lost on its way.
        edge: the edge it was on; ``None`` if it stood somewhere.
    """

    time: float
    cause: str
    place: int | None
    edge: int | None


class Ledger:
    """Counts what a trace tells.

    Attributes:
        graph: the port graph that the robots walk on.
        starts: start vertex of each robot.
        first_visits: for each visited vertex the robot that came first, and when.
        first_crossings: for each traversed edge the robot that crossed it first, and when.
        losses: for each lost robot how it was lost.
        stopped_at: when each robot stopped, or ``None``.
        returned_at: when each robot last arrived at its start; 0 for one that never did.
        moves: moves that each robot made; one under way has not made it yet.
        requests: requests of each robot that were applied.
        coverage_time: time of the last first visit.
        device_bytes_max: size of the largest tag that was written.
        events: number of events.
        last_time: time of the last event.
        violations: number of events that cannot be.
        first_violation: what was wrong with the first of them.
    """

    __slots__ = (
        "_back",
        "_capacity",
        "_dart_under_way",
        "_durations",
        "_earliest",
        "_edge",
        "_entries",
        "_far",
        "_first_dart",
        "_jitter_high",
        "_jitter_low",
        "_latest",
        "_places",
        "_robot",
        "_round",
        "_team",
        "_turn",
        "_turns",
        "_uses",
        "_wave",
        "coverage_time",
        "device_bytes_max",
        "events",
        "first_crossings",
        "first_violation",
        "first_visits",
        "graph",
        "last_time",
        "losses",
        "moves",
        "requests",
        "returned_at",
        "starts",
        "stopped_at",
        "violations",
    )

    def __init__(
        self, graph: PortGraph, starts: Sequence[int], scenario: Scenario | None = None
    ) -> None:
        """Open the ledger.

        Args:
            graph: the port graph.
            starts: start vertex of each robot.
            scenario: what is played; ``None``: the duration of moves and the size of tags are not
                checked.
        """
        self.graph = graph
        self.starts = tuple(starts)
        self._team = team = len(self.starts)
        self._first_dart = (0, *accumulate(map(len, graph.far)))
        self._far = [vertex for ports in graph.far for vertex in ports]
        self._back = [port for ports in graph.back for port in ports]
        self._edge = [edge for ports in graph.edge_at for edge in ports]
        self._capacity = None if scenario is None else scenario.device.capacity_bytes
        self._durations = _durations(graph, team, scenario)
        self._jitter_low, self._jitter_high = _jitter(scenario)

        self.first_visits: dict[int, tuple[int, float]] = {}
        for robot, start in enumerate(self.starts):
            self.first_visits.setdefault(start, (robot, 0.0))
        self.first_crossings: dict[int, tuple[int, float]] = {}
        self.losses: dict[int, Loss] = {}
        self.stopped_at: list[float | None] = [None] * team
        self.returned_at = [0.0] * team
        self.moves = [0] * team
        self.requests = [0] * team
        self.coverage_time = 0.0
        self.device_bytes_max = 0
        self.events = 0
        self.violations = 0
        self.first_violation: str | None = None
        self._uses: list[dict[int, int]] = [{} for _ in range(team)]

        # Where the next event of each robot must be, and within what times.
        self._places = list(self.starts)
        self._entries: list[int | None] = [None] * team
        self._dart_under_way = [-1] * team
        self._earliest = [0.0] * team
        self._latest = [0.0] * team

        # The wave of the last event, and the last robot in it that made a request.
        self.last_time = 0.0
        self._round = -2
        self._wave = -1
        self._robot = -1
        self._turn = 0  # counts the rounds of all instants
        self._turns = [0] * team  # the round in which each robot acted last

    # One pass. Called for each step of a run, so this is one long function.

    def observe(self, event: Event) -> None:  # noqa: C901  see above
        """Take in the next event of the trace."""
        time = event.time
        robot = event.robot
        what = event.what
        self.events += 1
        if event.wave != self._wave or time != self.last_time or event.round != self._round:
            self._open_wave(event)
        if not 0 <= robot < self._team:
            self._violation(event, f"there are robots 0 to {self._team - 1}")
            return
        if type(what) is str:
            self._lose(event, what)
            return
        place = event.place
        if (
            not self._earliest[robot] <= time <= self._latest[robot]
            or place != self._places[robot]
            or event.entry != self._entries[robot]
            or robot <= self._robot
            or self._turns[robot] == self._turn
        ) and not self._mend(event):
            return
        assert place is not None
        assert not isinstance(what, str)
        self._robot = robot
        self._turns[robot] = self._turn

        dart = self._dart_under_way[robot]
        if dart >= 0:
            self._dart_under_way[robot] = -1
            self._cross(robot, dart, place, time)

        self.requests[robot] += 1
        tag = what.tag
        if tag is not None and len(tag) > self.device_bytes_max:
            self._grow(event, len(tag))

        if type(what) is Move:
            exit_ = what.exit
            dart = self._first_dart[place] + exit_
            if exit_ < 0 or dart >= self._first_dart[place + 1]:
                self._violation(event, f"there are ports 0 to {self.graph.degree(place) - 1}")
                self._earliest[robot] = self._latest[robot] = time
                return
            self._dart_under_way[robot] = dart
            self._places[robot] = self._far[dart]
            self._entries[robot] = self._back[dart]
            duration = self._durations[robot][dart]
            self._earliest[robot] = time + duration * self._jitter_low
            self._latest[robot] = time + duration * self._jitter_high
        elif type(what) is Wait:
            self._earliest[robot] = self._latest[robot] = time + what.duration
        elif type(what) is WaitForNews:
            self._earliest[robot] = time
            self._latest[robot] = inf if what.at_most is None else time + what.at_most
        elif type(what) is Stop:
            self._latest[robot] = -inf
            self.stopped_at[robot] = time
        else:
            self._earliest[robot] = self._latest[robot] = time

    def _cross(self, robot: int, dart: int, place: int, time: float) -> None:
        """Book an arrival."""
        self.moves[robot] += 1
        uses = self._uses[robot]
        uses[dart] = uses.get(dart, 0) + 1
        if place not in self.first_visits:
            self.first_visits[place] = (robot, time)
            self.coverage_time = time
        edge = self._edge[dart]
        if edge not in self.first_crossings:
            self.first_crossings[edge] = (robot, time)
        if place == self.starts[robot]:
            self.returned_at[robot] = time

    def _open_wave(self, event: Event) -> None:
        """Go to the wave of ``event``, which must not be an earlier one."""
        before = (self.last_time, self._round, self._wave)
        now = (event.time, event.round, event.wave)
        if not now > before:  # also if a time is no number
            self._violation(event, "comes after a later event")
        if now[:2] != before[:2]:
            self._turn += 1
        self.last_time, self._round, self._wave = now
        self._robot = -1

    def _lose(self, event: Event, cause: str) -> None:
        robot, time, place = event.robot, event.time, event.place
        if not self._is_alive(robot):
            self._violation(event, "was out of the run already")
            return
        if self._robot >= 0 and cause != "refused":
            self._violation(event, "losses come before the requests of their wave")
        if time > self._latest[robot]:
            self._violation(event, f"expected by t={self._latest[robot]:g}")
        dart = self._dart_under_way[robot]
        edge: int | None = None
        if place is None:
            if dart < 0:
                self._violation(event, "it was not on its way")
                place = self._places[robot]
            else:
                edge = self._edge[dart]
        elif (place, event.entry) != (self._places[robot], self._entries[robot]):
            self._violation(event, self._expected(robot))
        elif dart >= 0:
            if time < self._earliest[robot]:
                self._violation(event, f"expected from t={self._earliest[robot]:g}")
            self._cross(robot, dart, place, time)
        self._dart_under_way[robot] = -1
        self._latest[robot] = -inf
        self.losses[robot] = Loss(time, cause, place, edge)

    # What cannot be.

    def _mend(self, event: Event) -> bool:
        """Say what is wrong with a request, and tell whether it can be counted all the same."""
        robot, time, place = event.robot, event.time, event.place
        if not self._is_alive(robot):
            self._violation(event, "is out of the run")
            return False
        if place is None or not 0 <= place < len(self.graph.names):
            self._violation(event, self._expected(robot))
            return False
        if (place, event.entry) != (self._places[robot], self._entries[robot]):
            self._violation(event, self._expected(robot))
            self._places[robot], self._entries[robot] = place, event.entry
            self._dart_under_way[robot] = -1
        elif not self._earliest[robot] <= time <= self._latest[robot]:
            due = (self._earliest[robot], self._latest[robot])
            expected = f"t={due[0]:g}" if due[0] == due[1] else f"t={due[0]:g} to {due[1]:g}"
            self._violation(event, f"expected {expected}")
        elif self._turns[robot] == self._turn:
            self._violation(event, "acts twice in a round")
        else:
            self._violation(event, f"acts after robot {self._robot} in one wave")
        return True

    def _expected(self, robot: int) -> str:
        place, entry = self._places[robot], self._entries[robot]
        return f"expected at {self.graph.names[place]}, entry {entry}"

    def _grow(self, event: Event, size: int) -> None:
        self.device_bytes_max = size
        if self._capacity is not None and size > self._capacity:
            self._violation(event, f"a tag of {size} bytes; the device holds {self._capacity}")

    def _violation(self, event: Event, detail: str) -> None:
        self.violations += 1
        if self.first_violation is None:
            self.first_violation = f"{event}: {detail}"

    # What the trace tells, so far.

    def _is_alive(self, robot: int) -> bool:
        return self.stopped_at[robot] is None and robot not in self.losses

    @property
    def alive(self) -> list[int]:
        """The robots that have neither stopped nor been lost."""
        return [robot for robot in range(self._team) if self._is_alive(robot)]

    @property
    def survivors(self) -> list[int]:
        """The robots that were not lost."""
        return [robot for robot in range(self._team) if robot not in self.losses]

    @property
    def steps(self) -> int:
        """Moves made, all robots."""
        return sum(self.moves)

    @property
    def makespan(self) -> float | None:
        """When the last live robot stopped.

        ``None`` while a robot is alive, so also for a run that stalled. Where all robots were lost
        the run ended with the last of them.
        """
        if self.alive:
            return None
        stops = [time for time in self.stopped_at if time is not None]
        return max(stops) if stops else self.last_time

    @property
    def lost(self) -> Mapping[int, tuple[float, int | None, int | None]]:
        """For each lost robot: when, the vertex where it stood, the edge that it was on."""
        return {robot: (loss.time, loss.place, loss.edge) for robot, loss in self.losses.items()}

    @property
    def excess(self) -> int:
        """Sum over the edges of the robots that crossed it, beyond the first (the papers' mu)."""
        users = (len({self._edge[dart] for dart in uses}) for uses in self._uses)
        return sum(users) - len(self.first_crossings)

    def place(self, robot: int) -> int | None:
        """Return where ``robot`` stands; ``None`` if it is, or was lost, on its way."""
        loss = self.losses.get(robot)
        if loss is not None:
            return loss.place
        return self._places[robot] if self._dart_under_way[robot] < 0 else None

    def most_used(self) -> tuple[int, int, int]:
        """Return the most crossings of one edge in one direction by one robot, the robot, the edge.

        Zeros where nobody moved.
        """
        most = (0, 0, 0)
        for robot, uses in enumerate(self._uses):
            for dart, times in uses.items():
                if times > most[0]:
                    most = (times, robot, self._edge[dart])
        return most


def reachable(graph: PortGraph, starts: Iterable[int]) -> tuple[int, int]:
    """Return how many vertices, and how many edges, can be reached from the starts."""
    reached: set[int] = set()
    for start in dict.fromkeys(starts):
        if start not in reached:
            hops = graph.distances(start)
            reached.update(vertex for vertex, distance in enumerate(hops) if distance >= 0)
    return len(reached), sum(u in reached for u, _ in graph.ends)


def _durations(graph: PortGraph, team: int, scenario: Scenario | None) -> list[list[float]]:
    """Return, for each robot, how long each dart takes without jitter."""
    if scenario is None or scenario.clock.mode == "lockstep":
        return [[1.0] * sum(map(len, graph.far))] * team
    lengths = [graph.lengths[edge] or 1.0 for ports in graph.edge_at for edge in ports]
    speed = scenario.team.speed
    speeds = speed if isinstance(speed, tuple) else (speed,) * team
    at_speed = {speed: [length / speed for length in lengths] for speed in set(speeds)}
    return [at_speed[speed] for speed in speeds]


def _jitter(scenario: Scenario | None) -> tuple[float, float]:
    """Return the least and the greatest factor of a duration."""
    jitter = "exponential" if scenario is None else scenario.clock.jitter
    if isinstance(jitter, str):
        return 0.0, inf
    if jitter == 0:
        return 1.0, 1.0
    return (1.0 - jitter) * (1 - ROUNDING), (1.0 + jitter) * (1 + ROUNDING)
