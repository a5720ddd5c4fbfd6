"""The world: virtual time, bodies, tags, radio and faults, without any input or output.

The core is resumed with inputs and returns outputs; it calls nobody. Its state is a pure function of
the scenario and of the inputs, which is what the journal keeps.

    output                      input
    Wave      whose turn it is  the request of each, and the robots that were lost meanwhile
    KillOrder a scheduled kill  nothing; given once the robot is dead
    TagsWanted                  the tags that an earlier run left at these places
    End                         (none)

One instant, in this order:

1. All arrivals and ends of waits take place.
2. The faults of round 0 strike.
3. Rounds. In a round each robot that has not yet acted takes its turn: it gets its sight and answers
   with a request. Where a place carries a device its robots take turns one after another, lowest id
   first, each seeing the tag as the one before left it; the j-th turns at all places are a wave.
   Elsewhere all take their turn in the first wave. A request of zero duration ends the turn; the
   robot is in the next round again. Rounds follow until all are under way, waiting or stopped.
4. After n rounds the faults of round n strike; those of a larger round than there are, at the end.

Pinned down because traces must be equal: the opening looks are round -1; messages, losses and changed
tags wake those who wait for news into the next round; a fault's ``at`` is an instant of its own; a
victim under way is lost on its way; ``at_request = n`` strikes in place of the n-th request, when the
turn comes; a loss that nobody scheduled applies before the requests of the wave that it came with,
and the request of the dead robot is dropped.
"""

from collections.abc import Callable, Generator, Iterable, Sequence
from math import inf
from operator import attrgetter
from typing import Literal
from zlib import crc32

from msgspec import Struct

from protocol.codec import encode
from protocol.errors import OpeningError, RoundsError, RuleError, TagError
from protocol.messages import (
    AnyRequest,
    Briefing,
    Look,
    Move,
    Progress,
    Refusal,
    Sight,
    Stop,
    TagWrite,
    Wait,
    WaitForNews,
)
from protocol.scenario import Scenario
from protocol.trace import Event, LossCause, Observer
from world_server.clock import Agenda, clock_of
from world_server.radio import RADIOS, in_reach
from world_server.terrain import GraphTerrain


class Wave(Struct, frozen=True, gc=False):
    """The robots whose turn it is, lowest id first, and what each of them sees.

    Attributes:
        time: virtual time.
        round: round of the instant; -1 for the opening.
        index: number of the wave in its round.
        robots: ids, ascending.
        sights: what each sees, the reply to its last request; ``None`` in the opening.
    """

    time: float
    round: int
    index: int
    robots: list[int]
    sights: list[Sight | None]


class KillOrder(Struct, frozen=True):
    """The clock stands still until ``robot`` is dead; ``fault`` is its number in the scenario."""

    fault: int
    robot: int


class TagsWanted(Struct, frozen=True):
    """Places that this run has not seen before and whose old tags are needed now."""

    places: tuple[int, ...]


class End(Struct, frozen=True):
    """The run is over, or stalled: all that are alive wait for news and none can come."""

    status: Literal["over", "stalled"]


Output = Wave | KillOrder | TagsWanted | End


class Answers(Struct, frozen=True, gc=False):
    """The input to a wave.

    Attributes:
        requests: one for each robot of the wave, in its order; ``None`` for a robot that is in
            ``lost``.
        lost: robots that were lost since the last input, of this wave or not, and why.
    """

    requests: list[AnyRequest | None]
    lost: tuple[tuple[int, LossCause], ...] = ()


Input = Answers | tuple[TagWrite, ...] | None


# What a body is doing. Plain numbers: they are compared several times a step.
IN_TURN, UNDER_WAY, WAITING, WAITING_FOR_NEWS, STOPPED, LOST = range(6)


class Body:
    """A robot as the world sees it."""

    __slots__ = (
        "cause",
        "destination",
        "due",
        "entry",
        "inbox",
        "left_at",
        "losses",
        "lost_at",
        "moves",
        "place",
        "requests",
        "revision_seen",
        "robot",
        "sight",
        "state",
        "stopped_at",
    )

    def __init__(self, robot: int, place: int) -> None:
        self.robot = robot
        self.place = place
        self.entry: int | None = None
        self.state = IN_TURN
        self.left_at = inf
        self.destination = (place, 0)
        self.due = 0.0
        self.sight: Sight | None = None
        self.revision_seen = 0
        self.requests = 0
        self.moves = 0
        self.inbox: list[tuple[int, bytes]] = []
        self.losses: list[int] = []
        self.stopped_at: float | None = None
        self.lost_at: float | None = None
        self.cause: str | None = None



def briefing(scenario: Scenario, robot: int, nonce: str = "") -> Briefing:
    """Return what ``robot`` may know beforehand."""
    return Briefing(
        robot,
        scenario.team.robots,
        scenario.seed,
        scenario.algorithm,
        scenario.algorithm_options,
        scenario.device.capacity_bytes,
        scenario.radio.heartbeat,
        scenario.bookkeeping.fresh,
        nonce,
    )


class World:
    """One run of one scenario.

    Attributes:
        time: virtual time of the present instant.
        bodies: the robots, by id.
        tags: the tag of each place.
        revisions: how often each tag was written.
        refusals: what each robot that broke a rule was told.
        struck: numbers of the scheduled faults that have struck.
    """

    def __init__(
        self,
        scenario: Scenario,
        terrain: GraphTerrain,
        starts: Sequence[int],
        *,
        observe: Observer | None = None,
        on_write: Callable[[int, int, bytes], None] | None = None,
    ) -> None:
        """Build the world; nothing happens before `begin`.

        Args:
            scenario: what is played.
            terrain: the place.
            starts: start place of each robot.
            observe: called with each event of the trace; ``None``: no trace is made.
            on_write: called with place, revision and tag at each write to a device.
        """
        self.time = 0.0
        self.bodies = [Body(robot, place) for robot, place in enumerate(starts)]
        self.tags = [b""] * len(terrain)
        self.revisions = [0] * len(terrain)
        self.refusals: dict[int, Refusal] = {}
        self.struck: list[int] = []
        self._leave = terrain.leave
        self._sense = terrain.sense
        self._observe = observe
        self._on_write = on_write
        clock = clock_of(scenario, terrain.length)
        self._move_duration = clock.move_duration
        self._wait_duration = clock.wait_duration
        self._agenda: Agenda[Body] = Agenda()
        self._capacity = scenario.device.capacity_bytes
        self._rounds_max = scenario.clock.rounds_max
        self._radio = RADIOS[scenario.radio.reach]()
        self._notices_reach = scenario.radio.heartbeat == "reach"
        self._standing: list[list[Body]] = [[] for _ in self.tags]
        self._next: list[Body] = []
        self._alone: set[int] = set()
        self._alive = len(self.bodies)
        self._round = -1
        self._wave = 0
        self._unseen = None if scenario.bookkeeping.fresh else set(range(len(terrain)))
        numbered = list(enumerate(scenario.faults))
        timed = [(fault.at, index, fault) for index, fault in numbered if fault.at is not None]
        self._faults = [(at, fault.round, index, fault) for at, index, fault in timed]
        self._faults.sort(key=lambda fault: fault[:3], reverse=True)
        self._at_request = {
            (fault.robot, fault.at_request): index
            for index, fault in reversed(numbered)
            if fault.at_request is not None
        }
        self._visited = bytearray(len(terrain))
        for body in self.bodies:
            self._standing[body.place].append(body)
            self._visited[body.place] = 1
        self._play = self._run()

    # Inputs and outputs.

    def begin(self) -> Output:
        """Start the run and return the first output."""
        return next(self._play)

    def resume(self, given: Input) -> Output:
        """Give the input that the last output asked for and return the next output."""
        return self._play.send(given)

    def alive(self) -> int:
        """Return how many robots are neither lost nor stopped."""
        return self._alive

    def progress(self) -> Progress:
        """Return how far the run is."""
        return Progress(
            self.time,
            sum(body.moves for body in self.bodies),
            len(self.tags) - self._visited.count(0),
            self._alive,
            tuple((b.robot, b.lost_at) for b in self.bodies if b.lost_at is not None),
        )

    def waiting(self) -> list[tuple[int, int]]:
        """Return the robots that wait for news, and the place of each."""
        return [
            (body.robot, body.place)
            for body in self.bodies
            if body.state == WAITING_FOR_NEWS
        ]

    # One run.

    def _run(self) -> Generator[Output, Input, None]:
        yield from self._serve(self.bodies)
        while self._alive:
            if not self._next and not self._advance():
                yield End("stalled")
                return
            yield from self._instant()
        yield End("over")

    def _advance(self) -> bool:
        """Go to the next event; tell whether there is one."""
        arrival = self._agenda.next_time()
        if self._faults and (arrival is None or self._faults[-1][0] < arrival):
            self.time = self._faults[-1][0]
        elif arrival is not None:
            self.time = arrival
        else:
            return False
        standing = self._standing
        visited = self._visited
        for body in self._agenda.take(self.time):
            if body.due != self.time:
                continue  # woken earlier, and about something else since
            if body.state == UNDER_WAY:
                body.place, body.entry = body.destination
                body.left_at = inf
                body.moves += 1
                standing[body.place].append(body)
                visited[body.place] = 1
            elif body.state not in (WAITING, WAITING_FOR_NEWS):
                continue
            body.state = IN_TURN
            self._next.append(body)
        return True

    def _instant(self) -> Generator[Output, Input, None]:
        self._round = 0
        while True:
            if self._faults and self._faults[-1][0] == self.time:
                # Without robots in turn there are no more rounds: all that are left strike now.
                yield from self._strike(self._round if self._next else None)
            if not self._next:
                return
            in_turn, self._next = self._next, []
            in_turn = [body for body in in_turn if body.state == IN_TURN]
            in_turn.sort(key=attrgetter("robot"))
            if self._round >= self._rounds_max:
                for body in in_turn:
                    detail = f"more than {self._rounds_max} free requests in the instant {self.time}"
                    self._refuse(body, RoundsError(detail))
                continue
            for index, wave in enumerate(self._waves(in_turn)):
                self._wave = index
                yield from self._serve(wave)
            self._round += 1

    def _waves(self, in_turn: list[Body]) -> list[list[Body]]:
        """Cut a round into waves: where there are devices, one robot a place."""
        waves: list[list[Body]] = []
        before: dict[int, int] = {}
        for body in in_turn:
            index = before.get(body.place, 0)
            before[body.place] = index + 1
            if index == len(waves):
                waves.append([])
            waves[index].append(body)
        self._alone = set() if self._round else {place for place, n in before.items() if n == 1}
        return waves if self._capacity else [in_turn]

    def _strike(self, round_: int | None) -> Generator[Output, Input, None]:
        """Carry out the faults of this instant up to ``round_``; ``None``: all of them."""
        while self._faults and self._faults[-1][0] == self.time:
            _, due, index, fault = self._faults[-1]
            if round_ is not None and due > round_:
                return
            self._faults.pop()
            self._wave = -1
            yield from self._kill(index, self.bodies[fault.robot])

    def _kill(self, fault: int, victim: Body) -> Generator[Output, Input, None]:
        if victim.state < STOPPED:
            yield KillOrder(fault, victim.robot)
            self.struck.append(fault)
            self._lose(victim, "killed")

    # One wave.

    def _serve(self, wave: list[Body]) -> Generator[Output, Input, None]:
        """Give each robot of a wave its sight, and apply what they answer."""
        if self._at_request:
            for body in wave:
                fault = self._at_request.get((body.robot, body.requests + 1))
                if fault is not None:
                    yield from self._kill(fault, body)
        if self._unseen:
            places = self._unseen.intersection(body.place for body in wave)
            if places:
                self._take_old_tags((yield TagsWanted(tuple(sorted(places)))))
                self._unseen -= places
        wave = [body for body in wave if body.state == IN_TURN]
        if not wave:
            return
        sights = [None] * len(wave) if self._round < 0 else list(map(self._sight, wave))
        robots = [body.robot for body in wave]
        answers = yield Wave(self.time, self._round, self._wave, robots, sights)
        assert isinstance(answers, Answers)
        for robot, cause in answers.lost:
            if self.bodies[robot].state < STOPPED:
                self._lose(self.bodies[robot], cause)
        for body, request in zip(wave, answers.requests, strict=True):
            if body.state == IN_TURN and request is not None:
                try:
                    self._apply(body, request)
                except RuleError as error:
                    self._refuse(body, error)

    def _sight(self, body: Body) -> Sight:
        place = body.place
        here: tuple[int, ...] = ()
        standing = self._standing[place]
        if len(standing) > 1:
            here = tuple(sorted(other.robot for other in standing if other is not body))
        inbox: tuple[tuple[int, bytes], ...] = ()
        if body.inbox:
            inbox = tuple(body.inbox)
            body.inbox.clear()
        losses: tuple[int, ...] = ()
        if body.losses:
            losses = tuple(body.losses)
            body.losses.clear()
        body.revision_seen = revision = self.revisions[place]
        body.sight = sight = Sight(
            self.time,
            place,
            body.entry,
            self._sense(place),
            self.tags[place],
            revision,
            place in self._alone,
            here,
            inbox,
            losses,
        )
        return sight

    def _apply(self, body: Body, request: AnyRequest) -> None:
        """Let a request take place.

        Raises:
            RuleError: If the world does not allow it; then nothing of it happened.
        """
        kind = request.__class__
        place = body.place
        sight = body.sight
        time = self.time
        if kind is Move:
            destination = self._leave(place, request.exit)  # type: ignore[union-attr]
            duration = self._move_duration(body.robot, place, request.exit)  # type: ignore[union-attr]
        elif kind is Wait:
            duration = self._wait_duration(request.duration)  # type: ignore[union-attr]
        elif kind is WaitForNews:
            at_most = request.at_most  # type: ignore[union-attr]
            duration = inf if at_most is None else self._wait_duration(at_most)
        if sight is None and kind is not Look:
            raise OpeningError(f"the first request is a {kind.__name__.lower()}; expected a look")
        if request.tag is not None:
            self._write(body, request.tag)
        body.requests += 1
        if self._observe is not None:
            digest = 0 if sight is None else crc32(encode(sight))
            wave = (time, self._round, self._wave)
            self._observe(Event(*wave, body.robot, place, body.entry, request, digest))
        if kind is Move:
            body.state = UNDER_WAY
            body.destination = destination
            body.due = due = time + duration
            self._standing[place].remove(body)
            body.left_at = time
            self._agenda.add(due, body)
        elif kind is Wait:
            body.state = WAITING
            body.due = time + duration
            self._agenda.add(body.due, body)
        elif kind is WaitForNews:
            body.state = WAITING_FOR_NEWS
            body.due = time + duration
            if duration < inf:
                self._agenda.add(body.due, body)
            if body.inbox or body.losses or body.revision_seen != self.revisions[place]:
                self._wake(body)
        elif kind is Stop:
            body.state = STOPPED
            body.stopped_at = time
            self._alive -= 1
        else:
            self._next.append(body)
        if request.messages:
            self._send(body, request.messages)

    # What a request, or a loss, brings about.

    def _write(self, body: Body, tag: bytes) -> None:
        place = body.place
        if len(tag) > self._capacity:
            fits = f"the device holds {self._capacity}" if self._capacity else "there is no device"
            raise TagError(f"tag of {len(tag)} bytes at place {place}; {fits}")
        self.tags[place] = tag
        self.revisions[place] += 1
        body.revision_seen += 1
        if self._on_write is not None:
            self._on_write(place, self.revisions[place], tag)
        standing = self._standing[place]
        if len(standing) > 1:
            for other in standing:
                self._wake(other)

    def _send(self, sender: Body, messages: Iterable[bytes]) -> None:
        receivers = [body for body in self.bodies if body.state < STOPPED]
        for receiver in in_reach(self._radio, sender, receivers, self.time):
            receiver.inbox.extend((sender.robot, message) for message in messages)
            self._wake(receiver)

    def _wake(self, body: Body) -> None:
        """Let a robot that waits for news take its turn in the next round."""
        if body.state == WAITING_FOR_NEWS:
            body.state = IN_TURN
            self._next.append(body)

    def _refuse(self, body: Body, error: RuleError) -> None:
        self.refusals[body.robot] = Refusal(type(error).__name__, str(error))
        self._lose(body, "refused")

    def _lose(self, victim: Body, cause: LossCause) -> None:
        """Let a robot be lost: its body stays, harmless; those who hear of it get notice."""
        under_way = victim.state == UNDER_WAY
        if not under_way:
            self._standing[victim.place].remove(victim)
        victim.state = LOST
        victim.lost_at = self.time
        victim.cause = cause
        self._alive -= 1
        if self._observe is not None:
            place = None if under_way else victim.place
            self._observe(
                Event(
                    self.time, self._round, self._wave, victim.robot, place, victim.entry, cause, 0
                )
            )
        hearers = [body for body in self.bodies if body.state < STOPPED]
        for hearer in in_reach(self._radio, victim, hearers, self.time) if self._notices_reach else hearers:
            hearer.losses.append(victim.robot)
            self._wake(hearer)

    def _take_old_tags(self, given: Input) -> None:
        assert isinstance(given, tuple)
        for old in given:
            self.tags[old.place] = old.tag
            self.revisions[old.place] = old.revision
