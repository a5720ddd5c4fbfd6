"""What a connected team does about a loss: find together, agree on who is left, go on.

The paper has no losses. Here a robot hears of one by the silence of a beacon, if it was connected to
the lost one. A loss may cut the team into parts that cannot reach each other, and further robots may
be lost meanwhile, out of everybody's hearing. The rules below need no more than that each robot knows
the last step that all of them shared.

In lockstep (`regroup_in_lockstep`)
    The *meeting vertex* is the highest one that the team was to hold when the loss became known, which
    all know. In each tick every robot says where it is, and so knows its part of the team. The part
    that holds the meeting vertex stays where it is; the robots of any other go up by one edge. So
    each part that is cut off meets the one above the break. The team is whole once a part has
    everybody whose loss nobody in it has heard of. Then all who are alive are in it, hear the same,
    and agree at the same instant.

    Who is missing may have been lost unheard. A part that has held the meeting vertex for longer than
    anyone could need to get there, without hearing of another loss, takes those who have not come
    for lost. That is certain: whoever lives, and is in no part that holds the vertex, goes up
    in every tick.

    Bound: after the last loss a team is connected again within D + 1 ticks, where the lowest robot
    stood D edges below the highest vertex that the team held when the losses began, or was to hold.
    A single loss that leaves one vertex empty is made up for in one tick.

On the event clock (`regroup_by_words`)
    Nobody can tell a lost robot from a slow one, so the beacon has to be heard everywhere. All go up to
    the meeting vertex and say, once there, what they know: who is lost, and their last two steps.
    Some may have begun one step more than others; so the vertices of two robots are the same or
    adjacent, which is contact enough. Who hears something new repeats what it knows, so that those who
    came last hear it too. A robot goes on once it has heard everybody who is left say that the same
    robots are lost, from the last step that they have in common, and says so; who hears that goes on in
    the same way, though a further robot be lost meanwhile, whose word it lacks.

    Bound: D + 1 moves, one after another, from when the moves that were under way have ended.
"""

from collections.abc import Callable, Iterable, Mapping

import msgspec
from msgspec import Struct

from agents.algorithms.connected_course import DIGEST_BYTES, Step
from agents.body import Body
from agents.planning.rooted_tree import Paths
from protocol.codec import encode
from protocol.errors import AlgorithmError
from protocol.messages import Sight


class Status(Struct, frozen=True, array_like=True):
    """What a robot says in lockstep, in each tick, while the team finds together.

    Attributes:
        at: the vertex where it is.
        lost: the robots of whose loss it knows, ascending.
        since: since when its part has held the meeting vertex; ``None``: it does not.
    """

    at: int
    lost: tuple[int, ...]
    since: float | None


class Word(Struct, frozen=True, array_like=True, tag="word"):
    """What a robot says on the event clock once it is at its meeting vertex.

    Attributes:
        at: that vertex.
        lost: the robots of whose loss it knows, ascending.
        steps: the digests of the last two steps that it knew.
    """

    at: int
    lost: tuple[int, ...]
    steps: tuple[bytes, bytes]


class Decision(Struct, frozen=True, array_like=True, tag="decision"):
    """What a robot says on the event clock as it goes on.

    Attributes:
        lost: the robots without which.
        step: digest of the step from which.
        part: where each robot is.
    """

    lost: tuple[int, ...]
    step: bytes
    part: dict[int, int]


_status = msgspec.msgpack.Decoder(Status).decode
_word: Callable[[bytes], Word | Decision] = msgspec.msgpack.Decoder(Word | Decision).decode


def is_digest(message: bytes) -> bool:
    """Tell the digest of a robot's copy of the team's state from all else, which is longer."""
    return len(message) == DIGEST_BYTES


def status_of(word: bytes, sender: int, robot: int) -> Status:
    """Read what a robot said while the team finds together, in lockstep.

    Raises:
        AlgorithmError: If it does not find together, as it has not heard of a loss.
    """
    if is_digest(word):
        raise AlgorithmError(
            f"robot {robot} has heard of a loss that robot {sender} has not heard of"
        )
    return _status(word)


def meeting_vertex(paths: Paths, at: Iterable[int]) -> int:
    """Return the highest of the vertices that a connected team holds."""
    return max(at, key=paths.tree.heights.__getitem__)


async def regroup_in_lockstep(
    body: Body, paths: Paths, step: Step, expected: Mapping[int, int], here: Sight
) -> tuple[Step, Sight]:
    """Find the others after a loss, in lockstep.

    Args:
        body: the robot.
        paths: the tree, and its ports.
        step: the last one that all robots shared.
        expected: where all were to be after it, the lost among them.
        here: what it saw when it heard of the loss.

    Returns:
        The step with which the team goes on, and what the robot saw last.
    """
    heights = paths.tree.heights
    meeting = meeting_vertex(paths, expected.values())
    farthest = heights[meeting] - min(map(heights.__getitem__, expected.values()))
    lost: set[int] = set()
    since: float | None = None
    while True:
        if here.losses:
            lost.update(here.losses)
            since = None
        said = Status(here.place, tuple(sorted(lost)), since)
        here = await body.exchange(encode(said))
        heard = {sender: status_of(word, sender, body.robot) for sender, word in here.inbox}
        heard[body.robot] = said
        lost.update(here.losses, *(status.lost for status in heard.values()))
        part = part_of(
            body.robot, paths, {r: status.at for r, status in heard.items() if r not in lost}
        )
        since = None
        if meeting in part.values():
            claims = [heard[robot].since for robot in part if not here.losses]
            since = min((claim for claim in claims if claim is not None), default=here.time)
        missing = expected.keys() - part.keys() - lost
        overdue = since is not None and here.time - since > farthest
        if overdue or not missing:
            seen = [expected[robot] for robot in part]
            return step.regrouped(round(here.time), part, seen), here
        if since is None:
            here = await body.move(paths.up[here.place])
        else:
            here = await body.wait()


def part_of(robot: int, paths: Paths, at: Mapping[int, int]) -> dict[int, int]:
    """Return where those robots are that are connected to one of them along the tree."""
    parents = paths.tree.parents
    places = set(at.values())
    root_of: dict[int, int] = {}
    for place in sorted(places, key=paths.tree.heights.__getitem__, reverse=True):
        parent = parents[place]
        root_of[place] = root_of[parent] if parent in places else place
    own = root_of[at[robot]]
    return {other: place for other, place in at.items() if root_of[place] == own}


async def regroup_by_words(
    body: Body, paths: Paths, steps: tuple[Step, Step], lost: set[int], here: Sight
) -> tuple[Step, Step, Sight, Decision]:
    """Find the others after a loss, on the event clock.

    Args:
        body: the robot.
        paths: the tree, and its ports.
        steps: the last two that it knew; others may have known but the first of them.
        lost: all whose losses were heard of in this run, to be kept up to date.
        here: what it saw when it heard of the loss.

    Returns:
        The step that all shared, the one with which the team goes on, what the robot saw last (it may
        tell of further losses), and what it has to say as it goes on.

    Raises:
        AlgorithmError: If the robots shared no step.
    """
    # Some may have gone on from the step before they heard of the loss.
    meeting = meeting_vertex(paths, (*steps[1].at.values(), *steps[1].moves.values()))
    known = {step.digest: step for step in steps}
    heard: dict[int, Word] = {}
    own: Word | None = None
    while True:
        # Words come before losses: another may go on by them before it hears of the next loss.
        before = dict(heard)
        decision: Decision | None = None
        for sender, message in here.inbox:
            word = None if is_digest(message) else _word(message)
            if isinstance(word, Word):
                heard[sender] = word
            elif word is not None and word.part.keys() < steps[1].at.keys():
                decision = word  # not one by which this robot has gone on already
        if decision is None and own is not None:
            decision = _decided(body, heard, own)
        if decision is None:
            lost.update(here.losses)
            if here.place != meeting:
                here = await body.move(paths.up[here.place])
                continue
            own = Word(here.place, tuple(sorted(lost)), (steps[0].digest, steps[1].digest))
            heard[body.robot] = own
            decision = _decided(body, heard, own)
        if decision is not None:
            lost.update(decision.lost)
            shared = known.get(decision.step)
            if shared is None:
                raise AlgorithmError(
                    f"robot {body.robot} does not know the step that others go on from"
                )
            return shared, shared.regrouped(shared.tick + 1, decision.part), here, decision
        here = await body.wait_for_news(messages=(encode(own),) if heard != before else ())


def _decided(body: Body, heard: Mapping[int, Word], own: Word) -> Decision | None:
    """Decide how to go on if all who are left were heard, and know of the same losses.

    Raises:
        AlgorithmError: If they share no step.
    """
    left = set(range(body.team_size)).difference(own.lost)
    if not all(robot in heard and heard[robot].lost == own.lost for robot in left):
        return None
    for step in reversed(own.steps):
        if all(step in heard[robot].steps for robot in left):
            return Decision(own.lost, step, {robot: heard[robot].at for robot in sorted(left)})
    raise AlgorithmError(
        f"robot {body.robot} shares no step of the team with all of {sorted(left)}"
    )
