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

from agents.algorithms.claims import Claim, Retract, Start
from agents.algorithms.gossip_body import CELLS, Beside, Covered, Gossip, GossipNote
from agents.algorithms.gossip_claims import GossipClaims
from agents.algorithms.ormstc import Explorer, Options
from agents.body import Body
from protocol.codec import encode
from protocol.messages import GridSight, Stop


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
