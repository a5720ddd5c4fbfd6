"""The audit of places and moves: no robot is in two places, or somewhere that no move led it."""

from collections.abc import Sequence
from math import inf
from typing import Protocol
from zlib import decompress

from deploy.verdict.audit_findings import Findings
from deploy.verdict.audit_journal import Opening
from deploy.verdict.guarantees import Guarantee
from protocol.messages import AnyRequest, Exchange, Look, Move, Stop, Wait, WaitForNews, Write
from protocol.scenario import Scenario
from protocol.trace import Event


class _Ground(Protocol):
    """Where one gets to."""

    def __len__(self) -> int:
        """Return the number of places."""
        ...

    def leads(self, left: int, exit_: int, place: int, entry: int | None) -> bool:
        """Tell whether who leaves ``left`` by ``exit_`` may arrive at ``place`` by ``entry``."""
        ...


class _Graph:
    """A port graph: ports are numbered by incident edge in the order of the edges."""

    def __init__(self, names: Sequence[str], ends: Sequence[tuple[int, int]]) -> None:
        self._ways: list[list[tuple[int, int]]] = [[] for _ in names]
        for u, v in ends:
            port_u = len(self._ways[u])
            self._ways[u].append((v, len(self._ways[v]) + (u == v)))
            self._ways[v].append((u, port_u))

    def __len__(self) -> int:
        return len(self._ways)

    def leads(self, left: int, exit_: int, place: int, entry: int | None) -> bool:
        ways = self._ways[left]
        return 0 <= exit_ < len(ways) and ways[exit_] == (place, entry)


class _Grid:
    """A grid with a border behind its last column and row.

    Whoever goes against a blocked cell comes back by the exit that it took, and so does, where bodies
    block each other, who goes against one; where motion drifts one may end in any free cell.
    """

    def __init__(self, rows: int, cols: int, blocked: bytes, scenario: Scenario) -> None:
        self._rows, self._cols, self._blocked = rows, cols, blocked
        self._bumps = scenario.world.bodies == "block"
        self._drifts = scenario.sensing.drift > 0

    def __len__(self) -> int:
        return (self._rows + 1) * (self._cols + 1)

    def leads(self, left: int, exit_: int, place: int, entry: int | None) -> bool:
        if not 0 <= exit_ < 4:
            return False
        row, col = divmod(left, self._cols + 1)
        down, right = ((-1, 0), (0, 1), (1, 0), (0, -1))[exit_]
        free = self._is_free(row + down, col + right)
        if not free or (self._bumps and entry == exit_):
            return (place, entry) == (left, exit_)
        to = (row + down) * (self._cols + 1) + col + right
        arrived = place == to or (self._drifts and self._is_free(*divmod(place, self._cols + 1)))
        return arrived and entry == (exit_ + 2) % 4

    def _is_free(self, row: int, col: int) -> bool:
        inside = 0 <= row < self._rows and 0 <= col < self._cols
        return inside and not self._blocked[row * self._cols + col]


def _ground_of(opening: Opening) -> _Ground:
    kind, *fields = opening.ground
    if kind == "graph":
        return _Graph(fields[0], fields[1])
    return _Grid(fields[0], fields[1], decompress(fields[3]), opening.scenario)


class _Robot:
    """Where a robot is, as its requests tell.

    Attributes:
        place, entry: where it made its last request, and by which port it had come there.
        exit: by which port it left then; -1: it stayed.
        time, round: when that was.
        earliest, latest: when its next request may be.
        out: why it can make no more; empty while it can.
    """

    __slots__ = ("earliest", "entry", "exit", "latest", "out", "place", "round", "time")

    def __init__(self, place: int) -> None:
        self.place = place
        self.entry: int | None = None
        self.exit = -1
        self.time, self.round = 0.0, -2
        self.earliest = self.latest = 0.0
        self.out = ""


class MotionAudit:
    """Follows each robot through the trace."""

    def __init__(self, opening: Opening) -> None:
        self._ground = _ground_of(opening)
        self._tick = opening.scenario.clock.mode == "lockstep"
        self._robots = list(map(_Robot, opening.starts))
        self._time = 0.0
        self._requests = 0
        self._wrong = Findings()

    def applied(self, event: Event, request: AnyRequest) -> None:
        """Let a robot make a request."""
        robot = self._robot(event)
        if robot is None:
            return
        time, place = event.time, event.place
        self._requests += 1
        if (time, event.round) <= (robot.time, robot.round):
            self._wrong.add(f"{event}: it acted at t={robot.time:g} in round {robot.round} already")
        elif not robot.earliest <= time <= robot.latest:
            expected = f"t={robot.earliest:g} to {robot.latest:g}"
            self._wrong.add(f"{event}: expected at {expected}")
        if place is None or not self._arrives(robot, place, event.entry):
            self._wrong.add(f"{event}: {_whereabouts(robot)}")
            if place is None or not 0 <= place < len(self._ground):
                return
        robot.place, robot.entry = place, event.entry
        robot.time, robot.round, robot.exit = time, event.round, -1
        robot.earliest = robot.latest = time
        match request:
            case Move(exit=exit_):
                robot.exit = exit_
                robot.latest = inf
                if self._tick:
                    robot.earliest = robot.latest = time + 1.0
            case Wait(duration=duration):
                robot.earliest = robot.latest = time + duration
            case WaitForNews(at_most=at_most):
                robot.latest = inf if at_most is None else time + at_most
            case Stop():
                robot.out = "it had stopped"
            case Look() | Write() | Exchange():
                pass  # these take no time

    def lost(self, event: Event) -> None:
        """Let a robot be lost; on its way it has no place."""
        robot = self._robot(event)
        if robot is None:
            return
        if event.time < robot.time:
            self._wrong.add(f"{event}: it acted at t={robot.time:g} already")
        on_its_way = event.place is None and robot.exit >= 0
        if not on_its_way and (
            event.place is None or not self._arrives(robot, event.place, event.entry)
        ):
            self._wrong.add(f"{event}: {_whereabouts(robot)}")
        robot.out = "it had been lost"

    def _robot(self, event: Event) -> _Robot | None:
        """Return the robot of an event, if it can act at all."""
        if event.time < self._time:
            self._wrong.add(f"{event}: comes after t={self._time:g}")
        self._time = event.time
        if not 0 <= event.robot < len(self._robots):
            self._wrong.add(f"{event}: there is no such robot")
            return None
        robot = self._robots[event.robot]
        if robot.out:
            self._wrong.add(f"{event}: {robot.out}")
            return None
        return robot

    def _arrives(self, robot: _Robot, place: int, entry: int | None) -> bool:
        """Tell whether a robot can be at a place by now."""
        if robot.exit < 0:
            return place == robot.place and entry == robot.entry
        return self._ground.leads(robot.place, robot.exit, place, entry)

    def report(self, name: str) -> Guarantee:
        """Judge, once the trace has been seen whole."""
        return self._wrong.guarantee(
            name, f"{self._requests} requests of {len(self._robots)} robots follow each other"
        )


def _whereabouts(robot: _Robot) -> str:
    if robot.exit < 0:
        return f"it stood at {robot.place}, entry {robot.entry}"
    return f"it had left {robot.place} by exit {robot.exit}, which does not lead there"
