"""Every message of Canopy: msgspec Structs, tagged, msgpack on the wire.

A robot's life: `Join` -> `Briefing`; then `Request` -> `Sight` (or `Refusal`), one at a time, each
numbered; at last `Stop`, answered by `Stopped`. One request is one message, one line of the trace and
one possible moment of death.

A place is a number: vertices are recognised when they are visited again (Brass et al. 2011, Sec. II,
third model), and nothing but equality of these numbers means anything to a robot. On a grid a robot
has a position besides, and looks in a direction (`protocol.grid`); that direction is kept until a
request names another one.
"""

from collections.abc import Iterable
from itertools import chain
from struct import iter_unpack, pack
from typing import Annotated, Literal, Self
from zlib import compress, decompress

from msgspec import Meta, Struct

from protocol.section import OptionValue

SCHEMA_VERSION = 5
"""Version of all messages below; checked when a process joins."""

PAYLOAD_BYTES_MAX = 1 << 20
"""Larger messages are refused at the door."""


class Message(Struct, frozen=True, array_like=True, forbid_unknown_fields=True, gc=False):
    """Root of all messages; a message is never changed once built."""


# Requests: what a robot asks of the world.


class Request(Message, frozen=True):
    """What a robot asks for next.

    Attributes:
        tag: bytes to write to the device of this place before anything else, or ``None``.
        messages: radio messages to send from here, each heard by every robot in reach.
    """

    tag: bytes | None = None
    messages: tuple[bytes, ...] = ()


class Look(Request, frozen=True, tag="look"):
    """See the place again (free). The first request of every robot.

    ``gaze`` is the direction to look in, on a grid.
    """

    gaze: int | None = None


class Write(Request, frozen=True, tag="write"):
    """Write the tag of this place (free); ends the turn in this round."""


class Exchange(Request, frozen=True, tag="exchange"):
    """Send messages and see what has come (free); ends the turn in this round."""


class Move(Request, frozen=True, tag="move"):
    """Leave by a port (one move).

    Attributes:
        exit: that port; on a grid the direction.
        gaze: on a grid the direction to look in on arrival.
    """

    exit: int = 0
    gaze: int | None = None


class Wait(Request, frozen=True, tag="wait"):
    """Stay for ``duration`` (time units; in lockstep whole ticks)."""

    duration: float = 1.0


class WaitForNews(Request, frozen=True, tag="wait_for_news"):
    """Stay until something is new.

    Attributes:
        at_most: how long to wait for it, if not for ever.
        words: how many messages must have come; a loss notice or a change of the tag here is enough.
    """

    at_most: float | None = None
    words: Annotated[int, Meta(ge=1)] = 1


class Stop(Request, frozen=True, tag="stop"):
    """The algorithm has returned."""


AnyRequest = Look | Write | Exchange | Move | Wait | WaitForNews | Stop

# Replies: what the world answers.


class Sight(Message, frozen=True, tag="sight"):
    """What a robot perceives when its turn comes.

    Attributes:
        time: virtual time.
        place: number of the place where it stands.
        entry: port by which it came here last; ``None`` at its start.
        degree: number of ports of the place.
        tag: bytes on the device here; empty where it is blank or there is none.
        revision: how often the tag here was written.
        alone: whether no other robot takes a turn here in this instant (first round only).
        here: the other robots that stand here, in turn, waiting or stopped; the lost do not count.
        inbox: radio messages since the last sight: sender and bytes, in order of arrival.
        losses: robots of whose loss notice came since the last sight.
    """

    time: float
    place: int
    entry: int | None
    degree: int
    tag: bytes
    revision: int
    alone: bool
    here: tuple[int, ...] = ()
    inbox: tuple[tuple[int, bytes], ...] = ()
    losses: tuple[int, ...] = ()


class GridSight(Sight, frozen=True, tag="grid_sight"):
    """What a robot perceives on a grid, where each place has four ports: north, east, south, west.

    A robot that came back by the port that it left by has bumped against something.

    Attributes:
        position: row and column where it is, as far as it can tell.
        seen: what it senses, a byte a cell: ``.`` free, ``#`` blocked, ``?`` not sensed; which cells
            these are is for the scenario to say (`protocol.scenario.SensingSection`).
    """

    position: tuple[int, int] = (0, 0)
    seen: bytes = b""


class TeamSight(GridSight, frozen=True, tag="team_sight"):
    """What a robot perceives on a grid where robots see each other.

    Attributes:
        robots: the others in sight, ascending: id, and row and column. One under way is where it left
            from; the lost do not count.
    """

    robots: tuple[tuple[int, tuple[int, int]], ...] = ()


class Stopped(Message, frozen=True, tag="stopped"):
    """The stop is committed; the process may exit."""


class Again(Message, frozen=True, tag="again"):
    """A world that was away, or cut off, asks for the open request once more."""


class Refusal(Message, frozen=True, tag="refusal"):
    """The request did not happen; the robot that made it is out of the run.

    Attributes:
        error: name of a class of `protocol.errors`.
        detail: one line: what was found, what was expected.
    """

    error: str
    detail: str


AnySight = Sight | GridSight | TeamSight
AnyReply = Sight | GridSight | TeamSight | Stopped | Refusal
"""What a request may be answered by."""

# A robot and the world.


class Join(Message, frozen=True, tag="join"):
    """A process asks to be robot ``robot``.

    Attributes:
        schema: its SCHEMA_VERSION.
        robot: the identity it asks for.
        process: random text that tells this process from any other, so that it may ask again.
    """

    schema: int
    robot: int
    process: str


class RadioFacts(Message, frozen=True):
    """What a robot knows of its radio.

    Attributes:
        reach: who hears a message, as in the scenario.
        latency: how long a message takes, time units.
        lossy: whether messages may be lost.
    """

    reach: str = "none"
    latency: float = 0.0
    lossy: bool = False


class SensingFacts(Message, frozen=True):
    """What a robot knows of its senses.

    Attributes:
        mode: what is sensed, as in the scenario; ``"none"`` for a child.
        window: side of the square of sub-cells around the robot that ``seen`` shows, where it does.
        range_cells: how far it sees, sub-cells, where that is limited.
        bodies_block: whether other bodies are obstacles.
        robots_cells: how far it sees other robots, sub-cells; 0 if not at all.
    """

    mode: str = "ports"
    window: int = 0
    range_cells: float = 0.0
    bodies_block: bool = False
    robots_cells: float = 0.0


class KnownMap(Message, frozen=True):
    """A grid that the robots have a map of, and where they all start.

    Attributes:
        rows, cols: sub-cells from top to bottom, and from left to right.
        packed: the sub-cells as `protocol.grid.Grid` takes them, compressed.
        starts: row and column of each robot's start.
    """

    rows: int
    cols: int
    packed: bytes
    starts: tuple[tuple[int, int], ...]

    def sub_cells(self) -> bytes:
        """Return the sub-cells, row by row; not 0 where one is blocked."""
        return decompress(self.packed)


class KnownGraph(Message, frozen=True):
    """A graph that the robots have a map of, and where they all start.

    Attributes:
        vertices: how many; their numbers are the places.
        packed: the two ends of each edge, in the order that numbers the ports, compressed.
        starts: the vertex at which each robot starts.
    """

    vertices: int
    packed: bytes
    starts: tuple[int, ...]

    @classmethod
    def of(cls, vertices: int, ends: Iterable[tuple[int, int]], starts: tuple[int, ...]) -> Self:
        """Pack a graph."""
        flat = tuple(chain.from_iterable(ends))
        return cls(vertices, compress(pack(f"<{len(flat)}I", *flat)), starts)

    def ends(self) -> list[tuple[int, int]]:
        """Return the two ends of each edge."""
        return [(one, other) for one, other in iter_unpack("<II", decompress(self.packed))]


class Briefing(Message, frozen=True, tag="briefing"):
    """What a robot may know beforehand.

    Attributes:
        robot: its identity, 0 .. team_size - 1.
        team_size: number of robots (the papers' k).
        seed: the scenario's seed.
        algorithm: name of the algorithm, or ``module:function``.
        options: the scenario's algorithm options.
        capacity_bytes: size of a bookkeeping device; 0 where there are none.
        heartbeat: who hears of a loss.
        blank_tags: whether all devices are blank at the beginning.
        radio: what its radio can be relied on for.
        sensing: how it senses.
        position: row and column of its start, on a grid.
        devices_fail: whether tags may vanish or change by themselves.
        map: the grid, where the robots know it beforehand.
        graph: the graph, where the robots know it beforehand.
        lockstep: whether every move takes one time unit.
        parents: robots below this number are parents, the others children, which see nothing and do
            not know where they are; ``None``: all are alike.
        nonce: carried by its keys and its token from now on.
    """

    robot: int
    team_size: int
    seed: int
    algorithm: str
    options: dict[str, OptionValue]
    capacity_bytes: int
    heartbeat: Literal["global", "reach"]
    blank_tags: bool
    radio: RadioFacts = RadioFacts()
    sensing: SensingFacts = SensingFacts()
    position: tuple[int, int] | None = None
    devices_fail: bool = False
    map: KnownMap | None = None
    graph: KnownGraph | None = None
    lockstep: bool = True
    parents: int | None = None
    nonce: str = ""


class NumberedRequest(Message, frozen=True, tag="request"):
    """A request and its sequence number, 1, 2, 3, ..."""

    seq: int
    request: AnyRequest


class NumberedReply(Message, frozen=True, tag="reply"):
    """The reply to the request of that number; `Again` answers none, and bears the last one known."""

    seq: int
    reply: AnyReply | Again


# The world and the supervisor.


class Up(Message, frozen=True, tag="up"):
    """A world server has begun to live: whatever it should know is to be said (again).

    Attributes:
        incarnation: number of this life.
        phases: how long each part of its start took, real seconds.
    """

    incarnation: int
    phases: dict[str, float] = {}


class KillOrder(Message, frozen=True, tag="kill_order"):
    """The world stands still until robot ``robot`` is known dead; ``fault`` is its number."""

    fault: int
    robot: int


class Reaped(Message, frozen=True, tag="reaped"):
    """The supervisor's word: the process of robot ``robot`` is dead."""

    robot: int


class FaultOrder(Message, frozen=True, tag="fault_order"):
    """The world stands still until fault number ``fault`` was taken down; it is repeated till then."""

    fault: int


class Taken(Message, frozen=True, tag="taken"):
    """The supervisor's word: fault number ``fault`` strikes, now or as late as it is to be."""

    fault: int


class Struck(Message, frozen=True, tag="struck"):
    """The supervisor's word: fault number ``fault`` has struck at ``at_s`` (monotonic clock)."""

    fault: int
    at_s: float


class WentOn(Message, frozen=True, tag="went_on"):
    """The world's answer to `Struck`: when the first wave after it was committed (monotonic clock)."""

    fault: int
    at_s: float


class Progress(Message, frozen=True, tag="progress"):
    """How far the run is; for people only, nothing depends on it.

    Attributes:
        time: virtual time.
        steps: moves made, all robots.
        covered: places visited.
        alive: robots that are neither lost nor stopped.
        lost: robots lost so far, with the time of each loss.
    """

    time: float
    steps: int
    covered: int
    alive: int
    lost: tuple[tuple[int, float], ...] = ()


class Ended(Message, frozen=True, tag="ended"):
    """The run has ended and everything is acknowledged; ``status`` as in the journal's end."""

    status: Literal["over", "stalled"]


AnyReport = Up | KillOrder | FaultOrder | WentOn | Progress | Ended
AnyWord = Reaped | Taken | Struck
"""What the supervisor tells the world."""

# The world and the bookkeeping store.


class Hello(Message, frozen=True, tag="hello"):
    """The world asks how far the store is, under its incarnation number."""

    schema: int
    incarnation: int


class HelloReply(Message, frozen=True, tag="hello_reply"):
    """The wave number of the last batch applied (0: none), as the hello of that incarnation asked."""

    wave: int
    incarnation: int


class TagWrite(Message, frozen=True, tag="tag_write"):
    """One write: the tag of ``place`` is now ``tag`` and was written ``revision`` times."""

    place: int
    revision: int
    tag: bytes


class Batch(Message, frozen=True, tag="batch"):
    """Writes of the waves up to ``wave``, in order; applied once, in one transaction.

    ``after`` is the wave up to which the store has acknowledged everything: one that is not there any
    more has lost its end.
    """

    incarnation: int
    wave: int
    writes: tuple[TagWrite, ...]
    after: int = 0


class BatchReply(Message, frozen=True, tag="batch_reply"):
    """The batch up to ``wave`` is durable, as far as the scenario's durability asks.

    ``incarnation`` is that of the batch: an answer may outlive the world that asked.
    """

    wave: int
    incarnation: int


class ReadTags(Message, frozen=True, tag="read_tags"):
    """Ask for the tags that an earlier run left at ``places``; ``number`` numbers the question."""

    number: int
    places: tuple[int, ...]
    incarnation: int


class ReadTagsReply(Message, frozen=True, tag="read_tags_reply"):
    """The tags at the places asked for; places without a tag are left out."""

    number: int
    tags: tuple[TagWrite, ...]
    incarnation: int


class StoreRefusal(Message, frozen=True, tag="store_refusal"):
    """The store refuses what the world of that incarnation asked, with the reason."""

    detail: str
    incarnation: int


AnyStoreRequest = Hello | Batch | ReadTags
AnyStoreReply = HelloReply | BatchReply | ReadTagsReply | StoreRefusal
