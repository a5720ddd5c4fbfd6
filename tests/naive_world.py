"""A world that is slow and obviously right: the rules of an instant, with lists and loops only.

Written from the description of an instant, not from `world_server.world`, so that each can be held
against the other. It knows the whole script of every robot: `Answer`, from a sight to a request.
"""

from collections.abc import Callable, Mapping, Sequence
from math import isfinite
from zlib import crc32

from protocol.codec import encode
from protocol.faults import Fault
from protocol.graph import PortGraph
from protocol.messages import (
    AnyRequest,
    Exchange,
    Look,
    Move,
    Sight,
    Stop,
    TagWrite,
    Wait,
    WaitForNews,
    Write,
)
from protocol.scenario import Scenario
from protocol.seeds import spawn
from protocol.trace import Event

Answer = Callable[[int, Sight | None], AnyRequest]

FOREVER = float("inf")


class NaiveRobot:
    """A robot; ``doing`` is acting, moving, waiting, listening, stopped or lost."""

    def __init__(self, number: int, place: int) -> None:
        self.number = number
        self.place = place
        self.entry: int | None = None
        self.doing = "acting"
        self.until = FOREVER
        self.goal: tuple[int, int] = (place, 0)
        self.left = FOREVER
        self.sight: Sight | None = None
        self.inbox: list[tuple[int, bytes]] = []
        self.losses: list[int] = []
        self.done = 0
        self.words = 1

    def alive(self) -> bool:
        return self.doing not in ("stopped", "lost")

    def stands(self) -> bool:
        return self.doing in ("acting", "waiting", "listening", "stopped")


class NaiveWorld:
    """One run; `run` plays it from beginning to end."""

    def __init__(
        self,
        scenario: Scenario,
        graph: PortGraph,
        starts: Sequence[int],
        answer: Answer,
        *,
        lost_in: Mapping[int, Sequence[tuple[int, str]]] | None = None,
        old_tags: Mapping[int, TagWrite] | None = None,
    ) -> None:
        self.scenario = scenario
        self.graph = graph
        self.answer = answer
        self.lost_in = lost_in or {}
        self.robots = [NaiveRobot(number, place) for number, place in enumerate(starts)]
        self.tags = [b"" for _ in graph.names]
        self.revisions = [0 for _ in graph.names]
        for old in (old_tags or {}).values():
            self.tags[old.place] = old.tag
            self.revisions[old.place] = old.revision
        self.jitters = [spawn(scenario.seed, "jitter", robot.number) for robot in self.robots]
        self.faults = list(enumerate(scenario.faults))
        self.now = 0.0
        self.rounds = -1  # rounds of this instant that are done
        self.wave = 0
        self.waves_served = 0
        self.events: list[Event] = []
        self.refused: dict[int, str] = {}
        self.struck: list[int] = []

    # The run.

    def run(self) -> str:
        """Play to the end; return how it ended."""
        self.serve(self.robots)
        while True:
            if self.acting() or any(fault.at == self.now for fault in self.timed()):
                self.instant()
            if not any(robot.alive() for robot in self.robots):
                return "over"
            times = [robot.until for robot in self.robots if robot.alive()]
            times += [fault.at for fault in self.timed() if fault.at is not None]
            if min(times, default=FOREVER) == FOREVER:
                return "stalled"
            self.now = min(times)
            for robot in self.robots:
                if robot.alive() and robot.until == self.now:
                    if robot.doing == "moving":
                        robot.place, robot.entry = robot.goal
                    self.activate(robot)

    def timed(self) -> list[Fault]:
        return [fault for _, fault in self.faults if fault.at is not None]

    def acting(self) -> list[NaiveRobot]:
        return [robot for robot in self.robots if robot.doing == "acting"]

    def activate(self, robot: NaiveRobot) -> None:
        robot.doing = "acting"
        robot.until = FOREVER
        robot.left = FOREVER

    def instant(self) -> None:
        self.rounds = 0
        while True:
            self.strike(self.rounds)
            if not self.acting():
                self.strike(None)  # a larger round than there are
            in_turn = self.acting()
            if not in_turn:
                return
            if self.rounds >= self.scenario.clock.rounds_max:
                self.wave = -1
                for robot in in_turn:
                    self.refuse(robot, "RoundsError")
                continue
            self.round(in_turn)
            self.rounds += 1

    def strike(self, up_to: int | None) -> None:
        due = [
            (fault.round, index)
            for index, fault in self.faults
            if fault.at == self.now and (up_to is None or fault.round <= up_to)
        ]
        for _, index in sorted(due):
            self.wave = -1
            self.kill(index)

    def kill(self, index: int) -> None:
        fault = self.scenario.faults[index]
        self.faults.remove((index, fault))
        assert fault.robot is not None
        victim = self.robots[fault.robot]
        if victim.alive():
            self.struck.append(index)
            self.lose(victim, "killed")

    def round(self, in_turn: list[NaiveRobot]) -> None:
        waves: list[list[NaiveRobot]] = []
        for robot in in_turn:
            before = [other for other in in_turn if other.number < robot.number]
            at_device = self.scenario.device.capacity > 0
            wave = sum(other.place == robot.place for other in before) if at_device else 0
            while len(waves) <= wave:
                waves.append([])
            waves[wave].append(robot)
        lonely = [
            robot
            for robot in in_turn
            if self.rounds == 0
            and not any(o is not robot and o.place == robot.place for o in in_turn)
        ]
        for self.wave, wave_robots in enumerate(waves):
            self.serve(wave_robots, lonely)

    # One wave.

    def serve(self, wave: list[NaiveRobot], lonely: Sequence[NaiveRobot] = ()) -> None:
        for robot in wave:
            for index, fault in list(self.faults):
                if fault.robot == robot.number and fault.at_request == robot.done + 1:
                    self.kill(index)
        wave = [robot for robot in wave if robot.doing == "acting"]
        if not wave:
            return
        if self.rounds >= 0:
            for robot in wave:
                robot.sight = self.look(robot, robot in lonely)
        requests = [self.answer(robot.number, robot.sight) for robot in wave]
        for number, cause in self.lost_in.get(self.waves_served, ()):
            if self.robots[number].alive():
                self.lose(self.robots[number], cause)
        self.waves_served += 1
        for robot, request in zip(wave, requests, strict=True):
            if robot.doing == "acting":
                self.apply(robot, request)

    def look(self, robot: NaiveRobot, alone: bool) -> Sight:
        others = [other for other in self.robots if other is not robot]
        here = [other.number for other in others if other.stands() and other.place == robot.place]
        inbox, robot.inbox = tuple(robot.inbox), []
        losses, robot.losses = tuple(robot.losses), []
        return Sight(
            time=self.now,
            place=robot.place,
            entry=robot.entry,
            degree=self.graph.degree(robot.place),
            tag=self.tags[robot.place],
            revision=self.revisions[robot.place],
            alone=alone,
            here=tuple(here),
            inbox=inbox,
            losses=losses,
        )

    def broken_rule(self, robot: NaiveRobot, request: AnyRequest) -> str | None:
        lockstep = self.scenario.clock.mode == "lockstep"
        if robot.sight is None and not isinstance(request, Look):
            return "OpeningError"
        if isinstance(request, Move) and request.exit not in range(self.graph.degree(robot.place)):
            return "ExitError"
        duration: float | None = None
        if isinstance(request, Wait):
            duration = request.duration
        elif isinstance(request, WaitForNews):
            duration = request.at_most
        if duration is not None:
            if not isfinite(duration) or duration <= 0:
                return "DurationError"
            if lockstep and duration != round(duration):
                return "DurationError"
        capacity = self.scenario.device.capacity
        if request.tag is not None and (capacity == 0 or len(request.tag) > capacity):
            return "TagError"
        return None

    def apply(self, robot: NaiveRobot, request: AnyRequest) -> None:
        rule = self.broken_rule(robot, request)
        if rule is not None:
            self.refuse(robot, rule)
            return
        place, seen = robot.place, robot.sight
        robot.done += 1
        digest = 0 if seen is None else crc32(encode(seen))
        self.tell(robot, place, request, digest)
        if request.tag is not None:
            self.tags[place] = request.tag
            self.revisions[place] += 1
            self.wake(other for other in self.robots if other.place == place and other.stands())
        match request:
            case Look() | Write() | Exchange():
                pass
            case Move():
                robot.doing = "moving"
                robot.goal = (
                    self.graph.far[place][request.exit],
                    self.graph.back[place][request.exit],
                )
                robot.left = self.now
                robot.until = self.now + self.move_duration(robot, request.exit)
            case Wait():
                robot.doing = "waiting"
                robot.until = self.now + float(request.duration)
            case WaitForNews():
                robot.doing = "listening"
                if request.at_most is not None:
                    robot.until = self.now + float(request.at_most)
                robot.words = request.words
                if len(robot.inbox) >= robot.words or robot.losses:
                    self.wake([robot])
            case Stop():
                robot.doing = "stopped"
                robot.until = FOREVER
        if request.messages:
            heard_by = self.hearers(robot)
            for message in request.messages:
                for hearer in heard_by:
                    hearer.inbox.append((robot.number, message))
            self.wake(hearer for hearer in heard_by if len(hearer.inbox) >= hearer.words)

    def move_duration(self, robot: NaiveRobot, exit_: int) -> float:
        if self.scenario.clock.mode == "lockstep":
            return 1.0
        length = self.graph.lengths[self.graph.edge_at[robot.place][exit_]]
        speed = self.scenario.team.speed
        duration = (length or 1.0) / (speed[robot.number] if isinstance(speed, tuple) else speed)
        jitter = self.scenario.clock.jitter
        if jitter == "exponential":
            duration *= self.jitters[robot.number].expovariate(1.0)
        elif jitter != 0:
            duration *= self.jitters[robot.number].uniform(1.0 - jitter, 1.0 + jitter)
        return duration

    # What it brings about.

    def hearers(self, sender: NaiveRobot) -> list[NaiveRobot]:
        others = [other for other in self.robots if other is not sender and other.alive()]
        reach = self.scenario.radio.reach
        if reach == "none":
            return []
        if reach == "global":
            return others
        if reach == "adjacent":
            hops = self.scenario.radio.hops
            if not self.scenario.radio.relay:
                far = self.graph.distances(sender.place)
                return [other for other in others if far[other.place] <= hops]
            reached = [sender]
            for robot in reached:
                far = self.graph.distances(robot.place)
                reached += [o for o in others if o not in reached and far[o.place] <= hops]
            return [other for other in others if other in reached]
        # Who leaves in this very instant has not gone anywhere yet.
        if sender.left < self.now:
            return []
        return [
            other for other in others if other.place == sender.place and not other.left < self.now
        ]

    def wake(self, robots: object) -> None:
        for robot in list(robots):  # type: ignore[call-overload]
            if robot.doing == "listening":
                self.activate(robot)

    def refuse(self, robot: NaiveRobot, rule: str) -> None:
        self.refused[robot.number] = rule
        self.lose(robot, "refused")

    def lose(self, victim: NaiveRobot, cause: str) -> None:
        if self.scenario.radio.heartbeat != "reach":
            hearers = [other for other in self.robots if other is not victim and other.alive()]
        else:
            hearers = self.hearers(victim)
        place = None if victim.doing == "moving" else victim.place
        victim.doing = "lost"
        victim.until = FOREVER
        self.tell(victim, place, cause, 0)
        for hearer in hearers:
            hearer.losses.append(victim.number)
        self.wake(hearers)

    def tell(
        self, robot: NaiveRobot, place: int | None, what: AnyRequest | str, digest: int
    ) -> None:
        line = (self.now, self.rounds, self.wave, robot.number, place, robot.entry, what, digest)
        self.events.append(Event(*line))
