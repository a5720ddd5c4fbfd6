"""The course of a team: what NCOCTA and COCTA have it do, tick by tick, as long as nobody is lost.

A `Step` is one tick: where all robots are, where each goes, and a digest of all steps so far by which
robots can tell whether they agree. Each robot follows the steps with a copy of its own; robots that
run in one process share what is the same for all of them, since a step depends on nothing but the tree
and on what was agreed. Steps that nobody holds any more are forgotten.

A team that has lost robots goes on from wherever it is, with split heights that it is large enough for
and without a load (`Step.regrouped`). The rule keeps any connected team connected, but the robots may
then stand where the rule has no move for them. Then they gather: all go up to the highest of them, and
from there on the team moves without splits, which always comes to an end.
"""

from collections.abc import Iterable, Mapping
from weakref import WeakValueDictionary
from zlib import crc32

from agents.algorithms.connected_rule import Moves, Team, Variant, next_moves
from agents.algorithms.connected_splits import paper_splits, robots_needed
from agents.planning.rooted_tree import RootedTree
from protocol.codec import encode

DIGEST_BYTES = 4


def _digest(places: Mapping[int, int], before: bytes) -> bytes:
    return crc32(encode(sorted(places.items())), crc32(before)).to_bytes(DIGEST_BYTES, "little")


class Step:
    """One tick of a team, as all its robots know it.

    Attributes:
        tick: how many there were before.
        at: the vertex of each robot that is left.
        robots_at: the robots at each vertex that has any, ascending.
        moves: where robots go in this tick; none if `over`.
        over: whether all is covered and all are back at the root.
        digest: of all that happened so far, and of the moves; `DIGEST_BYTES` long.
        speaker: the robot that says the digest to the others.
        heard: what these then find in their inbox.
    """

    __slots__ = (
        "__weakref__", "_course", "_fresh", "_keepers", "_next", "_regrouped",
        "at", "digest", "heard", "moves", "over", "robots_at", "speaker", "tick",
    )  # fmt: skip

    def __init__(self, course: "_Course", tick: int, digest: bytes, fresh: Iterable[int]) -> None:
        team = course.team
        self._course = course
        self._fresh = tuple(fresh)  # what was visited first on the way to this step
        self._next: Step | None = None
        self._regrouped: dict[tuple[object, ...], Step] = {}
        self._keepers: dict[int, frozenset[int]] | None = None
        self.tick = tick
        self.at = dict(team.at)
        self.robots_at = {vertex: tuple(robots) for vertex, robots in team.robots_at.items()}
        self.over = team.over
        self.moves: Moves = {} if team.over else course.moves()
        self.digest = _digest(self.moves, digest)
        robots = tuple(team.at)
        self.speaker = robots[self.tick % len(robots)]
        self.heard = ((self.speaker, self.digest),)

    @property
    def keepers(self) -> dict[int, frozenset[int]]:
        """On the event clock: who is the last to leave a place, and who comes there.

        It waits for one of them. Where nobody comes, nobody needs the place any more.
        """
        if self._keepers is None:
            coming: dict[int, set[int]] = {}
            for robot, to in self.moves.items():
                coming.setdefault(to, set()).add(robot)
            self._keepers = {
                self.robots_at[vertex][0]: frozenset(robots)
                for vertex, robots in coming.items()
                if vertex in self.robots_at and self.moves.keys() >= {*self.robots_at[vertex]}
            }
        return self._keepers

    def next(self) -> "Step":
        """Return what follows if all move as they should."""
        if self._next is None:
            team, moves = self._course.team, self.moves
            fresh = {to for to in moves.values() if not team.visited[to]}
            team.apply(moves)
            self._next = Step(self._course, self.tick + 1, self.digest, fresh)
        return self._next

    def regrouped(self, tick: int, at: Mapping[int, int], seen: Iterable[int] = ()) -> "Step":
        """Return how robots that are left go on, after a step that all of them know.

        Args:
            tick: which is the first one.
            at: the vertex of each; adjacent from one to the next.
            seen: what they have visited since this step.
        """
        fresh = frozenset(seen)
        key = (tick, frozenset(at.items()), fresh)
        if key not in self._regrouped:
            course = self._course
            visited = self.visited() | fresh
            self._regrouped[key] = Step(
                course.after_losses(at, visited), tick, _digest(at, self.digest), ()
            )
        return self._regrouped[key]

    def visited(self) -> set[int]:
        """Return the vertices that are visited when the step begins."""
        visited = {vertex for vertex, bit in enumerate(self._course.team.visited) if bit}
        later = self._next
        while later is not None:
            visited.difference_update(later._fresh)  # noqa: SLF001  of this class
            later = later._next  # noqa: SLF001  of this class
        return visited


class _Course:
    """A team that is always at the last of its steps that anybody asked for.

    Attributes:
        team: where it is.
    """

    def __init__(
        self, team: Team, variant: Variant, splits: tuple[int, ...], *, gathering: bool = False
    ) -> None:
        self.team = team
        self._variant = variant
        self._splits = splits  # those that the whole team was to use
        self._gathering = gathering

    def moves(self) -> Moves:
        """Return where the robots go."""
        moves = {} if self._gathering else next_moves(self.team)
        if moves:
            return moves
        team = self.team
        self._gathering = len(team.robots_at) > 1
        if self._gathering:
            return gathering_moves(team)
        self.team = Team(
            team.tree, team.team_size, self._variant, at=team.at, visited=_marked(team.visited)
        )
        return next_moves(self.team)

    def after_losses(self, at: Mapping[int, int], visited: Iterable[int]) -> "_Course":
        """Return how those that are left go on."""
        tree, left = self.team.tree, len(at)
        splits = self._splits
        if robots_needed(tree.arity, splits) > left:
            splits = paper_splits(tree.arity, tree.height, left)
        team = Team(tree, left, self._variant, splits, at=at, visited=visited)
        return _Course(team, self._variant, self._splits)


def gathering_moves(team: Team) -> Moves:
    """Return the moves of a team of which all go up to the highest robot; it stays connected."""
    heights, parents = team.tree.heights, team.tree.parents
    top = max(team.robots_at, key=heights.__getitem__)
    return {robot: parents[vertex] for robot, vertex in team.at.items() if vertex != top}


def _marked(bits: bytes | bytearray) -> list[int]:
    return [number for number, bit in enumerate(bits) if bit]


_first_steps: WeakValueDictionary[tuple[object, ...], Step] = WeakValueDictionary()


def first_step(
    tree: RootedTree,
    team_size: int,
    variant: Variant,
    splits: tuple[int, ...],
    load: int | None = None,
) -> Step:
    """Return the first step of a team whose robots are all at the root.

    Raises:
        ValueError: As `Team` does.
    """
    key = (id(tree), team_size, variant, splits, load)
    step = _first_steps.get(key)
    if step is None or step._course.team.tree is not tree:  # noqa: SLF001  of this module
        team = Team(tree, team_size, variant, splits, load=load)
        step = _first_steps[key] = Step(_Course(team, variant, splits), 0, b"", ())
    return step
