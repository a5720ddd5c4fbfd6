"""ORMSTC on a radio that loses messages, or does not reach everybody.

The paper (Agmon, Hazon, Kaminka 2008, Sec. 4) assumes that every message is heard by all. What is left
of its claims where that is not so, with up to k - 1 losses, on both clocks and with any latency:

    radio                                    Theorem 4  Theorem 5  Theorem 6  ends
    global, with loss and duplicates         yes        yes (1)    yes        yes
    limited, all in touch at all times       yes        yes (2)    yes        yes
    limited, some out of touch at times      yes        no         yes        yes
    none                                     yes        no         yes        yes

Limited is ``radius``, with or without line of sight, and ``same-place``; in touch means that the radio
graph is connected. The price of being out of touch are repeated visits, up to k times the work.

1. Unless a robot that lives is not heard for 256 time units on end.
2. Over at most `HOPS` relays, without loss, under the lockstep clock. With loss, or where a move takes
   longer than ``patience``, two robots may now and then cover one cell.

The same holds with ``heartbeat = "reach"``: a loss that nobody hears of is a silence like any other.
All this takes bodies that do not block and robots that know where they are; where not, runs still end.

*Notes.* What a robot has to say are *notes*, which it numbers: where it starts, what it claims and
gives up, and, when it closes a lap, that its cells are covered and which other free cells lie beside
them. All keep the notes of all, each robot's in order, and pass on what others lack (`Gossip`). On the
air go packets: *rows*, each of which tells how many notes of each robot some robot had at some time,
the sender's own and those that it has heard; and notes that robots nearby lack, as their rows say.

*Claims* (R9). A cell is entered when every other robot that is not known to be dead has the claim,
this robot has all that they had said when they had it, and no claim on the cell is older (of one
instant: of better rank); if one is, the claim is given up. So of two robots that claim a cell each
waits until the other has its claim, and until it has what the other had said before. Who heard of the
other's claim before it made its own would not have made it; hence both know of both claims, and agree.
A robot that was not heard for ``patience`` is not waited for: that is where Theorem 5 ends, and
nothing else does.

*The end* (R6, R7, R10). That a cell is covered is a fact, whatever becomes of those who covered it. A
robot is *done* when the covered cells that hang together with its start have no other free cell beside
them that it knows of. Then there is none: a free cell beside a covered one is of the same robot, and
was covered with it, or that robot has told of it. So nobody stops on an assumption, and Theorems 4 and
6 do not depend on the radio: what a robot is not told it covers itself.

*Giving up.* A robot that has closed its lap but is not done waits for those who own what is left, or
what lies beside it. Who is silent for long (16 time units, more with relays and latency; 256 where the
radio reaches all) is taken for lost until it is heard again, and what it has not covered is open; what
it has covered is opened only if it is in the way. If for as long nobody hears anything new, though all
that are heard have nothing to do, each takes all others for lost. A robot that has nobody left to wait
for covers all that is left; as its tree only grows, this ends. Who is done stays while it hears others
that are not.

*Traffic.* A request carries at most one packet, of at most `NOTES` notes and `ROWS` + 1 rows. One goes
out with each move, in each time unit of a wait, with each claim, and in answer to notes that were new,
once an instant; a packet without new notes is not answered. So a robot sends at most four in an
instant.

Departure: even where nothing is lost, claims take a tick or two, since others are under way when they
are made.
"""

from collections.abc import Iterable
from functools import lru_cache
from math import inf
from types import coroutine
from typing import Any

from msgspec import Struct
from msgspec.structs import replace

from agents.algorithms.claims import AnyNote, Claim, Claims, Note, Retract, Start
from agents.algorithms.ormstc import Explorer, Options
from agents.algorithms.stc import AWAY
from agents.body import Ask, Body
from protocol.codec import decoder_of, encode
from protocol.messages import Briefing, GridSight, Stop

NOTES = 32
"""A packet holds at most so many notes."""

NOTES_EACH = 8
"""Of these at most so many of one robot to one robot that lacks them."""

HOPS = 8
"""A robot that is heard over so many relays is waited for, unless ``patience`` says otherwise."""

CELLS = 64
"""A note tells of at most so many cells."""

ROWS = 16
"""A packet holds the rows of at most so many other robots."""


class Beside(Note, frozen=True, tag="beside"):
    """These cells are free; they lie beside the sender's own, and are not its own."""

    cells: tuple[int, ...]


class Covered(Note, frozen=True, tag="covered"):
    """Every cell that the sender has claimed so far, and not given up, is covered (Alg. 3 l. 24).

    All free cells beside these are its own, too, or it has told of them.
    """


class Row(Struct, frozen=True, array_like=True, forbid_unknown_fields=True, gc=False):
    """What one robot had heard at a time.

    Attributes:
        robot: which robot.
        time: when that was.
        counts: how many notes of each robot it had.
        rests: whether it had nothing to do.
        done: whether it knew that everything is covered that can be reached from its start.
    """

    robot: int
    time: float
    counts: tuple[int, ...]
    rests: bool = False
    done: bool = False


class Packet(
    Struct, frozen=True, array_like=True, forbid_unknown_fields=True, tag="packet", gc=False
):
    """What goes on the air.

    Attributes:
        rows: the sender's row, and the newest that it has of others.
        notes: origin, number, and the note itself.
        lost: robots known to be dead, where not everybody hears of a loss.
        done: robots from whose starts nothing that is not covered can be reached.
    """

    rows: tuple[Row, ...]
    notes: tuple[tuple[int, int, bytes], ...] = ()
    lost: tuple[int, ...] = ()
    done: tuple[int, ...] = ()


GossipNote = Start | Claim | Retract | Beside | Covered

_decode_note: Any = decoder_of(GossipNote)  # type: ignore[arg-type]
_decode_packet: Any = decoder_of(Packet)


@lru_cache(maxsize=4096)
def read_note(data: bytes) -> GossipNote:
    """Decode a note.

    Raises:
        MessageError: If it is none.
    """
    note: GossipNote = _decode_note(data)
    return note


@lru_cache(maxsize=1024)
def read_packet(data: bytes) -> Packet:
    """Decode a message.

    Raises:
        MessageError: If it is none.
    """
    packet: Packet = _decode_packet(data)
    return packet


class Gossip(Body):
    """A body whose radio repeats what others lack, and forwards it.

    The messages that it is given are notes; what it hears are notes too, those of each robot in the
    order in which they were said, whoever they came from.

    Attributes:
        logs: the notes of each robot, as far as they are known without a gap.
        rows: the newest row of each robot.
        lost: robots known to be dead.
        done: robots from whose starts nothing that is not covered can be reached, as far as is known.
        rests: whether it has nothing to do.
        now: when it saw something last.
        news_at: when it last heard that some robot had heard something new.
        patience: how old the row of a robot may be that this one waits for before it enters a cell.
        lately: how old the row of a robot may be that is sent what it lacks.
        quiet: how old the row of a robot is that is taken for lost.
        linger: how old the row of a robot may be that one that is done stays for.
        speaks: whether anybody can hear it.
    """

    __slots__ = (
        "_early",
        "_owes",
        "_replied",
        "_sent",
        "_spoke",
        "_tells_losses",
        "_turn",
        "done",
        "lately",
        "linger",
        "logs",
        "lost",
        "news_at",
        "now",
        "patience",
        "quiet",
        "rests",
        "rows",
        "speaks",
    )

    def __init__(self, briefing: Briefing, patience: float | None) -> None:
        super().__init__(briefing)
        radio, robots = briefing.radio, range(self.team_size)
        nothing = (0,) * self.team_size
        self.logs: list[list[bytes]] = [[] for _ in robots]
        self.rows = [Row(robot, 0.0, nothing) for robot in robots]
        self.lost: set[int] = set()
        self.done: set[int] = set()
        self.rests = False
        self.now = 0.0
        self.news_at = 0.0
        relayed = min(self.team_size - 1, HOPS) * (1 + radio.latency)
        self.linger = max(16.0, 4 * relayed)
        if radio.reach == "global":
            self.lately, self.quiet = inf, max(256.0, self.linger)
        else:
            self.lately, self.quiet = max(4.0, relayed), self.linger
        self.patience = self.lately if patience is None else patience
        self.lately = max(self.lately, self.patience)
        self.speaks = radio.reach != "none" and self.team_size > 1
        self._tells_losses = briefing.heartbeat == "reach"
        self._early: list[dict[int, bytes]] = [{} for _ in robots]
        self._sent = 0  # so many of its own notes
        self._spoke = -inf
        self._owes = False  # a reply to new notes
        self._replied = -inf
        self._turn = 0

    # Requests.

    @coroutine
    def look(self, *, gaze: int | None = None, messages: tuple[bytes, ...] = ()) -> Ask:
        """See this place (free)."""
        said = self._said(messages)
        return self._heard((yield from super().look(gaze=gaze, messages=said)))

    @coroutine
    def exchange(self, *messages: bytes) -> Ask:
        """Send notes and see what has come by the next round (free)."""
        return self._heard((yield from super().exchange(*self._said(messages))))

    @coroutine
    def move(
        self,
        exit_: int,
        *,
        gaze: int | None = None,
        tag: bytes | None = None,
        messages: tuple[bytes, ...] = (),
    ) -> Ask:
        """Leave by port ``exit_`` and arrive (one move)."""
        said = self._said(messages, always=True)
        return self._heard((yield from super().move(exit_, gaze=gaze, tag=tag, messages=said)))

    @coroutine
    def wait(
        self, duration: float = 1.0, *, tag: bytes | None = None, messages: tuple[bytes, ...] = ()
    ) -> Ask:
        """Stay for ``duration`` time units (that many ticks in lockstep)."""
        said = self._said(messages, always=True)
        return self._heard((yield from super().wait(duration, tag=tag, messages=said)))

    @coroutine
    def wait_for_news(
        self,
        *,
        at_most: float | None = None,
        tag: bytes | None = None,
        messages: tuple[bytes, ...] = (),
    ) -> Ask:
        """Stay until a message or a loss notice; or ``at_most`` so long."""
        said = self._said(messages)
        return self._heard(
            (yield from super().wait_for_news(at_most=at_most, tag=tag, messages=said))
        )

    def last_words(self, *, tag: bytes | None = None, messages: tuple[bytes, ...] = ()) -> Stop:
        """Return what the algorithm returns to stop (free)."""
        return super().last_words(tag=tag, messages=self._said(messages, always=True))

    def say(self, *notes: bytes) -> None:
        """Number notes; they go out with the next request."""
        self.logs[self.robot] += notes

    # What it knows of others.

    def is_silent(self, robot: int) -> bool:
        """Tell whether nothing was heard of a robot for long."""
        return self.now - self.rows[robot].time >= self.quiet

    def is_near(self, robot: int) -> bool:
        """Tell whether a robot was heard of lately."""
        age = self.now - self.rows[robot].time
        return self.speaks and age <= self.lately and age < self.quiet

    def waits_for(self, robot: int) -> bool:
        """Tell whether a robot was heard of so recently that an answer of it is worth a wait."""
        row = self.rows[robot]
        return self.is_near(robot) and self.now - row.time <= self.patience and not row.done

    def is_idle(self, robot: int) -> bool:
        """Tell whether no work of a robot can be the reason that nothing new was heard for long."""
        row = self.rows[robot]
        idle = (row.rests or row.done) and self.now - self.news_at >= self.quiet
        return idle or self.is_silent(robot)

    def lingers_for(self, robot: int) -> bool:
        """Tell whether a robot is not done and was heard of lately."""
        row = self.rows[robot]
        return self.speaks and not row.done and self.now - row.time < self.linger

    # Packets.

    def _heard(self, here: GridSight) -> GridSight:
        """Turn what came into notes that are new, and losses that are."""
        self.now = here.time
        if not here.inbox and not here.losses:
            return here
        news: list[tuple[int, bytes]] = []
        losses = list(here.losses)
        for _, data in here.inbox:
            packet = read_packet(data)
            for row in packet.rows:
                held = self.rows[row.robot]
                if row.time > held.time or (row.time == held.time and row.counts > held.counts):
                    self.rows[row.robot] = row
                    if row.counts != held.counts:
                        self.news_at = self.now
            for origin, number, note in packet.notes:
                self._file(origin, number, note, news)
            losses += packet.lost
            self.done.update(packet.done)
        losses = [robot for robot in dict.fromkeys(losses) if robot not in self.lost]
        self.lost.update(losses)
        self._owes = self._owes or bool(news)
        return replace(here, inbox=tuple(news), losses=tuple(losses))

    def _file(self, origin: int, number: int, note: bytes, news: list[tuple[int, bytes]]) -> None:
        """Put a note into the log of its origin, or aside until those before it have come."""
        log, early = self.logs[origin], self._early[origin]
        if number > len(log):
            early[number] = note
        elif number == len(log):
            following: bytes | None = note
            while following is not None:
                log.append(following)
                news.append((origin, following))
                following = early.pop(len(log), None)

    def _said(self, notes: tuple[bytes, ...], *, always: bool = False) -> tuple[bytes, ...]:
        """Return what to send now; at any instant only new notes, and one reply to those of others."""
        self.say(*notes)
        if not self.speaks:
            return ()
        replies = self._owes and self._replied < self.now
        is_due = always or self.now - self._spoke >= 1.0
        if not (is_due or replies or self._sent < len(self.logs[self.robot])):
            return ()
        if self._owes:
            self._replied = self.now
        self._owes = False
        self._spoke = self.now
        return (encode(self._packet()),)

    def _packet(self) -> Packet:
        me, rows = self.robot, self.rows
        rows[me] = Row(me, self.now, tuple(map(len, self.logs)), self.rests, me in self.done)
        others = [(me + 1 + turn) % self.team_size for turn in range(self.team_size - 1)]
        self._turn = (self._turn + 1) % len(others)
        others = others[self._turn :] + others[: self._turn]
        known = [rows[other] for other in others if rows[other].time or any(rows[other].counts)]
        lost = tuple(sorted(self.lost)) if self._tells_losses else ()
        return Packet(
            (rows[me], *known[:ROWS]), self._lacking(others), lost, tuple(sorted(self.done))
        )

    def _lacking(self, others: list[int]) -> tuple[tuple[int, int, bytes], ...]:
        """Return its new notes, and what the robots nearby lack as far as it knows."""
        me, logs = self.robot, self.logs
        own = logs[me]
        sent, self._sent = self._sent, min(len(own), self._sent + NOTES)
        chosen = dict.fromkeys((me, number) for number in range(sent, self._sent))
        counts = self.rows[me].counts
        for other in others:
            theirs = self.rows[other].counts
            if theirs == counts or other in self.lost or not self.is_near(other):
                continue
            for origin in (me, *others):
                first, last = theirs[origin], counts[origin]
                for number in range(first, min(last, first + NOTES_EACH)):
                    if len(chosen) < NOTES:
                        chosen[origin, number] = None
        return tuple((origin, number, logs[origin][number]) for origin, number in chosen)


class GossipClaims(Claims):
    """One robot's copy of who owns what, and of what is covered for good.

    Attributes:
        missing: robots taken for lost; they are among the dead.
        held: the cells that each robot has claimed and not given up, whoever owns them.
        covered: cells that are covered, whatever becomes of those who did it.
        known: cells known to be free.
        starts: the cell where each robot started, as far as it was heard.
        freed: whether also what the dead had covered is open: it is in the way.
    """

    __slots__ = ("covered", "freed", "held", "known", "missing", "starts")

    def __init__(self, team_size: int, *, fewest: bool, lazy: bool) -> None:
        super().__init__(team_size, fewest=fewest, lazy=lazy, delayed=True)
        self.missing: set[int] = set()
        self.held: list[set[int]] = [set() for _ in range(team_size)]
        self.covered: set[int] = set()
        self.known: set[int] = set()
        self.starts: dict[int, int] = {}
        self.freed = False

    # What one can ask.

    def has_no_owner(self, cell: int) -> bool:
        """Tell whether nobody owns a cell, or only the dead do."""
        stake = self.owner.get(cell)
        return stake is None or stake[2] in self.dead

    def is_open(self, cell: int) -> bool:
        """Tell whether a cell is to be covered by whoever comes first."""
        if not self.has_no_owner(cell):
            return False
        if cell not in self.covered or self.freed:
            return True
        stake = self.owner.get(cell)
        return not self.lazy and stake is not None and stake[2] not in self.missing

    def around(self, start: int, walls: set[int]) -> tuple[set[int], set[int]]:
        """Return the covered cells that hang together with ``start``, and what is left beside them."""
        if start not in self.covered:
            return set(), {start}
        covered, left, ahead = {start}, set(), [start]
        while ahead:
            cell = ahead.pop()
            for away in AWAY:
                beside = cell + away
                if beside in self.covered and beside not in covered:
                    covered.add(beside)
                    ahead.append(beside)
                elif beside in self.known and beside not in covered and beside not in walls:
                    left.add(beside)
        return covered, left

    def awaited(self, left: set[int]) -> set[int]:
        """Return who is to cover these cells: their owners, or else those who own what is beside."""
        robots: set[int] = set()
        for cell in left:
            near = [cell + away for away in AWAY] if self.has_no_owner(cell) else [cell]
            robots.update(self.owner[at][2] for at in near if not self.has_no_owner(at))
        return robots

    # What one hears.

    def hear_all(self, inbox: Iterable[tuple[int, bytes]]) -> None:
        """Take in notes."""
        for sender, note in inbox:
            self.hear(sender, read_note(note))

    def hear(self, sender: int, note: AnyNote | Beside | Covered) -> None:
        """Take in a note; the dead own nothing, but what they have covered is covered."""
        if isinstance(note, Covered):
            self.covered |= self.held[sender]
            self.changed = True
        elif isinstance(note, Beside):
            self.known.update(note.cells)
        else:
            if isinstance(note, Claim | Start):
                self.known.add(note.cell)
                self.held[sender].add(note.cell)
            if isinstance(note, Start):
                self.starts[sender] = note.cell
            elif isinstance(note, Retract):
                self.held[sender].discard(note.cell)  # also of a robot that is dead
            super().hear(sender, note)

    def retract(self, cell: int, robot: int) -> None:
        """Let a robot give a cell up."""
        self.held[robot].discard(cell)
        super().retract(cell, robot)

    def free_the_spared(self) -> None:
        """Nobody is spared here: see `freed`."""

    def replay(self, logs: list[list[bytes]], dead: set[int], missing: set[int]) -> None:
        """Begin anew: hear all that was said, then who is dead or taken for lost."""
        self.owner.clear()
        self.rivals.clear()
        self.taken.clear()
        self.dead.clear()
        self.cells = [0] * self.team_size
        for held in self.held:
            held.clear()
        for origin, log in enumerate(logs):
            self.hear_all((origin, note) for note in log)
        for robot in sorted(dead | missing):
            self.bury(robot)
        self.missing = missing
        self.freed = False
        self.changed = True


class GossipExplorer(Explorer):
    """One robot of ORMSTC that cannot rely on its radio.

    Attributes:
        stuck_at: when it had the last news, if it has given up waiting for more.
    """

    body: Gossip
    claims: GossipClaims

    def __init__(self, body: Body, options: Options) -> None:
        super().__init__(Gossip(body.briefing, options.patience), options)
        self.claims = GossipClaims(
            body.team_size, fewest=options.conflict == "fewest-cells", lazy=options.lazy
        )
        self.stuck_at: float | None = None
        self._told: set[int] = set()  # cells beside its own, by a note
        self._around: tuple[tuple[int, ...], set[int], set[int]] = ((), set(), set())

    def hear(self, here: GridSight) -> None:
        """Take in what came with a sight; who is heard of again was not lost."""
        super().hear(here)
        body, missing = self.body, self.claims.missing
        if missing and self.stuck_at != body.news_at:
            silent = set(filter(body.is_silent, missing))
            if silent != missing:
                self.give_up(silent)
        if self.me in body.done:
            self.claims.over = True

    def has_met(self, robots: set[int]) -> bool:
        """Tell whether one of these robots claimed a cell that can be reached from here."""
        covered, left = self.around()
        near = covered | left | self.border.keys() | self.tree.edges.keys()
        return any(not near.isdisjoint(self.claims.held[robot]) for robot in robots)

    def around(self) -> tuple[set[int], set[int]]:
        """Return the covered cells that hang together with its start, and what is left beside them."""
        claims = self.claims
        sizes = (len(claims.known), len(claims.covered), len(self.walls))  # these sets only grow
        if self._around[0] != sizes:
            self._around = (sizes, *claims.around(self.start[0], self.walls))
        return self._around[1:]

    def give_up(self, missing: set[int]) -> None:
        """Take these robots for lost, and no others."""
        self.claims.replay(self.body.logs, self.body.lost, missing)

    def others(self) -> list[int]:
        """Return the other robots that are neither dead nor taken for lost."""
        dead = self.claims.dead
        return [other for other in range(self.body.team_size) if other not in dead | {self.me}]

    # Algorithm 2.

    async def begin(self) -> None:
        """OMSTC_INIT: announce the start cell, and hear those of the others (l. 9-12)."""
        body, start = self.body, Start(self.cell)
        self.claims.hear(self.me, start)
        self.hear(await body.look(gaze=self.corner, messages=(encode(start),)))
        while any(body.waits_for(other) and not body.logs[other] for other in self.others()):
            self.hear(await body.wait_for_news(at_most=1.0))

    # Algorithm 3.

    async def claim(self, cell: int, *messages: bytes) -> bool:
        """Claim a cell; tell whether this robot may construct a tree edge to it (R9)."""
        claims, body = self.claims, self.body
        if claims.over:
            return False
        note = Claim(self.here.time, cell, claims.cells[self.me])
        claims.hear(self.me, note)
        body.say(*messages, encode(note))
        number = len(body.logs[self.me])
        if body.speaks:
            self.hear(await body.exchange())
        while (won := self.has_won(cell, number)) is None:
            self.hear(await body.wait_for_news(at_most=1.0))
        if not won:
            self.give_back(cell)
        return won

    def has_won(self, cell: int, number: int) -> bool | None:
        """Tell whether its claim, the note of that number, has won; ``None``: not known yet."""
        body = self.body
        if self.claims.over or not self.claims.holds(self.me, cell):
            return False
        for other in self.others():
            counts = body.rows[other].counts
            knows = counts[self.me] >= number and len(body.logs[other]) >= counts[other]
            if not knows and body.waits_for(other):
                return None
        return True

    def give_back(self, cell: int) -> None:
        """Give a cell up that it has claimed."""
        self.claims.retract(cell, self.me)
        self.body.say(encode(Retract(cell)))

    def announced(self) -> tuple[bytes, ...]:
        """Return what tells that its cells are covered, if it has not told yet (l. 24)."""
        claims = self.claims
        if claims.held[self.me] <= claims.covered:
            return ()
        beside = sorted({cell for cell in self.border if cell not in self.tree} - self._told)
        self._told.update(beside)
        parts = range(0, len(beside), CELLS)
        notes: list[GossipNote] = [Beside(tuple(beside[at : at + CELLS])) for at in parts]
        notes.append(Covered())
        for note in notes:
            claims.hear(self.me, note)
        return tuple(map(encode, notes))

    async def over(self) -> bool:
        """Tell whether everything is covered; if it is not, wait for some news (l. 25)."""
        claims, body = self.claims, self.body
        body.say(*self.announced())
        if not claims.over:
            covered, left = self.around()
            if not left:
                body.done.update(r for r, cell in claims.starts.items() if cell in covered)
            elif self.has_met(body.done):
                body.done.add(self.me)
            elif self.others() or not claims.freed:
                if not self.gives_up(left):
                    body.rests = True
                    await self.rest(1.0)
                    body.rests = False
                return False
            claims.over = True  # or else it bumped wherever something was left, and is alone
        await self.linger()
        return True

    def gives_up(self, left: set[int]) -> bool:
        """Stop waiting for who is silent, or sparing what is in the way; tell whether it did."""
        claims, body = self.claims, self.body
        awaited = claims.awaited(left) - {self.me}
        if not awaited and not claims.freed:
            claims.freed = claims.changed = True  # R10
            return True
        awaited = awaited or set(self.others())
        silent = set(filter(body.is_silent, awaited))
        if not silent and all(map(body.is_idle, self.others())):
            silent, self.stuck_at = set(self.others()), body.news_at
        if silent:
            self.give_up(claims.missing | silent)
        return bool(silent)

    async def linger(self) -> None:
        """Stay until all others that it hears are done, too."""
        while any(map(self.body.lingers_for, self.others())):
            await self.rest(1.0)

    def last_words(self) -> Stop:
        """Return what the robot stops with."""
        return self.body.last_words()

    # Departures.

    async def is_needed(self) -> bool:
        """Wait, if it is spare, until the cell where it started loses its owner (R4)."""
        claims = self.claims
        if not claims.holds(self.me, self.cell):
            self.give_back(self.cell)
        while not claims.holds(self.me, self.cell):
            if claims.over or not claims.is_open(self.cell):
                if await self.over():
                    return False
            else:
                await self.claim(self.cell)
        return True
