"""A body that keeps the notes of all robots, and passes on what others lack.

What for, and why that is enough: `agents.algorithms.ormstc_gossip`.
"""

from functools import lru_cache
from math import inf
from types import coroutine
from typing import Any

from msgspec import Struct
from msgspec.structs import replace

from agents.algorithms.claims import Claim, Note, Retract, Start
from agents.body import Ask, Body
from protocol.codec import decoder_of, encode
from protocol.messages import Briefing, GridSight, Stop

NOTES = 32
"""A packet holds at most so many notes."""

NOTES_EACH = 8
"""Of these at most so many of one robot to one robot that lacks them."""

HOPS = 8
"""A robot that is heard over so many relays is waited for, unless ``patience`` says otherwise."""

CELLS = 64
"""A note tells of at most so many cells."""

ROWS = 16
"""A packet holds the rows of at most so many other robots."""


class Beside(Note, frozen=True, tag="beside"):
    """These cells are free; they lie beside the sender's own, and are not its own."""

    cells: tuple[int, ...]


class Covered(Note, frozen=True, tag="covered"):
    """Every cell that the sender has claimed so far, and not given up, is covered (Alg. 3 l. 24).

    All free cells beside these are its own, too, or it has told of them.
    """


class Row(Struct, frozen=True, array_like=True, forbid_unknown_fields=True, gc=False):
    """What one robot had heard at a time.

    Attributes:
        robot: which robot.
        time: when that was.
        counts: how many notes of each robot it had.
        rests: whether it had nothing to do.
        done: whether it knew that everything is covered that can be reached from its start.
    """

    robot: int
    time: float
    counts: tuple[int, ...]
    rests: bool = False
    done: bool = False


class Packet(
    Struct, frozen=True, array_like=True, forbid_unknown_fields=True, tag="packet", gc=False
):
    """What goes on the air.

    Attributes:
        rows: the sender's row, and the newest that it has of others.
        notes: origin, number, and the note itself.
        lost: robots known to be dead, where not everybody hears of a loss.
        done: robots from whose starts nothing that is not covered can be reached.
    """

    rows: tuple[Row, ...]
    notes: tuple[tuple[int, int, bytes], ...] = ()
    lost: tuple[int, ...] = ()
    done: tuple[int, ...] = ()


GossipNote = Start | Claim | Retract | Beside | Covered

_decode_note: Any = decoder_of(GossipNote)  # type: ignore[arg-type]
_decode_packet: Any = decoder_of(Packet)


@lru_cache(maxsize=4096)
def read_note(data: bytes) -> GossipNote:
    """Decode a note.

    Raises:
        MessageError: If it is none.
    """
    note: GossipNote = _decode_note(data)
    return note


@lru_cache(maxsize=1024)
def read_packet(data: bytes) -> Packet:
    """Decode a message.

    Raises:
        MessageError: If it is none.
    """
    packet: Packet = _decode_packet(data)
    return packet


class Gossip(Body):
    """A body whose radio repeats what others lack, and forwards it.

    The messages that it is given are notes; what it hears are notes too, those of each robot in the
    order in which they were said, whoever they came from.

    Attributes:
        logs: the notes of each robot, as far as they are known without a gap.
        rows: the newest row of each robot.
        lost: robots known to be dead.
        done: robots from whose starts nothing that is not covered can be reached, as far as is known.
        rests: whether it has nothing to do.
        now: when it saw something last.
        news_at: when it last heard that some robot had heard something new.
        patience: how old the row of a robot may be that this one waits for before it enters a cell.
        lately: how old the row of a robot may be that is sent what it lacks.
        quiet: how old the row of a robot is that is taken for lost.
        linger: how old the row of a robot may be that one that is done stays for.
        speaks: whether anybody can hear it.
    """

    __slots__ = (
        "_early",
        "_owes",
        "_replied",
        "_sent",
        "_spoke",
        "_tells_losses",
        "_turn",
        "done",
        "lately",
        "linger",
        "logs",
        "lost",
        "news_at",
        "now",
        "patience",
        "quiet",
        "rests",
        "rows",
        "speaks",
    )

    def __init__(self, briefing: Briefing, patience: float | None) -> None:
        super().__init__(briefing)
        radio, robots = briefing.radio, range(self.team_size)
        nothing = (0,) * self.team_size
        self.logs: list[list[bytes]] = [[] for _ in robots]
        self.rows = [Row(robot, 0.0, nothing) for robot in robots]
        self.lost: set[int] = set()
        self.done: set[int] = set()
        self.rests = False
        self.now = 0.0
        self.news_at = 0.0
        relayed = min(self.team_size - 1, HOPS) * (1 + radio.latency)
        self.linger = max(16.0, 4 * relayed)
        if radio.reach == "global":
            self.lately, self.quiet = inf, max(256.0, self.linger)
        else:
            self.lately, self.quiet = max(4.0, relayed), self.linger
        self.patience = self.lately if patience is None else patience
        self.lately = max(self.lately, self.patience)
        self.speaks = radio.reach != "none" and self.team_size > 1
        self._tells_losses = briefing.heartbeat == "reach"
        self._early: list[dict[int, bytes]] = [{} for _ in robots]
        self._sent = 0  # so many of its own notes
        self._spoke = -inf
        self._owes = False  # a reply to new notes
        self._replied = -inf
        self._turn = 0

    # Requests.

    @coroutine
    def look(self, *, gaze: int | None = None, messages: tuple[bytes, ...] = ()) -> Ask:
        """See this place (free)."""
        said = self._said(messages)
        return self._heard((yield from super().look(gaze=gaze, messages=said)))

    @coroutine
    def exchange(self, *messages: bytes) -> Ask:
        """Send notes and see what has come by the next round (free)."""
        return self._heard((yield from super().exchange(*self._said(messages))))

    @coroutine
    def move(
        self,
        exit_: int,
        *,
        gaze: int | None = None,
        tag: bytes | None = None,
        messages: tuple[bytes, ...] = (),
    ) -> Ask:
        """Leave by port ``exit_`` and arrive (one move)."""
        said = self._said(messages, always=True)
        return self._heard((yield from super().move(exit_, gaze=gaze, tag=tag, messages=said)))

    @coroutine
    def wait(
        self, duration: float = 1.0, *, tag: bytes | None = None, messages: tuple[bytes, ...] = ()
    ) -> Ask:
        """Stay for ``duration`` time units (that many ticks in lockstep)."""
        said = self._said(messages, always=True)
        return self._heard((yield from super().wait(duration, tag=tag, messages=said)))

    @coroutine
    def wait_for_news(
        self,
        *,
        at_most: float | None = None,
        words: int = 1,
        tag: bytes | None = None,
        messages: tuple[bytes, ...] = (),
    ) -> Ask:
        """Stay until so many radio messages or a loss notice; or ``at_most`` so long."""
        said = self._said(messages)
        return self._heard(
            (yield from super().wait_for_news(at_most=at_most, words=words, tag=tag, messages=said))
        )

    def last_words(self, *, tag: bytes | None = None, messages: tuple[bytes, ...] = ()) -> Stop:
        """Return what the algorithm returns to stop (free)."""
        return super().last_words(tag=tag, messages=self._said(messages, always=True))

    def say(self, *notes: bytes) -> None:
        """Number notes; they go out with the next request."""
        self.logs[self.robot] += notes

    # What it knows of others.

    def is_silent(self, robot: int) -> bool:
        """Tell whether nothing was heard of a robot for long."""
        return self.now - self.rows[robot].time >= self.quiet

    def is_near(self, robot: int) -> bool:
        """Tell whether a robot was heard of lately."""
        age = self.now - self.rows[robot].time
        return self.speaks and age <= self.lately and age < self.quiet

    def waits_for(self, robot: int) -> bool:
        """Tell whether a robot was heard of so recently that an answer of it is worth a wait."""
        row = self.rows[robot]
        return self.is_near(robot) and self.now - row.time <= self.patience and not row.done

    def is_idle(self, robot: int) -> bool:
        """Tell whether no work of a robot can be the reason that nothing new was heard for long."""
        row = self.rows[robot]
        idle = (row.rests or row.done) and self.now - self.news_at >= self.quiet
        return idle or self.is_silent(robot)

    def lingers_for(self, robot: int) -> bool:
        """Tell whether a robot is not done and was heard of lately."""
        row = self.rows[robot]
        return self.speaks and not row.done and self.now - row.time < self.linger

    # Packets.

    def _heard(self, here: GridSight) -> GridSight:
        """Turn what came into notes that are new, and losses that are."""
        self.now = here.time
        if not here.inbox and not here.losses:
            return here
        news: list[tuple[int, bytes]] = []
        losses = list(here.losses)
        for _, data in here.inbox:
            packet = read_packet(data)
            for row in packet.rows:
                held = self.rows[row.robot]
                if row.time > held.time or (row.time == held.time and row.counts > held.counts):
                    self.rows[row.robot] = row
                    if row.counts != held.counts:
                        self.news_at = self.now
            for origin, number, note in packet.notes:
                self._file(origin, number, note, news)
            losses += packet.lost
            self.done.update(packet.done)
        losses = [robot for robot in dict.fromkeys(losses) if robot not in self.lost]
        self.lost.update(losses)
        self._owes = self._owes or bool(news)
        return replace(here, inbox=tuple(news), losses=tuple(losses))

    def _file(self, origin: int, number: int, note: bytes, news: list[tuple[int, bytes]]) -> None:
        """Put a note into the log of its origin, or aside until those before it have come."""
        log, early = self.logs[origin], self._early[origin]
        if number > len(log):
            early[number] = note
        elif number == len(log):
            following: bytes | None = note
            while following is not None:
                log.append(following)
                news.append((origin, following))
                following = early.pop(len(log), None)

    def _said(self, notes: tuple[bytes, ...], *, always: bool = False) -> tuple[bytes, ...]:
        """Return what to send now; at any instant only new notes, and one reply to those of others."""
        self.say(*notes)
        if not self.speaks:
            return ()
        replies = self._owes and self._replied < self.now
        is_due = always or self.now - self._spoke >= 1.0
        if not (is_due or replies or self._sent < len(self.logs[self.robot])):
            return ()
        if self._owes:
            self._replied = self.now
        self._owes = False
        self._spoke = self.now
        return (encode(self._packet()),)

    def _packet(self) -> Packet:
        me, rows = self.robot, self.rows
        rows[me] = Row(me, self.now, tuple(map(len, self.logs)), self.rests, me in self.done)
        others = [(me + 1 + turn) % self.team_size for turn in range(self.team_size - 1)]
        self._turn = (self._turn + 1) % len(others)
        others = others[self._turn :] + others[: self._turn]
        known = [rows[other] for other in others if rows[other].time or any(rows[other].counts)]
        lost = tuple(sorted(self.lost)) if self._tells_losses else ()
        return Packet(
            (rows[me], *known[:ROWS]), self._lacking(others), lost, tuple(sorted(self.done))
        )

    def _lacking(self, others: list[int]) -> tuple[tuple[int, int, bytes], ...]:
        """Return its new notes, and what the robots nearby lack as far as it knows."""
        me, logs = self.robot, self.logs
        own = logs[me]
        sent, self._sent = self._sent, min(len(own), self._sent + NOTES)
        chosen = dict.fromkeys((me, number) for number in range(sent, self._sent))
        counts = self.rows[me].counts
        for other in others:
            theirs = self.rows[other].counts
            if theirs == counts or other in self.lost or not self.is_near(other):
                continue
            for origin in (me, *others):
                first, last = theirs[origin], counts[origin]
                for number in range(first, min(last, first + NOTES_EACH)):
                    if len(chosen) < NOTES:
                        chosen[origin, number] = None
        return tuple((origin, number, logs[origin][number]) for origin, number in chosen)
