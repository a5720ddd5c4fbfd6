"""Walks of a team at the level of sub-cells, shortened by annealing.

Each walk is a doubly linked list of visits. The elementary moves change a walk in a place, so they keep
it a walk and cost constant time, however long it is:

    insert    a-b to a-x-y-b, beside it     two moves more
    remove    a-x-y-b to a-b                two moves less
    flip      a-b-c to a-x-c, the other way round a corner
    spur      a to a-x-a, and back again

Two more rewire it where it runs beside itself, and so reshape it from within:

    turn      a-b ... c-d to a-c ... b-d, the part between the other way round
    splice    a loop leaves a walk beside itself and enters the same or another one elsewhere

Removing may leave sub-cells that nobody visits; the search looks for walks no longer than a limit that
leave none, and lowers the limit each time it has found some.
"""

from collections.abc import Sequence
from math import exp
from operator import le, sub

from protocol.seeds import Stream

FEW = 100
"""`Search.mend` leaves it be where more sub-cells than this are missing: it would take long."""

LOOP = 400
"""No longer part of a walk is turned or spliced."""

Walk = list[int]
"""The sub-cells of a walk, first to last, by number."""


class Team:
    """The walks of all robots, each a linked list of visits.

    The first visit of robot ``i`` has the number ``i`` and stays; where walks are closed, the last one
    is at the same sub-cell.

    Attributes:
        cell, owner: sub-cell and robot of each visit.
        after, before: next and previous visit of each visit, -1 at the ends.
        last: last visit of each robot.
        length: moves of each robot.
        visits: the visits of each sub-cell.
        missed: sub-cells without visit.
        live: the numbers of all visits.
        slot: where each visit stands in ``live``.
        spare: numbers no longer in use.
    """

    __slots__ = (
        "after", "before", "cell", "last", "length", "live", "missed", "owner", "slot", "spare",
        "visits",
    )  # fmt: skip

    def __init__(self, cells: Sequence[bool], walks: Sequence[Walk]) -> None:
        """Begin with given walks.

        Args:
            cells: whether each sub-cell is to be visited; blocked ones and the border are not.
            walks: at least their first sub-cells.
        """
        self.cell: list[int] = []
        self.owner: list[int] = []
        self.after: list[int] = []
        self.before: list[int] = []
        self.live: list[int] = []
        self.slot: list[int] = []
        self.spare: list[int] = []
        self.last: list[int] = list(range(len(walks)))
        self.length = [0] * len(walks)
        self.visits: list[list[int]] = [[] for _ in cells]
        self.missed = sum(cells)
        for robot, walk in enumerate(walks):
            self._visit(robot, walk[0])
        for robot, walk in enumerate(walks):
            for cell in walk[1:]:
                self.append(robot, cell)

    def _visit(self, robot: int, cell: int) -> int:
        """Return a new visit, not linked yet."""
        if self.spare:
            visit = self.spare.pop()
            self.cell[visit] = cell
            self.owner[visit] = robot
            self.slot[visit] = len(self.live)
        else:
            visit = len(self.cell)
            self.cell.append(cell)
            self.owner.append(robot)
            self.after.append(-1)
            self.before.append(-1)
            self.slot.append(len(self.live))
        self.live.append(visit)
        here = self.visits[cell]
        if not here:
            self.missed -= 1
        here.append(visit)
        return visit

    def _forget(self, visit: int) -> None:
        here = self.visits[self.cell[visit]]
        here.remove(visit)
        if not here:
            self.missed += 1
        moved = self.live.pop()
        if moved != visit:
            at = self.slot[visit]
            self.live[at] = moved
            self.slot[moved] = at
        self.spare.append(visit)

    def append(self, robot: int, cell: int) -> None:
        """Make a walk longer by one move."""
        visit = self._visit(robot, cell)
        end = self.last[robot]
        self.after[end] = visit
        self.before[visit] = end
        self.after[visit] = -1
        self.last[robot] = visit
        self.length[robot] += 1

    def retract(self, robot: int) -> None:
        """Make a walk shorter by its last move."""
        end = self.last[robot]
        self.last[robot] = self.before[end]
        self.after[self.last[robot]] = -1
        self.length[robot] -= 1
        self._forget(end)

    def insert(self, visit: int, one: int, other: int) -> None:
        """Visit two more sub-cells after a visit."""
        robot = self.owner[visit]
        first, second = self._visit(robot, one), self._visit(robot, other)
        then = self.after[visit]
        self.after[visit] = first
        self.before[first] = visit
        self.after[first] = second
        self.before[second] = first
        self.after[second] = then
        if then >= 0:
            self.before[then] = second
        else:
            self.last[robot] = second
        self.length[robot] += 2

    def remove(self, visit: int) -> None:
        """Remove the two visits after a visit."""
        first = self.after[visit]
        second = self.after[first]
        then = self.after[second]
        robot = self.owner[visit]
        self.after[visit] = then
        if then >= 0:
            self.before[then] = visit
        else:
            self.last[robot] = visit
        self.length[robot] -= 2
        self._forget(first)
        self._forget(second)

    def flip(self, visit: int, cell: int) -> None:
        """Let a visit take place at another sub-cell."""
        here = self.visits[self.cell[visit]]
        here.remove(visit)
        if not here:
            self.missed += 1
        self.cell[visit] = cell
        here = self.visits[cell]
        if not here:
            self.missed -= 1
        here.append(visit)

    def part(self, first: int, end: int) -> list[int]:
        """Return the visits from one to another, empty if there are too many or it is not ahead."""
        part = [first]
        at = first
        for _ in range(LOOP):
            if at == end:
                return part
            at = self.after[at]
            if at < 0:
                break
            part.append(at)
        return []

    def turn(self, part: list[int]) -> None:
        """Turn a part of a walk around."""
        self._link(self.before[part[0]], part[::-1], self.after[part[-1]])

    def _link(self, visit: int, part: list[int], then: int) -> None:
        """Let a part follow a visit, which is never the last one, and another one follow the part."""
        after, before = self.after, self.before
        for next_ in part:
            after[visit] = next_
            before[next_] = visit
            visit = next_
        after[visit] = then
        if then >= 0:
            before[then] = visit
        else:
            self.last[self.owner[visit]] = visit

    def splice(self, part: list[int], loop: list[int], visit: int) -> None:
        """Take a part out of a walk and put it behind a visit outside of it.

        Args:
            part: consecutive visits, neither the first nor the last of their walk.
            loop: the same visits in the order in which they are to follow ``visit``.
            visit: any but the last one of its walk.
        """
        giver, taker = self.owner[part[0]], self.owner[visit]
        start, end = self.before[part[0]], self.after[part[-1]]
        self.after[start] = end
        self.before[end] = start
        self._link(visit, loop, self.after[visit])
        self.length[giver] -= len(loop)
        self.length[taker] += len(loop)
        for moved in loop:
            self.owner[moved] = taker

    def walks(self) -> list[Walk]:
        """Return the sub-cells of all walks."""
        found = []
        for robot in range(len(self.length)):
            walk = []
            visit = robot
            while visit >= 0:
                walk.append(self.cell[visit])
                visit = self.after[visit]
            found.append(walk)
        return found


class Search:
    """Annealing of a team's walks under limits of their lengths.

    Where walks are open, a robot may have to be back at a given time: then the way back from where its
    walk ends counts too.

    Attributes:
        team: the walks; they change all the time.
        limits: how long each walk may be now.
    """

    __slots__ = (
        "back",
        "closed",
        "free",
        "limit",
        "limits",
        "price",
        "return_limit",
        "rng",
        "stride",
        "team",
    )

    def __init__(
        self,
        team: Team,
        free: Sequence[bool],
        stride: int,
        rng: Stream,
        *,
        price: float,
        back: Sequence[Sequence[int]] | None = None,
        return_limit: int = 0,
        closed: bool,
    ) -> None:
        """Prepare a search.

        Args:
            team: the walks to begin with.
            free: whether each sub-cell may be visited.
            stride: sub-cells from one row to the next.
            rng: draws the moves.
            price: what a move costs, where a sub-cell without visit costs 1. A low one finds walks
                where many are possible, a high one where there is hardly a move to spare.
            back: for each robot the way to its start from each sub-cell, in moves.
            return_limit: no walk and the way back from its end are longer together.
            closed: the walks end where they do now.
        """
        self.team = team
        self.free = free
        self.stride = stride
        self.rng = rng
        self.closed = closed
        self.price = price
        self.back = back
        self.return_limit = return_limit
        self.aim(max(team.length))

    def aim(self, limit: int) -> None:
        """Search for walks no longer than ``limit`` from now on."""
        self.limit = limit
        self.limits = [self._allowed(robot, end) for robot, end in enumerate(self.team.last)]

    def _allowed(self, robot: int, end: int) -> int:
        """Return how long a walk may be that ends with a visit."""
        if self.back is None:
            return self.limit
        return min(self.limit, self.return_limit - self.back[robot][self.team.cell[end]])

    def is_solved(self) -> bool:
        """Tell whether every sub-cell is visited and no walk is too long."""
        return not self.team.missed and all(map(le, self.team.length, self.limits))

    def run(self, steps: int, heat: float) -> bool:  # noqa: C901, PLR0915  one loop: calls would cost a third of the speed
        """Try moves, until the walks are what is searched for.

        Args:
            steps: moves tried at most.
            heat: a rise of the cost by this much is accepted once in e times.

        Returns:
            Whether they are.
        """
        team, free, limits, closed = self.team, self.free, self.limits, self.closed
        cell, after, live, owner = team.cell, team.after, team.live, team.owner
        visits, length = team.visits, team.length
        random = self.rng.random
        stride = self.stride
        odds = [exp(-0.1 * cost / heat) for cost in range(60)]
        pair = 2 * self.price
        for step in range(steps):
            if not team.missed and step % 16 == 0 and self.is_solved():
                return True
            visit = live[int(random() * len(live))]
            here = cell[visit]
            next_ = after[visit]
            if next_ < 0:
                if not closed:
                    self._end(visit, odds)
                continue
            there = cell[next_]
            way = there - here
            robot = owner[visit]
            draw = random()
            if draw < 0.5:
                then = after[next_]
                if then >= 0:
                    beyond = cell[then]
                    gain = pair if length[robot] <= limits[robot] else 4.0
                    if beyond == here:
                        cost = (len(visits[there]) == 1) - gain
                        if cost <= 0 or random() < odds[int(10 * cost)]:
                            team.remove(visit)
                        continue
                    turn = beyond - there
                    if turn == way:
                        continue
                    last = after[then]
                    if last >= 0 and cell[last] - beyond == -way:
                        cost = (len(visits[there]) == 1) + (len(visits[beyond]) == 1) - gain
                        if cost <= 0 or random() < odds[int(10 * cost)]:
                            team.remove(visit)
                            continue
                    corner = here + turn
                    if free[corner]:
                        cost = (len(visits[there]) == 1) - (not visits[corner])
                        if cost <= 0 or random() < odds[10]:
                            team.flip(next_, corner)
            elif length[robot] + 2 <= limits[robot]:
                if draw < 0.9:
                    side = 1 if way in (stride, -stride) else stride
                    if draw < 0.7:
                        side = -side
                    one, other = here + side, there + side
                    if free[one] and free[other]:
                        cost = pair - (not visits[one]) - (not visits[other])
                        if cost <= 0 or random() < odds[int(10 * cost)]:
                            team.insert(visit, one, other)
                elif draw < 0.97:
                    one = here + (1, -1, stride, -stride)[int(random() * 4)]
                    if free[one]:
                        cost = pair - (not visits[one])
                        if cost <= 0 or random() < odds[int(10 * cost)]:
                            team.insert(visit, one, here)
                else:
                    self.rewire(visit)
            elif draw > 0.97:
                self.rewire(visit)
        return self.is_solved()

    def mend(self) -> bool:
        """Let robots that have moves to spare pass by where nobody does; return whether that is all."""
        team, stride = self.team, self.stride
        if team.missed > FEW:
            return False
        for cell, needed in enumerate(self.free):
            if not needed or team.visits[cell]:
                continue
            spare = max(map(sub, self.limits, team.length))
            came = {cell: cell}
            ahead = [cell]
            moves = 0
            while ahead and 2 * (moves + 1) <= spare:
                moves += 1
                behind, ahead = ahead, []
                for at in behind:
                    for next_ in (at + 1, at - 1, at + stride, at - stride):
                        if self.free[next_] and next_ not in came:
                            came[next_] = at
                            ahead.append(next_)
                visit = self._visit_with(2 * moves, ahead)
                if visit >= 0:
                    self._detour(visit, came)
                    break
        return self.is_solved()

    def _visit_with(self, moves: int, cells: Sequence[int]) -> int:
        """Return a visit at one of some sub-cells by a robot with so many moves to spare, or -1."""
        team = self.team
        for cell in cells:
            for visit in team.visits[cell]:
                robot = team.owner[visit]
                if team.length[robot] + moves <= self.limits[robot]:
                    return visit
        return -1

    def _detour(self, visit: int, onward: dict[int, int]) -> None:
        """Go from a visit to where ``onward`` ends, and back the same way."""
        team = self.team
        cell = team.cell[visit]
        while onward[cell] != cell:
            team.insert(visit, onward[cell], cell)
            visit = team.after[visit]
            cell = onward[cell]

    def _end(self, visit: int, odds: list[float]) -> None:
        """Move the end of an open walk."""
        team, random = self.team, self.rng.random
        robot = team.owner[visit]
        length = team.length[robot]
        draw = random()
        if draw < 0.4:
            if length:
                gain = self.price if length <= self.limits[robot] else 2.0
                cost = (len(team.visits[team.cell[visit]]) == 1) - gain
                if cost <= 0 or random() < odds[int(10 * cost)]:
                    team.retract(robot)
                    self.limits[robot] = self._allowed(robot, team.last[robot])
            return
        there = team.cell[visit] + (1, -1, self.stride, -self.stride)[int(random() * 4)]
        if not self.free[there]:
            return
        if draw < 0.7:
            cost = self.price - (not team.visits[there])
            if length < self.limits[robot] and (cost <= 0 or random() < odds[int(10 * cost)]):
                team.append(robot, there)
                self.limits[robot] = self._allowed(robot, team.last[robot])
                if length >= self.limits[robot]:
                    team.retract(robot)
                    self.limits[robot] = self._allowed(robot, team.last[robot])
            return
        for other in team.visits[there]:
            if team.owner[other] == robot and team.after[other] not in {visit, -1}:
                end = team.after[other]
                part = team.part(end, visit) if length <= self._allowed(robot, end) else []
                if part:
                    team.turn(part)
                    self.limits[robot] = self._allowed(robot, end)
                return

    def rewire(self, visit: int) -> None:
        """Turn a part of a walk, or splice a loop, where the walk runs beside itself after a visit."""
        team = self.team
        cell, after, before = team.cell, team.after, team.before
        next_ = after[visit]
        here, there = cell[visit], cell[next_]
        side = 1 if there - here in (self.stride, -self.stride) else self.stride
        if self.rng.random() < 0.5:
            side = -side
        for other in team.visits[here + side]:
            if team.owner[other] != team.owner[visit]:
                continue
            beside = after[other]
            if beside >= 0 and cell[beside] == there + side:
                part = team.part(next_, other) or team.part(beside, visit)
                if part:
                    team.turn(part)
                return
            beside = before[other]
            if beside >= 0 and cell[beside] == there + side:
                part = team.part(next_, beside) or team.part(other, visit)
                if part and before[part[0]] >= 0 and after[part[-1]] >= 0:
                    self._splice(part)
                return

    def _splice(self, part: list[int]) -> None:
        """Take out a loop and put it in beside a walk, somewhere along it."""
        team = self.team
        cell, after, before, owner = team.cell, team.after, team.before, team.owner
        inside = set(part)
        robot = owner[part[0]]
        size = len(part)
        offset = int(self.rng.random() * size)
        # The edge that closes the loop lies beside the walk it comes from: that is where it was.
        for at in range(offset, offset + size):
            one, other = part[at % size], part[(at + 1) % size]
            if (at + 1) % size == 0:
                continue
            way = cell[other] - cell[one]
            side = 1 if way in (self.stride, -self.stride) else self.stride
            for across in (side, -side):
                beside, target = cell[one] + across, cell[other] + across
                for visit in team.visits[beside]:
                    if visit in inside:
                        continue
                    taker = owner[visit]
                    if taker != robot and team.length[taker] + size > self.limits[taker]:
                        continue
                    cut = (at + 1) % size
                    loop = part[cut:] + part[:cut]  # from ``other`` around to ``one``
                    next_ = after[visit]
                    if next_ >= 0 and next_ not in inside and cell[next_] == target:
                        team.splice(part, loop[::-1], visit)
                        return
                    next_ = before[visit]
                    if next_ >= 0 and next_ not in inside and cell[next_] == target:
                        team.splice(part, loop, next_)
                        return
