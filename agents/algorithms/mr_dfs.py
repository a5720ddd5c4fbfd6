"""MR-DFS: exploration of an unknown graph by robots that meet only at bookkeeping devices.

Brass, Cabrera-Mora, Gasparri, Xiao 2011, "Multi-Robot Tree and Graph Exploration", Algorithms 1 and 2.

Assumes: a connected graph with opaque passages; all robots start at one vertex and recognise
vertices they have visited; a device at each vertex; no radio. Any robot may be lost at any time.

Claims (Sec. IV), without losses: every edge is traversed, each robot uses each edge at most once
in each direction (Lemma 1), so it makes at most 2e moves (Theorem 1); on trees, in lockstep, all
finish at the same step (Lemma 2), within (2e + 2 C(k + r, k - 1)) / k (Theorem 2), for k = 2
within e + r (Theorem 3).

A device holds, for each port, whether it is *closed* (a robot came in by it: it is finished, or an
entry) or else how many robots have *departed* by it (Sec. III): `Tag`. At every arrival all robots
record before any of them chooses; a robot that is alone does both in one request.

Departures from the paper, in the default ``variant = "corrected"`` (``"paper"`` has none of them):

- A robot that is sent straight back (lines 2-3) *bounces*: that is no departure, and its open port
  stays as it is. Read literally, a self-loop never ends. Both variants.
- Lost robots can leave marks behind which nobody stands for, and on general graphs these can hide
  an edge for ever. So a device also holds an *epoch*, and marks of an older epoch read as blank. A
  robot that finds nothing to do at the start waits there for the living. When all are there and
  one was lost in this epoch, or there were tags of an earlier team, they begin the next epoch; else
  they stop.
- Where losses are not heard everywhere (``heartbeat = "reach"``) a robot cannot know who is alive.
  It waits as long as the run has taken so far and then takes the absent for lost. A late comer that
  finds marks of a newer epoch walks home by its entries, without a mark, and joins there.
- Where devices may fail (``Briefing.devices_fail``): see below.

Failing devices. The paper warns of them (Sec. VI): marks that vanish can keep robots from coming to an
end, wrong marks can hide places. Where they may happen, each robot also remembers by which ports it
came to each vertex in this epoch, and takes these for closed whatever the device holds. What cannot
be a tag reads as blank, in both variants. Then, whatever becomes of tags, in both versions:

- It ends. Lemma 1 needs no marks but a robot's own: it chooses a port only if it never came in by it,
  and not again before it has come back by it; else it leaves by a port only to bounce, or at last by
  the entry that it remembers. So an epoch takes it at most 2e moves.
- As long as no mark is wrong (marks may vanish; a corrupted tag that its device notices reads as
  blank), every port that reads as closed is one by which some robot came in this epoch. So a vertex
  that a robot has left for the last time has all its edges traversed, and if all that took part in an
  epoch come to its end, their vertices make up the whole graph. On trees this holds even of those that
  were lost: a port of a child was closed by a robot that had seen all ports of the child closed.

Epochs need more, as the device at the start may forget their number, or wake nobody any more: a robot
that waits there would not learn that the others are back or have begun anew (with remembered marks
alone, runs stall), and an epoch that is begun late could share its number with marks of the lost. So
here an epoch's number is *how many losses are known* at its beginning, which all know alike, as losses
are heard everywhere. Whoever is at the start and knows of more begins anew at once, and who meets marks
of a newer epoch goes home. A robot stops when its epoch is over, nobody was lost since, and all the
living stand at the start. Those that were ever in this epoch are then alive, as they began it after the
last loss, and through with it: so all is traversed. There are at most as many epochs as losses and one.
At a start whose device was destroyed a robot looks up as often as its moves take.

Where losses are not heard everywhere, or tags of an earlier team lie about, no number is safe. Then
each robot relies on the marks of its own alone; those of others only tell it where to go last. So it
traverses all by itself, in one epoch and at most 2e moves.

Wrong marks that no checksum catches can still hide places. The printed variant has nothing of this, but
that it reads as blank what cannot be a tag. It may make more than 2e moves, go on as long as marks are
erased, and for ever around a device that was destroyed; in the tree version a lost or wrong entry may
have a robot stop away from the start.
"""

from collections.abc import Coroutine, Generator
from functools import lru_cache
from math import ceil
from types import coroutine
from typing import Any, Literal

from msgspec import Struct
from msgspec.structs import replace

from agents.body import Body
from protocol.messages import AnyRequest, Move, Sight

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


class Layout:
    """How the marks of one vertex lie in the bytes of its device.

    Attributes:
        degree: number of ports.
        team_size: number of robots (the paper's k).
        width: bits of a mark, ceil(log2(k + 2)): it is one of 0..k departures, or closed.
        closed: the mark of a closed port, all bits set.
        tree: whether the entry of the first robot is stored as well (Algorithm 2).
        head: the bytes that tell the degree, 1 of them (5 from 255 on).
        size: bytes of a tag in epoch 0: head, marks and entry.
    """

    __slots__ = ("closed", "degree", "head", "size", "team_size", "tree", "width")

    def __init__(self, degree: int, team_size: int, *, tree: bool) -> None:
        self.degree = degree
        self.team_size = team_size
        self.tree = tree
        self.width = (team_size + 1).bit_length()
        self.closed = (1 << self.width) - 1
        self.head = bytes((degree,)) if degree < 255 else b"\xff" + degree.to_bytes(4, "little")
        bits = degree * self.width + (degree.bit_length() if tree else 0)
        self.size = len(self.head) + (bits + 7) // 8


@lru_cache(maxsize=1024)
def layout_of(degree: int, team_size: int, tree: bool) -> Layout:  # noqa: FBT001  a cache key
    """Return the layout of a tag; the same object for the same values."""
    return Layout(degree, team_size, tree=tree)


class Tag(Struct, frozen=True, gc=False):
    """What the device of one vertex holds.

    Attributes:
        marks: the marks of all ports in one integer, port 0 in the lowest bits.
        entry: the port by which the first robot came, tree version only; ``None`` at the start.
        epoch: number of the epoch these marks belong to.
    """

    marks: int = 0
    entry: int | None = None
    epoch: int = 0


BLANK = Tag()


def pack(tag: Tag, layout: Layout) -> bytes:
    """Encode a tag: degree, marks, in the tree version the entry, and the epoch unless it is 0."""
    bits = tag.marks
    if tag.entry is not None:
        bits |= (tag.entry + 1) << layout.degree * layout.width
    body = bits.to_bytes(layout.size - len(layout.head), "little")
    if not tag.epoch:
        return layout.head + body
    return layout.head + body + tag.epoch.to_bytes((tag.epoch.bit_length() + 7) // 8, "little")


def unpack(data: bytes, layout: Layout) -> Tag:
    """Decode a tag; a blank device holds no marks.

    Raises:
        ValueError: If the bytes are no tag of this layout.
    """
    if not data:
        return BLANK
    head = len(layout.head)
    if len(data) < layout.size or data[:head] != layout.head:
        raise ValueError(f"tag {data.hex()} does not belong to a vertex of degree {layout.degree}")
    bits = int.from_bytes(data[head : layout.size], "little")
    width = layout.degree * layout.width
    first = bits >> width
    if first > (layout.degree if layout.tree else 0):
        raise ValueError(f"tag {data.hex()} holds more than a vertex of degree {layout.degree}")
    epoch = int.from_bytes(data[layout.size :], "little")
    return Tag(bits & ((1 << width) - 1), first - 1 if first else None, epoch)


# The rules, as plain functions. Marks are one integer, as on the device.


def record(marks: int, port: int, layout: Layout) -> int:
    """Mark the port of an arrival closed (Alg. 1 l. 3, 7, 10): finished, or an entry."""
    return marks | layout.closed << port * layout.width


def choose(marks: int, layout: Layout) -> int | None:
    """Return the port to leave by (Alg. 1 l. 12-13), or ``None`` if none is eligible.

    Neither finished nor an entry, used by the fewest robots so far; ties to the lowest port.

    Raises:
        ValueError: If a mark counts more departures than the team has robots.
    """
    width, closed = layout.width, layout.closed
    exit_, fewest = None, closed
    for port in range(layout.degree):
        mark = marks & closed
        if mark < fewest:
            exit_, fewest = port, mark
        marks >>= width
    if layout.team_size < fewest < closed:
        raise ValueError(f"a tag counts {fewest} departures by a team of {layout.team_size}")
    return exit_


def depart(marks: int, port: int, layout: Layout) -> int:
    """Count one more robot that departed by ``port``."""
    return marks + (1 << port * layout.width)


# The same on the bytes of a device. Tags repeat all over a graph, so the last results are kept.


@lru_cache(maxsize=4096)
def recorded(data: bytes, port: int | None, epoch: int, layout: Layout) -> tuple[int, bytes]:
    """Record an arrival by ``port`` on a device that holds ``data``.

    ``port`` is ``None`` for a robot that has not moved yet.

    Returns:
        The epoch that the device is in, and its bytes afterwards. Where that epoch is newer than
        ``epoch`` nothing is recorded.
    """
    tag = unpack(data, layout)
    if tag.epoch > epoch:
        return tag.epoch, data
    entry = tag.entry if data or not layout.tree else port  # Alg. 2 l. 3-4
    marks = tag.marks if tag.epoch == epoch else 0  # those of an older epoch read as blank
    if port is not None:
        marks = record(marks, port, layout)
    return epoch, pack(Tag(marks, entry, epoch), layout)


@lru_cache(maxsize=4096)
def chosen(data: bytes, epoch: int, layout: Layout) -> tuple[int | None, bytes]:
    """Choose an exit by what the device holds; it is in ``epoch``, or an older one.

    Returns:
        The exit and the device's bytes with that departure counted; ``None`` and the bytes as they
        are where no port is eligible.
    """
    tag = unpack(data, layout)
    marks = tag.marks if tag.epoch == epoch else 0
    port = choose(marks, layout)
    if port is None:
        return None, data
    return port, pack(Tag(depart(marks, port, layout), tag.entry, epoch), layout)


def epoch_on(here: Sight, epoch: int, team_size: int) -> int:
    """Return the epoch of the device here, or ``epoch`` if that is newer."""
    return max(epoch, unpack(here.tag, layout_of(here.degree, team_size, False)).epoch)


def tag_bytes(degree: int, team_size: int, *, tree: bool) -> int:
    """Return the size of a tag of epoch 0 at a vertex of ``degree``."""
    return layout_of(degree, team_size, tree).size


# The robot.


class RollCall:
    """Who of the team is alive, as far as one robot at the start can tell.

    A robot that finds nothing to do at the start waits until everybody alive stands there. A
    bouncing robot stands there too, but is gone by the next round: so the roll must be full twice
    running.
    """

    def __init__(self, body: Body) -> None:
        self._body = body
        self._team = frozenset(range(body.team_size))
        self._hears_all = body.briefing.heartbeat == "global"
        self._lost: set[int] = set()
        self.fresh_loss = not body.briefing.blank_tags  # marks of robots that are not here

    def hear(self, here: Sight) -> None:
        """Take in who was lost. Each sight is heard once: it counts for the epoch it falls in."""
        if here.losses:
            self._lost.update(here.losses)
            self.fresh_loss = True

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
            self.hear(here)
        return here


async def go_home(body: Body, entry: Ports, open_: Ports, here: Sight, roll: RollCall) -> Sight:
    """Walk back along the entries without a mark; from an unknown vertex by where it came from.

    Where devices may fail others begin anew without waiting for it, so that it may meet their marks at
    a vertex that it has left by its entry before: there it bounces first, to keep to Lemma 1.
    """
    place, port = here.place, here.entry
    off_path = entry.get(place) is not None and open_.get(place, port) != port
    if body.briefing.devices_fail and off_path and port is not None:
        here = await body.move(port)
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
        layout = layout_of(here.degree, k, tree)
        found, tag = recorded(here.tag, port, epoch, layout)
        if found > epoch:
            roll.fresh_loss = False  # what is lost from now on is lost in the newer epoch
            return await go_home(body, entry, open_, here, roll), found
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
            exit_, tag = chosen(tag, epoch, layout)  # l. 12-13
            if exit_ is None:
                exit_ = unpack(tag, layout).entry if tree else entry[place]  # l. 15
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
    if body.briefing.devices_fail:
        reading = Reading(body, options)
        await through(reading, explore_warily(body, options, reading))
        return
    here: Sight = await body.look()
    layout = layout_of(here.degree, body.team_size, options.version == "tree")
    epoch = unpack(here.tag, layout).epoch
    roll = RollCall(body)
    roll.hear(here)
    while True:
        here, newest = await explore(body, here, epoch, options.version, roll)
        if options.version == "tree" or options.variant == "paper":
            return
        if newest == epoch:
            here = await roll.call(here, epoch)
            newest = epoch_on(here, epoch, body.team_size)
            if newest == epoch:
                if not roll.fresh_loss:
                    return
                newest += 1
            roll.fresh_loss = False
        epoch = epoch_on(here, newest, body.team_size)


# The robot where devices may fail.


@lru_cache(maxsize=4096)
def legible(data: bytes, layout: Layout) -> Tag | None:
    """Decode what may be a wrong tag; ``None`` if the bytes cannot be a tag."""
    try:
        tag = unpack(data, layout)
    except ValueError:
        return None
    marks = tag.marks
    for _ in range(layout.degree):
        if layout.team_size < marks & layout.closed < layout.closed:
            return None
        marks >>= layout.width
    return tag


def reopen(marks: int, layout: Layout) -> int:
    """Turn closed ports into such as all others have departed by: eligible, but the last choice."""
    others = layout.team_size - 1
    for shift in range(0, layout.degree * layout.width, layout.width):
        excess = (marks >> shift & layout.closed) - others
        if excess > 0:
            marks -= excess << shift
    return marks


class Reading:
    """How a robot reads devices that may fail: what it takes for their tags.

    Attributes:
        trust: ``"device"``: it takes a tag for what it is if it can be one, as the printed variant
            does; ``"both"``: it believes the device and its own memory; ``"memory"``: it believes
            that it came by the ports that it came by, and nothing else.
        lost: the robots of whose loss it knows.
        pace: the longest time that a move took it.
    """

    def __init__(self, body: Body, options: Options) -> None:
        briefing = body.briefing
        self._team_size = body.team_size
        self._tree = options.version == "tree"
        self.trust: Literal["device", "both", "memory"] = "memory"
        if options.variant == "paper":
            self.trust = "device"
        elif self._tree or (briefing.heartbeat == "global" and briefing.blank_tags):
            self.trust = "both"
        self.lost: set[int] = set()
        self.pace = 0.0
        self._epoch = 0
        self._closed: dict[int, int] = {}  # by place: the ports that it came by in this epoch
        self._entry: dict[int, int | None] = {}
        self._stored = 0  # the epoch on the device here

    def begin(self, epoch: int, here: Sight) -> Sight:
        """Begin an epoch at the start; return what is seen there now."""
        self._epoch = epoch
        self._closed.clear()
        return self.read(here)

    def arrive(self, here: Sight, left_at: float) -> Sight:
        """Return what is seen at the end of a move, and remember the port that it came by."""
        self.pace = max(self.pace, here.time - left_at)
        layout = layout_of(here.degree, self._team_size, self._tree)
        if here.entry is not None:
            closed = self._closed.get(here.place, 0)
            self._closed[here.place] = record(closed, here.entry, layout)
        return self.read(here)

    def read(self, here: Sight) -> Sight:
        """Return what is seen, with the tag as this robot takes it."""
        self.lost.update(here.losses)
        layout = layout_of(here.degree, self._team_size, self._tree)
        tag = legible(here.tag, layout)
        if self.trust == "device":
            return here if tag is not None else replace(here, tag=b"")
        tag = tag or BLANK
        marks = tag.marks
        self._stored = tag.epoch
        if self.trust == "memory":
            marks = reopen(marks, layout)
        elif self._epoch < tag.epoch <= len(self.lost) and not self._tree:
            return here  # others have begun anew
        elif tag.epoch != self._epoch:
            marks = 0
        marks |= self._closed.get(here.place, 0)
        entry = self._entry.setdefault(here.place, here.entry) if self._tree else None
        return replace(here, tag=pack(Tag(marks, entry, self._epoch), layout))

    def put(self, request: AnyRequest, here: Sight) -> AnyRequest:
        """Return a request as it is made: a device keeps the newest epoch that it ever was in."""
        if self.trust != "memory" or request.tag is None or not self._stored:
            return request
        layout = layout_of(here.degree, self._team_size, self._tree)
        marks = unpack(request.tag, layout).marks
        return replace(request, tag=pack(Tag(marks, None, self._stored), layout))


@coroutine
def through(
    reading: Reading, doing: Coroutine[AnyRequest, Any, None]
) -> Generator[AnyRequest, Any, None]:
    """Do ``doing``, which sees all devices as ``reading`` has it."""
    here: Sight = yield doing.send(None)
    sight = reading.read(here)
    while True:
        try:
            request = doing.send(sight)
        except StopIteration:
            return
        left_at = here.time
        here = yield reading.put(request, here)
        moved = isinstance(request, Move)
        sight = reading.arrive(here, left_at) if moved else reading.read(here)


async def last_call(body: Body, here: Sight, team: frozenset[int], reading: Reading) -> Sight:
    """Wait at the start for the living of ``team``, or for a loss.

    One that passes through is there in the first two rounds of an instant: so the roll must be full
    three times running.
    """
    lost = len(reading.lost)
    full = 0
    while len(reading.lost) == lost:
        full = full + 1 if team <= reading.lost.union(here.here) else 0
        if full == 3:
            break
        if full:
            here = await body.look()
        elif here.revision:
            here = await body.wait_for_news()
        else:  # this device is no more: nobody can wake us
            here = await body.wait_for_news(at_most=reading.pace or 1.0)
    return here


async def explore_warily(body: Body, options: Options, reading: Reading) -> None:
    """Explore, and return to the start, where devices may fail.

    Only those that set out from this start are awaited there.
    """
    here: Sight = await body.look()
    roll = RollCall(body)  # of no use here: `reading` counts the losses
    if reading.trust == "device":
        layout = layout_of(here.degree, body.team_size, options.version == "tree")
        await explore(body, here, unpack(here.tag, layout).epoch, options.version, roll)
        return
    if reading.trust == "memory" or options.version == "tree":
        await explore(body, reading.begin(0, here), 0, options.version, roll)
        return
    team = frozenset(here.here)
    while True:
        epoch = len(reading.lost)
        here, _ = await explore(body, reading.begin(epoch, here), epoch, options.version, roll)
        if len(reading.lost) == epoch:
            here = await last_call(body, here, team, reading)
        if len(reading.lost) == epoch:
            return
