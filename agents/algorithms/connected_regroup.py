"""What a connected team does about a loss: find together, agree on who is left, go on.

The paper has no losses. Here a robot hears of one by the silence of a beacon, if it was connected to
the lost one. A loss may cut the team into parts that cannot reach each other, and further robots may
be lost meanwhile, out of everybody's hearing. The rules below need no more than that each robot knows
the last step that all of them shared.

In lockstep (`regroup`)
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
    After a single loss it is one tick, if one place was left.

On the event clock (`regroup_later`)
    Nobody can tell a lost robot from a slow one, so the beacon has to be heard everywhere. All go up to
    the meeting vertex and say, once there, what they know: who is lost, and which step they shared
    last. Some may have begun one step more than others; so the vertices of two robots are the same or
    adjacent, which is contact enough. A robot goes on once it has heard everybody who is left
    say that the same robots are lost; all go on from the last step that they have in common. Who hears
    something new repeats what it knows, so that those who came last hear it too. If that step is the
    end, robots say so as they stop, for one who lacks the word of a robot that was lost meanwhile.

    Bound: as many moves, one after another, as above.
"""

from collections.abc import Iterable, Mapping

import msgspec
from msgspec import Struct

from agents.algorithms.connected_course import DIGEST_BYTES, Step
from agents.body import Body
from agents.planning.rooted_tree import Paths
from protocol.codec import encode
from protocol.errors import AlgorithmError
from protocol.messages import Sight


class Status(Struct, frozen=True, array_like=True, tag="status"):
    """What a robot says while the team finds together.

    Attributes:
        at: the vertex where it is.
        lost: the robots of whose loss it knows, ascending.
        since: since when its part has held the meeting vertex; ``None``: it does not.
        step: on the event clock: the last one that it knew, as `Step.order`.
    """

    at: int
    lost: tuple[int, ...]
    since: float | None = None
    step: tuple[int, int] = (0, 0)


DONE = b"\1"
"""On the event clock, the last word of each robot: all is covered. That never becomes untrue."""

_decode = msgspec.msgpack.Decoder(Status).decode


def statuses(here: Sight) -> dict[int, Status]:
    """Return the last status of each robot that was heard, without digests said before the loss."""
    words = here.inbox
    return {sender: _decode(word) for sender, word in words if not is_digest(word) and word != DONE}


def is_digest(message: bytes) -> bool:
    """Tell the digest of a robot's copy of the team's state from a `Status`, which is longer."""
    return len(message) == DIGEST_BYTES


def meeting_vertex(paths: Paths, at: Iterable[int]) -> int:
    """Return the highest of the vertices that a connected team holds."""
    return max(at, key=paths.tree.heights.__getitem__)


async def regroup(
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
        heard = {**statuses(here), body.robot: said}
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


async def regroup_later(
    body: Body, paths: Paths, steps: tuple[Step, Step], lost: set[int], here: Sight
) -> tuple[Step, Step, Sight, bytes | None] | None:
    """Find the others after a loss, on the event clock.

    Args:
        body: the robot.
        paths: the tree, and its ports.
        steps: the last two that it knew; others may have known but the first of them.
        lost: all whose losses were heard of in this run, to be kept up to date.
        here: what it saw when it heard of the loss.

    Returns:
        The step that all shared, the one with which the team goes on, what the robot saw last (it may
        tell of further losses), and what is still to be said. ``None``: others have found that all is
        covered, and have stopped.

    Raises:
        AlgorithmError: If the robots shared no step.
    """
    # Some may have gone on from the step before they heard of the loss.
    meeting = meeting_vertex(paths, (*steps[1].at.values(), *steps[1].moves.values()))
    own: Status | None = None
    heard: dict[int, Status] = {}
    while True:
        if any(word == DONE for _, word in here.inbox):
            return None
        # Words come before losses: another may go on by them before it hears of the next loss.
        news = {robot: word for robot, word in statuses(here).items() if heard.get(robot) != word}
        heard.update(news)
        unsaid = bool(news)
        if own is None or not _all_say_the_same(body, heard, own):
            lost.update(here.losses)
            if here.place != meeting:
                here = await body.move(paths.up[here.place])
                continue
            said, own = own, Status(here.place, tuple(sorted(lost)), None, steps[1].order)
            heard[body.robot] = own
            unsaid = unsaid or own != said
            if not _all_say_the_same(body, heard, own):
                here = await body.wait_for_news(messages=(encode(own),) if unsaid else ())
                continue
        part = {robot: word.at for robot, word in heard.items() if robot not in own.lost}
        shared = min(heard[robot].step for robot in part)
        for step in steps:
            if step.order == shared:
                last = encode(own) if unsaid else None
                return step, step.regrouped(step.tick + 1, part), here, last
        raise AlgorithmError(
            f"robot {body.robot} knows steps {[step.order for step in steps]} of the team, and some "
            f"other one only {shared}"
        )


def _all_say_the_same(body: Body, heard: Mapping[int, Status], own: Status) -> bool:
    """Tell whether all who are left were heard, and know of the same losses."""
    left = set(range(body.team_size)).difference(own.lost)
    return all(robot in heard and heard[robot].lost == own.lost for robot in left)
