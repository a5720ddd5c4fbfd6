"""Parent and children: a robot that has a map leads others that neither see nor know where they are.

The parent plans every move of all (`agents.planning.parent_child`) and has the children make them, by
radio, in line of sight. A child makes the move that it is told, says that it did, and stands still
otherwise.

    command           a byte for the parents and one for each child, once a tick: the exit to leave by,
                      `STAY`, or `END`
    acknowledgement   how many moves a child has made by now, when it has made another one; of a
                      parent that stands by nothing but an empty message

Robots below ``parents`` are parents, the others their children. The lowest parent that lives leads;
the others stand by: they make its moves, and listen.

Assumes: a known grid without bodies in the way; parents that know where they are and see robots in
line of sight; a radio in line of sight that reaches at least as far and loses nothing; losses are heard
by all; all parents start on one sub-cell.

Claims: every free sub-cell that can be reached is visited by a child while one child and one parent
live; no child moves out of sight of a parent; in lockstep and without losses the run takes as many
ticks as were planned. When no parent is left the children stop where they are.

How it goes on. In lockstep all moves of a tick are made in the instant of the command: a child hears
it in the round after. On the event clock the parent goes on once it sees each robot, where it should be
in sight, at the place where it should be; acknowledgements wake it. What is covered is what a child
was seen at, or told of; what a lost child was on its way to is not. After the loss of a child the
leading parent plans for the rest, and so does one that takes over, from its own knowledge: it stood
where the other one stood, and heard its commands.

At its end a plan leaves all children in sight of the parent. Then it tells them to stop.

Paper:
    The parent-child paper, Sec. 3. It has no losses, and one parent. Where a child is when it is out of
    sight the parent knows by the last command.
"""

from collections.abc import Iterable
from functools import lru_cache
from typing import NamedTuple

from agents.body import Body
from agents.planning.parent_child import STAY, Plan, Zones, plan_team
from protocol.errors import AlgorithmError
from protocol.grid import STEPS, Cell, Grid
from protocol.messages import Sight, Stop, TeamSight

END = 5
"""The command to stop; 0 to 3 are exits, and then comes `STAY`."""

ARRIVED = b""
"""The acknowledgement of a parent that stands by: it can be seen where it is."""


class Land(NamedTuple):
    """What there is to cover, and from where.

    Attributes:
        zones: the map, and who sees whom on it.
        stops: where a parent is to stand.
        vertices: the sub-cells to cover.
        in_file: how many children fit into the line of sight one behind the other.
    """

    zones: Zones
    stops: tuple[Cell, ...]
    vertices: frozenset[Cell]
    in_file: int

    def plan(self, parent: Cell, children: Iterable[Cell], covered: Iterable[Cell] = ()) -> Plan:
        """Plan what is left to cover."""
        return plan_team(
            self.zones,
            self.stops,
            parent=parent,
            children=tuple(children),
            covered=frozenset(covered),
            in_file=self.in_file,
        )


@lru_cache(maxsize=4)
def land_of(rows: int, cols: int, blocked: bytes, start: Cell, range_cells: float) -> Land:
    """Choose the stops of a parent; robots in one process, and the verdict, share what is found.

    Args:
        rows: of sub-cells.
        cols: of sub-cells.
        blocked: the sub-cells, as `protocol.grid.Grid` takes them.
        start: where the parent starts; what can be reached from there is to be covered.
        range_cells: how far robots see each other, the paper's r_los / d; that far is too far.
    """
    from agents.planning.vertices import (  # noqa: PLC0415  numpy, which children need not pay for
        Reach,
        choose,
    )

    grid = Grid(rows, cols, blocked)
    reach = Reach.of_lengths(range_cells, 1)
    choice = choose(grid, reach, start)
    zones = Zones(grid, choice.sights.seen)
    vertices = frozenset(grid.reachable([start]))
    return Land(zones, tuple(choice.parents), vertices, reach.in_file)


@lru_cache(maxsize=4)
def first_plan(
    rows: int,
    cols: int,
    blocked: bytes,
    starts: tuple[Cell, ...],
    parents: int,
    range_cells: float,
) -> Plan:
    """Return the plan with which a team sets out; arguments as of `land_of`.

    Args:
        rows: of sub-cells.
        cols: of sub-cells.
        blocked: the sub-cells.
        starts: of all robots, the parents first.
        parents: how many of them are parents.
        range_cells: how far robots see each other.
    """
    land = land_of(rows, cols, blocked, starts[0], range_cells)
    return land.plan(starts[0], starts[parents:])


class Team:
    """What a parent knows of all robots.

    Attributes:
        at: where each robot is, or is on its way to by the last command.
        moves: how many moves each child was told to make.
        covered: where a child was for certain.
        lost: robots of whose loss was heard.
    """

    def __init__(self, starts: Iterable[Cell], parents: int) -> None:
        """Begin with robots that stand still."""
        self.at = dict(enumerate(starts))
        self.moves = dict.fromkeys(self.at, 0)
        self.covered: set[Cell] = set()
        self.lost: set[int] = set()
        self._parents = parents

    @property
    def leader(self) -> int | None:
        """The parent that leads."""
        return next((one for one in range(self._parents) if one not in self.lost), None)

    @property
    def children(self) -> list[int]:
        """The children that live."""
        return [one for one in self.at if one >= self._parents and one not in self.lost]

    def told(self, command: bytes) -> None:
        """Take down a command."""
        for robot in self.at:
            order = command[max(0, robot - self._parents + 1)]
            if order < STAY:
                row, col = self.at[robot]
                self.at[robot] = (row + STEPS[order][0], col + STEPS[order][1])
                self.moves[robot] += 1

    def hear(self, here: TeamSight) -> int:
        """Take in what a parent perceives; return what the parents were told."""
        own = STAY
        for sender, message in here.inbox:
            if sender < self._parents:
                if message != ARRIVED:
                    own = message[0]
                    self.told(message)
            elif acknowledged(message) == self.moves[sender]:
                self.covered.add(self.at[sender])
        self.lost.update(here.losses)
        self.covered.update(
            cell for robot, cell in here.robots if robot >= self._parents and cell == self.at[robot]
        )
        return own


def acknowledgement(moves: int) -> bytes:
    """Encode how many moves a child has made."""
    return moves.to_bytes(4, "little")


def acknowledged(message: bytes) -> int:
    """Decode how many moves a child has made."""
    return int.from_bytes(message, "little")


async def parent_child(body: Body) -> Stop | None:
    """Lead, or stand by until one has to, or obey."""
    parents = body.briefing.parents
    if not parents:
        raise AlgorithmError("parent-child needs a parent; expected `team.parents` of at least 1")
    if body.robot >= parents:
        await obey(body, parents)
        return None
    return await Parent(body, parents).work()


async def obey(body: Body, parents: int) -> None:
    """Make the moves that a parent tells, until it tells to stop or no parent is left."""
    index = body.robot - parents + 1
    left = set(range(parents))
    moves = 0
    words: tuple[bytes, ...] = ()
    here: Sight = await body.look()
    while True:
        left.difference_update(here.losses)
        commands = [said for sender, said in here.inbox if sender < parents and said != ARRIVED]
        orders = {command[index] for command in commands} - {STAY}
        if END in orders or not left:
            return
        if orders:
            here = await body.move(orders.pop())
            moves += 1
            words = (acknowledgement(moves),)
        else:
            here = await body.wait_for_news(messages=words)
            words = ()


class Parent:
    """A robot that leads, or stands by."""

    def __init__(self, body: Body, parents: int) -> None:
        """Read the map.

        Raises:
            AlgorithmError: If there is none, or robots do not see each other.
        """
        known, range_cells = body.briefing.map, body.briefing.sensing.robots_cells
        if known is None or not range_cells:
            raise AlgorithmError(
                "parents need a map and see robots; expected `sensing.map = true` and a length as "
                "`sensing.robots_m`"
            )
        self._body = body
        self._parents = parents
        self._known = known
        self._range_cells = range_cells
        self._team = Team(known.starts, parents)
        self._here: TeamSight

    async def work(self) -> Stop:
        """Stand by, lead when it is time to, and tell all to stop at the end."""
        own = self._hear(await self._body.look())
        words: tuple[bytes, ...] = ()
        while True:
            if own == END:
                return self._body.last_words()
            if own != STAY:
                own = self._hear(await self._body.move(own))
                words = (ARRIVED,)
            elif self._team.leader == self._body.robot:
                return await self._lead()
            else:
                own = self._hear(await self._body.wait_for_news(messages=words))
                words = ()

    async def _lead(self) -> Stop:
        known, team = self._known, self._team
        land = land_of(
            known.rows, known.cols, known.sub_cells(), known.starts[0], self._range_cells
        )
        if not self._here.time and not team.lost:
            plan = first_plan(
                known.rows,
                known.cols,
                known.sub_cells(),
                known.starts,
                self._parents,
                self._range_cells,
            )
            await self._follow(land, plan)
        while team.children and not self._is_done(land):
            children = [team.at[child] for child in team.children]
            await self._follow(land, land.plan(self._here.position, children, team.covered))
        return self._body.last_words(messages=(bytes([END]) * self._command_bytes,))

    async def _follow(self, land: Land, plan: Plan) -> None:
        """Have a plan carried out, as far as it goes until a child is lost."""
        body, team = self._body, self._team
        children = team.children
        for own, *moves in zip(*plan.moves, strict=True):
            await self._see_all(land, children)
            if team.children != children:
                return
            orders = dict(zip(children, moves, strict=True))
            numbers = range(self._parents, body.team_size)
            command = bytes([own, *(orders.get(child, STAY) for child in numbers)])
            team.told(command)
            if own != STAY:
                self._hear(await body.move(own, messages=(command,)))
            elif body.briefing.lockstep:
                self._hear(await body.wait(messages=(command,)))
            else:
                self._hear(await body.exchange(command))
        await self._see_all(land, children)

    async def _see_all(self, land: Land, children: list[int]) -> None:
        """Wait until all who should be in sight are seen where they should be, or a child is lost."""
        while self._team.children == children and not self._sees_all(land):
            self._hear(await self._body.wait_for_news())

    def _sees_all(self, land: Land) -> bool:
        """Tell whether those who stand by are here, and children in sight where they should be."""
        team, seen = self._team, dict(self._here.robots)
        expected = set(range(self._parents)) - team.lost - {self._body.robot}
        expected.update(child for child in team.children if self._is_in_sight(land, child))
        return all(seen.get(robot) == team.at[robot] for robot in expected)

    def _is_in_sight(self, land: Land, child: int) -> bool:
        place = land.zones.grid.place
        return place(*self._team.at[child]) in land.zones.seen(place(*self._here.position))

    def _is_done(self, land: Land) -> bool:
        """Tell whether all is covered, and everybody in sight to be told so."""
        children = self._team.children
        in_sight = all(self._is_in_sight(land, child) for child in children)
        return in_sight and land.vertices <= self._team.covered and self._sees_all(land)

    @property
    def _command_bytes(self) -> int:
        return 1 + self._body.team_size - self._parents

    def _hear(self, here: TeamSight) -> int:
        self._here = here
        return self._team.hear(here)
