"""ORMSTC (Agmon, Hazon, Kaminka 2008, Sec. 4) as plainly as it can be said: one state, tick by tick.

All robots move in lockstep and know at once what any of them knows; there are no messages. Times
are ticks: tick t takes the team from time t - 1 to time t, and at time 0 all stand at their starts.
One tick is: deaths before anybody decides, which all see at once; everybody decides on the same old
state, and claims coarse cells; of the claimants of a cell one wins; dead robots' cells are released,
claimed ones taken; deaths that the others see from the next tick on only; moves.

The rules, where they are applied below:

- R1: a robot drives counter-clockwise inside a coarse cell, with its tree on its left.
- R2: at a sub-cell it decides about the one coarse cell that lies outward of it.
- R3: the last coarse cell to be looked at from the start cell follows from the start sub-cell.
- R4: where several robots start in one coarse cell, the highest id owns it; the others are spare.
- R5: a lap ends at the start sub-cell.
- R6: a robot is complete while no free coarse cell borders on its own; else it walks to the nearest.
- R7: the run ends when all live robots are complete.
- R8: cells are released by who owns them then.
- R10 (``lazy``): the cells of robots that died complete stay covered, as long as that serves.

Where the rules leave room:

- A robot is complete from the moment at which it arrives where its lap ends. So one that dies in
  phase ``pre`` of the next tick died complete, one that dies in phase ``mid`` of its last did not.
- Whether the run is over is asked after the deaths ``pre`` of a tick, before anybody decides.
- Dead robots' cells are released as soon as the death is known. Under R10 those of all robots that
  died complete are, in a tick that begins with all live ones complete and some known cell without
  an owner: known are start cells and those that somebody once looked at, within reach or not.
- A spare robot counts as complete while its cell has an owner, be it a dead one that died complete.
- A robot on its way to an exit which finds that another took the cell is complete where it stands.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import count

from protocol.grid import Cell

WHERE: tuple[Cell, ...] = ((1, 1), (0, 1), (0, 0), (1, 0))
"""Where in its coarse cell a sub-cell is: south-east, then counter-clockwise."""

OUT: tuple[Cell, ...] = ((0, 1), (-1, 0), (0, -1), (1, 0))
"""Outward of each of them: east, north, west, south; so also the counter-clockwise order of sides."""

Kill = tuple[int, int, str]
Edge = tuple[Cell, Cell]
Visit = tuple[int, int, Cell]


# Geometry ----------------------------------------------------------------------------------------


def coarse(at: Cell) -> Cell:
    """Return the coarse cell of a sub-cell."""
    return at[0] // 2, at[1] // 2


def corner(at: Cell) -> int:
    """Tell which of the four sub-cells of its coarse cell a sub-cell is."""
    return WHERE.index((at[0] % 2, at[1] % 2))


def sub_cell(cell: Cell, which: int) -> Cell:
    """Return a sub-cell of a coarse cell, by its number counter-clockwise."""
    down, right = WHERE[which % 4]
    return 2 * cell[0] + down, 2 * cell[1] + right


def turned(at: Cell, steps: int = 1) -> Cell:
    """Return the next sub-cell of the same coarse cell, counter-clockwise."""
    return sub_cell(coarse(at), corner(at) + steps)


def across(at: Cell) -> Cell:
    """Return the sub-cell that lies outward of a sub-cell, in the neighbouring coarse cell."""
    down, right = OUT[corner(at)]
    return at[0] + down, at[1] + right


def beyond(at: Cell) -> Cell:
    """Return the coarse cell outward of a sub-cell."""
    return coarse(across(at))


def reachable(free: Iterable[Cell], starts: Iterable[Cell]) -> set[Cell]:
    """Return the free coarse cells that can be reached from some of them."""
    left = set(free)
    ahead = [cell for cell in starts if cell in left]
    left.difference_update(ahead)
    reached = set(ahead)
    while ahead:
        row, col = ahead.pop()
        near = {(row + down, col + right) for down, right in OUT} & left
        left -= near
        reached |= near
        ahead.extend(near)
    return reached


# Robots ------------------------------------------------------------------------------------------


@dataclass
class Robot:
    """A robot and its spanning tree.

    Attributes:
        tree: for each of its coarse cells, those that a tree edge leads to; empty: it is spare.
        until: the sub-cell where its lap ends, or its excursion into cells claimed later; None
            while it rests, or walks on its contour to where it will leave it.
        lapping: it is on its first lap.
        complete: it announced completion, and did not withdraw it.
        done_at: when it last did.
        links: only as printed: for each robot met, the first and the last edge where it was met.
        goal: only as printed: the sub-cell where it will leave its contour, the robot whose cells
            lie there, and the direction in which it walks.
        withdrew: only as printed: it once withdrew its completion.
    """

    number: int
    start: Cell
    at: Cell
    tree: dict[Cell, set[Cell]] = field(default_factory=dict)
    until: Cell | None = None
    lapping: bool = True
    alive: bool = True
    complete: bool = False
    done_at: int | None = None
    moves: int = 0
    links: dict[int, tuple[Cell, Cell]] = field(default_factory=dict)
    goal: tuple[Cell, int, int] | None = None
    withdrew: bool = False

    def next(self, at: Cell) -> Cell:
        """Return what follows a sub-cell on the contour, counter-clockwise."""
        return across(at) if beyond(at) in self.tree[coarse(at)] else turned(at)

    def tour(self) -> list[Cell]:
        """Return the whole contour, from where it is."""
        tour = [self.at]
        while (at := self.next(tour[-1])) != self.at:
            tour.append(at)
        return tour

    def exits(self) -> Iterable[tuple[Cell, Cell, Cell]]:
        """Yield own coarse cell, a neighbour of it, and the sub-cell that leads from one to it."""
        for own in self.tree:
            for which in range(4):
                at = sub_cell(own, which)
                yield own, beyond(at), at


@dataclass(frozen=True)
class Choice:
    """What a robot decided for one tick.

    Attributes:
        step: where it moves if it wins no claim; None: nowhere.
        claim: a coarse cell, the one outward of it; if it wins, it crosses.
        frees: only as printed: dead robots whose cells it met.
        barges: only as printed: it crosses without claiming.
    """

    step: Cell | None = None
    claim: Cell | None = None
    frees: tuple[int, ...] = ()
    barges: bool = False


@dataclass(frozen=True)
class Outcome:
    """How a run went; times are ticks, lists are by robot.

    Attributes:
        covered: nothing is missing.
        cover_time: time of the last first visit.
        done_at: when it completed for the last time; None for the lost, and for spare ones.
        cells: how many coarse cells it owns in the end.
        moves: sub-cells moved to.
        extra: visits beyond the first of a sub-cell; starts are visits.
        missing: coarse cells within reach of a survivor that are not covered, sorted (R11).
        lost: who died.
        owner: whose each coarse cell is in the end.
        trees: the edges of each robot's tree, each with its lesser end first.
        visits: time, robot and sub-cell, in the order in which they happened.
        ended: by R7; else nothing moved any more, or it went on for too long.
    """

    covered: bool
    cover_time: int
    done_at: list[int | None]
    cells: list[int]
    moves: list[int]
    extra: int
    missing: list[Cell]
    lost: list[int]
    owner: dict[Cell, int]
    trees: list[set[Edge]]
    visits: list[Visit]
    ended: bool


def play(
    free: set[Cell],
    robots: Sequence[Cell],
    kills: Sequence[Kill] = (),
    *,
    rule: str = "id",
    lazy: bool,
    literal: bool = False,
    stand_by_until: int = 0,
) -> Outcome:
    """Play a run.

    Args:
        free: the free coarse cells.
        robots: the sub-cells where they start, all within free coarse cells.
        kills: tick, robot, and ``pre`` (before it decides) or ``mid`` (after it claimed, before it
            moves). One that comes after the end of the run never strikes; one of phase ``pre`` still
            strikes in the tick that would have been the next.
        rule: who gets a cell that several claim: ``id``, the highest id, or ``few``, the one with
            the fewest cells, of those the highest id.
        lazy: R10.
        literal: Algorithm 3 as printed, but with R1 and R2; see `Literal`.
        stand_by_until: the run does not end before this tick has been played.
    """
    run = (Literal if literal else Run)(free, robots, kills, rule, lazy, stand_by_until)
    run.play()
    return run.outcome()


class Run:
    """The state of a run; `play` plays it."""

    def __init__(
        self,
        free: set[Cell],
        starts: Sequence[Cell],
        kills: Sequence[Kill],
        rule: str,
        lazy: bool,
        stand_by_until: int,
    ) -> None:
        self.free = free
        self.kills = kills
        self.rule = rule
        self.lazy = lazy
        self.stand_by_until = stand_by_until
        self.robots = [Robot(number, start, start) for number, start in enumerate(starts)]
        self.visits = [(0, robot.number, robot.at) for robot in self.robots]
        self.known = {coarse(start) for start in starts}
        self.ended = False
        self.tick = 0
        for robot in reversed(self.robots):  # R4
            if coarse(robot.start) not in self.owners():
                self.take(robot, coarse(robot.start))

    def play(self) -> None:
        """Play until the end, or for so long that there is none in sight."""
        last = max([self.stand_by_until, *(tick for tick, _, _ in self.kills)])
        generous = 40 * (len(self.free) + 1) * len(self.robots)
        for self.tick in count(1):
            self.die("pre")
            self.learn()
            self.ended = self.tick > self.stand_by_until and self.is_over()
            if self.ended or self.tick > last + generous:
                break
            choices = {robot.number: self.choose(robot) for robot in self.live()}
            if self.tick > last and all(choice == Choice() for choice in choices.values()):
                break  # Only ever so as printed: not over, yet nobody has anything to do.
            winners = self.winners(choices)
            self.settle(choices, winners)
            self.die("mid")
            for robot in self.live():
                self.move(robot, choices[robot.number].step)
            for robot in self.live():
                self.rest(robot)

    # The state ------------------------------------------------------------------------------

    def live(self) -> list[Robot]:
        return [robot for robot in self.robots if robot.alive]

    def dead(self) -> list[Robot]:
        return [robot for robot in self.robots if not robot.alive]

    def owners(self) -> dict[Cell, int]:
        return {cell: robot.number for robot in self.robots for cell in robot.tree}

    def pending(self, robot: Robot) -> list[tuple[Cell, Cell, Cell]]:
        """Return own cell, free neighbour, and the sub-cell that leads there (R6)."""
        owners = self.owners()
        if not robot.tree:  # R4: a spare robot waits for the cell it stands in.
            own = coarse(robot.at)
            return [] if own in owners else [(own, own, robot.at)]
        return [pair for pair in robot.exits() if pair[1] in self.free and pair[1] not in owners]

    # One tick -------------------------------------------------------------------------------

    def die(self, phase: str) -> None:
        for tick, number, when in self.kills:
            if (tick, when) == (self.tick, phase):
                self.robots[number].alive = False

    def learn(self) -> None:
        """See who died; release what was theirs (R2, R8, R10), withdraw completions (R6)."""
        for robot in self.dead():
            if not (self.lazy and robot.complete):
                robot.tree = {}
        if self.is_over() and self.known - set(self.owners()):  # Only ever so if lazy.
            for robot in self.dead():
                robot.tree = {}
        for robot in self.live():
            robot.complete = robot.complete and not self.pending(robot)

    def is_over(self) -> bool:
        """Tell whether all live robots are complete (R7); a spare one is while it has no work."""
        live = self.live()
        at_rest = all(robot.complete or not robot.tree for robot in live)
        return at_rest and not any(self.pending(robot) for robot in live)

    def choose(self, robot: Robot) -> Choice:
        if not robot.tree:  # R4
            return Choice(claim=coarse(robot.at) if self.pending(robot) else None)
        self.known |= {beyond(robot.at)} & self.free
        if robot.until is None:
            return Choice() if robot.complete else self.walk(robot)
        # R2. A blocked cell, an own one and one of a live robot all mean: follow the contour; so
        # does a lost claim, as no tree edge leads to a cell that is free.
        is_free = beyond(robot.at) in self.free and beyond(robot.at) not in self.owners()
        return Choice(robot.next(robot.at), beyond(robot.at) if is_free else None)

    def walk(self, robot: Robot) -> Choice:
        """Go to the nearest exit, or leave by it (R6)."""
        tour = robot.tour()
        plans = []
        for own, neighbour, exit_ in self.pending(robot):
            ahead = tour.index(exit_)
            back = len(tour) - ahead
            plans.append((min(ahead, back), ahead > back, own, neighbour))
        distance, backwards, _, neighbour = min(plans)
        if distance == 0:
            return Choice(tour[1], neighbour)
        return Choice(tour[-1 if backwards else 1])

    def winners(self, choices: dict[int, Choice]) -> dict[Cell, Robot]:
        claims: dict[Cell, list[Robot]] = {}
        for number, choice in choices.items():
            if choice.claim is not None:
                claims.setdefault(choice.claim, []).append(self.robots[number])

        def rank(robot: Robot) -> tuple[int, int]:
            return (-len(robot.tree) if self.rule == "few" else 0, robot.number)

        return {cell: max(claimants, key=rank) for cell, claimants in claims.items()}

    def settle(self, choices: dict[int, Choice], winners: dict[Cell, Robot]) -> None:
        """Take the cells won; the winners will cross, but for spare ones, which strike root."""
        for cell, robot in winners.items():
            step = across(robot.at) if robot.tree else None
            choices[robot.number] = replace(choices[robot.number], step=step)
            self.take(robot, cell)

    def take(self, robot: Robot, cell: Cell) -> None:
        """Make a cell the root of a tree, or build an edge to it from where the robot is."""
        if not robot.tree:
            robot.until = robot.at  # R5
            robot.tree[cell] = set()
            return
        if robot.until is None:
            robot.until = turned(robot.at)  # R6: where it will return into its own cell.
        robot.tree[coarse(robot.at)].add(cell)
        robot.tree.setdefault(cell, set()).add(coarse(robot.at))

    def move(self, robot: Robot, step: Cell | None) -> None:
        if step is None:
            return
        robot.at = step
        robot.moves += 1
        self.visits.append((self.tick, robot.number, step))
        if robot.at == robot.until:
            robot.until = None
            robot.lapping = False

    def rest(self, robot: Robot) -> None:
        """Announce completion, if nothing is left to do (R6)."""
        resting = robot.tree and robot.until is None
        if resting and not robot.complete and not self.pending(robot):
            robot.complete = True
            robot.done_at = self.tick

    # What came of it ------------------------------------------------------------------------

    def outcome(self) -> Outcome:
        first: dict[Cell, int] = {}
        for time, _, at in self.visits:
            first.setdefault(at, time)
        within_reach = reachable(self.free, [coarse(robot.start) for robot in self.live()])
        missing = [
            cell for cell in within_reach if any(sub_cell(cell, w) not in first for w in range(4))
        ]
        return Outcome(
            covered=not missing,
            cover_time=max(first.values()),
            done_at=[robot.done_at if robot.alive else None for robot in self.robots],
            cells=[len(robot.tree) for robot in self.robots],
            moves=[robot.moves for robot in self.robots],
            extra=len(self.visits) - len(first),
            missing=sorted(missing),
            lost=[robot.number for robot in self.dead()],
            owner=self.owners(),
            trees=[
                {(one, other) for one, near in robot.tree.items() for other in near if one < other}
                for robot in self.robots
            ],
            visits=self.visits,
            ended=self.ended,
        )


# As printed --------------------------------------------------------------------------------------


class Literal(Run):
    """Algorithm 3 as printed, driven by R1 and R2; lines are those of Algorithm 3.

    C1: who first meets a dead robot's cell on its lap frees all its cells, and deletes the links to
    it of all robots (lines 12 to 14). C3: who withdrew its completion never announces again (line 28,
    36). C4: the last neighbour of the start cell is entered whoever owns it, and links nothing
    (lines 21, 22). C6: the cells of complete robots are covered again (line 26).
    """

    def owned_by(self, cell: Cell) -> list[Robot]:
        """Return all robots with a cell in their tree; there may be two, by lines 21 and 22."""
        return [robot for robot in self.robots if cell in robot.tree]

    def learn(self) -> None:
        """Learn nothing: deaths are noticed where a robot looks for them."""

    def is_over(self) -> bool:
        links = {met for robot in self.live() for met in robot.links}
        announced = all(robot.complete or not robot.tree for robot in self.live())
        return announced and all(self.robots[met].alive for met in links)

    def choose(self, robot: Robot) -> Choice:
        if not robot.tree:  # Not in the paper: R4.
            return self.unless_owned(coarse(robot.at))
        if robot.until is None:
            return self.stand_by(robot)
        looked, step = beyond(robot.at), robot.next(robot.at)
        if looked not in self.free or looked in robot.tree:  # Line 3.
            return Choice(step)
        if robot.lapping and turned(robot.at) == robot.start:  # Lines 21, 22.
            return Choice(across(robot.at), barges=True)
        choice = self.unless_owned(looked, step)
        if choice.claim is None:  # Lines 7 to 11.
            self.link(robot, looked)
        return choice

    def unless_owned(self, cell: Cell, step: Cell | None = None) -> Choice:
        """Claim a cell, and free those of its dead owners, unless an owner lives."""
        owners = self.owned_by(cell)
        dead = tuple(owner.number for owner in owners if not owner.alive)
        lives = len(dead) < len(owners)
        return Choice(step, None if lives else cell, frees=dead)

    def link(self, robot: Robot, met: Cell) -> None:
        for owner in self.owned_by(met):
            if owner.alive and owner is not robot:
                first, _ = robot.links.get(owner.number, (robot.at, robot.at))
                robot.links[owner.number] = (first, robot.at)

    def stand_by(self, robot: Robot) -> Choice:
        """Lines 25 to 35."""
        frees: tuple[int, ...] = ()
        if robot.goal is None:
            dead = [met for met in sorted(robot.links) if not self.robots[met].alive]
            if not dead:
                return Choice()
            frees = (dead[0],)  # Line 27.
            robot.complete, robot.withdrew = False, True  # Line 28.
            tour = robot.tour()
            ends = [(tour.index(end), 1, end) for end in robot.links[dead[0]]]
            ends += [((len(tour) - ahead) % len(tour), -1, end) for ahead, _, end in ends]
            _, direction, end = min(ends, key=lambda plan: plan[0])  # Line 29.
            robot.goal = (end, dead[0], direction)
        end, met, direction = robot.goal
        if robot.at != end:
            return Choice(robot.tour()[direction], frees=frees)  # Line 30.
        robot.goal = None
        self.forget(met)  # Line 32.
        if beyond(end) in robot.tree or any(who.alive for who in self.owned_by(beyond(end))):
            return Choice(robot.next(end), frees=frees)  # Somebody was there before.
        return Choice(robot.next(end), beyond(end), frees=frees)  # Lines 33 to 35.

    def forget(self, dead: int) -> None:
        for robot in self.robots:
            robot.links.pop(dead, None)

    def settle(self, choices: dict[int, Choice], winners: dict[Cell, Robot]) -> None:
        for number, choice in list(choices.items()):
            for dead in choice.frees:  # Line 14, line 27.
                self.robots[dead].tree = {}
                if self.robots[number].until is not None:
                    self.forget(dead)  # Line 13.
        super().settle(choices, winners)
        for number, choice in choices.items():
            robot = self.robots[number]
            if choice.barges:
                self.take(robot, beyond(robot.at))
            elif choice.claim is not None and winners[choice.claim] is not robot:
                self.link(robot, choice.claim)

    def rest(self, robot: Robot) -> None:
        """Line 24, which is behind a robot that withdrew."""
        if robot.tree and robot.until is None and not (robot.complete or robot.withdrew):
            robot.complete = True
            robot.done_at = self.tick


# A single robot, recursively ---------------------------------------------------------------------


def scan(free: set[Cell], robot: Cell, direction: str = "ccw") -> tuple[int, int]:
    """Let a single robot run Algorithm 3 recursively, and count its moves and revisits.

    The four neighbours of a coarse cell are tried in the given direction, the one it came from last;
    inside a coarse cell it drives counter-clockwise all the same, to where it leaves (R1).

    Args:
        free: the free coarse cells.
        robot: the sub-cell where it starts.
        direction: in which neighbours are tried, ``ccw`` or ``cw``.

    Returns:
        Moves, and visits beyond the first of a sub-cell; the start is one.
    """
    path = [robot]
    covered = {coarse(robot)}
    turn = {"ccw": 1, "cw": -1}[direction]

    def drive(which: int) -> None:
        while corner(path[-1]) != which:
            path.append(turned(path[-1]))

    def cross(side: int) -> None:
        drive(side)
        path.append(across(path[-1]))

    def cover(cell: Cell, came_from: int) -> None:
        for step in range(1, 5):
            side = (came_from + turn * step) % 4
            neighbour = beyond(sub_cell(cell, side))
            # Line 18 to 20: the last one of a cell that is not the first is where it came from.
            if neighbour in free and neighbour not in covered:
                covered.add(neighbour)
                cross(side)
                cover(neighbour, (side + 2) % 4)
                cross((side + 2) % 4)

    # R3: the side that is clockwise of the start sub-cell's own comes last.
    cover(coarse(robot), (corner(robot) - 1) % 4)
    if len(path) == 1:
        path.append(turned(robot))  # R5: all alone in its cell it goes round all the same.
    drive(corner(robot))
    return len(path) - 1, len(path) - len(set(path))
