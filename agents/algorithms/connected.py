"""NCOCTA and COCTA as robots run them: a team that covers a known tree and never loses touch.

Sinay, Agmon, Maksimov, Kraus, Peleg 2017, "Maintaining Communication in Multi-Robot Tree Coverage". The
rule is `connected_rule`; here is what one robot does. Each keeps a copy of the team's state, a `Step`:
where all are, and what is explored. It is built from the map, from what the robot saw, and from what
reached it by radio; nobody tells it the truth.

As long as no loss is heard of, every robot knows what the others do, since all follow one rule and,
in lockstep, moves take one tick. Silence means that all went as agreed. In each tick one robot, each in
its turn, says a digest of its copy, and every other compares it with its own. Each robot also compares
how many stand beside it with what its copy says. Whoever finds a difference says who differs, and
fails.

Assumes: a radio that reaches adjacent places, and all that are connected by others (`relay`); at once,
without loss. A beacon of each robot that these hear, so that they notice when it falls silent
(``heartbeat = "reach"``); on the event clock one that is heard everywhere.

Losses, which the paper leaves out: `connected_regroup`.

On the event clock, where moves take different times, robots tell the others when they have arrived; a
tick is over when all have. Within it a robot leaves its place only when contact is assured: the last
one to leave a place that others still need, or come to, waits for the first of those who come.

A graph that is no tree: the robots use a spanning tree of it, as the option ``tree`` says.
"""

from collections.abc import Iterator
from functools import lru_cache, partial

from agents.algorithms.connected_course import Step, first_step
from agents.algorithms.connected_options import AnyOptions, BestOptions, Options, planned
from agents.algorithms.connected_regroup import is_digest, regroup_by_words, regroup_in_lockstep
from agents.algorithms.connected_rule import Variant
from agents.body import Body
from agents.planning.rooted_tree import Paths, reordered, spanning_tree
from protocol.codec import encode
from protocol.errors import AlgorithmError
from protocol.graph import PortGraph
from protocol.messages import KnownGraph, Sight, Stop


@lru_cache(maxsize=4)
def paths_of(known: KnownGraph, root: int, tree: str, order: tuple[int, ...] = ()) -> Paths:
    """Return the tree that a team covers; robots in one process share it.

    Raises:
        AlgorithmError: If the graph is no tree, and is to be one.
    """
    graph = PortGraph([""] * known.vertices, known.ends())
    if tree == "given" and not graph.is_tree():
        raise AlgorithmError(
            'the graph is no tree; expected `algorithm_options.tree = "breadth-first"`, or a tree'
        )
    paths = spanning_tree(graph, root, deep=tree == "depth-first")
    return paths._replace(tree=reordered(paths.tree, order))


@lru_cache(maxsize=4)
def planned_on(
    known: KnownGraph, root: int, team_size: int, options: AnyOptions, variant: Variant
) -> AnyOptions:
    """Return options with a plan that was not made before the run; robots in one process share it."""
    graph = PortGraph([""] * known.vertices, known.ends())
    return planned(graph, root, team_size, options, variant)


async def cover_in_lockstep(body: Body, paths: Paths, step: Step, here: Sight) -> None:
    """Cover the tree with the others until all are back at the root, in lockstep.

    Args:
        body: the robot.
        paths: the tree, and its ports.
        step: the first one.
        here: what the robot saw first.
    """
    robot = body.robot
    before = step
    while True:
        if here.losses:
            step, here = await regroup_in_lockstep(body, paths, before, step.at, here)
        if step.over:
            return
        messages = (step.digest,) if step.speaker == robot else ()
        to = step.moves.get(robot)
        if to is None:
            here = await body.wait(messages=messages)
        else:
            here = await body.move(paths.exit(here.place, to), messages=messages)
        before, step = step, step.next()
        if not here.losses:
            compare(robot, here, before, step)


def compare(robot: int, here: Sight, before: Step, step: Step) -> None:
    """Compare what a robot sees and heard with its copy of the team's state.

    Raises:
        AlgorithmError: If a robot differs.
    """
    place = step.at[robot]
    beside = step.robots_at[place]
    # How many stand here is enough: another robot in the place of one is missing where it should be.
    if here.place != place or len(here.here) + 1 != len(beside):
        raise AlgorithmError(
            f"robot {robot} is at {here.place} with {[*here.here]} at tick {step.tick}; by its copy of "
            f"the team's state it is at {place}, and there are {[*beside]}"
        )
    if here.inbox != before.heard and robot != before.speaker:
        said = (
            ", ".join(f"{word.hex()} of robot {sender}" for sender, word in here.inbox) or "nothing"
        )
        raise AlgorithmError(
            f"robot {robot} expected the digest {before.digest.hex()} of robot {before.speaker} at "
            f"tick {before.tick} and heard {said}: their copies of the team's state differ, or they "
            "have lost touch"
        )


class PhasedRobot:
    """A robot and its copy of the team's state, on the event clock.

    Attributes:
        step: the tick that the team is at.
        before: the last one that it moved in; the same at the beginning.
        here: what it saw last.
        lost: all whose losses it heard of.
    """

    def __init__(self, body: Body, paths: Paths, step: Step, here: Sight) -> None:
        self._body = body
        self._paths = paths
        self._unsaid: tuple[bytes, ...] = ()
        self.before = self.step = step
        self.here = here
        self.lost: set[int] = set()

    async def cover(self) -> Stop:
        """Cover the tree with the others until all are back at the root; return the last words."""
        while not self.step.over:
            if not self._hears_of_loss():
                await self._phase()
                continue
            self.before, self.step, self.here, decision = await regroup_by_words(
                self._body, self._paths, (self.before, self.step), self.lost, self.here
            )
            self._unsaid = (encode(decision),)
        return self._body.last_words(messages=self._unsaid)

    def _hears_of_loss(self) -> bool:
        return not self.lost.issuperset(self.here.losses)

    async def _phase(self) -> None:
        """Do what the step says, and wait until all have done it or a loss is heard of."""
        step, robot = self.step, self._body.robot
        to = step.moves.get(robot)
        first = step.keepers.get(robot)
        arrived: set[int] = set()
        while not arrived.issuperset(step.moves):
            messages, self._unsaid = self._unsaid, ()
            if to is not None and robot not in arrived and first and first.isdisjoint(arrived):
                self.here = await self._body.wait_for_news(messages=messages)
            elif to is None or robot in arrived:
                words = len(step.moves.keys() - arrived)
                self.here = await self._body.wait_for_news(words=words, messages=messages)
            else:
                exit_ = self._paths.exit(step.at[robot], to)
                self.here = await self._body.move(exit_, messages=messages)
                if self._hears_of_loss():
                    return  # nobody can have gone on: all wait for this robot
                arrived.add(robot)
                self._unsaid = (step.digest,)
            # Words come before losses: whoever said them has not heard of the loss.
            arrived.update(self._arrivals())
            if self._hears_of_loss() and not arrived.issuperset(step.moves):
                return
        self.before, self.step = step, step.next()

    def _arrivals(self) -> Iterator[int]:
        """Yield the robots that have just said that they have arrived.

        Raises:
            AlgorithmError: If one of them is at another step.
        """
        for sender, word in self.here.inbox:
            if word == self.step.digest:
                yield sender
            elif is_digest(word):
                raise AlgorithmError(
                    f"robots {self._body.robot} and {sender} differ about the team at tick "
                    f"{self.step.tick}"
                )


async def ncocta(body: Body, options: Options) -> Stop:
    """Cover a tree, always connected, by Algorithm 1."""
    return await _cover(body, options, "ncocta")


async def cocta(body: Body, options: Options) -> Stop:
    """Cover a tree, always connected, by Algorithm 2."""
    return await _cover(body, options, "cocta")


async def cocta_best(body: Body, options: BestOptions) -> Stop:
    """Cover a tree, always connected, by the best plan found (`agents.planning.connected_best`)."""
    return await _cover(body, options, "cocta")


async def _cover(body: Body, options: AnyOptions, variant: Variant) -> Stop:
    known = body.briefing.graph
    if known is None:
        raise AlgorithmError("connected coverage needs a map; expected `sensing.map = true`")
    if len(set(known.starts)) > 1:
        raise AlgorithmError("connected coverage needs one start for all; expected `world.start`")
    root = known.starts[0]
    if options.heights is None:
        options = planned_on(known, root, body.team_size, options, variant)
    splits = options.heights
    assert splits is not None
    order: tuple[int, ...] = ()
    load = None
    if isinstance(options, BestOptions):
        order, load = options.order, options.load or None
    paths = paths_of(known, root, options.tree, order)
    # No name for the first step here: it would keep all of them in memory.
    first = partial(first_step, paths.tree, body.team_size, variant, splits, load)
    if body.briefing.lockstep:
        await cover_in_lockstep(body, paths, first(), await body.look())
        return body.last_words()
    return await PhasedRobot(body, paths, first(), await body.look()).cover()
