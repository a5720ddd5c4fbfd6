"""MR-DFS: exploration of an unknown graph by robots that meet only at bookkeeping devices.

Brass, Cabrera-Mora, Gasparri, Xiao 2011, "Multi-Robot Tree and Graph Exploration", Algorithms 1 and 2.

Assumes: a connected graph with opaque passages; all robots start at one vertex and recognise vertices
they have visited; a device at each vertex; no radio. Any robot may be lost at any time.

Claims (Sec. IV), without losses: every edge is traversed, each robot uses each edge at most once in
each direction (Lemma 1), so it makes at most 2e moves (Theorem 1); on trees, in lockstep, all finish
at the same step (Lemma 2), within (2e + 2 C(k + r, k - 1)) / k (Theorem 2), for k = 2 within e + r
(Theorem 3).

A device holds, for each port, whether it is *closed* (a robot came in by it: it is finished, or an
entry) or else how many robots have *departed* by it (Sec. III): `Tag`. At every arrival all robots
record before any of them chooses; a robot that is alone does both in one request.

Departures from the paper, in the default ``variant = "corrected"`` (``"paper"`` has none of them):

- A robot that is sent straight back (lines 2-3) *bounces*: that is no departure, and its open port
  stays as it is. Read literally, a self-loop never ends. Both variants.
- Lost robots can leave marks behind which nobody stands for, and on general graphs these can hide an
  edge for ever. So a device also holds an *epoch*, and marks of an older epoch read as blank. A robot
  that finds nothing to do at the start waits there for the living. When all are there and one was
  lost in this epoch, or there were tags of an earlier team, they begin the next epoch; else they stop.
- Where losses are not heard everywhere (``heartbeat = "reach"``) a robot cannot know who is alive. It
  waits as long as the run has taken so far and then takes the absent for lost. A late comer that finds
  marks of a newer epoch walks home by its entries, without a mark, and joins there.
"""

from functools import lru_cache
from math import ceil
from typing import Literal

from msgspec import Struct

from agents.body import Body
from protocol.messages import Sight

Ports = dict[int, int | None]
"""A port of each vertex that a robot remembers."""


class Options(Struct, frozen=True, forbid_unknown_fields=True):
    """Options of MR-DFS.

    Attributes:
        variant: ``"corrected"`` completes on every graph with any losses; ``"paper"`` as printed.
        version: ``"graph"`` for Algorithm 1, ``"tree"`` for Algorithm 2, which needs no epochs.
    """

    variant: Literal["corrected", "paper"] = "corrected"
    version: Literal["graph", "tree"] = "graph"


class Tag(Struct, frozen=True, gc=False):
    """What the device of one vertex holds.

    Attributes:
        marks: one for each port: how many robots departed by it, or `closed`.
        closed: the mark of a closed port, team_size + 1.
        entry: the port by which the first robot came, tree version only; ``None`` at the start.
        epoch: number of the epoch these marks belong to.
    """

    marks: tuple[int, ...]
    closed: int
    entry: int | None = None
    epoch: int = 0


def bits_per_port(team_size: int) -> int:
    """Return ceil(log2(k + 2)): a mark is one of 0..k departures, or closed."""
    return (team_size + 1).bit_length()


def pack(tag: Tag, team_size: int, *, tree: bool) -> bytes:
    """Encode a tag: degree, marks, in the tree version the entry, and the epoch unless it is 0.

    Returns:
        1 byte for the degree (5 from 255 on) and ``degree * ceil(log2(k + 2))`` bits, rounded up to
        bytes; the tree version adds ``ceil(log2(degree + 1))`` bits; an epoch adds 1 to 4 bytes.
    """
    degree = len(tag.marks)
    width = bits_per_port(team_size)
    bits = 0
    for mark in reversed(tag.marks):
        bits = bits << width | mark
    size = degree * width
    if tree:
        bits |= (0 if tag.entry is None else tag.entry + 1) << size
        size += degree.bit_length()
    head = bytes((degree,)) if degree < 255 else b"\xff" + degree.to_bytes(4, "little")
    epoch = tag.epoch.to_bytes((tag.epoch.bit_length() + 7) // 8, "little")
    return head + bits.to_bytes((size + 7) // 8, "little") + epoch


def tag_bytes(degree: int, team_size: int, *, tree: bool) -> int:
    """Return the size of a tag of epoch 0 at a vertex of ``degree``."""
    return len(pack(Tag((0,) * degree, team_size + 1), team_size, tree=tree))


def unpack(data: bytes, degree: int, team_size: int, *, tree: bool) -> Tag:
    """Decode a tag at a vertex of ``degree`` ports; a blank device has no marks.

    Raises:
        ValueError: If the bytes are no such tag.
    """
    closed = team_size + 1
    if not data:
        return Tag((0,) * degree, closed)
    width = bits_per_port(team_size)
    size = degree * width + (degree.bit_length() if tree else 0)
    head = 1 if degree < 255 else 5
    body = head + (size + 7) // 8
    written = data[0] if degree < 255 else int.from_bytes(data[1:5], "little")
    if len(data) < body or written != degree:
        raise ValueError(f"tag {data.hex()} does not belong to a vertex of degree {degree}")
    bits = int.from_bytes(data[head:body], "little")
    mask = (1 << width) - 1
    marks = tuple(bits >> port * width & mask for port in range(degree))
    if max(marks, default=0) > closed:
        raise ValueError(f"tag {data.hex()} holds more departures than the team has robots")
    first = (bits >> degree * width) - 1 if tree else -1
    if first >= degree:
        raise ValueError(f"tag {data.hex()} names an entry beyond the degree {degree}")
    entry = first if first >= 0 else None
    return Tag(marks, closed, entry, int.from_bytes(data[body:], "little"))


# The rules, as plain functions.


def record(tag: Tag, port: int | None) -> Tag:
    """Mark the port of an arrival closed (Alg. 1 l. 3, 7, 10): finished, or an entry.

    ``port`` is ``None`` for a robot that has not moved yet.
    """
    if port is None or tag.marks[port] == tag.closed:
        return tag
    marks = (*tag.marks[:port], tag.closed, *tag.marks[port + 1 :])
    return Tag(marks, tag.closed, tag.entry, tag.epoch)


def choose(tag: Tag) -> int | None:
    """Return the port to leave by (Alg. 1 l. 12-13), or ``None`` if none is eligible.

    Neither finished nor an entry, used by the fewest robots so far; ties to the lowest port.
    """
    fewest = min(tag.marks, default=tag.closed)
    return None if fewest == tag.closed else tag.marks.index(fewest)


def depart(tag: Tag, port: int) -> Tag:
    """Count one more robot that departed by ``port``."""
    marks = (*tag.marks[:port], tag.marks[port] + 1, *tag.marks[port + 1 :])
    return Tag(marks, tag.closed, tag.entry, tag.epoch)


# The same on the bytes of a device. Tags repeat all over a graph, so the results are kept.


@lru_cache(maxsize=1 << 16)
def recorded(
    data: bytes, degree: int, port: int | None, epoch: int, team_size: int, tree: bool
) -> tuple[int, bytes]:
    """Record an arrival by ``port`` on a device that holds ``data``.

    Returns:
        The epoch that the device is in, and its bytes afterwards. Where that epoch is newer than
        ``epoch`` nothing is recorded.
    """
    tag = _in_epoch(unpack(data, degree, team_size, tree=tree), epoch)
    if tag.epoch > epoch:
        return tag.epoch, data
    if tree and not data:
        tag = Tag(tag.marks, tag.closed, port, epoch)  # Alg. 2 l. 3-4
    return epoch, pack(record(tag, port), team_size, tree=tree)


@lru_cache(maxsize=1 << 16)
def chosen(
    data: bytes, degree: int, epoch: int, team_size: int, tree: bool
) -> tuple[int | None, bytes]:
    """Choose an exit by what the device holds.

    Returns:
        The exit and the device's bytes with that departure counted; ``None`` and the bytes as they
        are where no port is eligible.
    """
    tag = _in_epoch(unpack(data, degree, team_size, tree=tree), epoch)
    port = choose(tag)
    if port is None:
        return None, data
    return port, pack(depart(tag, port), team_size, tree=tree)


def _in_epoch(tag: Tag, epoch: int) -> Tag:
    """Read the marks of an older epoch as blank."""
    return Tag((0,) * len(tag.marks), tag.closed, None, epoch) if tag.epoch < epoch else tag


def entry_on(data: bytes, degree: int, team_size: int) -> int | None:
    """Return the entry that a device of the tree version holds."""
    return unpack(data, degree, team_size, tree=True).entry


# The robot.


class RollCall:
    """Who of the team is alive, as far as one robot at the start can tell.

    A robot that finds nothing to do at the start waits until everybody alive stands there. A bouncing
    robot stands there too, but is gone by the next round: so the roll must be full twice running.
    """

    def __init__(self, body: Body) -> None:
        self._body = body
        self._team = frozenset(range(body.team_size))
        self._hears_all = body.briefing.heartbeat == "global"
        self._lost: set[int] = set()
        self.fresh_loss = not body.briefing.blank_tags  # marks of robots that are not here

    def hear(self, here: Sight) -> None:
        """Take in who was lost; to hear the same again changes nothing."""
        self.fresh_loss |= not self._lost.issuperset(here.losses)
        self._lost.update(here.losses)

    async def call(self, here: Sight, epoch: int) -> Sight:
        """Wait at the start for the living; return early if a newer epoch has begun there."""
        body = self._body
        patience = max(1.0, here.time)
        deadline = here.time + patience
        full = 0
        while epoch_on(here, epoch, body.team_size) == epoch:
            if not self._hears_all and here.time >= deadline:
                absent = self._team - self._lost - {body.robot, *here.here}
                self._lost |= absent
                self.fresh_loss |= bool(absent)
            self._lost.difference_update(here.here)  # a late comer was not lost after all
            missing = self._team - self._lost - {body.robot, *here.here}
            full = 0 if missing else full + 1
            if full == 2:
                break
            if full:
                here = await body.look()
            elif self._hears_all:
                here = await body.wait_for_news()
            else:
                # Whole ticks, also when a loss was heard at a fraction of one.
                here = await body.wait_for_news(at_most=float(ceil(deadline - here.time)))
            if here.losses:
                self.hear(here)
        return here


def epoch_on(here: Sight, epoch: int, team_size: int) -> int:
    """Return the epoch of the device here, or ``epoch`` if that is newer."""
    return recorded(here.tag, here.degree, None, epoch, team_size, False)[0]


async def go_home(body: Body, entry: Ports, here: Sight, roll: RollCall) -> Sight:
    """Walk back along the entries without a mark; from an unknown vertex by where it came from."""
    while (exit_ := entry.get(here.place, here.entry)) is not None:
        here = await body.move(exit_)
        if here.losses:
            roll.hear(here)
    return here


async def explore(
    body: Body, here: Sight, epoch: int, version: str, roll: RollCall
) -> tuple[Sight, int]:
    """Play one epoch, from the start until there is nothing to do at the start.

    Returns:
        What is seen there, and the newest epoch that was met; where that is newer than ``epoch``
        the others have begun anew without this robot.
    """
    k, tree, start = body.team_size, version == "tree", here.place
    port: int | None = None  # by which it arrived
    entry: Ports = {start: None}
    open_: Ports = {start: None}
    while True:
        place = here.place
        found, tag = recorded(here.tag, here.degree, port, epoch, k, tree)
        if found > epoch:
            return await go_home(body, entry, here, roll), found
        first = place not in entry
        if first:
            entry[place] = port  # Alg. 1 l. 7
        if not here.alone:
            here = await body.write(tag)  # all record before any chooses
            if here.losses:
                roll.hear(here)
            if not tree and epoch_on(here, epoch, k) > epoch:
                continue
            tag = here.tag
        if not first and open_[place] != port:
            exit_ = port  # Alg. 1 l. 3
        else:
            exit_, tag = chosen(tag, here.degree, epoch, k, tree)  # l. 12-13
            if exit_ is None:
                exit_ = entry_on(tag, here.degree, k) if tree else entry[place]  # l. 15
            open_[place] = exit_
        if exit_ is None:
            if here.alone:
                here = await body.write(tag)  # which wakes those who wait here
                if here.losses:
                    roll.hear(here)
            return here, epoch
        here = await body.move(exit_, tag=tag)
        if here.losses:
            roll.hear(here)
        port = here.entry


async def mr_dfs(body: Body, options: Options) -> None:
    """Explore, and return to the start."""
    here = await body.look()
    epoch = recorded(here.tag, here.degree, None, 0, body.team_size, options.version == "tree")[0]
    roll = RollCall(body)
    roll.hear(here)
    while True:
        here, newest = await explore(body, here, epoch, options.version, roll)
        if options.version == "tree" or options.variant == "paper":
            return
        if newest == epoch:
            here = await roll.call(here, epoch)
        newest = epoch_on(here, newest, body.team_size)
        if newest == epoch:
            if not roll.fresh_loss:
                return
            newest += 1
        epoch, roll.fresh_loss = newest, False
