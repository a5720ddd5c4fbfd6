"""The ledger: what can be counted in a trace, and whether the trace is possible at all.

One pass, event by event; memory is bounded by the graph and the team, not by the length of the run.

Rules of counting:

- A robot that asked to move has crossed the edge if and only if its next event has the far end as
  its place and the port there as its entry. It arrived at the time of that event: arrivals act in
  the instant in which they arrive, and that holds for a robot lost in that instant, too. A robot
  lost on its way (no place) has not crossed.
- A *dart* is an edge in one direction: the number of a port among all ports of the graph. A
  self-loop has two, like any edge.
- Starts are visited at time 0 by the lowest robot there.

What a robot cannot do (`Ledger.violations`): be where it has not walked to, take a port that is not
there, arrive before or after its time, act out of turn, or act after it stopped or was lost.
"""

from collections.abc import Iterable, Sequence
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


class Track:
    """What the ledger knows about one robot.

    Attributes:
        start: its start vertex.
        moves: moves that it made; one that is under way is not made yet.
        requests: its requests that were applied.
        returned_at: when it last arrived at its start; 0 if it never did.
        stopped_at: when it stopped, or ``None``.
        loss: how it was lost, or ``None``.
        uses: how often it crossed each dart.
    """

    __slots__ = (
        "dart",
        "durations",
        "earliest",
        "entry",
        "latest",
        "loss",
        "moves",
        "place",
        "requests",
        "returned_at",
        "start",
        "stopped_at",
        "turn",
        "uses",
    )

    def __init__(self, start: int, durations: list[float]) -> None:
        self.start = start
        self.moves = 0
        self.requests = 0
        self.returned_at = 0.0
        self.stopped_at: float | None = None
        self.loss: Loss | None = None
        self.uses: dict[int, int] = {}
        # Where and when its next event must be; the dart that it is on, or -1; its last round.
        self.place = start
        self.entry: int | None = None
        self.earliest = 0.0
        self.latest = 0.0
        self.dart = -1
        self.turn = 0
        self.durations = durations

    @property
    def alive(self) -> bool:
        """Whether it has neither stopped nor been lost."""
        return self.stopped_at is None and self.loss is None


class Ledger:
    """Counts what a trace tells.

    Attributes:
        graph: the port graph that the robots walk on.
        starts: start vertex of each robot.
        robots: what is known about each robot.
        first_visits: for each visited vertex the robot that came first, and when.
        first_crossings: for each traversed edge the robot that crossed it first, and when.
        coverage_time: time of the last first visit.
        device_bytes_max: size of the largest tag that was written.
        last_time: time of the last event.
        violations: number of things that cannot be.
        first_violation: the first of them, in words.
    """

    __slots__ = (
        "_back",
        "_capacity",
        "_edge",
        "_far",
        "_first_dart",
        "_jitter_high",
        "_jitter_low",
        "_last",
        "_round",
        "_team",
        "_turn",
        "_wave",
        "coverage_time",
        "device_bytes_max",
        "first_crossings",
        "first_violation",
        "first_visits",
        "graph",
        "last_time",
        "robots",
        "starts",
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
        self._capacity = inf if scenario is None else scenario.device.capacity_bytes
        self._jitter_low, self._jitter_high = _jitter(scenario)
        durations = _durations(graph, team, scenario)
        self.robots = list(map(Track, self.starts, durations))
        self.first_visits: dict[int, tuple[int, float]] = {}
        for robot, start in enumerate(self.starts):
            self.first_visits.setdefault(start, (robot, 0.0))
        self.first_crossings: dict[int, tuple[int, float]] = {}
        self.coverage_time = 0.0
        self.device_bytes_max = 0
        self.violations = 0
        self.first_violation: str | None = None
        # The wave of the last event, and the last robot in it that made a request.
        self.last_time = 0.0
        self._round = -2
        self._wave = -1
        self._last = -1
        self._turn = 0  # counts the rounds of all instants

    # One pass. Called for each step of a run, hence one long function.

    def observe(self, event: Event) -> None:
        """Take in the next event of the trace."""
        time = event.time
        robot = event.robot
        what = event.what
        if event.wave != self._wave or time != self.last_time or event.round != self._round:
            self._open_wave(event, time)
        if not 0 <= robot < self._team:
            self._violation(event, f"there are robots 0 to {self._team - 1}")
            return
        track = self.robots[robot]
        if type(what) is str:
            self._lose(event, track, what)
            return
        place = event.place
        if (
            not track.earliest <= time <= track.latest
            or place != track.place
            or event.entry != track.entry
            or robot <= self._last
            or track.turn == self._turn
        ) and not self._mend(event, track):
            return
        assert place is not None
        assert not isinstance(what, str)
        self._last = robot
        track.turn = self._turn
        track.requests += 1

        dart = track.dart
        if dart >= 0:
            track.dart = -1
            self._cross(robot, track, dart, time)

        tag = what.tag
        if tag is not None and len(tag) > self.device_bytes_max:
            self._grow(event, len(tag))

        if type(what) is Move:
            exit_ = what.exit
            dart = self._first_dart[place] + exit_
            if exit_ < 0 or dart >= self._first_dart[place + 1]:
                self._violation(event, f"there are ports 0 to {self.graph.degree(place) - 1}")
                track.earliest = track.latest = time
                return
            track.dart = dart
            track.place = self._far[dart]
            track.entry = self._back[dart]
            duration = track.durations[dart]
            track.earliest = time + duration * self._jitter_low
            track.latest = time + duration * self._jitter_high
        elif type(what) is Wait:
            track.earliest = track.latest = time + what.duration
        elif type(what) is WaitForNews:
            track.earliest = time
            track.latest = inf if what.at_most is None else time + what.at_most
        elif type(what) is Stop:
            track.latest = -inf
            track.stopped_at = time
        else:
            track.earliest = track.latest = time

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

    def _open_wave(self, event: Event, time: float) -> None:
        """Go to the wave of ``event``, which must not be an earlier one."""
        before = self.last_time
        round_, wave = event.round, event.wave
        if time > before or (time == before and round_ > self._round):
            self._turn += 1
        elif not (time == before and round_ == self._round and wave > self._wave):
            self._violation(event, "comes after a later event")
            self._turn += 1
        self.last_time = time
        self._round = round_
        self._wave = wave
        self._last = -1

    def _lose(self, event: Event, track: Track, cause: str) -> None:
        time, place = event.time, event.place
        if not track.alive:
            self._violation(event, "it was out of the run already")
            return
        if self._last >= 0 and cause != "refused":
            self._violation(event, "losses come before the requests of their wave")
        if time > track.latest:
            self._violation(event, f"expected by t={track.latest:g}")
        edge: int | None = None
        if place is None:
            if track.dart < 0:
                self._violation(event, "it was not on its way")
                place = track.place
            else:
                edge = self._edge[track.dart]
        elif (place, event.entry) != (track.place, track.entry):
            self._violation(event, self._expected(track))
        elif track.dart >= 0:
            if time < track.earliest:
                self._violation(event, f"expected from t={track.earliest:g}")
            self._cross(event.robot, track, track.dart, time)
        track.dart = -1
        track.latest = -inf
        track.loss = Loss(time, cause, place, edge)

    # What cannot be.

    def _mend(self, event: Event, track: Track) -> bool:
        """Say what is wrong with a request, and tell whether it can be counted all the same."""
        time, place = event.time, event.place
        if not track.alive:
            self._violation(event, "it is out of the run")
            return False
        if place is None or not 0 <= place < len(self.graph.names):
            self._violation(event, self._expected(track))
            return False
        if (place, event.entry) != (track.place, track.entry):
            self._violation(event, self._expected(track))
            track.place, track.entry, track.dart = place, event.entry, -1
        elif not track.earliest <= time <= track.latest:
            expected = f"t={track.earliest:g}"
            if track.latest != track.earliest:
                expected += f" to {track.latest:g}"
            self._violation(event, f"expected {expected}")
        elif track.turn == self._turn:
            self._violation(event, "it acts twice in a round")
        else:
            self._violation(event, f"it acts after robot {self._last} of the same wave")
        return True

    def _expected(self, track: Track) -> str:
        return f"expected at {self.graph.names[track.place]}, entry {track.entry}"

    def _grow(self, event: Event, size: int) -> None:
        self.device_bytes_max = size
        if size > self._capacity:
            self._violation(event, f"a tag of {size} bytes; the device holds {self._capacity}")

    def _violation(self, event: Event, detail: str) -> None:
        self.violations += 1
        if self.first_violation is None:
            self.first_violation = f"{event}: {detail}"

    # What the trace tells, so far.

    @property
    def alive(self) -> list[int]:
        """The robots that have neither stopped nor been lost."""
        return [robot for robot, track in enumerate(self.robots) if track.alive]

    @property
    def survivors(self) -> list[int]:
        """The robots that were not lost."""
        return [robot for robot, track in enumerate(self.robots) if track.loss is None]

    @property
    def losses(self) -> dict[int, Loss]:
        """How each lost robot was lost."""
        tracks = enumerate(self.robots)
        return {robot: track.loss for robot, track in tracks if track.loss is not None}

    @property
    def lost(self) -> dict[int, tuple[float, int | None, int | None]]:
        """For each lost robot: when, the vertex where it stood, the edge that it was on."""
        return {robot: (loss.time, loss.place, loss.edge) for robot, loss in self.losses.items()}

    @property
    def steps(self) -> int:
        """Moves made, all robots."""
        return sum(track.moves for track in self.robots)

    @property
    def events(self) -> int:
        """Requests that were applied, and losses."""
        return sum(track.requests + (track.loss is not None) for track in self.robots)

    @property
    def makespan(self) -> float | None:
        """When the last live robot stopped.

        ``None`` while a robot is alive, so also for a run that stalled. Where all robots were lost
        the run ended with the last of them.
        """
        if self.alive:
            return None
        stops = [track.stopped_at for track in self.robots if track.stopped_at is not None]
        return max(stops) if stops else self.last_time

    @property
    def excess(self) -> int:
        """Sum over the edges of the robots that crossed it, beyond the first (the papers' mu)."""
        users = (len({self._edge[dart] for dart in track.uses}) for track in self.robots)
        return sum(users) - len(self.first_crossings)

    def place(self, robot: int) -> int | None:
        """Return where ``robot`` stands; ``None`` if it is, or was lost, on its way."""
        track = self.robots[robot]
        if track.loss is not None:
            return track.loss.place
        return track.place if track.dart < 0 else None

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
