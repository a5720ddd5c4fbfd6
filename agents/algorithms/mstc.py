"""MSTC: a team covers a grid that it has a map of, along one tour around a spanning tree.

Agmon, Hazon, Kaminka 2008, "The giving tree", Sec. 3. Every robot knows the map and all starts and
makes the same plan (`agents.planning.team`): a spanning tree of the complete coarse cells, the tour
around it, and a part of the tour for each robot, by NB, B or Opt MSTC. Then it walks.

Assumes: a known grid without bodies in the way; a radio that reaches everybody and loses nothing;
losses are heard by all.

Claims: every sub-cell is covered, with ``split = "nb"`` and without losses each once; in lockstep and
without losses coverage takes as long as planned; NB takes at most twice as long as Opt (Theorem 1);
the team completes while one robot is left (Sec. 3.1: robustness).

Who takes over. The paper has the robot behind follow the tour into the part of one that failed. A part
is *done* once a robot that has walked all of it says so. A part that is not done belongs to the
nearest living robot backwards on the tour, its own robot first: the *heir*. Robots may hear of a loss
late, but those they know of are true; so whoever takes itself for the heir is, and no two living
robots ever walk one part. A robot that has nothing to do waits for news, and stops when all parts are
done: as long as one is not, its heir is alive and has not stopped. Each loss gives away at most all
parts, so it ends. How much of a part was covered when its robot was lost nobody knows: it is walked
again as a whole.

Departures: B and Opt take over by the same rule; the paper speaks of NB only. The heir goes to the
nearer end of the part by a shortest way instead of along the tour.
"""

from collections import deque
from collections.abc import Collection, Sequence
from typing import Annotated, Literal

from msgspec import Meta, Struct

from agents.body import Body
from agents.planning.team import Kind, TeamPlan, team_plan
from protocol.errors import AlgorithmError
from protocol.grid import STEPS, Cell
from protocol.messages import Sight, Stop

EXITS = {step: exit_ for exit_, step in enumerate(STEPS)}
"""The exit of each step."""


class Options(Struct, frozen=True, forbid_unknown_fields=True):
    """Options of MSTC.

    Attributes:
        tree: the spanning tree.
        split: how its tour is divided: ``"nb"``, ``"b"`` or ``"opt"``.
        distance: between the tips of Create_Tree.
        alpha: Create_Tree draws k to the alpha bridge sets.
        home: whether robots go back to where they started.
    """

    tree: Literal["create-tree", "random", "depth-first", "breadth-first", "minimum"] = (
        "create-tree"
    )
    split: Literal["nb", "b", "opt"] = "opt"
    distance: Literal["manhattan", "euclid", "shortest-path"] = "manhattan"
    alpha: Annotated[float, Meta(ge=0, le=4)] = 2.0
    home: bool = False

    @property
    def kind(self) -> Kind:
        """How to plan."""
        return Kind(self.tree, f"{self.split}-mstc", self.distance, self.alpha)


class Parts:
    """Which parts of the tour are done, and whose the others are.

    Attributes:
        done: robots whose parts were walked.
        lost: robots that were lost.
    """

    def __init__(self, order: Sequence[int]) -> None:
        self._order = tuple(order)
        self.done: set[int] = set()
        self.lost: set[int] = set()

    def heir(self, part: int) -> int | None:
        """Return the robot that a part belongs to: the nearest alive, backwards from its own."""
        at = self._order.index(part)
        for back in range(len(self._order)):
            robot = self._order[at - back]
            if robot not in self.lost:
                return robot
        return None

    def left_to(self, robot: int) -> list[int]:
        """Return the parts that a robot has still to walk, along the tour from its own."""
        at = self._order.index(robot)
        ahead = (*self._order[at:], *self._order[:at])
        return [part for part in ahead if part not in self.done and self.heir(part) == robot]

    def complete(self) -> bool:
        """Tell whether all parts are done."""
        return self.done.issuperset(self._order)

    def hear(self, here: Sight) -> None:
        """Take in who was lost and what was done."""
        self.lost.update(here.losses)
        self.done.update(read(message) for _, message in here.inbox)


def note(part: int) -> bytes:
    """Encode that a part is done."""
    return part.to_bytes(4, "little")


def read(message: bytes) -> int:
    """Decode which part is done."""
    return int.from_bytes(message, "little")


def shortest_way(cells: Collection[Cell], start: Cell, targets: Collection[Cell]) -> list[Cell]:
    """Return the sub-cells from ``start`` to the nearest of ``targets``, without the first.

    Args:
        cells: those that may be entered, connected.
        start: one of them.
        targets: some of them.
    """
    came: dict[Cell, Cell] = {start: start}
    ahead = deque([start])
    while ahead:
        at = ahead.popleft()
        if at in targets:
            way = []
            while at != start:
                way.append(at)
                at = came[at]
            return way[::-1]
        for down, right in STEPS:
            cell = (at[0] + down, at[1] + right)
            if cell in cells and cell not in came:
                came[cell] = at
                ahead.append(cell)
    raise AssertionError("the cells are connected")


def walk_of(plan: TeamPlan, cells: Collection[Cell], position: Cell, part: int) -> list[Cell]:
    """Return the way from a place through a whole part, from its nearer end to the other."""
    stretch = plan.parts[part]
    way = shortest_way(cells, position, {stretch[0], stretch[-1]})
    end = way[-1] if way else position
    return way + (stretch[1:] if end == stretch[0] else stretch[-2::-1])


class Robot:
    """A robot that walks and listens.

    Attributes:
        position: where it is.
        parts: what it knows of the parts.
    """

    def __init__(self, body: Body, position: Cell, parts: Parts) -> None:
        self._body = body
        self._news: tuple[bytes, ...] = ()
        self.position = position
        self.parts = parts

    async def walk(self, way: Sequence[Cell]) -> None:
        """Go from one sub-cell to the next."""
        for row, col in way:
            exit_ = EXITS[row - self.position[0], col - self.position[1]]
            here = await self._body.move(exit_, messages=self._said())
            self.position = (row, col)
            self.parts.hear(here)

    async def wait(self) -> None:
        """Wait for a loss, or for word that a part is done."""
        self.parts.hear(await self._body.wait_for_news(messages=self._said()))

    def finish(self, part: int) -> None:
        """Take down that a part is done, and tell the others with the next request."""
        self.parts.done.add(part)
        self._news = (*self._news, note(part))

    def last_words(self) -> Stop:
        """Return the stop, with what is still to be said."""
        return self._body.last_words(messages=self._said())

    def _said(self) -> tuple[bytes, ...]:
        news, self._news = self._news, ()
        return news


async def mstc(body: Body, options: Options) -> Stop:
    """Cover the own part of the tour, and what is left by robots that were lost."""
    known = body.briefing.map
    if known is None:
        raise AlgorithmError("MSTC needs a map; expected `sensing.map = true` and a grid")
    start = known.starts[body.robot]
    plan = team_plan(
        known.rows, known.cols, known.sub_cells(), known.starts, options.kind,
        body.briefing.seed, body.robot,
    )  # fmt: skip
    cells = frozenset(cell for stretch in plan.parts.values() for cell in stretch)
    parts = Parts(plan.order)
    parts.hear(await body.look())
    robot = Robot(body, start, parts)
    await robot.walk(plan.walks[body.robot][1:])
    robot.finish(body.robot)
    while not parts.complete():
        mine = parts.left_to(body.robot)
        if mine:
            await robot.walk(walk_of(plan, cells, robot.position, mine[0]))
            robot.finish(mine[0])
        else:
            await robot.wait()
    if options.home:
        await robot.walk(shortest_way(cells, robot.position, {start}))
    return robot.last_words()
