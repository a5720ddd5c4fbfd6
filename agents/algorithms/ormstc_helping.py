"""ORMSTC with helping: a robot that has nothing left to do goes and takes a share of what others have.

Not in the paper: there a robot that has closed its lap stands by, however much the others have before
them, and robots that start in a cluster leave nearly everything to the one that gets out of it.

A robot covers as in `ormstc`, with three differences:

- It looks at all sides of a cell when it first comes there. When it leaves a cell although beside it
  there are free cells that nobody owns, it tells the others: it will come back to these last.
- A robot that has closed its lap goes to the nearest open cell that is known, over cells that are
  known to be free, and begins another tree there. So are the cells of the dead taken over.
- If there is none, it *asks* who has how much before it. The robot with the most *grants* it the far
  end of its way: sub-cells that the helper reaches and covers while the other covers what is left.
  Cells change their owner with the grant.

What a robot had covered when it closed a lap is covered for good (`HelpingClaims.unsealed`): if it dies
later only the cells are open that it took since.

Assumes a radio that is reliable, reaches everybody and takes no time. Repeated visits are the price;
Theorem 5 is not claimed.
"""

from collections import deque
from collections.abc import Collection, Iterator
from math import ceil

from agents.algorithms.claims import (
    OVER,
    WITHDRAWAL,
    AnyNote,
    Ask,
    Claims,
    Completion,
    Frontier,
    Grant,
    Offer,
    Refusal,
    Stake,
    Take,
    read_note,
)
from agents.algorithms.ormstc import Explorer, Options, cells_beside
from agents.algorithms.stc import AWAY, BEFORE, BEHIND, OPPOSITE, Corner
from agents.body import Body
from protocol.codec import encode
from protocol.errors import AlgorithmError
from protocol.messages import GridSight, Stop

Move = tuple[int, int, int]
"""An exit, and the cell and the corner that it leads to."""

WORTH = 4
"""A share is worth a journey if it ends the work at least so many moves earlier."""

NEAR = 4
"""An open cell that its finder would come back to is worth a journey of at most so many moves."""

PAUSE_MOVES = 8
"""After it has asked in vain a robot asks again when the others have made so many moves."""


class HelpingClaims(Claims):
    """One robot's copy of who owns what, and of what there is left to cover.

    Attributes:
        open: cells that are free and to be covered by whoever comes first, and who has left them
            behind and would come back to them.
        unsealed: for each robot the cells that it took since it last closed a lap.
        promised: for each robot the cells that it must still cover although they are another's.
    """

    __slots__ = ("open", "promised", "unsealed")

    def __init__(self, team_size: int, *, fewest: bool) -> None:
        super().__init__(team_size, fewest=fewest, lazy=False, delayed=False)
        self.open: dict[int, int] = {}
        self.unsealed: list[set[int]] = [set() for _ in range(team_size)]
        self.promised: list[set[int]] = [set() for _ in range(team_size)]

    def is_open(self, cell: int) -> bool:
        """Tell whether nobody has covered a cell for good, and nobody alive is to."""
        return cell in self.open or cell not in self.owner

    def is_known(self, cell: int) -> bool:
        """Tell whether a cell is known to be free."""
        return cell in self.owner or cell in self.open

    def hear(self, sender: int, note: AnyNote) -> None:
        """Take in a message."""
        super().hear(sender, note)
        if sender in self.dead:
            return
        kind = note.__class__
        if kind is Completion:
            self.unsealed[sender].clear()
            self.promised[sender].clear()
        elif kind is Frontier:
            for cell in note.cells:  # type: ignore[union-attr]
                if cell not in self.owner:
                    self.open.setdefault(cell, sender)
        elif kind is Grant:
            self._grant(sender, note)  # type: ignore[arg-type]

    def stake(self, cell: int, stake: Stake) -> None:
        """Let a robot claim a cell."""
        if cell in self.open:
            del self.open[cell]
            self._give(cell, stake)
        else:
            super().stake(cell, stake)

    def bury(self, robot: int) -> None:
        """Hear that a robot is dead: what it has not covered for good is open."""
        if robot not in self.dead:
            super().bury(robot)
            for cell in self.unsealed[robot] | self.promised[robot]:
                self.open[cell] = robot

    def is_forsaken(self, cell: int) -> bool:
        """Tell whether nobody is on the way back to an open cell."""
        finder = self.open[cell]
        return finder in self.dead or finder in self.complete

    def _give(self, cell: int, stake: Stake) -> None:
        held = self.owner.get(cell)
        if held is not None:
            self.unsealed[held[2]].discard(cell)
        super()._give(cell, stake)
        self.unsealed[stake[2]].add(cell)

    def _grant(self, sender: int, grant: Grant) -> None:
        self.complete.pop(grant.to, None)
        for cell in grant.cells:
            stake = self.owner.get(cell)
            if stake is not None and stake[2] == sender:
                self._give(cell, (grant.time, -grant.to, grant.to))
            else:  # the sender had promised to another to cover its part of this one
                self.promised[grant.to].add(cell)
        self.promised[sender].update(grant.shared)
        if grant.to in self.dead:
            self.open.update(dict.fromkeys(grant.cells, grant.to))


class Helper(Explorer):
    """One robot of ORMSTC that helps.

    Attributes:
        sides: for each cell of its own the sides where it has not seen an obstacle.
        way: what it still has to drive of a share, in order; its tree may grow beside it.
        goal: where the drive around its present tree ends.
        stop: the sub-cell from which on others cover its way; ``None``: none.
        replies: what it has to say to others with its next request.
        offers: who has how much before it, since it last asked.
        answer: what it got of the robot that it wanted a share of.
    """

    claims: HelpingClaims

    def __init__(self, body: Body, options: Options) -> None:
        super().__init__(body, options)
        briefing = body.briefing
        radio = briefing.radio
        if radio.reach != "global" or radio.latency or radio.lossy:
            raise AlgorithmError(
                'variant helping needs radio.reach = "global" without latency and loss, found '
                f"{radio.reach!r}, latency {radio.latency:g}, {'lossy' if radio.lossy else 'no loss'}"
            )
        cells_beside(briefing.sensing, needed=3.17)  # all sides of a cell, from any corner of it
        self.claims = HelpingClaims(body.team_size, fewest=options.conflict == "fewest-cells")
        self.sides: dict[int, int] = {}
        self.way: list[Corner] = []
        self.goal: Corner | None = None
        self.stop: Corner | None = None
        self.replies: list[bytes] = []
        self.offers: dict[int, int] = {}
        self.answer: Grant | Refusal | None = None
        self._move_took = 1.0
        self._claimed = (-1.0, 0)

    # What it hears and says.

    def hear_messages(self, here: GridSight) -> None:
        """Take in what the others say; note what must be answered."""
        hear = self.claims.hear
        for sender, message in here.inbox:
            note = read_note(message)
            hear(sender, note)
            kind = note.__class__
            if kind is Ask:
                if self.is_busy:
                    self.replies.append(encode(Offer(sender, self.left())))
            elif kind is Take:
                if note.of == self.me:  # type: ignore[union-attr]
                    self.replies.append(self.granted(sender, note))  # type: ignore[arg-type]
            elif kind is Offer:
                if note.to == self.me:  # type: ignore[union-attr]
                    self.offers[sender] = note.left  # type: ignore[union-attr]
            elif (kind is Grant or kind is Refusal) and note.to == self.me:  # type: ignore[union-attr]
                self.answer = note  # type: ignore[assignment]

    def said(self) -> tuple[bytes, ...]:
        """Return what it has to say, and forget it."""
        replies, self.replies = tuple(self.replies), []
        return replies

    async def step(self, exit_: int, cell: int, corner: int, *messages: bytes) -> bool:
        """Move to a sub-cell, and say what there is to say (one move)."""
        before = self.here.time
        arrived = await super().step(exit_, cell, corner, *messages, *self.said())
        self._move_took = self.here.time - before
        return arrived

    async def claim(self, cell: int, *messages: bytes) -> bool:
        """Claim a cell; tell whether it is this robot's now."""
        self._claimed = (self.here.time, cell)
        return await super().claim(cell, *messages, *self.said())

    @property
    def is_busy(self) -> bool:
        """Whether it has something before it."""
        return self.goal is not None or bool(self.way)

    # What it has before it, and what it grants of that.

    def ahead(self) -> Iterator[Corner]:
        """Yield the sub-cells that it still has to cover, as far as it knows, in order."""
        if self.goal is not None and (self.cell, self.corner) in self._lanes():
            at = (self.cell, self.corner)
            while True:
                at = self.tree.ahead(*at)[1:]
                if at in (self.goal, self.stop):
                    break
                yield at
        if self.stop is None:
            yield from self.way

    def _lanes(self) -> Collection[Corner]:
        """Return the present sub-cell if it is one of the tree, which it is not on a journey."""
        return ((self.cell, self.corner),) if self.cell in self.tree else ()

    def left(self) -> int:
        """Return how many moves it still has to make, as far as it knows."""
        return sum(map(self.moves_at, self.ahead()))

    def moves_at(self, at: Corner) -> int:
        """Return how many moves a sub-cell costs, with the open cell that may lie beside it."""
        return 5 if at[0] + AWAY[at[1]] in self.claims.open else 1

    def granted(self, helper: int, take: Take) -> bytes:
        """Cut off the end of what it has before it for a helper, if that is worth the journey."""
        ahead = list(self.ahead())
        costs = list(map(self.moves_at, ahead))
        left = sum(costs)
        best = left - WORTH
        found: tuple[int, bool] | None = None
        if best > 0:
            far = self.distances(take.cell, best)
            last = far.get(ahead[-1][0])
            keeps = 0
            for kept in range(1, len(ahead)):
                keeps += costs[kept - 1]
                to_first = far.get(ahead[kept][0])
                for journey, backwards in ((to_first, False), (last, True)):
                    if journey is not None and max(keeps, journey + left - keeps) < best:
                        best, found = max(keeps, journey + left - keeps), (kept, backwards)
        if found is None:
            return encode(Refusal(helper))
        kept, backwards = found
        own, share_ = ahead[:kept], ahead[kept:]
        still = {cell for cell, _ in own} | {self.cell}
        cells = tuple(sorted({cell for cell, _ in share_}))
        shared = tuple(cell for cell in cells if cell in still)
        grant = Grant(
            helper,
            self.here.time,
            cells,
            shared,
            tuple(share_[::-1] if backwards else share_),
            backwards,
        )
        self.claims.hear(self.me, grant)
        on_tree = len(ahead) - (len(self.way) if self.stop is None else 0)
        if kept < on_tree:
            self.stop = share_[0]
            self.way = []
        else:
            self.way = self.way[: kept - on_tree]
        return encode(grant)

    # Where it can go.

    def near(self, at: Corner) -> Iterator[Move]:
        """Yield the sub-cells beside one, as far as they are known to be free."""
        cell, corner = at
        behind, before = BEHIND[corner], BEFORE[corner]
        known, walls = self.claims.is_known, self.walls
        yield before, cell, before
        yield OPPOSITE[corner], cell, behind
        beside = cell + AWAY[corner]
        if known(beside) and beside not in walls:
            yield corner, beside, behind
        beside = cell + AWAY[behind]
        if known(beside) and beside not in walls:
            yield behind, beside, before

    def distances(self, start: int, most: int) -> dict[int, int]:
        """Return about how many moves each cell is away from ``start``, up to ``most`` of them."""
        known, walls = self.claims.is_known, self.walls
        far = {start: 0}
        ring, moves = [start], 0
        while ring and moves < most:
            moves += 2
            following = []
            for cell in ring:
                for away in AWAY:
                    beside = cell + away
                    if beside not in far and known(beside) and beside not in walls:
                        far[beside] = moves
                        following.append(beside)
            ring = following
        return far

    def route(self, targets: "Collection[Corner] | None") -> list[Move] | None:
        """Return a shortest way to one of ``targets``.

        ``None``: to the nearest open cell that is forsaken, or near enough.
        """
        bodies = self.bodies
        start = (self.cell, self.corner)
        came: dict[Corner, tuple[Corner, int, int]] = {start: (start, 0, 0)}
        ahead = deque([start])
        while ahead:
            at = ahead.popleft()
            far = came[at][2]
            if (at in targets) if targets is not None else self.is_worth(at[0], far):
                way: list[Move] = []
                while at != start:
                    before, exit_, _ = came[at]
                    way.append((exit_, *at))
                    at = before
                return way[::-1]
            for exit_, *to in self.near(at):
                corner = (to[0], to[1])
                if corner not in came and corner not in bodies:
                    came[corner] = (at, exit_, far + 1)
                    ahead.append(corner)
        return None

    def is_worth(self, cell: int, far: int) -> bool:
        """Tell whether an open cell is worth a journey of ``far`` moves."""
        claims = self.claims
        return cell in claims.open and (far <= NEAR or claims.is_forsaken(cell))

    async def travel(self, targets: Collection[Corner]) -> bool:
        """Go to one of some sub-cells; tell whether it got there."""
        while True:
            route = self.route(targets)
            if route is None:
                return False
            for exit_, cell, corner in route:
                if not await self.step(exit_, cell, corner):
                    self.bodies.add((cell, corner))
                    break
            else:
                return True

    # Covering.

    async def look_around(self) -> None:
        """Look at all sides of a cell where it comes for the first time."""
        cell = self.cell
        if cell in self.sides:
            return
        free = 0
        looks_ahead = self.corner
        for turn in range(4):
            direction = (self.corner + turn) % 4
            if self.claims.is_known(cell + AWAY[direction]):
                free |= 1 << direction
                continue
            if direction != looks_ahead and not self.body.briefing.sensing.window:
                looks_ahead = direction
                self.hear(await self.body.look(gaze=direction, messages=self.said()))
            if self.sees_free(direction):
                free |= 1 << direction
        self.sides[cell] = free

    def left_behind(self, cell: int) -> tuple[bytes, ...]:
        """Return what tells the others of open cells beside one that this robot leaves."""
        claims = self.claims
        sides = self.sides.get(cell, 0)
        found = tuple(
            beside
            for direction, away in enumerate(AWAY)
            if sides >> direction & 1
            and (beside := cell + away) not in claims.owner
            and beside not in claims.open
            and beside not in self.walls
        )
        if not found:
            return ()
        claims.open.update(dict.fromkeys(found, self.me))
        return (encode(Frontier(found)),)

    async def drive_around(self, goal: Corner) -> None:
        """Drive around the present tree, which grows, to its goal or to where others take over."""
        tree = self.tree
        self.goal, self.stop = goal, None
        while True:
            await self.look_around()
            cell, corner = self.cell, self.corner
            beside = cell + AWAY[corner]
            joins = False
            if tree.edges[cell] >> corner & 1:
                exit_, at = corner, (beside, BEHIND[corner])
            elif await self.grows(cell, corner, beside):
                joins = True
                exit_, at = corner, (beside, BEHIND[corner])
            else:
                exit_, at = BEFORE[corner], (cell, BEFORE[corner])
            if at == self.stop:
                break
            left = self.left_behind(cell) if at[0] != cell else ()
            if not await self.step(exit_, *at, *left):
                if joins:
                    await self.cut_off(cell, corner)
                else:
                    await self.go_past(*at, goal)
            if (self.cell, self.corner) == goal or goal in self.bodies:
                break
        self.goal = None

    async def grows(self, cell: int, corner: int, beside: int) -> bool:
        """Let the tree grow into an open cell beside this corner, if there is one."""
        if not self.sides[cell] >> corner & 1 or self.is_own_or_wall(beside):
            return False
        if self.claims.is_open(beside) and await self.claim(beside):
            self.tree.join(cell, corner)
            return True
        return False

    async def drive_share(self, *, backwards: bool) -> None:
        """Cover a share, sub-cell by sub-cell; driven forwards, trees may grow beside it."""
        while self.way:
            at = self.way[0]
            if (self.cell, self.corner) != at and not await self.travel({at}):
                self.bodies.add(at)
            if self.way and self.way[0] == at:
                self.way.pop(0)
            if not backwards and (self.cell, self.corner) == at:
                await self.grow_beside()

    async def grow_beside(self) -> None:
        """Cover what hangs on this corner of a share, and come back to its next one."""
        await self.look_around()
        cell, corner = self.cell, self.corner
        beside = cell + AWAY[corner]
        if cell not in self.tree:
            self.tree.root(cell)
        if self.way and self.way[0][0] == beside:
            return
        if await self.grows(cell, corner, beside):
            if await self.step(corner, beside, BEHIND[corner], *self.left_behind(cell)):
                await self.drive_around((cell, BEFORE[corner]))
            else:
                await self.cut_off(cell, corner)

    # With nothing before it.

    async def work(self) -> None:
        """Cover, then help, until everything is covered."""
        if self.claims.holds(self.me, self.cell):
            self.tree.root(self.cell)
            await self.drive_around(self.start)
        while not await self.is_over():
            route = self.route(None) if self.claims.open else None
            if route is not None:
                await self.begin_anew(route)
            elif not await self.take_share():
                pause = max(1.0, float(ceil(PAUSE_MOVES * self._move_took)))
                self.hear(await self.body.wait_for_news(at_most=pause))

    async def is_over(self) -> bool:
        """Tell whether everything is covered."""
        claims = self.claims
        losses = len(claims.dead)
        if claims.complete.get(self.me) != losses:
            claims.hear(self.me, Completion(losses))
            self.hear(await self.body.exchange(encode(Completion(losses)), *self.said()))
        if claims.over:
            return True
        # What is open and cannot be reached from here is left to those that can, if there are any.
        return claims.agreed() and not (claims.open and self.route(None) is not None)

    def withdraw(self) -> tuple[bytes, ...]:
        """Return what withdraws completion, if it was announced."""
        return () if self.claims.complete.pop(self.me, None) is None else (WITHDRAWAL,)

    async def begin_anew(self, route: list[Move]) -> None:
        """Claim the open cell that a way leads to, go there and cover from there."""
        cell = route[-1][1] if route else self.cell
        if self._claimed == (self.here.time, cell):
            # It has lost this cell, and now the winner died. Who hears of all that at once could not
            # tell which claim came after that loss.
            await self.rest(1.0, *self.said())
            return
        if not await self.claim(cell, *self.withdraw()):
            return
        entry = (route[-1][1], route[-1][2]) if route else (self.cell, self.corner)
        self.way = [entry]  # busy from now on
        there = await self.travel({entry})
        self.way = []
        if not there:
            self.walls.add(cell)
            return
        self.tree.edges[cell] = 0
        self.hear(await self.body.look(gaze=self.corner, messages=self.said()))
        await self.drive_around(entry)

    async def take_share(self) -> bool:
        """Ask who has how much before it, and take a share of the most; tell whether it got one."""
        claims = self.claims
        asked = {
            robot
            for robot in range(self.body.team_size)
            if robot != self.me and robot not in claims.dead and robot not in claims.complete
        }
        self.offers = {}
        self.replies.append(encode(Ask()))
        while asked - self.offers.keys() - claims.dead - claims.complete.keys():
            self.hear(await self.body.wait_for_news(messages=self.said()))
            if claims.over:
                return False
        robot = max(self.offers, key=lambda robot: (self.offers[robot], robot), default=None)
        if robot is None or self.offers[robot] < 2 * WORTH:
            return False
        self.answer = None
        self.replies.append(encode(Take(robot, self.cell)))
        while not self.is_answered(robot):
            self.hear(await self.body.wait_for_news(messages=self.said()))
        return await self.accept()

    def is_answered(self, robot: int) -> bool:
        """Tell whether a robot that it wanted a share of has answered, or never will."""
        claims = self.claims
        gone = robot in claims.dead or robot in claims.complete or claims.over
        return gone or self.answer is not None

    async def accept(self) -> bool:
        """Cover the share that it was granted; tell whether there is one."""
        grant, self.answer = self.answer, None
        if not isinstance(grant, Grant):
            return False
        self.way = list(grant.way)
        await self.drive_share(backwards=grant.backwards)
        return True


async def help_out(body: Body, options: Options) -> Stop:
    """Cover the grid together with the others, helping them, until everything is covered."""
    robot = Helper(body, options)
    await robot.begin()
    await robot.work()
    for_good = encode(Completion(body.team_size))
    return body.last_words(messages=(for_good if robot.claims.open else OVER,))
