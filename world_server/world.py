"""The world: virtual time, bodies, tags, radio and faults, without any input or output.

The core is resumed with inputs and returns outputs; it calls nobody. Its state is a pure function of
the scenario and of the inputs, which is what the journal keeps.

    output                      input
    Wave      whose turn it is  the request of each, and the robots that were lost meanwhile
    KillOrder a scheduled kill  nothing; given once the robot is dead
    FaultOrder another fault    nothing; given once somebody has taken it down
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
from math import inf, nextafter
from operator import attrgetter
from typing import Literal
from zlib import crc32

from msgspec import Struct
from msgspec.structs import asdict

from protocol.codec import encode
from protocol.errors import (
    DurationError,
    GazeError,
    OpeningError,
    RoundsError,
    RuleError,
    TagError,
)
from protocol.faults import TAG_WORDS, Fault
from protocol.messages import (
    AnyRequest,
    AnySight,
    Briefing,
    GridSight,
    Look,
    Move,
    Progress,
    RadioFacts,
    Refusal,
    SensingFacts,
    Sight,
    Stop,
    TagWrite,
    TeamSight,
    Wait,
    WaitForNews,
)
from protocol.scenario import Scenario
from protocol.seeds import spawn
from protocol.trace import DEVICE_FAULTS, NOBODY, Event, LossCause, Observer
from world_server.clock import Agenda, clock_of
from world_server.radio import Ether, RadiusRadio, ether_of, in_reach, radio_of
from world_server.sensing import in_sub_cells
from world_server.state import BodyState, WorldState, put_back, put_tags_back, states_of, tags_state
from world_server.steering import steering_of
from world_server.terrain import GridTerrain, Terrain


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
    sights: list[AnySight | None]


class KillOrder(Struct, frozen=True):
    """The clock stands still until ``robot`` is dead; ``fault`` is its number in the scenario."""

    fault: int
    robot: int


class FaultOrder(Struct, frozen=True):
    """Fault number ``fault`` of the scenario is due; it changes nothing in the world itself."""

    fault: int


class TagsWanted(Struct, frozen=True):
    """Places that this run has not seen before and whose old tags are needed now."""

    places: tuple[int, ...]


class End(Struct, frozen=True):
    """The run is over, or stalled: all that are alive wait for news and none can come."""

    status: Literal["over", "stalled"]


Output = Wave | KillOrder | FaultOrder | TagsWanted | End


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


CORRUPT_BITS_MAX = 4
"""A tag is corrupted in so many bits at most."""

UNKNOWN_PLACE = -1
"""The place that a robot is told which must add up its own moves, or sees nothing."""

# What a body is doing. Plain numbers: they are compared several times a step.
IN_TURN, UNDER_WAY, WAITING, WAITING_FOR_NEWS, STOPPED, LOST = range(6)


class Body:
    """A robot as the world sees it.

    Attributes:
        place: where it stands, or where it left from.
        entry: the port by which it came there.
        destination: place and entry at the end of its way.
        due: when its way or its wait ends.
        gaze: the direction that it looks in, on a grid.
        sight: what it saw last; it acts, and leaves, in the instant of that sight.
        requests: how many of its requests were applied.
        inbox, losses: what it will see next.
        has_news: whether there is anything in these two.
        words: while it waits for news, how many messages are some.
    """

    __slots__ = (
        "destination",
        "due",
        "entry",
        "gaze",
        "has_news",
        "inbox",
        "losses",
        "lost_at",
        "place",
        "requests",
        "robot",
        "sight",
        "state",
        "stopped_at",
        "words",
    )

    def __init__(self, robot: int, place: int) -> None:
        self.robot = robot
        self.place = place
        self.entry: int | None = None
        self.gaze: int | None = None
        self.state = IN_TURN
        self.destination = (place, 0)
        self.due = 0.0
        self.sight: AnySight | None = None
        self.requests = 0
        self.inbox: list[tuple[int, bytes]] = []
        self.losses: list[int] = []
        self.has_news = False
        self.lost_at: float | None = None
        self.stopped_at: float | None = None
        self.words = 1

    def as_state(self) -> BodyState:
        """Return what determines how it goes on."""
        return BodyState(
            self.place,
            self.entry,
            self.gaze,
            self.state,
            self.destination,
            self.due,
            self.sight,
            self.requests,
            tuple(self.inbox),
            tuple(self.losses),
            self.lost_at,
            self.stopped_at,
            self.words,
        )

    def restore(self, state: BodyState) -> None:
        """Go on as another did of which this was the state."""
        self.place, self.entry, self.gaze = state.place, state.entry, state.gaze
        self.state, self.destination, self.due = state.state, state.destination, state.due
        self.sight, self.requests = state.sight, state.requests
        self.inbox, self.losses = list(state.inbox), list(state.losses)
        self.has_news = bool(self.inbox or self.losses)
        self.lost_at, self.stopped_at = state.lost_at, state.stopped_at
        self.words = state.words

    @property
    def left_at(self) -> float:
        """When it left its place; infinite while it stands there."""
        return self.sight.time if self.state == UNDER_WAY and self.sight is not None else inf


class World:
    """One run of one scenario.

    Attributes:
        time: virtual time of the present instant.
        bodies: the robots, by id.
        tags: the tag of each place.
        revisions: how often each tag was written.
        refusals: what each robot that broke a rule was told.
        struck: numbers of the scheduled faults that were due; not of a kill of a robot that was lost
            or had stopped before.
        struck_at: when each of these was due.
        on_write: as of the constructor.
    """

    def __init__(
        self,
        scenario: Scenario,
        terrain: Terrain,
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
        self.struck_at: list[float] = []
        self._scenario = scenario
        self._terrain = terrain
        self._starts = tuple(starts)
        self._leave = terrain.leave
        self._sense, self._see = terrain.sense, terrain.see
        self._blind, self._eyes = _eyes_of(scenario, terrain)
        self._steering = steering_of(scenario, terrain, self._starts)
        self._believed = None if self._steering is None else self._steering.believed
        self._observe = observe
        self.on_write = on_write
        self._clock = clock = clock_of(scenario, terrain.length)
        self._tick = clock.tick
        self._move_duration = clock.move_duration
        self._wait_duration = clock.wait_duration
        self._agenda: Agenda[Body] = Agenda()
        self._in_air: Agenda[tuple[Body, int, bytes]] = Agenda()
        self._capacity = scenario.device.capacity
        self._rounds_max = scenario.clock.rounds_max
        self._radio = radio_of(scenario, terrain)
        self._latency = scenario.radio.latency
        self._ether = ether_of(scenario)
        self._notices_reach = scenario.radio.heartbeat == "reach"
        self._resting: dict[int, list[Body]] = {}  # by place: those that wait or have stopped
        self._in_turn: dict[int, list[Body]] = {}  # by place: those that take a turn this round
        self._next: list[Body] = []
        self._alive = len(self.bodies)
        self._round = -1
        self._wave = 0
        old_tags = self._capacity and not scenario.bookkeeping.fresh
        self._unseen = set(range(len(terrain))) if old_tags else None
        numbered = list(enumerate(scenario.faults))
        timed = [(fault.at, index, fault) for index, fault in numbered if fault.at is not None]
        self._faults = [(at, fault.round, index, fault) for at, index, fault in timed]
        self._faults.sort(key=lambda fault: fault[:3], reverse=True)
        self._at_request: dict[tuple[int, int], list[int]] = {}
        for index, fault in numbered:
            if fault.trigger is not None:
                self._at_request.setdefault(fault.trigger, []).append(index)
        self._destroyed: set[int] = set()  # places whose device is no more
        self._visited: set[int] = set()
        self._moves = 0
        self._when_quiet: Callable[[WorldState], None] | None = None
        self._play = self._run(begun=False)

    # Inputs and outputs.

    def begin(self) -> Output:
        """Start the run and return the first output."""
        return next(self._play)

    def resume(self, given: Input) -> Output:
        """Give the input that the last output asked for and return the next output."""
        return self._play.send(given)

    def briefing(self, robot: int, nonce: str = "") -> Briefing:
        """Return what ``robot`` may know beforehand."""
        scenario, terrain = self._scenario, self._terrain
        radio, on_grid = scenario.radio, isinstance(terrain, GridTerrain)
        is_blind = robot in self._blind
        known_map, known_graph = None, None
        if scenario.sensing.map and not is_blind:
            if isinstance(terrain, GridTerrain):
                known_map = terrain.known_map(self._starts)
            else:
                known_graph = terrain.known_graph(self._starts)
        return Briefing(
            robot,
            scenario.team.robots,
            scenario.seed,
            scenario.algorithm,
            scenario.algorithm_options,
            self._capacity,
            radio.heartbeat or "global",
            scenario.bookkeeping.fresh,
            RadioFacts(radio.reach or "none", radio.latency, radio.loss > 0),
            self._senses(is_blind=is_blind),
            terrain.position(self._starts[robot]) if on_grid and not is_blind else None,
            any(fault.word in TAG_WORDS for fault in scenario.faults),
            known_map,
            known_graph,
            scenario.clock.mode == "lockstep",
            scenario.team.parents,
            nonce,
        )

    def _senses(self, *, is_blind: bool) -> SensingFacts:
        """Return how a robot senses."""
        sensing, terrain = self._scenario.sensing, self._terrain
        bodies_block = self._scenario.world.bodies == "block"
        if is_blind:
            return SensingFacts("none", bodies_block=bodies_block)
        range_cells, robots_cells = (
            in_sub_cells(length, terrain.grid)
            if isinstance(terrain, GridTerrain) and length is not None
            else 0.0
            for length in (sensing.range_m, sensing.robots_m)
        )
        mode = sensing.mode or "ports"
        return SensingFacts(mode, terrain.window, range_cells, bodies_block, robots_cells)

    def alive(self) -> int:
        """Return how many robots are neither lost nor stopped."""
        return self._alive

    def progress(self) -> Progress:
        """Return how far the run is."""
        return Progress(
            self.time,
            self._moves,
            len(self._visited),
            self._alive,
            tuple((b.robot, b.lost_at) for b in self.bodies if b.lost_at is not None),
        )

    def waiting(self) -> list[tuple[int, int]]:
        """Return the robots that wait for news, and the place of each."""
        return [(body.robot, body.place) for body in self.bodies if body.state == WAITING_FOR_NEWS]

    # The state between two instants.

    def when_quiet(self, take: Callable[[WorldState], None]) -> None:
        """Have ``take`` called with the state once the present instant is over: nobody is in turn."""
        self._when_quiet = take

    def state(self) -> WorldState:
        """Return what determines the future, between two instants."""
        agenda, resting = self._agenda.planned(), self._resting.items()
        return WorldState(
            self.time,
            [body.as_state() for body in self.bodies],
            tags_state(self.revisions, self.tags),
            self._destroyed.copy(),
            None if self._unseen is None else self._unseen.copy(),
            self.refusals.copy(),
            list(zip(self.struck, self.struck_at, strict=True)),
            len(self._faults),
            list(self._at_request),
            [(time, [body.robot for body in bodies]) for time, bodies in agenda],
            [
                (time, [(body.robot, sender, message) for body, sender, message in heard])
                for time, heard in self._in_air.planned()
            ],
            {place: [body.robot for body in bodies] for place, bodies in resting},
            self._visited.copy(),
            self._moves,
            states_of(self._clock.streams),
            [] if self._ether is None else states_of([self._ether.stream]),
            None if self._steering is None else self._steering.state(),
        )

    def restore(self, state: WorldState) -> None:
        """Go on as another world of this scenario did from this state; in place of a beginning.

        `begin` returns what came next there. Trace and writes up to here are not told again.
        """
        bodies = self.bodies
        self.time = state.time
        for body, was in zip(bodies, state.bodies, strict=True):
            body.restore(was)
        self._alive = sum(body.state < STOPPED for body in bodies)
        put_tags_back(state.tags, self.revisions, self.tags)
        self._destroyed = state.destroyed.copy()
        self._unseen = None if state.unseen is None else state.unseen.copy()
        self.refusals = state.refusals.copy()
        self.struck = [fault for fault, _ in state.struck]
        self.struck_at = [time for _, time in state.struck]
        del self._faults[state.faults_left :]
        self._at_request = {key: self._at_request[key] for key in state.at_request}
        self._agenda = Agenda((time, [bodies[i] for i in robots]) for time, robots in state.agenda)
        self._in_air = Agenda(
            (time, [(bodies[robot], sender, message) for robot, sender, message in heard])
            for time, heard in state.in_air
        )
        self._resting = {
            place: [bodies[i] for i in robots] for place, robots in state.resting.items()
        }
        self._visited = state.visited.copy()
        self._moves = state.moves
        put_back(self._clock.streams, state.jitter)
        if self._ether is not None:
            put_back([self._ether.stream], state.ether)
        if self._steering is not None and state.steering is not None:
            self._steering.restore(state.steering)
        self._play = self._run(begun=True)

    # One run.

    def _run(self, *, begun: bool) -> Generator[Output, Input, None]:
        if not begun:
            yield from self._serve(self.bodies)
        while self._alive:
            if self._when_quiet is not None and not self._next:
                take, self._when_quiet = self._when_quiet, None
                take(self.state())
            if not self._next and not self._advance():
                yield End("stalled")
                return
            yield from self._instant()
        yield End("over")

    def _advance(self) -> bool:
        """Go to the next event; tell whether there is one."""
        arrival = self._agenda.next_time()
        if self._ether is not None:
            heard = self._in_air.next_time()
            if heard is not None and (arrival is None or heard < arrival):
                arrival = heard
        if self._faults and (arrival is None or self._faults[-1][0] < arrival):
            self.time = self._faults[-1][0]
        elif arrival is not None:
            self.time = arrival
        else:
            return False
        arrived = self._next
        for body in self._agenda.take(self.time):
            if body.due != self.time:
                continue  # woken earlier, and about something else since
            if body.state == UNDER_WAY:
                left = body.place
                body.place, body.entry = body.destination
                self._moves += 1
                if self._steering is not None:
                    self._steering.arrived(body, left)
            elif body.state not in (WAITING, WAITING_FOR_NEWS):
                continue
            body.state = IN_TURN
            arrived.append(body)
        for body, sender, message in self._in_air.take(self.time):
            self._deliver(body, sender, message)
        return True

    def _instant(self) -> Generator[Output, Input, None]:
        self._round = 0
        requests_before: dict[int, int] = {}  # by robot: when its first round but round 0 began
        while True:
            yield from self._strike(self._round)
            if not self._next:
                yield from self._strike(None)  # there are no more rounds
                if not self._next:
                    return
            in_turn, self._next = self._next, []
            if self._resting:
                for body in in_turn:
                    self._rise(body)
            in_turn = [body for body in in_turn if body.state == IN_TURN]
            if not in_turn:
                continue
            in_turn.sort(key=attrgetter("robot"))
            if self._round:
                for body in in_turn:
                    requests_before.setdefault(body.robot, body.requests)
                if self._round >= self._rounds_max:
                    in_turn = self._refuse_restless(in_turn, requests_before)
            for index, wave in enumerate(self._waves(in_turn)):
                self._wave = index
                yield from self._serve(wave)
            self._round += 1

    def _refuse_restless(self, in_turn: list[Body], before: dict[int, int]) -> list[Body]:
        """Refuse those that have acted in every round; return the others."""
        self._wave = -1
        others = []
        for body in in_turn:
            if body.requests - before[body.robot] < self._rounds_max - 1:
                others.append(body)
                continue
            detail = f"more than {self._rounds_max} free requests in the instant {self.time}"
            self._refuse(body, RoundsError(detail))
        return others

    def _waves(self, in_turn: list[Body]) -> list[list[Body]]:
        """Cut a round into waves: where there are devices, one robot a place."""
        at: dict[int, list[Body]] = {}
        for body in in_turn:
            place = body.place
            if place in at:
                at[place].append(body)
            else:
                at[place] = [body]
        self._in_turn = at
        if self._round == 0:
            self._visited.update(at)
        if len(at) == len(in_turn) or not self._capacity:
            return [in_turn]
        waves: list[list[Body]] = [[] for _ in range(max(map(len, at.values())))]
        for body in in_turn:
            waves[at[body.place].index(body)].append(body)
        return waves

    def _strike(self, round_: int | None) -> Generator[Output, Input, None]:
        """Carry out the faults of this instant up to ``round_``; ``None``: all of them."""
        while self._faults and self._faults[-1][0] == self.time:
            _, due, index, fault = self._faults[-1]
            if round_ is not None and due > round_:
                return
            self._faults.pop()
            self._wave = -1
            yield from self._befall(index, fault)

    def _befall(self, index: int, fault: Fault) -> Generator[Output, Input, None]:
        """Carry out one fault, or have it carried out."""
        if fault.robot is not None and self._scenario.team.on_crash == "lost":
            yield from self._kill(index, self.bodies[fault.robot])
            return
        self._note(index)
        if fault.word not in TAG_WORDS:
            yield FaultOrder(index)
            return
        place = fault.place
        assert place is not None
        if self._unseen and place in self._unseen:  # the store has to know what is gone
            self._take_old_tags((yield TagsWanted((place,))))
            self._unseen.discard(place)
        self._fail_device(index, fault.word, place)

    def _fail_device(self, index: int, word: str, place: int) -> None:
        """Erase or corrupt the tag of a place, or destroy its device.

        A device counts its writes apart from its tag, so a tag that was erased is blank and has a
        revision; one that was destroyed has neither.
        """
        tag = self.tags[place]
        if word == "corrupt_tag" and not self._scenario.device.checksum:
            stream = spawn(self._scenario.seed, "corrupt", index)
            bits = int.from_bytes(tag, "little")
            for _ in range(stream.randint(1, CORRUPT_BITS_MAX) if tag else 0):
                bits ^= 1 << stream.randrange(8 * len(tag))
            tag = bits.to_bytes(len(tag), "little")
        else:
            tag = b""
        if place not in self._destroyed:
            self.tags[place] = tag
            self.revisions[place] += 1
            if self.on_write is not None:
                self.on_write(place, self.revisions[place], tag)
        if word == "destroy_tag":
            self._destroyed.add(place)
            self.revisions[place] = 0
        if self._observe is not None:
            what = DEVICE_FAULTS[word]
            self._observe(Event(self.time, self._round, self._wave, NOBODY, place, None, what, 0))
        self._wake(self._resting.get(place, ()))

    def _kill(self, fault: int, victim: Body) -> Generator[Output, Input, None]:
        if victim.state < STOPPED:
            yield KillOrder(fault, victim.robot)
            self._note(fault)
            self._lose(victim, "killed")

    def _note(self, fault: int) -> None:
        self.struck.append(fault)
        self.struck_at.append(self.time)

    # One wave.

    def _serve(self, wave: list[Body]) -> Generator[Output, Input, None]:
        """Give each robot of a wave its sight, and apply what they answer."""
        if self._at_request:
            for body in wave:
                for index in self._at_request.pop((body.robot, body.requests + 1), ()):
                    yield from self._befall(index, self._scenario.faults[index])
        if self._unseen:
            places = self._unseen.intersection(body.place for body in wave)
            if places:
                self._take_old_tags((yield TagsWanted(tuple(sorted(places)))))
                self._unseen -= places
        wave = [body for body in wave if body.state == IN_TURN]
        if not wave:
            return
        sights: list[AnySight | None] = (
            [None] * len(wave) if self._round < 0 else self._sights(wave)
        )
        robots = [body.robot for body in wave]
        answers = yield Wave(self.time, self._round, self._wave, robots, sights)
        assert isinstance(answers, Answers)
        for robot, cause in answers.lost:
            if self.bodies[robot].state < STOPPED:
                self._lose(self.bodies[robot], cause)
        self._apply(wave, answers.requests)

    def _sights(self, wave: list[Body]) -> list[AnySight | None]:
        """Return what each robot of a wave sees."""
        time, sense, tags, revisions = self.time, self._sense, self.tags, self.revisions
        see, believed, stride = self._see, self._believed, self._terrain.stride
        blind, has_eyes = self._blind, self._eyes is not None
        in_turn_at, resting_at, first_round = self._in_turn, self._resting, self._round == 0
        sights: list[AnySight | None] = []
        present_at: dict[int, list[int]] = {}
        for body in wave:
            place = body.place
            in_turn = in_turn_at[place]
            here: tuple[int, ...] = ()
            if len(in_turn) > 1 or place in resting_at:
                if place not in present_at:
                    present = [other.robot for other in in_turn if other.state == IN_TURN]
                    present += [other.robot for other in resting_at.get(place, ())]
                    present_at[place] = sorted({*present})  # who was woken is in both
                present = present_at[place]
                at = present.index(body.robot)
                here = (*present[:at], *present[at + 1 :])
            inbox: tuple[tuple[int, bytes], ...] = ()
            losses: tuple[int, ...] = ()
            if body.has_news:
                inbox, losses = tuple(body.inbox), tuple(body.losses)
                body.inbox.clear()
                body.losses.clear()
                body.has_news = False
            alone = first_round and len(in_turn) == 1
            entry, tag, revision = body.entry, tags[place], revisions[place]
            sight: AnySight
            if see is None:
                sight = Sight(
                    time, place, entry, sense(place), tag, revision, alone, here, inbox, losses
                )
            elif body.robot in blind:
                here, alone = (), False
                sight = Sight(
                    time, UNKNOWN_PLACE, entry, 4, tag, revision, alone, here, inbox, losses
                )
            else:
                position = divmod(place, stride) if believed is None else believed[body.robot]
                sight = GridSight(
                    time,
                    place if believed is None else UNKNOWN_PLACE,
                    entry,
                    sense(place),
                    tag,
                    revision,
                    alone,
                    here,
                    inbox,
                    losses,
                    position,
                    see(place, position, body.gaze),
                )
                if has_eyes:
                    sight = TeamSight(**asdict(sight), robots=self._robots_seen(body, position))
            body.sight = sight
            sights.append(sight)
        return sights

    def _robots_seen(
        self, body: Body, position: tuple[int, int]
    ) -> tuple[tuple[int, tuple[int, int]], ...]:
        """Return the others that a robot sees which takes itself to be at ``position``."""
        assert self._eyes is not None
        stride = self._terrain.stride
        others = [other for other in self.bodies if other.state != LOST]
        row, col = divmod(body.place, stride)
        down, right = position[0] - row, position[1] - col
        seen = [
            (other.robot, divmod(other.place, stride))
            for other in in_reach(self._eyes, body, others, self.time)
        ]
        return tuple((robot, (row + down, col + right)) for robot, (row, col) in seen)

    def _apply(  # noqa: C901, PLR0915  see below
        self, wave: list[Body], requests: list[AnyRequest | None]
    ) -> None:
        """Let the requests of a wave take place, lowest id first.

        A request that the world does not allow does not happen, and its robot is out. This is the
        heart of every run, so it is one function: a call less a step is a tenth of its time.
        """
        time, observe, tick, leave = self.time, self._observe, self._tick, self._leave
        steering = self._steering
        tags, revisions, on_write = self.tags, self.revisions, self.on_write
        capacity, resting_at, destroyed = self._capacity, self._resting, self._destroyed
        due, agenda = -1.0, None
        for body, asked in zip(wave, requests, strict=True):
            if body.state != IN_TURN or asked is None:
                continue  # lost since its turn came
            request = asked
            kind = request.__class__
            place = body.place
            sight = body.sight
            tag = request.tag
            try:
                if kind is Move:
                    exit_ = request.exit  # type: ignore[union-attr]
                    if request.gaze is not None:  # type: ignore[union-attr]
                        self._turn(body, request.gaze)  # type: ignore[union-attr]
                    body.destination = leave(place, exit_)
                elif kind is Look and request.gaze is not None:  # type: ignore[union-attr]
                    self._turn(body, request.gaze)  # type: ignore[union-attr]
                elif kind is Wait or kind is WaitForNews:
                    request, ends = self._end_of(request)  # type: ignore[arg-type]
                if sight is None and kind is not Look:
                    found = kind.__name__.lower()
                    raise OpeningError(f"the first request is a {found}; expected a look")
                if tag is not None and (len(tag) > capacity or not capacity):
                    raise self._tag_error(place, tag)
            except RuleError as error:
                self._refuse(body, error)
                continue
            body.requests += 1
            if observe is not None:
                digest = 0 if sight is None else crc32(encode(sight))
                robot, entry = body.robot, body.entry
                observe(Event(time, self._round, self._wave, robot, place, entry, request, digest))
            if destroyed and place in destroyed:
                tag = None  # whoever writes there cannot tell
            if tag is not None:
                tags[place] = tag
                revisions[place] += 1
                if on_write is not None:
                    on_write(place, revisions[place], tag)
                if place in resting_at:
                    self._wake(resting_at[place])
            if kind is Move:
                if steering is not None:  # it takes up room, so nothing is refused from here on
                    body.destination = steering.leave(body, exit_)
                body.state = UNDER_WAY
                duration = tick or self._move_duration(body.robot, place, exit_)
                arrival = time + duration
                if arrival <= time:  # however short a way is, one arrives later
                    arrival = nextafter(time, inf)
                body.due = arrival
                if arrival != due or agenda is None:  # in lockstep all arrive together
                    due, agenda = arrival, self._agenda.at(arrival)
                agenda.append(body)
            elif kind is Wait or kind is WaitForNews:
                body.state = WAITING if kind is Wait else WAITING_FOR_NEWS
                body.due = ends
                if ends < inf:
                    self._agenda.at(ends).append(body)
                self._resting.setdefault(place, []).append(body)
                if kind is WaitForNews and sight is not None:
                    body.words = request.words  # type: ignore[union-attr]
                    own = tag is not None
                    heard = body.losses or len(body.inbox) >= body.words
                    if heard or revisions[place] != sight.revision + own:
                        self._wake([body])
            elif kind is Stop:
                body.state = STOPPED
                body.stopped_at = time
                self._resting.setdefault(place, []).append(body)
                self._alive -= 1
            else:
                self._next.append(body)
            if request.messages:
                self._send(body, request.messages)

    def _end_of(self, request: Wait | WaitForNews) -> tuple[Wait | WaitForNews, float]:
        """Return a wait as the trace spells it, with times as floats, and when it ends.

        Raises:
            DurationError: If it is no time that one can wait.
        """
        bound = request.duration if isinstance(request, Wait) else request.at_most
        if bound is None:
            return request, inf
        duration = self._wait_duration(bound)
        ends = self.time + duration
        if ends <= self.time:
            raise DurationError(f"wait of {duration} at {self.time}: too short to be told apart")
        if isinstance(request, Wait):
            return Wait(request.tag, request.messages, duration), ends
        return WaitForNews(request.tag, request.messages, duration, request.words), ends

    # What a request, or a loss, brings about.

    def _tag_error(self, place: int, tag: bytes) -> TagError:
        fits = f"the device holds {self._capacity}" if self._capacity else "there is no device"
        return TagError(f"tag of {len(tag)} bytes at place {place}; {fits}")

    def _send(self, sender: Body, messages: Iterable[bytes]) -> None:
        receivers = [body for body in self.bodies if body.state < STOPPED]
        receivers = in_reach(self._radio, sender, receivers, self.time)
        if self._ether is not None:
            self._send_through(self._ether, sender.robot, receivers, messages)
            return
        sent = [(sender.robot, message) for message in messages]
        for receiver in receivers:
            receiver.inbox.extend(sent)
            receiver.has_news = True
        self._wake(body for body in receivers if len(body.inbox) >= body.words)

    def _send_through(
        self, ether: Ether, sender: int, receivers: Iterable[Body], messages: Iterable[bytes]
    ) -> None:
        """Send messages that may come late, twice or not at all."""
        due = self.time + self._latency
        for receiver in receivers:
            for message in messages:
                for _ in range(ether.copies()):
                    if due > self.time:
                        self._in_air.at(due).append((receiver, sender, message))
                    else:
                        self._deliver(receiver, sender, message)

    def _deliver(self, receiver: Body, sender: int, message: bytes) -> None:
        if receiver.state < STOPPED:
            receiver.inbox.append((sender, message))
            receiver.has_news = True
            if len(receiver.inbox) >= receiver.words:
                self._wake((receiver,))

    def _turn(self, body: Body, gaze: int) -> None:
        """Let a body look in another direction.

        Raises:
            GazeError: If there is no such direction, or nothing to look with.
        """
        if self._see is None:
            raise GazeError(f"gaze {gaze} on a graph; expected none")
        if not 0 <= gaze < 4:
            raise GazeError(f"gaze {gaze}; expected 0 (north), 1, 2 or 3 (west)")
        body.gaze = gaze

    def _wake(self, bodies: Iterable[Body]) -> None:
        """Let those of ``bodies`` that wait for news take their turn in the next round."""
        for body in bodies:
            if body.state == WAITING_FOR_NEWS:
                body.state = IN_TURN
                self._next.append(body)

    def _rise(self, body: Body) -> None:
        """Take a body from those that rest at its place, if it is one of them."""
        resting = self._resting.get(body.place, [])
        if body in resting:
            resting.remove(body)
            if not resting:
                del self._resting[body.place]

    def _refuse(self, body: Body, error: RuleError) -> None:
        self.refusals[body.robot] = Refusal(type(error).__name__, str(error))
        self._lose(body, "refused")

    def _lose(self, victim: Body, cause: LossCause) -> None:
        """Let a robot be lost: its body stays, harmless; those who hear of it get notice."""
        under_way = victim.state == UNDER_WAY
        if not under_way:
            self._rise(victim)
        elif self._steering is not None:
            self._steering.lost(victim)
        hearers = [body for body in self.bodies if body.state < STOPPED and body is not victim]
        if self._notices_reach:
            hearers = in_reach(self._radio, victim, hearers, self.time)
        victim.state = LOST
        victim.lost_at = self.time
        self._alive -= 1
        if self._observe is not None:
            place = None if under_way else victim.place
            robot, entry = victim.robot, victim.entry
            self._observe(Event(self.time, self._round, self._wave, robot, place, entry, cause, 0))
        for hearer in hearers:
            hearer.losses.append(victim.robot)
            hearer.has_news = True
        self._wake(hearers)

    def _take_old_tags(self, given: Input) -> None:
        assert isinstance(given, tuple)
        for old in given:
            self.tags[old.place] = old.tag
            self.revisions[old.place] = old.revision


def _eyes_of(scenario: Scenario, terrain: Terrain) -> tuple[frozenset[int], RadiusRadio | None]:
    """Return the robots that see nothing, and how far the others see robots: as a radio carries."""
    if not isinstance(terrain, GridTerrain):
        return frozenset(), None
    parents, robots_m = scenario.team.parents, scenario.sensing.robots_m
    blind = () if parents is None else range(parents, scenario.team.robots)
    eyes = None if robots_m is None else RadiusRadio(terrain.grid, robots_m, line_of_sight=True)
    return frozenset(blind), eyes
