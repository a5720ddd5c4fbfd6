"""ORMSTC: on-line robust coverage of an unknown grid by a team that divides it as it goes.

Agmon, Hazon, Kaminka 2008, "The giving tree", Sec. 4: Algorithms 2 (OMSTC_INIT) and 3 (ORMSTC).

Assumes: a grid of coarse cells with a common origin; each robot senses whether the coarse cell next to
its own is free; a radio that reaches everybody; losses are heard by all. Bounds and obstacles are not
known. A coarse cell that is partly blocked is not covered.

Claims: every cell that can be reached is covered (Theorem 4); without losses no sub-cell is visited
twice (Theorem 5), except the one where a robot started, when its lap closes; up to k - 1 robots may
be lost, at any time (Theorem 6).

Each robot builds a tree of coarse cells and drives around it, the tree on its left (`stc`). Whenever
it comes to the corner of a cell from which an edge would leave, it looks at the cell there: a free one
is claimed, and the winner of the claim drives on into it (`claims`). Back at its start it has
completed a lap; then it stands by, and takes over from robots that die.

Departures from the paper, in the default ``variant = "corrected"``; each marked below by its rule:

- R1, R2: the scan goes counter-clockwise, one cell at a time, when the robot comes to it. Clockwise, as
  line 1 has it, a robot passes sub-cells twice (``scan = "clockwise"`` shows it).
- R3: W of the start cell is tested like any other (lines 21-22 enter it whoever owns it).
- R4: of several robots that start in one coarse cell the highest id owns it; the others are spare.
- R6: what is left to take over is not kept in ``connection[][]``, which one robot can spoil for
  another: it is evaluated at the borders of the own tree whenever something has changed.
- R8: cells are freed by their owner's death, not by a list in a message.
- R9: where messages take time a robot enters a cell only when all claims on it can have come.
- R10, ``lazy``: cells that a robot had covered completely before it died are covered again only if
  they are in the way.

``variant = "paper"`` is Algorithm 3 as printed, but for R1 and R2 (`PaperExplorer`).
"""

from math import ceil
from typing import Literal

from msgspec import Struct

from agents.algorithms.claims import (
    AT_START,
    OVER,
    WITHDRAWAL,
    Claim,
    Claims,
    Completion,
    Removal,
    Retract,
    Start,
    read_note,
)
from agents.algorithms.stc import AWAY, BEFORE, BEHIND, Tree, located
from agents.body import Body
from protocol.codec import encode
from protocol.messages import GridSight, Stop


class Options(Struct, frozen=True, forbid_unknown_fields=True):
    """Options of ORMSTC.

    Attributes:
        variant: ``"corrected"`` keeps the theorems; ``"paper"`` as printed.
        conflict: who wins a cell that several claim at once: the highest ``"id"``, or who has the
            ``"fewest-cells"`` (and then the highest id).
        lazy: whether cells that a robot had covered completely before it died are left alone (R10).
        scan: ``"clockwise"`` as in line 1, for one robot only: it passes sub-cells twice.
    """

    variant: Literal["corrected", "paper"] = "corrected"
    conflict: Literal["id", "fewest-cells"] = "id"
    lazy: bool = True
    scan: Literal["counter-clockwise", "clockwise"] = "counter-clockwise"


FREE = ord(".")
"""How a free cell looks."""


def whole(duration: float) -> float:
    """Return a time to wait that both clocks allow: whole ticks."""
    return float(ceil(duration))


class Explorer:
    """One robot of ORMSTC: where it is, its tree, and its copy of who owns what.

    Attributes:
        body: what it can do.
        cell, corner: where it is.
        start: where it started.
        tree: the coarse cells it covers, and how they hang together.
        claims: who owns what.
        border: the corners of the tree beside which there is a free cell of another robot's, and that
            cell.
        exits: those of them where there is something to take over now (R6).
        here: what it saw last.
        late: whether it heard something in the midst of this instant: it acts on it in the next.
    """

    def __init__(self, body: Body, options: Options) -> None:
        briefing = body.briefing
        assert briefing.position is not None
        self.body = body
        self.me = body.robot
        self.cell, self.corner = located(briefing.position)
        self.start = (self.cell, self.corner)
        self.tree = Tree()
        self.delay = ceil(briefing.radio.latency)  # whole ticks, so that both clocks allow to wait
        self.claims = Claims(
            body.team_size,
            fewest=options.conflict == "fewest-cells",
            lazy=options.lazy,
            delayed=self.delay > 0,
        )
        self.border: dict[tuple[int, int], int] = {}
        self.exits: set[tuple[int, int]] = set()
        self.here: GridSight
        self.late = False
        self._ahead = 1 if briefing.sensing.mode == "three" else 0
        self._forward: bool | None = None

    # What a robot hears and sees.

    def hear(self, here: GridSight) -> None:
        """Take in what came with a sight: first the messages, then the losses."""
        self.here = here
        if here.inbox or here.losses:
            claims = self.claims
            for sender, message in here.inbox:
                claims.hear(sender, read_note(message))
            for robot in here.losses:
                claims.bury(robot)

    async def tell(self, *messages: bytes) -> None:
        """Broadcast, and hear what the others say in this instant."""
        self.hear(await self.body.exchange(*messages))
        self.late = True

    def sees_free(self) -> bool:
        """Tell whether the cell that it looks at is free (l. 1-3)."""
        return self.here.seen[self._ahead] == FREE

    # Algorithm 2.

    async def begin(self) -> None:
        """OMSTC_INIT: announce the start cell, and hear those of the others (l. 9-12)."""
        self.claims.stake(self.cell, (AT_START, -self.me, self.me))
        start = encode(Start(self.cell))
        self.hear(await self.body.look(gaze=self.corner, messages=(start,)))
        if self.delay:
            await self.rest(self.delay)

    # Algorithm 3.

    async def claim(self, cell: int, *messages: bytes) -> bool:
        """Claim a cell; tell whether this robot may construct a tree edge to it (R9)."""
        claims = self.claims
        note = Claim(self.here.time, cell, claims.cells[self.me])
        claims.hear(self.me, note)
        here: GridSight = await self.body.exchange(*messages, encode(note))
        if self.delay:
            self.hear(here)
            here = await self.body.wait(self.delay)
        # Who died since it claimed holds its claim until the next tick: the losses come last.
        for sender, message in here.inbox:
            claims.hear(sender, read_note(message))
        won = claims.holds(self.me, cell)
        self.hear(here)
        self.late = True
        if self.delay and not won:
            claims.retract(cell, self.me)
            await self.tell(encode(Retract(cell)))
        return won

    async def drive_around(self, goal: tuple[int, int]) -> None:
        """Drive around the tree, which grows on the way, until the robot comes to ``goal``."""
        tree, claims = self.tree, self.claims
        edges = tree.edges
        while True:
            cell, corner = self.cell, self.corner
            beside = cell + AWAY[corner]
            if edges[cell] >> corner & 1:
                crosses = True
            elif beside in edges or not self.sees_free():
                crosses = False  # R2: its own, or an obstacle
            elif claims.is_open(beside) and await self.claim(beside):
                tree.join(cell, corner)  # l. 15
                crosses = True
            else:
                crosses = await self.passes(beside)
            if crosses:
                exit_, cell, corner = corner, beside, BEHIND[corner]  # l. 16 and 19
            else:
                exit_ = corner = BEFORE[corner]
            if (cell, corner) == goal:
                await self.step(exit_, cell, corner, *self.announced())
                return
            await self.step(exit_, cell, corner)

    async def passes(self, beside: int) -> bool:
        """Keep in mind that a cell here belongs to another robot (l. 5-11); never enter it."""
        self.border[self.cell, self.corner] = beside
        return False

    async def step(self, exit_: int, cell: int, corner: int, *messages: bytes) -> None:
        """Move to a sub-cell, and look where an edge would leave from there (one move)."""
        here = await self.body.move(exit_, gaze=corner, messages=messages)
        self.cell, self.corner = cell, corner
        self.hear(here)
        self.late = False

    async def rest(self, duration: float, *messages: bytes) -> None:
        """Stay where it is."""
        self.hear(await self.body.wait(duration, messages=messages))
        self.late = False

    async def stand_by(self) -> None:
        """Be complete, or take over what the dead have left, until all are complete (l. 24-36)."""
        while True:
            self.find_exits()
            if self.claims.over or not self.exits:
                if await self.over():
                    return  # R7
                continue
            withdrawal = self.withdrawn()
            if self.late:
                await self.rest(1.0, *withdrawal)
            elif (self.cell, self.corner) in self.exits:
                await self.take_over(*withdrawal)
            else:
                await self.walk(*withdrawal)

    def announced(self) -> tuple[bytes, ...]:
        """Return what announces completion, if there is something to announce (l. 24).

        The last move of a lap leads to a sub-cell that was visited before; so completion goes out
        with it, and who dies right after it has died complete.
        """
        self.find_exits()
        claims = self.claims
        losses = len(claims.dead)
        if self.exits or claims.complete.get(self.me) == losses:
            return ()
        claims.complete[self.me] = losses
        return (encode(Completion(losses)),)

    def withdrawn(self) -> tuple[bytes, ...]:
        """Return what withdraws completion, if it was announced (l. 28)."""
        return () if self.claims.complete.pop(self.me, None) is None else (WITHDRAWAL,)

    async def over(self) -> bool:
        """Tell whether all are complete; if they are not, wait for some news (l. 25)."""
        if self.claims.over:
            return True
        announcement = self.announced()
        if not self.claims.agreed():
            self.hear(await self.body.wait_for_news(messages=announcement))
            self.late = not self.here.alone  # woken when a round had passed
        elif announcement or self.late:
            await self.rest(1.0, *announcement)
        elif self.delay:
            await self.rest(2 * self.delay)
            return not (self.here.inbox or self.here.losses)
        else:
            return True
        return False

    def find_exits(self) -> None:
        """Find the corners of the tree beside which a cell is open (R6)."""
        claims = self.claims
        if not self.exits:
            claims.free_the_spared()
        if claims.changed:
            claims.changed = False
            self._forward = None
            self.exits = {
                corner
                for corner, beside in (self.border.items() if claims.any_open() else ())
                if beside not in self.tree and claims.is_open(beside)
            }

    async def walk(self, *messages: bytes) -> None:
        """Go one move towards the nearest exit, along the own way around (l. 29-30)."""
        if self._forward is None:
            self._forward = self.nearest_is_ahead()
        way = self.tree.ahead if self._forward else self.tree.back
        await self.step(*way(self.cell, self.corner), *messages)

    def nearest_is_ahead(self) -> bool:
        """Tell whether the nearest exit lies ahead, counter-clockwise, or as near as any behind."""
        ahead = back = (self.cell, self.corner)
        while True:
            ahead = self.tree.ahead(*ahead)[1:]
            if ahead in self.exits:
                return True
            back = self.tree.back(*back)[1:]
            if back in self.exits:
                return False

    async def take_over(self, *messages: bytes) -> None:
        """Claim the cell beside this exit, cover what lies behind, and come back (l. 31-36)."""
        cell, corner = self.cell, self.corner
        beside = cell + AWAY[corner]
        self.exits.discard((cell, corner))
        if not await self.claim(beside, *messages):
            await self.step(BEFORE[corner], cell, BEFORE[corner])
            return
        self.tree.join(cell, corner)  # l. 34
        await self.step(corner, beside, BEHIND[corner])
        await self.drive_around((cell, BEFORE[corner]))

    # Departures.

    async def is_needed(self) -> bool:
        """Wait, if it is spare, until the cell where it started loses its owner (R4)."""
        claims = self.claims
        while not claims.holds(self.me, self.cell):
            if not claims.is_open(self.cell):
                claims.free_the_spared()
            if not claims.is_open(self.cell):
                if await self.over():
                    return False
                continue
            withdrawal = self.withdrawn()
            if self.late:
                await self.rest(1.0, *withdrawal)
            elif await self.claim(self.cell, *withdrawal):
                await self.rest(1.0)
        return True

    async def scan_clockwise(self) -> None:
        """Line 1 as printed: clockwise from W, while driving on the right side (R1)."""
        trail = [(self.cell, BEHIND[self.corner], 1)]  # cell, W, which of its sides is next
        while trail:
            cell, came_from, side = trail.pop()
            if side > 4:
                continue
            direction = (came_from + side) % 4
            back = bool(trail) and side == 4
            trail.append((cell, came_from, side + 1))
            beside = cell + AWAY[direction]
            if not back:
                self.hear(await self.body.look(gaze=direction))
                if beside in self.tree or not self.sees_free():
                    continue
                if not (self.claims.is_open(beside) and await self.claim(beside)):
                    continue
                self.tree.join(cell, direction)
                trail.append((beside, (direction + 2) % 4, 1))
            while self.corner != direction:
                await self.step(BEFORE[self.corner], cell, BEFORE[self.corner])
            await self.step(direction, beside, BEHIND[direction])
        while (self.cell, self.corner) != self.start:
            await self.step(BEFORE[self.corner], self.cell, BEFORE[self.corner])  # l. 23


class PaperExplorer(Explorer):
    """Algorithm 3 as printed, but for the scan (R1, R2): what it leaves uncovered is the paper's own.

    Attributes:
        connection: the first and the last corner of the own tree beside a tree edge of each robot.
    """

    def __init__(self, body: Body, options: Options) -> None:
        super().__init__(body, options)
        self.claims.lazy = False
        self.connection: dict[int, list[tuple[int, int]]] = {}

    def hear(self, here: GridSight) -> None:
        """Take in what came with a sight; forget the connections that another robot removes."""
        super().hear(here)
        for _, message in here.inbox:
            note = read_note(message)
            if isinstance(note, Removal):
                self.connection.pop(note.robot, None)

    def announced(self) -> tuple[bytes, ...]:
        """Announce nothing before `stand_by`."""
        return ()

    async def claim(self, cell: int, *messages: bytes) -> bool:
        """Claim a cell; one that belonged to a dead robot removes all connections to it (l. 12-14)."""
        stake = self.claims.owner.get(cell)
        if stake is not None and stake[2] in self.claims.dead:
            self.connection.pop(stake[2], None)
            messages = (*messages, encode(Removal(stake[2])))
        return await super().claim(cell, *messages)

    async def passes(self, beside: int) -> bool:
        """Keep the connection to a tree edge of another robot (l. 5-11), but for W (l. 21-22)."""
        cell, corner = self.start
        if (self.cell, self.corner) == (cell, BEHIND[corner]):
            await self.claim(beside)
            self.tree.join(self.cell, self.corner)
            return True
        owner = self.claims.owner[beside][2]
        here = (self.cell, self.corner)
        self.connection.setdefault(owner, [here, here])[1] = here
        return False

    async def stand_by(self) -> None:
        """Wait for all to announce completion; take over from the dead (l. 24-36)."""
        claims = self.claims
        claims.complete[self.me] = 0
        await self.tell(encode(Completion(0)))
        while len(claims.complete) < self.body.team_size:  # l. 25
            lost = next((robot for robot in self.connection if robot in claims.dead), None)
            if lost is None:
                self.hear(await self.body.wait_for_news())
                continue
            self.exits = set(self.connection.pop(lost))  # l. 26-29
            withdrawal: tuple[bytes, ...] = (WITHDRAWAL, encode(Removal(lost)))
            claims.complete.pop(self.me)  # and l. 36 does not announce it again
            self._forward = None
            while (self.cell, self.corner) not in self.exits:
                await self.walk(*withdrawal)
                withdrawal = ()
            await self.take_over(*withdrawal)


async def ormstc(body: Body, options: Options) -> Stop:
    """Cover the grid together with the others, and stand by until all are complete."""
    robot = (Explorer if options.variant == "corrected" else PaperExplorer)(body, options)
    await robot.begin()
    if await robot.is_needed():
        robot.tree.root(robot.cell)
        if options.scan == "clockwise":
            await robot.scan_clockwise()
        else:
            await robot.drive_around(robot.start)
        await robot.stand_by()
    return body.last_words(messages=(OVER,))
