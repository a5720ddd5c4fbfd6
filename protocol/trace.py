"""The trace: the canonical list of what happened, and its SHA-256.

An event is one request that was applied, or one loss, in the order (time, round, wave, robot). Two
runs of one scenario are the same run if and only if their traces are the same bytes. Events are
encoded by the world alone, so engines cannot differ by how a robot spells its request.
"""

import hashlib
from collections.abc import Callable, Iterable
from itertools import zip_longest
from typing import Literal

from msgspec import Struct

from protocol.codec import encode
from protocol.messages import AnyRequest, Look, Move, Wait, WaitForNews

LossCause = Literal["killed", "refused", "failed"]


class Event(Struct, frozen=True, array_like=True, gc=False):
    """One line of the trace.

    Attributes:
        time: virtual time.
        round: round of the instant; -1 for the opening looks.
        wave: wave of the round; -1 for a loss between waves.
        robot: who.
        place: where its body stands; ``None`` if it was lost on its way.
        entry: port by which it came to that place; ``None`` at its start.
        what: the request that was applied, or why the robot was lost.
        digest: CRC-32 of the encoded sight that the request answers; 0 where there is none.
    """

    time: float
    round: int
    wave: int
    robot: int
    place: int | None
    entry: int | None
    what: AnyRequest | str
    digest: int

    def __str__(self) -> str:
        where = "on its way" if self.place is None else f"at {self.place}"
        return (
            f"t={self.time:g} round={self.round} wave={self.wave} robot={self.robot} {where} "
            f"entry={self.entry} {describe(self.what)} sight={self.digest:08x}"
        )


Observer = Callable[[Event], None]


def describe(what: AnyRequest | str) -> str:
    """Return a request, or the cause of a loss, in a few words."""
    if isinstance(what, str):
        return f"lost ({what})"
    words = [type(what).__name__.lower()]
    if isinstance(what, Move):
        words.append(f"exit={what.exit}")
    elif isinstance(what, Wait):
        words.append(f"duration={what.duration:g}")
    elif isinstance(what, WaitForNews) and what.at_most is not None:
        words.append(f"at_most={what.at_most:g}")
    if isinstance(what, Look | Move) and what.gaze is not None:
        words.append(f"gaze={what.gaze}")
    if what.tag is not None:
        words.append(f"tag={what.tag.hex() or 'blank'}")
    if what.messages:
        words.append(f"messages={[message.hex() for message in what.messages]}")
    return " ".join(words)


class TraceDigest:
    """SHA-256 over the encoded events, in order."""

    __slots__ = ("_buffer", "_hash")

    def __init__(self) -> None:
        self._hash = hashlib.sha256()
        self._buffer = bytearray()

    def __call__(self, event: Event) -> None:
        """Take in the next event."""
        # One update for many events: a call of the hash costs more than hashing a line.
        self._buffer += encode(event)
        if len(self._buffer) > 1 << 16:
            self._hash.update(self._buffer)
            self._buffer.clear()

    def hexdigest(self) -> str:
        """Return the digest of all events so far."""
        self._hash.update(self._buffer)
        self._buffer.clear()
        return self._hash.hexdigest()


def first_difference(left: Iterable[Event], right: Iterable[Event]) -> str | None:
    """Return the first place where two traces part, as text; ``None`` where they are equal."""
    for number, (a, b) in enumerate(zip_longest(left, right)):
        if a != b:
            shown = ["(ends)" if event is None else str(event) for event in (a, b)]
            return f"event {number}:\n  left:  {shown[0]}\n  right: {shown[1]}"
    return None
