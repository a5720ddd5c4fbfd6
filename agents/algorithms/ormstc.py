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
from typing import Annotated, Literal

from msgspec import Meta, Struct

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
from agents.algorithms.stc import AWAY, BEFORE, BEHIND, Corner, Tree, located, sub_cell
from agents.body import Body
from protocol.codec import encode
from protocol.errors import AlgorithmError
from protocol.grid import STEPS
from protocol.messages import GridSight, SensingFacts, Stop


class Options(Struct, frozen=True, forbid_unknown_fields=True):
    """Options of ORMSTC.

    Attributes:
        variant: ``"corrected"`` keeps the theorems; ``"paper"`` as printed; with ``"helping"`` robots
            that have nothing left to do take a share of what others have (`ormstc_helping`).
        conflict: who wins a cell that several claim at once: the highest ``"id"``, or who has the
            ``"fewest-cells"`` (and then the highest id).
        lazy: whether cells that a robot had covered completely before it died are left alone (R10).
        scan: ``"clockwise"`` as in line 1, for one robot only: it passes sub-cells twice.
        patience: where the radio is not reliable and global, how old the last sign of life may be of
            a robot whose answer this one awaits before it enters a cell, time units (`ormstc_gossip`).
    """

    variant: Literal["corrected", "paper", "helping"] = "corrected"
    conflict: Literal["id", "fewest-cells"] = "id"
    lazy: bool = True
    scan: Literal["counter-clockwise", "clockwise"] = "counter-clockwise"
    patience: Annotated[float, Meta(ge=0)] | None = None


FREE = ord(".")
"""How a free cell looks."""


def cells_beside(
    sensing: SensingFacts, needed: float = 2.24
) -> dict[tuple[int, int], tuple[int, ...]]:
    """Return where in `GridSight.seen` the cell is that lies in a direction, for each corner.

    Args:
        sensing: how the robot senses.
        needed: how far it must see, sub-cells: to the far end of the cell across from its corner.

    Raises:
        AlgorithmError: If the robot does not see so far.
    """
    side = sensing.window
    if not side:
        ahead = (1 if sensing.mode == "three" else 0,)
        return {(corner, direction): ahead for corner in range(4) for direction in range(4)}
    if sensing.range_cells < needed:
        raise AlgorithmError(
            f"a robot sees {sensing.range_cells:g} sub-cells far; expected sensing.range_m of at "
            f"least {needed} sub-cells"
        )
    seen = {}
    for corner in range(4):
        row, col = sub_cell(0, corner)
        for direction, (down, right) in enumerate(STEPS):
            top, left = 2 * down - row + side // 2, 2 * right - col + side // 2
            cells = tuple((top + r) * side + left + c for r in (0, 1) for c in (0, 1))
            seen[corner, direction] = cells
    return seen


class Explorer:
    """One robot of ORMSTC: where it is, its tree, and its copy of who owns what.

    Attributes:
        body: what it can do.
        cell, corner: where it is.
        start: where it started.
        tree: the coarse cells it covers, and how they hang together.
        claims: who owns what.
        border: free cells of other robots beside the tree, and the corners of the tree beside each.
        exits: those of them where there is something to take over now (R6).
        walls: cells that it could not enter although they looked free.
        bodies: sub-cells of its own tree that something lies in.
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
        self.border: dict[int, set[Corner]] = {}
        self.exits: set[Corner] = set()
        self.walls: set[int] = set()
        self.bodies: set[Corner] = set()
        self.here: GridSight
        self.late = False
        self._looks_at = cells_beside(briefing.sensing)
        self._forward: bool | None = None

    # What a robot hears and sees.

    def hear(self, here: GridSight) -> None:
        """Take in what came with a sight: first the messages, then the losses."""
        self.here = here
        if here.inbox:
            self.hear_messages(here)
        for robot in here.losses:
            self.claims.bury(robot)

    def hear_messages(self, here: GridSight) -> None:
        """Take in what the others say."""
        self.claims.hear_all(here.inbox)

    async def tell(self, *messages: bytes) -> None:
        """Broadcast, and hear what the others say in this instant."""
        self.hear(await self.body.exchange(*messages))
        self.late = True

    def sees_free(self, direction: int) -> bool:
        """Tell whether the cell beside its own, which it looks at, is free (l. 1-3)."""
        seen = self.here.seen
        if len(seen) == 1:
            return seen == b"."
        return all(seen[at] == FREE for at in self._looks_at[self.corner, direction])

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
        self.here = here
        self.hear_messages(here)
        won = claims.holds(self.me, cell)
        for robot in here.losses:  # who died since it claimed holds its claim until the next tick
            claims.bury(robot)
        self.late = True
        if self.delay and not won:
            claims.retract(cell, self.me)
            await self.tell(encode(Retract(cell)))
        return won

    async def drive_around(self, goal: Corner) -> None:
        """Drive around the tree, which grows on the way, until the robot comes to ``goal``."""
        tree, claims = self.tree, self.claims
        edges = tree.edges
        while True:
            cell, corner = self.cell, self.corner
            beside = cell + AWAY[corner]
            joins = False
            if edges[cell] >> corner & 1:
                crosses = True
            elif beside in edges or beside in self.walls or not self.sees_free(corner):
                crosses = False  # R2: its own, or an obstacle
            elif claims.is_open(beside) and await self.claim(beside):
                tree.join(cell, corner)  # l. 15
                crosses = joins = True
            else:
                crosses = await self.passes(beside)
            if crosses:
                exit_, cell, corner = corner, beside, BEHIND[corner]  # l. 16 and 19
            else:
                exit_ = corner = BEFORE[corner]
            announcement = self.announced() if (cell, corner) == goal else ()
            if not await self.step(exit_, cell, corner, *announcement):
                if joins:
                    await self.cut_off(self.cell, exit_)
                else:
                    await self.go_past(cell, corner, goal)
            if (self.cell, self.corner) == goal or goal in self.bodies:
                return

    async def passes(self, beside: int) -> bool:
        """Keep in mind that a cell here belongs to another robot (l. 5-11); never enter it."""
        self.border.setdefault(beside, set()).add((self.cell, self.corner))
        return False

    async def step(self, exit_: int, cell: int, corner: int, *messages: bytes) -> bool:
        """Move to a sub-cell, and look where an edge would leave from there (one move).

        Returns:
            Whether it got there; it may have bumped against something, three times.
        """
        self.here = here = await self.body.move(exit_, gaze=corner, messages=messages)
        if here.inbox or here.losses:
            self.hear(here)
        self.late = False
        if here.entry == exit_ and not await self.tried_again(exit_):
            self.hear(await self.body.look(gaze=self.corner))
            return False
        self.cell, self.corner = cell, corner
        return True

    async def tried_again(self, exit_: int) -> bool:
        """Wait a little and try again, twice, after a bump; tell whether it helped (Sec. 4.2)."""
        for _ in range(2):
            await self.rest(float(self.body.rng.randint(1, 3)))
            self.hear(await self.body.move(exit_))
            if self.here.entry != exit_:
                return True
        return False

    async def cut_off(self, cell: int, direction: int) -> None:
        """Take a cell beside one of its own, which it could not enter, for an obstacle."""
        beside = self.tree.cut(cell, direction)
        self.walls.add(beside)
        self.claims.retract(beside, self.me)
        await self.tell(encode(Retract(beside)))

    async def go_past(self, cell: int, corner: int, goal: Corner) -> None:
        """Get past a sub-cell where it bumped three times, on the other lane of its own tree."""
        blocked = (cell, corner)
        self.bodies.add(blocked)
        while (cell, corner) != goal:
            _, cell, corner = self.tree.ahead(cell, corner)
            if (cell, corner) not in self.bodies and await self.go_to({(cell, corner)}):
                if cell == blocked[0]:
                    await self.scan_from_here(blocked[1])
                return
        self.bodies.add(goal)  # the way around ends here

    async def scan_from_here(self, direction: int) -> None:
        """Look from another corner of the cell where an edge would leave from one out of reach."""
        cell, beside = self.cell, self.cell + AWAY[direction]
        if self.is_own_or_wall(beside):
            return
        self.hear(await self.body.look(gaze=direction))
        free = self.sees_free(direction)
        if free and self.claims.is_open(beside) and await self.claim(beside):
            self.tree.join(cell, direction)
            if not await self.go_to({(beside, BEHIND[direction])}) and self.cell != beside:
                await self.cut_off(cell, direction)
        self.hear(await self.body.look(gaze=self.corner))

    async def go_to(self, targets: set[Corner], *messages: bytes) -> bool:
        """Go the shortest way to one of some sub-cells of its own tree; tell whether it got there."""
        while True:
            way = self.tree.way((self.cell, self.corner), targets, self.bodies)
            if way is None:
                return False
            for exit_, cell, corner in way:
                if not await self.step(exit_, cell, corner, *messages):
                    self.bodies.add((cell, corner))
                    break
                messages = ()
            else:
                return True

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
        claims, me = self.claims, self.me
        view = claims.view()
        if self.exits or (claims.complete.get(me), claims.opened.get(me)) == view:
            return ()
        claims.complete[me], claims.opened[me] = view
        return (encode(Completion(*view)),)

    def withdrawn(self) -> tuple[bytes, ...]:
        """Return what withdraws completion, if it was announced (l. 28)."""
        return () if self.claims.complete.pop(self.me, None) is None else (WITHDRAWAL,)

    async def over(self) -> bool:
        """Tell whether all are complete; if they are not, wait for some news (l. 25)."""
        if self.claims.over:
            return True
        announcement = self.announced()
        if announcement and self.claims.agreed():
            await self.rest(1.0, *announcement)  # now the spared can be freed, if they must be
        elif not self.claims.settled():
            self.hear(await self.body.wait_for_news(messages=announcement))
            self.late = not self.here.alone  # woken when a round had passed
        elif self.late:
            await self.rest(1.0)
        elif self.delay:
            await self.rest(2 * self.delay)
            return not (self.here.inbox or self.here.losses)
        else:
            return True
        return False

    def is_own_or_wall(self, cell: int) -> bool:
        """Tell whether a cell is of its tree, or could not be entered."""
        return cell in self.tree or cell in self.walls

    def find_exits(self) -> None:
        """Find the corners of the tree beside which a cell is open (R6)."""
        claims = self.claims
        if not self.exits:
            claims.free_the_spared()
        if claims.changed:
            claims.changed = False
            self._forward = None
            self.exits.clear()
            for beside, corners in self.border.items() if claims.any_open() else ():
                if claims.is_open(beside) and not self.is_own_or_wall(beside):
                    self.exits |= corners
        elif self.exits:
            for cell in claims.taken:
                if not self.exits.isdisjoint(self.border.get(cell, ())):
                    self.exits -= self.border[cell]
                    self._forward = None
        claims.taken.clear()

    async def walk(self, *messages: bytes) -> None:
        """Go one move towards the nearest exit, along the own way around (l. 29-30)."""
        if self.bodies:
            if not await self.go_to(self.exits, *messages):
                for corners in self.border.values():  # out of reach
                    corners.difference_update(self.exits)
                self.exits.clear()
            return
        if self._forward is None:
            self._forward = self.nearest_is_ahead()
        way = self.tree.ahead if self._forward else self.tree.back
        towards, cell, corner = way(self.cell, self.corner)
        if not await self.step(towards, cell, corner, *messages):
            self.bodies.add((cell, corner))

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
        self._forward = None
        if not await self.claim(beside, *messages):
            await self.step(BEFORE[corner], cell, BEFORE[corner])
            return
        self.tree.join(cell, corner)  # l. 34
        if await self.step(corner, beside, BEHIND[corner]):
            await self.drive_around((cell, BEFORE[corner]))
        else:
            await self.cut_off(cell, corner)

    def last_words(self) -> Stop:
        """Return what the robot stops with."""
        return self.body.last_words(messages=(OVER,))

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
                if beside in self.tree or not self.sees_free(direction):
                    continue
                if not (self.claims.is_open(beside) and await self.claim(beside)):
                    continue
                self.tree.join(cell, direction)
                trail.append((beside, (direction + 2) % 4, 1))
            while self.corner != direction:
                await self.step(BEFORE[self.corner], cell, BEFORE[self.corner])
            await self.step(direction, beside, BEHIND[direction])
        if len(self.tree.edges) == 1:  # nowhere to go: it covers its own cell all the same
            await self.step(BEFORE[self.corner], self.cell, BEFORE[self.corner])
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
        self.connection: dict[int, list[Corner]] = {}

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
            claims.complete.pop(self.me, None)  # and l. 36 does not announce it again
            self._forward = None
            while (self.cell, self.corner) not in self.exits:
                await self.walk(*withdrawal)
                withdrawal = ()
            beside = self.cell + AWAY[self.corner]
            if not self.is_own_or_wall(beside) and claims.is_open(beside):
                await self.take_over(*withdrawal)


def explorer_of(body: Body, options: Options) -> Explorer:
    """Return the robot for this variant and this radio."""
    if options.variant == "paper":
        return PaperExplorer(body, options)
    radio = body.briefing.radio
    if radio.reach == "global" and not radio.lossy:
        return Explorer(body, options)
    from agents.algorithms.ormstc_gossip import GossipExplorer  # noqa: PLC0415  it builds on this module

    return GossipExplorer(body, options)


async def ormstc(body: Body, options: Options) -> Stop:
    """Cover the grid together with the others, and stand by until all are complete."""
    if options.variant == "helping":
        from agents.algorithms.ormstc_helping import help_out  # noqa: PLC0415  it builds on this module

        return await help_out(body, options)
    robot = explorer_of(body, options)
    await robot.begin()
    if await robot.is_needed():
        robot.tree.root(robot.cell)
        if options.scan == "clockwise":
            await robot.scan_clockwise()
        else:
            await robot.drive_around(robot.start)
        await robot.stand_by()
    return robot.last_words()
